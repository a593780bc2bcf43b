"""Loops whose runs are not in this user's runtime directory, as far as the kernel tells of their processes."""

import contextlib
import itertools
import os
import pwd
from collections.abc import Iterator, Sequence
from pathlib import Path

from lowfc.adapters.bus.run import runtime_path

_PROGRAMS = ("controller", "sim-loop")
_MOST = 3
_LONGEST = 48  # characters of a run's name
_PROC = Path("/proc")
_FOLDER = "XDG_RUNTIME_DIR"


def none_here() -> str:
    """Sentence for a user who has no loop here: which folder was searched, what is not seen from here, who runs one."""
    given = f"from {_FOLDER}" if os.environ.get(_FOLDER) else f"{_FOLDER} is not set"
    sentence = (
        f"no loop of user {_name(os.geteuid())} is running here: {runtime_path()} was searched ({given}); loops of "
        f"other users, or started with another {_FOLDER}, are not seen"
    )
    found = list(other_loops())
    more = [f"and {len(found) - _MOST} more"] if len(found) > _MOST else []
    return "; ".join([sentence, *found[:_MOST], *more])


def other_loops(proc: Path = _PROC) -> Iterator[str]:
    """A sentence for each controller or simulated loop on this host, whoever runs it."""
    for folder in sorted(proc.glob("[0-9]*"), key=lambda one: int(one.name)):
        if folder.name == str(os.getpid()):
            continue
        with contextlib.suppress(OSError):  # it has ended, or the system does not tell
            program = _program((folder / "cmdline").read_bytes().decode(errors="replace").split("\0"))
            if program:
                owner = folder.stat().st_uid
                who = "you run" if owner == os.geteuid() else f"user {_name(owner)} runs"
                yield f"{who} `{program}` (process {folder.name}{_where(folder)})"


def _program(words: Sequence[str]) -> str:
    """`lowfc controller --run NAME` of a command line that is one; empty for any other."""
    for before, word in itertools.pairwise(words):
        if before.rpartition("/")[2] == "lowfc" and word in _PROGRAMS:
            name = words[words.index("--run") + 1 :][:1] if "--run" in words else []
            return " ".join(["lowfc", word, *(f"--run {one[:_LONGEST]}" for one in name)])
    return ""


def _where(folder: Path) -> str:
    """The runtime directory of a process; nothing for that of another user, which the kernel does not tell."""
    try:
        words = (folder / "environ").read_bytes().decode(errors="replace").split("\0")
    except OSError:
        return ""
    there = dict(word.partition("=")[::2] for word in words).get(_FOLDER, "")
    if there == os.environ.get(_FOLDER, ""):
        return ", still starting"
    return f", with {_FOLDER}={there}" if there else f", without {_FOLDER}"


def _name(user: int) -> str:
    try:
        return pwd.getpwuid(user).pw_name
    except KeyError:
        return str(user)
