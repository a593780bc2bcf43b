"""A chaos case as data: what befalls a running loop, what must come of it, and by which events it is named."""

import contextlib
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lowfc.programs.reliability.chaos.bench import ChaosBench

Act = Callable[[ChaosBench], None]

LOST = ("MESSAGES_LOST", "MIRROR_LOST")
WHILE_FRAMES = 250


@dataclass(frozen=True)
class Case:
    """One case: `act` does what its sentence says once the loop is quiet; then the loop is left to come to its end.

    Attributes:
        fault: kind of the frames' fault, of the camera from the start.
        config: keys that differ from a chaos run's own.
        expected: events that must be in the log, by how they begin.
        allowed: names of events of the level ERROR that may be there.
        safe: it must come to a latched loop and a flat mirror, not to a closed one with the residual as before.
        bad: which frames, by their number, may not be used.
        statuses: exit statuses that a process may end with, beside 0.
        noisy: tracebacks of what could not be read are to be expected.
        lacks: why this host cannot do it; empty where it can.
    """

    name: str
    sentence: str
    act: Act
    fault: str = ""
    config: Mapping[str, Any] = field(default_factory=dict)
    expected: tuple[str, ...] = ()
    allowed: tuple[str, ...] = ()
    safe: bool = False
    bad: Callable[[int], bool] | None = None
    statuses: Mapping[str, int] = field(default_factory=dict)
    noisy: bool = False
    lacks: Callable[[], str] = str

    def play(self, bench: ChaosBench) -> None:
        """Do it, and wait until what must come of it has come."""
        self.act(bench)
        if self.safe:
            bench.frames(WHILE_FRAMES)
        else:
            bench.settled()


REGISTERED: dict[str, Case] = {}


def case(name: str, sentence: str, **more: Any) -> Callable[[Act], Act]:
    """Register a function as what a case does; `more` are the case's other attributes."""

    def register(act: Act) -> Act:
        REGISTERED[name] = Case(name, sentence, act, **more)
        return act

    return register


def no_other_clock() -> str:
    """Why no process can have a clock of its own here; empty where one can."""
    return lacking("takes a time namespace", "unshare", "--time", "--monotonic", "1", "true")


def no_mounts() -> str:
    """Why nothing can be mounted here; empty where it can."""
    mount = ("mount", "-t", "tmpfs", "-o", "ro,size=1m", "tmpfs", tempfile.gettempdir())
    return lacking("takes a mount of its own", "unshare", "--mount", *mount)


def lacking(what: str, *words: str) -> str:
    """Try a command that harms nobody: `what` and why it fails, empty where it does not."""
    try:
        done = subprocess.run(words, capture_output=True, text=True, check=False)  # noqa: S603  # ours
    except OSError as fault:
        return f"{what} ({words[0]}: {fault.strerror})"
    why = done.stderr.strip().splitlines() or [f"{words[0]} ended with {done.returncode}"]
    return f"{what} ({why[0]})" if done.returncode else ""


@contextlib.contextmanager
def read_only(folder: Path) -> Iterator[None]:
    """A folder that cannot be written meanwhile, by root neither, whatever is open in it."""
    subprocess.run(["mount", "--bind", folder, folder], check=True)  # noqa: S603, S607  # ours
    try:
        subprocess.run(["mount", "-o", "remount,ro,bind", folder], check=True)  # noqa: S603, S607  # ours
        yield
    finally:
        subprocess.run(["umount", "--lazy", folder], check=False)  # noqa: S603, S607  # ours
