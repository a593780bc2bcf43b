"""Figures 1 and 7: an aberration of lambda/30 of focus and of coma, its effect on the contrast, and its estimate."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from lowfc.arrays import Array
from lowfc.design.trials import residual_pv
from lowfc.optics.chain.coronagraph import Wedge, contrast_curve, mean_contrast, wedge_samples
from lowfc.optics.chain.zernike import NOLLS_14
from lowfc.programs.paper import plots
from lowfc.programs.paper.cases import Case, Context, Prepared, Row, assuming, prepared
from lowfc.programs.paper.figures.exposure import (
    BRIGHT,
    ESTIMATORS,
    FULL_CHAIN,
    MODES,
    PINV,
    WEIGHTED_1,
    WEIGHTED_2,
)
from lowfc.programs.paper.tables.reconstruction import bound_nm2, exposed_e, fits, iterated_nm, mean_and_error

COMAS = (7, 8)  # Noll indices
REALISATIONS = 20
_CORRECTING = (PINV, WEIGHTED_1, WEIGHTED_2)  # estimators whose corrections are evaluated
_RING = Wedge(4.5, 5.5)  # radii in lambda/D
_VIEW = 20  # half width of a picture, lambda/D
_VIEW_SAMPLES_PER, _FINE_SAMPLES_PER = 6, 10  # per lambda/D
_CURVE_EDGES = np.arange(0.25, 20.5, 0.5)  # radii between the rings of a contrast curve, lambda/D
_LIMIT_DRAWS = 400  # residuals drawn from the Cramer-Rao bound
_PAPER_GOAL = 1e-9  # contrast
_PAPER_RATIO = 100.0  # contrast with the aberration divided by that of the flat wavefront
_PAPER_PV_WAVES = 6e-3


@dataclass(frozen=True, eq=False)
class _Aberration:
    """One aberration (modes,), and the residuals (realisations, modes) after its correction, by estimator."""

    sensor: Prepared
    truth_nm: Array
    residuals_nm: dict[str, Array]


@lru_cache(maxsize=8)
def _aberrated(context: Context, name: str, coma: int) -> _Aberration:
    """lambda/30 of focus and of the coma with Noll index `coma`, and the residuals after correction with one sensor."""
    sensor = prepared(name)
    truth_nm = np.zeros(MODES)
    truth_nm[[NOLLS_14.index(4), NOLLS_14.index(coma)]] = sensor.optics.wavelength_nm / 30.0
    image, linear = sensor.image(truth_nm), fits(sensor, MODES)
    sensor.model(truth_nm)  # builds the twin before the threads use it

    def estimate(i: int) -> dict[str, Array]:
        return iterated_nm(sensor, linear, exposed_e(sensor, image, context.rng("focus and coma", name, coma, i)))

    results = context.map(f"{name}, coma Z{coma}", estimate, range(min(context.trials, REALISATIONS)))
    return _Aberration(
        sensor, truth_nm, {key: truth_nm - np.stack([each[key] for each in results]) for key in ESTIMATORS}
    )


@assuming(
    "Contrast: mean from 4.5 to 5.5 lambda/D within 42.5 degrees of the x axis, over the peak of the star with a flat "
    "wavefront. paper: its goal, and 'over a factor of 100'; it does not specify the coma. Corrected: mean of at "
    f"most {REALISATIONS} exposures; limit: the flat wavefront. {BRIGHT} {FULL_CHAIN}"
)
def fig1(context: Context) -> Iterator[Row]:
    """Rows of the contrast at 5 lambda/D, Fig. 1(c), and of the contrast between the design's points."""
    for name in context.names("sam"):
        yield from _between_samples(prepared(name))
        for coma in COMAS:
            aberration = _aberrated(context, name, coma)
            sensor, row_name = aberration.sensor, f"{name}, coma Z{coma}"
            flat, aberrated = _contrast(sensor, 0.0 * aberration.truth_nm), _contrast(sensor, aberration.truth_nm)
            yield Row(row_name, "contrast, flat wavefront", "", flat, _PAPER_GOAL)
            yield Row(row_name, "contrast, aberrated", "", aberrated)
            yield Row(row_name, "contrast, aberrated / flat wavefront", "", aberrated / flat, _PAPER_RATIO)
            for key in _CORRECTING:
                corrected = context.map(f"{row_name}, {key}", partial(_contrast, sensor), aberration.residuals_nm[key])
                mean, error = mean_and_error(np.array(corrected))
                fitted = partial(Row, row_name, modes=MODES, estimator=key)
                yield fitted("contrast, corrected", "", mean, error=error, limit=flat)
                yield fitted("contrast, corrected / flat wavefront", "", mean / flat, error=error / flat, limit=1.0)


def _between_samples(sensor: Prepared) -> list[Row]:
    """Rows of the dark zone's contrast halfway between the points at which the pupil's design limits it."""
    columns = 2 * _VIEW * _FINE_SAMPLES_PER
    image = sensor.star_image(np.zeros(MODES), columns, _FINE_SAMPLES_PER)
    zone = image[wedge_samples(sensor.coronagraph.dark_zone, columns, columns, _FINE_SAMPLES_PER)]
    row_name = f"{sensor.name}, dark zone, {_FINE_SAMPLES_PER} samples per lambda/D"
    return [
        Row(row_name, "largest contrast, flat wavefront", "", float(zone.max()), _PAPER_GOAL),
        Row(row_name, f"samples above 1e-9, of {zone.size}", "", float((zone > _PAPER_GOAL).sum())),
    ]


def plot_fig1(context: Context, path: Path) -> None:
    """Draw Fig. 1: point spread functions and contrast curves; a row for each coma."""
    name = context.names("sam")[0]
    panels: list[plots.Panel] = []
    for coma in COMAS:
        aberration = _aberrated(context, name, coma)
        sensor, truth_nm, flat_nm = aberration.sensor, aberration.truth_nm, 0.0 * aberration.truth_nm
        for title, modes_nm in (("flat wavefront", flat_nm), (f"$\\lambda$/30 of Z4 and of Z{coma}", truth_nm)):
            image = sensor.star_image(modes_nm, 2 * _VIEW * _VIEW_SAMPLES_PER, _VIEW_SAMPLES_PER)
            panels.append(plots.picture(image, title, plots.SKY, _VIEW, (1e-11, 1.0), "contrast", "log"))
        middles = (_CURVE_EDGES[1:] + _CURVE_EDGES[:-1]) / 2.0
        wavefronts = {"flat": flat_nm, "aberrated": truth_nm}
        wavefronts |= {key: aberration.residuals_nm[key][0] for key in _CORRECTING}
        lines = [plots.Line(key, middles, _curve(sensor, modes_nm)) for key, modes_nm in wavefronts.items()]
        panels.append(
            plots.curves(lines, f"Z{coma}, corrected by {name}", f"radius, {plots.SKY_UNIT}", "contrast", "log")
        )
    pupil = "shaped pupil" if prepared(name).coronagraph.lyot is None else "Lyot coronagraph"
    plots.draw(
        path,
        panels,
        f"Fig. 1. The star behind the {pupil}, and the contrast averaged in azimuth within 42.5 degrees of the x "
        f"axis; each correction is one estimate. {BRIGHT}",
    )


@assuming(
    f"lambda/30 of Z4 and of one coma, which the paper does not specify; mean of at most {REALISATIONS} exposures, "
    f"over the open pupil; limit: mean of {_LIMIT_DRAWS} residuals drawn from the Cramer-Rao bound. "
    f"{BRIGHT} {FULL_CHAIN}"
)
def fig7(context: Context) -> Iterator[Row]:
    """Peak-to-valley residual of the estimate, Fig. 7(c)."""
    for name in context.names("sam"):
        sensor = prepared(name)
        basis, wavelength_nm = sensor.open_modes[:MODES], sensor.optics.wavelength_nm
        root = np.linalg.cholesky(bound_nm2(sensor, MODES))
        drawn_nm = context.rng("focus and coma", "limit").standard_normal((_LIMIT_DRAWS, MODES)) @ root.T
        limit = float(residual_pv(basis, drawn_nm).mean()) / wavelength_nm
        paper = _PAPER_PV_WAVES if sensor.paper_name == "sam" else None
        for coma in COMAS:
            for key, residuals_nm in _aberrated(context, name, coma).residuals_nm.items():
                mean, error = mean_and_error(residual_pv(basis, residuals_nm) / wavelength_nm)
                fitted = partial(Row, f"{name}, coma Z{coma}", modes=MODES, estimator=key)
                yield fitted("P-V residual", "waves", mean, paper, error, limit=limit)


def plot_fig7(context: Context, path: Path) -> None:
    """Draw Fig. 7: input, estimate and residuals; a row for each coma."""
    name = context.names("sam")[0]
    panels: list[plots.Panel] = []
    for coma in COMAS:
        aberration = _aberrated(context, name, coma)
        residuals = {key: aberration.residuals_nm[key][0] for key in (PINV, WEIGHTED_1)}
        for title, modes_nm, bound in (
            (f"input, $\\lambda$/30 of Z4 and of Z{coma}", aberration.truth_nm, 0.1),
            (f"estimate, {WEIGHTED_1}", aberration.truth_nm - residuals[WEIGHTED_1], 0.1),
            *((f"residual, {key}", modes_nm, 0.006) for key, modes_nm in residuals.items()),
        ):
            waves = aberration.sensor.opd_nm(modes_nm) / aberration.sensor.optics.wavelength_nm
            inside = waves[aberration.sensor.open]
            shown = np.where(aberration.sensor.open, waves - inside.mean(), np.nan)
            title = f"{title}\nP-V {np.ptp(inside):.2g} waves"
            panels.append(plots.picture(shown, title, plots.PUPIL, 0.5, (-bound, bound), "waves", "signed"))
    plots.draw(path, panels, f"Fig. 7. One estimate of {name}. {BRIGHT}", columns=4)


def _contrast(sensor: Prepared, modes_nm: Array) -> float:
    """Mean contrast from 4.5 to 5.5 lambda/D with a wavefront (modes,)."""
    return mean_contrast(sensor.coronagraph, sensor.opd_nm(modes_nm), sensor.optics.wavelength_nm, _RING)


def _curve(sensor: Prepared, modes_nm: Array) -> Array:
    """Mean contrast (rings,) between the radii `_CURVE_EDGES` with a wavefront (modes,)."""
    return contrast_curve(sensor.coronagraph, sensor.opd_nm(modes_nm), sensor.optics.wavelength_nm, _CURVE_EDGES)


CASES = {
    "fig1": Case("Fig. 1: point spread function and contrast: flat, aberrated, corrected", fig1, plot_fig1),
    "fig7": Case("Fig. 7: estimate of lambda/30 of focus and of coma", fig7, plot_fig7),
}
