"""Tolerances of drift and vibration lines, from theory: the largest that add an allowed contrast in a loop.

A mode drifts as a random walk of variance D per frame. The mean over an exposure of e frame periods (e <= 1) is
measured with noise of variance n; a command takes effect at the next frame. Let r be the residual at the start of a
frame, d the drift during the frame, and m the mean over the exposure of the drift since the start of the frame. Then

    r' = r + d - g (r + m + noise),    var d = D, var m = D e / 3, cov(d, m) = D e / 2

with the gain g of an integrator. The variance in continuous time is therefore v = D / 2 + P, where

    P = (D (1 - g e + g^2 e / 3) + g^2 n) / (g (2 - g)),

and at the best gain (P + D e / 2)^2 = D (P + D e / 3 + n), which is the Kalman filter's Riccati equation: for drift
alone no linear law is better than that integrator.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from lowfc.arrays import Array
from lowfc.control.laws.continuous import Timing
from lowfc.control.laws.kalman import lqg
from lowfc.control.laws.linear_law import LinearLaw, integrator
from lowfc.control.laws.margins import noise_gain
from lowfc.control.laws.stability import highest_gain
from lowfc.control.laws.tuning import predicted_nm
from lowfc.control.laws.vibration import Line, Model

Kind = Literal["integrator", "lqg"]
KINDS: tuple[Kind, ...] = ("integrator", "lqg")

DELAY = 1.0
"""Delay of the loop, frames: a command takes effect at the next frame."""
_MIN_DRIFT = 1e-12  # drift in the model of a filter for a line alone, nm^2 per frame
_GAINS = np.geomspace(0.01, 1.0, 30)  # gains of the integrators that are compared
_LINE_RATIOS = np.geomspace(1e-15, 1e10, 76)  # ratios of a line's variance to a frame's noise variance


@dataclass(frozen=True)
class Drift:
    """A drift corrected by an integrator.

    Attributes:
        step_nm2: D, variance of the drift's step from frame to frame.
        gain: Gain of the integrator.
    """

    step_nm2: float
    gain: float


def drift_residual_nm2(step_nm2: float, noise_nm2: float, exposure: float, gain: float) -> float:
    """Variance of the residual of an integrator under a drift, in continuous time."""
    drift_nm2 = step_nm2 * (1.0 - gain * exposure + gain**2 * exposure / 3.0)
    return step_nm2 / 2.0 + (drift_nm2 + gain**2 * noise_nm2) / (gain * (2.0 - gain))


def best_gain(step_nm2: float, noise_nm2: float, exposure: float) -> float:
    """Gain with the least residual, which is the Kalman gain."""
    measurement_nm2 = 2.0 * (step_nm2 * exposure / 3.0 + noise_nm2) - step_nm2 * exposure
    root = np.sqrt(step_nm2**2 + 2.0 * step_nm2 * measurement_nm2)
    return float(2.0 * step_nm2 / (step_nm2 + root))


def tolerated_drift(residual_nm2: float, noise_nm2: float, exposure: float, kind: Kind = "integrator") -> Drift:
    """The fastest drift whose residual does not exceed a variance.

    Args:
        residual_nm2: Allowed variance of the residual.
        noise_nm2: Variance of the noise of a frame.
        exposure: Exposure time, in frame periods.
        kind: "integrator", with a gain limited to the highest within the stability margins, or "lqg".
    """
    # At the best gain the step D solves square D^2 + linear D + residual_nm2^2 = 0.
    square = (exposure - 1.0) ** 2 / 4.0 - exposure / 3.0 + 0.5
    linear = (exposure - 2.0) * residual_nm2 - noise_nm2
    step = 2.0 * residual_nm2**2 / (-linear + np.sqrt(linear**2 - 4.0 * square * residual_nm2**2))
    gain, highest = best_gain(step, noise_nm2, exposure), highest_gain(DELAY)
    if kind == "integrator" and gain > highest:
        from_noise_nm2 = drift_residual_nm2(0.0, noise_nm2, exposure, highest)
        step, gain = (residual_nm2 - from_noise_nm2) / drift_residual_nm2(1.0, 0.0, exposure, highest), highest
    return Drift(float(step), gain)


def tolerated_lines(kind: Kind, line: Line, rate_hz: float, exposure: float) -> Callable[[Array], Array]:
    """Function from the allowed residual variance of a line to its tolerated variance.

    Both variances are divided by the noise variance of a frame.

    Args:
        kind: Integrator with the best gain, or LQG with the line in its model.
        line: Frequency and width of the line.
        rate_hz: Frame rate.
        exposure: Exposure time, in frame periods.
    """
    timing = Timing.of(DELAY, exposure)

    def model(variance: float) -> Model:
        return Model(_MIN_DRIFT, np.inf, (replace(line, variance_nm2=variance),), 1.0, rate_hz)

    def residual(law: LinearLaw, variance: float) -> float:
        return float(predicted_nm(law, [model(variance)], timing)[0] ** 2)

    if kind == "integrator":  # residual = line_factor x line + noise_factor x noise at each gain
        laws = [integrator([gain], [0.0], (2,), DELAY, rate_hz) for gain in np.append(_GAINS, highest_gain(DELAY))]
        noise_factor = np.array([0.0, *(float(noise_gain(law)[0]) for law in laws)])  # the first value: without a loop
        line_factor = np.array([1.0, *(residual(law, 1.0) for law in laws)]) - noise_factor
        return lambda allowed: np.asarray(np.max((allowed[..., None] - noise_factor) / line_factor, axis=-1))

    def filtered(variance: float) -> float:
        return min(residual(lqg([model(variance)], (2,), timing), variance), variance)

    residuals = np.log([filtered(variance) for variance in _LINE_RATIOS.tolist()])
    return lambda allowed: np.asarray(np.exp(np.interp(np.log(allowed), residuals, np.log(_LINE_RATIOS))))


def tolerated_variance(form: float, quartic: float, contrast: float) -> float:
    """Variance, nm^2, of a Gaussian mode that adds this mean contrast; an amplitude a adds form a^2 + quartic a^4."""
    root = np.sqrt(form**2 + 12.0 * max(quartic, 0.0) * contrast)  # the mean of a^4 is three times the variance squared
    return float(2.0 * contrast / (form + root))
