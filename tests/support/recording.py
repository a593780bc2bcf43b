"""A recorder, a camera and a controller on a memory bus."""

import threading
from collections import Counter
from pathlib import Path

from lowfc.adapters.bus.bus import Publisher, Sample
from lowfc.adapters.logs.reader import LogReader
from lowfc.adapters.process.clock import HostClock
from lowfc.contract.messages import Topic, wire
from lowfc.programs.core.recording.recorder import Recorder
from lowfc.programs.core.recording.summary import Summary
from lowfc.testing.listener import Listener
from lowfc.testing.memory_bus import MemoryBus
from tests.support.loops import until

PATIENCE_S = 20.0


class Bench(Listener):
    """A recorder in its own thread, two services that publish, and the events on their bus."""

    def __init__(self, folder: Path) -> None:
        super().__init__(HostClock())
        self.folder = folder
        self.summary: Summary | None = None
        self.thread = threading.Thread(target=self._record, daemon=True)
        self.cameras: list[wire.CameraState | None] = []  # camera states known when the first log began
        self.camera, self.controller = self.service("camera"), self.service("controller")

    def start(self, bytes_per_s: float = 0.0, **options: object) -> None:
        def expected(camera: wire.CameraState | None) -> float:
            self.cameras.append(camera)
            return bytes_per_s

        bus = MemoryBus(self.hub, "recorder", self.clock)
        metadata = {"lowfc": {"run": "test"}}
        self.recorder = Recorder(
            bus, self.clock, "test", self.folder, metadata=metadata, expected_bytes_per_s=expected, **options
        )
        self.thread.start()
        for service in (self.camera, self.controller):
            service.state = "ready"
        until(lambda: self.recorder.service.state == "ready" or not self.thread.is_alive())

    def stop(self) -> Summary:
        for service in (self.camera, self.controller):
            service.finish()
        self.recorder.service.stop("stopped by test")
        self.thread.join(PATIENCE_S)
        assert self.summary is not None
        return self.summary

    def losses(self) -> Counter[str]:
        """Number of messages that events report as lost, by topic."""
        counts: Counter[str] = Counter()
        for event in self.event_texts("MESSAGES_LOST"):
            _, count, *_, topic = event.split()
            counts[topic] += int(count)
        return counts

    def _record(self) -> None:
        self.summary = self.recorder.run()


def put(publisher: Publisher, count: int) -> list[bytes]:
    """Publish numbered messages; return their payloads."""
    bodies = [b"%s %d" % (publisher.key.encode(), publisher.published + number) for number in range(count)]
    for body in bodies:
        publisher.put(body)
    return bodies


def logged(summary: Summary) -> list[Sample]:
    return [message for path in summary.files for message in LogReader(path)]


def bodies_of(messages: list[Sample], topic: Topic) -> list[bytes]:
    return [message.payload for message in messages if message.key == topic.key]
