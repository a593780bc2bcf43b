"""A child process that dies with its parent, and what it said last."""

import contextlib
import ctypes
import functools
import os
import signal
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

_PR_SET_PDEATHSIG = 1
_LAST_WORDS = 6


@dataclass(slots=True)
class Child:
    """One process, what it says going to a file.

    Attributes:
        name: as in its Health, or in what is told about it.
        command: the program and its arguments.
        said: file with its standard error.
        environment: of the process; None for ours.
        when_we_die: the signal it gets then; only SIGKILL ends one that is stopped.
    """

    name: str
    command: list[str]
    said: Path
    environment: Mapping[str, str] | None = None
    when_we_die: signal.Signals = signal.SIGTERM
    process: "subprocess.Popen[bytes] | None" = None
    _stream: "IO[bytes] | None" = field(default=None, repr=False)

    def start(self) -> None:
        """Start it in a session of its own, so that Ctrl-C reaches only us.

        It dies with us; the kernel takes the end of the thread that starts it for ours.
        """
        self._stream = self.said.open("wb")
        self.process = subprocess.Popen(  # noqa: S603  # our own programs, and the viewer's
            self.command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=self._stream,
            env=self.environment,
            start_new_session=True,
            preexec_fn=functools.partial(_signal_at_parents_death, self.when_we_die, os.getpid()),
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


_libc = ctypes.CDLL(None)


def _signal_at_parents_death(number: signal.Signals, parent: int) -> None:
    _libc.prctl(_PR_SET_PDEATHSIG, number)
    if os.getppid() != parent:  # it died between fork and here
        os._exit(1)
