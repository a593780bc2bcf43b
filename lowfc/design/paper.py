"""Conditions and results of Subedi et al. 2015, used by the tables and by the search for better masks."""

from lowfc.optics.detector.photometry import Photometry

MODES = (14, 20)
"""Numbers of modes in the two columns of Table 3: radial degrees up to 4 and up to 5."""

PEAK_E = 40_000.0
"""Electrons in the brightest pixel of the flat wavefront's image (Sect. 3.1)."""
TABLE3_READ_NOISE_E = 3.0
TABLE3_INPUT_WAVES = {14: 0.015, 20: 0.018}
"""Rms of Table 3's random wavefronts over the open pupil, by number of modes."""

STAR = Photometry()
TABLE4_EXPOSURE_S = 0.05
TABLE4_READ_NOISE_E = 1.0
TABLE4_MODES = 2
"""Number of fitted modes, tip and tilt. The paper does not state it; with 14, even the SAM's Cramer-Rao bound would be
twice the paper's value."""

TABLE3_WAVES = {
    "disk": {14: (5.1e-4, 8.9e-3), 20: (8.0e-4, 0.021)},
    "bowtie": {14: (4.6e-4, 8.0e-3), 20: (6.8e-4, 0.017)},
    "clowfs": {14: (1.3e-3, 0.022), 20: (2.3e-3, 0.066)},
}
"""Mean rms and peak-to-valley residuals, waves, by sensor (SAM with disk or bow-tie mask; CLOWFS) and modes."""
TABLE4_MAS = {"sam": {1: 0.36, 10: 0.37}, "clowfs": {1: 0.080, 10: 0.082}}
"""Standard deviation of the tilt estimate, mas, by sensor and by the true tilt in mas."""
