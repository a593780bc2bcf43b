"""The sensors in the live loop: each closes it, with every mode's sign right; the table in docs/sensors.md."""

from pathlib import Path

import numpy as np
import pytest

from lowfc.adapters.files.layouts import layout_names
from lowfc.adapters.files.sensors import sensor_named
from lowfc.contract.configuration import SENSORS
from lowfc.contract.messages import wire
from lowfc.optics.chain.sensor import light_budget
from tests.support.loops import loop, payloads, run
from tools.measure import measured

DOCS = Path(__file__).parents[2] / "docs"

STATIC_NM = dict(zip(range(2, 16), (12, -9, 8, -7, 6, 5, -5, 4, -4, 3, -3, 3, -3, 3), strict=True))
STILL = f"""
[star]
magnitude = 1
[mirror]
rows = 12
columns = 12
pitches_per_pupil = 11
[control]
gain = 0.2
[disturbance]
preset = "quiet"
static_nm = {{ {", ".join(f'"{noll}" = {nm}' for noll, nm in STATIC_NM.items())} }}
"""


@pytest.mark.parametrize("sensor", ["zwfs", *(pytest.param(one, marks=pytest.mark.slow) for one in ("clowfs", "bar"))])
def test_every_mode_of_a_static_wavefront_is_removed(tmp_path: Path, sensor: str) -> None:
    figures = loop(tmp_path, "--lockstep", "--duration", "0.6", "--sensor", sensor, config=STILL)
    assert figures["frames_published"] == figures["commands_applied"] == 150
    truths = [wire.Truth.FromString(payload) for payload in payloads(figures["log"])["/lowfc/sim/truth"]]
    first, last = truths[0], truths[-50:]
    np.testing.assert_allclose(first.residual_nm[:14], list(STATIC_NM.values()), atol=0.1)
    left_nm = np.mean([truth.residual_nm[:14] for truth in last], axis=0)
    assert np.abs(left_nm).max() < 1.0
    assert np.mean([truth.residual_rms_nm for truth in last]) < 0.15 * first.residual_rms_nm


def test_a_sensor_that_cannot_tell_the_modes_apart_says_so(tmp_path: Path) -> None:
    done = run(tmp_path, "sim-loop", "--duration", "1", "--sensor", "open", config=STILL)
    assert done.returncode == 2
    said = done.stderr.strip().splitlines()
    assert [line.startswith("error: ") for line in said] == [False] * (len(said) - 1) + [True]
    assert "sensor.kind = 'open'" in done.stderr
    assert "cannot tell the modes apart" in done.stderr


def test_the_document_describes_every_sensor_and_layout() -> None:
    document = (DOCS / "sensors.md").read_text()
    assert set(SENSORS) < set(measured("sensors")["sensors"])
    assert all(f"\n| `{name}` |" in document for name in SENSORS)
    assert all(f"`{name}`" in document for name in layout_names())


def test_the_documents_table_is_of_the_sensors_as_they_are() -> None:
    for name, figures in measured("sensors")["sensors"].items():
        budget = light_budget(sensor_named(name))
        assert budget.total == pytest.approx(figures["light"], rel=1e-6), name
        assert budget.peak == pytest.approx(figures["peak"], rel=1e-6), name
