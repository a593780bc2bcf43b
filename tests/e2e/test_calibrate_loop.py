"""`lowfc calibrate` on the real processes: pokes through the bus, Ctrl-C in the middle, and going on after it."""

import json
import time
from pathlib import Path

import numpy as np
import pytest

from lowfc.adapters.files import calibration_file
from lowfc.client import Client, running
from lowfc.control.calibration.response_fit import cross_talk
from tests.support.loops import interrupt, run, start, until

pytestmark = pytest.mark.exclusive

CONFIG = """
[sensor]
sam = "sam27d10_bal14"
modes = 6
[star]
magnitude = 0.0
[camera]
rate_hz = 500.0
delay_frames = 1.5
[disturbance]
preset = "quiet"
[realtime]
priority = 0
disable_cpu_idle = false
"""


SHAKEN = """
[sensor]
modes = 6
[disturbance]
preset = "bench"
[realtime]
priority = 0
disable_cpu_idle = false
"""


@pytest.mark.slow
def test_a_running_loop_is_calibrated_interrupted_and_gone_on_with(tmp_path: Path) -> None:
    (tmp_path / "test.toml").write_text(CONFIG)
    how = ("--config", "test.toml", "--no-record", "--open", "--lockstep")  # nothing is late on a busy host
    loop = start(tmp_path, "sim-loop", *how)
    try:
        until(running)
        calibrating = start(tmp_path, "calibrate", "--cycles", "400", "--out", "night.fits")
        until((tmp_path / "night.fits.part.npz").exists, timeout_s=90)
        _, said = interrupt(calibrating)
        assert calibrating.returncode == 130
        assert "kept in night.fits.part.npz: the same command with --resume goes on with them" in said
        with Client() as client:
            until(lambda: flat(client))
        done = run(
            tmp_path, "calibrate", "--cycles", "5", "--resume", "--no-linear-range", "--out", "night.fits", "--json"
        )
        assert done.returncode == 0, done.stderr
        assert "going on after" in done.stderr
        found = json.loads(done.stdout)
        assert {"method", "modes", "condition_number", "delay_frames", "noise_gain_nm", "file"} <= found.keys()
        assert found["delay_frames"] == pytest.approx(1.5, abs=0.05)
        assert found["cross_talk"] < 0.02 + 4 * found["cross_talk_error"]
        assert found["recommended"]
        assert not (tmp_path / "night.fits.part.npz").exists()
        made = calibration_file.load(tmp_path / "night.fits")
        with Client() as client:
            assert flat(client)
            talk = cross_talk(made.reconstructor, client.calibration().response)
            assert np.abs(talk).max() == np.float64(found["cross_talk"])
            client.load(made)
            assert client.calibration().id == made.id
            client.close_loop()
            time.sleep(0.5)
            state = client.status().state
            assert np.abs(np.array(state.command_history_nm)).max() < 5
    finally:
        interrupt(loop)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["hadamard", "poke", "in-loop"])
def test_the_promise_is_kept_over_the_bus(method: str, tmp_path: Path) -> None:
    (tmp_path / "test.toml").write_text(SHAKEN)
    opened = [] if method == "in-loop" else ["--open"]
    loop = start(tmp_path, "sim-loop", "--config", "test.toml", "--no-record", "--lockstep", *opened)
    try:
        until(running)
        words = ("--method", method, "--snr", "20", "--no-linear-range", "--out", "night.fits", "--json")
        done = run(tmp_path, "calibrate", *words)
        assert done.returncode == 0, done.stderr
        found = json.loads(done.stdout)
        assert found["recommended"]
        assert found["snr_reached"] >= 20
        made = calibration_file.load(tmp_path / "night.fits")
        with Client() as client:
            talk = cross_talk(made.reconstructor, client.calibration().response)
        assert np.sqrt((talk**2).mean()) < 1.2 / 20
        assert np.abs(talk).max() < 4 / 20
        ratio = np.array(found["noise_gain_nm"]) / found["computed_noise_nm"]
        assert ratio.max() < 1.2
        assert not list(tmp_path.glob("*.part.npz"))
    finally:
        interrupt(loop)


def flat(client: Client) -> bool:
    """Whether nothing is played, nor anything commanded."""
    state = client.status().state
    return not np.frombuffer(state.actuators, np.float32).any()
