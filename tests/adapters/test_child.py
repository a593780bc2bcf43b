"""Children that die with their parent, however it dies."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from lowfc.adapters.process.child import Child
from tests.support.loops import until

pytestmark = pytest.mark.exclusive

PATIENCE_S = 30.0

# Starts a child that ignores SIGTERM, and says its number.
PARENT = """
import signal, sys, time
from pathlib import Path
from lowfc.adapters.process.child import Child
program = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print(1, flush=True); time.sleep(600)"
child = Child("one", [sys.executable, "-c", program], Path(sys.argv[1]), death_signal=signal.SIGKILL)
child.start()
print(child.process.pid, flush=True)
time.sleep(600)
"""


def command_line(pid: int) -> bytes:
    """Of a process; empty once it is gone, or nobody has waited for it."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return b""


def test_a_child_dies_with_a_parent_that_was_killed(tmp_path: Path) -> None:
    parent = subprocess.Popen([sys.executable, "-c", PARENT, tmp_path / "said"], stdout=subprocess.PIPE, text=True)
    pid = int(parent.stdout.readline())
    until(lambda: b"SIG_IGN" in command_line(pid) and b"prctl" not in command_line(pid))
    parent.kill()
    parent.communicate()
    until(lambda: not command_line(pid))


def test_a_child_is_the_program_itself_in_a_session_of_its_own(tmp_path: Path) -> None:
    program = "import os, sys, time; sys.stderr.write(repr((os.getpid(), os.getsid(0), os.environ['WORD'])))"
    child = Child("one", [sys.executable, "-c", program], tmp_path / "said", {**os.environ, "WORD": "heard"})
    child.start()
    child.process.wait(PATIENCE_S)
    assert (child.status, child.stderr_tail()) == (0, repr((child.process.pid, child.process.pid, "heard")))
    child.stop(PATIENCE_S)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_how_a_child_ended_is_its_own_end(tmp_path: Path, number: signal.Signals) -> None:
    child = Child("one", ["sleep", "600"], tmp_path / "said")
    child.start()
    child.process.send_signal(number)
    child.process.wait(PATIENCE_S)
    assert child.how_it_ended() == f"one was killed by {number.name}"
    child.stop(PATIENCE_S)


def test_a_program_that_is_not_there_is_said_at_once(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no-such-program"):
        Child("one", ["no-such-program"], tmp_path / "said").start()
