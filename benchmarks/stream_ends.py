"""Both ends of a stream: a program that writes prepared frames, and a driver that reads them and records their times.

Example: python -m benchmarks.stream_ends FOLDER STREAM COUNT, with the folder of a run
"""

import sys
import time
from array import array
from pathlib import Path

import numpy as np

from lowfc.adapters.bus.run import open_run
from lowfc.adapters.image_stream.stream import Stream, stream_path
from lowfc.adapters.process.clock import HostClock
from lowfc.adapters.process.join import prepare
from lowfc.adapters.process.service import Service
from lowfc.contract.configuration import Configuration, load
from lowfc.contract.envelope import Envelope
from lowfc.contract.messages import Role
from lowfc.device import Exposure
from lowfc.device.drivers.isio.camera import IsioCamera
from lowfc.programs.measure.frame_source import FRAMES_FILE, SENT_FILE

GO_FILE = "go"
"""File in the run's directory that starts the writer."""

_POLL_S = 0.02
_LEAD_NS, _WARM_UP_NS = 10_000_000, 150_000
_LAST_COMMAND_S = 0.1


class TimedCamera(IsioCamera):
    """The driver `isio`; it also records the image's `atime`, the time just before it was written."""

    def __init__(self, options: IsioCamera.Options, config: Configuration) -> None:
        """Open the stream."""
        super().__init__(options, config)
        self._sequence, self._put_ns, self._written_ns = array("Q"), array("q"), array("q")

    def join(self, service: Service) -> None:
        """Store the clock and the run's folder, which are needed to record the times."""
        super().join(service)
        self._folder = open_run(service.run_id, ()).path
        self._clock = service.clock

    def start(self) -> None:
        """Start the writer."""
        (self._folder / GO_FILE).touch()

    def expose(self) -> Exposure | None:
        """The next image of the stream."""
        exposure = super().expose()
        if exposure is not None:
            self._newest_ns = (exposure.end_ns or 0) + self._clock.ahead_ns()
        return exposure

    def sent(self, envelope: Envelope) -> None:
        """Record the times of the frame."""
        self._sequence.append(envelope.sequence)
        self._put_ns.append(envelope.publish_time_ns)
        self._written_ns.append(self._newest_ns)

    def close(self) -> None:
        """Save the times. `due_ns` of a frame is its `atime` here; in a frame source it is the scheduled time."""
        super().close()
        np.savez(
            self._folder / SENT_FILE,
            sequence=np.array(self._sequence),
            put_ns=np.array(self._put_ns),
            due_ns=np.array(self._written_ns),
        )


def main() -> None:
    """Write every frame at its scheduled time, or at once if late.

    A real camera's program is in C; to be about as fast, this one first writes each frame to a warm-up stream.
    """
    folder, name, count = Path(sys.argv[1]), sys.argv[2], int(sys.argv[3])
    config, frames, path = load(folder / "config.toml"), np.load(folder / FRAMES_FILE), stream_path(name)
    stream, warm_up = Stream(path), Stream.create(path.with_stem(f"{path.stem}_"), frames.shape[1:], frames.dtype)
    prepare(config, Role.CAMERA, config.realtime.camera_cpus)
    clock = HostClock()
    while not (folder / GO_FILE).exists():
        time.sleep(_POLL_S)
    scheduled_ns = clock.now_ns() + _LEAD_NS
    for index in range(count):
        frame = frames[index % len(frames)]
        clock.sleep_until_ns(scheduled_ns - _WARM_UP_NS)
        warm_up.put(frame, time.time_ns())
        clock.sleep_until_ns(scheduled_ns)
        stream.put(frame, time.time_ns())
        scheduled_ns += config.period_ns
    time.sleep(_LAST_COMMAND_S)


if __name__ == "__main__":
    main()
