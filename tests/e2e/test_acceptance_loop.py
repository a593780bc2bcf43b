"""The acceptance tests on a running loop, and again from the log of it."""

import json
from pathlib import Path

import pytest

from tests.support.loops import interrupt, recorded_bytes, run, start, until

TOML = """
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
def test_rejection_of_a_running_loop_and_of_its_log(tmp_path: Path) -> None:
    (tmp_path / "loop.toml").write_text(TOML)
    words = ("--duration", "4", "--lines", "8", "--json", "--plot", "live.png")
    running = start(tmp_path, "sim-loop", "--config", "loop.toml", "--lockstep")  # nothing is late on a busy host
    try:
        until(lambda: recorded_bytes(tmp_path) > 4_000_000)
        done = run(tmp_path, "acceptance", "rejection", *words)
    finally:
        _, said = interrupt(running)
    assert done.returncode == 0, done.stdout + done.stderr + said
    live = json.loads(done.stdout)
    assert live["passed"]
    assert live["rate_hz"] == pytest.approx(250, rel=0.01)
    assert live["lowest_hz"] >= 1.5
    assert live["largest_departure_db"] <= 1.0
    assert (tmp_path / "live.png").read_bytes().startswith(b"\x89PNG")

    (log,) = (tmp_path / "logs").glob("*.mcap")
    again = run(tmp_path, "acceptance", "rejection", "--json", str(log))
    assert again.returncode == 0, again.stderr
    assert json.loads(again.stdout) == live
