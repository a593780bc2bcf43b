"""`lowfc acceptance capture-range`: from how large a wavefront the loop closes."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from lowfc.arrays import Single
from lowfc.contract.configuration import Acceptance
from lowfc.control.calibration.excitation import climb
from lowfc.control.calibration.linearity import captured
from lowfc.control.laws.law import TIP_TILT, Law
from lowfc.control.loop.safety import LoopMode
from lowfc.optics.chain.zernike import mode_name
from lowfc.programs.cli.result import figure
from lowfc.programs.commissioning.acceptance.live import Live
from lowfc.programs.commissioning.acceptance.played import (
    AcceptanceError,
    AcceptanceResult,
    Kind,
    ModeResult,
    Played,
    chosen,
)

KIND: Kind = "capture-range"
SIZES = (0.5, 1.0, 1.5)
"""Sizes that are played, as multiples of the one from which the loop must close."""


class CaptureMode(ModeResult):
    """How large a wavefront of a mode the loop closes from, nm rms."""

    required_nm: float = figure("required", "nm", "g")
    captured_nm: float = figure("closes from", "nm", "g")
    lost_nm: float | None = figure("not from", "nm", "g")
    limits: list[str] = figure("limits that acted")


class CaptureResult(AcceptanceResult):
    """The capture range."""

    trials: int = figure("trials")
    modes: list[CaptureMode] = figure("modes")


def play(live: Live, modes: Sequence[int], required: Acceptance) -> list[Played]:
    """Put growing shapes of each mode on the mirror under the closed loop, until it does not take one away.

    A shape comes as quickly as the mirror's slew allows, in a frame or two, and goes again. To the loop that is what it
    finds when it is closed on it. After one that it did not take away it begins anew from zero.
    """
    plan = [trials for noll in chosen(modes, live.loop.noll) if (trials := _trials(live, noll, required))]
    live.expect(sum(len(table) for trials in plan for _, table, _ in trials))
    found = []
    for trials in plan:
        for place, (what, table, shape) in enumerate(trials):
            found.append(live.play(KIND, what, LoopMode.CLOSED, table, shape))
            if not closed(found[-1]):
                live.left_out(sum(len(table) for _, table, _ in trials[place + 1 :]))
                live.rest()
                live.into(LoopMode.CLOSED)
                break
    return found


def _trials(live: Live, noll: int, required: Acceptance) -> list[tuple[dict[str, Any], Single, Single]]:
    """Shapes of a mode, the smallest first, each with its announcement and its staircase; none without a gain."""
    place, law = live.loop.noll.index(noll), live.loop.law
    if isinstance(law, Law) and not law.gain[place]:
        return []
    # An integrator's knows its gain and nothing of the delay; a linear law's is five time constants of its slowest
    # pole, of which three are enough: they leave a twentieth.
    hold = round(live.loop.settling_frames() * (2 if isinstance(law, Law) else 0.6))
    shape = live.calibration.modes_to_actuators[:, place][None]
    step_nm = live.configuration.safety.slew_nm / 2 / float(np.abs(shape).max())
    trials = []
    for level_nm in (np.outer(SIZES, (1.0, -1.0)).ravel() * _required_nm(required, noll)).tolist():
        stairs, starts = climb([0.0, level_nm], hold, step_nm)
        begin, there = starts.tolist()
        what = {
            "noll": noll,
            "level_nm": level_nm,
            "before": [begin + hold - hold // 4, begin + hold],
            "after": [there + hold - hold // 4, there + hold],
        }
        back = len(stairs) - (hold - 1)  # the next one begins with a rest of its own
        trials.append((what, stairs[:back].astype(np.float32)[:, None], shape))
    return trials


def closed(trial: Played) -> bool:
    """Whether the loop removed the shape of a trial."""
    if trial.limits_hit:
        return False
    trial.check(LoopMode.CLOSED)
    place = trial.loop.noll.index(trial.what["noll"])
    before, after = (slice(*trial.what[name]) for name in ("before", "after"))
    commands = trial.filled(trial.command_nm)
    return captured(trial.filled(trial.error_nm), commands, place, trial.what["level_nm"], before, after)


def judge(trials: Sequence[Played], required: Acceptance) -> CaptureResult:
    """The capture range of each mode that was tried."""
    if not trials:
        raise AcceptanceError("no mode of the loop has a gain: there is nothing to capture")
    modes = []
    for noll in dict.fromkeys(trial.what["noll"] for trial in trials):
        of = [trial for trial in trials if trial.what["noll"] == noll]
        done = {trial.what["level_nm"]: closed(trial) for trial in of}
        sizes = sorted({abs(level_nm) for level_nm in done})
        lost = [abs(level_nm) for level_nm, good in done.items() if not good]
        good = [size for size in sizes if {size, -size} <= set(done) and size < min([*lost, np.inf])]
        required_nm = _required_nm(required, noll)
        modes.append(
            CaptureMode(
                noll=noll,
                name=mode_name(noll),
                required_nm=required_nm,
                captured_nm=max(good, default=0.0),
                lost_nm=min(lost, default=None),
                limits=sorted({name for trial in of for name in trial.limits_hit}),
                passed=max(good, default=0.0) >= required_nm * (1 - 1e-6),
            )
        )
    return CaptureResult(test=KIND, passed=all(mode.passed for mode in modes), trials=len(trials), modes=modes)


def draw(found: dict[str, Any], figure: Any) -> None:
    """Bars of what each mode was captured from, beside what is required."""
    ax = figure.subplots()
    x = np.arange(len(found["modes"]))
    colours = ["C0" if mode["passed"] else "C3" for mode in found["modes"]]
    ax.bar(x, [mode["captured_nm"] for mode in found["modes"]], color=colours, label="closes from")
    ax.plot(x, [mode["required_nm"] for mode in found["modes"]], "k_", markersize=14, label="required")
    ax.set_xticks(x, [f"Z{mode['noll']}" for mode in found["modes"]])
    ax.set_ylabel("nm rms of wavefront")
    ax.legend()


def _required_nm(required: Acceptance, noll: int) -> float:
    return required.capture_tilt_nm if noll in TIP_TILT else required.capture_nm
