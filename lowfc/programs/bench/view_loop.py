"""A simulated loop beside which a view starts, works, hangs and dies; what every frame took meanwhile."""

import contextlib
import os
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from rich.console import Console

from lowfc.adapters.bus import Sample
from lowfc.adapters.child import Child
from lowfc.adapters.clock import HostClock
from lowfc.adapters.realtime import spread
from lowfc.adapters.run import new_run_id, open_run
from lowfc.adapters.usage import processor_s, resident_bytes
from lowfc.adapters.zenoh_bus import ZenohBus
from lowfc.contract.configuration import Configuration, load
from lowfc.contract.errors import BusError
from lowfc.contract.messages import EVENT, FRAME, HEALTH, TIMING, Log, Role, from_timestamp, wire
from lowfc.programs.processes import program, start_all, stop_all
from lowfc.programs.sim_loop import check, children_of, prepare
from lowfc.programs.watch import Watch, summary, topic_count

SETTLE_S = 1.0
"""Between a change and the measurement beside it."""
HEALTH_S = 0.6
"""After a phase, until every process has said what it missed."""

_READY_S = 120.0
_TURN_S = 0.05
_LAST_WORDS_S = 0.1
_VIEWER = "rerun"
_PATIENCE_S = 5.0


def loop_configuration(rate_hz: float, folder: Path, log_mb: float) -> Configuration:
    """What `lowfc sim-loop --rate` runs, with logs of this size in `folder`."""
    overrides = {"camera.rate_hz": rate_hz, "recorder.folder": str(folder), "recorder.largest_mb": log_mb}
    return load(None, overrides, {"control.start_mode": "closed", **spread(os.sched_getaffinity(0))})


class Phase(StrEnum):
    """What the view does while frames are timed; the order is the life of a view."""

    OFF = "off"
    STARTING = "starting"
    ON = "on"
    HUNG = "hung"
    VIEWER_HUNG = "viewer hung"
    KILLED = "killed"
    RENDERED = "rendered"


class Losses(NamedTuple):
    """Counts since the loop began.

    Attributes:
        skipped, missing: frames, by the controller's account.
        lost: messages, by the recorder's.
    """

    skipped: int
    missing: int
    lost: int


@dataclass(frozen=True, slots=True)
class Cost:
    """What the view's two processes take.

    Attributes:
        bridge_share, viewer_share: of one processor, all threads.
        bridge_bytes, viewer_bytes: resident memory at the end.
        moments_hz: drawn at the end; a view that gets no processor time is cheap.
    """

    bridge_share: float
    viewer_share: float
    bridge_bytes: int
    viewer_bytes: int
    moments_hz: float


@dataclass(frozen=True, slots=True)
class Reading:
    """One phase, once.

    Attributes:
        phase: which.
        frame_to_command_ns: of every frame of it, (frames,).
        losses: in it; `HEALTH_S` before and after it are counted too, for that is how often processes say.
        cost: of the view; None where none works.
    """

    phase: Phase
    frame_to_command_ns: npt.NDArray[np.int64]
    losses: Losses
    cost: Cost | None


class LoopBesideView:
    """The processes of a simulated loop, recorder included, within a `with` block; and at most one view.

    Attributes:
        renewals: how often a view began anew.
    """

    def __init__(self, config: Configuration, folder: Path, played: Sequence[Path] = ()) -> None:
        """Prepare it.

        Args:
            config: of the loop.
            folder: what the view leaves behind when it is killed is left there.
            played: instead of the loop, its logs are published, at their own rate, by one process.
        """
        self.renewals = 0
        self._played = played
        self._config = config
        self._folder = folder
        self._clock = HostClock()
        self._watch = Watch({}, [])
        self._timings: list[tuple[int, list[int]]] = []
        self._run = open_run(new_run_id(), (config.mirror.name,), listeners=(Role.LAUNCHER,))
        self._children: list[Child] = []
        self._view: Child | None = None
        self._rendering = False
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> "LoopBesideView":
        with contextlib.ExitStack() as stack:
            stack.callback(self._run.remove)
            prepare(self._config, self._run, Console(stderr=True))
            if self._played:
                words = ["-m", "lowfc", "replay", *map(str, self._played), "--publish", "--run", self._run.run_id]
                self._children = [program("player", [*words, "--json"], self._run.path / "player.stderr")]
            else:
                self._children = children_of(self._config, self._run, None, record=True)
            bus = ZenohBus(self._run.links, Role.LAUNCHER, self._clock)
            stack.callback(bus.close)
            bus.subscribe(HEALTH, self._watch.hear)
            bus.subscribe(EVENT, self._note)
            bus.subscribe(TIMING, self._time)
            stack.callback(time.sleep, _LAST_WORDS_S)
            stack.callback(stop_all, self._children)
            start_all(self._children)
            if not self._played:
                self._until(lambda: self._watch.of(Role.CAMERA).state == "running", "the camera")
            stack.callback(self._stop_view)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *how: object) -> None:
        self._stack.close()

    def figures(self) -> dict[str, Any]:
        """Figures of the run so far; of all of it once the `with` block has ended."""
        return summary(self._watch, record=True)

    def wait(self, seconds: float) -> None:
        """Let time pass.

        Raises:
            ProcessDiedError: a process of the loop ended by itself.
        """
        end_s = time.monotonic() + seconds
        while (left_s := end_s - time.monotonic()) > 0:
            check(self._children)
            time.sleep(min(left_s, _TURN_S))

    def read(self, phase: Phase, seconds: float) -> Reading:
        """Time every frame of one phase.

        Raises:
            ProcessDiedError: a process of the loop ended by itself.
            BusError: the view did not get ready, or ended; or nothing is heard of the controller.
        """
        if phase in (Phase.OFF, Phase.STARTING):
            self._stop_view()
        else:
            self._want_view(rendering=phase is Phase.RENDERED)
        self.wait(SETTLE_S)
        pids, losses = self._pids(), self._losses()
        begun_ns = self._clock.host_ns()
        with self._disturbed(phase, pids):
            cost = self._cost(pids, seconds) if phase is Phase.ON else None
            if cost is None:
                self.wait(seconds)
        end_ns = self._clock.host_ns()
        self.wait(HEALTH_S)
        if phase is Phase.KILLED:
            self._stop_view()
        elif self._view is not None:
            _check_view(self._view)
        durations_ns = [ns for time_ns, frames in self._timings if begun_ns < time_ns <= end_ns for ns in frames]
        self._timings.clear()
        if not durations_ns:
            raise BusError(f"the controller said nothing of its timing within {seconds:g} s; make the phases longer")
        lost = (now - then for now, then in zip(self._losses(), losses, strict=True))
        return Reading(phase, np.array(durations_ns), Losses(*lost), cost)

    def cost(self, seconds: float) -> Cost:
        """What a view takes for so long.

        Raises:
            ProcessDiedError: a process of the loop ended by itself.
            BusError: the view did not get ready, or ended.
        """
        self._want_view(rendering=False)
        self.wait(SETTLE_S)
        return self._cost(self._pids(), seconds)

    @contextlib.contextmanager
    def _disturbed(self, phase: Phase, pids: tuple[int, ...]) -> Iterator[None]:
        """What the phase is about; what was frozen goes on afterwards."""
        frozen = pids[:1] if phase is Phase.HUNG else pids[1:] if phase is Phase.VIEWER_HUNG else ()
        if phase is Phase.STARTING:
            self._start_view(rendering=False)
        elif phase is Phase.KILLED:
            os.kill(pids[0], signal.SIGKILL)
        try:
            for pid in frozen:
                os.kill(pid, signal.SIGSTOP)
            yield
        finally:
            for pid in frozen:
                with contextlib.suppress(ProcessLookupError):  # a view ends a viewer that hangs for long
                    os.kill(pid, signal.SIGCONT)

    def _want_view(self, *, rendering: bool) -> None:
        """Wait until there is a view of this kind, and start it where there is none."""
        if self._view is None or self._rendering != rendering:
            self._stop_view()
            self._start_view(rendering=rendering)
        self._until(self._view_ready, "the view")

    def _view_ready(self) -> bool:
        health = self._watch.of(Role.VIEWER)
        return self._view is not None and health.pid == _pid(self._view) and health.state == "ready"

    def _pids(self) -> tuple[int, ...]:
        """Numbers of the processes of the view and of its viewer; none where there is no view."""
        if self._view is None:
            return ()
        view = _pid(self._view)
        self._until(lambda: bool(_viewers_of(view)), "the viewer")  # a view may just be starting it again
        return view, _viewers_of(view)[0]

    def _start_view(self, *, rendering: bool) -> None:
        where = (
            ["--headless-screenshot", str(self._folder / "view.png"), "--seconds", "1e6"] if rendering else ["--web"]
        )
        words = ["-m", "lowfc", "view", "--run", self._run.run_id, *where]
        self._view = program(str(Role.VIEWER), words, self._run.path / f"{Role.VIEWER}.stderr")
        self._view.environment = os.environ | {"TMPDIR": str(self._folder)}
        self._rendering = rendering
        self._view.start()

    def _stop_view(self) -> None:
        if self._view is not None:
            self._view.stop(_PATIENCE_S)
            self._view = None

    def _until(self, there: Callable[[], bool], who: str) -> None:
        deadline_s = time.monotonic() + _READY_S
        while not there():
            if self._view is not None:
                _check_view(self._view)
            if time.monotonic() > deadline_s:
                said = self._view.last_words() if self._view is not None else "nothing"
                raise BusError(f"{who} did not get ready within {_READY_S:g} s; the view said: {said}")
            self.wait(_TURN_S)

    def _time(self, sample: Sample) -> None:
        """Keep the durations of a message's frames, on the bus's thread."""
        timing = wire.ControlTiming.FromString(sample.payload)
        self._timings.append((from_timestamp(timing.timestamp), list(timing.frame_to_command_ns)))

    def _note(self, sample: Sample) -> None:
        """Count the view's new beginnings, on the bus's thread."""
        self.renewals += Log.FromString(sample.payload).message.startswith("VIEW_RENEWED")

    def _losses(self) -> Losses:
        frames = topic_count(self._watch.of(Role.CONTROLLER), FRAME.key)
        return Losses(frames.skipped, frames.missing, self._watch.of(Role.RECORDER).recording.lost)

    def _cost(self, pids: tuple[int, ...], seconds: float) -> Cost:
        """Let time pass, and tell what the view took of it."""
        used_s, begun_s = [processor_s(pid) for pid in pids], time.monotonic()
        self.wait(seconds)
        elapsed_s = time.monotonic() - begun_s
        bridge_share, viewer_share = (
            (processor_s(pid) - then_s) / elapsed_s for pid, then_s in zip(pids, used_s, strict=True)
        )
        bridge_bytes, viewer_bytes = map(resident_bytes, pids)
        return Cost(bridge_share, viewer_share, bridge_bytes, viewer_bytes, self._watch.of(Role.VIEWER).rate_hz)


def _check_view(view: Child) -> None:
    if view.status is not None:
        raise BusError(f"{view.how_it_ended()}; its last words: {view.last_words()}")


def _pid(child: Child) -> int:
    assert child.process is not None  # noqa: S101  # it was started
    return child.process.pid


def _viewers_of(view: int) -> list[int]:
    """Numbers of the viewers that a view's process has started."""
    try:
        tasks = Path(f"/proc/{view}/task").iterdir()
        children = [child for task in tasks for child in (task / "children").read_text().split()]
        return [int(child) for child in children if Path(f"/proc/{child}/comm").read_text().strip() == _VIEWER]
    except (FileNotFoundError, ProcessLookupError):  # one has just ended
        return []
