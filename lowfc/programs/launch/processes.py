"""Child processes of the launcher: started together, stopped in the order in which data flows."""

import sys
from pathlib import Path

from lowfc.adapters.process.child import Child


def program(name: str, arguments: list[str], said: Path) -> Child:
    """One of our own programs as a child, not started yet."""
    # -P: a folder called lowfc where the user stands is not ours
    return Child(name, [sys.executable, "-P", *arguments], said)


def start_all(children: list[Child]) -> None:
    """Start them; if one cannot be started, stop those that were."""
    try:
        for child in children:
            child.start()
    except OSError:
        stop_all(children)
        raise


def stop_all(children: list[Child], patience_s: float = 5.0) -> None:
    """Stop them one after the other, in the order of the list."""
    for child in children:
        child.stop(patience_s)
