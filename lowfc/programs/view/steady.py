"""The last frames under one loop mode and one control law."""

from collections import deque
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lowfc.contract.messages import wire
from lowfc.control.safety import LoopMode
from lowfc.control.stability import settling_frames
from lowfc.programs.view.moment import Moment

FRAMES = 6144
"""Frames kept: for spectra eleven segments of 1024."""

Single = npt.NDArray[np.float32]


class LawInForce(NamedTuple):
    """Gain and leak of each mode of the integrator, the delay in frames, and the linear law in its place, if any."""

    gain: tuple[float, ...]
    leak: tuple[float, ...]
    delay_frames: float
    linear: str


class Steady:
    """Measured error and pseudo-open-loop of the last frames since loop mode or law changed, and the law has settled.

    Attributes:
        mode: of the loop, as in a step; 0 before the first step.
        law: in force; None where the controller does not report it, or reports one for other modes.
    """

    def __init__(self) -> None:
        self.mode = 0
        self.law: LawInForce | None = None
        self._settling = 0
        self._kept: deque[tuple[npt.NDArray[np.uint64], Single]] = deque()

    def feed(self, moment: Moment, modes: int) -> None:
        """Add the steps of a moment, which are of so many modes."""
        steps, law = moment.steps, _law_of(moment.controller, modes)
        changes = np.flatnonzero(np.diff(steps.mode.astype(int), prepend=self.mode))
        first = int(changes[-1]) if changes.size else 0
        if changes.size or law != self.law:
            self._kept.clear()
            self.mode, self.law = int(steps.mode[-1]), law
            self._settling = 0
            if law is not None and self.mode == LoopMode.CLOSED:
                self._settling = min(settling_frames(np.array(law.gain), np.array(law.leak)), FRAMES)
        signals = np.concatenate([steps.error_nm, steps.pol_nm], axis=1)
        left_out = min(self._settling, len(signals) - first)
        self._settling -= left_out
        self._kept.append((steps.sequence[first + left_out :], signals[first + left_out :]))
        kept = sum(len(sequence) for sequence, _ in self._kept)
        while kept - len(self._kept[0][0]) >= FRAMES:
            kept -= len(self._kept.popleft()[0])

    def rows(self) -> tuple[npt.NDArray[np.uint64], Single]:
        """Sequence of each frame, and error and pseudo-open-loop (frames, 2 x modes); after the first `feed`."""
        sequence, signals = (np.concatenate(column) for column in zip(*self._kept, strict=True))
        return sequence, signals


def _law_of(state: wire.ControllerState | None, modes: int) -> LawInForce | None:
    if state is None or not len(state.gain) == len(state.leak) == modes or not state.delay_frames >= 1:
        return None
    linear = (state.law.id or state.law.name) if state.HasField("law") else ""
    return LawInForce(tuple(state.gain), tuple(state.leak), state.delay_frames, linear)
