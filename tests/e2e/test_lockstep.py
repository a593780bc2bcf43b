"""Lockstep over the real bus: the same bytes from one seed, the predicted residual, a static wavefront removed."""

import json
import os
import signal
from pathlib import Path

import numpy as np
import pytest

from lowfc.adapters.files.sensors import sensor_named
from lowfc.contract.configuration import load
from lowfc.contract.errors import ConfigurationError
from lowfc.contract.messages import topic_of, wire
from lowfc.contract.sections import SENSORS
from lowfc.optics.chain.sensor import light_budget
from tests.support.loops import children, loop, lowfc, output_of, payloads, recorded_bytes, start, until
from tools.laws import tilt_residual_mas
from tools.measure import measured

GENTLE = """
[camera]
rate_hz = 1000
[disturbance]
preset = "reaction-wheel"
scale = 0.3571428  # 5 mas of 14 mas rms per axis
[control]
tilt_gain = 1.0
gain = 0.05
[mirror]
rows = 12
columns = 12
pitches_per_pupil = 10
"""


@pytest.mark.parametrize("rate_hz", [50, pytest.param(250, marks=pytest.mark.slow)])
def test_two_runs_with_one_seed_write_the_same_bytes_and_have_one_digest(tmp_path: Path, rate_hz: int) -> None:
    """Automatic gains are inputs, identical in both runs and in a replay."""
    logs, infos, frames = [], [], round(2.4 * rate_hz)
    for name in ("first", "second"):
        folder = tmp_path / name
        folder.mkdir()
        options = ("--rate", str(rate_hz), "--duration", "2.4", "--seed", "7")
        results = loop(folder, "--lockstep", *options, "--disturbance", "bench")
        assert results["frames_published"] == results["commands_applied"] == frames
        assert results["messages_lost"] == 0
        logs.append(payloads(results["log"]))
        infos.append(json.loads(output_of(folder, "lowfc info last --digest --json")))
    assert infos[0]["digest"] == infos[1]["digest"]
    for key, line in infos[0]["topics"].items():
        assert ("digest" in line) == topic_of(key).deterministic, key
    assert "digest" not in infos[0]["topics"]["lowfc/event"]
    first, second = (
        {topic: bodies for topic, bodies in log.items() if topic_of(topic[1:]).deterministic} for log in logs
    )
    assert first.keys() == second.keys()
    for topic, bodies in first.items():
        assert bodies == second[topic], topic
    requests = [wire.Request.FromString(payload) for payload in first["/lowfc/control/request"]]
    assert [(request.name, request.accepted) for request in requests[:2]] == [("gain", True), ("close", True)]
    assert {request.requester for request in requests[:2]} == {"automatic gains"}
    assert json.loads(output_of(tmp_path / "first", "lowfc replay last --json"))["identical"] is True


@pytest.mark.parametrize("frames", [1_200, pytest.param(20_000, marks=pytest.mark.slow)])
def test_the_tilt_residual_agrees_with_the_prediction(tmp_path: Path, frames: int) -> None:
    """The prediction |S|^2 P_d + |T|^2 P_n holds within 10 % for 5 mas rms of tilt per axis and half the limiting gain.

    Beyond 10 mas the sensor's optical gain drops (0.92 at 14 mas), so this holds for small tilts only.
    """
    results = loop(
        tmp_path, "--lockstep", "--duration", str(frames / 1000), "--no-record", config=GENTLE, timeout_s=200
    )
    assert results["frames_published"] == results["commands_applied"] == frames
    assert results["tilt_disturbance_mas"] == pytest.approx(5, rel=0.15)
    predicted_mas = tilt_residual_mas(load(tmp_path / "test.toml"))
    assert results["tilt_residual_mas"] == pytest.approx(predicted_mas, rel=0.1)


@pytest.mark.slow
def test_a_lockstep_run_ends_and_names_a_suspended_process(tmp_path: Path) -> None:
    """Five seconds of real time without progress end a lockstep run."""
    process = start(tmp_path, "sim-loop", "--lockstep", "--duration", "600")
    until(lambda: recorded_bytes(tmp_path) > 4e6)
    os.kill(children(process.pid)["controller"], signal.SIGSTOP)
    _, stderr = process.communicate(timeout=40)
    assert process.returncode == 1
    assert "no Health from controller" in stderr
    assert "Traceback" not in stderr


STATIC_NM = dict(zip(range(2, 16), (12, -9, 8, -7, 6, 5, -5, 4, -4, 3, -3, 3, -3, 3), strict=True))
STATIC_WAVEFRONT = f"""
[star]
magnitude = 1
[mirror]
rows = 12
columns = 12
pitches_per_pupil = 11
[control]
tilt_gain = 0.5
gain = 0.2
[disturbance]
preset = "quiet"
static_nm = {{ {", ".join(f'"{noll}" = {nm}' for noll, nm in STATIC_NM.items())} }}
"""


@pytest.mark.parametrize("sensor", ["zwfs", *(pytest.param(one, marks=pytest.mark.slow) for one in ("clowfs", "bar"))])
def test_every_mode_of_a_static_wavefront_is_removed(tmp_path: Path, sensor: str) -> None:
    results = loop(tmp_path, "--lockstep", "--duration", "0.6", "--sensor", sensor, config=STATIC_WAVEFRONT)
    assert results["frames_published"] == results["commands_applied"] == 150
    truths = [wire.Truth.FromString(payload) for payload in payloads(results["log"])["/lowfc/sim/truth"]]
    first, last = truths[0], truths[-50:]
    np.testing.assert_allclose(first.residual_nm[:14], list(STATIC_NM.values()), atol=0.1)
    residual_nm = np.mean([truth.residual_nm[:14] for truth in last], axis=0)
    assert np.abs(residual_nm).max() < 1.0
    assert np.mean([truth.residual_rms_nm for truth in last]) < 0.15 * first.residual_rms_nm


def test_stored_light_budgets_match_the_sensors() -> None:
    assert set(SENSORS) < set(measured("sensors")["sensors"])
    for name, results in measured("sensors")["sensors"].items():
        budget = light_budget(sensor_named(name))
        assert budget.total == pytest.approx(results["light"], rel=1e-6), name
        assert budget.peak == pytest.approx(results["peak"], rel=1e-6), name


def test_a_loop_starts_open_only_if_configured_and_names_the_key_or_option(tmp_path: Path) -> None:
    file = tmp_path / "open.toml"
    file.write_text('[control]\nstart_mode = "open"\n')
    for options, chosen in ((("--config", file), f"control.start_mode of {file}"), (("--open",), "--open")):
        done = lowfc("sim-loop", *options, "--view", "--web")
        assert f"the loop starts open ({chosen}): `lowfc ctl close` closes it" in done.stderr
        assert isinstance(done.exception, ConfigurationError), "--view with --web is refused before a process starts"
    file.write_text(output_of(tmp_path, "lowfc config show"))
    assert "starts open" not in lowfc("sim-loop", "--config", file, "--view", "--web").stderr
