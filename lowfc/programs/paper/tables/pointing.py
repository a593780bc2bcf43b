"""Table 4: scatter of tilt estimates from short exposures of a star, with the paper's flux and with our own."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from itertools import product

import numpy as np

from lowfc.arrays import Array
from lowfc.design.estimators import KINDS, Fit, estimate
from lowfc.design.fisher import covariance, cramer_rao, variance_e2
from lowfc.design.paper import STAR, TABLE4_EXPOSURE_S, TABLE4_MAS, TABLE4_READ_NOISE_E
from lowfc.design.trials import noisy_e
from lowfc.optics.chain.relay import ApertureMask
from lowfc.optics.detector.photometry import electrons, tilt_nm_per_mas
from lowfc.programs.paper.cases import Context, Prepared, Row, prepared, sparse_apertures

OTHER_SENSORS = ("clowfs", "clowfs:1", "clowfs_tuned", "zwfs", "zwfs_tuned")
"""Sensors in addition to the packaged sparse apertures."""
FITTED = {1: (2, 14, 20), 10: (2, 14)}
"""Numbers of fitted modes, tip and tilt first, by the tilt in mas."""
NM_PER_MAS = tilt_nm_per_mas(STAR.diameter_m)

PAPER_PUPIL, PAPER_FOCAL_MASK, PAPER_RELAY_MASK = 0.147, 0.567, 0.091
"""The paper's throughputs of three elements, each relative to the light that reaches the element."""
SCALED_PUPIL = "scaled photometry"
"""Name of our own photometry with the transmission of the paper's pupil."""

ASSUMPTION = (
    "Band in five wavelengths, both ends included, H averaged over it, 1 e- read noise, whole electrons, total flux "
    "known. The paper does not say how many modes it fits; its values agree only with two, tip and tilt. A loop on 14 "
    "modes has the noise of a fit of 14. predicted: noise of the tilted image, through the estimator. limit: the "
    "Cramer-Rao bound at the flat wavefront. At 10 mas the weights are still those of the flat image, which costs a "
    "few per cent."
)

CENTRED = "paper: 'the estimate distribution is centered on the true value'; predicted: from the image without noise."


@dataclass(frozen=True)
class Exposure:
    """Flux in an exposure: a name for it, electrons of the open circle's light, and how they were determined."""

    name: str
    scale_e: float
    assumption: str


def paper_count_e(sensor: Prepared) -> float:
    """Electrons on the sensor with the paper's throughputs."""
    relay = PAPER_RELAY_MASK if isinstance(sensor.optics.relay, ApertureMask) else 1.0
    return electrons(STAR, TABLE4_EXPOSURE_S) * PAPER_PUPIL * PAPER_FOCAL_MASK * relay


def exposures(sensor: Prepared) -> tuple[Exposure, Exposure]:
    """The exposures with the paper's electron count and with our own."""
    on_sensor, own = float(sensor.band_I0.sum()), electrons(STAR, TABLE4_EXPOSURE_S)
    count = paper_count_e(sensor)
    return (
        Exposure(
            "paper's electrons", count / on_sensor, f"{count:.3g} e- on the sensor, with the paper's throughputs."
        ),
        Exposure(
            "own photometry",
            own,
            f"{own * on_sensor:.3g} e- on the sensor: V = {STAR.magnitude}, {STAR.diameter_m:g} m, "
            f"{TABLE4_EXPOSURE_S} s, {STAR.bandwidth_nm:g} nm and our own masks.",
        ),
    )


def with_paper_pupil(sensor: Prepared) -> Exposure:
    """Own photometry with our pupil's transmission scaled to the paper's."""
    own = electrons(STAR, TABLE4_EXPOSURE_S) * PAPER_PUPIL / sensor.budget.pupil
    return Exposure(
        SCALED_PUPIL,
        own,
        f"{own * float(sensor.band_I0.sum()):.3g} e- on the sensor: pupil transmission scaled from "
        f"{100 * sensor.budget.pupil:.1f} to {100 * PAPER_PUPIL:g} %.",
    )


def fits(sensor: Prepared, exposure: Exposure, mas: int) -> dict[tuple[int, str], Fit]:
    """The estimators of Table 4 for a tilt of `mas`, by number of modes and kind."""
    return {
        (modes, kind): sensor.fit(modes, exposure.scale_e, TABLE4_READ_NOISE_E, kind, in_band=True)
        for modes, kind in product(FITTED[mas], KINDS)
    }


def bound_mas(linear: Fit) -> Array:
    """Least standard deviations (2,) of the tilts in x and y at the flat wavefront, mas: the Cramer-Rao bound."""
    bound = cramer_rao(linear.response_e, variance_e2(linear.reference_e, TABLE4_READ_NOISE_E))
    return np.asarray(np.sqrt(np.diag(bound)[:2]) / NM_PER_MAS)


def predicted_mas(linear: Fit, mean_e: Array) -> Array:
    """Standard deviations (2,) of the estimated tilts in x and y, mas, for an image with this mean (pixels,)."""
    spread = covariance(linear.R[:2], variance_e2(mean_e, TABLE4_READ_NOISE_E))
    return np.asarray(np.sqrt(np.diag(spread)) / NM_PER_MAS)


def table4(context: Context) -> list[Row]:
    """Rows of Table 4: electrons, then scatter and mean error of the tilt by sensor, flux, tilt, modes and kind."""
    rows: list[Row] = []
    for name in context.names(*sparse_apertures(), *OTHER_SENSORS):
        sensor = prepared(name)
        images = {mas: sensor.image(np.array([mas * NM_PER_MAS]), sensor.band) for mas in FITTED}
        for exposure in exposures(sensor):
            quantity = f"electrons on the sensor, {exposure.name}"
            count_e = exposure.scale_e * float(sensor.band_I0.sum())
            rows.append(Row(name, quantity, "e-", count_e, paper_count_e(sensor), assumption=exposure.assumption))
            for mas, image in images.items():
                linear, mean_e = fits(sensor, exposure, mas), image * exposure.scale_e
                for key, tilts_mas in _realisations(context, sensor, exposure, linear, mas, mean_e).items():
                    rows += _rows(sensor, exposure, key, linear[key], mas, mean_e, tilts_mas)
        rows += _rows_with_paper_pupil(sensor, images[1])
    return rows


def _realisations(
    context: Context, sensor: Prepared, exposure: Exposure, linear: dict[tuple[int, str], Fit], mas: int, mean_e: Array
) -> dict[tuple[int, str], Array]:
    """Tilts (trials, 2) in mas from noisy images, by estimator."""

    def trial(i: int) -> list[Array]:
        image_e = noisy_e(context.rng("table4", sensor.name, exposure.name, mas, i), mean_e, TABLE4_READ_NOISE_E)
        return [estimate(each, image_e)[:2] / NM_PER_MAS for each in linear.values()]

    tilts_mas = context.map(f"table4 {sensor.name}, {mas} mas, {exposure.name}", trial, range(context.trials))
    return dict(zip(linear, np.array(tilts_mas).transpose(1, 0, 2), strict=True))


def _paper_name(sensor: Prepared) -> str:
    """Key of the sensor's values in `TABLE4_MAS`."""
    return sensor.paper_name.partition(":")[0]  # also clowfs:MM, whose defocus may be fitted to this table


def _rows(
    sensor: Prepared, exposure: Exposure, key: tuple[int, str], linear: Fit, mas: int, mean_e: Array, tilts_mas: Array
) -> Iterator[Row]:
    (modes, kind), trials = key, len(tilts_mas)
    predicted, bound = predicted_mas(linear, mean_e), bound_mas(linear)
    scatter = tilts_mas.std(axis=0, ddof=1)
    fitted = partial(Row, sensor.name, unit="mas", modes=modes, estimator=kind)
    for axis, direction in enumerate("xy" if mas == 1 else "x"):
        yield fitted(
            quantity=f"std of {direction} tilt, {mas} mas, {exposure.name}",
            measured=float(scatter[axis]),
            paper=TABLE4_MAS.get(_paper_name(sensor), {}).get(mas) if modes == 2 and direction == "x" else None,
            error=float(scatter[axis] / np.sqrt(2.0 * (trials - 1))),
            predicted=float(predicted[axis]),
            limit=float(bound[axis]),
            assumption=f"{exposure.assumption}\n{ASSUMPTION}",
        )
    yield fitted(
        quantity=f"mean error of x tilt, {mas} mas, {exposure.name}",
        measured=float(tilts_mas[:, 0].mean() - mas),
        paper=0.0,
        error=float(scatter[0] / np.sqrt(trials)),
        predicted=float(estimate(linear, mean_e)[0] / NM_PER_MAS) - mas,
        assumption=f"{exposure.assumption}\n{CENTRED}",
    )


def _rows_with_paper_pupil(sensor: Prepared, tilted_image: Array) -> Iterator[Row]:
    """Predictions with the throughput of the paper's pupil, from the image (pixels,) with a tilt of 1 mas."""
    exposure = with_paper_pupil(sensor)
    linear = fits(sensor, exposure, 1)
    quantity, paper = f"predicted std of x tilt, 1 mas, {exposure.name}", TABLE4_MAS.get(_paper_name(sensor), {}).get(1)
    for kind in KINDS:
        std, limit = predicted_mas(linear[2, kind], tilted_image * exposure.scale_e), bound_mas(linear[2, kind])
        fitted = partial(Row, sensor.name, modes=2, estimator=kind, assumption=exposure.assumption)
        yield fitted(quantity, "mas", float(std[0]), paper, limit=float(limit[0]))
