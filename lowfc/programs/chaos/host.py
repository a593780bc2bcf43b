"""What a chaos case needs of its host, beside the loop."""

import contextlib
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path


def nothing() -> str:
    """Any host will do."""
    return ""


def no_other_clock() -> str:
    """Why no process can have a clock of its own here; empty where one can."""
    return _lacking("takes a time namespace", "unshare", "--time", "--monotonic", "1", "true")


def no_mounts() -> str:
    """Why nothing can be mounted here; empty where it can."""
    mount = ("mount", "-t", "tmpfs", "-o", "ro,size=1m", "tmpfs", tempfile.gettempdir())
    return _lacking("takes a mount of its own", "unshare", "--mount", *mount)


@contextlib.contextmanager
def read_only_view(folder: Path) -> Iterator[None]:
    """A folder that cannot be written meanwhile, by root neither, whatever is open in it."""
    subprocess.run(["mount", "--bind", folder, folder], check=True)  # noqa: S603, S607  # ours
    try:
        subprocess.run(["mount", "-o", "remount,ro,bind", folder], check=True)  # noqa: S603, S607  # ours
        yield
    finally:
        subprocess.run(["umount", "--lazy", folder], check=False)  # noqa: S603, S607  # ours


def _lacking(what: str, *words: str) -> str:
    """Try a command that harms nobody: `what` and why it fails, empty where it does not."""
    try:
        done = subprocess.run(words, capture_output=True, text=True, check=False)  # noqa: S603  # ours
    except OSError as fault:
        return f"{what} ({words[0]}: {fault.strerror})"
    said = done.stderr.strip().splitlines() or [f"{words[0]} ended with {done.returncode}"]
    return f"{what} ({said[0]})" if done.returncode else ""
