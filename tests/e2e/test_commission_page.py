"""docs/commissioning.md, as it stands: a camera of 64 x 64 pixels at 100 Hz with 14 bits, to a closed loop."""

import json
import re
import shutil
from pathlib import Path

import pytest

from lowfc.adapters.files import calibration_file
from lowfc.client import Client
from lowfc.contract.messages import FRAME, MIRROR_STATE
from tests.e2e.test_own_hardware import ROOT, listening, running, started
from tests.support.loops import until

pytestmark = pytest.mark.exclusive

TEXT = (ROOT / "docs/commissioning.md").read_text()
COMMANDS = re.findall(r"^    ((?:python|lowfc) .*)$", TEXT, flags=re.MULTILINE)
DEVICES, CONTROLLER, COMMISSION, LATER = COMMANDS[:2], COMMANDS[2], COMMANDS[3], COMMANDS[4]


def block(language: str) -> str:
    """The page's listing in this language."""
    (found,) = re.findall(rf"^```{language}\n(.*?)^```$", TEXT, flags=re.MULTILINE | re.DOTALL)
    return str(found)


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the examples and the page's two files, and runs of its own."""
    runtime = tmp_path / "run"
    runtime.mkdir(mode=0o700)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(runtime))
    shutil.copytree(ROOT / "examples", tmp_path / "examples")
    (tmp_path / "examples/small_camera.py").write_text(block("python"))
    (tmp_path / "bench.toml").write_text(block("toml"))
    return tmp_path


def closed(folder: Path) -> bool:
    """Whether the loop could be closed."""
    process = started(folder, "lowfc ctl close --run bench")
    process.communicate(timeout=20)
    return process.returncode == 0


@pytest.mark.slow
def test_a_camera_of_another_size_comes_to_a_closed_loop(bench: Path) -> None:
    assert len(COMMANDS) == 5
    with running(bench, *DEVICES, CONTROLLER):
        with listening() as bus:
            there: set[str] = set()
            for topic in (FRAME, MIRROR_STATE):
                bus.subscribe(topic, lambda sample: there.add(sample.key))
            until(lambda: len(there) == 2)
        process = started(bench, f"{COMMISSION} --json")
        out, shown = process.communicate(timeout=400)
        assert process.returncode == 0, shown
        for number in range(1, 11):
            assert f"[{number}/10]" in shown
        figures = json.loads(out)
        assert figures["recommended"]
        assert figures["delay_frames"] == pytest.approx(1, abs=0.1)
        assert figures["measured_error_nm"] == pytest.approx(figures["predicted_error_nm"], rel=0.15)
        with Client("bench") as client:
            state = client.status().state
            assert state.mode_cause == "operator asked to close"
        assert calibration_file.load(bench / "calibration.fits").shape == (64, 64)
    with running(bench, *DEVICES, LATER):
        until(lambda: closed(bench), 60)
