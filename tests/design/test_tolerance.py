"""Tolerated drift and lines: closed forms against the continuous theory, against each other and against simulation."""

import numpy as np
import pytest

from lowfc.contract.sections import SensorSection
from lowfc.control.laws.continuous import Timing, residual_power
from lowfc.control.laws.linear_law import integrator
from lowfc.control.laws.margins import noise_gain
from lowfc.control.laws.stability import highest_gain
from lowfc.control.laws.vibration import Line
from lowfc.design.tolerance import best_gain, drift_residual_nm2, tolerated_drift, tolerated_lines, tolerated_variance
from lowfc.optics.chain.focal_mask import phase_spot
from lowfc.optics.chain.pupil import circle
from lowfc.optics.chain.relay import PupilImage
from lowfc.optics.chain.sensor import Sensor
from lowfc.optics.twin.twin import TwinSpec
from lowfc.optics.twin.twin_build import build
from lowfc.programs.paper.cases import Context, Prepared
from lowfc.programs.paper.tables import tolerance
from lowfc.programs.paper.tables.star_pair import zero_point_nm

EXPOSURE_FRACTION = 0.5


@pytest.mark.parametrize("gain", [0.05, 0.4, 1.0])
def test_residual_of_a_drift_agrees_with_the_continuous_theory(gain):
    law, omega = integrator([gain], [0.0], (2,), 1.0, 250.0), np.geomspace(1e-6, 300 * np.pi, 200_000)
    transmitted = residual_power(law, omega, Timing.of(1.0, EXPOSURE_FRACTION))[:, 0]
    expected = 0.3 * np.trapezoid(transmitted / omega**2, omega) / np.pi + 2.0 * noise_gain(law)[0]
    assert drift_residual_nm2(0.3, 2.0, EXPOSURE_FRACTION, gain) == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("noise_nm2", [1e-3, 0.3, 30.0])
def test_tolerated_drift_leaves_the_allowed_residual_at_the_best_gain(noise_nm2):
    for kind in ("integrator", "lqg"):
        tolerated = tolerated_drift(0.5, noise_nm2, EXPOSURE_FRACTION, kind)
        residual_nm2 = drift_residual_nm2(tolerated.step_nm2, noise_nm2, EXPOSURE_FRACTION, tolerated.gain)
        assert residual_nm2 == pytest.approx(0.5)
    best = best_gain(tolerated.step_nm2, noise_nm2, EXPOSURE_FRACTION)
    assert tolerated.gain == pytest.approx(best)
    assert min(drift_residual_nm2(tolerated.step_nm2, noise_nm2, EXPOSURE_FRACTION, best * f) for f in (0.9, 1.1)) > 0.5


def test_margins_bound_the_gain_of_an_integrator_if_frames_are_exposed_all_the_time():
    bounded, best = (tolerated_drift(0.5, 1e-3, 1.0, kind) for kind in ("integrator", "lqg"))
    assert bounded.gain == highest_gain(1.0) < best.gain
    assert bounded.step_nm2 < best.step_nm2
    assert drift_residual_nm2(bounded.step_nm2, 1e-3, 1.0, bounded.gain) == pytest.approx(0.5)


def test_residual_variance_of_a_slow_loop_is_the_root_of_drift_times_noise():
    """At low gain, a drift D per frame and a noise n leave a residual variance of sqrt(D n) (Kalman and Bucy)."""
    tolerated = tolerated_drift(1.0, 1e4, EXPOSURE_FRACTION)
    assert tolerated.step_nm2 * 1e4 == pytest.approx(1.0, rel=1e-3)


def test_lqg_with_the_line_tolerates_more_than_an_integrator():
    allowed, line = np.geomspace(1e-10, 1e4, 15), Line(10.0, 0.05, 1.0)
    plain, lqg = (tolerated_lines(kind, line, 250.0, EXPOSURE_FRACTION)(allowed) for kind in ("integrator", "lqg"))
    assert (lqg >= plain * 0.999).all()
    assert (plain >= allowed * 0.999).all()  # a line of the allowed variance needs no loop
    assert lqg[10] > 10 * plain[10]
    assert (np.diff(lqg) > 0).all()


def test_quartic_term_limits_a_mode_with_a_small_quadratic_term():
    assert tolerated_variance(2e-12, 0.0, 1e-10) == pytest.approx(50.0)
    variance = tolerated_variance(1e-15, 1e-14, 1e-10)
    # The mean fourth power of a normal amplitude is three times its squared variance.
    assert 1e-15 * variance + 3e-14 * variance**2 == pytest.approx(1e-10)


@pytest.mark.slow
def test_star_colour_does_not_shift_the_zero_point_of_an_aperture_mask():
    assert np.linalg.norm(zero_point_nm("sam")) < 1e-9


@pytest.fixture
def coarse(monkeypatch):
    """Make a Zernike sensor of 16 x 16 pixels the only sensor of the check by simulation."""
    sensor = Sensor(circle(64), phase_spot(samples_per=4), PupilImage(), samples_per=4, pixels=16)
    prepared = Prepared("coarse", SensorSection(), sensor)
    prepared.twin = build(sensor, TwinSpec(nodes=24, order=6, rank=40, guards=4))
    monkeypatch.setattr(tolerance, "prepared", lambda name: prepared)
    monkeypatch.setattr(tolerance, "CHECKED_SENSORS", ("coarse",))
    monkeypatch.setattr(tolerance, "CHECKED_MAGNITUDES", (2.0,))
    monkeypatch.setattr(tolerance, "CHECKED_MODES", (4, 8))


@pytest.mark.usefixtures("coarse")
def test_simulation_of_a_small_sensor_agrees_with_the_closed_form():
    rows = tolerance._checked(Context(trials=30, seed=3))
    assert len(rows) == 2
    for row in rows:
        assert row.error < 0.06 * row.predicted
        assert row.measured == pytest.approx(row.predicted, abs=4 * row.error), row


@pytest.mark.slow
def test_simulation_agrees_with_the_closed_form():
    rows = tolerance._checked(Context(trials=100, seed=3))
    assert len(rows) == 12
    for row in rows:
        assert row.measured == pytest.approx(row.predicted, rel=0.1), row
