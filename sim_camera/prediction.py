"""Residual over all time predicted by control theory for a simulated run, from its disturbance and noise."""

import numpy as np

from lowfc.adapters.files import factory
from lowfc.contract.configuration import Configuration
from lowfc.control.laws.continuous import Timing, residual_power
from lowfc.control.laws.linear_law import integrator
from lowfc.control.laws.margins import noise_gain
from lowfc.control.laws.stability import highest_gain
from lowfc.optics.detector.photometry import tilt_nm_per_mas
from sim_camera.disturbance import variances_nm2
from sim_camera.driver import disturbance_of, ignore


def tilt_residual_mas(config: Configuration, delay_frames: float) -> float:
    """Rms of tip and tilt per axis, for a loop closed with a delay; linear, so for residuals of a few mas only.

    The disturbance's sine waves are known exactly; photon and read noise come through R. An automatic gain is taken to
    be the highest.
    """
    control, shaken = config.control, disturbance_of(config)
    gain = highest_gain(delay_frames) if control.tilt_gain == "auto" else control.tilt_gain
    law = integrator([gain], [control.tilt_leak], (2,), delay_frames, config.camera.rate_hz)
    timing = Timing.of(delay_frames, config.camera.exposure_fraction)
    frequency_hz, variance_nm2 = variances_nm2(shaken)
    left = residual_power(law, 2 * np.pi * frequency_hz / config.camera.rate_hz, timing)
    waves = np.sum(variance_nm2[:, :2] * left, axis=0)
    optics = factory.twin(config, None, ignore)
    calibration = factory.analytic_calibration(config, optics, factory.mirror_on_twin(config, optics, ignore))
    noise = factory.frame_noise_nm(config, calibration)[:2] ** 2
    return float(np.sqrt(np.mean(waves + noise * noise_gain(law))) / tilt_nm_per_mas(config.star.diameter_m))
