"""What the open loop says the closed one will leave, and what it leaves."""

from collections.abc import Sequence

import numpy as np

from lowfc.arrays import Array, Sequences, Single
from lowfc.control.laws.law import Law
from lowfc.control.laws.stability import delay_weights, settling_frames
from lowfc.control.laws.what_if import as_logged, counterfactual, missing_before, rms
from lowfc.control.loop.inputs import Step


def predicted_nm(steps: Sequence[Step], law: Law, delay_frames: float, rate_hz: float) -> Array:
    """Measured modal error (modes,), nm rms, that this law would have left of the disturbance in some steps.

    Its noise is in it, as it is in the measured one.

    Raises:
        ValueError: there are too few steps.
    """
    sequence, pol_nm = _rows(steps, [step.pol_nm for step in steps])
    weights = delay_weights(max(delay_frames, 1.0)).astype(np.float32)
    error_nm, _ = counterfactual(as_logged(law), weights, pol_nm, missing_before(sequence))
    return _rms(error_nm, settling_frames(law.gain, law.leak, rate_hz))


def measured_nm(steps: Sequence[Step], law: Law, rate_hz: float) -> Array:
    """Measured modal error (modes,), nm rms, of steps that begin when the loop is closed.

    Raises:
        ValueError: there are too few steps.
    """
    _, error_nm = _rows(steps, [step.error_nm for step in steps])
    return _rms(error_nm, settling_frames(law.gain, law.leak, rate_hz))


def _rows(steps: Sequence[Step], values: Sequence[Single | None]) -> tuple[Sequences, Single]:
    modes = max((value.size for value in values if value is not None), default=0)
    if not modes:
        raise ValueError("no frame was used")
    rows = [np.full(modes, np.nan, np.float32) if value is None else value for value in values]
    return np.array([step.frame_sequence for step in steps], np.uint64), np.array(rows)


def _rms(error_nm: Single, settling: int) -> Array:
    used = np.isfinite(error_nm).all(axis=1) & (np.arange(len(error_nm)) >= settling)
    if used.sum() < settling:
        raise ValueError(f"{int(used.sum())} frames after {settling} of settling are too few to tell a residual")
    return rms(error_nm, used)
