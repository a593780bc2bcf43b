"""The latch of safe mode: files that outlive the controller, in up to two places that fail independently.

A file in any place means safe mode, and so does a place that cannot be read. A separate thread writes the files and
retries until it succeeds, so that neither a full disk nor a hanging file server delays the loop or an answer.
"""

import contextlib
import os
import tempfile
import threading
from collections.abc import Callable, Sequence
from pathlib import Path

from lowfc.adapters.bus.run import MODE, Run
from lowfc.contract.messages import Role

NAME = "safe"
FORMER_NAME = "safed"
RETRY_S = 1.0


def latch_files(run: Run) -> tuple[Path, ...]:
    """Files of a run's latch: one in its directory, one outside that is named after the run.

    The second survives a reboot or logout, which remove the run's directory. A run that a launcher started ends with
    the launcher, and needs only the first.
    """
    files = (run.path / NAME,)
    if Role.LAUNCHER in run.links.ports:
        return files
    state = os.environ.get("STATE_DIRECTORY", "").partition(":")[0]  # set by systemd
    if not state:
        state = str(Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local/state") / "lowfc")
    with contextlib.suppress(OSError):  # the latch reports the fault when it writes
        Path(state).mkdir(mode=0o700, parents=True, exist_ok=True)
    return (*files, Path(state) / f"{run.run_id}.{NAME}")


class Latch:
    """State of safe mode, stored in files.

    Attributes:
        safe: whether, at the start, a file existed or could not be checked.
        writable: whether, at the start, at least one file could be written.
    """

    def __init__(self, files: Sequence[Path], failed: Callable[[str], None] = lambda why: None) -> None:
        """Read the files; `failed` is called with a file's fault, and again only after the file has worked."""
        self._files = tuple(files)
        self._failed = failed
        self._reported: set[Path] = set()
        # Lists, so that every file is tried: `any` and `all` would stop at the first result.
        self.safe = True in [self._exists(file) for file in self._files]
        self.writable = True in [self._try(_check_writable, file) for file in self._files]
        self._target = self.safe
        self._stored: bool | None = None if self.safe else False  # None: the files may differ
        self._ended = False
        self._changed = threading.Condition()
        self._keeper = threading.Thread(target=self._keep, name="latch", daemon=True)
        self._keeper.start()

    def set(self, safe: bool) -> None:
        """Set the state; returns at once and raises nothing."""
        with self._changed:
            self._target = safe
            self._changed.notify()

    def close(self) -> None:
        """Finish writing: make one more attempt, if necessary, and wait for it for up to a second."""
        with self._changed:
            self._ended = True
            self._changed.notify()
        self._keeper.join(RETRY_S)

    def _exists(self, file: Path) -> bool:
        for path in (file, file.with_name(FORMER_NAME)) if file.name == NAME else (file,):
            try:
                path.lstat()
            except (FileNotFoundError, NotADirectoryError):
                continue
            except OSError as fault:
                self._report(path, f"{path} cannot be read ({fault.strerror}), which counts as safe")
            return True
        return False

    def _keep(self) -> None:
        """After each change of the state, write or remove the files until all agree with it; runs on its own thread."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._ended or self._target is not self._stored)
                ended, target = self._ended, self._target
            if target is not self._stored:
                self._stored = None
                if False not in [self._try(_write if target else _remove, file) for file in self._files]:
                    self._stored = target
                elif not ended:
                    with self._changed:
                        self._changed.wait_for(lambda: self._ended, RETRY_S)
                    continue
            if ended:
                return

    def _try(self, action: Callable[[Path], None], file: Path) -> bool:
        try:
            action(file)
        except OSError as fault:
            self._report(file, f"{file} cannot be written ({fault.strerror})")
            return False
        self._reported.discard(file)
        return True

    def _report(self, file: Path, why: str) -> None:
        """Report a file's fault, and again only after the file has worked; an exception of the handler is ignored."""
        if file not in self._reported:
            self._reported.add(file)
            with contextlib.suppress(Exception):
                self._failed(why)


def _write(file: Path) -> None:
    mode = MODE if file.name == NAME else 0o600  # a home directory's file server may refuse the sticky bit
    descriptor = os.open(file, os.O_WRONLY | os.O_CREAT, mode)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _remove(file: Path) -> None:
    file.unlink(missing_ok=True)
    if file.name == NAME:
        file.with_name(FORMER_NAME).unlink(missing_ok=True)


def _check_writable(file: Path) -> None:
    with tempfile.TemporaryFile(dir=file.parent):
        pass
