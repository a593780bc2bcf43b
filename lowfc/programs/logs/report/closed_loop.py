"""The longest stretch of a run with the loop closed under one law: spectra, theory and sensor noise."""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from lowfc.adapters.logs.columns import exposure_fraction
from lowfc.adapters.logs.history import History
from lowfc.arrays import Array, Mask
from lowfc.contract.codecs.state_codec import calibration_in_use
from lowfc.control.laws import margins
from lowfc.control.laws.continuous import Timing
from lowfc.control.laws.error_budget import SensorNoise, sensor_noise
from lowfc.control.laws.linear_law import LinearLaw, integrator
from lowfc.control.laws.margins import noise_transfer, rejection
from lowfc.control.laws.spectra import SHORTEST, Spectrum, TimeSeries, means_in_bins, spectrum, time_series
from lowfc.control.laws.stability import settling_frames
from lowfc.control.loop.safety import Limit, LoopMode
from lowfc.control.loop.state import FADING_FRAMES, SETTLING_FRAMES
from lowfc.programs.logs.report.source import LawInForce, Results, Run

MAX_STEPS = 200_000
"""Largest number of steps used, to bound the memory; of a longer stretch, the last ones are used."""
BANDS_HZ = (1.0, 10.0, 100.0, 1000.0)
"""Edges between the frequency bands; edges below the resolution or above the highest frequency are not used."""

_TIP, _TILT = 2, 3


@dataclass(frozen=True, slots=True)
class Stretch:
    """Steps with the loop closed under one law.

    Attributes:
        rows: steps of the stretch, after settling.
        settling: number of steps left out for settling.
        earlier: number of steps after settling that are left out because the stretch is longer than `MAX_STEPS`.
        in_force: the law as the controller's states report it.
        law: the same law, even if it is the integrator, as a linear law with the rate and delay of the stretch.
        timing: timing of the loop; continuous if truth is continuous and the exposure known, otherwise sampled.
        series: (frames, columns) error, pseudo-open-loop and, if the log has truth, disturbance, residual and the
            residual's mean over the exposure, each with a column for every mode.
        residual_ms_nm2: (modes,) mean square of the true residual, over all times if the truth is continuous, otherwise
            over the frames; None without truth.
    """

    rows: slice
    settling: int
    earlier: int
    in_force: LawInForce
    law: LinearLaw
    timing: Timing
    series: TimeSeries
    residual_ms_nm2: Array | None

    @property
    def true(self) -> bool:
        """Whether the true wavefront is known."""
        return self.residual_ms_nm2 is not None

    def signal(self, number: int) -> TimeSeries:
        """One of `ERROR`, `POL`, `DISTURBANCE`, `RESIDUAL` and `SENSED`, (frames, modes)."""
        modes = len(self.law.noll)
        return self.series.columns(slice(number * modes, (number + 1) * modes))


ERROR, POL, DISTURBANCE, RESIDUAL, SENSED = range(5)


def longest_stretch(run: Run) -> Stretch | None:
    """The longest stretch; None if there is none, for the reasons of `why_no_stretch`."""
    history, steps = run.history, run.history.steps
    law_of_step = np.searchsorted([law.first for law in run.laws], np.arange(steps.sequence.size), side="right") - 1
    # Before the first law, the index is -1, which selects the element False at the end.
    law_known = np.array([*(law.known for law in run.laws), False])[law_of_step]
    linear = np.array([*(law.linear is not None for law in run.laws), False])[law_of_step]
    # Until the next state names the overruled groups of modes, only the steps show that a group is overruled.
    overruled = linear & (steps.reasons >> Limit.LAW_OVERRULED & 1 == 1)
    closed = (steps.mode == LoopMode.CLOSED) & law_known & ~overruled & history.under_calibration
    edges = np.flatnonzero(np.diff(np.where(closed, law_of_step, -1), prepend=-1, append=-1))
    spans = [(first, last) for first, last in pairwise(edges.tolist()) if closed[first]]
    if not spans:
        return None
    first, last = max(spans, key=lambda span: int(np.isfinite(steps.error_nm[span[0] : span[1], :1]).sum()))
    in_force = run.laws[law_of_step[first]]
    gain, leak = np.array(in_force.gain, float), np.array(in_force.leak, float)
    if in_force.linear is None:
        settling = settling_frames(gain, leak)
    else:
        settling = SETTLING_FRAMES + FADING_FRAMES + margins.settling_frames(in_force.linear, in_force.delay_frames)
    settling = min(settling, (last - first) // 10)
    rows = slice(max(first + settling, last - MAX_STEPS), last)
    earlier = rows.start - first - settling
    signals = [steps.error_nm[rows], steps.pol_nm[rows]]
    residual_ms_nm2, timing, true = None, Timing.sampled(in_force.delay_frames), history.true
    if true is not None and np.isfinite(true.residual_nm[rows]).any():
        signals += [true.disturbance_nm[rows], true.residual_nm[rows], true.sensed_nm[rows]]
        residual_ms_nm2 = np.nanmean(true.modes_residual_rms_nm[rows].astype(float) ** 2, axis=0)
        if true.continuous and exposure_fraction(history.camera) is not None:
            timing = history.timing(in_force.delay_frames)
    series = time_series(steps.sequence[rows], np.hstack(signals))
    noll = tuple(range(2, 2 + gain.size))  # only the number of modes is used
    rate_hz = history.rate_hz or 1.0  # with a single step the rate is unknown, and unused
    if in_force.linear is None:
        law = integrator(gain, leak, noll, in_force.delay_frames, rate_hz)
    else:
        law = replace(in_force.linear, delay_frames=in_force.delay_frames, rate_hz=rate_hz)
    return Stretch(rows, settling, earlier, in_force, law, timing, series, residual_ms_nm2)


def why_no_stretch(run: Run) -> str:
    """Reason why there is no stretch."""
    closed = run.history.steps.mode == LoopMode.CLOSED
    if (closed & run.history.under_calibration).any():
        return (
            "the law with which the loop was closed is not in this log, or the integrator took over some of its modes"
        )
    if closed.any():
        return "the loop was closed only under an earlier calibration than the last one of this log"
    return "the loop was not closed in this log"


def stretch_results(run: Run, stretch: Stretch | None) -> Results | None:
    """Results on the stretch and its law, for JSON; None without a stretch."""
    if stretch is None:
        return None
    steps = run.history.steps
    times_s = run.step_s[stretch.rows]
    limited = steps.reasons[stretch.rows] & ~(1 << Limit.LAW_OVERRULED) >= 1 << Limit.MODAL_LIMIT
    return {
        "from_s": float(times_s[0]),
        "to_s": float(times_s[-1]),
        "true": stretch.true,
        "frames": stretch.series.frames,
        "pieces": len(stretch.series.values),
        "frames_bridged": stretch.series.interpolated,
        "steps_settling": stretch.settling,
        "steps_earlier": stretch.earlier,
        "steps_limited": int(limited.sum()),
        "law": stretch.in_force.law_name,
        "gain": list(stretch.in_force.gain),
        "leak": list(stretch.in_force.leak),
        "delay_frames": stretch.law.delay_frames,
    }


def groups_of(noll: tuple[int, ...]) -> dict[str, Mask]:
    """Tip, tilt and the others as masks (modes,); only groups that have modes."""
    index = np.array(noll, dtype=int)
    masks = {"tilt x": index == _TIP, "tilt y": index == _TILT, "other modes": index > _TILT}
    return {name: mask for name, mask in masks.items() if mask.any()}


Spectra = list[Spectrum]
"""Spectra of a stretch's signals: error, pseudo-open-loop and, if the log has truth, disturbance and residual."""


def spectra_of(stretch: Stretch | None) -> Spectra | None:
    """Spectra of the signals of a stretch; None without a stretch, or if it is too short."""
    if stretch is None:
        return None
    found = [spectrum(stretch.signal(number), stretch.law.rate_hz) for number in range(4 if stretch.true else 2)]
    return [one for one in found if one is not None] or None  # all signals are equally long


def spectra_results(run: Run, stretch: Stretch | None, spectra: Spectra | None) -> Results:
    """Spectra of tip, tilt and the sum of the others: in bins, by band, and compared with theory."""
    if stretch is None:
        return {"why_not": why_no_stretch(run)}
    if spectra is None:
        longest = stretch.series.longest
        return {"why_not": f"the longest gap-free stretch has {longest} frames, but a spectrum requires {SHORTEST}"}
    calibration = run.history.calibration
    groups = groups_of(calibration.noll if calibration is not None else ())
    noise = noise_of(run.history, stretch.rows)
    noise_nm2_hz = None if noise is None else 2 * noise.total_nm**2 / stretch.law.rate_hz
    return {
        "segments": spectra[ERROR].segments,
        "resolution_hz": spectra[ERROR].spacing_hz,
        "groups": [_group(name, mask, stretch.law, spectra, noise_nm2_hz) for name, mask in groups.items()],
    }


def _group(name: str, modes: Mask, law: LinearLaw, spectra: Spectra, noise_nm2_hz: Array | None) -> Results:
    """Spectra of one group; modes are summed in power."""

    def total(one: Spectrum) -> Array:
        return np.asarray(one.power_nm2_hz[:, modes].sum(axis=1))

    error, pol, *true = spectra
    frequency_hz = pol.frequency_hz
    power_rejection = rejection(law, frequency_hz)[:, modes] ** 2
    columns = {
        "pseudo_open_loop": total(pol),
        "error": total(error),
        "error_predicted": (power_rejection * pol.power_nm2_hz[:, modes]).sum(axis=1),
    }
    if true:
        disturbance, residual = true
        rejected = (power_rejection * disturbance.power_nm2_hz[:, modes]).sum(axis=1)
        columns |= {"disturbance": total(disturbance), "residual": total(residual), "disturbance_left": rejected}
        if noise_nm2_hz is not None:
            added = noise_transfer(law, frequency_hz)[:, modes] ** 2 * noise_nm2_hz[modes]
            columns["residual_predicted"] = rejected + added.sum(axis=1)
    centres_hz, means = means_in_bins(frequency_hz, list(columns.values()))
    binned = dict(zip(columns, means, strict=True))
    ratios = {"measured_over_theory": _amplitude_ratio(binned["error"], binned["error_predicted"])}
    if "residual_predicted" in binned:
        ratios["true_over_theory"] = _amplitude_ratio(binned["residual"], binned["residual_predicted"])
    highest_hz = float(frequency_hz[-1])
    lowest_hz = float(frequency_hz[1])  # slower drift is mostly removed with the mean of each segment
    edges_hz = [lowest_hz, *(edge for edge in BANDS_HZ if lowest_hz < edge < highest_hz), highest_hz]
    bands = [
        {"from_hz": low, "to_hz": high}
        | {f"{key}_rms_nm": _band_rms(frequency_hz, column, low, high) for key, column in columns.items()}
        for low, high in pairwise(edges_hz)
    ]
    return {
        "name": name,
        **ratios,
        "bands": bands,
        "frequency_hz": centres_hz.tolist(),
        "power_nm2_hz": {key: column.tolist() for key, column in binned.items()},
    }


def _amplitude_ratio(measured: Array, theory: Array) -> Results:
    """Ratio of measured to theoretical amplitude from powers (bins,): median, 5th and 95th percentile over the bins."""
    positive = (theory > 0) & (measured > 0)
    if not positive.any():
        return {"median": None, "p5": None, "p95": None}
    p5, median, p95 = np.percentile(np.sqrt(measured[positive] / theory[positive]), [5, 50, 95])
    return {"median": float(median), "p5": float(p5), "p95": float(p95)}


def _band_rms(frequency_hz: Array, power: Array, low_hz: float, high_hz: float) -> float:
    inside = (frequency_hz >= low_hz) & ((frequency_hz < high_hz) | (high_hz == frequency_hz[-1]))
    return float(np.sqrt(power[inside].sum() * frequency_hz[1]))


def noise_of(history: History, rows: slice) -> SensorNoise | None:
    """Sensor noise of one frame at the flux of these steps, through the reconstructor in use at the last of them.

    None if the log lacks calibration, flux, or the camera's gain.
    """
    camera, calibration = history.camera, history.calibration
    flux_dn = history.steps.flux_dn[rows]
    flux_dn = flux_dn[flux_dn > 0]
    if camera is None or calibration is None or not flux_dn.size or not camera.gain_e_per_dn:
        return None
    charge_e = 0.0
    if history.configuration is not None:
        if not history.configuration.camera.noise:
            nothing = np.zeros(len(calibration.noll))
            return SensorNoise(nothing, nothing)
        charge_e = history.configuration.dark_e
    end = history.steps.sequence[rows][-1]
    newest = np.array([state.frame_sequence for state in history.controllers], np.uint64)
    # A state without a frame, after a start or `clear`, counts from the next frame.
    from_frame = np.maximum.accumulate(newest) + (newest == 0)
    count = np.searchsorted(from_frame, end, side="right")
    in_use = calibration_in_use(history.controllers[count - 1], calibration) if count else calibration
    em_gain = max(camera.em_gain, 1.0)
    excess = 2.0 if em_gain > 1 else 1.0
    readout_e2 = camera.read_noise_e**2 + camera.gain_e_per_dn**2 / 12  # after the EM gain; with rounding to whole DN
    return sensor_noise(
        in_use.reconstructor.astype(float),
        calibration.reference.astype(float),
        float(flux_dn.mean()) * camera.gain_e_per_dn / em_gain,
        float(np.sqrt(readout_e2 / em_gain**2 + excess * charge_e)),
        excess,
    )
