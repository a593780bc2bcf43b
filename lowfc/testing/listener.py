"""What a test hears of a process: messages by topic, events by name."""

from typing import Any

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.process.clock import Clock
from lowfc.adapters.process.service import Service
from lowfc.contract.messages import EVENT, Topic
from lowfc.testing.memory_bus import MemoryBus, MemoryHub


class Listener:
    """Keeps every message of some topics and of the events: `samples` has them with their envelopes, by topic."""

    def __init__(self, hub: MemoryHub, clock: Clock, *topics: Topic) -> None:
        self.samples: dict[Topic, list[Sample]] = {topic: [] for topic in (*topics, EVENT)}
        self._hub, self._clock = hub, clock
        bus = MemoryBus(hub, "operator", clock)
        for topic, kept in self.samples.items():
            bus.subscribe(topic, kept.append)

    def service(self, role: str) -> Service:
        """A process beside it, on the same bus and by the same clock."""
        return Service(role, "test", self._clock, MemoryBus(self._hub, role, self._clock))

    def messages(self, topic: Topic) -> list[Any]:
        """Messages of a topic, in their order."""
        return [topic.message.FromString(sample.payload) for sample in self.samples[topic]]

    def events(self) -> list[str]:
        """Names of the events, in their order."""
        return [message.message.split()[0] for message in self.messages(EVENT)]

    def said(self, start: str) -> list[str]:
        """Events that begin so, in full."""
        return [log.message for log in self.messages(EVENT) if log.message.startswith(start)]
