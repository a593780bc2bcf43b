"""LQG laws for damped lines: their residual compared with that of the best law within the margins; their margins."""

import numpy as np
import pytest
import scipy

from lowfc.adapters.files.factory import frame_noise_nm
from lowfc.arrays import Array
from lowfc.contract.configuration import Configuration
from lowfc.control.laws.continuous import Timing
from lowfc.control.laws.kalman import lqg_block
from lowfc.control.laws.linear_law import LinearLaw, law_from_blocks
from lowfc.control.laws.margins import margins
from lowfc.control.laws.spectra import TimeSeries
from lowfc.control.laws.stability import MIN_GAIN_MARGIN, MIN_PHASE_MARGIN_DEG
from lowfc.control.laws.tuning import within_margins
from lowfc.control.laws.vibration import Line, Model
from sim_camera.disturbance import LINES_HZ, LINES_MAS, Sampler
from sim_camera.driver import disturbance_of
from sim_camera.scene import GAUSS_LEGENDRE
from tests.support.theory import one_piece
from tools import laws
from tools.law_bench import RATE_HZ, Bench, calibrated, configured, tuned

WIDTHS, DELAYS, FRAMES = (0.001, 0.005, 0.02), (1.0, 2.0), 16_000  # widths relative to the lines' frequencies


def tilts_of(config: Configuration, noise_nm: Array, frames: int = FRAMES) -> TimeSeries:
    """Pseudo-open-loop tilts (frames, 2) as the sensor would measure them: means over exposures, with white noise."""
    instants = config.camera.exposure_fraction * GAUSS_LEGENDRE
    sampler = Sampler(disturbance_of(config), instants, RATE_HZ)
    exposure_nm = np.array([sampler.at(index)[:, :2].mean(axis=0) for index in range(frames)], np.float64)
    noise = np.random.default_rng([config.seed, 5]).standard_normal((frames, 2))
    return one_piece(exposure_nm + noise_nm * noise)


@pytest.mark.slow
def test_an_identified_law_is_nearly_optimal() -> None:
    """At this noise level even the best law without a limit on margins keeps them."""
    config = configured()
    calibration = calibrated(config)
    law = tuned(tilts_of(config, frame_noise_nm(config, calibration)[:2], 8000), config)["lqg"].law
    assert np.hypot(*laws.theory_mas(config, calibration, law)) < 1.05 * laws.optimum_mas(config, calibration)


@pytest.mark.slow
@pytest.mark.parametrize("delay", DELAYS)
@pytest.mark.parametrize("magnitude", [0.0, 2.0, 5.0])
@pytest.mark.parametrize("width", WIDTHS)
def test_identified_laws_are_nearly_optimal_within_the_margins(width: float, magnitude: float, delay: float) -> None:
    """Laws are identified from modes, not images; `test_laws_from_modes_agree_with_laws_from_images` compares both."""
    keys = {"star.magnitude": magnitude, "disturbance.line_width": width}
    config = configured(delay_frames=delay, **keys)
    calibration = calibrated(config)
    best_mas = laws.optimum_mas(config, calibration, robust=True)
    assert laws.optimum_mas(config, calibration) <= 1.001 * best_mas
    for seed in range(1, 11):
        config_of_seed = configured(delay_frames=delay, seed=seed, **keys)
        noise_nm = frame_noise_nm(config_of_seed, calibration)[:2]
        law = tuned(tilts_of(config_of_seed, noise_nm), config_of_seed)["lqg"].law
        assert np.hypot(*laws.theory_mas(config_of_seed, calibration, law)) < 1.06 * best_mas


@pytest.mark.parametrize("noise_nm", [0.05, 2.0])
@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("delay", DELAYS)
def test_a_filter_keeps_the_margins_at_any_noise(noise_nm: float, width: float, delay: float) -> None:
    """With less noise a filter has more gain and smaller margins, so the tuning overestimates the noise as needed."""
    timing = Timing.of(delay, 0.5)
    exact = tuple(Line(hz, width * hz, (2.4 * mas) ** 2) for hz, mas in zip(LINES_HZ, LINES_MAS, strict=True))
    model = Model(0.02, 2.0, exact, noise_nm**2, RATE_HZ)
    blocks = within_margins(model, timing), lqg_block(model, timing)
    law, unconstrained = (law_from_blocks([block], "pol", "lqg", (2,), delay, RATE_HZ) for block in blocks)

    def margin_ratio(filter_: LinearLaw) -> float:
        """Smallest ratio of a margin to its limit; for filters the limit of the phase margin is 0.7 times as large."""
        found = margins(filter_, delay)
        gain = min(found.gain_margin[0], 1 / max(found.gain_reduction[0], 1e-9)) / MIN_GAIN_MARGIN
        return float(min(gain, found.phase_margin_deg[0] / (0.7 * MIN_PHASE_MARGIN_DEG)))

    assert margin_ratio(law) >= 1
    assert margin_ratio(law) < 1.1 or margin_ratio(law) == margin_ratio(unconstrained)


@pytest.mark.slow
def test_laws_from_modes_agree_with_laws_from_images() -> None:
    """Modes from images and modes without images give the same noise level above the lines and nearly the same laws.

    The identified noise is lower than a frame's: the model of a line has wings up to half the rate, while those of the
    simulated lines end earlier.
    """
    config = configured()
    calibration = calibrated(config)
    bench = Bench(config, calibration)
    bench.settle(1000)
    bench.run(FRAMES)
    noise_nm = frame_noise_nm(config, calibration)[:2]
    tuned_laws = []
    for pol in (one_piece(bench.pol().values[0][:, :2]), tilts_of(config, noise_nm)):
        frequency_hz, density = scipy.signal.welch(pol.values[0], RATE_HZ, nperseg=2000, axis=0)
        level_nm = np.sqrt(density[(frequency_hz > 400) & (frequency_hz < 490)].mean(axis=0) * RATE_HZ / 2)
        np.testing.assert_allclose(level_nm, noise_nm, rtol=0.1)
        tuned_laws.append(tuned(pol, config)["lqg"])
    identified_nm = [np.sqrt([model.noise_nm2 for model in tuned_law.models]) for tuned_law in tuned_laws]
    np.testing.assert_allclose(*identified_nm, rtol=0.1)
    assert (np.array(identified_nm) < noise_nm).all()
    residual_mas = [float(np.hypot(*laws.theory_mas(config, calibration, tuned_law.law))) for tuned_law in tuned_laws]
    assert residual_mas[0] == pytest.approx(residual_mas[1], rel=0.03)
