"""What a camera's publisher gets wrong: its frames, its settings, its times, looked at for a while."""

import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from google.protobuf.message import DecodeError

from lowfc.contract.messages import CAMERA_STATE, FRAME, MONO16, RawImage, Role, from_timestamp, wire
from lowfc.programs.conformance.checks import (
    LATE_NS,
    NS,
    Check,
    Heard,
    envelope_checks,
    envelope_of,
    health_check,
    key_check,
    ok,
    sent_on,
    warning,
    wrong,
)
from lowfc.programs.conformance.line import Line
from lowfc.programs.conformance.settings import settings_checks

TURN_S = 0.02
PICTURES = 50
"""Frames whose pixels are kept."""

_SILENT_PERIODS = 5
_JITTER = 0.1
_SMOOTHER = 2.0
_READOUT_NS = 50_000_000
_FULL = 0.01
_STOPPED_NS = 300_000_000
_VARIED = 8
_AGE_NS = 1_000_000
_OWN_WAIT_NS = 10_000_000  # may be this host's, not the camera's


class Picture(NamedTuple):
    """What is kept of a frame; `highest` is its brightest pixel, None where it is not whole."""

    receive_time_ns: int
    time_ns: int
    put_ns: int | None
    rows: int
    columns: int
    encoding: str
    step: int
    size: int
    checksum: int
    highest: int | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.rows, self.columns

    @property
    def whole(self) -> bool:
        """Whether it has as many bytes as it says."""
        return self.step == 2 * self.columns and self.size == self.step * self.rows > 0


@dataclass(slots=True)
class Watched:
    """What was heard of a camera.

    Attributes:
        seconds: for how long.
        frames: every frame, without its pixels.
        unreadable: payloads that are no RawImage.
        pixels: (rows, columns) of some of them, as little-endian.
        messages: all that was heard, frames without their payload.
        states: the camera's settings as they came; None for one that could not be read.
        answers: to who asks for the settings.
        offset_ns: what CLOCK_MONOTONIC is short of the epoch.
    """

    seconds: float
    offset_ns: int = 0
    frames: list[Picture] = field(default_factory=list)
    unreadable: int = 0
    pixels: list[npt.NDArray[np.uint16]] = field(default_factory=list)
    messages: list[Heard] = field(default_factory=list)
    states: list[wire.CameraState | None] = field(default_factory=list)
    answers: list[Heard] = field(default_factory=list)

    @property
    def put_times_ns(self) -> list[int]:
        """When each frame was put; when it arrived, where the envelopes' times are no good."""
        puts, arrivals = [frame.put_ns or 0 for frame in self.frames], [frame.receive_time_ns for frame in self.frames]
        near = all(abs(arrival - put) <= LATE_NS for put, arrival in zip(puts, arrivals, strict=True))
        return puts if near and all(later > earlier for earlier, later in pairwise(puts)) else arrivals

    def take(self, heard: Heard) -> None:
        """Keep of a message what is looked at later."""
        if heard.key == FRAME.key:
            self._frame(heard)
            heard = heard._replace(payload=b"")
        elif heard.key == CAMERA_STATE.key:
            self.states.append(_state(heard.payload))
        self.messages.append(heard)

    def _frame(self, heard: Heard) -> None:
        try:
            image = RawImage.FromString(heard.payload)
        except DecodeError:
            self.unreadable += 1
            return
        data, envelope = image.data, envelope_of(heard)
        pixels = np.frombuffer(data[: len(data) // 2 * 2], "<u2")
        picture = Picture(
            heard.receive_time_ns,
            from_timestamp(image.timestamp),
            None if envelope is None else envelope.publish_time_ns,
            image.height,
            image.width,
            image.encoding,
            image.step,
            len(data),
            zlib.crc32(data),
        )
        if picture.whole:
            picture = picture._replace(highest=int(pixels.max()))
        self.frames.append(picture)
        if picture.whole and len(self.pixels) < PICTURES:
            self.pixels.append(pixels.reshape(picture.shape))


def _state(payload: bytes) -> wire.CameraState | None:
    try:
        return wire.CameraState.FromString(payload)
    except DecodeError:
        return None


def watch(line: Line, seconds: float, advance: Callable[[float], None]) -> Watched:
    """Listen to a camera for so long; `advance` is told how long it has been."""
    watched = Watched(seconds, line.offset_ns)
    begun_ns = line.now_ns()
    while (elapsed_s := (line.now_ns() - begun_ns) / NS) < seconds:
        advance(elapsed_s)
        line.wait(min(TURN_S, seconds - elapsed_s))
        for heard in line.heard():
            watched.take(heard)
    watched.answers = line.ask(CAMERA_STATE.key)
    return watched


def camera_checks(watched: Watched) -> Iterator[Check]:
    """What is right and wrong with a camera."""
    heard = sent_on(watched.messages, FRAME.key)
    expected = f"{FRAME.key}: foxglove.RawImage, one for each exposure"
    if not heard:
        others = ", ".join(sorted({one.key for one in watched.messages})) or "nothing"
        advice = "is the camera in this run, with the session file of `lowfc config zenoh --role camera`, on this key?"
        yield wrong("frames", expected, f"none in {watched.seconds:g} s; heard: {others}", advice)
    elif watched.unreadable:
        got = f"{watched.unreadable} of {len(heard)} payloads are no foxglove.RawImage"
        yield wrong("frames", expected, got, "encode the message with its declaration, foxglove/RawImage.proto")
    else:
        yield ok("frames", expected, f"{len(heard)} in {watched.seconds:g} s")
    if heard:
        yield from envelope_checks(heard, watched.offset_ns)
    states = [state for state in watched.states if state is not None]
    if watched.frames:
        yield _frame_time(watched, states)
        yield from _form(watched.frames)
        yield _steady(watched)
        yield from _pictures(watched, states)
    yield from settings_checks(watched.states, watched.answers, watched.frames, watched.seconds)
    yield health_check(watched.messages, Role.CAMERA, watched.seconds)
    yield key_check(watched.messages)


def _frame_time(watched: Watched, states: Sequence[wire.CameraState]) -> Check:
    name, expected = "frame time", "end of the exposure, on the clock of the puts, growing"
    times = [frame.time_ns for frame in watched.frames]
    if not all(times):
        return wrong(name, expected, f"{times.count(0)} frames without a timestamp", "set it in every frame")
    back = sum(later <= earlier for earlier, later in pairwise(times))
    if back:
        got = f"not above the one before it, {back} times of {len(times)}"
        return wrong(name, expected, got, "take it anew for every exposure, from a clock that never steps")
    age_ns = int(np.median(np.subtract(watched.put_times_ns, times)))
    exposure_ns = states[-1].exposure_ns if states else 0
    got = f"{age_ns / 1e6:.3g} ms before the put"
    if age_ns < -_AGE_NS:
        return wrong(name, expected, f"{-age_ns / 1e6:.3g} ms after the put", "use the same clock for both")
    if age_ns > _READOUT_NS + exposure_ns:
        return wrong(name, expected, got, "use the same clock for both, in nanoseconds since the epoch")
    if exposure_ns > _AGE_NS and 0.9 * exposure_ns <= age_ns < 1.5 * exposure_ns:
        advice = "about as long as the exposure: is it the time of its start? If the readout takes so long, all is well"
        return warning(name, expected, got, advice)
    return ok(name, expected, got)


def _form(frames: Sequence[Picture]) -> Iterator[Check]:
    """Encoding, bytes and shape."""
    encodings = sorted({frame.encoding for frame in frames})
    if encodings == [MONO16]:
        yield ok("encoding", MONO16, MONO16)
    else:
        got = ", ".join(map(repr, encodings))
        yield wrong("encoding", MONO16, got, "send uint16 in DN, little-endian, and call it mono16")
    bad = [frame for frame in frames if not frame.whole]
    expected = "step is 2 x width, and data are step x height bytes"
    if bad:
        one = bad[-1]
        got = f"{one.rows} x {one.columns} (height x width), step {one.step}, {one.size} bytes"
        if one.size == one.rows * one.columns:
            advice = "these are bytes, not uint16"
        elif one.size == 2 * one.rows * one.columns:
            advice = "set step, in bytes"
        else:
            advice = "send whole rows without padding, with the width and height they have"
        yield wrong("bytes", expected, got, advice)
    else:
        yield ok("bytes", expected, f"step {frames[-1].step}, {frames[-1].size} bytes")
    shapes = sorted({frame.shape for frame in frames})
    got = ", ".join(f"{rows} x {columns}" for rows, columns in shapes)
    if len(shapes) > 1:
        yield wrong("shape", "the same rows and columns in every frame", got, "keep one region while the loop runs")
    else:
        yield ok("shape", "the same rows and columns in every frame", got)


def _steady(watched: Watched) -> Check:
    """Whether frames come all the time, and evenly."""
    name, expected = "steadiness", "frames at an even rate for as long as one looks"
    spans = np.diff(watched.put_times_ns)
    if not spans.size:
        return warning(name, expected, "one frame", "look for longer: --duration")
    period_ns = float(np.median(spans))
    elapsed_ns = watched.frames[-1].receive_time_ns - watched.frames[0].receive_time_ns
    lacking_ns = watched.seconds * NS - elapsed_ns
    if lacking_ns > max(_SILENT_PERIODS * period_ns, 0.2 * watched.seconds * NS, _STOPPED_NS):
        got = f"frames during {elapsed_ns / 1e9:.1f} of {watched.seconds:g} s"
        return wrong(name, expected, got, "does the camera go on, whoever looks? Look again while it runs")
    late_ns, longest_ns = float(np.percentile(np.abs(spans - period_ns), 99)), float(spans.max())
    got = (
        f"every {period_ns / 1e6:.4g} ms, 99 % within {late_ns / 1e6:.3g} ms of it, "
        f"longest wait {longest_ns / 1e6:.3g} ms"
    )
    if longest_ns > max(_SILENT_PERIODS * period_ns, _OWN_WAIT_NS):
        return warning(name, expected, got, "what holds the camera up? `lowfc doctor` looks at the host")
    if late_ns > _JITTER * period_ns:
        return warning(
            name, expected, got, "jitter costs delay: real-time scheduling for the publisher (`lowfc doctor`)"
        )
    return ok(name, expected, got)


def _pictures(watched: Watched, states: Sequence[wire.CameraState]) -> Iterator[Check]:
    """Whether the pixels are those of a live sensor."""
    sums = [frame.checksum for frame in watched.frames]
    same = sum(earlier == later for earlier, later in pairwise(sums))
    expected = "no two frames alike: there is noise in each"
    if len(sums) > 1 and same == len(sums) - 1:
        yield wrong("live image", expected, "all are alike", "is the camera read out anew for every frame?")
    elif same:
        got = f"{same} of {len(sums)} are the one before"
        yield wrong("live image", expected, got, "publish each exposure once, and count what the camera dropped")
    else:
        yield ok("live image", expected, f"{len(set(sums))} different ones of {len(sums)}")
    if not watched.pixels:
        return
    highest = max(frame.highest or 0 for frame in watched.frames)
    expected = "light above the bias, and hardly a pixel at full well"
    state = states[-1] if states else wire.CameraState()
    noise_dn = state.read_noise_e / state.gain_e_per_dn if state.gain_e_per_dn > 0 else 0.0
    if not highest:
        yield wrong("light", expected, "every pixel of every frame is 0", "are the pixels copied into the message?")
    elif highest <= state.bias_dn + 10 * noise_dn:
        got = f"brightest pixel {highest} DN, bias {state.bias_dn:g} DN"
        yield warning("light", expected, got, "all dark: is the shutter open, is the star there?")
    elif highest == int(state.saturation_dn) and _full(watched.pixels, highest) > _FULL:
        got = f"{100 * _full(watched.pixels, highest):.0f} % of the pixels at {highest} DN"
        yield warning("light", expected, got, "expose for less: what is at full well measures nothing")
    else:
        yield ok("light", expected, f"brightest pixel {highest} DN")
    yield _pixel_bytes(watched.pixels)


def _full(pixels: Sequence[npt.NDArray[np.uint16]], saturation_dn: float) -> float:
    return float(np.mean([np.mean(one >= saturation_dn) for one in pixels]))


def _pixel_bytes(pixels: Sequence[npt.NDArray[np.uint16]]) -> Check:
    """Byte order and alignment, by what makes neighbours alike."""
    name, expected = "byte order", "little-endian, in DN from bit 0 on"
    picture = pixels[-1]  # not their median: that of swapped bytes is nothing
    as_is, swapped = _roughness(picture), _roughness(picture.byteswap())
    if as_is > _SMOOTHER * swapped:
        got = f"neighbours differ {as_is / max(swapped, 1e-9):.0f} times less with the bytes swapped: big-endian?"
        return wrong(name, expected, got, "write the low byte of each pixel first")
    values = np.unique(np.concatenate([one.reshape(-1) for one in pixels]))
    bits = int(np.bitwise_or.reduce(values))
    spare = (bits & -bits).bit_length() - 1 if bits else 0
    if spare >= 2 and values.size > _VARIED:
        advice = f"shift them right by {spare}: left-aligned data make gain, bias and saturation wrong"
        return wrong(name, expected, f"all pixels are multiples of {1 << spare}", advice)
    return ok(name, expected, "neighbouring pixels are alike as they are")


def _roughness(picture: npt.NDArray[np.uint16]) -> float:
    """Mean difference of neighbours, as a fraction of the scatter of all pixels."""
    values = picture.astype(np.float64)
    if values.size < 4 or not values.std():
        return 0.0
    steps = [np.abs(np.diff(values, axis=axis)).mean() for axis in (0, 1) if values.shape[axis] > 1]
    return float(np.mean(steps) / values.std())
