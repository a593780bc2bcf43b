"""Make a calibration of what was measured, judge it, and write its file."""

from pathlib import Path
from typing import Any, NamedTuple

from lowfc.adapters import calibration_file, instrument
from lowfc.control.calibration import Calibration
from lowfc.control.regularised import advice
from lowfc.control.response_fit import LinearRange
from lowfc.programs.calibrate.pokes import Wanted
from lowfc.programs.calibrate.result import computed_noise_nm, configured_delay, figures, measured_calibration, text_of
from lowfc.programs.calibrate.run import Calibrator, Taken
from lowfc.programs.calibrate.verdict import judge
from lowfc.programs.calibrate.verdict import text_of as verdict_text

DELAY_APART = 0.1
"""Frames by which the delay that the loop counts with may be off before something is said."""


class Finished(NamedTuple):
    """A calibration that was written: what `--json` prints of it, the text, and what is wrong with it."""

    calibration: Calibration
    figures: dict[str, Any]
    text: str
    faults: tuple[str, ...]


def rejected_of(out: Path) -> Path:
    """Where a calibration is written that is not recommended: what may be a good one stays."""
    return out.with_name(f"{out.stem}.rejected{out.suffix}")


def finished(
    calibrator: Calibrator,
    asked: Wanted,
    taken: Taken,
    computed: Calibration,
    linear: LinearRange | None = None,
    truncate: float = 0.0,
    tikhonov: float = 0.0,
) -> Finished:
    """Make R, check it on other frames, write the file: under another name where it is not recommended.

    Args:
        calibrator: Of the running loop.
        asked: What is asked for.
        taken: What was measured.
        computed: Of the optical model.
        linear: The linear range, where it is known already.
        truncate: Leave out singular values below this part of the largest.
        tikhonov: Damp singular values of about this part of the largest.

    Raises:
        CalibrationError: H is not above its noise, or frames are lost.
        DataFileError: the file cannot be written.
    """
    config = calibrator.config
    made, quality = measured_calibration(config, calibrator.before, taken.measured, asked.method, truncate, tikhonov)
    check = calibrator.check(made, taken)
    if linear is None and calibrator.pokes.ranged:
        linear = calibrator.linear_range(made, taken.delay)
    noise = computed_noise_nm(config, made, computed)
    ratio = None if noise is None else instrument.frame_noise_nm(config, made) / noise
    verdict = judge(asked.snr, taken.measured.cycles, taken.measured.error, check, ratio, made.noll)
    file = rejected_of(asked.out) if verdict.faults else asked.out
    found = figures(config, made, quality, asked.method, taken.measured, taken.delay, linear, computed, verdict, file)
    calibration_file.save(made, file)
    lines = [text_of(found), advice(quality, made.noll, config.control.limit_nm), verdict_text(found)]
    counted = configured_delay(config)
    if abs(taken.delay.delay_frames - counted) > DELAY_APART:
        lines.append(
            f"warning: the loop counts with a delay of {counted:g} frames; set control.delay_frames = "
            f"{max(taken.delay.delay_frames, 1):.2f}"
        )
    return Finished(made, found, "\n".join(lines), verdict.faults)
