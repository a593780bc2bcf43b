"""Reference star and target of different colour and roll: change of the dark zone after subtraction."""

from bisect import bisect_left
from collections.abc import Iterator
from functools import lru_cache, partial

import numpy as np

from lowfc.arrays import Array, Mask
from lowfc.design.tolerance import best_gain, drift_residual_nm2
from lowfc.optics.chain.band import Band, gauss_legendre
from lowfc.optics.chain.coronagraph import DARK_ZONE, SAMPLES_PER, wedge_samples
from lowfc.optics.chain.sensor import reference, response
from lowfc.optics.chain.zernike import NOLLS_14
from lowfc.programs.paper.cases import Row, prepared
from lowfc.programs.paper.tables import tolerance

STARS = {"reference": (2.0, 20_000.0), "target": (5.0, 5_800.0)}
"""Magnitude V and temperature in K."""
DRIFT_PM = 20.0
"""Drift of each of 14 modes, pm per root second."""
ROLL_NM, ROLL_CONTRAST = 1.0, 1e-11
"""Step of every mode by a roll of the telescope, nm rms, and the contrast to which it must decay."""
_SMALL_NM = 0.3  # amplitude of the modes from which the second-order maps are computed
_PLANCK_NM_K = 1.438777e7
_LONGEST_FRAMES = 1 << 20

ASSUMPTION = (
    f"Every mode drifts by {DRIFT_PM:g} pm/sqrt(s), best gain of each mode for each star, {tolerance.RATE_HZ:g} "
    "Hz; black bodies of 20,000 K (V = 2) and 5,800 K (V = 5) over the band of 20 %, in four wavelengths. A roll steps "
    f"every mode by {ROLL_NM:g} nm; the loop on the target corrects it."
)
RMS_NOTE = (
    "Rms over the dark zone of the difference of the two long exposures, without photon noise of the science camera."
)


def coloured(temperature_K: float) -> Band:
    """The band weighted by a black body's photons."""
    band = gauss_legendre(prepared("sam").optics.wavelength_nm, count=4)
    nm = np.array(band.wavelengths_nm)
    photons = np.array(band.weights) * nm**-4.0 / np.expm1(_PLANCK_NM_K / (nm * temperature_K))
    return Band(band.wavelengths_nm, tuple((photons / photons.sum()).tolist()))


@lru_cache(maxsize=1)
def _maps() -> tuple[Array, Array, Mask]:
    """Second-order maps (modes, samples, samples) of contrast per nm^2, the map of a flat wavefront, the dark zone."""
    samples = 2 * int(np.ceil(DARK_ZONE.outer)) * SAMPLES_PER
    sensor = prepared("sam")
    flat = sensor.star_image(np.zeros(len(NOLLS_14)), samples)
    pure_modes_nm = _SMALL_NM * np.eye(len(NOLLS_14))
    maps = np.array(
        [(sensor.star_image(nm, samples) + sensor.star_image(-nm, samples)) / 2 - flat for nm in pure_modes_nm]
    )
    return maps / _SMALL_NM**2, flat, wedge_samples(DARK_ZONE, samples, samples)


def zero_point_nm(name: str) -> Array:
    """Offset (14,), nm, of a loop on the target with the reference star's I0 and R: the effect of its colour."""
    sensor = prepared(name)
    reference_star, target = (coloured(kelvin) for _, kelvin in STARS.values())
    I0, H = reference(sensor.optics, reference_star).ravel(), response(sensor.optics, sensor.modes[:14], reference_star)
    normalised_I0, R = sensor.loop_fit(I0, H, tolerance.light_e(STARS["reference"][0]), tolerance.READ_NOISE_E)
    target_I0 = reference(sensor.optics, target).ravel()
    return np.asarray(-R @ (target_I0 / target_I0.sum() - normalised_I0))


def pair_rows(name: str) -> Iterator[Row]:
    """Rows of one sensor behind the shaped pupil."""
    maps, flat, zone = _maps()
    step_nm2 = (DRIFT_PM / 1e3) ** 2 / tolerance.RATE_HZ  # variance of the drift in a period
    new_row = partial(Row, name, unit="", assumption=ASSUMPTION)
    gains, residual_nm2 = dict[str, Array](), dict[str, Array]()
    for star, (magnitude, _) in STARS.items():
        noise = tolerance.frame_noise_nm2(name, magnitude).tolist()
        best = [best_gain(step_nm2, n, tolerance.EXPOSURE) for n in noise]
        residual = [drift_residual_nm2(step_nm2, n, tolerance.EXPOSURE, g) for n, g in zip(noise, best, strict=True)]
        gains[star], residual_nm2[star] = np.array(best), np.array(residual)
        yield new_row(
            f"added contrast, {star}, V = {magnitude:g}",
            measured=float(tolerance.contrasts_of(name).form @ residual_nm2[star]),
        )
    by_noise = np.tensordot(residual_nm2["target"] - residual_nm2["reference"], maps, 1)
    shift = zero_point_nm(name)
    by_colour = prepared("sam").star_image(shift, len(flat)) - flat
    yield new_row("zero-point shift by colour", unit="nm", measured=float(np.linalg.norm(shift)))
    for reference_image, change in (
        ("reference star's I0", by_noise + by_colour),
        ("I0 measured again", by_noise),
    ):
        yield new_row(f"mean contrast after subtraction, {reference_image}", measured=float(change[zone].mean()))
        yield new_row(
            f"rms contrast after subtraction, {reference_image}",
            measured=float(np.sqrt(np.mean(change[zone] ** 2))),
            assumption=f"{ASSUMPTION}\n{RMS_NOTE}",
        )
    form = tolerance.contrasts_of(name).form

    def decayed(frames: int) -> bool:
        return float(ROLL_NM**2 * form @ (1.0 - gains["target"]) ** (2.0 * frames)) <= ROLL_CONTRAST

    yield new_row(
        f"decay time of a roll's step to a contrast of {ROLL_CONTRAST:g}",
        unit="s",
        measured=bisect_left(range(_LONGEST_FRAMES), True, key=decayed) / tolerance.RATE_HZ,
    )
