"""Checks of a camera's frames: format, time, rate and pixels."""

from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from lowfc.arrays import Pixels
from lowfc.contract.messages import FRAME, MONO16, wire
from lowfc.control.loop.wording import counted
from lowfc.programs.commissioning.checks import Check, Table, ok, warning, wrong
from lowfc.programs.commissioning.conformance.camera import Camera
from lowfc.programs.commissioning.conformance.connection import NS_PER_S
from lowfc.programs.commissioning.conformance.publisher import PROCESS, PUBLISHER
from lowfc.programs.commissioning.conformance.settings import SETTINGS

_SILENT_PERIODS = 5  # longest wait between frames that is not reported, in frame periods
_JITTER = 0.1  # largest deviation of 99 % of the waits from the period that is not reported, in frame periods
_SMOOTHER = 2.0  # roughness of an image relative to that with swapped bytes, above which its bytes count as swapped
_READOUT_NS = 50_000_000  # longest plausible time from end of exposure to publication
_FULL = 0.01  # fraction of the pixels above which saturated pixels are reported
_STOPPED_NS = 300_000_000  # a shorter time without frames, before the first plus after the last, is never reported
_VARIED = 8  # the alignment of the bits is judged if the pixels have more different values than this
_AGE_NS = 1_000_000  # tolerance of the age of a frame
_OWN_WAIT_NS = 10_000_000  # shorter waits may be caused by this host, not by the camera

ARRIVED: Table[Camera] = Table()
FRAMES: Table[Camera] = Table()
"""Checks that need at least one frame."""


def camera_checks(camera: Camera) -> Iterator[Check]:
    """All checks of a camera."""
    yield from ARRIVED.run(camera)
    yield from PUBLISHER.run(camera)
    if camera.frames:
        yield from FRAMES.run(camera)
    yield from SETTINGS.run(camera)
    yield from PROCESS.run(camera)


@ARRIVED.check("frames", f"{FRAME.key}: foxglove.RawImage, one for each exposure")
def _frames(camera: Camera) -> Check:
    count = len(camera.published)
    if not count:
        advice = "does the camera use this run's session file (`lowfc config zenoh --role camera`), and this key?"
        return wrong(f"none in {camera.seconds:g} s; received: {camera.keys}", camera.driver_failure or advice)
    if camera.unreadable:
        got = f"{camera.unreadable} of {count} payloads are not a foxglove.RawImage"
        return wrong(got, "encode the message as declared in foxglove/RawImage.proto")
    return ok(f"{count} in {camera.seconds:g} s")


_ONE_CLOCK = (
    "use the same clock for the timestamp and the publish time: `lowfc.device.CameraClock` converts the times of a "
    "camera's own clock"
)


@FRAMES.check("frame time", "end of the exposure, on the clock of the publish time, increasing")
def _frame_time(camera: Camera) -> Check:
    times = [frame.time_ns for frame in camera.frames]
    if not all(times):
        return wrong(f"{counted(times.count(0), 'frame')} without a timestamp", "set it in every frame")
    not_later = sum(later <= earlier for earlier, later in pairwise(times))
    if not_later:
        got = f"{not_later} of {len(times) - 1} not later than the previous one"
        return wrong(got, "read the time for every exposure, from a clock that never steps")
    age_ns = int(np.median(np.subtract(camera.publish_times_ns, times)))
    exposure_ns = 0 if camera.settings is None else camera.settings.exposure_ns
    got = f"{age_ns / 1e6:.3g} ms before the publish time"
    if age_ns < -_AGE_NS:
        got = f"{-age_ns / 1e6:.3g} ms after the publish time"
        return wrong(got, _ONE_CLOCK)
    if age_ns > _READOUT_NS + exposure_ns:
        return wrong(got, f"{_ONE_CLOCK}; both are nanoseconds since the epoch")
    if exposure_ns > _AGE_NS and 0.9 * exposure_ns <= age_ns < 1.5 * exposure_ns:
        advice = (
            "about one exposure: is the timestamp the start of the exposure? Ignore this if the readout takes so long"
        )
        return warning(got, advice)
    return ok(got)


@FRAMES.check("encoding", MONO16)
def _encoding(camera: Camera) -> Check:
    encodings = {frame.image.encoding for frame in camera.frames}
    if encodings == {MONO16}:
        return ok(MONO16)
    return wrong(", ".join(map(repr, sorted(encodings))), "send uint16 in DN, little-endian, with encoding mono16")


@FRAMES.check("bytes", "step is 2 x width, and data are step x height bytes")
def _bytes(camera: Camera) -> Check:
    last = next((frame for frame in reversed(camera.frames) if frame.highest_dn is None), None)
    if last is None:
        return ok(f"step {camera.frames[-1].image.step}, {camera.frames[-1].data_bytes} bytes")
    rows, columns = last.shape
    advice = "send complete rows without padding, and set width and height accordingly"
    if last.data_bytes == rows * columns:
        advice = "the pixels are bytes: send uint16"
    elif last.data_bytes == 2 * rows * columns:
        advice = "set step, in bytes"
    return wrong(f"{rows} x {columns} (height x width), step {last.image.step}, {last.data_bytes} bytes", advice)


@FRAMES.check("shape", "the same rows and columns in every frame")
def _shape(camera: Camera) -> Check:
    got = ", ".join(f"{rows} x {columns}" for rows, columns in camera.shapes)
    return ok(got) if len(camera.shapes) == 1 else wrong(got, "keep one region of interest while the loop runs")


@FRAMES.check("steadiness", "frames at a constant rate during the whole check")
def _steadiness(camera: Camera) -> Check:
    spans = np.diff(camera.publish_times_ns)
    if not spans.size:
        return warning("one frame", "use a longer --duration")
    period_ns = float(np.median(spans))
    elapsed_ns = camera.frames[-1].receive_time_ns - camera.frames[0].receive_time_ns
    missing_ns = camera.seconds * NS_PER_S - elapsed_ns
    if missing_ns > max(_SILENT_PERIODS * period_ns, 0.2 * camera.seconds * NS_PER_S, _STOPPED_NS):
        got = f"frames during {elapsed_ns / 1e9:.1f} of {camera.seconds:g} s"
        return wrong(got, "the camera must publish whether or not a process subscribes; repeat while it is running")
    late_ns, longest_ns = float(np.percentile(np.abs(spans - period_ns), 99)), float(spans.max())
    got = (
        f"every {period_ns / 1e6:.4g} ms, 99 % of the waits within {late_ns / 1e6:.3g} ms of that, "
        f"longest wait {longest_ns / 1e6:.3g} ms"
    )
    if longest_ns > max(_SILENT_PERIODS * period_ns, _OWN_WAIT_NS):
        return warning(got, "what delays the camera? Check the host with `lowfc doctor`")
    if late_ns > _JITTER * period_ns:
        return warning(got, "jitter adds to the delay: use real-time scheduling for the publisher (`lowfc doctor`)")
    return ok(got)


@FRAMES.check("live image", "no two identical frames: each has noise")
def _live_image(camera: Camera) -> Check:
    sums = [frame.checksum for frame in camera.frames]
    same = sum(earlier == later for earlier, later in pairwise(sums))
    if len(sums) > 1 and same == len(sums) - 1:
        return wrong("all are identical", "read the camera out for every frame")
    if same:
        advice = "publish each exposure once, and count the frames that the camera dropped"
        return wrong(f"{same} of {len(sums)} are identical to the previous one", advice)
    return ok(f"{len(set(sums))} different of {len(sums)}")


@FRAMES.check("light", "brightest pixel above the bias, and few pixels at full well")
def _light(camera: Camera) -> Check | None:
    if not camera.pixels:
        return None
    highest, state = camera.brightest_dn, camera.settings or wire.CameraState()
    noise_dn = state.read_noise_e / state.gain_e_per_dn if state.gain_e_per_dn > 0 else 0.0
    if not highest:
        return wrong("every pixel of every frame is 0", "copy the pixels into the message")
    if highest <= state.bias_dn + 10 * noise_dn:
        got = f"brightest pixel {highest} DN, bias {state.bias_dn:g} DN"
        return warning(got, "no light: is the shutter open and the star on the sensor?")
    full = np.mean([np.mean(pixels >= highest) for pixels in camera.pixels])
    if 0 <= state.saturation_dn - highest < 1 and full > _FULL:
        got = f"{100 * full:.0f} % of the pixels at {highest} DN"
        return warning(got, "shorten the exposure: saturated pixels measure nothing")
    return ok(f"brightest pixel {highest} DN")


@FRAMES.check("byte order", "little-endian, right-aligned DN")
def _byte_order(camera: Camera) -> Check | None:
    if not camera.pixels:
        return None
    picture = camera.pixels[-1]  # one image: the median of several is meaningless with swapped bytes
    as_is, swapped = _roughness(picture), _roughness(picture.byteswap())
    if as_is > _SMOOTHER * swapped:
        got = f"the image is {as_is / max(swapped, 1e-9):.0f} times smoother with the bytes swapped: big-endian?"
        return wrong(got, "write the low byte of each pixel first")
    values = np.unique(np.concatenate([pixels.reshape(-1) for pixels in camera.pixels]))
    bits = int(np.bitwise_or.reduce(values))
    spare = (bits & -bits).bit_length() - 1 if bits else 0
    if spare >= 2 and values.size > _VARIED:
        advice = f"shift them right by {spare} bits: with left-aligned data gain, bias and saturation are wrong"
        return wrong(f"all pixels are multiples of {1 << spare}", advice)
    return ok("the image is smooth as received")


def _roughness(picture: Pixels) -> float:
    """Mean difference of neighbouring pixels relative to the standard deviation of all pixels."""
    values = picture.astype(np.float64)
    if values.size < 4 or not values.std():
        return 0.0
    steps = [np.abs(np.diff(values, axis=axis)).mean() for axis in (0, 1) if values.shape[axis] > 1]
    return float(np.mean(steps) / values.std())
