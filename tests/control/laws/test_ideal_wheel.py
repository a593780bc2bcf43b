"""The ideal wheel, lines without a width: what laws leave at every moment, and what an instant of a frame hides."""

from typing import Any

import numpy as np
import pytest

from lowfc.contract.configuration import Configuration
from lowfc.contract.envelope import count_of
from lowfc.control.laws.continuous import Timing
from lowfc.control.laws.spectra import Pieces
from lowfc.control.laws.stability import highest_gain
from lowfc.control.laws.tuning import best_gains, identified, tune_lqg
from sim_camera.disturbance import Sampler
from sim_camera.driver import disturbance_of
from tools.law_bench import Bench, calibrated, configured

IDENTIFY, SETTLE, MEASURE = 16_000, 8_000, 8_000

pytestmark = pytest.mark.slow


def wheel(**keys: Any) -> tuple[Configuration, Bench]:
    """Its loop, closed by an integrator: tip and tilt alone."""
    config = configured(**{"disturbance.preset": "reaction-wheel-ideal", "sensor.modes": 2, **keys})
    bench = Bench(config, calibrated(config))
    bench.ask("gain", modes=(2, 3), values=(min(highest_gain(config.camera.delay_frames), 1.11),))
    bench.settle(1000)
    return config, bench


def left_mas(bench: Bench, run: Pieces, timing: Timing, *, continuous: bool = True) -> float:
    """At every moment, or where exposures start, under the law that is tuned from a run for a timing."""
    rate_hz, none = bench.config.camera.rate_hz, np.zeros(2)
    gains = best_gains(run, rate_hz, timing, none)
    bench.load(tune_lqg(run, identified(run, rate_hz), gains, (2, 3), none, timing).law)
    bench.forget()
    bench.run(SETTLE + MEASURE)
    return bench.tilt_mas(MEASURE, continuous=continuous)


def between_mas(bench: Bench) -> float:
    """At every moment of the last frames, from the commands, where the camera simulates one instant of each frame."""
    sampler = Sampler(disturbance_of(bench.config), (np.arange(8) + 0.5) / 8, bench.config.camera.rate_hz)
    counts = [count_of(step.frame_sequence) for step in bench.steps[-MEASURE:]]
    disturbance_nm = np.array([sampler.at(count) for count in counts[1:]], float)
    command_nm = np.array([step.command_nm for step in bench.steps[-MEASURE:-1]], float)
    return float(np.sqrt(np.square(disturbance_nm + command_nm[:, None]).mean()) / bench.nm_per_mas)


def test_an_image_of_an_instant_hides_what_the_star_does_after_it() -> None:
    """Of an integrator, and of the law that nulls the instants."""
    _, bench = wheel(**{"camera.instants": 1})
    bench.run(IDENTIFY)
    assert bench.tilt_mas(MEASURE, continuous=False) == pytest.approx(2.3, rel=0.03)
    assert between_mas(bench) == pytest.approx(3.55, rel=0.03)
    at_instants_mas = left_mas(bench, bench.pol(), Timing.sampled(1.0), continuous=False)
    assert at_instants_mas < 0.1
    assert between_mas(bench) == pytest.approx(1.44, rel=0.03)


def test_a_blurred_image_and_the_mean_over_the_commands_period_nulled() -> None:
    """As a law would have it that nulls the next exposure's mean, and as `lowfc tune` makes it."""
    _, bench = wheel()
    bench.run(IDENTIFY)
    run = bench.pol()
    assert bench.tilt_mas(IDENTIFY) == pytest.approx(2.97, rel=0.03)
    assert left_mas(bench, run, Timing(1.0, 1.0, 0.5, 0.5)) == pytest.approx(0.955, rel=0.03)
    assert left_mas(bench, run, Timing.of(1.0, 0.5)) == pytest.approx(0.73, rel=0.03)


def test_two_frames_of_delay() -> None:
    _, bench = wheel(**{"camera.delay_frames": 2.0})
    bench.run(MEASURE)
    assert bench.tilt_mas(MEASURE) == pytest.approx(6.55, rel=0.03)


def test_at_4_khz_hardly_anything_is_left() -> None:
    config, bench = wheel(**{"camera.rate_hz": 4000.0})
    bench.run(2 * IDENTIFY)
    assert left_mas(bench, bench.pol(), Timing.of(1.0, config.camera.exposure_fraction)) < 0.22
