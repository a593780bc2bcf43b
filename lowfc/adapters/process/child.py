"""A child process that ends with its parent; its standard error is kept in a file."""

import contextlib
import errno
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from multiprocessing import resource_tracker
from pathlib import Path

_TAIL_LINES = 6
_WRAPPER = """
import ctypes, os, sys
number, parent = map(int, sys.argv[1:3])
ctypes.CDLL(None).prctl(1, number)  # PR_SET_PDEATHSIG, which exec keeps
if os.getppid() == parent:  # the parent is still alive
    os.execvp(sys.argv[3], sys.argv[3:])
"""
"""Program that requests the death signal, then executes the child's command (`preexec_fn` is unsafe with threads)."""


@dataclass(slots=True)
class Child:
    """A child process whose standard error and output go to files; `name` is its name in Health or in messages.

    `environment` defaults to this process's. The child gets `death_signal` when its parent dies; only SIGKILL ends a
    process suspended by SIGSTOP.
    """

    name: str
    command: list[str]
    stderr_path: Path
    environment: Mapping[str, str] | None = None
    death_signal: signal.Signals = signal.SIGTERM
    stdout_path: Path = Path(os.devnull)
    process: "subprocess.Popen[bytes] | None" = None

    def start(self) -> None:
        """Start the process in its own session, so that Ctrl-C reaches only the parent.

        It ends with the thread that calls this method: for the kernel that thread is the parent.

        Raises:
            OSError: the program does not exist, or a file cannot be written.
        """
        if shutil.which(self.command[0], path=(self.environment or os.environ).get("PATH")) is None:
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), self.command[0])
        wrapper = [sys.executable, "-I", "-S", "-c", _WRAPPER, str(self.death_signal.value), str(os.getpid())]
        with self.stderr_path.open("wb") as errors, self.stdout_path.open("wb") as output:
            self.process = subprocess.Popen(  # noqa: S603  # our own programs, and the viewer's
                [*wrapper, *self.command],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=errors,
                env=self.environment,
                start_new_session=True,
            )

    @property
    def status(self) -> int | None:
        """Exit status; None while it runs, negative if a signal ended it."""
        return self.process.poll() if self.process is not None else None

    def stop(self, timeout_s: float) -> None:
        """Send SIGTERM, wait, then SIGKILL if it is still running."""
        if self.process is None:
            return
        if self.status is None:
            self.process.send_signal(signal.SIGTERM)
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.process.wait(timeout_s)
        if self.status is None:
            self.process.kill()
            self.process.wait()

    def stderr_tail(self) -> str:
        """Last lines of the child's standard error."""
        lines = self.stderr_path.read_text(errors="replace").strip().splitlines() if self.stderr_path.exists() else []
        return "\n".join(lines[-_TAIL_LINES:])

    def exit_description(self) -> str:
        """One line on how the process ended."""
        status = self.status
        if status is not None and status < 0:
            names = {member.value: member.name for member in signal.Signals}  # without most real-time signals
            return f"{self.name} was killed by {names.get(-status, f'signal {-status}')}"
        return f"{self.name} ended with exit status {status}"


@contextlib.contextmanager
def interrupt_blocked() -> Iterator[None]:
    """Block Ctrl-C until the end of the context; processes started in it never receive it."""
    resource_tracker.ensure_running()  # started within the context, it would unblock Ctrl-C
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
