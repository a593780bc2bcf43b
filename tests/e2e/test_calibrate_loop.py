"""A running loop is calibrated over the bus, with an interruption and a resumption; its rejection is tested."""

import json
import time
from pathlib import Path

import numpy as np
import pytest

from lowfc.adapters.files import calibration_file
from lowfc.client import Client, running
from lowfc.control.calibration.response_fit import cross_talk
from tests.support.loops import interrupt, json_of, recorded_bytes, run, start, until

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


@pytest.mark.slow
def test_an_interrupted_calibration_of_a_running_loop_is_resumed(tmp_path: Path) -> None:
    (tmp_path / "test.toml").write_text(CONFIG)
    options = ("--config", "test.toml", "--no-record", "--open", "--lockstep")  # lockstep: independent of the load
    loop = start(tmp_path, "sim-loop", *options)
    try:
        until(running)
        calibrating = start(tmp_path, "calibrate", "--cycles", "400", "--out", "night.fits")
        until((tmp_path / "night.fits.part.npz").exists, timeout_s=90)
        _, stderr = interrupt(calibrating)
        assert calibrating.returncode == 130
        assert "kept in night.fits.part.npz: " in stderr
        with Client() as client:
            until(lambda: is_flat(client))
        done = run(tmp_path, "calibrate", "--cycles", "5", "--resume", "--out", "night.fits", "--json")
        assert done.returncode == 0, done.stderr
        assert "continuing after" in done.stderr
        results = json.loads(done.stdout)
        assert {"method", "modes", "condition_number", "delay_frames", "noise_gain_nm", "file"} <= results.keys()
        assert results["delay_frames"] == pytest.approx(1.5, abs=0.05)
        assert results["cross_talk"] < 0.02 + 4 * results["cross_talk_error"]
        assert results["recommended"]
        assert not (tmp_path / "night.fits.part.npz").exists()
        calibration = calibration_file.load(tmp_path / "night.fits")
        with Client() as client:
            assert is_flat(client)
            matrix = cross_talk(calibration.reconstructor, client.calibration().response)
            assert np.abs(matrix).max() == np.float64(results["cross_talk"])
            client.load(calibration)
            assert client.calibration().id == calibration.id
            client.close_loop()
            time.sleep(0.5)
            state = client.status().state
            assert np.abs(np.array(state.command_history_nm)).max() < 5, "without a disturbance the command stays small"
    finally:
        interrupt(loop)


def is_flat(client: Client) -> bool:
    """Whether the command is zero."""
    state = client.status().state
    return not np.frombuffer(state.actuators, np.float32).any()


REJECTION_CONFIG = """
[star]
magnitude = -1.0
[sensor]
modes = 4
[camera]
rate_hz = 250
[disturbance]
preset = "quiet"
[control]
gain = 0.3
[acceptance]
lowest_hz = 1.5
"""


@pytest.mark.slow
def test_the_rejection_measured_on_a_running_loop_and_from_its_log_is_the_same(tmp_path: Path) -> None:
    (tmp_path / "loop.toml").write_text(REJECTION_CONFIG)
    options = ("--duration", "4", "--lines", "8", "--json", "--plot", "live.png")
    loop = start(tmp_path, "sim-loop", "--config", "loop.toml", "--lockstep")  # lockstep: independent of the load
    try:
        until(lambda: recorded_bytes(tmp_path) > 4_000_000)
        done = run(tmp_path, "acceptance", "rejection", *options)
    finally:
        _, stderr = interrupt(loop)
    assert done.returncode == 0, done.stdout + done.stderr + stderr
    live = json.loads(done.stdout)
    assert live["passed"]
    assert live["rate_hz"] == pytest.approx(250, rel=0.01)
    assert live["lowest_hz"] >= 1.5
    assert live["largest_departure_db"] <= 1.0
    assert (tmp_path / "live.png").read_bytes().startswith(b"\x89PNG")

    (log,) = (tmp_path / "logs").glob("*.mcap")
    assert json_of("acceptance", "rejection", log) == live
