"""Bench values used by interlocks: the newest of each, and its age."""

from collections.abc import Callable, Iterable
from math import inf

from lowfc.adapters.process.service import Service
from lowfc.contract.codecs.bench_codec import decode_bench_value
from lowfc.contract.errors import BadMessageError
from lowfc.contract.messages import BENCH
from lowfc.control.loop.interlocks import BenchReport, Interlock, Value

ANSWER_S = 0.2
"""Timeout of the query for a value at the controller's start."""


class BenchValues:
    """The newest value of each name; however many values arrive, a frame costs one check of each name."""

    def __init__(
        self, service: Service, interlocks: Iterable[Interlock], report: Callable[[BenchReport], None]
    ) -> None:
        self._service = service
        self._report = report
        max_ages_ns: dict[str, set[int]] = {}
        for interlock in interlocks:
            max_ages_ns.setdefault(interlock.name, set()).add(interlock.max_age_ns)
        self._slots = [_Slot(service, name, sorted(ages)) for name, ages in max_ages_ns.items()]

    def query(self) -> None:
        """Query the publisher of each value, so that every interlock is evaluated before the first frame."""
        for slot in self._slots:
            answers, age_ns = self._service.bus.get(BENCH.at(slot.name), timeout_s=ANSWER_S), 0
            if answers and not slot.mailbox.waiting:  # a value published meanwhile is newer
                newest = max(answers, key=lambda answer: answer.publish_time_ns)
                slot.mailbox.put(newest)
                age_ns = max(0, newest.receive_time_ns - newest.publish_time_ns)
            now_ns = self._service.clock.now_ns()
            self._report(slot.report(now_ns, age_ns) or BenchReport(now_ns, slot.name, None))

    def update(self) -> None:
        """Report new values, and values that have become too old for an interlock."""
        if self._slots:
            now_ns = self._service.clock.now_ns()
            for slot in self._slots:
                if (slot.mailbox.waiting or now_ns > slot.due_ns) and (report := slot.report(now_ns)) is not None:
                    self._report(report)


class _Slot:
    """The newest value of one name; after `due_ns` it is too old for one more of its interlocks."""

    def __init__(self, service: Service, name: str, max_ages_ns: list[int]) -> None:
        self.name = name
        self.mailbox = service.mailbox(BENCH, name)
        self.due_ns = inf
        self._unreadable = service.unreadable
        self._max_ages_ns = max_ages_ns
        self._value: Value | None = None
        self._received_ns = 0

    def report(self, now_ns: int, age_ns: int = 0) -> BenchReport | None:
        """The newest value and its age; None without a value. A value waiting in the mailbox has the age `age_ns`."""
        sample = self.mailbox.take(0.0)
        if sample is not None:
            try:
                self._value, self._received_ns = decode_bench_value(sample.payload), now_ns - age_ns
            except BadMessageError as fault:
                self._unreadable(sample.key, fault)
        if self._value is None:
            return None
        age_ns = now_ns - self._received_ns
        self.due_ns = self._received_ns + next(
            (max_age_ns for max_age_ns in self._max_ages_ns if max_age_ns >= age_ns), inf
        )
        return BenchReport(now_ns, self.name, self._value, age_ns)
