"""`lowfc console` in a terminal, beside a real loop: what it asks is in the log, and its death ends nothing."""

import os
import pty
import signal
import subprocess
import time
from pathlib import Path

import pytest

from lowfc.adapters.files import calibration_file
from lowfc.adapters.logs.reader import LogReader
from lowfc.client import Client
from lowfc.contract.messages import REQUEST, wire
from tests.support.loops import LOWFC, interrupt, start, until

RUN = "console"


class Terminal:
    """A console in a terminal of 100 x 30.

    Attributes:
        shown: everything that it wrote.
    """

    def __init__(self, folder: Path) -> None:
        self._end, child = pty.openpty()
        os.set_blocking(self._end, False)
        subprocess.run(["stty", "cols", "100", "rows", "30"], stdin=child, check=True)
        environment = os.environ | {"TERM": "xterm-256color"}
        words = [*LOWFC, "console", "--run", RUN]
        self.process = subprocess.Popen(
            words, cwd=folder, stdin=child, stdout=child, stderr=child, env=environment, start_new_session=True
        )
        os.close(child)
        self.shown = ""

    def type(self, text: str) -> None:
        os.write(self._end, text.encode())

    def shows(self, text: str) -> bool:
        while True:
            try:
                self.shown += os.read(self._end, 65536).decode(errors="replace")
            except (BlockingIOError, OSError):
                return text in self.shown


def requests(log: Path, name: str) -> list[wire.Request]:
    found = [wire.Request.FromString(one.payload) for one in LogReader(log, topics=(REQUEST,))]
    return [one for one in found if one.name == name]


@pytest.mark.exclusive
@pytest.mark.slow
def test_a_calibration_outlives_the_console_that_started_it(tmp_path: Path, own_runtime: Path) -> None:
    loop = start(tmp_path, "sim-loop", "--rate", "200", "--run", RUN)
    try:
        until(lambda: list((tmp_path / "logs").glob("*.part")), 120)
        time.sleep(2)
        terminal = Terminal(tmp_path)
        until(lambda: terminal.shows("CLOSED"))
        terminal.type("n")
        until(lambda: terminal.shows("Leave a note"))
        terminal.type("kept\r")
        terminal.type("o")
        with Client(RUN) as client:
            until(lambda: client.status().state.mode == wire.LOOP_MODE_OPEN)
            terminal.type("b")
            until(lambda: terminal.shows("signal-to-noise"))
            terminal.type("\r")
            until(lambda: client.status().state.lease.holder.startswith("lowfc calibrate"))
            os.killpg(terminal.process.pid, signal.SIGKILL)
            terminal.process.wait()
            before = client.calibration().id
            until(lambda: client.calibration().id != before, 120)
            (file,) = tmp_path.glob("calibration-*.fits")
            assert calibration_file.load(file).id == client.calibration().id
            until(lambda: client.status().state.lease.ended)
    finally:
        _, complaints = interrupt(loop)
    assert loop.returncode == 0, complaints
    (log,) = (tmp_path / "logs").glob("*.mcap")
    (note,) = requests(log, "note")
    assert (note.text, note.accepted) == ("kept", True)
    assert note.requester.startswith("lowfc console by ")
    assert note.requester.endswith(f"(process {terminal.process.pid})")
