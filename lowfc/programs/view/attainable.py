"""What a loop leaves beside what the best integrator gains would leave of the same disturbance."""

from dataclasses import dataclass

import numpy as np

from lowfc.adapters.history import frame_rate_hz
from lowfc.control.safety import LoopMode
from lowfc.control.spectra import pieces
from lowfc.control.tuning import best_gains
from lowfc.programs.view.moment import Moment
from lowfc.programs.view.steady import Steady

PERIOD_NS = 10_000_000_000
"""A computation takes some 50 ms for 14 modes."""


@dataclass(frozen=True, slots=True)
class Attained:
    """Rms over the circle of all modes of the last frames under one law, nm; the sensor's noise is subtracted.

    Attributes:
        left_nm: what the loop leaves.
        best_nm: what integrators with the best gains would leave, as `lowfc tune` predicts it.
        noise_nm: the sensor's noise in one frame.
    """

    left_nm: float
    best_nm: float
    noise_nm: float


class Attainable:
    """Computes `found` every ten seconds of a closed loop; None while there are too few frames under one law."""

    def __init__(self) -> None:
        self.found: Attained | None = None
        self._steady = Steady()
        self._computed_ns = 0

    def feed(self, moment: Moment) -> None:
        """Add what is new."""
        calibration, steps = moment.calibration, moment.steps
        if calibration is None or not len(steps.error_nm) or steps.error_nm.shape[1] != len(calibration.noll):
            return
        before = self._steady.mode, self._steady.law
        self._steady.feed(moment, len(calibration.noll))
        if before != (self._steady.mode, self._steady.law):
            self.found, self._computed_ns = None, moment.time_ns  # of another law
        if moment.time_ns - self._computed_ns >= PERIOD_NS:
            self._computed_ns = moment.time_ns
            self.found = self._compute(frame_rate_hz(moment.camera, steps))

    def _compute(self, rate_hz: float) -> Attained | None:
        law = self._steady.law
        if law is None or self._steady.mode != LoopMode.CLOSED or not rate_hz:
            return None
        sequence, signals = self._steady.rows()
        modes = len(law.gain)
        try:
            best = best_gains(pieces(sequence, signals[:, modes:]), rate_hz, law.delay_frames, np.array(law.leak))
        except ValueError:
            return None  # too few frames in a row
        error_nm = signals[np.isfinite(signals).all(axis=1), :modes].astype(np.float64)
        noise_nm2 = float(np.sum(best.noise_nm**2))
        left_nm2 = float(np.mean(np.sum(error_nm**2, axis=1))) - noise_nm2
        return Attained(
            float(np.sqrt(max(left_nm2, 0.0))), float(np.linalg.norm(best.predicted_nm)), float(np.sqrt(noise_nm2))
        )
