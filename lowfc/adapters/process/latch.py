"""The latch of safe mode: it outlives the controller, in places that fail independently, and never delays the loop.

A file in any place means safe, and so does a place that cannot be read. A thread of its own writes the files, again and
again until that works, so that neither a full disk nor a server that hangs delays the loop or an answer.
"""

import contextlib
import os
import tempfile
import threading
from collections.abc import Callable, Sequence
from pathlib import Path

from lowfc.adapters.bus.run import Run
from lowfc.contract.messages import Role

NAME = "safe"
FORMER_NAME = "safed"
RETRY_S = 1.0


def latch_files(run: Run) -> tuple[Path, ...]:
    """Where the latch of a run is kept: in its directory, and outside of it by the run's name.

    The directory of a run is gone after a reboot or a logout, the other place is not. A run that a launcher started
    ends with it and needs the first alone.
    """
    files = (run.path / NAME,)
    if Role.LAUNCHER in run.links.ports:
        return files
    state = os.environ.get("STATE_DIRECTORY", "").partition(":")[0]  # given by systemd
    if not state:
        state = str(Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local/state") / "lowfc")
    with contextlib.suppress(OSError):  # the latch reports it when it needs the folder
        Path(state).mkdir(mode=0o700, parents=True, exist_ok=True)
    return (*files, Path(state) / f"{run.run_id}.{NAME}")


class Latch:
    """Whether the loop is in safe mode, kept in files."""

    def __init__(self, files: Sequence[Path], failed: Callable[[str], None] = lambda why: None) -> None:
        """Read the files; `failed` gets the reason, once, whenever a file cannot be read or written.

        Attributes:
            safe: one of the files is there, or cannot be looked for.
            kept: at least one of them can be written.
        """
        self._files = tuple(files)
        self._failed = failed
        self._named: set[Path] = set()
        self.safe = True in [self._there(file) for file in self._files]
        self.kept = True in [self._try(_probe, file) for file in self._files]
        self._wanted = self.safe
        self._done: bool | None = None if self.safe else False  # where one place is safe, the others shall be, too
        self._ended = False
        self._changed = threading.Condition()
        self._keeper = threading.Thread(target=self._keep, name="latch", daemon=True)
        self._keeper.start()

    def set(self, safe: bool) -> None:
        """Keep this from now on; returns at once and raises nothing."""
        with self._changed:
            self._wanted = safe
            self._changed.notify()

    def close(self) -> None:
        """Finish writing: one more attempt, for up to a second."""
        with self._changed:
            self._ended = True
            self._changed.notify()
        self._keeper.join(RETRY_S)

    def _there(self, file: Path) -> bool:
        for one in (file, file.with_name(FORMER_NAME)) if file.name == NAME else (file,):
            try:
                one.lstat()
            except (FileNotFoundError, NotADirectoryError):
                continue
            except OSError as fault:
                self._name(one, f"{one} cannot be read ({fault.strerror}), which counts as safe")
            return True
        return False

    def _keep(self) -> None:
        """On a thread of its own: write or remove the files until all are as wanted."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._ended or self._wanted is not self._done)
                ended, wanted = self._ended, self._wanted
            if wanted is not self._done:
                self._done = None  # some of the files may be written, and others not
                if False not in [self._try(_write if wanted else _remove, file) for file in self._files]:
                    self._done = wanted
                elif not ended:
                    with self._changed:
                        self._changed.wait_for(lambda: self._ended, RETRY_S)
                    continue
            if ended:
                return

    def _try(self, act: Callable[[Path], None], file: Path) -> bool:
        try:
            act(file)
        except OSError as fault:
            self._name(file, f"{file} cannot be written ({fault.strerror})")
            return False
        self._named.discard(file)
        return True

    def _name(self, file: Path, why: str) -> None:
        """Report once that a file is wrong, until it is right again; a handler that fails does not end this thread."""
        if file not in self._named:
            self._named.add(file)
            with contextlib.suppress(Exception):
                self._failed(why)


def _write(file: Path) -> None:
    descriptor = os.open(file, os.O_WRONLY | os.O_CREAT, 0o600)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _remove(file: Path) -> None:
    file.unlink(missing_ok=True)
    if file.name == NAME:
        file.with_name(FORMER_NAME).unlink(missing_ok=True)


def _probe(file: Path) -> None:
    with tempfile.TemporaryFile(dir=file.parent):
        pass
