"""`lowfc acceptance capture-range`: largest tested static wavefront error from which the loop converges."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from lowfc.arrays import Single
from lowfc.contract.configuration import Configuration
from lowfc.control.calibration.excitation import build_staircase
from lowfc.control.calibration.linearity import captured
from lowfc.control.laws.integrator import TIP_TILT, Integrator
from lowfc.control.loop.safety import LoopMode
from lowfc.optics.chain.zernike import mode_name
from lowfc.programs.cli.result import result_field
from lowfc.programs.commissioning.acceptance.live import Live
from lowfc.programs.commissioning.acceptance.probe import (
    AcceptanceError,
    AcceptanceResult,
    Kind,
    ModeResult,
    ProbeResponse,
    selected_modes,
)

KIND: Kind = "capture-range"
SIZES = (0.5, 1.0, 1.5)
"""Amplitudes tested, as multiples of the required capture range."""


class CaptureMode(ModeResult):
    """Capture range of a mode, nm rms of wavefront."""

    required_nm: float = result_field("required", "nm", "g")
    captured_nm: float = result_field("converges from", "nm", "g")
    lost_nm: float | None = result_field("fails from", "nm", "g")
    limits: list[str] = result_field("limits that acted")


class CaptureResult(AcceptanceResult):
    """Capture range of every mode."""

    trials: int = result_field("trials")
    modes: list[CaptureMode] = result_field("modes")


def play(live: Live, *, modes: Sequence[int]) -> list[ProbeResponse]:
    """Add shapes of each mode to the mirror in closed loop, in steps of growing amplitude, until one is not corrected.

    Each shape is ramped up and down at half the slew limit. If a ramp takes few frames, the trial is equivalent to
    closing the loop on a static error. After a shape that was not corrected, the command is reset to zero.
    """
    plan = [trials for noll in selected_modes(modes, live.loop.noll) if (trials := _trials(live, noll))]
    live.expect(sum(len(table) for trials in plan for _, table, _ in trials))
    responses = []
    for trials in plan:
        for number, (parameters, table, shape) in enumerate(trials):
            responses.append(live.play(KIND, parameters, LoopMode.CLOSED, table, shape))
            if not shape_removed(responses[-1]):
                live.skip(sum(len(table) for _, table, _ in trials[number + 1 :]))
                live.return_to_zero()
                live.set_mode(LoopMode.CLOSED)
                break
    return responses


def _trials(live: Live, noll: int) -> list[tuple[dict[str, Any], Single, Single]]:
    """Trials of a mode, smallest amplitude first: parameters, staircase and shape; empty if its gain is zero."""
    row, law = live.loop.noll.index(noll), live.loop.law
    if isinstance(law, Integrator) and not law.gain[row]:
        return []
    # settling_frames() of an integrator ignores the delay, so the hold is twice as long. That of a linear law is five
    # time constants of the slowest pole; three are enough, because they leave 5 % of the error.
    hold = round(live.loop.settling_frames() * (2 if isinstance(law, Integrator) else 0.6))
    averaged = hold // 4  # levels are compared over the last quarter of their hold time
    shape = live.calibration.modes_to_actuators[:, row][None]
    step_nm = live.configuration.safety.slew_nm / 2 / float(np.abs(shape).max())
    trials = []
    for level_nm in (np.outer(SIZES, (1.0, -1.0)).ravel() * _required_nm(live.configuration, noll)).tolist():
        stairs, starts = build_staircase([0.0, level_nm], hold, step_nm)
        zero_start, level_start = starts.tolist()
        parameters = {
            "noll": noll,
            "level_nm": level_nm,
            "before": [zero_start + hold - averaged, zero_start + hold],
            "after": [level_start + hold - averaged, level_start + hold],
        }
        frames = len(stairs) - (hold - 1)  # the next trial starts with its own hold at zero
        trials.append((parameters, stairs[:frames].astype(np.float32)[:, None], shape))
    return trials


def shape_removed(trial: ProbeResponse) -> bool:
    """Whether the loop removed the shape of a trial."""
    if trial.limits_hit:
        return False
    trial.check(LoopMode.CLOSED)
    row = trial.loop.noll.index(trial.parameters["noll"])
    before, after = (slice(*trial.parameters[name]) for name in ("before", "after"))
    commands = trial.filled(trial.command_nm)
    return captured(trial.filled(trial.error_nm), commands, row, trial.parameters["level_nm"], before, after)


def judge(trials: Sequence[ProbeResponse], configuration: Configuration) -> CaptureResult:
    """Evaluate the capture range of each tested mode; AcceptanceError without a trial, or if the loop was disturbed."""
    if not trials:
        raise AcceptanceError("the gains of the tested modes are zero: they have no capture range")
    modes = []
    for noll in dict.fromkeys(trial.parameters["noll"] for trial in trials):
        # Of a repeated level, only the last trial counts.
        trial_of_level = {trial.parameters["level_nm"]: trial for trial in trials if trial.parameters["noll"] == noll}
        converged = {level_nm: shape_removed(trial) for level_nm, trial in trial_of_level.items()}
        lost = [abs(level_nm) for level_nm, success in converged.items() if not success]
        converging_nm = [level for level in converged if 0 < level < min(lost, default=np.inf) and -level in converged]
        required_nm = _required_nm(configuration, noll)
        modes.append(
            CaptureMode(
                noll=noll,
                name=mode_name(noll),
                required_nm=required_nm,
                captured_nm=max(converging_nm, default=0.0),
                lost_nm=min(lost, default=None),
                limits=sorted({name for trial in trial_of_level.values() for name in trial.limits_hit}),
                passed=max(converging_nm, default=0.0) >= required_nm * (1 - 1e-6),
            )
        )
    return CaptureResult(test=KIND, passed=all(mode.passed for mode in modes), trials=len(trials), modes=modes)


def draw(result: dict[str, Any], figure: Any) -> None:
    """Draw a bar of the capture range of each mode, with a mark at the required one."""
    ax = figure.subplots()
    x = np.arange(len(result["modes"]))
    colours = ["C0" if mode["passed"] else "C3" for mode in result["modes"]]
    ax.bar(x, [mode["captured_nm"] for mode in result["modes"]], color=colours, label="converges from")
    ax.plot(x, [mode["required_nm"] for mode in result["modes"]], "k_", markersize=14, label="required")
    ax.set_xticks(x, [f"Z{mode['noll']}" for mode in result["modes"]])
    ax.set_ylabel("nm rms of wavefront")
    ax.legend()


def _required_nm(configuration: Configuration, noll: int) -> float:
    required = configuration.acceptance
    return required.capture_tilt_nm if noll in TIP_TILT else required.capture_nm
