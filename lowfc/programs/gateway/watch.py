"""The newest messages of a run for a gateway, read several times a second."""

from typing import NamedTuple

from lowfc.adapters.bus.bus import Bus, states
from lowfc.adapters.process.clock import Clock
from lowfc.arrays import Pixels
from lowfc.client.stream import step_of
from lowfc.contract.messages import STEP, Role, wire
from lowfc.control.loop.inputs import Step
from lowfc.programs.view.snapshot import SHOWN, Accumulator
from lowfc.programs.view.verdicts.tile import Verdict
from lowfc.programs.view.verdicts.verdict import judge
from lowfc.programs.view.verdicts.watcher import Watcher

SILENT_NS = 2_000_000_000
"""Longest time without a Health of the controller, which is sent twice a second."""
_WAITING = 2000
_PATIENCE_S = 0.2
_QUERY_AGAIN_NS = 5_000_000_000  # until a controller that did not answer is queried again


class RunView(NamedTuple):
    """Present state of the run; `connected` if the controller has sent Health recently; `frame` only if it is new."""

    connected: bool
    state: wire.ControllerState
    processes: dict[str, wire.Health]
    verdict: Verdict
    step: Step | None
    frame: Pixels | None


class Watch:
    """Receives as a monitor, through ring buffers that do not burden the loop."""

    def __init__(self, bus: Bus, clock: Clock) -> None:
        self._bus, self._clock = bus, clock
        self._rings = {topic: bus.ring(topic, 1 if topic.latest_only else _WAITING) for topic in SHOWN}
        self._accumulator, self._watcher = Accumulator(clock.now_ns() if clock.lockstep else None), Watcher()
        self._known: set[tuple[str, int]] = set()
        self._queried_ns = 0
        self._step: Step | None = None

    def update(self) -> RunView:
        """Process the messages since the last call."""
        add, now_ns = self._accumulator.add, self._clock.host_ns()
        for topic, ring in self._rings.items():
            samples = ring.drain()
            for sample in samples:
                add(sample)
            if topic is STEP and samples:
                self._step = step_of(samples[-1]) or self._step
        snapshot = self._accumulator.snapshot(now_ns)
        there = {(name, one.health.pid) for name, one in snapshot.health.items()}
        incomplete = Role.CONTROLLER in snapshot.health and None in (snapshot.calibration, snapshot.controller)
        if not there <= self._known or (incomplete and now_ns - self._queried_ns > _QUERY_AGAIN_NS):
            self._known, self._queried_ns = there, now_ns
            for _, sample in states(self._bus, SHOWN, _PATIENCE_S):
                add(sample)
        self._watcher.feed(snapshot)
        controller = snapshot.health.get(Role.CONTROLLER)
        connected = controller is not None and now_ns - controller.time_ns < SILENT_NS
        return RunView(
            connected,
            snapshot.controller or wire.ControllerState(),
            {name: one.health for name, one in snapshot.health.items()},
            judge(self._watcher.state()),
            self._step,
            snapshot.frame,
        )
