"""Processor time of a loop's processes, from /proc, while a command of ours runs them."""

import contextlib
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from lowfc.adapters.usage import processor_s

MODULES = {
    "sim_camera": "camera",
    "lowfc.programs.frame_source": "camera",
    "lowfc controller": "controller",
    "sim_dm": "mirror",
    "lowfc record": "recorder",
}
"""What Python was told to run, and the role that it has in the loop."""
LOOP = {"camera", "controller", "mirror"}

_EVERY_S = 0.2
_PART = 0.8


class Share(NamedTuple):
    """What a process used.

    Attributes:
        share: of one processor, all its threads.
        processors: those that it may run on, as the kernel lists them.
    """

    share: float
    processors: str


class Moment(NamedTuple):
    """Processor time used so far by each role's process, seconds, and where it may run."""

    at_s: float
    used_s: dict[str, float]
    processors: dict[str, str]


class Watched:
    """Looks at the processes below one, five times a second, within a `with` block."""

    def __init__(self, pid: int) -> None:
        """Name the process that starts the loop's."""
        self._pid = pid
        self._moments: list[Moment] = []
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._look, daemon=True)

    def __enter__(self) -> "Watched":
        self._thread.start()
        return self

    def __exit__(self, *how: object) -> None:
        self._ended.set()
        self._thread.join()

    def shares(self, seconds: float) -> dict[str, Share]:
        """Of each role, at the end of a loop that lasts so long; see `shares`."""
        return shares(self._moments, seconds)

    def _look(self) -> None:
        while not self._ended.wait(_EVERY_S):
            moment = Moment(time.monotonic(), {}, {})
            for pid in below(self._pid):
                with contextlib.suppress(OSError):  # it has just ended
                    role = role_of(Path(f"/proc/{pid}/cmdline").read_text().split("\0"))
                    if role is not None:
                        moment.used_s[role] = processor_s(pid)
                        moment.processors[role] = _processors(pid)
            self._moments.append(moment)


def shares(moments: list[Moment], seconds: float) -> dict[str, Share]:
    """What each role used while the loop went on: over the last four fifths of it, before its processes ended.

    Args:
        moments: in the order of time.
        seconds: for how long frames came.

    Returns:
        Nothing where fewer than two moments fall into that time.
    """
    whole = [moment for moment in moments if moment.used_s.keys() >= LOOP][:-1]
    inside = [moment for moment in whole if moment.at_s >= whole[-1].at_s - _PART * seconds]
    if len(inside) < 2:
        return {}
    first, last = inside[0], inside[-1]
    return {
        role: Share((used_s - first.used_s[role]) / (last.at_s - first.at_s), last.processors[role])
        for role, used_s in last.used_s.items()
        if role in first.used_s
    }


def role_of(words: list[str]) -> str | None:
    """Role of a process in the loop, from its command line; None where it has none."""
    module = words[words.index("-m") + 1 :] if "-m" in words else []
    return MODULES.get(" ".join(module[:1])) or MODULES.get(" ".join(module[:2]))


def below(pid: int) -> Iterator[int]:
    """Numbers of the processes that one has started, and that those have."""
    with contextlib.suppress(FileNotFoundError, ProcessLookupError):
        for task in Path(f"/proc/{pid}/task").iterdir():
            for child in map(int, (task / "children").read_text().split()):
                yield child
                yield from below(child)


def _processors(pid: int) -> str:
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("Cpus_allowed_list:"):
            return line.split()[1]
    return ""
