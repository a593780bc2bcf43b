"""Sect. 4: conditioning of the modes behind an open relay pupil, bars, and holes of several sizes."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from lowfc.adapters.files.layouts import load_layout
from lowfc.arrays import Array
from lowfc.contract.sections import SensorSection
from lowfc.control.calibration.calibration import condition_number
from lowfc.design.fisher import cramer_rao, quantum_information, variance_e2
from lowfc.design.paper import STAR, TABLE4_EXPOSURE_S, TABLE4_READ_NOISE_E
from lowfc.optics.chain import sam as sams
from lowfc.optics.chain.band import gauss_legendre
from lowfc.optics.chain.relay import ApertureMask
from lowfc.optics.chain.sensor import reference, response
from lowfc.optics.detector.photometry import electrons
from lowfc.programs.paper.cases import Context, Prepared, Row, prepared, sparse_apertures
from lowfc.programs.paper.tables.pointing import NM_PER_MAS

OTHER_SENSORS = ("clowfs", "clowfs_tuned", "zwfs", "zwfs_tuned")
"""Sensors in addition to the packaged sparse apertures."""
BARS = ((0.05, 20.0), (0.1, 20.0), (0.2, 20.0), (0.1, 0.0), (0.1, 45.0), (0.1, 90.0))
"""Width of each bar in pupil diameters, and its angle in degrees."""
HOLES = (0.09, 0.08, 0.07, 0.06, 0.05, 0.04, 0.03)
"""Diameters of the holes, in pupil diameters."""

MONOCHROMATIC = "H at the central wavelength, per nm rms of each mode over the full circle."
FIXED_STAR = (
    f"Cramer-Rao bound at the central wavelength: V = {STAR.magnitude}, {STAR.diameter_m:g} m, {TABLE4_EXPOSURE_S} s, "
    f"{TABLE4_READ_NOISE_E:g} e- read noise, our own masks. Smaller holes are better conditioned but noisier: the "
    "condition number ignores the light."
)
NOISE = (
    f"Root of the sum of the 14 modes' variances, all fitted, no read noise: V = {STAR.magnitude}, "
    f"{TABLE4_EXPOSURE_S} s, our own masks. The band has four Gauss-Legendre wavelengths and as many photons as the "
    "central wavelength."
)
QUANTUM = (
    "limit: quantum Fisher information of the light after the shaped pupil, 4 N Cov of the modes' phases: no sensor "
    "of this light has less noise."
)
SHARE = "Median over the modes of the ratio of variances, quantum limit over Cramer-Rao bound."
CLAIMS = {
    "open": "Sect. 4: extremely high. limit: a condition number above it counts as singular.",
    "bar": "Sect. 4: below 1000 (the limit here), an order of magnitude above the sparse aperture mask's.",
    "holes": "Sect. 4: smaller holes lower the condition number, for the 14 modes that the mask was designed for.",
    "sensor": "limit: an order of magnitude below the bar's.",
}
LIMITS = {"open": 1e12, "bar": 1000.0, "holes": None, "sensor": 100.0}


def conditioning(context: Context) -> list[Row]:
    """Condition number, throughput and Cramer-Rao bounds of each mask in the relay pupil."""
    masks = [("open", prepared("open"))]
    masks += [("bar", _bar(width, angle)) for width, angle in BARS]
    masks += [("sensor", prepared(name)) for name in context.names(*sparse_apertures(), *OTHER_SENSORS)]
    holes = [_with_holes(diameter) for diameter in HOLES]
    masks += [("holes", each) for each in holes if isinstance(each, Prepared)]
    rows = [row for mask_rows in context.map("conditioning", lambda mask: [*_rows(*mask)], masks) for row in mask_rows]
    return rows + [each for each in holes if isinstance(each, Row)]


def _bar(width: float, angle_deg: float) -> Prepared:
    section = SensorSection(kind="bar", bar_width=width, bar_angle_deg=angle_deg)
    return Prepared(f"bar of {100 * width:g} % at {angle_deg:g} deg", section)


def _with_holes(diameter: float) -> Prepared | Row:
    """The default layout with holes of another diameter, or a row that says that they would reach outside the pupil."""
    layout = load_layout(SensorSection().sam)
    name = f"default layout with holes of {100 * diameter:g} %"
    shrunk = sams.Layout(name, layout.purpose, tuple((x, y, diameter) for x, y, _ in layout.holes))
    try:
        sams.check(shrunk)
    except ValueError:
        return Row(
            name, "condition number", "", None, modes=14, assumption="These holes would reach outside the pupil."
        )
    optics = prepared("sam").optics
    relay = ApertureMask(sams.transmission(shrunk, len(optics.pupil)))
    return Prepared(name, SensorSection(), replace(optics, relay=relay))


def _rows(kind: str, mask: Prepared) -> Iterator[Row]:
    for modes in (14, 20):
        yield Row(
            mask.name,
            "condition number",
            "",
            condition_number(mask.H[:, :modes]),
            "extremely high" if kind == "open" else "below 1000" if kind == "bar" else None,
            limit=LIMITS[kind] if modes == 14 else None,
            modes=modes,
            assumption=f"{MONOCHROMATIC}\n{CLAIMS[kind]}",
        )
    yield Row(mask.name, "fraction of the open circle's light on the sensor", "", float(mask.I0.sum()))
    scale_e = electrons(STAR, TABLE4_EXPOSURE_S)
    yield from _noise_rows(mask, scale_e)
    variance = variance_e2(mask.I0 * scale_e, TABLE4_READ_NOISE_E)
    for modes in (2, 14):
        try:
            tilt = float(np.sqrt(cramer_rao(mask.H[:, :modes] * scale_e, variance)[0, 0]) / NM_PER_MAS)
        except ValueError:
            tilt = None
        quantity = "least std of x tilt"
        yield Row(mask.name, quantity, "mas", tilt, modes=modes, estimator="Cramer-Rao bound", assumption=FIXED_STAR)


def _noise_rows(mask: Prepared, light_e: float) -> Iterator[Row]:
    """Rows of the noise of 14 modes and of its quantum limit; no rows if the mask cannot distinguish the modes."""
    optics, modes = mask.optics, mask.modes[:14]
    band = gauss_legendre(optics.wavelength_nm, count=4)

    def bound_nm2(I0: Array, H: Array) -> Array:
        return np.diag(cramer_rao(H * light_e, variance_e2(I0 * light_e, 0.0)))

    try:
        bound = bound_nm2(mask.I0, mask.H[:, :14])
    except ValueError:
        return
    limit = np.diag(np.linalg.inv(quantum_information(optics.pupil, modes, optics.wavelength_nm, light_e)))
    in_band = bound_nm2(reference(optics, band).ravel(), response(optics, modes, band))
    noise, limit_nm, noise_in_band = (float(np.sqrt(each.sum())) for each in (bound, limit, in_band))
    row = partial(Row, mask.name, modes=14, estimator="Cramer-Rao bound")
    yield row("noise of all modes", "nm", noise, limit=limit_nm, assumption=f"{NOISE}\n{QUANTUM}")
    yield row("share of the quantum limit", "", float(np.median(limit / bound)), limit=1.0, assumption=SHARE)
    yield row("noise of all modes, 20 % band", "nm", noise_in_band, assumption=NOISE)
