"""The error budget of a run's longest closed-loop stretch; each term with its source."""

from dataclasses import replace

import numpy as np

from lowfc.arrays import Mask
from lowfc.control.laws.error_budget import SensorNoise, Term, lag, lag_under_noise, measurement_error, white_noise
from lowfc.programs.logs.report import closed_loop
from lowfc.programs.logs.report.closed_loop import DISTURBANCE, ERROR, POL, SENSED, Spectra, Stretch, noise_of
from lowfc.programs.logs.report.source import Results, Run

Masks = dict[str, Mask]

Entry = tuple[Term | None, str]
"""A term and its source; or None, and what the term would require."""

_TIMES_TRANSFER = "times the loop's noise transfer"
_NOISE_REQUIRES = "a calibration, light, and the camera's gain"
_SPECTRA_REQUIRE = "a longer stretch with the loop closed"


def budget_results(
    run: Run, stretch: Stretch | None, spectra: Spectra | None, masks: Masks, *, shaped: bool
) -> Results:
    """Terms, their sum and the values to compare it with, in nm rms over each group of modes.

    A true residual that is `shaped` by offset or channels is left out: it contains their shapes.
    """
    if stretch is None:
        return {"why_not": closed_loop.why_no_stretch(run)}
    noise = noise_of(run.history, stretch.rows)
    terms = _terms(stretch, spectra, noise, shaped=shaped)
    rows = [
        {"name": name, "how": how} | _columns(term, masks) | {"missing": term is None}
        for name, (term, how) in terms.items()
    ]
    found = [term for term, _ in terms.values() if term is not None]
    total = Term(np.sum([np.maximum(term.variance_nm2, 0) for term in found], axis=0)) if found else None
    missing = [name for name, (term, _) in terms.items() if term is None]
    true = None
    if stretch.residual_ms_nm2 is not None and stretch.series.values and not shaped:
        true = Term(stretch.residual_ms_nm2)
    measured = Term(np.mean(stretch.signal(ERROR).joined() ** 2, axis=0)) if stretch.series.values else None
    return {
        "terms": rows,
        "sum": _columns(total, masks),
        "sum_lacks": missing,
        "true_residual": _columns(true, masks),
        "measured_error": _columns(measured, masks),
        "sum_over_true": _ratios(total, true, masks),
        "frame_noise": None
        if noise is None
        else {
            "photon_nm": noise.photon_nm.tolist(),
            "read_nm": noise.read_nm.tolist(),
            "total_nm": noise.total_nm.tolist(),
        },
    }


def _terms(stretch: Stretch, spectra: Spectra | None, noise: SensorNoise | None, *, shaped: bool) -> dict[str, Entry]:
    """Each term and its source, or None and what the term would require."""
    law, timing = stretch.law, stretch.timing
    entries: dict[str, Entry] = {}
    if noise is None:
        entries = dict.fromkeys(("photon noise", "read noise"), (None, f"requires {_NOISE_REQUIRES}"))
    else:
        for name, frame_nm, source in (
            ("photon noise", noise.photon_nm, "measured flux"),
            ("read noise", noise.read_nm, "camera's read noise, rounding and dark charge"),
        ):
            how = f"{source}, through the reconstructor, {_TIMES_TRANSFER}"
            how = how if noise.total_nm.any() else "the simulation has no noise"
            entries[name] = (white_noise(law, frame_nm, timing), how)
    if spectra is None:
        entries["lag"] = (None, f"requires {_SPECTRA_REQUIRE}")
    elif stretch.true:
        mean_nm = stretch.signal(DISTURBANCE).joined().mean(axis=0)
        how = "spectrum of the true disturbance times the rejection"
        entries["lag"] = (lag(law, spectra[DISTURBANCE], mean_nm, timing), how)
    else:
        mean_nm = stretch.signal(POL).joined().mean(axis=0)
        how = "pseudo-open-loop spectrum minus its noise floor, times the rejection"
        entries["lag"] = (lag_under_noise(law, spectra[POL], mean_nm, timing), how)
    crosstalk, nonlinearity = _measurement_terms(stretch, noise, shaped=shaped)
    entries["cross-talk and aliasing"] = crosstalk
    entries["nonlinearity"] = nonlinearity
    return entries


def _measurement_terms(stretch: Stretch, noise: SensorNoise | None, *, shaped: bool) -> tuple[Entry, Entry]:
    split, missing = None, _SPECTRA_REQUIRE
    if not stretch.true:
        missing = "the true wavefront, known only in simulation"
    elif shaped:
        missing = "a stretch without offset and channels, whose shapes are in the true residual"
    elif noise is None:
        missing = _NOISE_REQUIRES
    else:
        error, pol = stretch.signal(ERROR), stretch.signal(POL)
        command_seen = replace(error, values=tuple(a - b for a, b in zip(error.values, pol.values, strict=True)))
        split = measurement_error(stretch.law, error, stretch.signal(SENSED), command_seen, noise.total_nm)
    if split is None:
        unknown = (None, f"requires {missing}")
        return unknown, unknown
    linear = "linear part of (error - true residual): fit to a constant, the residual and the command"
    remainder = "remainder of (error - true residual) beyond the noise of a frame"
    return (split.crosstalk, f"{linear}, {_TIMES_TRANSFER}"), (split.nonlinearity, f"{remainder}, {_TIMES_TRANSFER}")


def _columns(term: Term | None, masks: Masks) -> Results:
    """Rms of a term in each group, nm; `upper_limit` names the groups in which the term was not detected."""
    if term is None:
        return {"rms_nm": dict.fromkeys(masks), "upper_limit": []}
    totals = {name: term.total(mask) for name, mask in masks.items()}
    return {
        "rms_nm": {name: rms_nm for name, (rms_nm, _) in totals.items()},
        "upper_limit": [name for name, (_, detected) in totals.items() if not detected],
    }


def _ratios(total: Term | None, true: Term | None, masks: Masks) -> dict[str, float | None]:
    if total is None or true is None:
        return dict.fromkeys(masks)
    ratios = {}
    for name, mask in masks.items():
        true_nm = true.total(mask)[0]
        ratios[name] = total.total(mask)[0] / true_nm if true_nm > 0 else None
    return ratios
