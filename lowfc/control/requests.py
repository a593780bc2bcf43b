"""Operators' requests: what each does to the mode and the law, and the sentence it is answered with."""

from dataclasses import dataclass, replace

import numpy as np

from lowfc.control.inputs import Request
from lowfc.control.law import Law
from lowfc.control.safety import LoopMode, request_mode
from lowfc.control.stability import limiting_gain

REQUESTS = ("status", "open", "close", "safe", "clear", "gain", "leak")


@dataclass(frozen=True, slots=True)
class Answer:
    """Mode and law after a request, whether it was accepted, and the sentence about it."""

    mode: LoopMode
    law: Law | None
    accepted: bool
    text: str


def answer(mode: LoopMode, law: Law | None, noll: tuple[int, ...], delay_frames: float, request: Request) -> Answer:
    """What a request does to the mode and to the law of the modes `noll`."""
    match request.name:
        case "status":
            return Answer(mode, law, True, mode.name.lower())
        case "open" | "close" | "safe" | "clear":
            after, refusal = request_mode(mode, request.name, calibrated=law is not None)
            return Answer(after, law, not refusal, refusal or f"loop {after.name.lower()}")
        case "gain" | "leak":
            if law is None:
                return Answer(mode, law, False, "no calibration is loaded, so there are no modes yet")
            try:
                changed = _change(law, noll, delay_frames, request)
            except ValueError as error:
                return Answer(mode, law, False, str(error))
            values = getattr(changed, request.name).tolist()
            return Answer(mode, changed, True, f"{request.name} is now {' '.join(f'{value:g}' for value in values)}")
    return Answer(mode, law, False, f"unknown request {request.name!r}; there are {', '.join(REQUESTS)}")


def _change(law: Law, noll: tuple[int, ...], delay_frames: float, request: Request) -> Law:
    """The law with new gains or leaks; ValueError says what is wrong with the request."""
    modes = request.modes or noll
    unknown = sorted(set(modes) - set(noll))
    if unknown:
        raise ValueError(f"Noll modes {unknown} are not controlled; there are {noll[0]} to {noll[-1]}")
    if len(request.values) not in (1, len(modes)):
        raise ValueError(f"give one value, or one for each of the {len(modes)} modes; got {len(request.values)}")
    if not np.isfinite(request.values).all():
        raise ValueError(f"{request.name} must be finite, got {list(request.values)}")
    if request.name == "gain":
        highest = limiting_gain(delay_frames)
        if not (min(request.values) >= 0 and max(request.values) < highest):
            raise ValueError(
                f"gain must be at least 0 and below {highest:.3g}, where a loop with a delay of {delay_frames:g} "
                f"frames becomes unstable; got {max(request.values, key=abs):g}"
            )
    elif not (min(request.values) >= 0 and max(request.values) <= 1):
        raise ValueError(f"leak must be between 0 and 1, got {max(request.values, key=abs):g}")
    array = getattr(law, request.name).copy()
    array[[noll.index(mode) for mode in modes]] = np.asarray(request.values, dtype=np.float32)
    return replace(law, **{request.name: array})
