"""Captions and estimator labels of the figures that estimate one wavefront from one bright exposure (Sect. 3.1)."""

from lowfc.design.estimators import KINDS
from lowfc.design.paper import PEAK_E, TABLE3_READ_NOISE_E
from lowfc.optics.chain.zernike import NOLLS_14
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
