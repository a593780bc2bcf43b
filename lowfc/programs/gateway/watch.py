"""The newest messages of a run for a gateway, read several times a second."""

from typing import NamedTuple

from lowfc.adapters.logs.columns import Steps
from lowfc.arrays import Pixels
from lowfc.contract.messages import Role, wire
from lowfc.programs.view.monitor import Monitor
from lowfc.programs.view.verdicts.tile import Verdict
from lowfc.programs.view.verdicts.verdict import judge

SILENT_NS = 2_000_000_000
"""Time without a Health (sent twice a second) after which a process other than the controller is left out."""


class RunView(NamedTuple):
    """Present state of the run; `connected` if the controller has sent Health recently; `frame` only if it is new."""

    connected: bool
    state: wire.ControllerState
    processes: dict[str, wire.Health]
    verdict: Verdict
    steps: Steps
    frame: Pixels | None


class Watch(Monitor):
    """Receives a run's messages as a monitor, and makes a `RunView` of them."""

    def update(self) -> RunView:
        """Process the messages since the last call."""
        now_ns = self._clock.host_ns()
        snapshot = self.snapshot(now_ns)
        alive = {name for name, one in snapshot.health.items() if now_ns - one.time_ns < SILENT_NS}
        return RunView(
            Role.CONTROLLER in alive,
            snapshot.controller or wire.ControllerState(),
            {name: one.health for name, one in snapshot.health.items() if name in alive | {Role.CONTROLLER}},
            judge(self.watcher.state()),
            self.steps,
            snapshot.frame,
        )
