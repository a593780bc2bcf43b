"""`lowfc acceptance rejection`: the loop's measured rejection and noise transfer functions compared with theory.

They are measured with a multisine; its frequencies are called lines. Each mode has lines of its own.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from lowfc.adapters.logs.columns import count_reasons
from lowfc.arrays import Array, Integers
from lowfc.contract.configuration import Configuration
from lowfc.control.calibration.excitation import lines, multisine, with_lead_in
from lowfc.control.laws import margins
from lowfc.control.laws.linear_law import LinearLaw
from lowfc.control.laws.stability import delay_weights
from lowfc.control.laws.transfer_function import Departure, Lines, departure, measure_lines, modes_seen
from lowfc.control.loop.command_channels import OFFSET
from lowfc.control.loop.safety import Limit, LoopMode
from lowfc.control.loop.wording import counted
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

KIND: Kind = "rejection"
MIN_JUDGED = 0.5
"""A mode passes only if the rejection is certain enough to judge at this fraction of its lines or more.

The noise transfer has no such limit: where it is small, it is below the measurement noise.
"""
_LEAD_FRAMES = 50  # frames before the multisine in addition to those of settling: the first steps may come late


class Comparison(Result):
    """Departure of a mode's transfer function from theory, at the lines that can be judged."""

    within: bool = result_field()
    lines: int = result_field()
    judged: int = result_field()
    largest_departure_db: float | None = result_field(form="+.2f")
    unsure_hz: list[float] = result_field()

    def __str__(self) -> str:
        worst = "-" if self.largest_departure_db is None else f"{self.largest_departure_db:+.2f}"
        return f"{worst} on {self.judged} of {self.lines}"


class RejectionMode(ModeResult):
    """Departure of a mode's rejection and noise transfer from theory, dB, each at the lines that can be judged."""

    rejection: Comparison = result_field("rejection", "dB on lines")
    noise_transfer: Comparison = result_field("noise transfer", "dB on lines")


class RejectionResult(AcceptanceResult):
    """Rejection and noise transfer measured with a multisine; `points` has one entry per line.

    The largest departures are absolute values, of all modes; `lines_judged` counts lines whose rejection is judged.
    """

    law: str = result_field("law")
    delay_frames: float = result_field("delay", "frames", "g")
    rate_hz: float = result_field("rate", "Hz", ".4g")
    injected: str = result_field("multisine added to")
    lines: int = result_field("lines")
    lowest_hz: float = result_field("lowest", "Hz", ".3g")
    highest_hz: float = result_field("highest", "Hz", ".4g")
    frames: int = result_field("frames")
    frames_missing: int = result_field()
    tolerance_db: float = result_field("tolerance", "dB", "g")
    lines_judged: int = result_field()
    largest_departure_db: float | None = result_field()
    largest_noise_departure_db: float | None = result_field()
    modes: list[RejectionMode] = result_field("modes")
    points: list[dict[str, Any]] = result_field()

    def remarks(self) -> Sequence[str]:
        """Lines at which the rejection is too noisy to judge, number of missing frames, and the verdict."""
        lines = [
            f"Z{mode.noll}: rejection too noisy to judge at "
            f"{', '.join(f'{frequency:.3g}' for frequency in mode.rejection.unsure_hz)} Hz"
            for mode in self.modes
            if mode.rejection.unsure_hz
        ]
        if any(mode.too_noisy for mode in self.modes):
            lines.append("a longer --duration, a larger --rms-nm or fewer --modes reduce the noise")
        if self.frames_missing:
            lines.append(f"interpolated: {counted(self.frames_missing, 'frame')}, missing or refused")
        return [*lines, *super().remarks()]


def play(
    live: Live, *, duration_s: float, rms_nm: float, lines_per_mode: int, modes: Sequence[int], seed: int
) -> list[ProbeResponse]:
    """Play a multisine in closed loop; AcceptanceError if its lines do not fit into the duration.

    The multisine is added to the loop's offset; with a law on pseudo-open-loop modes it is added to the mirror, because
    such a law responds to an offset differently than to a disturbance.

    Args:
        live: The loop, and the requirements in its configuration.
        duration_s: Period of the multisine.
        rms_nm: Rms of the multisine in each mode, nm of wavefront.
        lines_per_mode: Number of lines of each mode.
        modes: Noll indices; empty for all.
        seed: Seed of the phases.
    """
    noll, rate_hz, required = live.loop.noll, live.loop.rate_hz, live.configuration.acceptance
    tested = selected_modes(modes, noll)
    frames = round(duration_s * rate_hz)
    try:
        bins = lines(frames, len(tested), lines_per_mode, required.lowest_hz / rate_hz, required.highest_of_rate)
    except ValueError as error:
        raise AcceptanceError(
            f"{duration_s:g} s at {rate_hz:.4g} Hz, {len(tested)} modes, from {required.lowest_hz:g} Hz up: {error}"
        ) from None
    basis, lead_frames = None, live.loop.settling_frames() + _LEAD_FRAMES
    if isinstance(live.loop.law, LinearLaw) and live.loop.law.signal == "pol":
        basis = np.ascontiguousarray(live.calibration.modes_to_actuators.T)
    live.check_length(lead_frames + frames, len(noll), basis)  # before a long computation
    period = np.zeros((frames, len(noll)), np.float32)
    period[:, [noll.index(mode) for mode in tested]] = multisine(frames, bins, rms_nm, seed)
    table = with_lead_in(period, lead_frames)
    return [live.play(KIND, {"period_frames": frames}, LoopMode.CLOSED, table, basis)]


def transfer_function(response: ProbeResponse) -> Lines:
    """Transfer functions measured at the lines of the multisine; AcceptanceError if the loop was disturbed."""
    response.check(LoopMode.CLOSED)
    if Limit.LAW_OVERRULED in count_reasons(response.reasons):
        raise AcceptanceError(
            f"the integrator drove in place of the law {response.loop.name!r} (LAW_OVERRULED): load the law again, or "
            "`lowfc ctl law integrator`, then measure again"
        )
    period = response.table[-response.parameters["period_frames"] :].astype(float)
    added = -period if response.target == OFFSET else modes_seen(period, delay_weights(response.loop.delay_frames))
    return measure_lines(response.filled(response.error_nm)[-len(period) :], added)


def judge(responses: Sequence[ProbeResponse], configuration: Configuration) -> RejectionResult:
    """Compare the last multisine with theory; AcceptanceError if the loop was disturbed meanwhile."""
    response = responses[-1]
    measured, rate_hz = transfer_function(response), response.loop.rate_hz
    tolerance_db = configuration.acceptance.rejection_db
    frequency_hz = measured.frequency * rate_hz
    line_rows = np.arange(measured.mode.size)
    law, delay_frames = response.loop.linear, response.loop.delay_frames
    theory_s = margins.rejection(law, frequency_hz, delay_frames)[line_rows, measured.mode]
    theory_t = margins.noise_transfer(law, frequency_hz, delay_frames)[line_rows, measured.mode]
    departure_s = departure(measured.rejection, theory_s, measured.error, tolerance_db)
    departure_t = departure(measured.noise_transfer, theory_t, measured.error, tolerance_db)
    modes = []
    for mode, noll in enumerate(response.loop.noll):
        rows = np.flatnonzero(measured.mode == mode)
        if rows.size:
            rejection = _comparison(departure_s, rows, frequency_hz)
            noise = _comparison(departure_t, rows, frequency_hz)
            within = rejection.within and noise.within
            enough = rejection.judged >= MIN_JUDGED * rows.size
            modes.append(
                RejectionMode(
                    noll=noll,
                    name=mode_name(noll),
                    passed=within and enough,
                    too_noisy=within and not enough,
                    rejection=rejection,
                    noise_transfer=noise,
                )
            )
    return RejectionResult(
        test=KIND,
        passed=bool(modes) and all(mode.passed for mode in modes),
        law=response.loop.name,
        rate_hz=rate_hz,
        delay_frames=delay_frames,
        injected=response.target,
        frames=len(response.table),
        frames_missing=response.missing,
        tolerance_db=tolerance_db,
        lowest_hz=float(frequency_hz.min()),
        highest_hz=float(frequency_hz.max()),
        lines=int(measured.mode.size),
        lines_judged=int(np.count_nonzero(departure_s.judged)),
        largest_departure_db=_largest(departure_s),
        largest_noise_departure_db=_largest(departure_t),
        modes=modes,
        points=[
            {
                "noll": response.loop.noll[measured.mode[row]],
                "frequency_hz": float(frequency_hz[row]),
                "rejection": float(np.abs(measured.rejection[row])),
                "rejection_theory": float(theory_s[row]),
                "rejection_error_db": float(departure_s.error_db[row]),
                "rejection_judged": bool(departure_s.judged[row]),
                "noise_transfer": float(np.abs(measured.noise_transfer[row])),
                "noise_transfer_theory": float(theory_t[row]),
                "noise_transfer_error_db": float(departure_t.error_db[row]),
                "noise_transfer_judged": bool(departure_t.judged[row]),
            }
            for row in line_rows
        ],
    )


def draw(result: dict[str, Any], figure: Any) -> None:
    """Draw rejection and noise transfer side by side: measured points and theory."""
    axes = figure.subplots(1, 2, sharex=True)
    titles = {"rejection": "rejection |S|", "noise_transfer": "noise transfer |T|"}
    for ax, (name, title) in zip(axes, titles.items(), strict=True):
        for number, mode in enumerate(result["modes"]):
            points = [point for point in result["points"] if point["noll"] == mode["noll"]]
            hz = [point["frequency_hz"] for point in points]
            colour = f"C{number % 10}"
            ax.loglog(hz, [point[f"{name}_theory"] for point in points], "-", color=colour, linewidth=1)
            for judged, marker, face in ((True, "o", colour), (False, "o", "none")):
                shown = [point for point in points if point[f"{name}_judged"] is judged]
                x, y = ([point[key] for point in shown] for key in ("frequency_hz", name))
                label = f"Z{mode['noll']}" if judged else None
                ax.loglog(x, y, marker, color=colour, markerfacecolor=face, markersize=3, label=label)
        ax.set_title(title)
        ax.set_xlabel("frequency, Hz")
        ax.grid(alpha=0.3)
    axes[0].set_ylabel("measured (points; open: too noisy) and theory (lines)")
    axes[1].legend(fontsize=6, ncols=2)


def _comparison(departures: Departure, rows: Integers, frequency_hz: Array) -> Comparison:
    judged = rows[departures.judged[rows]]
    db = departures.db[judged]
    worst = float(db[np.argmax(np.abs(db))]) if judged.size else None
    return Comparison(
        within=bool(departures.within[judged].all()),
        lines=int(rows.size),
        judged=int(judged.size),
        largest_departure_db=worst,
        unsure_hz=frequency_hz[rows[~departures.judged[rows]]].tolist(),
    )


def _largest(departures: Departure) -> float | None:
    return float(np.abs(departures.db[departures.judged]).max()) if departures.judged.any() else None
