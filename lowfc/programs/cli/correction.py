"""What a closed loop does to the wavefront, and other thresholds shared by the view, the console and the report."""

from enum import Enum, auto

WORSE = 1.1
"""Ratio of residual to open-loop wavefront above which a loop does harm; an rms over 1 s scatters by under 10 %."""
GOOD_FACTOR = 2.0
"""Reduction factor of the wavefront rms that counts as good: leaked light, which scales as its square, falls to 1/4."""
NEAR_STROKE = 0.9
"""Fraction of the stroke above which the mirror has little reserve."""
MANY_LATE = 0.05
"""Fraction of late commands that a busy host may cause; above it, the delay is longer than the loop is tuned for."""


class Correction(Enum):
    """What a closed loop does to the wavefront."""

    GOOD = auto()
    LITTLE = auto()
    HARM = auto()


def correction(residual_nm: float, open_nm: float) -> Correction:
    """HARM if residual / open is above `WORSE`, GOOD if open / residual is at least `GOOD_FACTOR`, otherwise LITTLE.

    Both rms are over one span: the last second (live view, console), all frames in closed loop (view of a log), or the
    longest stretch under one law (report).
    """
    if residual_nm > WORSE * open_nm:
        return Correction.HARM
    return Correction.GOOD if 0 < GOOD_FACTOR * residual_nm <= open_nm else Correction.LITTLE
