"""What a reply says of values that are allowed and probably not meant, and of offsets that are not allowed."""

from typing import Any

import numpy as np
import numpy.typing as npt

from lowfc.arrays import Single
from lowfc.control.laws.stability import LEAST_GAIN_MARGIN, LEAST_PHASE_MARGIN_DEG, LOWEST_GAIN, highest_gain
from lowfc.control.loop.inputs import Request
from lowfc.control.loop.state import ActiveLoop, Settings


def remark(settings: Settings, drive: ActiveLoop, request: Request) -> str:
    """Remark on the values of a request for gains or limits; empty where there is nothing to say."""
    lowest, highest = min(request.values), max(request.values)
    if request.name == "gain":
        recommended = highest_gain(settings.delay_frames)
        if highest > recommended:
            return (
                f": above {recommended:.3g} the margins are below the {LEAST_GAIN_MARGIN:g} in gain and "
                f"{LEAST_PHASE_MARGIN_DEG:g} degrees in phase that `lowfc tune` keeps, and the loop may ring"
            )
        if 0 < lowest < np.float32(LOWEST_GAIN):  # as a request has it
            return f": below {LOWEST_GAIN:g}, the least that `lowfc tune` chooses, next to nothing is corrected"
    if request.name in ("gain", "limit") and lowest == 0:
        unit = " nm" if request.name == "limit" else ""
        return f": a mode with a {request.name} of 0{unit} is not corrected"
    if request.name == "limit":
        noll = request.modes or drive.calibration.noll
        columns = drive.to_actuators[:, [drive.calibration.noll.index(mode) for mode in noll]]
        stroke_nm = settings.limits.stroke_nm
        reach_nm = stroke_nm / np.maximum(np.abs(columns).max(axis=0), np.finfo(np.float32).tiny)
        beyond = np.flatnonzero(np.asarray(request.values) > reach_nm)
        if beyond.size:
            first = int(beyond[0])
            return f": above {reach_nm[first]:.3g} nm the stroke of {stroke_nm:g} nm limits mode {noll[first]} first"
    return ""


def offset_remark(drive: ActiveLoop, offset_nm: Single) -> str:
    """Remark on offsets (modes,) of modes that no gain lets follow; empty where there are none."""
    fixed = (offset_nm != 0) & (drive.law.gain == 0) & ~drive.automatic & (drive.following is None)
    names = ", ".join(f"Z{mode}" for mode, one in zip(drive.calibration.noll, fixed, strict=True) if one)
    return f": {names} would not follow at a gain of 0" if names else ""


def check_offset(drive: ActiveLoop, largest_nm: npt.NDArray[np.floating[Any]]) -> None:
    """Refuse offsets (modes,), nm rms of wavefront, beyond the limits of their modes.

    Raises:
        ValueError: one is; the text names its mode.
    """
    for mode, limit_nm, asked_nm in zip(drive.calibration.noll, drive.law.limit_nm, largest_nm, strict=True):
        if asked_nm > limit_nm:
            raise ValueError(f"offset of mode {mode}: at most its limit, {limit_nm:g} nm; asked for {asked_nm:g} nm")
