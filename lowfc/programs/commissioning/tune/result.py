"""The result of `lowfc tune`: the present residual, and the residual predicted for the tuned law."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from lowfc.arrays import Array
from lowfc.control.laws import margins
from lowfc.control.laws.continuous import Timing, residual_spectrum
from lowfc.control.laws.integrator import TIP_TILT
from lowfc.control.laws.linear_law import LinearLaw, integrator
from lowfc.control.laws.spectra import means_in_bins, spectrum
from lowfc.control.laws.tuning import (
    Gains,
    Tuned,
    best_gains,
    fine_frequencies,
    frame_noise_nm2,
    identify_modes,
    predicted_covariance_nm2,
    predicted_nm,
    tune_integrator,
    tune_lqg,
    tune_pi_notch,
)
from lowfc.control.laws.vibration import Model
from lowfc.control.loop.wording import counted
from lowfc.optics.chain.zernike import mode_name
from lowfc.programs.cli.contrast import added_contrast, added_contrast_in_words, with_variances
from lowfc.programs.cli.result import Result, result_field
from lowfc.programs.commissioning.tune.data import Telemetry

OPTICAL_GAIN_MAS = 10.0
"""Open-loop tilt, rms per axis, above which the optical gain of the sensor is low."""


def tuned(data: Telemetry, controller: str) -> tuple[Tuned, Gains]:
    """The best law of a kind for a run; ValueError if there are too few frames, or no law of this kind is stable."""
    leak = data.integrator.leak.astype(np.float64)
    gains = best_gains(data.pol, data.rate_hz, data.timing, leak)
    models = identify_modes(data.pol, data.rate_hz)
    match controller:
        case "integrator":
            return tune_integrator(models, gains, data.noll, leak, data.timing), gains
        case "pi-notch":
            return tune_pi_notch(models, gains, data.noll, leak, data.timing), gains
        case _:
            return tune_lqg(data.pol, models, gains, data.noll, leak, data.timing), gains


class TunedMode(Result):
    """A mode: residual now and with the tuned law, nm rms of wavefront, and the margins of the tuned law."""

    noll: int = result_field("mode", form="Z{}")
    name: str = result_field("name")
    gain_now: float | None = result_field("gain now", form=".3g")
    gain_best: float = result_field("best gain", form=".2f")
    achieved_nm: float | None = result_field("achieved", "nm", ".3f")
    predicted_now_nm: float | None = result_field("theory now", "nm", ".3f")
    kind: str = result_field("tuned law")
    predicted_nm: float = result_field("predicted", "nm", ".3f")
    integrator_predicted_nm: float = result_field()
    noise_nm: float = result_field()
    gain_margin: float | None = result_field("gain margin", form=".2f")
    phase_margin_deg: float = result_field("phase margin", "deg", ".0f")
    max_rejection: float = result_field("max |S|", form=".2f")
    lines: list[dict[str, float]] = result_field()

    def remarks(self) -> Sequence[str]:
        """The detected lines, after the row."""
        shown = [f"{line['frequency_hz']:.2f} Hz ({line['rms_nm']:.2g} nm)" for line in self.lines]
        return [", ".join(shown)] if shown else []


class TuneResult(Result):
    """The best law of a kind for a run, and its predicted residual."""

    source: str = result_field()
    controller: str = result_field()
    law_now: str = result_field()
    rate_hz: float = result_field()
    delay_frames: float = result_field()
    closed: bool = result_field()
    frames_closed: int = result_field(exclude=True)
    frames: int = result_field()
    achieved_from: str | None = result_field()
    tilt_mas: dict[str, float | None] = result_field()
    added_contrast: dict[str, Any] | None = result_field()
    gain_margin: float | None = result_field()
    phase_margin_deg: float = result_field()
    max_rejection: float = result_field()
    modes: list[TunedMode] = result_field()
    warnings: list[str] = result_field()
    files: list[str] = result_field(default=[])
    applied: str | None = result_field(default=None)

    def head(self) -> Sequence[str]:
        """Source of the tuning data."""
        partly_closed = f"closed in {self.frames_closed} of them" if self.frames_closed else "open"
        return [
            f"{self.source}: {counted(self.frames, 'frame')} at {self.rate_hz:.4g} Hz, loop "
            f"{'closed' if self.closed else partly_closed}, delay {self.delay_frames:.2f} frames, law {self.law_now}"
        ]

    def remarks(self) -> Sequence[str]:
        """Tilt and contrast, warnings, and the actions taken."""
        tilt = {name: rms for name, rms in self.tilt_mas.items() if rms is not None}
        names = {"predicted": f"predicted ({self.controller})", "integrator_predicted": "best integrator"}
        cases = ", ".join(f"{names.get(name, name)} {rms:.2f}" for name, rms in tilt.items())
        return [
            *([f"tilt per axis, mas rms: {cases}"] if tilt else []),
            *([] if self.added_contrast is None else [added_contrast_in_words(self.added_contrast)]),
            *(f"warning: {warning}" for warning in self.warnings),
            *(f"written: {file}" for file in self.files),
            *([] if self.applied is None else [self.applied]),
        ]


def result_of(data: Telemetry, best: Tuned, gains: Gains, controller: str) -> TuneResult:
    """Predicted residual of a tuned law, with the residual of the run."""
    now, stable = _present_law(data)
    leak = data.integrator.leak.astype(np.float64)
    integrators = tune_integrator(best.models, gains, data.noll, leak, data.timing)
    now_nm = predicted_nm(now, best.models, data.timing) if stable else None
    achieved_nm = _achieved_nm(data, gains.noise_nm)
    has_truth = data.true_nm2 is not None or data.continuous_rms_nm is not None
    if achieved_nm is not None and now_nm is not None and data.continuous_rms_nm is None:
        # The frames give the residual at one instant per frame; theory adds the residual between these instants.
        sampled_nm = predicted_nm(now, best.models, Timing.sampled(data.timing.delay))
        achieved_nm = np.sqrt(np.maximum(achieved_nm**2 + now_nm**2 - sampled_nm**2, 0.0))
    mean_nm = max(data.pol.values, key=len).mean(axis=0)

    def with_mean(law: LinearLaw, changing_nm: Array) -> Array:
        """Rms (modes,) with what a leak leaves of the disturbance's mean, which the models omit."""
        return np.asarray(np.hypot(changing_nm, mean_nm * margins.rejection(law, np.zeros(1))[0]))

    best_nm, integrator_nm = (with_mean(each.law, each.predicted_nm) for each in (best, integrators))
    columns = {
        "achieved_nm": achieved_nm,
        "predicted_now_nm": None if now_nm is None else with_mean(now, now_nm),
        "predicted_nm": best_nm,
        "integrator_predicted_nm": integrator_nm,
        "gain_now": None if data.law else data.integrator.gain.astype(float).round(6),
        "gain_best": gains.gain.round(4),
        "phase_margin_deg": best.margins.phase_margin_deg,
        "max_rejection": best.margins.peak,
    }
    modes = [
        TunedMode(
            noll=noll,
            name=mode_name(noll),
            kind=best.kinds[k],
            noise_nm=np.sqrt(best.models[k].noise_nm2),
            gain_margin=_finite(float(best.margins.gain_margin[k])),
            lines=_lines(best.models[k]),
            **{name: None if each is None else each[k] for name, each in columns.items()},
        )
        for k, noll in enumerate(data.noll)
    ]
    rms_nm = {
        "open": np.sqrt(np.mean(data.pol.joined() ** 2, axis=0)),
        "achieved": achieved_nm,
        "predicted": best_nm,
        "integrator_predicted": integrator_nm,
    }
    tilt_mas = {name: _tilt_mas(data, each) for name, each in rms_nm.items()}
    return TuneResult(
        source=data.source,
        controller=controller,
        law_now=now.name,
        rate_hz=data.rate_hz,
        delay_frames=data.timing.delay,
        closed=data.closed,
        frames_closed=data.frames_closed,
        frames=data.pol.frames,
        achieved_from=None if achieved_nm is None else "truth" if has_truth else "error less noise",
        tilt_mas=tilt_mas,
        added_contrast=_added_contrast(data, best, now, achieved_nm, best_nm),
        gain_margin=_finite(float(best.margins.gain_margin.min())),
        phase_margin_deg=best.margins.phase_margin_deg.min(),
        max_rejection=best.margins.peak.max(),
        modes=modes,
        warnings=[*data.warnings, *_doubts(data, tilt_mas["open"], stable)],
    )


def picture(data: Telemetry, best: Tuned) -> bytes:
    """PNG: spectra of the two largest modes: measured, modelled, and predicted with the present and the tuned law."""
    from lowfc.adapters.files.drawing import figure_class, png

    drawing = figure_class()(figsize=(10, 8), layout="constrained")
    pol_spectrum = spectrum(data.pol, data.rate_hz)
    assert pol_spectrum is not None  # noqa: S101  # tuning needs more frames than a spectrum
    largest = np.sort(np.argsort(-pol_spectrum.variance_nm2())[:2])
    shown_hz = pol_spectrum.frequency_hz[1:]
    edges = np.append(shown_hz - pol_spectrum.spacing_hz / 2, shown_hz[-1]) * 2 * np.pi / data.rate_hz
    noise_nm2 = np.array([each.noise_nm2 for each in best.models])
    closed = spectrum(data.error, data.rate_hz) if data.closed else None
    now, stable = _present_law(data)
    for axes, mode in zip(drawing.subplots(2, 1, sharex=True), largest.tolist(), strict=False):
        omega = fine_frequencies(best.models[mode])
        modelled = best.models[mode].spectrum_nm2(omega) + noise_nm2[mode]
        measured = np.repeat(modelled[:, None], len(noise_nm2), axis=1)  # only the column of this mode is used
        curves = {"model of the pseudo-open-loop": ("tab:blue", modelled)}
        laws = {"present law": ("black", now)} if stable else {}
        for name, (colour, law) in {**laws, f"tuned law ({best.kinds[mode]})": ("tab:green", best.law)}.items():
            residual = residual_spectrum(law, omega, measured, noise_nm2, data.timing)[:, mode]
            curves[f"predicted true residual with the {name}"] = colour, residual
        axes.loglog(shown_hz, pol_spectrum.power_nm2_hz[1:, mode], color="0.6", label="pseudo-open-loop")
        if closed is not None:
            binned_hz, (power,) = means_in_bins(closed.frequency_hz, [closed.power_nm2_hz[:, mode]])
            axes.loglog(binned_hz, power, color="tab:orange", label="measured error")
        for label, (colour, power) in curves.items():
            axes.loglog(shown_hz, 2 / data.rate_hz * _means(power, omega, edges), color=colour, lw=1, label=label)
        axes.set(ylabel=f"Z{data.noll[mode]} {mode_name(data.noll[mode])}, nm$^2$/Hz")
        axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1), ncols=2, frameon=False)  # above all lines
    axes.set(xlabel="frequency, Hz")
    return png(drawing)


def _present_law(data: Telemetry) -> tuple[LinearLaw, bool]:
    """The law in force, and whether it is stable with the run's delay."""
    law = data.law or integrator(data.integrator.gain, data.integrator.leak, data.noll, data.timing.delay, data.rate_hz)
    return law, margins.margins(law, data.timing.delay).stable


def _means(power: Array, omega: Array, edges: Array) -> Array:
    """Mean power between neighbouring `edges`; `omega` and `edges` in rad per frame. Narrow lines keep their power."""
    total = np.append(0, np.cumsum((power[1:] + power[:-1]) / 2 * np.diff(omega)))
    return np.asarray(np.diff(np.interp(edges, omega, total)) / np.diff(edges))


def _added_contrast(
    data: Telemetry, best: Tuned, now: LinearLaw, closed_nm: Array | None, best_nm: Array
) -> dict[str, Any] | None:
    """Contrast added to the dark zone: in open loop, in closed loop as measured, and predicted with the tuned law."""
    if data.noise_nm2 is None:
        return None
    opened, closed = data.pol.joined(), None
    if closed_nm is not None:
        instants_nm2 = data.true_nm2
        if instants_nm2 is None:  # predicted: the measured error contains noise that may exceed the residual
            instants_nm2 = predicted_covariance_nm2(now, best.models, data.noise_nm2, data.timing)
        closed = with_variances(instants_nm2, closed_nm)
    return added_contrast(
        data.contrast,
        {
            "open": opened.T @ opened / len(opened) - frame_noise_nm2(best.models, data.noise_nm2),
            "closed": closed,
            "predicted": with_variances(
                predicted_covariance_nm2(best.law, best.models, data.noise_nm2, data.timing), best_nm
            ),
        },
    )


def _achieved_nm(data: Telemetry, noise_nm: Array) -> Array | None:
    """Rms (modes,) of the true residual, over all time if known; else of the error without its noise; None if open."""
    if not data.closed:
        return None
    if data.continuous_rms_nm is not None:
        return data.continuous_rms_nm
    if data.true_nm2 is not None:
        return np.asarray(np.sqrt(np.diag(data.true_nm2)))
    squares = np.mean(data.error.joined() ** 2, axis=0)
    return np.asarray(np.sqrt(np.maximum(squares - noise_nm**2, 0.0)))


def _lines(model: Model) -> list[dict[str, float]]:
    return [
        {
            "frequency_hz": round(line.frequency_hz, 4),
            "width_hz": float(f"{line.width_hz:.3g}"),
            "rms_nm": float(f"{np.sqrt(line.variance_nm2):.4g}"),
        }
        for line in model.lines
    ]


def _tilt_mas(data: Telemetry, rms_nm: Array | None) -> float | None:
    tilts = np.isin(data.noll, TIP_TILT)
    if rms_nm is None or data.nm_per_mas is None or not tilts.any():
        return None
    return float(np.sqrt(np.mean(rms_nm[tilts] ** 2))) / data.nm_per_mas


def _doubts(data: Telemetry, open_mas: float | None, stable: bool) -> list[str]:
    doubts = []
    if not data.closed and open_mas is not None and open_mas > OPTICAL_GAIN_MAS:
        doubts.append(
            f"an open loop with {open_mas:.1f} mas rms of tilt per axis, above {OPTICAL_GAIN_MAS:g}: the optical gain "
            "of the sensor is low, and some lines are spurious; close the loop with any stable gain and tune again"
        )
    if not stable:
        doubts.append("the present law is unstable with this delay: theory cannot predict its residual")
    return doubts


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None
