"""The last frames under one loop mode and control law, and their residual compared with that of the best gains."""

from collections import deque
from typing import NamedTuple

import numpy as np

from lowfc.adapters.logs.columns import exposure_fraction
from lowfc.arrays import Sequences, Single
from lowfc.contract.codecs.law_codec import overruled
from lowfc.contract.messages import wire
from lowfc.control.laws.continuous import Timing
from lowfc.control.laws.spectra import time_series
from lowfc.control.laws.stability import settling_frames
from lowfc.control.loop.safety import LoopMode
from lowfc.programs.view.snapshot import Snapshot

FRAMES = 6144
"""Frames kept, for spectra of eleven half-overlapping segments of 1024 frames."""


class LawInForce(NamedTuple):
    """The integrator, and `linear`: identity and overruled modes of the law that replaces it; empty without a law."""

    gain: tuple[float, ...]
    leak: tuple[float, ...]
    delay_frames: float
    linear: str


class SteadyFrames:
    """Measured error and pseudo-open-loop of the last frames since loop mode or law changed, after settling.

    `mode` is 0 before the first step; `law` is None if the controller has reported no valid gains for these modes.
    """

    def __init__(self) -> None:
        self.mode = 0
        self.law: LawInForce | None = None
        self._settling = 0
        self._kept: deque[tuple[Sequences, Single]] = deque()

    def feed(self, snapshot: Snapshot) -> bool:
        """Add the steps of a snapshot; False if no step of it has the modes of its calibration."""
        steps, calibration = snapshot.steps, snapshot.calibration
        if calibration is None or not len(steps.error_nm) or steps.error_nm.shape[1] != len(calibration.noll):
            return False
        law = _law_of(snapshot.controller, len(calibration.noll))
        changes = np.flatnonzero(np.diff(steps.mode.astype(int), prepend=self.mode))
        first = int(changes[-1]) if changes.size else 0
        if changes.size or law != self.law:
            self._kept.clear()
            self.mode, self.law = int(steps.mode[-1]), law
            self._settling = 0
            if law is not None and self.mode == LoopMode.CLOSED:
                self._settling = min(settling_frames(np.array(law.gain), np.array(law.leak)), FRAMES)
        signals = np.concatenate([steps.error_nm, steps.pol_nm], axis=1)
        excluded = min(self._settling, len(signals) - first)
        self._settling -= excluded
        self._kept.append((steps.sequence[first + excluded :], signals[first + excluded :]))
        frames = sum(len(sequence) for sequence, _ in self._kept)
        while frames - len(self._kept[0][0]) >= FRAMES:
            frames -= len(self._kept.popleft()[0])
        return True

    def rows(self) -> tuple[Sequences, Single]:
        """Sequence of each frame; error and pseudo-open-loop (frames, 2 x modes). Only after `feed` returned True."""
        sequence, signals = (np.concatenate(column) for column in zip(*self._kept, strict=True))
        return sequence, signals


class ResidualComparison(NamedTuple):
    """Residual of a law, and of integrators with the best gains: rms of all modes without noise, nm.

    `noise_nm` is the sensor's noise in one frame.
    """

    residual_nm: float
    best_nm: float
    noise_nm: float


def compare_with_best_gains(
    steady: SteadyFrames, rate_hz: float, camera: wire.CameraState | None
) -> ResidualComparison | None:
    """Compare residuals; None if the loop is not closed, its law is unknown, or too few frames follow each other."""
    law, modes = steady.law, len(steady.law.gain) if steady.law is not None else 0
    if law is None or steady.mode != LoopMode.CLOSED or not rate_hz:
        return None
    from lowfc.control.laws.tuning import best_gains  # scipy's import takes as long as that of the rest of a view

    sequence, signals = steady.rows()
    try:
        timing = Timing.of(law.delay_frames, exposure_fraction(camera) or 0.0)
        best = best_gains(time_series(sequence, signals[:, modes:]), rate_hz, timing, np.array(law.leak))
    except ValueError:
        return None  # too few frames in a row
    error_nm = signals[np.isfinite(signals).all(axis=1), :modes].astype(np.float64)
    noise_nm2 = float(np.sum(best.noise_nm**2))
    residual_nm2 = max(float(np.mean(np.sum(error_nm**2, axis=1))) - noise_nm2, 0.0)
    return ResidualComparison(residual_nm2**0.5, float(np.linalg.norm(best.sensed_nm)), noise_nm2**0.5)


def _law_of(state: wire.ControllerState | None, modes: int) -> LawInForce | None:
    if state is None or not len(state.gain) == len(state.leak) == modes or not state.delay_frames >= 1:
        return None
    linear = " ".join((state.law.id or state.law.name, *overruled(state))) if state.HasField("law") else ""
    return LawInForce(tuple(state.gain), tuple(state.leak), state.delay_frames, linear)
