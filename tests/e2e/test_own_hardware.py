"""A user's devices as real processes: the examples of hardware.md, commissioning.md and the tutorial your_camera.md."""

import json
import re
import shlex
import shutil
import subprocess
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.bus.run import open_run
from lowfc.adapters.bus.zenoh_bus import ZenohBus
from lowfc.adapters.files import calibration_file
from lowfc.adapters.process.clock import HostClock
from lowfc.client import Client
from lowfc.contract.messages import FRAME, MIRROR_STATE, STEP, Role, wire
from tests.support.loops import PROGRAMS, command, in_background, until

pytestmark = pytest.mark.exclusive

ROOT = Path(__file__).parents[2]
BENCH = """
[camera]
rate_hz = 100

[disturbance]
preset = "quiet"
static_nm = { "2" = 15, "4" = 8 }

[control]
gain = 0.2
"""
DEVICES = (
    "lowfc mirror examples/mirror.py:MyMirror --run bench --config bench.toml",
    "lowfc camera examples/camera.py:MyCamera --run bench --config bench.toml",
)
CONFORMANCE = (
    "lowfc conformance camera --run bench --config bench.toml",
    "lowfc conformance mirror --run bench --config bench.toml",
)
LOOP = ("lowfc controller --run bench --config bench.toml", "lowfc ctl close --run bench")
PLAIN = (
    "lowfc config zenoh --run bench --role camera --make > camera.json5",
    "python examples/plain_camera.py camera.json5 frames.npy",
)

COUNTING = (
    "lowfc camera counting.py:Counting --run counting --peak-dn 9000",
    "lowfc conformance camera --run counting",
)
DOCTOR = "lowfc doctor --device sim"
DOCUMENTED = (*DEVICES, *CONFORMANCE, *LOOP, *PLAIN, *COUNTING, DOCTOR)
"""Commands of hardware.md and your_camera.md; all are run here."""

SIMULATED = ("sim-camera --run bench --config bench.toml", "sim-dm --run bench --config bench.toml")


@pytest.fixture
def folder(tmp_path: Path, own_runtime: Path) -> Path:
    """A folder with the examples, and a private runtime directory."""
    shutil.copytree(ROOT / "examples", tmp_path / "examples")
    (tmp_path / "bench.toml").write_text(BENCH)
    return tmp_path


def started(folder: Path, line: str) -> "subprocess.Popen[str]":
    program, *rest = shlex.split(line)
    return subprocess.Popen(
        [PROGRAMS / program, *rest], cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def operator_bus() -> closing[ZenohBus]:
    return closing(ZenohBus(open_run("bench").links, Role.OPERATOR, HostClock()))


def wait_for_devices(bus: ZenohBus) -> None:
    """Wait for the first frame and the first state of the mirror."""
    received: set[str] = set()
    for topic in (FRAME, MIRROR_STATE):
        bus.subscribe(topic, lambda sample: received.add(sample.key))
    until(lambda: len(received) == 2)


def conformance(folder: Path, *commands: str) -> None:
    """Check all devices at the same time; none may fail a check."""
    checking = [started(folder, f"{line} --json --duration 0.6") for line in commands]
    for line, process in zip(commands, checking, strict=True):
        out, stderr = process.communicate(timeout=60)
        assert process.returncode == 0, f"{line}: {out} {stderr}"
        results = json.loads(out)
        assert f"--run {results['run']}" in line
        assert results["device"] in line or results["device"] == "mirror-dm"
        assert results["counts"]["wrong"] == 0
        assert {"clear", "relaxing"}.isdisjoint(check["name"] for check in results["checks"] if check["status"] != "ok")
        assert results["counts"]["ok"] >= len(results["checks"]) - 5  # a busy host causes warnings


def test_the_loop_closes_with_a_users_camera_and_mirror(folder: Path) -> None:
    with in_background(folder, *DEVICES), operator_bus() as bus:
        wait_for_devices(bus)
        conformance(folder, *CONFORMANCE)
        errors_nm: list[list[float]] = []

        def keep_error(sample: Sample) -> None:
            errors_nm.append(list(wire.ControlStep.FromString(sample.payload).error_nm))

        def rms_nm() -> float:
            """Norm of the mean error of the last 100 steps: the residual without noise; NaN without 100 errors."""
            measured = [error for error in errors_nm[-100:] if error]
            return float(np.linalg.norm(np.mean(measured, axis=0))) if len(measured) == 100 else np.nan

        bus.subscribe(STEP, keep_error)
        with in_background(folder, LOOP[0]):
            until(lambda: np.isfinite(rms_nm()))
            before_nm = rms_nm()
            assert "loop closed" in command(folder, LOOP[1])
            until(lambda: rms_nm() < 0.1 * before_nm)
        states: list[wire.MirrorState] = []
        bus.subscribe(MIRROR_STATE, lambda sample: states.append(wire.MirrorState.FromString(sample.payload)))
        until(lambda: states and not np.frombuffer(states[-1].actuators, np.float32).any())
        assert not states[-1].command_nm, "a flat mirror reports no modal command for the next controller to adopt"
    assert before_nm == pytest.approx(17, rel=0.15)


@pytest.mark.slow
def test_the_simulated_devices_and_a_camera_in_plain_zenoh_pass_conformance(folder: Path) -> None:
    y, x = np.mgrid[:80, :80]
    spot = 100 + 2000 * np.exp(-((y - 40) ** 2 + (x - 30) ** 2) / 50)
    np.save(folder / "frames.npy", np.random.default_rng(1).poisson(spot, (50, 80, 80)).astype(np.uint16))
    HostClock()  # creates this boot's clock, which the program below only reads
    command(folder, PLAIN[0].replace("bench", "plain"))
    with in_background(folder, *SIMULATED, PLAIN[1]):
        with operator_bus() as bus:
            wait_for_devices(bus)
        conformance(folder, *CONFORMANCE, CONFORMANCE[0].partition(" --config")[0].replace("bench", "plain"))


@pytest.mark.slow
def test_the_camera_of_the_tutorial_passes_conformance(folder: Path, own_runtime: Path) -> None:
    (folder / "counting.py").write_text(block("python", (ROOT / "docs/tutorials/your_camera.md").read_text()))
    with in_background(folder, COUNTING[0]):
        until(lambda: (own_runtime / "lowfc/counting").exists())
        conformance(folder, COUNTING[1])
    assert "2 ok" in command(folder, DOCTOR)


COMMISSIONING_PAGE = (ROOT / "docs/howto/commissioning.md").read_text()
COMMISSIONING = re.findall(r"^    ((?:python|lowfc) .*)$", COMMISSIONING_PAGE, flags=re.MULTILINE)
*PAGE_DEVICES, CONTROLLER, COMMISSION, LATER = COMMISSIONING


def block(language: str, page: str = COMMISSIONING_PAGE) -> str:
    """The page's listing in this language."""
    (listing,) = re.findall(rf"^```{language}\n(.*?)^```$", page, flags=re.MULTILINE | re.DOTALL)
    return str(listing)


def close_loop(folder: Path) -> bool:
    """Ask the loop to close; return whether it accepted."""
    process = started(folder, "lowfc ctl close --run bench")
    process.communicate(timeout=20)
    return process.returncode == 0


OWN_CAMERA = """
from dataclasses import replace

from camera import MyCamera


class SmallCamera(MyCamera):
    def settings(self):
        return replace(super().settings(), rows=64, columns=64, bit_depth=14, saturation_dn=None)

    def expose(self):
        exposure = super().expose()
        return exposure._replace(pixels=exposure.pixels[8:-8, 8:-8])
"""


@pytest.mark.slow
@pytest.mark.parametrize("own_drivers", [False, True])
def test_a_loop_with_a_camera_of_another_size_is_commissioned(folder: Path, own_drivers: bool) -> None:
    """docs/howto/commissioning.md, as written, and with a user's drivers: 64 x 64 pixels, 100 Hz, 14 bits."""
    assert len(COMMISSIONING) == 5
    (folder / "bench.toml").write_text(block("toml"))
    devices = PAGE_DEVICES
    if own_drivers:
        (folder / "examples/small_camera.py").write_text(OWN_CAMERA)
        sim = "lowfc mirror sim", "lowfc camera sim --rows 64 --columns 64"
        drivers = "lowfc mirror examples/mirror.py:MyMirror", "lowfc camera examples/small_camera.py:SmallCamera"
        devices = [line.replace(a, b) for line, a, b in zip(devices, sim, drivers, strict=True)]
        assert not any(" sim " in line for line in devices)
    with in_background(folder, *devices, CONTROLLER):
        with operator_bus() as bus:
            wait_for_devices(bus)
        process = started(folder, f"{COMMISSION} --json")
        out, stderr = process.communicate(timeout=400)
        assert process.returncode == 0, stderr
        for number in range(1, 11):
            assert f"[{number}/10]" in stderr
        results = json.loads(out)
        assert results["recommended"]
        assert results["delay_frames"] == pytest.approx(1, abs=0.1)
        assert results["measured_error_nm"] == pytest.approx(results["predicted_error_nm"], rel=0.15)
        with Client("bench") as client:
            state = client.status().state
            assert state.mode_cause == "asked to close for lowfc commission"
        assert calibration_file.load(folder / "calibration.fits").shape == (64, 64)
    with in_background(folder, *devices, LATER):
        until(lambda: close_loop(folder), 60)
