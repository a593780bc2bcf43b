"""The bright exposure of a single wavefront in the figures (Sect. 3.1), and its estimators."""

from lowfc.arrays import Array
from lowfc.design.estimators import KINDS, Fit, iterated
from lowfc.design.paper import PEAK_E, TABLE3_READ_NOISE_E
from lowfc.optics.chain.zernike import NOLLS_14
from lowfc.programs.paper.cases import Prepared
from lowfc.programs.paper.tables.reconstruction import ITERATIONS, label

MODES = len(NOLLS_14)
BRIGHT = (
    f"{PEAK_E:,.0f} e- in the brightest pixel of the flat image, {TABLE3_READ_NOISE_E:.0f} e- read noise, whole "
    "electrons, monochromatic."
)
FULL_CHAIN = "Images by the full optical chain; iterations with the twin, accurate to about 1e-5."

ESTIMATORS = tuple(label(kind, iterations) for kind in KINDS for iterations in ITERATIONS)
PINV = label("pinv", 0)
WEIGHTED, WEIGHTED_1, WEIGHTED_2 = (label("weighted", iterations) for iterations in ITERATIONS)


def estimates_nm(ready: Prepared, linear: dict[str, Fit], image_e: Array) -> dict[str, Array]:
    """Estimates (modes,) from an image (pixels,) in electrons, by those of `ESTIMATORS` whose kind is in `linear`."""
    estimates: dict[str, Array] = {}
    for kind, fit in linear.items():
        steps_nm = iterated(fit, image_e, ready.model, ITERATIONS[-1])
        estimates |= {label(kind, iterations): steps_nm[iterations] for iterations in ITERATIONS}
    return estimates
