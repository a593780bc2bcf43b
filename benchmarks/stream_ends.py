"""The two ends of a camera's stream: who writes prepared frames into it, and a driver that notes when each was written.

Example: python -m benchmarks.stream_ends FOLDER STREAM FRAMES, with the folder of a run
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
from lowfc.device import Exposure
from lowfc.device.drivers.isio.camera import IsioCamera
from lowfc.programs.measure.frame_source import FRAMES_FILE, SENT_FILE

GO_FILE = "go"
"""In the run's directory, once the first frame may come."""

_LOOK_S = 0.02
_LEAD_NS, _WARM_UP_NS = 10_000_000, 150_000
_LAST_COMMAND_S = 0.1


class TimedCamera(IsioCamera):
    """The driver `isio` as it is; beside it, the moment before each image was written, which is the image's `atime`."""

    def __init__(self, options: IsioCamera.Options, config: Configuration) -> None:
        """Open the stream."""
        super().__init__(options, config)
        self._sequence, self._put_ns, self._written_ns = array("Q"), array("q"), array("q")

    def join(self, service: Service) -> None:
        """Keep the clock, and the run's folder, where the times go."""
        super().join(service)
        self._folder = open_run(service.run_id, ()).path
        self._clock = service.clock

    def start(self) -> None:
        """Everybody is there."""
        (self._folder / GO_FILE).touch()

    def expose(self) -> Exposure | None:
        """The next image of the stream."""
        exposure = super().expose()
        if exposure is not None:
            self._newest_ns = (exposure.end_ns or 0) + self._clock.ahead_ns()
        return exposure

    def sent(self, envelope: Envelope) -> None:
        """Note the times of the frame."""
        self._sequence.append(envelope.sequence)
        self._put_ns.append(envelope.publish_time_ns)
        self._written_ns.append(self._newest_ns)

    def close(self) -> None:
        """Leave the times: the moment at which a frame was due is that at which it was written into the stream."""
        super().close()
        np.savez(
            self._folder / SENT_FILE,
            sequence=np.array(self._sequence),
            put_ns=np.array(self._put_ns),
            due_ns=np.array(self._written_ns),
        )


def main() -> None:
    """Write every frame at its moment, whatever became of the last; what is late is written at once.

    A camera's program is of C. So as not to be slower than that by far, this one does the same elsewhere just before.
    """
    folder, name, count = Path(sys.argv[1]), sys.argv[2], int(sys.argv[3])
    config, frames, path = load(folder / "config.toml"), np.load(folder / FRAMES_FILE), stream_path(name)
    stream, rehearsed = Stream(path), Stream.create(path.with_stem(f"{path.stem}_"), frames.shape[1:], frames.dtype)
    prepare(config, config.realtime.camera_cpus)
    clock = HostClock()
    while not (folder / GO_FILE).exists():
        time.sleep(_LOOK_S)
    due_ns = clock.now_ns() + _LEAD_NS
    for index in range(count):
        frame = frames[index % len(frames)]
        clock.sleep_until_ns(due_ns - _WARM_UP_NS)
        rehearsed.put(frame, time.time_ns())
        clock.sleep_until_ns(due_ns)
        stream.put(frame, time.time_ns())
        due_ns += config.period_ns
    time.sleep(_LAST_COMMAND_S)


if __name__ == "__main__":
    main()
