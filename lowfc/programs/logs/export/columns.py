"""Columns of an export: quantities of the steps and arrays of the calibration, each with unit and description."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from lowfc.adapters.logs.columns import STAGES, joined, rows_of
from lowfc.adapters.logs.history import History
from lowfc.contract.envelope import count_of
from lowfc.contract.errors import DataFileError
from lowfc.control.calibration.calibration import Calibration
from lowfc.control.loop.safety import REASONS, mode_name


@dataclass(frozen=True, slots=True)
class Column:
    """One quantity of every step or frame, or one array of the calibration.

    Attributes:
        name: name of the column; ends in the unit if there is one.
        values: array (rows,) or (rows, modes); any shape for a calibration.
        unit: unit in FITS notation; empty for none.
        description: description of the quantity.
    """

    name: str
    values: npt.NDArray[Any]
    unit: str
    description: str

    def headings(self, noll: tuple[int, ...]) -> list[str]:
        """Names of the columns in a table with one column for each mode, such as "error_z2_nm"."""
        if self.values.ndim == 1:
            return [self.name]
        stem, _, unit = self.name.rpartition("_")
        return [f"{stem}_z{index}_{unit}" for index in noll]


def step_columns(history: History) -> list[Column]:
    """All quantities of a run's steps, one row for each step in the order of recording.

    Truth, durations and mirror stroke are joined by frame sequence; NaN where the log does not have them. Error and
    flux of a refused frame are NaN.
    """
    steps = history.steps
    if not steps.sequence.size:
        path, excluded = history.log.path, history.excluded_messages
        if history.calibration is None and (count := history.stepped_sequence.size):
            raise DataFileError(f"{path} has no calibration, which the export of its {count} steps requires")
        fitting = f" that fit its calibration ({excluded} do not)" if excluded else ""
        raise DataFileError(f"{path} has no steps{fitting}: there is nothing to export")

    measured, missing = np.isfinite(steps.error_nm).all(axis=1), np.float32(np.nan)

    def reasons(bits: int) -> str:
        return " ".join(reason.name.lower() for reason in REASONS if bits >> reason & 1)

    columns = [
        Column("sequence", steps.sequence, "", "frame sequence: camera start in Unix seconds << 32 | count"),
        Column("count", np.array([count_of(int(one)) for one in steps.sequence]), "", "frame count"),
        Column("time_ns", steps.time_ns, "ns", "end of the frame's exposure, since 1970-01-01 UTC"),
        Column("time_utc", steps.time_ns.astype("datetime64[ns]"), "", "time_ns as a date"),
        Column("mode", _named(steps.mode, mode_name), "", "loop mode"),
        Column("reasons", _named(steps.reasons, reasons), "", "reason why the frame was refused, or limits that acted"),
        Column("flux_dn", np.where(measured, steps.flux_dn, missing), "adu", "sum of the good pixels, dark subtracted"),
        Column(
            "saturated_pixels", steps.saturated_pixels, "pix", "good pixels at full well; 0 if the frame was refused"
        ),
        Column("error_nm", steps.error_nm, "nm", "measured modal error, wavefront rms"),
        Column("pol_nm", steps.pol_nm, "nm", "pseudo-open-loop modes, wavefront rms"),
        Column("command_nm", steps.command_nm, "nm", "modal command after the step, wavefront rms"),
    ]
    return [*columns, *_truth(history), *_mirror(history), *_durations(history)]


def calibration_columns(calibration: Calibration) -> list[Column]:
    """Arrays of a calibration; arrays over pixels or actuators are images."""
    frame, grid, modes = calibration.shape, calibration.grid, len(calibration.noll)
    return [
        Column("reference", calibration.reference.reshape(frame), "", "reference image I0, fraction of the flux"),
        Column(
            "response_per_nm",
            calibration.response.T.reshape(modes, *frame),
            "nm-1",
            "response H of each mode, fraction of the flux per nm rms of wavefront",
        ),
        Column(
            "reconstructor_nm",
            calibration.reconstructor.reshape(modes, *frame),
            "nm",
            "reconstructor R of each mode, nm rms of wavefront per fraction of the flux",
        ),
        Column("good", calibration.good.reshape(frame), "", "1 for pixels in use"),
        Column("dark_dn", calibration.dark.reshape(frame), "adu", "frame without light"),
        Column(
            "modes_to_actuators",
            calibration.modes_to_actuators.T.reshape(modes, *grid),
            "",
            "mirror shape of each mode, nm of surface per nm rms of wavefront",
        ),
    ]


def _truth(history: History) -> list[Column]:
    true = history.true
    if true is None:
        return []
    modes, pupil = "each mode, nm rms of wavefront", "wavefront rms over the open pupil, without piston"
    when = "root mean square over the frame period" if true.continuous else "at the start of the exposure"
    return [
        Column("true_disturbance_nm", true.disturbance_nm, "nm", f"{modes}, at the start of the exposure"),
        Column("true_residual_nm", true.residual_nm, "nm", f"{modes}, at the start of the exposure"),
        Column("true_residual_mode_rms_nm", true.modes_residual_rms_nm, "nm", f"{modes}, {when}"),
        Column("true_disturbance_rms_nm", true.disturbance_rms_nm, "nm", f"{pupil}, {when}"),
        Column("true_residual_rms_nm", true.residual_rms_nm, "nm", f"{pupil}, {when}"),
    ]


def _mirror(history: History) -> list[Column]:
    if not history.mirror.sequence.size:
        return []
    rows = rows_of(history.steps.sequence, history.mirror.sequence)
    stroke = joined(history.mirror.stroke_nm, rows)
    return [Column("mirror_stroke_nm", stroke, "nm", "largest deviation of an actuator from flat, surface")]


def _durations(history: History) -> list[Column]:
    if not history.timed_sequence.size:
        return []
    rows = rows_of(history.steps.sequence, history.timed_sequence)
    durations_us = {stage: joined(history.stages_ns[stage] / 1e3, rows) for stage in STAGES}
    return [
        Column(f"{stage}_us", us, "us", f"duration of {stage.replace('_', ' ')}") for stage, us in durations_us.items()
    ]


def _named(codes: npt.NDArray[Any], name: Callable[[int], str]) -> npt.NDArray[np.str_]:
    distinct, indices = np.unique(codes, return_inverse=True)
    return np.array([name(int(code)) for code in distinct])[indices]
