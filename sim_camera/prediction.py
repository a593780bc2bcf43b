"""What the control theory says that a simulated run must leave: |S|^2 P_d + |T|^2 P_n."""

import numpy as np

from lowfc.adapters import instrument
from lowfc.contract.configuration import Configuration
from lowfc.control.stability import noise_gain, rejection
from lowfc.optics.photometry import tilt_nm_per_mas
from sim_camera.process import disturbance_of, ignore


def tilt_residual_mas(config: Configuration, delay_frames: float) -> float:
    """Rms of tip and tilt per axis, for a loop closed with a delay; linear, so for residuals of a few mas only.

    The disturbance's sine waves are known exactly; photon and read noise come through R.
    """
    control, rate_hz = config.control, config.camera.rate_hz
    shaken = disturbance_of(config)
    rejected = rejection(shaken.frequency_hz, rate_hz, control.tilt_gain, control.tilt_leak, delay_frames)
    waves = np.sum(np.abs(shaken.amplitude_nm[:, :2]) ** 2 / 2 * rejected[:, None] ** 2, axis=0)
    optics = instrument.twin(config, None, ignore)
    calibration = instrument.analytic_calibration(config, optics, instrument.mirror_on_twin(config, optics, ignore))
    noise = instrument.frame_noise_nm(config, calibration)[:2] ** 2
    through = noise_gain(control.tilt_gain, control.tilt_leak, delay_frames)
    return float(np.sqrt(np.mean(waves + noise * through)) / tilt_nm_per_mas(config.star.diameter_m))
