"""`lowfc acceptance linearity`: gain and cross-talk of each mode as a function of amplitude, with the loop open."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from lowfc.arrays import Array, Integers
from lowfc.contract.configuration import Configuration
from lowfc.control.calibration.excitation import build_staircase
from lowfc.control.calibration.linearity import SIGMAS, gains, levels
from lowfc.control.loop.safety import LoopMode
from lowfc.optics.chain.zernike import mode_name
from lowfc.programs.cli.result import Result, result_field
from lowfc.programs.commissioning.acceptance.live import Live
from lowfc.programs.commissioning.acceptance.probe import (
    AcceptanceError,
    AcceptanceResult,
    Kind,
    ModeResult,
    ProbeResponse,
    selected_modes,
)

KIND: Kind = "linearity"
AMPLITUDES = (0.5, 1.0, 2.0)
"""Amplitudes tested, as multiples of the required linear range."""
_SPARE_FRAMES = 2  # frames skipped in addition to the delay, while the mirror settles


class Level(Result):
    """Gain of a mode and its largest cross-talk at one amplitude; `within`: within the requirements, None if unsure."""

    amplitude_nm: float = result_field()
    gain: float = result_field()
    gain_error: float = result_field()
    crosstalk: float = result_field()
    crosstalk_error: float = result_field()
    crosstalk_noll: int = result_field()
    within: bool | None = result_field()


class LinearityMode(ModeResult):
    """Linear range of a mode, nm rms of wavefront."""

    linear_nm: float = result_field("linear to", "nm", ".3g")
    levels: list[Level] = result_field()

    def remarks(self) -> Sequence[str]:
        """Gain - 1 and cross-talk at each amplitude."""
        cells = [
            f"{row.amplitude_nm:g}: {row.gain - 1:+.3f} ({abs(row.crosstalk):.3f})"
            + {True: "", False: "!", None: "?"}[row.within]
            for row in self.levels
        ]
        return [*cells, *super().remarks()]


class LinearityResult(AcceptanceResult):
    """Linearity; the row of a mode ends with gain - 1 and the largest cross-talk at each amplitude (nm rms)."""

    required_nm: float = result_field("required linear to", "nm", "g")
    required_gain_error: float = result_field("required |gain - 1|", form="g")
    required_crosstalk: float = result_field("required cross-talk", form="g")
    modes: list[LinearityMode] = result_field("modes")

    def remarks(self) -> Sequence[str]:
        """Key to the marks, and the verdict."""
        key = f"amplitude, nm: gain - 1 (largest cross-talk); !: beyond the requirement by {SIGMAS:g} standard errors"
        unsure = any(row.within is None for mode in self.modes for row in mode.levels)
        noisy = ["?: too noisy to judge; use more cycles or longer levels"] if unsure else []
        return [key, *noisy, *super().remarks()]


def play(live: Live, *, hold_frames: int, cycles: int, modes: Sequence[int]) -> list[ProbeResponse]:
    """Play a staircase of each mode on the mirror, with the loop open; AcceptanceError if its levels are too short.

    Args:
        live: The loop, and the requirements in its configuration.
        hold_frames: Frames at each level.
        cycles: Push-pull cycles of each amplitude.
        modes: Noll indices; empty for all.
    """
    skipped = int(np.ceil(live.loop.delay_frames)) + _SPARE_FRAMES
    if hold_frames <= skipped:
        raise AcceptanceError(
            f"{hold_frames} frames at each level are too few: the first {skipped} do not show the level yet"
        )
    plan = []
    for noll in selected_modes(modes, live.loop.noll):
        shape = live.calibration.modes_to_actuators[:, live.loop.noll.index(noll)][None]
        step_nm = live.configuration.safety.slew_nm / 2 / float(np.abs(shape).max())
        levels_nm = levels(np.array(AMPLITUDES) * live.configuration.acceptance.linear_nm, cycles)
        stairs, _ = build_staircase(levels_nm, hold_frames, step_nm)
        plan.append(({"noll": noll, "averaged": hold_frames - skipped}, stairs.astype(np.float32)[:, None], shape))
    live.expect(sum(len(table) for _, table, _ in plan))
    return [live.play(KIND, parameters, LoopMode.OPEN, table, shape) for parameters, table, shape in plan]


def judge(responses: Sequence[ProbeResponse], configuration: Configuration) -> LinearityResult:
    """Evaluate gain and cross-talk from the probe sequences; AcceptanceError if the loop was disturbed meanwhile."""
    required, modes = configuration.acceptance, []
    for response in {each.parameters["noll"]: each for each in responses}.values():  # the last response of each mode
        response.check(LoopMode.OPEN)
        parameters, noll = response.parameters, response.loop.noll
        levels_nm, starts = _levels(response.table[:, 0].astype(float), parameters["averaged"])
        mode = noll.index(parameters["noll"])
        measured = gains(response.filled(response.error_nm), mode, levels_nm, starts, parameters["averaged"])
        within = measured.within(required.gain_error, required.crosstalk)
        rows = []
        for row, amplitude_nm in enumerate(measured.amplitude_nm.tolist()):
            other = int(np.argmax(np.abs(measured.crosstalk[row])))
            rows.append(
                Level(
                    amplitude_nm=amplitude_nm,
                    gain=float(measured.gain[row, measured.mode]),
                    gain_error=float(measured.error[row, measured.mode]),
                    crosstalk=float(measured.crosstalk[row, other]),
                    crosstalk_error=float(measured.error[row, other]),
                    crosstalk_noll=noll[other],
                    within=within[row],
                )
            )
        beyond = min([row.amplitude_nm for row in rows if row.within is False], default=np.inf)
        linear_nm = max([row.amplitude_nm for row in rows if row.within and row.amplitude_nm < beyond], default=0.0)
        passed = linear_nm >= required.linear_nm * (1 - 1e-6)
        modes.append(
            LinearityMode(
                noll=parameters["noll"],
                name=mode_name(parameters["noll"]),
                passed=passed,
                too_noisy=not passed and beyond > required.linear_nm * (1 + 1e-6),
                linear_nm=linear_nm,
                levels=rows,
            )
        )
    return LinearityResult(
        test=KIND,
        passed=bool(modes) and all(mode.passed for mode in modes),
        required_nm=required.linear_nm,
        required_gain_error=required.gain_error,
        required_crosstalk=required.crosstalk,
        modes=modes,
    )


def _levels(stairs: Array, averaged: int) -> tuple[Array, Integers]:
    """Levels (levels,) of a staircase (frames,), and the frame (levels,) at which averaging begins at each level."""
    edges = np.flatnonzero(np.diff(stairs, prepend=np.nan, append=np.nan))
    hold = min(frames for frames in np.diff(edges).tolist() if frames > 1)  # values between levels last one frame
    starts = np.concatenate([np.arange(at, end - hold + 1, hold) for at, end in pairwise(edges)])
    starts = starts[stairs[starts] != 0]  # without the zero at the end of the staircase
    return stairs[starts], starts + hold - averaged


def draw(result: dict[str, Any], figure: Any) -> None:
    """Draw gain and cross-talk against amplitude."""
    axes = figure.subplots(1, 2, sharex=True)
    for number, mode in enumerate(result["modes"]):
        names = ("amplitude_nm", "gain", "gain_error", "crosstalk", "crosstalk_error")
        x, gain, gain_error, crosstalk, crosstalk_error = ([row[name] for row in mode["levels"]] for name in names)
        style = {"color": f"C{number % 10}", "marker": "o", "markersize": 3, "linewidth": 1}
        axes[0].errorbar(x, gain, gain_error, label=f"Z{mode['noll']}", **style)
        axes[1].errorbar(x, np.abs(crosstalk), crosstalk_error, **style)
    for side in (-1, 1):
        axes[0].axhline(1 + side * result["required_gain_error"], color="grey", linestyle=":")
    axes[1].axhline(result["required_crosstalk"], color="grey", linestyle=":")
    for ax, title in zip(axes, ("gain: measured / true amplitude", "largest cross-talk"), strict=True):
        ax.axvline(result["required_nm"], color="grey", linestyle=":")
        ax.set_title(title)
        ax.set_xlabel("amplitude of the mode, nm rms of wavefront")
        ax.grid(alpha=0.3)
    axes[0].legend(fontsize=6, ncols=2)
