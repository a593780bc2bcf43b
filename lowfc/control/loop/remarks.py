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
    if request.name == "gain":
        return on_gain(request.values, settings.delay_frames)
    if request.name == "limit":
        noll = request.modes or drive.calibration.noll
        columns = drive.to_actuators[:, [drive.calibration.noll.index(mode) for mode in noll]]
        return on_limit(request.values, noll, columns, settings.limits.stroke_nm)
    return ""


def check_offset(drive: ActiveLoop, largest_nm: npt.NDArray[np.floating[Any]]) -> None:
    """Refuse offsets (modes,), nm rms of wavefront, beyond the limits of their modes.

    Raises:
        ValueError: one is; the text names its mode.
    """
    for mode, limit_nm, asked_nm in zip(drive.calibration.noll, drive.law.limit_nm, largest_nm, strict=True):
        if asked_nm > limit_nm:
            raise ValueError(f"offset of mode {mode}: at most its limit, {limit_nm:g} nm; asked for {asked_nm:g} nm")


def on_gain(values: tuple[float, ...], delay_frames: float) -> str:
    """Remark on integrator gains that `lowfc tune` would not choose; empty for others."""
    highest = highest_gain(delay_frames)
    if max(values) > highest:
        return (
            f": above {highest:.3g} the margins are below the {LEAST_GAIN_MARGIN:g} in gain and "
            f"{LEAST_PHASE_MARGIN_DEG:g} degrees in phase that `lowfc tune` keeps, and the loop may ring"
        )
    if min(values) == 0:
        return ": a mode with a gain of 0 is not corrected"
    if min(values) < LOWEST_GAIN:
        return f": below {LOWEST_GAIN:g}, the least that `lowfc tune` chooses, next to nothing is corrected"
    return ""


def on_limit(values: tuple[float, ...], noll: tuple[int, ...], to_actuators: Single, stroke_nm: float) -> str:
    """Remark on limits of modal commands that allow nothing, or that the mirror's stroke precedes; empty for others.

    Args:
        values: nm rms of wavefront.
        noll: Noll indices of the modes that they are for.
        to_actuators: (actuators, modes) nm of surface per nm of wavefront, of those modes.
        stroke_nm: of the controller's limits, surface.
    """
    if min(values) == 0:
        return ": a mode with a limit of 0 nm is not corrected"
    reach_nm = stroke_nm / np.maximum(np.abs(to_actuators).max(axis=0), np.finfo(np.float32).tiny)
    beyond = np.flatnonzero(np.asarray(values) > reach_nm)
    if not beyond.size:
        return ""
    first = int(beyond[0])
    return f": above {reach_nm[first]:.3g} nm the stroke of {stroke_nm:g} nm limits mode {noll[first]} first"
