"""Prediction of a simulated run's continuous-time tilt residual, from its disturbance and noise spectra."""

import numpy as np

from lowfc.adapters.files.factory import frame_noise_nm
from lowfc.contract.configuration import Configuration
from lowfc.control.laws.continuous import Timing, residual_power
from lowfc.control.laws.linear_law import integrator
from lowfc.control.laws.margins import noise_gain
from lowfc.control.laws.stability import highest_gain
from lowfc.optics.detector.photometry import tilt_nm_per_mas
from sim_camera.disturbance import variances_nm2
from sim_camera.driver import disturbance_of
from tools.law_bench import calibrated


def tilt_residual_mas(config: Configuration, delay_frames: float) -> float:
    """Rms tilt residual per axis with this loop delay; from a linear model, valid for residuals of a few mas.

    The spectrum of sine waves, damped lines and wheels is known; a square wave and a static wavefront are left out.
    Photon and read noise propagate through R. For an automatic gain, the highest gain within the margins is used.
    """
    control, disturbance = config.control, disturbance_of(config)
    gain = highest_gain(delay_frames) if control.tilt_gain == "auto" else control.tilt_gain
    law = integrator([gain], [control.tilt_leak], (2,), delay_frames, config.camera.rate_hz)
    timing = Timing.of(delay_frames, config.camera.exposure_fraction)
    frequency_hz, variance_nm2 = variances_nm2(disturbance)
    transmitted = residual_power(law, 2 * np.pi * frequency_hz / config.camera.rate_hz, timing)
    residual_nm2 = np.sum(variance_nm2[:, :2] * transmitted, axis=0)
    noise_nm2 = frame_noise_nm(config, calibrated(config))[:2] ** 2
    total_nm2 = residual_nm2 + noise_nm2 * noise_gain(law)
    return float(np.sqrt(np.mean(total_nm2)) / tilt_nm_per_mas(config.star.diameter_m))
