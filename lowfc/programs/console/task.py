"""A command started by the console, in a separate process that outlives the console."""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

_TAIL_BYTES = 4000  # end of the output, of which the last line or the error is shown


class Task:
    """A command in its own process, with the name of its button; its output goes to the file `output`."""

    def __init__(self, name: str, arguments: Sequence[str]) -> None:
        """Start `lowfc` with these arguments, in its own session: neither Ctrl-C nor a lost terminal reaches it."""
        self.name = name
        self._began_s = time.monotonic()
        descriptor, path = tempfile.mkstemp(prefix=f"lowfc-{arguments[0]}-", suffix=".txt")
        self.output = Path(path)
        # ZENOH_RUNTIME is set for monitors; it would delay the messages of a command that computes.
        environment = {key: value for key, value in os.environ.items() if key != "ZENOH_RUNTIME"}
        with os.fdopen(descriptor, "wb") as stream:
            self._process = subprocess.Popen(  # noqa: S603  # our own program
                [sys.executable, "-P", "-m", "lowfc", *arguments],  # -P: import nothing from the working directory
                stdin=subprocess.DEVNULL,
                stdout=stream,
                stderr=stream,
                env=environment,
                start_new_session=True,
            )

    @property
    def status(self) -> int | None:
        """Exit status; None while it runs."""
        return self._process.poll()

    @property
    def status_line(self) -> str:
        """State of the command in one line, with the last line of its output."""
        lines = [line.strip() for line in self._tail().splitlines() if line.strip()]
        last = lines[-1] if lines else ""
        if self.status is None:
            return f"{self.name}: running for {time.monotonic() - self._began_s:.0f} s{f'; {last}' if last else ''}"
        if self.status == 0:
            return f"{self.name}: done; {last}"
        error_line = next((line for line in reversed(lines) if line.startswith("error:")), last)
        return f"{self.name} failed: {error_line.removeprefix('error: ')} (full output: {self.output})"

    def _tail(self) -> str:
        try:
            return self.output.read_bytes()[-_TAIL_BYTES:].decode(errors="replace")
        except OSError:  # the file was removed, for example by a cleaner of temporary files
            return ""
