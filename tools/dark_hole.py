"""Fraction of a dark hole's steps that the loop undoes: a table of docs/howto/zero_point.md."""

import tempfile
from pathlib import Path

import numpy as np
from rich.progress import track

from lowfc.programs.paper.dark_hole import COMMAND, PLAIN, SETTLE, SHIFTED, STEPS, STEPS_COMBINED, dark_hole
from tools.shared import Results, markdown

STEP_RMS_NM = (1.0, 2.0, 5.0)

__all__ = ["COMMAND", "measure", "render"]


def measure() -> Results:
    """Fraction of the steps that the loop undoes, for small and for large steps."""
    runs = {}
    for step_rms_nm in track(STEP_RMS_NM, "dark holes"):
        with tempfile.TemporaryDirectory() as folder:
            result = dark_hole(Path(folder), step_rms_nm)
        run: Results = {"together_nm": step_rms_nm * STEPS**0.5}
        for name, channel in result.channels.items():
            undone_fraction, error = channel.undone()
            run[name] = {"undone": undone_fraction, "error": error, "left_nm": channel.residual_nm.tolist()}
        run["seen_nm"] = float(np.linalg.norm(result.channels[SHIFTED].channel_nm[-1]))
        runs[f"{step_rms_nm:g}"] = run
    return {"runs": runs}


def render(results: Results) -> str:
    """A row for each size of the steps."""
    head = (
        *("each step, nm rms of surface", "sum of the steps, nm rms of surface"),
        *("sum as seen by the sensor, nm rms of wavefront", "undone, %", "undone without the shift, %"),
        "true residual before -> after, nm rms",
    )
    rows = [
        (
            step_rms_nm,
            f"{run['together_nm']:.1f}",
            f"{run['seen_nm']:.1f}",
            *(f"{100 * run[name]['undone']:.2f} +- {100 * run[name]['error']:.2f}" for name in (SHIFTED, PLAIN)),
            " -> ".join(f"{residual_nm:.2f}" for residual_nm in run[SHIFTED]["left_nm"]),
        )
        for step_rms_nm, run in results["runs"].items()
    ]
    return (
        f"{markdown(head, rows)}\n{STEPS} random steps, {SETTLE} frames apart, each added to those before it; "
        f"without the shift, {STEPS_COMBINED} steps are added at a time. Undone: the fraction of the channel's shape, "
        "as seen by the sensor, that the loop removes. It is minus the slope of (command + disturbance) against the "
        "channel's modes, by least squares over all steps and modes, with its standard error. A negative "
        "value means that the loop adds to the steps. The true residual is the rms of all modes about their mean, over "
        "the full circle, before the first step and after the last."
    )
