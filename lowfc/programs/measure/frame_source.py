"""A camera that sends prepared frames on an absolute schedule.

It replaces the simulated camera when the loop is timed, so that the simulation does not load the host. At its end it
writes a file with the times at which each frame was due and was sent.
"""

import math
from array import array
from contextlib import closing
from typing import Annotated

import numpy as np
import typer

from lowfc.adapters.bus.run import open_run
from lowfc.adapters.files import factory
from lowfc.adapters.files.whole_file import being_written
from lowfc.adapters.process.join import join
from lowfc.adapters.process.realtime import yield_to_sender
from lowfc.adapters.process.terminal import DEFAULT_RUN, ConfigFile, RunId, configuration, new_app, run_app
from lowfc.arrays import Pixels
from lowfc.contract.configuration import Configuration
from lowfc.contract.messages import CAMERA_STATE, FRAME, RawImage, Role, image, timestamp
from lowfc.device.driver import CameraSettings, camera_state
from lowfc.optics.chain.zernike import zernikes
from lowfc.optics.detector.detector import expose
from lowfc.optics.twin.twin import Evaluator, node_radii

FRAMES_FILE = "frames.npy"
"""File in the run's directory: the frames, (frames, rows, columns) uint16."""
SENT_FILE = "sent.npz"
"""File in the run's directory: sequence, put_ns and due_ns of every frame sent."""
BEGIN_FILE = "begin"
"""File in the run's directory: time at which the first frame is due, ns."""

_COUNT = 32  # number of different frames; they are sent over and over in this order
_TILT_NM, _OTHER_NM = 3.0, 1.0  # amplitudes, nm rms
_MAX_CYCLES = 3  # largest number of oscillations of a mode in _COUNT frames
_WAIT_S = 60.0  # longest wait for the other processes: a view takes long to load
_FIRST_FRAME_PERIODS = 10  # periods from the start to the first frame

app = new_app("A camera that sends prepared frames.")


def prepared_frames(config: Configuration) -> Pixels:
    """Noisy frames (frames, rows, columns) of the configured sensor while the modes oscillate by a few nm."""
    optics = factory.twin(config, None, lambda _: None)
    evaluator, detector = Evaluator(optics), factory.detector(config)
    electrons = np.float32(factory.electrons_per_exposure(config))
    rng = np.random.default_rng([config.seed, 4])
    noll = np.array(config.noll)
    amplitude_nm = np.where(noll <= 3, _TILT_NM, _OTHER_NM)
    cycles, phase = rng.integers(1, _MAX_CYCLES + 1, noll.size), rng.uniform(0, 2 * np.pi, noll.size)
    modes_nm = amplitude_nm * np.sin(2 * np.pi * np.outer(np.arange(_COUNT) / _COUNT, cycles) + phase)
    wavefronts_nm = (modes_nm @ zernikes(config.noll, *node_radii(optics))).astype(np.float32)
    return np.stack([expose(detector, evaluator.image(opd_nm) * electrons, rng) for opd_nm in wavefronts_nm])


class Payloads:
    """Frames as messages, encoded once; only the time stamp is added for each use."""

    def __init__(self, pixels: Pixels) -> None:
        self.shape: tuple[int, int] = (pixels.shape[1], pixels.shape[2])
        self._bodies = []
        for frame in pixels:
            message = image(frame, 0, "lowfc_camera")
            message.ClearField("timestamp")
            self._bodies.append(message.SerializeToString())

    def at(self, index: int, time_ns: int) -> bytes:
        """Payload `index` (modulo their number) with this time stamp: encoded protobuf fields can be concatenated."""
        head = RawImage(timestamp=timestamp(time_ns)).SerializeToString()
        return head + self._bodies[index % len(self._bodies)]


@app.command()
def frame_source(
    run: RunId = DEFAULT_RUN,
    config: ConfigFile = None,
    seconds: Annotated[float, typer.Option(help="Duration, seconds.")] = 10.0,
    wait_for: Annotated[list[str] | None, typer.Option(help="Process to wait for; repeat for several.")] = None,
) -> None:
    """Send the frames in the run's directory as the run's camera, and write there when each was due and sent.

    Each frame is sent when it is due, or at once if it is overdue; none is left out.
    """
    settings = configuration(config)
    folder, period_ns = open_run(run, (settings.mirror.name,)).path, settings.period_ns
    payloads = Payloads(np.load(folder / FRAMES_FILE))
    service = join(settings, run, Role.CAMERA, settings.realtime.camera_cpus)
    service.catch_signals()
    sequence, put_ns, due_ns = array("Q"), array("q"), array("q")
    with closing(service.bus):  # a callback on zenoh's threads must not outlive the interpreter
        frames, states, clock = service.publisher(FRAME), service.publisher(CAMERA_STATE), service.clock
        service.state = "ready"
        service.require(wait_for or (), _WAIT_S, "no frame is sent")
        state = camera_state(CameraSettings.configured(settings, *payloads.shape), clock.now_ns())
        states.put(state.SerializeToString())
        service.state = "running"
        begin_ns = clock.now_ns() + _FIRST_FRAME_PERIODS * period_ns
        draft = folder / f".{BEGIN_FILE}"  # `write_whole` waits for the disk, and the first frame would be late
        draft.write_text(str(begin_ns))
        draft.replace(folder / BEGIN_FILE)
        for index in range(math.ceil(seconds * settings.camera.rate_hz)):
            next_ns = begin_ns + index * period_ns
            payload = payloads.at(index, next_ns)
            clock.sleep_until_ns(next_ns)
            if not service.running:
                break
            envelope = frames.put(payload)
            yield_to_sender()
            due_ns.append(next_ns)
            sequence.append(envelope.sequence)
            put_ns.append(envelope.publish_time_ns)
            service.work += 1
            service.beat()
        with being_written(folder / SENT_FILE) as part, part.open("wb") as file:
            np.savez(file, sequence=np.array(sequence), put_ns=np.array(put_ns), due_ns=np.array(due_ns))
        service.finish()


if __name__ == "__main__":
    run_app(app)
