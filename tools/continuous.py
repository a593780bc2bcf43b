"""Theoretical continuous-time residual of the wheel's five lines under each law: a table of docs/howto/tuning.md."""

from dataclasses import replace

import numpy as np

from lowfc.control.laws.continuous import Timing, hold_floor, residual_power
from lowfc.control.laws.kalman import lqg
from lowfc.control.laws.linear_law import LinearLaw, integrator
from lowfc.control.laws.stability import highest_gain
from lowfc.control.laws.vibration import Line, Model
from lowfc.control.loop.wording import counted
from sim_camera.disturbance import LINES_HZ, LINES_MAS
from tools.shared import markdown

RATE_HZ = 1000.0
_OMEGA = 2 * np.pi * np.array(LINES_HZ) / RATE_HZ
_NO_WIDTH_HZ, _NO_NOISE_NM2, _NO_DRIFT_NM2 = 1e-6, 1e-6, 1e-9
_LINES = tuple(Line(hz, _NO_WIDTH_HZ, mas**2) for hz, mas in zip(LINES_HZ, LINES_MAS, strict=True))
WHEEL = Model(_NO_DRIFT_NM2, np.inf, _LINES, _NO_NOISE_NM2, RATE_HZ)
"""Model of the five lines alone; where a model has nm, this one has mas."""
_CASES = (Timing.of(1, 0.5), Timing.of(1, 0.9), Timing.of(2, 0.5))


def table() -> str:
    """A row for each law, a column for each timing; residuals in mas rms per axis."""
    laws = {
        "integrator, highest gain": [
            integrator([highest_gain(timing.delay)], [0.0], (2,), timing.delay, RATE_HZ) for timing in _CASES
        ],
        "Kalman filter that nulls one instant": [kalman(timing, timing.applied, 0.0) for timing in _CASES],
        "Kalman filter that nulls the mean of the next exposure": [
            kalman(timing, timing.applied, timing.exposure) for timing in _CASES
        ],
        "Kalman filter that nulls the mean over the command's period (`lqg`)": [
            kalman(timing, timing.applied, timing.held) for timing in _CASES
        ],
    }
    rows = [
        (name, *(f"{residual_mas(law, timing):.3f}" for law, timing in zip(by_timing, _CASES, strict=True)))
        for name, by_timing in laws.items()
    ]
    rows.append(("lower bound for a command held for a period", *(f"{floor_mas():.3f}" for _ in _CASES)))
    head = f"law; continuous-time residual, mas rms per axis, of a disturbance of {np.linalg.norm(LINES_MAS):.3g} mas"
    cases = (f"delay {counted(t.delay, 'frame')}, exposure {t.exposure:g} of the period" for t in _CASES)
    return markdown((head, *cases), rows)


def kalman(timing: Timing, start: float, length: float) -> LinearLaw:
    """Kalman filter of the exact lines; its command nulls the mean error from `start` to `start + length` (periods)."""
    predicted_mean = WHEEL.mean_over(start, length) @ np.linalg.inv(WHEEL.mean_over(0.0, timing.exposure))
    return replace(lqg([WHEEL], (2,), timing), output=(-WHEEL.states()[2] @ predicted_mean)[None].astype(np.float32))


def floor_mas() -> float:
    """Least residual of the lines with a command that is held for a period, mas rms."""
    return float(np.sqrt(np.square(LINES_MAS) @ hold_floor(_OMEGA)))


def residual_mas(law: LinearLaw, timing: Timing) -> float:
    """Residual of the lines under a law, mas rms."""
    return float(np.sqrt(np.square(LINES_MAS) @ residual_power(law, _OMEGA, timing)[:, 0]))
