"""Child processes of the launcher: started together, watched, stopped in the order in which data flows."""

import contextlib
import ctypes
import signal
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

_PR_SET_PDEATHSIG = 1
_LAST_WORDS = 6


@dataclass(slots=True)
class Child:
    """One process, what it says going to a file.

    Attributes:
        name: as in its Health.
        arguments: of the Python interpreter.
        said: file with its standard error.
    """

    name: str
    arguments: list[str]
    said: Path
    process: "subprocess.Popen[bytes] | None" = None
    _stream: "IO[bytes] | None" = field(default=None, repr=False)

    def start(self) -> None:
        """Start it in a session of its own, so that Ctrl-C reaches only the launcher; it dies with the launcher."""
        self._stream = self.said.open("wb")
        self.process = subprocess.Popen(  # noqa: S603  # our own programs
            [sys.executable, "-P", *self.arguments],  # -P: a folder called lowfc where the user stands is not ours
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=self._stream,
            start_new_session=True,
            preexec_fn=_die_with_parent,
        )

    @property
    def status(self) -> int | None:
        """Exit status; None while it runs, negative where a signal ended it."""
        return self.process.poll() if self.process is not None else None

    def stop(self, patience_s: float) -> None:
        """Ask it to end, wait, and kill it where it does not."""
        if self.process is None:
            return
        if self.status is None:
            self.process.send_signal(signal.SIGTERM)
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.process.wait(patience_s)
        if self.status is None:
            self.process.kill()
            self.process.wait()
        if self._stream is not None:
            self._stream.close()

    def last_words(self) -> str:
        """The end of what it said on standard error."""
        lines = self.said.read_text(errors="replace").strip().splitlines() if self.said.exists() else []
        return "\n".join(lines[-_LAST_WORDS:])

    def how_it_ended(self) -> str:
        """One line about a process that ended by itself."""
        status = self.status
        if status is not None and status < 0:
            return f"{self.name} was killed by {signal.Signals(-status).name}"
        return f"{self.name} ended with exit status {status}"


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


_libc = ctypes.CDLL(None)


def _die_with_parent() -> None:
    _libc.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
