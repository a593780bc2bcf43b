"""Residual wavefront: rms of each mode, and of tip and tilt on the sky."""

from itertools import groupby, pairwise

import numpy as np

from lowfc.adapters.files.factory import contrast_or_none
from lowfc.adapters.logs.columns import TruthRows, Truths
from lowfc.arrays import Array, Integers, Single
from lowfc.contract.configuration import Configuration
from lowfc.control.loop.safety import LoopMode
from lowfc.optics.chain.zernike import mode_name
from lowfc.optics.detector.photometry import tilt_nm_per_mas
from lowfc.programs.cli.contrast import added_contrast, with_variances
from lowfc.programs.cli.status import holds_shape
from lowfc.programs.logs.report.closed_loop import Stretch, noise_of
from lowfc.programs.logs.report.source import Results, Run, row_after


def residual_results(run: Run, stretch: Stretch | None) -> Results:
    """Rms in nm of each mode and signal, and of tip and tilt per axis in mas; None for signals not in the log.

    Closed-loop values are over the longest stretch under one law, after settling; open-loop values are over all
    open-loop steps under the last calibration. Without a closed stretch, the disturbance over the open pupil and the
    added contrast are over the open-loop steps.
    """
    history = run.history
    steps = history.steps
    opened = np.flatnonzero((steps.mode == LoopMode.OPEN) & history.under_calibration)
    rows = stretch.rows if stretch is not None else slice(0, steps.sequence.size)
    closed = np.arange(steps.sequence.size)[rows] if stretch is not None else opened[:0]
    closed_or_open = closed if closed.size else opened
    noll = history.calibration.noll if history.calibration is not None else ()
    true = history.true or TruthRows(0).values()
    values = {
        "open_error": _rms(steps.error_nm, opened),
        "open_residual": _rms(true.modes_residual_rms_nm, opened),
        "pseudo_open_loop": _rms(steps.pol_nm, closed),
        "disturbance": _rms(true.modes_disturbance_rms_nm, closed),
        "error": _rms(steps.error_nm, closed),
        "residual": _rms(true.modes_residual_rms_nm, closed),
        "sampled_residual": _rms(true.residual_nm, closed),
    }
    noise = noise_of(history, rows)
    modes = [
        {
            "noll": index,
            "name": mode_name(index),
            **{f"{signal}_rms_nm": _at(found, k) for signal, found in values.items()},
            "frame_noise_nm": float(noise.total_nm[k]) if noise is not None else None,
        }
        for k, index in enumerate(noll)
    ]
    open_pupil = {
        f"{name}_open_pupil_rms_nm": _at(_rms(column[:, None], chosen), 0)
        for name, column, chosen in (
            ("disturbance", true.disturbance_rms_nm, closed_or_open),
            ("residual", true.residual_rms_nm, closed),
            ("sampled_residual", true.sampled_residual_rms_nm, closed),
        )
    }
    return {
        "modes": modes,
        "added_contrast": _contrast(true, closed_or_open, history.configuration),
        "tilt_mas": {signal: _tilt_mas(found, noll, history.configuration) for signal, found in values.items()},
        "total_rms_nm": {
            signal: float(np.sqrt(np.sum(found**2))) if found is not None else None for signal, found in values.items()
        },
        "open_pupil": open_pupil,
        "truth": "none" if history.true is None else "continuous" if true.continuous else "sampled only",
        "shaped": history.true is not None and _shaped_in(run, rows),
        "steps_open": int(opened.size),
        "steps_closed": int(closed.size),
    }


def binned_rms(run: Run) -> dict[str, Array]:
    """Rms of all modes in nm before and after correction, in at most 300 bins; `time_s` is the start of a bin."""
    steps, true = run.history.steps, run.history.true
    columns = {"pseudo_open_loop": steps.pol_nm, "error": steps.error_nm}
    if true is not None:
        columns |= {"disturbance": true.modes_disturbance_rms_nm, "residual": true.modes_residual_rms_nm}
    starts = bin_starts(steps.sequence.size, 300)
    found = {"time_s": run.step_s[starts]}
    for name, column in columns.items():
        if column.size:
            squares = np.sum(column.astype(float) ** 2, axis=1)
            finite = np.isfinite(squares)
            counts = np.add.reduceat(finite, starts, dtype=float)
            sums = np.add.reduceat(np.where(finite, squares, 0.0), starts)
            found[name] = np.sqrt(np.divide(sums, counts, out=np.full_like(sums, np.nan), where=counts > 0))
    return found


def bin_starts(rows: int, max_bins: int) -> Integers:
    """First row of each bin: at most `max_bins` bins of equal numbers of rows, only the last may have fewer."""
    return np.arange(0, rows, max(1, -(-rows // max_bins)))


def _shaped_in(run: Run, rows: slice) -> bool:
    """Whether an offset or a shape of a channel was in force in some of these steps."""
    changes = [next(states) for _, states in groupby(run.history.controllers, holds_shape)]
    firsts = [row_after(run.history, state.frame_sequence, state.timestamp) for state in changes]
    return any(
        holds_shape(state) and first < rows.stop and rows.start < end
        for state, (first, end) in zip(changes, pairwise([*firsts, rows.stop]), strict=True)
    )


def _contrast(true: Truths, rows: Integers, config: Configuration | None) -> Results | None:
    """Contrast added to the dark zone by the disturbance (open) and by the residual (closed) of these steps.

    None without truth or configuration, or if this host lacks the file of the coronagraph's pupil.
    """
    covariances = {}
    for name, rms_nm, sampled_nm in (
        ("open", true.modes_disturbance_rms_nm, true.disturbance_nm),
        ("closed", true.modes_residual_rms_nm, true.residual_nm),
    ):
        if (modes_nm := _rms(rms_nm, rows)) is None:
            return None
        finite_nm = sampled_nm[rows][np.isfinite(sampled_nm[rows]).all(axis=1)].astype(float)
        covariances[name] = with_variances(finite_nm.T @ finite_nm / len(finite_nm), modes_nm)
    return added_contrast(contrast_or_none(config), covariances)


def _rms(values: Single, rows: Integers) -> Array | None:
    """Rms (modes,) over those of `rows` that have no NaN; None if all have NaN."""
    found = values[rows] if values.size else values
    finite = found[np.isfinite(found).all(axis=1)].astype(float)
    return np.sqrt(np.mean(finite**2, axis=0)) if len(finite) else None


def _at(values: Array | None, index: int) -> float | None:
    return float(values[index]) if values is not None else None


def _tilt_mas(values: Array | None, noll: tuple[int, ...], configuration: Configuration | None) -> Results | None:
    """Tip, tilt and rms per axis, sqrt((x^2 + y^2) / 2), mas; None without configuration, or without both modes."""
    if values is None or configuration is None or not {2, 3} <= set(noll):
        return None
    x, y = values[[noll.index(2), noll.index(3)]] / tilt_nm_per_mas(configuration.star.diameter_m)
    return {"x": float(x), "y": float(y), "per_axis": float(np.sqrt((x**2 + y**2) / 2))}
