"""A day on the bench: every command of the documents on calibration, tuning and acceptance, on a running loop."""

import shlex
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from lowfc.client import running
from tests.support.loops import LOWFC, command, in_background, until

pytestmark = pytest.mark.exclusive

COMPUTED = (
    "lowfc calibrate --method analytic --config lowfc.toml --out computed.fits",
    "lowfc calibrate --method analytic --config lowfc.toml --at 4=15,7=-10 --out zero_point.fits",
)
OPEN_LOOP = (
    "lowfc calibrate --method hadamard --out night.fits",
    "lowfc calibrate --compare computed.fits night.fits",
    "lowfc calibrate reference --frames 5000 --out night.fits",
    "lowfc calibrate align --out aligned.fits",
)
DARK = "lowfc calibrate dark --frames 1000 --out night.fits"
WITH_CALIBRATION = "lowfc controller --run bench --calibration night.fits"
CLOSED_LOOP = (
    "lowfc tune --live 20 --controller lqg --apply",
    "lowfc acceptance noise-floor",
    "lowfc acceptance linearity",
    "lowfc acceptance capture-range",
    "lowfc acceptance rejection --plot rejection.png",
)
AFTERWARDS = (
    "lowfc tune last",
    "lowfc tune last --controller lqg --out lqg.fits",
    "lowfc acceptance rejection last",
)
LAW = "lowfc ctl law lqg.fits"
STATUS = [*LOWFC, "ctl", "status"]
COMMANDS = (*COMPUTED, *OPEN_LOOP, DARK, WITH_CALIBRATION, *CLOSED_LOOP, *AFTERWARDS, LAW)

CONFIG = """
[sensor]
sam = "sam27d10_bal14"
modes = 6
[camera]
rate_hz = 125.0
[star]
magnitude = 0.0
[disturbance]
preset = "bench"
scale = 0.2
"""


def run(folder: Path, line: str) -> str:
    """Run a documented command; an acceptance test may also end with status 1, failed."""
    return command(folder, line, 900, (0, 1) if line.split()[1] == "acceptance" else (0,))


@contextmanager
def loop(folder: Path, *options: str) -> Iterator[None]:
    with in_background(folder, shlex.join(["lowfc", "sim-loop", "--config", "lowfc.toml", *options])):
        until(lambda: running() and subprocess.run(STATUS, capture_output=True, check=False).returncode == 0, 60)
        yield


@pytest.mark.slow
@pytest.mark.timeout(2400)
def test_every_command_of_the_calibration_and_acceptance_pages_runs(tmp_path: Path) -> None:
    (tmp_path / "lowfc.toml").write_text(CONFIG)
    for line in COMPUTED:
        assert run(tmp_path, line)
    with loop(tmp_path, "--open", "--no-record"):
        for line in OPEN_LOOP:
            assert run(tmp_path, line)
    with loop(tmp_path, "--open", "--no-record", "--star-magnitude", "20"):
        run(tmp_path, "lowfc ctl load night.fits")
        assert run(tmp_path, DARK + " --star-blocked")
    with loop(tmp_path):
        for line in CLOSED_LOOP:
            assert run(tmp_path, line)
    for line in AFTERWARDS:
        assert run(tmp_path, line)
    with loop(tmp_path, "--no-record"):
        assert run(tmp_path, LAW)
    with in_background(tmp_path, WITH_CALIBRATION):
        until(lambda: "bench" in running())
        until(lambda: subprocess.run(STATUS, capture_output=True, check=False).returncode == 0)
    assert {"computed.fits", "zero_point.fits", "night.fits", "aligned.fits", "lqg.fits", "rejection.png"} <= {
        path.name for path in tmp_path.iterdir()
    }
