"""Find loops on this host whose runs are not in this user's runtime directory, by listing processes."""

import contextlib
import itertools
import os
import pwd
from collections.abc import Iterator, Sequence

import psutil

from lowfc.adapters.bus.run import runtime_path

_PROGRAMS = ("controller", "sim-loop")
_MOST = 3
_LONGEST = 48  # characters of a run's name
_FOLDER = "XDG_RUNTIME_DIR"
_STARTING = ", starting or ending"


def none_here() -> str:
    """Sentence for an error when no loop is found: the folder that was searched, and other loops on this host."""
    found = list(other_loops())
    transient = [each.removesuffix(_STARTING) for each in found if each.endswith(_STARTING)]
    if transient:
        return f"{transient[0]}, which is starting or ending: try again in a few seconds"
    origin = f"from {_FOLDER}" if os.environ.get(_FOLDER) else f"{_FOLDER} is not set"
    message = (
        f"no loop of user {_name(os.geteuid())} is running here: {runtime_path()} was searched ({origin}); loops of "
        f"other users, or started with another {_FOLDER}, are not seen"
    )
    more = [f"and {len(found) - _MOST} more"] if len(found) > _MOST else []
    return "; ".join([message, *found[:_MOST], *more])


def other_loops() -> Iterator[str]:
    """Yield a sentence for each simulated loop and each separate controller on this host, of any user."""
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.Error):  # it has ended, or is not readable
            program = _program(process.cmdline())
            above = process.parent() if program else None
            if program and process.pid != os.getpid() and not (above and _program(above.cmdline())):
                owner = process.uids().effective
                who = "you run" if owner == os.geteuid() else f"user {_name(owner)} runs"
                yield f"{who} `{program}` (process {process.pid}){_where(process)}"


def _program(words: Sequence[str]) -> str:
    """Short form `lowfc controller --run NAME` of a loop's command line; empty for others, including sudo's."""
    if not words or not words[0].rpartition("/")[2].startswith("python"):
        return ""
    for before, word in itertools.pairwise(words):
        if before.rpartition("/")[2] == "lowfc" and word in _PROGRAMS:
            name = words[words.index("--run") + 1 :][:1] if "--run" in words else []
            return " ".join(["lowfc", word, *(f"--run {one[:_LONGEST]}" for one in name)])
    return ""


def _where(process: psutil.Process) -> str:
    """Clause on the runtime directory of a process; empty for another user's process, which is not readable."""
    try:
        there = process.environ().get(_FOLDER, "")
    except psutil.Error:
        return ""
    if there == os.environ.get(_FOLDER, ""):
        return _STARTING
    return f", with {_FOLDER}={there}" if there else f", without {_FOLDER}"


def _name(user: int) -> str:
    try:
        return pwd.getpwuid(user).pw_name
    except KeyError:
        return str(user)
