"""Prediction of a simulated run's continuous-time tilt residual, from its disturbance and noise spectra."""

import numpy as np

from lowfc.contract.configuration import Configuration
from lowfc.control.laws.linear_law import integrator
from lowfc.control.laws.stability import highest_gain
from tools.law_bench import calibrated
from tools.laws import theory_mas


def tilt_residual_mas(config: Configuration) -> float:
    """Rms tilt residual per axis of the integrator; from a linear model, valid for residuals of a few mas.

    The spectrum of sine waves, damped lines and wheels is known; a square wave and a static wavefront are left out.
    Photon and read noise propagate through R. For an automatic gain, the highest gain within the margins is used.
    """
    control, delay_frames = config.control, config.camera.delay_frames
    gain = highest_gain(delay_frames) if control.tilt_gain == "auto" else control.tilt_gain
    law = integrator([gain], [control.tilt_leak], (2,), delay_frames, config.camera.rate_hz)
    return float(np.hypot(*theory_mas(config, calibrated(config), law)))
