"""Search for loops among this host's processes, when the user's runtime directory has none."""

import contextlib
import itertools
import os
import pwd
import re
import time
from collections.abc import Iterator, Sequence

import psutil

from lowfc.adapters.bus.run import runtime_path

_PROGRAMS = ("controller", "sim-loop")
_MAX_LISTED = 3
_MAX_NAME_LENGTH = 48  # characters of a run's name
_VARIABLE = "XDG_RUNTIME_DIR"
_START_S = 600.0  # longest duration of a start: the first one computes the optical model


def no_loop_message() -> str:
    """Sentence for an error when no loop is found: the folder that was searched, and other loops on this host."""
    loops = list(other_loops())
    if transient := [text for text, starting in loops if starting]:
        return f"{transient[0]}, which is starting or ending: try again in a few seconds"
    origin = f"from {_VARIABLE}" if os.environ.get(_VARIABLE) else f"{_VARIABLE} is not set"
    message = (
        f"no loop of user {_user_name(os.geteuid())} is running here: {runtime_path()} was searched ({origin}); loops "
        f"of other users, or started with another {_VARIABLE}, cannot be reached"
    )
    unlisted = [f"and {len(loops) - _MAX_LISTED} more"] if len(loops) > _MAX_LISTED else []
    return "; ".join([message, *(text for text, _ in loops[:_MAX_LISTED]), *unlisted])


def other_loops() -> Iterator[tuple[str, bool]]:
    """Yield a sentence and a flag for each simulated loop and each separate controller on this host, of any user.

    The flag is set for a process of this user that started less than ten minutes ago with our runtime directory: as no
    run was found there, the loop is starting or ending.
    """
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.Error):  # it has ended, or is not readable
            program = _program(process.cmdline())
            parent = process.parent() if program else None
            if program and process.pid != os.getpid() and not (parent and _program(parent.cmdline())):
                owner = process.uids().effective
                subject = "you run" if owner == os.geteuid() else f"user {_user_name(owner)} runs"
                directory, starting = _directory_clause(process, owner)
                yield f"{subject} `{program}` (process {process.pid}){directory}", starting


def _program(arguments: Sequence[str]) -> str:
    """Short form `lowfc controller --run NAME` of a loop's command line; empty for all others, such as `sudo lowfc`."""
    if not arguments or not arguments[0].rpartition("/")[2].startswith("python"):
        return ""
    for program, command in itertools.pairwise(arguments):
        if program.rpartition("/")[2] == "lowfc" and command in _PROGRAMS:
            name = re.search(r" --run[ =](\S+)", " ".join(arguments))
            return f"lowfc {command}" + (f" --run {name[1][:_MAX_NAME_LENGTH]}" if name else "")
    return ""


def _directory_clause(process: psutil.Process, owner: int) -> tuple[str, bool]:
    """Clause on a process's runtime directory, and the flag of `other_loops`.

    The clause is empty if the flag is set, and for a process whose environment cannot be read.
    """
    try:
        folder = process.environ().get(_VARIABLE, "")
    except psutil.Error:
        return "", False
    if owner == os.geteuid() and folder == os.environ.get(_VARIABLE, ""):
        starting = time.time() - process.create_time() < _START_S
        return "" if starting else ", but its directory is gone, as after a logout: stop and restart it", starting
    return f", with {_VARIABLE}={folder}" if folder else f", without {_VARIABLE}", False


def _user_name(user: int) -> str:
    try:
        return pwd.getpwuid(user).pw_name
    except KeyError:
        return str(user)
