"""`lowfc tune` on a running loop: it listens, finds better gains, and the loop leaves less with them."""

import json
from pathlib import Path

import numpy as np
import pytest

from lowfc.client import Client, running
from tests.support.loops import interrupt, run, start, until

pytestmark = pytest.mark.exclusive

MISTUNED = 0.03
TOML = f"""
[star]
magnitude = -1.0
[sensor]
modes = 4
[camera]
rate_hz = 250
[disturbance]
preset = "bench"
[control]
tilt_gain = {MISTUNED}
gain = {MISTUNED}
"""
SETTLING, MEASURED = 500, 2500


def left_nm() -> float:
    """What the loop leaves of tip and tilt, rms per axis, as it measures it."""
    with Client() as loop:
        steps = list(loop.steps(SETTLING + MEASURED, patience_s=30))[SETTLING:]
    tilts_nm = np.array([step.error_nm[:2] for step in steps if step.error_nm is not None])
    assert len(tilts_nm) > MEASURED / 2
    return float(np.sqrt(np.mean(tilts_nm**2)))


@pytest.mark.slow
def test_a_mistuned_loop_is_tuned_while_it_runs(tmp_path: Path) -> None:
    (tmp_path / "loop.toml").write_text(TOML)
    words = ("sim-loop", "--config", "loop.toml", "--lockstep", "--no-record")  # nothing is late on a busy host
    process = start(tmp_path, *words)
    try:
        until(running)
        before_nm = left_nm()
        done = run(tmp_path, "tune", "--live", "20", "--apply", "--json")
        status = run(tmp_path, "ctl", "status", "--json")
        after_nm = left_nm()
    finally:
        _, said = interrupt(process)
    assert done.returncode == 0, done.stderr + said
    found, now = json.loads(done.stdout), json.loads(status.stdout)
    assert found["closed"]
    assert [mode["gain_now"] for mode in found["modes"]] == pytest.approx([MISTUNED] * 4)
    best = [mode["gain_best"] for mode in found["modes"]]
    assert min(best[:2]) > 5 * MISTUNED
    assert found["applied"].startswith("gain is now ")
    assert now["gain"] == pytest.approx(best, abs=1e-4)
    assert (now["mode"], now["law"]["name"]) == ("closed", "integrator")
    assert after_nm < 0.7 * before_nm
