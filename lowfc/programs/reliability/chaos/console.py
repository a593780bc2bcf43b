"""Chaos case: a console that is flooded with events, suspended (SIGSTOP) and killed."""

import contextlib
import os
import pty
import re
import signal
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import psutil

from lowfc.adapters.process.clock import HostClock
from lowfc.contract.events import EVENTS
from lowfc.contract.messages import EVENT
from lowfc.programs.reliability.chaos.bench import CaseFailedError, ChaosBench
from lowfc.programs.reliability.chaos.case import LOST, case
from lowfc.programs.reliability.chaos.processes import CommandTimes

PHASE_S = 5.0
"""Duration of each phase."""
START_S = 60.0  # longest wait for the console to show the loop
FLOOD_HZ = 2000
_STEP_S = 0.02  # between two looks at the screen, and between two bursts of events
_SIZE = 30, 100  # rows and columns of the terminal
_LOOP_MODE = rb"\b(OPEN|CLOSED)\b"
"""Text on the screen once the console shows the loop."""


@case(
    "console",
    "a console of a loop at 1 kHz receives 2,000 events a second, is suspended (SIGSTOP), and is killed",
    config={"camera.rate_hz": 1000.0},
    allowed=LOST,
)
def _console(bench: ChaosBench) -> None:
    times = CommandTimes(bench)
    times.measure("without", PHASE_S)
    with TerminalConsole(bench.run.run_id) as console:
        cpu_before_s, began_s = console.cpu_s(), time.monotonic()
        times.measure("open", PHASE_S)
        share = (console.cpu_s() - cpu_before_s) / (time.monotonic() - began_s)
        bench.outcome.measurements["console"] = {"start_s": round(console.start_s, 2), "share": round(share, 3)}
        with _flood(bench):
            times.measure("flooded", PHASE_S)
            console.process.send_signal(signal.SIGSTOP)
            times.measure("flooded and frozen", PHASE_S)
        times.measure("frozen", PHASE_S)
        console.process.kill()
        times.measure("killed", PHASE_S)
    with _flood(bench):
        times.measure("flood without", PHASE_S)


class TerminalConsole(contextlib.AbstractContextManager["TerminalConsole"]):
    """`lowfc console` as a process with its own terminal; `start_s`: time from its start until it showed the loop."""

    def __init__(self, run: str, folder: Path | None = None) -> None:
        """Start the console in a folder, and wait until it shows the loop; CaseFailedError after `START_S`."""
        self._terminal, console_end = pty.openpty()
        termios.tcsetwinsize(self._terminal, _SIZE)
        self._screen = b""
        began_s = time.monotonic()
        self.process = subprocess.Popen(  # noqa: S603  # our own program
            [sys.executable, "-P", "-m", "lowfc", "console", "--run", run],
            cwd=folder,
            stdin=console_end,
            stdout=console_end,
            stderr=console_end,
            env={**os.environ, "TERM": "xterm-256color"},
            start_new_session=True,
        )
        os.close(console_end)
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        while not self.drew(_LOOP_MODE):
            time.sleep(_STEP_S)
            if time.monotonic() > began_s + START_S:
                self.close()
                drawn = self._screen[-200:]
                raise CaseFailedError(f"the console did not show the loop within {START_S:g} s, but {drawn!r}")
        self.start_s = time.monotonic() - began_s

    def cpu_s(self) -> float:
        """Processor time that the console has used so far, s."""
        times = psutil.Process(self.process.pid).cpu_times()
        return float(times.user + times.system)

    def drew(self, pattern: bytes) -> bool:
        """Whether the console's recent output matches the pattern."""
        return re.search(pattern, self._screen) is not None

    def press(self, keys: bytes) -> None:
        """Type on the console's terminal."""
        os.write(self._terminal, keys)

    def close(self) -> None:
        """Kill the console if it still runs."""
        self.process.kill()
        self.process.wait()
        self._reader.join()
        os.close(self._terminal)

    def __exit__(self, *_: object) -> None:
        self.close()

    def _read(self) -> None:
        with contextlib.suppress(OSError):  # the console has ended
            while drawn := os.read(self._terminal, 1 << 16):
                self._screen = (self._screen + drawn)[-(1 << 16) :]


@contextlib.contextmanager
def _flood(bench: ChaosBench) -> Iterator[None]:
    """Publish `FLOOD_HZ` events a second within the context."""
    assert bench.bus is not None  # noqa: S101  # the bench has begun
    publisher, clock, ended = bench.bus.publisher(EVENT), HostClock(), threading.Event()

    def send() -> None:
        while not ended.wait(_STEP_S):
            for _ in range(round(FLOOD_HZ * _STEP_S)):
                publisher.put(EVENTS["NOTE"].log("chaos", clock.now_ns(), text="flood").SerializeToString())

    thread = threading.Thread(target=send)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
