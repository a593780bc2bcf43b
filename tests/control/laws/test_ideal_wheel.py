"""Residual of laws under the ideal reaction wheel (lines without width), in continuous time and at instants."""

from typing import Any

import numpy as np
import pytest

from lowfc.contract.configuration import Configuration
from lowfc.contract.envelope import count_of
from lowfc.control.laws.continuous import Timing
from lowfc.control.laws.spectra import TimeSeries
from lowfc.control.laws.stability import highest_gain
from sim_camera.disturbance import Sampler
from sim_camera.driver import disturbance_of
from tools.law_bench import Bench, calibrated, configured, tuned

IDENTIFY, SETTLE, MEASURE = 16_000, 8_000, 8_000  # frames

pytestmark = pytest.mark.slow


def wheel(**keys: Any) -> tuple[Configuration, Bench]:
    """Configuration and loop of the ideal wheel, closed by an integrator: tip and tilt only."""
    config = configured(**{"disturbance.preset": "reaction-wheel-ideal", "sensor.modes": 2, **keys})
    bench = Bench(config, calibrated(config))
    bench.ask("gain", modes=(2, 3), values=(min(highest_gain(config.camera.delay_frames), 1.11),))
    bench.settle(1000)
    return config, bench


def residual_mas(bench: Bench, series: TimeSeries, timing: Timing, *, continuous: bool = True) -> float:
    """Residual, mas, of the law tuned from `series` for a timing: over all time, or only at starts of exposures."""
    bench.ask("law", law=tuned(series, bench.config, timing=timing)["lqg"].law)
    bench.new_record()
    bench.run(SETTLE + MEASURE)
    return bench.tilt_mas(MEASURE, continuous=continuous)


def residual_between_instants_mas(bench: Bench) -> float:
    """Continuous-time residual, mas, in the last frames, from the commands of a loop with a camera of one instant."""
    sampler = Sampler(disturbance_of(bench.config), (np.arange(8) + 0.5) / 8, bench.config.camera.rate_hz)
    counts = [count_of(step.frame_sequence) for step in bench.steps[-MEASURE:]]
    disturbance_nm = np.array([sampler.at(count) for count in counts[1:]], float)
    command_nm = np.array([step.command_nm for step in bench.steps[-MEASURE:-1]], float)
    return float(np.sqrt(np.square(disturbance_nm + command_nm[:, None]).mean()) / bench.nm_per_mas)


def test_an_image_of_one_instant_hides_the_residual_between_instants() -> None:
    """The loop is driven by an integrator, then by the law that nulls the residual at the instants."""
    _, bench = wheel(**{"camera.instants": 1})
    bench.run(IDENTIFY)
    assert bench.tilt_mas(MEASURE, continuous=False) == pytest.approx(2.3, rel=0.03)
    assert residual_between_instants_mas(bench) == pytest.approx(3.55, rel=0.03)
    at_instants_mas = residual_mas(bench, bench.pol(), Timing.sampled(1.0), continuous=False)
    assert at_instants_mas < 0.1
    assert residual_between_instants_mas(bench) == pytest.approx(1.44, rel=0.03)


def test_the_best_law_nulls_the_mean_over_the_period_of_its_command() -> None:
    """The law of `lowfc tune` leaves less than a law that nulls the mean over the next exposure."""
    _, bench = wheel()
    bench.run(IDENTIFY)
    series = bench.pol()
    assert bench.tilt_mas(IDENTIFY) == pytest.approx(2.97, rel=0.03)
    assert residual_mas(bench, series, Timing(1.0, 1.0, 0.5, 0.5)) == pytest.approx(0.955, rel=0.03)
    assert residual_mas(bench, series, Timing.of(1.0, 0.5)) == pytest.approx(0.73, rel=0.03)


def test_the_integrator_with_two_frames_of_delay_leaves_6_55_mas() -> None:
    _, bench = wheel(**{"camera.delay_frames": 2.0})
    bench.run(MEASURE)
    assert bench.tilt_mas(MEASURE) == pytest.approx(6.55, rel=0.03)


def test_lqg_at_4_khz_leaves_less_than_0_22_mas() -> None:
    config, bench = wheel(**{"camera.rate_hz": 4000.0})
    bench.run(2 * IDENTIFY)
    assert residual_mas(bench, bench.pol(), Timing.of(1.0, config.camera.exposure_fraction)) < 0.22
