"""The newest messages of a run, read several times a second by a console or a gateway."""

from collections import deque
from importlib import import_module

from lowfc.adapters.bus.bus import Bus, Sample, last_messages
from lowfc.adapters.logs.columns import StepRows
from lowfc.adapters.process.clock import Clock
from lowfc.contract.messages import EVENT, STEP, SURFACE, TRUTH, Role
from lowfc.programs.view.snapshot import SHOWN, Accumulator, Snapshot
from lowfc.programs.view.verdicts.watcher import Watcher

_RING_SIZES = {EVENT: 200, STEP: 4000, TRUTH: 200}  # messages; for an rms, 200 truths per snapshot suffice
_QUERY_AGAIN_NS = 5_000_000_000  # time until a controller that did not answer is queried again


def import_late_modules() -> None:
    """Import the module that only later verdicts use: its import during a verdict would delay all values shown."""
    import_module("lowfc.control.laws.tuning")


class Monitor:
    """Receives through ring buffers, which keep the newest messages: the loop never waits for a monitor.

    `watcher`: derives the state of the run for the verdict. `steps`: the last steps received; empty before the first.
    """

    _query_timeout_s = 0.2
    """Timeout of a query of one topic."""

    def __init__(self, bus: Bus, clock: Clock) -> None:
        """Subscribe to the shown topics except the surface."""
        self.watcher, self.steps = Watcher(), StepRows(0).values()
        self._bus, self._clock = bus, clock
        self._rings = {
            topic: bus.ring(topic, 1 if topic.latest_only else _RING_SIZES.get(topic, 100))
            for topic in SHOWN
            if topic is not SURFACE
        }
        self._accumulator = Accumulator(clock.now_ns() if clock.lockstep else None)
        self._answers: deque[Sample] = deque()
        self._known_processes: set[tuple[str, int]] = set()
        self._queried_ns = 0

    def snapshot(self, now_ns: int, behind_s: float = 0.0) -> Snapshot:
        """Return the data since the last call; the next has states of new processes. `behind_s`: see `Snapshot`."""
        while self._answers:
            self._accumulator.add(self._answers.popleft())
        for ring in self._rings.values():
            for sample in ring.drain():
                self._accumulator.add(sample)
        snapshot = self._accumulator.snapshot(now_ns, behind_s=behind_s)
        processes = {(name, last.start_s) for name, last in snapshot.health.items()}
        incomplete = Role.CONTROLLER in snapshot.health and not self._complete(snapshot)
        if not processes <= self._known_processes or (incomplete and now_ns - self._queried_ns > _QUERY_AGAIN_NS):
            self._known_processes, self._queried_ns = processes, now_ns
            self._query()
        self.watcher.feed(snapshot)
        if snapshot.steps.mode.size:
            self.steps = snapshot.steps
        return snapshot

    def _complete(self, snapshot: Snapshot) -> bool:
        """Whether all states queried from the controller have arrived; subclasses may query more states."""
        return None not in (snapshot.calibration, snapshot.controller)

    def _query(self) -> None:
        """Query the last states that the processes published."""
        self._answers.extend(sample for _, sample in last_messages(self._bus, SHOWN, self._query_timeout_s))
