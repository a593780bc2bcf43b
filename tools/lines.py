"""LQG for damped lines of several widths, and the best law within the margins."""

from typing import Any

import numpy as np

from lowfc.adapters.files.factory import frame_noise_nm
from lowfc.contract.configuration import Configuration
from lowfc.control.laws.spectra import TimeSeries
from sim_camera.disturbance import Sampler
from sim_camera.driver import disturbance_of
from sim_camera.scene import GAUSS_LEGENDRE
from tools.law_bench import RATE_HZ, calibrated, configured, tuned
from tools.laws import optimum_mas, theory_mas
from tools.shared import Results

WIDTHS, MAGNITUDES, DELAYS, SEEDS = (0.001, 0.005, 0.02), (0.0, 2.0, 5.0), (1.0, 2.0), 10
FRAMES = 16_000


def case(width: float, magnitude: float, delay: float, seeds: int = SEEDS) -> Results:
    """Theoretical residuals of laws for lines of this relative width, mas rms per axis.

    Laws are identified without images, from means over the exposures with the noise of the twin's images
    (`tests/control/laws/test_lines.py` compares both).
    """
    keys: dict[str, Any] = {"star.magnitude": magnitude, "disturbance.line_width": width}
    config = configured(delay_frames=delay, **keys)
    calibration = calibrated(config)
    residual_mas = []
    for seed in range(1, 1 + seeds):
        own = configured(delay_frames=delay, seed=seed, **keys)
        law = tuned(tilts_of(own, frame_noise_nm(own, calibration)[:2], FRAMES), own)["lqg"].law
        residual_mas.append(float(np.hypot(*theory_mas(own, calibration, law))))
    return {
        "width": width,
        "magnitude": magnitude,
        "delay_frames": delay,
        "identified_mas": residual_mas,
        "best_within_margins_mas": optimum_mas(config, calibration, robust=True),
        "optimum_mas": optimum_mas(config, calibration),
    }


def tilts_of(config: Configuration, noise_nm: Any, frames: int) -> TimeSeries:
    """Pseudo-open-loop tilts (frames, 2) as the sensor would measure them: means over exposures, with white noise."""
    instants = config.camera.exposure_fraction * GAUSS_LEGENDRE
    sampler = Sampler(disturbance_of(config), instants, RATE_HZ)
    exposure_nm = np.array([sampler.at(index)[:, :2].mean(axis=0) for index in range(frames)], np.float64)
    noise = np.random.default_rng([config.seed, 5]).standard_normal((frames, 2))
    return TimeSeries((exposure_nm + noise_nm * noise,), 0)
