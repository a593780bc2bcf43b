"""Recorder of messages and events on an in-memory bus, for tests."""

from typing import Any

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.process.clock import Clock
from lowfc.adapters.process.service import Service
from lowfc.contract.messages import EVENT, Topic
from lowfc.testing.memory_bus import MemoryBus, MemoryHub


class Listener:
    """Keeps all messages of some topics and all events: `samples` has them by topic, with their envelopes.

    `hub` connects the processes of the test; `bus` is the listener's own connection, with an operator's role.
    """

    def __init__(self, clock: Clock, *topics: Topic) -> None:
        self.samples: dict[Topic, list[Sample]] = {topic: [] for topic in (*topics, EVENT)}
        self.hub, self.clock = MemoryHub(), clock
        self.bus = MemoryBus(self.hub, "operator", clock)
        for topic, received in self.samples.items():
            self.bus.subscribe(topic, received.append)

    def service(self, role: str, **options: Any) -> Service:
        """Make a process on the same hub with the same clock, with these options of `Service`."""
        return Service(role, "test", self.clock, MemoryBus(self.hub, role, self.clock), **options)

    def messages(self, topic: Topic) -> list[Any]:
        """Messages of a topic, in order."""
        return [topic.message.FromString(sample.payload) for sample in self.samples[topic]]

    def events(self) -> list[str]:
        """Names of the events, in order."""
        return [message.message.split()[0] for message in self.messages(EVENT)]

    def event_texts(self, start: str) -> list[str]:
        """Texts of the events whose text begins with `start`."""
        return [log.message for log in self.messages(EVENT) if log.message.startswith(start)]
