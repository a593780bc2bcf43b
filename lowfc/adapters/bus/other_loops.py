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
_FOLDER = "XDG_RUNTIME_DIR"
_START_S = 600.0  # longest start: the first one computes the optical model


def no_loop_message() -> str:
    """Sentence for an error when no loop is found: the folder that was searched, and other loops on this host."""
    loops = list(other_loops())
    if transient := [text for text, starting in loops if starting]:
        return f"{transient[0]}, which is starting or ending: try again in a few seconds"
    origin = f"from {_FOLDER}" if os.environ.get(_FOLDER) else f"{_FOLDER} is not set"
    message = (
        f"no loop of user {_user_name(os.geteuid())} is running here: {runtime_path()} was searched ({origin}); loops "
        f"of other users, or started with another {_FOLDER}, cannot be reached"
    )
    unlisted = [f"and {len(loops) - _MAX_LISTED} more"] if len(loops) > _MAX_LISTED else []
    return "; ".join([message, *(text for text, _ in loops[:_MAX_LISTED]), *unlisted])


def other_loops() -> Iterator[tuple[str, bool]]:
    """Yield a sentence and a flag for each simulated loop and each separate controller on this host, of any user.

    The flag is set for a young process of this user with our runtime directory: as no run was found there, the loop is
    starting or ending.
    """
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.Error):  # it has ended, or is not readable
            program = _program(process.cmdline())
            parent = process.parent() if program else None
            if program and process.pid != os.getpid() and not (parent and _program(parent.cmdline())):
                owner = process.uids().effective
                who = "you run" if owner == os.geteuid() else f"user {_user_name(owner)} runs"
                where, starting = _directory_clause(process, owner)
                yield f"{who} `{program}` (process {process.pid}){where}", starting


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
    """Clause on a process's runtime directory; whether it is a young process of this user with our runtime directory.

    The clause is empty for such a process, and for a process of another user whose environment cannot be read.
    """
    try:
        folder = process.environ().get(_FOLDER, "")
    except psutil.Error:
        return "", False
    if owner == os.geteuid() and folder == os.environ.get(_FOLDER, ""):
        starting = time.time() - process.create_time() < _START_S
        return "" if starting else ", but its directory is gone, as after a logout: stop and restart it", starting
    return f", with {_FOLDER}={folder}" if folder else f", without {_FOLDER}", False


def _user_name(user: int) -> str:
    try:
        return pwd.getpwuid(user).pw_name
    except KeyError:
        return str(user)
