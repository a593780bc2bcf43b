import subprocess
import sys
import time
from pathlib import Path

import pytest

from lowfc.adapters.bus.run import write_once
from lowfc.adapters.process.clock import SIMULATED_START_NS, HostClock, SimulatedClock, boot_offset_ns
from lowfc.contract.errors import DataFileError
from lowfc.testing.clock import FakeClock

pytestmark = pytest.mark.exclusive


def test_all_processes_of_a_boot_have_one_offset(tmp_path: Path) -> None:
    ask = (
        "from lowfc.adapters.process.clock import *; import pathlib; "
        f"print(boot_offset_ns(pathlib.Path({str(tmp_path)!r})))"
    )
    asked = [subprocess.Popen([sys.executable, "-c", ask], stdout=subprocess.PIPE, text=True) for _ in range(4)]
    answers = {process.communicate()[0] for process in asked}
    assert answers == {f"{boot_offset_ns(tmp_path)}\n"}
    (file,) = tmp_path.iterdir()
    assert file.stat().st_mode & 0o777 == 0o600


def test_the_clock_is_the_hosts_and_does_not_step_with_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = HostClock(tmp_path)
    before = clock.now_ns()
    monkeypatch.setattr(time, "time_ns", lambda: 0)  # somebody sets the wall clock back to 1970
    assert HostClock(tmp_path).now_ns() >= before
    assert clock.host_ns() >= before
    assert clock.start_s == before // 1_000_000_000 or clock.start_s + 1 == before // 1_000_000_000
    assert clock.now_ns() - time.monotonic_ns() <= clock.offset_ns


def test_it_knows_how_far_it_is_from_the_wall_clock(tmp_path: Path) -> None:
    clock = HostClock(tmp_path)
    assert abs(clock.ahead_ns()) < 1_000_000_000
    (file,) = tmp_path.iterdir()
    file.write_text(str(clock.offset_ns - 3600 * 10**9))  # as fixed before NTP was there
    late = HostClock(tmp_path)
    assert abs(late.ahead_ns() + 3600 * 10**9) < 1_000_000_000
    assert abs(SimulatedClock(base=tmp_path).ahead_ns() + 3600 * 10**9) < 1_000_000_000


def test_sleep_ends_after_its_deadline_and_not_before(tmp_path: Path) -> None:
    clock = HostClock(tmp_path)
    deadline = clock.now_ns() + 3_000_000
    clock.sleep_until_ns(deadline)
    assert clock.now_ns() >= deadline
    clock.sleep_until_ns(deadline)  # passed: no wait, no error


def test_a_damaged_offset_is_an_error(tmp_path: Path) -> None:
    boot_offset_ns(tmp_path)
    (file,) = tmp_path.iterdir()
    file.write_text("noon")
    with pytest.raises(DataFileError, match="offset in ns, got 'noon'"):
        boot_offset_ns(tmp_path)


def test_what_is_written_once_stays(tmp_path: Path) -> None:
    assert [write_once(tmp_path / "file", text) for text in ("first", "second")] == ["first", "first"]
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_simulated_time_moves_by_hand_and_host_time_by_itself(tmp_path: Path) -> None:
    host = HostClock(tmp_path)
    clock = SimulatedClock(base=tmp_path)
    assert (clock.now_ns(), clock.start_s, clock.lockstep) == (SIMULATED_START_NS, SIMULATED_START_NS // 10**9, True)
    clock.set_ns(SIMULATED_START_NS + 7)
    clock.sleep_until_ns(SIMULATED_START_NS + 9)
    clock.sleep_until_ns(SIMULATED_START_NS + 8)
    assert clock.now_ns() == SIMULATED_START_NS + 9
    assert host.now_ns() <= clock.host_ns() <= host.now_ns()


def test_the_fake_clock_stands_still() -> None:
    clock = FakeClock(5)
    clock.advance(2)
    clock.sleep_until_ns(6)
    assert (clock.now_ns(), clock.host_ns()) == (7, 7)
    clock.sleep_until_ns(10)
    assert clock.now_ns() == 10
