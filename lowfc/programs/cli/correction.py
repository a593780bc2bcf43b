"""What a closed loop does to the wavefront: the thresholds shared by the view, the console and the report."""

from enum import Enum, auto

WORSE = 1.1
"""Ratio of residual to open wavefront above which a closed loop does harm; an rms over 1 s scatters by under 10 %."""
GOOD_FACTOR = 2.0
"""Reduction of the wavefront that counts as good: leaked light scales with its square, so a quarter is left."""


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
