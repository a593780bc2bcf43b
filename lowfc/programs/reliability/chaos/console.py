"""Chaos case: a console beside the loop that is flooded, stands still and dies."""

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

SPAN_S = 5.0
START_S = 60.0
FLOOD_HZ = 2000
_STEP_S = 0.02
_SIZE = 30, 100
_SHOWN = rb"\b(OPEN|CLOSED)\b"
"""What it says of the loop."""


@case(
    "console",
    "a console of a loop at 1 kHz receives 2,000 events a second, is stopped (SIGSTOP), and is killed",
    config={"camera.rate_hz": 1000.0},
    allowed=LOST,
)
def _console(bench: ChaosBench) -> None:
    times = CommandTimes(bench)
    times.note("without", SPAN_S)
    with TerminalConsole(bench.run.run_id) as console:
        before_s, began_s = console.used_s(), time.monotonic()
        times.note("open", SPAN_S)
        share = (console.used_s() - before_s) / (time.monotonic() - began_s)
        bench.left.figures["console"] = {"start_s": round(console.start_s, 2), "share": round(share, 3)}
        with _flood(bench):
            times.note("flooded", SPAN_S)
            console.process.send_signal(signal.SIGSTOP)
            times.note("flooded and frozen", SPAN_S)
        times.note("frozen", SPAN_S)
        console.process.kill()
        times.note("killed", SPAN_S)
    with _flood(bench):
        times.note("flood without", SPAN_S)


class TerminalConsole(contextlib.AbstractContextManager["TerminalConsole"]):
    """`lowfc console` as a process with a terminal of its own, once it shows the loop, `start_s` after its start."""

    def __init__(self, run: str, folder: Path | None = None) -> None:
        """Start it in a folder, and wait; CaseFailedError where it shows nothing."""
        self._terminal, its_own = pty.openpty()
        termios.tcsetwinsize(self._terminal, _SIZE)
        self._screen = b""
        began_s = time.monotonic()
        self.process = subprocess.Popen(  # noqa: S603  # our own program
            [sys.executable, "-m", "lowfc", "console", "--run", run],
            cwd=folder,
            stdin=its_own,
            stdout=its_own,
            stderr=its_own,
            env={**os.environ, "TERM": "xterm-256color"},
            start_new_session=True,
        )
        os.close(its_own)
        self._reader = threading.Thread(target=self._look, daemon=True)
        self._reader.start()
        while not self.drew(_SHOWN):
            time.sleep(_STEP_S)
            if time.monotonic() > began_s + START_S:
                self.close()
                drawn = self._screen[-200:]
                raise CaseFailedError(f"the console did not show the loop within {START_S:g} s, but {drawn!r}")
        self.start_s = time.monotonic() - began_s

    def used_s(self) -> float:
        """Processor time so far."""
        times = psutil.Process(self.process.pid).cpu_times()
        return float(times.user + times.system)

    def drew(self, pattern: bytes) -> bool:
        """Whether it drew this of late."""
        return re.search(pattern, self._screen) is not None

    def press(self, keys: bytes) -> None:
        """Type on its terminal."""
        os.write(self._terminal, keys)

    def close(self) -> None:
        """Kill it, if it is there still."""
        self.process.kill()
        self.process.wait()
        self._reader.join()
        os.close(self._terminal)

    def __exit__(self, *_: object) -> None:
        self.close()

    def _look(self) -> None:
        with contextlib.suppress(OSError):  # it has ended
            while drawn := os.read(self._terminal, 1 << 16):
                self._screen = (self._screen + drawn)[-(1 << 16) :]


@contextlib.contextmanager
def _flood(bench: ChaosBench) -> Iterator[None]:
    """Events meanwhile, `FLOOD_HZ` of them a second."""
    assert bench.bus is not None  # noqa: S101  # it has begun
    publisher, clock, over = bench.bus.publisher(EVENT), HostClock(), threading.Event()

    def send() -> None:
        while not over.wait(_STEP_S):
            for _ in range(round(FLOOD_HZ * _STEP_S)):
                publisher.put(EVENTS["NOTE"].log("chaos", clock.now_ns(), text="flood").SerializeToString())

    thread = threading.Thread(target=send)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
