"""Child processes of the launcher: started together, stopped in the order in which data flows."""

import sys
from pathlib import Path

from lowfc.adapters.process.child import Child
from lowfc.contract.messages import Role


def program(name: str, arguments: list[str], stderr_path: Path) -> Child:
    """A Python program of the project as a child process, not yet started."""
    # -P: do not import from a folder named lowfc in the working directory
    return Child(name, [sys.executable, "-P", *arguments], stderr_path)


def stop_all(children: list[Child]) -> None:
    """Stop the children one after the other, in the order of the list; a recorder has time to write to a slow disk."""
    for child in children:
        child.stop(60.0 if child.name == Role.RECORDER else 5.0)
