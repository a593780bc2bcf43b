"""What a closed loop does to the wavefront: the thresholds shared by the view, the console and the report."""

from enum import Enum, auto

WORSE = 1.1
"""Residual over open wavefront above which a closed loop does harm; the rms of a second scatters by less than 10 %."""
GOOD_FACTOR = 2.0
"""Reduction that counts as good: leaked starlight scales with the square of the wavefront, so a quarter is left."""


class Correction(Enum):
    """What a closed loop does to the wavefront."""

    GOOD = auto()
    LITTLE = auto()
    HARM = auto()


def correction(residual_nm: float, open_nm: float) -> Correction:
    """HARM if the residual exceeds `WORSE` times the open wavefront, GOOD at `GOOD_FACTOR` below it, LITTLE between.

    Both are over one span: the last second (live view, console), all frames in closed loop (view of a log), or the
    longest stretch under one law (report).
    """
    if residual_nm > WORSE * open_nm:
        return Correction.HARM
    return Correction.GOOD if 0 < GOOD_FACTOR * residual_nm <= open_nm else Correction.LITTLE
