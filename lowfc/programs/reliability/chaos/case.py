"""A chaos case as data: the injected fault, the required outcome, and the events that must report the fault."""

import contextlib
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lowfc.programs.reliability.chaos.bench import ChaosBench

Act = Callable[[ChaosBench], None]
"""Function that injects the fault of a case."""

LOST = ("MESSAGES_LOST", "MIRROR_LOST")
"""Events of the level ERROR that many faults may cause."""
HOLD_FRAMES = 250  # number of frames for which a case keeps a state, such as safe mode


@dataclass(frozen=True)
class Case:
    """One case: once the loop has settled, `act` injects the fault; then the loop must recover.

    Attributes:
        name: name for `--case`.
        description: description of the fault.
        act: function that injects the fault.
        fault: kind of the fault that the camera is started with; empty for none.
        config: values that the case sets in the configuration, by key.
        expected: beginnings of the messages of events that must be in the log.
        allowed: names of events of the level ERROR or above that may be in the log besides the expected ones.
        ends_safe: whether the loop must end in safe mode with a flat mirror, not closed with the former residual.
        is_bad: whether the frame with a given number must be refused; None if all frames may be used.
        statuses: exit status other than 0 with which a process may end, by name of the process.
        prints_tracebacks: whether the processes may print tracebacks, from messages that cannot be decoded.
        why_skipped: function that returns why this host cannot run the case; empty if it can.
    """

    name: str
    description: str
    act: Act
    fault: str = ""
    config: Mapping[str, Any] = field(default_factory=dict)
    expected: tuple[str, ...] = ()
    allowed: tuple[str, ...] = ()
    ends_safe: bool = False
    is_bad: Callable[[int], bool] | None = None
    statuses: Mapping[str, int] = field(default_factory=dict)
    prints_tracebacks: bool = False
    why_skipped: Callable[[], str] = str  # str() is the empty string

    def run(self, bench: ChaosBench) -> None:
        """Inject the fault, and wait until the loop has recovered."""
        self.act(bench)
        if self.ends_safe:
            bench.await_steps(HOLD_FRAMES)
        else:
            bench.await_settled()


REGISTERED: dict[str, Case] = {}


def case(name: str, description: str, **attributes: Any) -> Callable[[Act], Act]:
    """Register a function as the `act` of a case; `attributes` are the other attributes of `Case`."""

    def register(act: Act) -> Act:
        REGISTERED[name] = Case(name, description, act, **attributes)
        return act

    return register


def no_clock_shift(shift_s: int) -> str:
    """Why a process cannot have a clock shifted by this time on this host; empty if it can."""
    return unmet(f"requires a clock shifted by {shift_s} s", "unshare", "--time", "--monotonic", str(shift_s), "true")


def no_mounts() -> str:
    """Why this process cannot mount on this host; empty if it can."""
    mount = ("mount", "-t", "tmpfs", "-o", "ro,size=1m", "tmpfs", tempfile.gettempdir())
    return unmet("requires the right to mount", "unshare", "--mount", *mount)


def unmet(requirement: str, *command: str) -> str:
    """Try a harmless command; return the requirement and why the command failed, or empty if it succeeded."""
    try:
        process = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603  # ours
    except OSError as fault:
        return f"{requirement} ({command[0]}: {fault.strerror})"
    why = process.stderr.strip().splitlines() or [f"{command[0]} ended with {process.returncode}"]
    return f"{requirement} ({why[0]})" if process.returncode else ""


@contextlib.contextmanager
def read_only(folder: Path) -> Iterator[None]:
    """Make a folder read-only within the context, for root too, even with open files in it."""
    subprocess.run(["mount", "--bind", folder, folder], check=True)  # noqa: S603, S607  # ours
    try:
        subprocess.run(["mount", "-o", "remount,ro,bind", folder], check=True)  # noqa: S603, S607  # ours
        yield
    finally:
        subprocess.run(["umount", "--lazy", folder], check=False)  # noqa: S603, S607  # ours
