"""Sect. 3.3: light budget, signal of 1 mas, and contradictions within the paper."""

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache, partial

import numpy as np
from scipy.optimize import brentq

from lowfc.arrays import Array
from lowfc.contract.sections import SensorSection
from lowfc.design.fisher import covariance, variance_e2
from lowfc.design.paper import (
    STAR,
    TABLE3_INPUT_WAVES,
    TABLE3_READ_NOISE_E,
    TABLE3_WAVES,
    TABLE4_EXPOSURE_S,
    TABLE4_MAS,
    TABLE4_READ_NOISE_E,
)
from lowfc.design.trials import bounds_waves, expected_r_squared, expected_rms
from lowfc.optics.chain.relay import Defocus, fresnel_distance
from lowfc.optics.chain.sensor import reference
from lowfc.optics.chain.zernike import NOLLS_14
from lowfc.optics.detector.photometry import electrons
from lowfc.programs.paper.cases import Context, Prepared, Row, prepared
from lowfc.programs.paper.tables import reconstruction
from lowfc.programs.paper.tables.pointing import (
    NM_PER_MAS,
    PAPER_FOCAL_MASK,
    PAPER_PUPIL,
    PAPER_RELAY_MASK,
    exposures,
    paper_count_e,
    predicted_mas,
)

PAPER_PEAK = {"sam": 0.0022, "clowfs": 0.0110}
"""The paper's light on the brightest pixel divided by the light on the sensor."""
PAPER_SIGNAL = {"sam": 0.025, "clowfs": 0.011}
"""The paper's signal of 1 mas of tilt, peak to valley, divided by the brightest pixel."""
PAPER_SIGNAL_RATIO = 13.0
"""The paper's signal of 1 mas in electrons: ratio clowfs / sam."""
PAPER_SCATTER_RATIO = 5.0
"""The paper's standard deviation of the tilt estimates: ratio sam / clowfs."""
PAPER_TILT_PEAK = 5.42e-2
"""Table 2's peak differential intensity of lambda/30 of tilt in x."""
PAPER_R2 = 0.97
"""The paper's coefficient of determination, mean of the modes."""


def photometry(context: Context) -> list[Row]:
    """Rows of throughputs, brightest pixels, signals of 1 mas, ratios of sensors, and the paper's inconsistencies."""
    sam, clowfs = prepared("sam"), prepared("clowfs")
    rows = [*_throughputs(sam, clowfs)]
    for sensor in (sam, clowfs, prepared("zwfs")):
        rows += _signals(sensor)
    return [*rows, *_ratios(sam, clowfs), *_inconsistencies(sam, clowfs)]


def _throughputs(sam: Prepared, clowfs: Prepared) -> Iterator[Row]:
    budget, pupils = sam.budget, "Shaped pupil by linear programming; the paper's ripple pupil is not published."
    yield Row("shaped pupil", "throughput", "", budget.pupil, PAPER_PUPIL, assumption=pupils)
    yield Row("focal-plane mask", "throughput", "", budget.focal_mask, PAPER_FOCAL_MASK, assumption=pupils)
    yield Row("sparse aperture mask", "throughput", "", budget.relay_mask, PAPER_RELAY_MASK)
    yield Row(
        "sam", "fraction of the light on the relay mask that reaches the sensor", "", budget.sensor, PAPER_RELAY_MASK
    )
    for sensor in (sam, clowfs):
        own_e = electrons(STAR, TABLE4_EXPOSURE_S) * float(sensor.band_I0.sum())
        yield Row(
            sensor.name,
            "electrons on the sensor",
            "e-",
            own_e,
            paper_count_e(sensor),
            assumption=f"V = {STAR.magnitude}, {STAR.diameter_m:g} m, {TABLE4_EXPOSURE_S} s, {STAR.bandwidth_nm:g} nm; "
            "paper: the same light with the paper's throughputs.",
        )


@lru_cache(maxsize=8)
def tilt_signal(sensor: Prepared, axis: int) -> Array:
    """Change (pixels,) of the image in the band by 1 mas of tilt along x (axis 0) or y (axis 1)."""
    tilt_nm = np.zeros(2)
    tilt_nm[axis] = NM_PER_MAS
    return sensor.image(tilt_nm, sensor.band) - sensor.band_I0


def differential(sensor: Prepared, noll: int) -> Array:
    """(I - I0) / max(I0), (pixels,), for lambda/30 rms of one of the 14 modes, with the full exp(i phi)."""
    modes_nm = np.zeros(len(NOLLS_14))
    modes_nm[NOLLS_14.index(noll)] = sensor.optics.wavelength_nm / 30.0
    return np.asarray((sensor.image(modes_nm) - sensor.I0) / sensor.I0.max())


def _signals(sensor: Prepared) -> Iterator[Row]:
    mono, band = "Central wavelength.", "Band in five wavelengths."
    peak, signal = PAPER_PEAK.get(sensor.name), PAPER_SIGNAL.get(sensor.name)
    yield Row(sensor.name, "brightest pixel / image", "", sensor.budget.peak, peak, assumption=mono)
    in_band = float(sensor.band_I0.max() / sensor.band_I0.sum())
    yield Row(sensor.name, "brightest pixel / image, in the band", "", in_band, peak, assumption=band)
    for axis, direction in enumerate("xy"):
        quantity = f"P-V of the signal of 1 mas in {direction} / brightest pixel"
        ratio = float(np.ptp(tilt_signal(sensor, axis)) / sensor.band_I0.max())
        yield Row(sensor.name, quantity, "", ratio, signal, assumption=band)


def _ratios(sam: Prepared, clowfs: Prepared) -> Iterator[Row]:
    own = float(np.ptp(tilt_signal(clowfs, 0)) / np.ptp(tilt_signal(sam, 0)))
    clowfs_e, sam_e = (float(paper_count_e(each) / each.band_I0.sum()) for each in (clowfs, sam))
    for light, ratio in (("own photometry", own), ("paper's electrons", own * clowfs_e / sam_e)):
        quantity, band = f"P-V of the signal of 1 mas in electrons, {light}", "Band in five wavelengths, x tilt."
        yield Row("clowfs / sam", quantity, "", ratio, PAPER_SIGNAL_RATIO, assumption=band)
    predicted = f"Predicted; the ratio in the paper's Table 4 is {TABLE4_MAS['sam'][1] / TABLE4_MAS['clowfs'][1]:.1f}."
    for k, light in enumerate(("paper's electrons", "own photometry")):
        scatter = []
        for sensor in (sam, clowfs):
            linear = sensor.fit(2, exposures(sensor)[k].scale_e, TABLE4_READ_NOISE_E, "pinv", in_band=True)
            scatter.append(float(predicted_mas(linear, linear.reference_e)[0]))
        fitted = partial(Row, "sam / clowfs", modes=2, estimator="pinv", assumption=predicted)
        yield fitted(f"std of x tilt, {light}", "", scatter[0] / scatter[1], PAPER_SCATTER_RATIO)


def _inconsistencies(sam: Prepared, clowfs: Prepared) -> Iterator[Row]:
    yield from _tilt_contradiction(sam)
    yield from _defocus_contradiction(clowfs)
    yield from _r2_contradiction(sam)
    light = 1.0 / PAPER_RELAY_MASK * PAPER_PEAK["clowfs"] / PAPER_PEAK["sam"]
    yield Row(
        "inconsistency 4: 13 times the signal",
        "P-V of the signal of 1 mas in electrons, clowfs / sam, from the paper's own ratios",
        "",
        light * PAPER_SIGNAL["clowfs"] / PAPER_SIGNAL["sam"],
        PAPER_SIGNAL_RATIO,
        assumption="Without a model: product of three ratios of Sect. 3.3: light without and with the sparse aperture "
        "mask, brightest pixel / image, and signal / brightest pixel.",
    )


def _tilt_contradiction(sam: Prepared) -> Iterator[Row]:
    """Table 2's tilt contradicts the 2.5 % of Sect. 3.3: a P-V is at most twice the largest |dI|."""
    name, tilt_nm = "inconsistency 1: Table 2 against 2.5 % for 1 mas", sam.optics.wavelength_nm / 30.0
    yield Row(
        name,
        "largest P-V of 1 mas that Table 2's tilt allows",
        "",
        2.0 * PAPER_TILT_PEAK * NM_PER_MAS / tilt_nm,
        PAPER_SIGNAL["sam"],
        assumption=f"Without a model: lambda/30 is {tilt_nm / NM_PER_MAS:.2f} mas, the signal is proportional to the "
        "tilt, and its P-V at most twice its largest value.",
    )
    yield Row(
        name,
        "peak differential intensity of lambda/30 of x tilt (Table 2)",
        "",
        float(np.abs(differential(sam, 2)).max()),
        PAPER_TILT_PEAK,
        assumption="If the signal of 1 mas reaches the 2.5 % of Sect. 3.3, the peak for lambda/30 exceeds that of "
        "Table 2.",
    )


def defocus_waves(section: SensorSection, wavelength_nm: float) -> float:
    """Peak to valley of a sensor's defocus in waves."""
    return fresnel_distance(section.defocus_mm, section.focal_ratio, wavelength_nm) / 8.0


def _defocus_contradiction(clowfs: Prepared) -> Iterator[Row]:
    section = SensorSection(kind="clowfs")

    def peak(defocus_mm: float) -> float:
        relay = Defocus(fresnel_distance(defocus_mm, section.focal_ratio, clowfs.optics.wavelength_nm))
        I0 = reference(replace(clowfs.optics, relay=relay))
        return float(I0.max() / I0.sum())

    paper_peak, own = PAPER_PEAK["clowfs"], f"{section.defocus_mm:g} mm"
    name = f"inconsistency 2: CLOWFS at {own} against {100 * paper_peak:.2f} % in its brightest pixel"
    yield Row(
        name,
        f"brightest pixel / image at {own}",
        "",
        peak(section.defocus_mm),
        paper_peak,
        assumption=f"{own} are {defocus_waves(section, clowfs.optics.wavelength_nm):.2f} waves of defocus.",
    )
    agreeing_mm = brentq(lambda mm: peak(mm) - paper_peak, 1.0, section.defocus_mm, xtol=1e-3)
    yield Row(
        name,
        f"defocus at which the brightest pixel has {100 * paper_peak:.2f} %",
        "mm",
        float(agreeing_mm),
        section.defocus_mm,
        assumption="With the paper's electrons, the tilt scatter of 0.080 mas of Table 4 (two modes) needs about "
        "this defocus. A fit of 14 modes (pinv) there has ten times this scatter, and at 1 mm (clowfs:1 "
        "in Table 4) 36 times. No defocus agrees with both CLOWFS tables of the paper.",
    )


def _r2_contradiction(sam: Prepared) -> Iterator[Row]:
    """A mean R2 of 0.97 contradicts a residual 30 times below the input."""
    name = "inconsistency 3: R2 of 0.97 against a residual 30 times below the input"
    paper_in, paper_out = TABLE3_INPUT_WAVES[14], TABLE3_WAVES["disk"][14][0]
    yield Row(
        name,
        "R2 if every mode's error were as far below its input as the wavefront's error",
        "",
        1.0 - (paper_out / paper_in) ** 2,
        PAPER_R2,
        assumption="Without a model: eq. (15) with the ratio of Table 3.",
    )
    gram, wavelength_nm = sam.gram[:14, :14], sam.optics.wavelength_nm
    wavefronts = next(reconstruction.inputs(sam, 14, literal=False))
    linear = reconstruction.fits(sam, 14)["pinv"]
    covariance_waves2 = covariance(linear.R, variance_e2(linear.reference_e, TABLE3_READ_NOISE_E)) / wavelength_nm**2
    covariance_waves2 *= (paper_out / expected_rms(gram, covariance_waves2)) ** 2
    bounds = bounds_waves(NOLLS_14, wavefronts.low, wavefronts.high)
    yield Row(
        name,
        "mean R2 of our sensor, noise scaled to the paper's residual of 5.1e-4 waves",
        "",
        float(expected_r_squared(np.diag(covariance_waves2), bounds).mean()),
        PAPER_R2,
        assumption="Errors of modes that look alike through the shaped pupil partly cancel in the residual.",
    )
