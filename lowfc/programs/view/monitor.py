"""The newest messages of a run, read several times a second by a console or a gateway."""

from collections import deque
from importlib import import_module

from lowfc.adapters.bus.bus import Bus, Sample, last_messages
from lowfc.adapters.logs.columns import StepRows
from lowfc.adapters.process.clock import Clock
from lowfc.contract.messages import EVENT, STEP, SURFACE, TRUTH, Role
from lowfc.programs.view.snapshot import SHOWN, Accumulator, Snapshot
from lowfc.programs.view.verdicts.watcher import Watcher

_RING_SIZES = {EVENT: 200, STEP: 4000, TRUTH: 200}  # messages; the newest 200 truths per reading suffice for an rms
_QUERY_AGAIN_NS = 5_000_000_000  # until a controller that did not answer is queried again


def import_late_modules() -> None:
    """Import the module that only a later verdict uses: imported then, it would delay all values of that reading."""
    import_module("lowfc.control.laws.tuning")


class Monitor:
    """Receives as a monitor: messages wait in rings that keep the newest, so that the loop never waits for it.

    `watcher`: state of the run, from which the verdict is made. `steps`: the newest ones; none before the first.
    """

    _patience_s = 0.2
    """Timeout of a query of one topic."""

    def __init__(self, bus: Bus, clock: Clock) -> None:
        """Subscribe."""
        self.watcher, self.steps = Watcher(), StepRows(0).values()
        self._bus, self._clock = bus, clock
        self._rings = {
            topic: bus.ring(topic, 1 if topic.latest_only else _RING_SIZES.get(topic, 100))
            for topic in SHOWN
            if topic is not SURFACE
        }
        self._accumulator = Accumulator(clock.now_ns() if clock.lockstep else None)
        self._answers: deque[Sample] = deque()
        self._known: set[tuple[str, int]] = set()
        self._queried_ns = 0

    def snapshot(self, now_ns: int, behind_s: float = 0.0) -> Snapshot:
        """Return the messages since the last call; states published by new processes are queried, for the next call."""
        while self._answers:
            self._accumulator.add(self._answers.popleft())
        for ring in self._rings.values():
            for sample in ring.drain():
                self._accumulator.add(sample)
        snapshot = self._accumulator.snapshot(now_ns, behind_s=behind_s)
        processes = {(name, last.start_s) for name, last in snapshot.health.items()}
        incomplete = Role.CONTROLLER in snapshot.health and not self._complete(snapshot)
        if not processes <= self._known or (incomplete and now_ns - self._queried_ns > _QUERY_AGAIN_NS):
            self._known, self._queried_ns = processes, now_ns
            self._query()
        self.watcher.feed(snapshot)
        if snapshot.steps.mode.size:
            self.steps = snapshot.steps
        return snapshot

    def _complete(self, snapshot: Snapshot) -> bool:
        """Whether everything that is queried of the controller is known; subclasses may query more."""
        return None not in (snapshot.calibration, snapshot.controller)

    def _query(self) -> None:
        """Query the states published earlier."""
        self._answers.extend(sample for _, sample in last_messages(self._bus, SHOWN, self._patience_s))
