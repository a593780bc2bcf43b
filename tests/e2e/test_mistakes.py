"""A user's mistakes: one clear message, exit status 2, nothing half done."""

import json
import socket
from pathlib import Path

import pytest
from loops import run

from lowfc.adapters import calibration_file, instrument
from lowfc.adapters.run import open_run
from lowfc.contract.configuration import load

SHORT = ["sim-loop", "--duration", "0.1"]

LAYOUT = {"hole_diameter": 0.1, "holes": [[0.0, 0.2], [0.2, -0.1], [-0.2, -0.1]]}


def layout(**changes: object) -> str:
    return json.dumps({"layouts": {"mine": LAYOUT | changes}})


@pytest.mark.parametrize(
    ("config", "expected"),
    [
        ("[control]\ntilt_gian = 0.3", "unknown key 'control.tilt_gian'; the nearest known one is 'control.tilt_gain'"),
        ("[camera]\nrate = 100", "nearest known one is 'camera.rate_hz'"),
        ("[camera]\nrate_hz = -1", "camera.rate_hz = -1"),
        ("[safety]\nstroke_nm = 900.0", "safety.stroke_nm is 900 nm either way"),
        ("[disturbance]\npreset = 'noise'", "reaction-wheel"),
        ("[camera\nrate_hz = 1", "not a readable TOML file"),
        ("[sensor]\nsam = 'sam27d07_bal15'", "sam27d07_bal14"),
        ("[sensor]\nsam = 'nowhere.json'", "nowhere.json"),
        ("[mirror]\ndead = [99999]", "actuator '99999'"),
    ],
)
def test_configuration(tmp_path: Path, config: str, expected: str) -> None:
    _refused(tmp_path, *SHORT, config=config, expected=expected)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (layout(holes=[[0.0, 0.2], [0.05, 0.2]]), "overlap"),
        (layout(holes=[[0.0, 0.48], [0.2, -0.1]]), "outside"),
        (layout(holes=[[0.0, "x"]]), "layout mine"),
        ("{", "JSON"),
    ],
)
def test_a_layout(tmp_path: Path, content: str, expected: str) -> None:
    (tmp_path / "mask.json").write_text(content)
    _refused(tmp_path, *SHORT, "--sensor", "mask.json:mine", expected=expected)


def test_an_even_symmetric_layout_is_warned_about(tmp_path: Path) -> None:
    (tmp_path / "mask.json").write_text(layout(holes=[[0.3, 0.1], [-0.3, -0.1], [0.1, -0.3], [-0.1, 0.3]]))
    complaints = _refused(tmp_path, *SHORT, "--sensor", "mask.json:mine", expected="cannot tell the modes apart")
    assert "warning: " in complaints
    assert "even" in complaints


def test_a_calibration(tmp_path: Path) -> None:
    missing = ["controller", "--run", "mistakes", "--calibration", "none.fits"]
    _refused(tmp_path, *missing, expected="there is no such calibration file")
    config = load(None)
    optics = instrument.twin(config, None, print)
    found = instrument.analytic_calibration(config, optics, instrument.mirror_on_twin(config, optics, print))
    whole = calibration_file.to_bytes(found)
    for name, content in (("cut", whole[: len(whole) // 2]), ("text", b"hello"), ("flipped", _flip(whole))):
        (tmp_path / f"{name}.fits").write_bytes(content)
        _refused(tmp_path, *missing[:-1], f"{name}.fits", expected=f"{name}.fits")


def test_a_port_in_use(tmp_path: Path) -> None:
    held = open_run("mistakes-port")
    try:
        with socket.socket() as taken:
            taken.bind(("127.0.0.1", held.links.ports["recorder"]))
            taken.listen()
            _refused(tmp_path, "record", "--run", "mistakes-port", expected=str(held.links.ports["recorder"]))
    finally:
        held.remove()


def test_nobody_is_there(tmp_path: Path) -> None:
    _refused(tmp_path, "ctl", "status", expected="no loop is running on this host")
    _refused(tmp_path, "ctl", "status", "--run", "none-such", expected="no loop is running on this host")
    _refused(tmp_path, "ctl", "gain", "often", expected="valid number")
    _refused(tmp_path, "config", "check", "none.toml", expected="none.toml")
    _refused(tmp_path, "sim-lop", expected="sim-lop")


def _flip(content: bytes) -> bytes:
    middle = len(content) // 2
    return content[:middle] + bytes([content[middle] ^ 0x10]) + content[middle + 1 :]


def _refused(folder: Path, *arguments: str, expected: str, config: str = "") -> str:
    done = run(folder, *arguments, config=config)
    assert done.returncode == 2, done.stderr
    assert expected in done.stderr
    assert "Traceback" not in done.stderr
    assert not done.stdout
    assert not (folder / "logs").exists()
    return done.stderr
