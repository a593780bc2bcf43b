"""A user's mistakes: one clear message, exit status 2, no file or run left behind. Most run in this process."""

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import pytest

from lowfc.adapters.bus.run import Links, Run, open_run
from lowfc.adapters.bus.zenoh_bus import ZenohBus
from lowfc.adapters.logs.writer import LogWriter
from lowfc.adapters.process.clock import HostClock
from lowfc.contract.configuration import Configuration, load
from lowfc.contract.errors import BusError, DataFileError, LowfcError
from lowfc.contract.messages import Role
from lowfc.programs.launch import sim_loop
from tests.support.loops import LOWFC, json_of, lowfc, run, until

SHORT = ["sim-loop", "--duration", "0.1"]


def layout(holes: list[list[float]]) -> str:
    return json.dumps({"layouts": {"mine": {"hole_diameter": 0.1, "holes": holes}}})


@pytest.mark.parametrize(
    ("config", "expected"),
    [
        ("[control]\ntilt_gian = 0.3", "unknown key 'control.tilt_gian'; the nearest known one is 'control.tilt_gain'"),
        ("[safety]\nstroke_nm = 900.0", "safety.stroke_nm is 900 nm either way"),
        ("[camera\nrate_hz = 1", "not a readable TOML file"),
        ("[sensor]\nsam = 'sam27d07_bal15'", "sam27d07_bal14"),
        ("[sensor]\nsam = 'nowhere.json'", "nowhere.json"),
        (f"[recorder]\nfolder = '{'x' * 300}'", "x cannot be accessed: File name too long"),
    ],
)
def test_an_invalid_configuration_is_refused(tmp_path: Path, config: str, expected: str) -> None:
    _refusal(tmp_path, *SHORT, config=config, expected=expected)


@pytest.mark.parametrize(
    ("config", "expected"),
    [
        ("[sensor]\nkind = 'open'", "cannot tell the modes apart"),
        ("[camera]\nfull_well_e = 100", "the star saturates the sensor"),
        ("[recorder]\ntopics = ['x']", "no topic matches 'x'"),
    ],
)
def test_check_refuses_what_a_run_would_refuse(tmp_path: Path, config: str, expected: str) -> None:
    (tmp_path / "lowfc.toml").write_text(config)
    _refusal(tmp_path, "config", "check", "lowfc.toml", expected=expected)


def test_an_invalid_layout_is_refused(tmp_path: Path) -> None:
    (tmp_path / "mask.json").write_text(layout([[0.0, 0.2], [0.05, 0.2]]))
    _refusal(tmp_path, *SHORT, "--sensor", "mask.json:mine", expected="overlap")


def test_an_even_symmetric_layout_is_warned_about(tmp_path: Path) -> None:
    (tmp_path / "mask.json").write_text(layout([[0.3, 0.1], [-0.3, -0.1], [0.1, -0.3], [-0.1, 0.3]]))
    done = run(tmp_path, *SHORT, "--sensor", "mask.json:mine")
    assert (done.returncode, done.stdout) == (2, "")
    assert "even" in done.stderr.partition("warning: ")[2]
    assert "cannot tell the modes apart" in done.stderr.partition("error: ")[2]
    assert "Traceback" not in done.stderr


def test_an_invalid_calibration_is_refused(tmp_path: Path) -> None:
    arguments = ["controller", "--run", "mistakes", "--calibration"]
    _refusal(tmp_path, *arguments, "none.fits", expected="there is no such calibration file")
    (tmp_path / "text.fits").write_bytes(b"hello")
    _refusal(tmp_path, *arguments, "text.fits", expected="text.fits")


def test_a_port_in_use_is_named(tmp_path: Path) -> None:
    held = open_run("mistakes-port")
    try:
        with socket.socket() as busy:
            busy.bind(("127.0.0.1", held.links.ports["recorder"]))
            busy.listen()
            port = str(held.links.ports["recorder"])
            stderr = _refusal(tmp_path, "record", "--run", "mistakes-port", expected=port)
        assert "Address already in use" in stderr
        assert ".rs" not in stderr
        assert "cargo" not in stderr
    finally:
        held.remove()


def test_unknown_runs_arguments_and_files_are_named(tmp_path: Path, own_runtime: Path) -> None:
    _refusal(tmp_path, "ctl", "status", expected="lowfc was searched")
    _refusal(tmp_path, "ctl", "status", "--run", "none-such", expected="there is no run 'none-such': no loop of user")
    _refusal(tmp_path, "ctl", "--run", "none-such", "record", "stop", expected="there is no run 'none-such'")
    _refusal(tmp_path, "ctl", "gain", "often", expected="'often' is not a number")
    _refusal(tmp_path, "config", "check", "none.toml", expected="none.toml")
    _refusal(tmp_path, "sim-lop", expected="sim-lop")
    _refusal(tmp_path, *SHORT, "--sensor", "", expected="unknown sensor ''")


def _refusal(folder: Path, *arguments: str, expected: str, config: str = "") -> str:
    if config:
        (folder / "test.toml").write_text(config)
        arguments = (*arguments, "--config", "test.toml")
    if arguments[0] in {"record", "view"}:  # these commands lower the priority of their process for good
        done = run(folder, *arguments)
        assert (done.returncode, done.stdout) == (2, ""), done.stderr
        complaint = done.stderr.removeprefix("error: ").rstrip("\n")
    else:
        with contextlib.chdir(folder):
            result = lowfc(*arguments)
        assert not result.stdout
        assert isinstance(result.exception, LowfcError | SystemExit), result.exception
        assert getattr(result.exception, "exit_status", 2) == 2
        complaint = str(result.exception) if isinstance(result.exception, LowfcError) else result.stderr
    assert expected in complaint
    assert not (folder / "logs").exists()
    return complaint


@pytest.mark.parametrize(
    ("arguments", "output", "status", "error"),
    [
        ("--version", ">/dev/full", 2, "error: standard output cannot be written: No space left on device\n"),
        ("--version", ">&-", 2, "error: standard output cannot be written: Bad file descriptor\n"),
        ("console", "<&-", 2, "error: the console requires a terminal; `lowfc ctl` operates a loop without one\n"),
        ("runs --help", "2>&-", 0, ""),
    ],
)
def test_a_full_disk_or_a_closed_stream_causes_at_most_one_line_of_error(
    arguments: str, output: str, status: int, error: str
) -> None:
    script = ["sh", "-c", f'exec "$@" {arguments} {output}', "sh", *LOWFC]
    buffered = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    done = subprocess.run(script, env=buffered, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (status, error)


@pytest.mark.parametrize("fault", ["EDQUOT", "EFBIG"])
def test_a_used_up_quota_or_file_size_limit_has_a_one_line_error(fault: str) -> None:
    imports = "import errno; from unittest.mock import Mock; from lowfc.adapters.process.terminal import run_app"
    code = f"{imports}; run_app(Mock(side_effect=OSError(errno.{fault}, 'no room')))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (2, "error: standard output cannot be written: no room\n")


@pytest.mark.parametrize("arguments", ["main config show", "sim_camera --help", "sim_dm --help"])
def test_ctrl_c_during_startup_prints_no_traceback(tmp_path: Path, arguments: str) -> None:
    entry, *options = arguments.split()
    start = [sys.executable, "-c", f"from lowfc.__main__ import {entry}; {entry}()", *options]
    process = subprocess.Popen(start, cwd=tmp_path, stderr=subprocess.PIPE, text=True)
    until(lambda: "pydantic_core" in Path(f"/proc/{process.pid}/maps").read_text(), 20)  # in the middle of the imports
    process.send_signal(signal.SIGINT)
    _, stderr = process.communicate(timeout=20)
    assert "Traceback" not in stderr


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("info", "empty.mcap"), "empty.mcap is empty: nothing was recorded"),
        (("recover", "header.mcap"), "no part of it is intact, so there is nothing to recover"),
        (("export", "header.mcap", "--decimate", "2"), "header.mcap has no messages: there is nothing to copy"),
        (("replay", "night.mcap.part"), "it is finished now: night.mcap"),
        (("replay", "night.mcap", "night.mcap"), "are the same part of one log"),
        (("replay", "pipe"), "pipe cannot be read: not a regular file"),
        *(((name, ""), ". cannot be read: not a regular file") for name in ("info", "recover", "report")),
        (("replay", "circle"), "circle cannot be read: Too many levels of symbolic links"),
        (("config", "check", "/dev/zero"), "/dev/zero: not a readable TOML file: not a regular file"),
        (("config", "check", "brackets.toml"), "nested too deeply"),
        (("recover", "night.mcap", "header.mcap", "--json"), "name one"),
        (("view", "nowhere.mcap", "--web"), "nowhere.mcap cannot be read"),
        (("bench", "record", "--folder", "nowhere"), "nowhere cannot be written"),
    ],
)
def test_unusable_files_are_refused_in_one_line(tmp_path: Path, arguments: tuple[str, ...], expected: str) -> None:
    (tmp_path / "empty.mcap").touch()
    (tmp_path / "header.mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(12))
    LogWriter(tmp_path / "night.mcap", 1, {}).finish({})
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "circle").symlink_to("circle")
    (tmp_path / "brackets.toml").write_text("a = " + "[" * 100_000)
    before = sorted(path.name for path in tmp_path.iterdir())
    assert len(_refusal(tmp_path, *arguments, expected=expected).splitlines()) == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == before


def test_a_starting_loop_is_listed_and_makes_a_request_without_a_run_ambiguous(
    own_runtime: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A request without a run must not be sent to `other` just because `night` has no controller yet."""
    found: list[object] = []

    def run_other_commands(config: Configuration, run: Run, console: object) -> None:
        with contextlib.closing(ZenohBus(open_run("other").links, Role.CONTROLLER, HostClock())):
            done = lowfc("ctl", "open")
            listed = json_of("runs")["runs"]
            found.extend([str(done.exception), [(one["run"], one["mode"]) for one in listed]])
        done = lowfc("sim-loop", "--run", "night")
        assert "run 'night' is already running" in str(done.exception)
        assert "recording into" not in done.stderr
        raise BusError("enough")

    monkeypatch.setattr(sim_loop, "prepare", run_other_commands)
    with pytest.raises(BusError, match="enough"):
        sim_loop.sim_loop(load(None), 1.0, record=False, name="night")
    refusal, listed = found
    assert refusal == (
        "more than one run is live: night (no controller yet), other; choose one with --run (a unique prefix is enough)"
    )
    assert listed == [("night", "starting"), ("other", "starting")]
    assert not (own_runtime / "lowfc" / "night").exists()
    with pytest.raises(BusError, match="created by processes started by hand"):
        sim_loop.sim_loop(load(None), 1.0, record=False, name="other")


def test_a_folder_without_permission_is_refused_before_anything_starts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sim_loop, "_new_run", Mock(side_effect=AssertionError("started")))
    monkeypatch.setattr(os, "access", lambda path, mode: mode != os.W_OK)  # root may write everywhere
    with pytest.raises(DataFileError, match="not writable; name another"):
        sim_loop.sim_loop(load(None, {"recorder.folder": str(tmp_path / "logs")}), 1.0, record=True)


def test_an_interruption_or_a_fault_before_the_first_process_leaves_no_run_but_that_of_another_launcher(
    own_runtime: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (open_run("night", listeners=(Role.LAUNCHER,)).path / "config.toml").mkdir()
    with pytest.raises(DataFileError, match=r"config.toml cannot be written"):
        sim_loop.sim_loop(load(None), 1.0, record=False, name="night")
    for fault, live in ((KeyboardInterrupt(), set()), (BusError("another was faster"), {"launcher"})):
        monkeypatch.setattr(sim_loop, "ZenohBus", Mock(side_effect=fault))
        monkeypatch.setattr(Links, "live", Mock(side_effect=[set(), live]))
        with pytest.raises(type(fault)):
            sim_loop.sim_loop(load(None), 1.0, record=False, name="night")
        assert (own_runtime / "lowfc" / "night").exists() is bool(live)
