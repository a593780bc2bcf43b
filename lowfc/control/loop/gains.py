"""Requests for gains, leaks and limits of the integrator, and for offsets, from people or automatic gains."""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from lowfc.arrays import Mask, Single
from lowfc.control.laws.integrator import Integrator
from lowfc.control.laws.stability import LOWEST_GAIN, MIN_GAIN_MARGIN, MIN_PHASE_MARGIN_DEG, highest_gain, limiting_gain
from lowfc.control.loop.inputs import PendingEvent, Request
from lowfc.control.loop.safety import MAX_LIMIT_NM
from lowfc.control.loop.state import ActiveLoop, Settings, Weighting
from lowfc.control.loop.wording import AUTO, counted

_MAX_PREPARED = 64
"""Largest number of different leaks in a request for which `prepare_gains` caches the highest gains."""

Changed = tuple[ActiveLoop, str, *tuple[PendingEvent, ...]]  # the loop after a request, its reply, events


def change_integrator(settings: Settings, loop: ActiveLoop, request: Request) -> Changed:
    """The loop after a request for gain, leak or limit, and the reply; ValueError with the reason if refused."""
    if request.name == "gain" and request.text == AUTO:
        return _automatic_gain(settings, loop, request)
    if loop.law_runner is not None and request.name != "limit":
        raise ValueError(
            f"the law {loop.law_runner.law.name!r} drives the mirror, and has no {request.name}: "
            "`lowfc ctl law integrator` returns to the integrator"
        )
    integrator = _new_integrator(loop.integrator, loop.calibration.noll, settings.delay_frames, request)
    if request.name == "gain":  # a gain set by a person is not automatic, and R treats its mode as corrected
        chosen = _chosen(loop.calibration.noll, request)
        weighting = loop.weighting
        loop = loop._replace(automatic=loop.automatic & ~chosen)
        if weighting is not None and (weighting.prior_nm2[chosen] > 0).any():
            prior_nm2 = np.where(chosen, np.float32(0), weighting.prior_nm2)
            loop = loop.with_weighting(weighting._replace(prior_nm2=prior_nm2))
    loop = loop.with_gains(integrator)
    text = f"{request.name} is now {_listed(getattr(integrator, _ATTRIBUTES[request.name]))}"
    return loop, text + remark(settings, loop, request)


def _automatic_gain(settings: Settings, loop: ActiveLoop, request: Request) -> Changed:
    """The loop after a request for automatic gains: without values it switches them on, with values it changes them."""
    noll = loop.calibration.noll
    chosen = _chosen(noll, request)
    if not request.values:
        loop = loop._replace(automatic=loop.automatic | chosen).with_gains(loop.integrator)
        names = ", ".join(f"Z{index}" for index, is_chosen in zip(noll, chosen, strict=True) if is_chosen)
        return loop, f"the gain of {names} is automatic"
    changed = _new_integrator(loop.integrator, noll, settings.delay_frames, request)
    prior_nm2 = np.array(request.prior_nm2, np.float32)
    valid = prior_nm2.shape == chosen.shape and (np.isfinite(prior_nm2) & (prior_nm2 >= 0)).all()
    if prior_nm2.size and not valid:
        raise ValueError(f"the mean squares must be {chosen.size}, one per mode, finite and at least 0 nm^2")
    gain = np.where(chosen & loop.automatic, changed.gain, loop.integrator.gain)
    weighting = Weighting(prior_nm2, request.flux_dn) if prior_nm2.any() else None
    loop = loop.with_gains(replace(loop.integrator, gain=gain)).with_weighting(weighting)
    text = _listed(gain)
    return loop, f"gain is now {text}", PendingEvent("GAINS_CHANGED", {"gains": text})


def _listed(values: Single) -> str:
    return " ".join(f"{value:.3g}" for value in values.tolist())


def _chosen(noll: tuple[int, ...], request: Request) -> Mask:
    """The modes (modes,) of a request; ValueError if one is not controlled."""
    return np.isin(noll, _modes(noll, request))


def _modes(noll: tuple[int, ...], request: Request) -> tuple[int, ...]:
    modes = tuple(dict.fromkeys(request.modes)) or noll  # without duplicates
    unknown = sorted(set(modes) - set(noll))
    if unknown:
        raise ValueError(f"Noll modes {unknown} are not controlled; there are {', '.join(map(str, noll))}")
    return modes


def per_mode(noll: tuple[int, ...], request: Request, before: Single) -> Single:
    """Values of all modes (modes,), in their unit, updated with those of the request.

    Raises:
        ValueError: the request is wrong; the text names the fault.
    """
    modes = _modes(noll, request)
    if len(request.values) not in (1, len(modes)):
        raise ValueError(f"give one value, or one per mode ({counted(len(modes), 'mode')}); got {len(request.values)}")
    if not np.isfinite(request.values).all():
        raise ValueError(f"{request.name} must be finite, got {' '.join(map('{:g}'.format, request.values))}")
    array = before.copy()
    array[[noll.index(mode) for mode in modes]] = np.asarray(request.values, dtype=np.float32)
    return array


def _new_integrator(integrator: Integrator, noll: tuple[int, ...], delay_frames: float, request: Request) -> Integrator:
    """The integrator with new gains, leaks or limits; ValueError if the request is wrong."""
    attribute = _ATTRIBUTES[request.name]
    values = per_mode(noll, request, getattr(integrator, attribute))
    lowest, highest = min(request.values), max(request.values)
    if request.name == "leak" and not (lowest >= 0 and highest <= 1):
        raise ValueError(f"leak must be between 0 and 1, got {lowest if lowest < 0 else highest:g}")
    if request.name == "limit" and not (lowest >= 0 and highest <= MAX_LIMIT_NM):
        raise ValueError(f"limit must be between 0 and {MAX_LIMIT_NM:g} nm, got {lowest if lowest < 0 else highest:g}")
    chosen = _chosen(noll, request)
    if request.name == "gain":
        check_gains(values[chosen].tolist(), integrator.leak[chosen].tolist(), delay_frames)
    if request.name == "leak":
        check_gains(integrator.gain[chosen].tolist(), values[chosen].tolist(), delay_frames)
    changed: dict[str, Any] = {attribute: values}
    return replace(integrator, **changed)


def check_gains(gains: Iterable[float], leaks: Iterable[float], delay_frames: float) -> None:
    """Refuse gains (modes,) that are negative, or with which the loop is unstable at these leaks (modes,).

    Raises:
        ValueError: a gain is refused.
    """
    for gain, leak in zip(gains, leaks, strict=True):
        limiting = limiting_gain(delay_frames, leak)
        if not 0 <= gain < np.float32(limiting):
            with_leak = f" and a leak of {leak:g}" if leak else ""
            raise ValueError(
                f"gain must be at least 0 and below {limiting:.3g}, where a loop with a delay of "
                f"{counted(float(delay_frames), 'frame')}{with_leak} becomes unstable; got {gain:g}"
            )


def prepare_gains(settings: Settings, request: Request) -> None:
    """Cache the highest gains that the reply to a request for gains or leaks needs, so that no frame waits for them."""
    leaks = np.unique(np.array(request.values if request.name == "leak" else settings.leak, np.float32))
    if leaks.size <= _MAX_PREPARED:
        for leak in leaks[(leaks >= 0) & (leaks <= 1)].tolist():
            highest_gain(settings.delay_frames, leak)


def remark(settings: Settings, loop: ActiveLoop, request: Request) -> str:
    """Remark on the values of a request for gains or limits; usually empty."""
    lowest = min(request.values)
    if request.name == "gain":
        chosen, integrator = _chosen(loop.calibration.noll, request), loop.integrator
        for gain, leak in zip(integrator.gain[chosen].tolist(), integrator.leak[chosen].tolist(), strict=True):
            recommended = highest_gain(settings.delay_frames, leak)
            if gain > recommended:
                return (
                    f": above {recommended:.3g} a margin is below the {MIN_GAIN_MARGIN:g} in gain or "
                    f"{MIN_PHASE_MARGIN_DEG:g} degrees in phase that `lowfc tune` keeps, and the loop may ring"
                )
        if 0 < lowest < np.float32(LOWEST_GAIN):  # values of a request are float32
            return f": below {LOWEST_GAIN:g}, the least that `lowfc tune` chooses, next to nothing is corrected"
    if request.name in ("gain", "limit") and lowest == 0:
        unit = " nm" if request.name == "limit" else ""
        return f": a mode with a {request.name} of 0{unit} is not corrected"
    if request.name == "limit":
        noll = _modes(loop.calibration.noll, request)
        columns = loop.to_actuators[:, [loop.calibration.noll.index(mode) for mode in noll]]
        stroke_nm = settings.limits.stroke_nm
        reach_nm = stroke_nm / np.maximum(np.abs(columns).max(axis=0), np.finfo(np.float32).tiny)
        beyond = np.flatnonzero(np.asarray(request.values) > reach_nm)
        if beyond.size:
            first = int(beyond[reach_nm[beyond].argmin()])
            return f": above {reach_nm[first]:.3g} nm the stroke of {stroke_nm:g} nm limits mode {noll[first]} first"
    return ""


def offset_remark(loop: ActiveLoop, offset_nm: Single) -> str:
    """Remark on offsets (modes,) of modes that cannot follow at a gain of 0; empty if there are none."""
    fixed = (offset_nm != 0) & (loop.integrator.gain == 0) & ~loop.automatic & (loop.law_runner is None)
    names = ", ".join(f"Z{mode}" for mode, is_fixed in zip(loop.calibration.noll, fixed, strict=True) if is_fixed)
    return f": {names} would not follow at a gain of 0" if names else ""


def check_offset(loop: ActiveLoop, largest_nm: npt.NDArray[np.floating[Any]]) -> None:
    """Refuse offsets (modes,), nm rms of wavefront, beyond the limits of their modes, or of modes not fully measured.

    Raises:
        ValueError: an offset is refused; the text names its mode.
    """
    for mode, limit_nm, asked_nm in zip(loop.calibration.noll, loop.integrator.limit_nm, largest_nm, strict=True):
        if asked_nm > limit_nm:
            raise ValueError(f"offset of mode {mode}: at most its limit, {limit_nm:g} nm; asked for {asked_nm:g} nm")
    own = loop.calibration.actuators_to_modes
    if not own.size:
        return
    departure = np.linalg.norm(own @ loop.to_actuators - np.eye(len(own)), axis=0)
    for mode in np.array(loop.calibration.noll)[(departure > _MAX_DEPARTURE) & (largest_nm > 0)]:
        raise ValueError(f"offset of mode {mode}: R measures it only in part (--truncate): the loop would overshoot")


_MAX_DEPARTURE = 0.1  # norm of the difference between a mode and what R measures of it, above which offsets are refused
_ATTRIBUTES = {"gain": "gain", "leak": "leak", "limit": "limit_nm"}
