"""A day on the bench: every command of the documents on calibration, tuning and acceptance, on a running loop."""

import shlex
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from lowfc.client import running
from tests.support.loops import LOWFC, children, interrupt, start, until

pytestmark = pytest.mark.exclusive

COMPUTED = (
    "lowfc calibrate --method analytic --config lowfc.toml --out computed.fits",
    "lowfc calibrate --method analytic --config lowfc.toml --at 4=15,7=-10 --out there.fits",
)
OPEN_LOOP = (
    "lowfc calibrate --method hadamard --out night.fits",
    "lowfc calibrate --compare computed.fits night.fits",
    "lowfc calibrate reference --frames 5000 --out night.fits",
    "lowfc calibrate align --out aligned.fits",
)
DARK = "lowfc calibrate dark --frames 1000 --out night.fits"
WITH_IT = "lowfc controller --run bench --calibration night.fits"
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
COMMANDS = (*COMPUTED, *OPEN_LOOP, DARK, WITH_IT, *CLOSED_LOOP, *AFTERWARDS, LAW)

CONFIG = """
[sensor]
sam = "sam27d10_bal14"
modes = 6
[star]
magnitude = 0.0
[disturbance]
preset = "bench"
scale = 0.2
"""


def run(folder: Path, command: str) -> str:
    """Run a documented command; what an acceptance test finds is another matter than whether it runs."""
    words = shlex.split(command)[1:]
    done = subprocess.run([*LOWFC, *words], cwd=folder, capture_output=True, text=True, timeout=900, check=False)
    fine = (0, 1) if words[0] == "acceptance" else (0,)
    assert done.returncode in fine, f"{command}: {done.stderr}"
    assert "Traceback" not in done.stderr, done.stderr
    return done.stdout


@contextmanager
def loop(folder: Path, *arguments: str) -> Iterator[None]:
    process = start(folder, "sim-loop", "--config", "lowfc.toml", *arguments)
    try:
        until(lambda: "controller" in children(process.pid))
        until(running)
        yield
    finally:
        _, complaints = interrupt(process)
    assert process.returncode == 0, complaints


@pytest.mark.slow
@pytest.mark.timeout(2400)
def test_a_day_on_the_bench(tmp_path: Path) -> None:
    (tmp_path / "lowfc.toml").write_text(CONFIG)
    for command in COMPUTED:
        assert run(tmp_path, command)
    with loop(tmp_path, "--open", "--no-record"):
        for command in OPEN_LOOP:
            assert run(tmp_path, command)
    with loop(tmp_path, "--open", "--no-record", "--star-magnitude", "20"):
        run(tmp_path, "lowfc ctl load night.fits")
        assert run(tmp_path, DARK + " --dark-taken")
    with loop(tmp_path):
        for command in CLOSED_LOOP:
            assert run(tmp_path, command)
    for command in AFTERWARDS:
        assert run(tmp_path, command)
    with loop(tmp_path, "--no-record"):
        assert run(tmp_path, LAW)
    controller = start(tmp_path, *shlex.split(WITH_IT)[1:])
    until(lambda: "bench" in running())
    until(lambda: subprocess.run([*LOWFC, "ctl", "status"], capture_output=True, check=False).returncode == 0)
    interrupt(controller)
    assert controller.returncode == 0
    assert {"computed.fits", "there.fits", "night.fits", "aligned.fits", "lqg.fits", "rejection.png"} <= {
        path.name for path in tmp_path.iterdir()
    }
