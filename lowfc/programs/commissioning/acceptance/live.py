"""The live loop as the acceptance tests have it: what they play is announced in its log, and it is left as found."""

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from lowfc.adapters.logs.columns import of_steps
from lowfc.arrays import Single
from lowfc.client import Client, Step, configuration_of
from lowfc.contract.messages import wire
from lowfc.control.laws.linear_law import LinearLaw
from lowfc.control.loop.command_channels import MIRROR, OFFSET
from lowfc.control.loop.safety import LoopMode
from lowfc.control.loop.state import FADING_FRAMES, SETTLING_FRAMES
from lowfc.programs.commissioning.acceptance.played import (
    ANNOUNCEMENT,
    LIMITS,
    AcceptanceError,
    Kind,
    Played,
    loop_of,
    played,
)

_LAW = ("gain", "leak", "limit_nm", "law", "calibration_id")


class Live:
    """The live loop, left in the mode in which it was found, with nothing more being played."""

    def __init__(self, client: Client, progress: Callable[[int, int], None]) -> None:
        """Take hold of the loop."""
        self.client = client
        self.calibration = client.calibration()
        self.configuration = configuration_of(client)
        state = self._state()
        if LoopMode(state.mode) not in (LoopMode.OPEN, LoopMode.CLOSED):
            raise AcceptanceError(
                f"the loop is {LoopMode(state.mode).in_words}: it must be open or closed to be measured"
            )
        self._found = LoopMode(state.mode)
        self._progress = progress
        self._past = self._expected = 0
        self.loop = loop_of(state, self.calibration, self.configuration.camera.rate_hz, self.client.laws())

    @contextmanager
    def kept(self) -> Iterator["Live"]:
        """Leave the loop as it was found, whatever happens meanwhile; but safe mode stays."""
        try:
            yield self
        finally:
            self.client.check_lease()  # whoever ended it has the last word on the loop
            self.client.stop()
            now = LoopMode(self._state().mode)
            if now in (LoopMode.OPEN, LoopMode.CLOSED) and now is not self._found:
                self.into(self._found)

    def expect(self, frames: int) -> None:
        """Say how many frames all that is to be played will take; otherwise each play counts by itself."""
        self._expected = frames

    def left_out(self, frames: int) -> None:
        """Say that so many of the expected ones will not be played."""
        self._past += frames

    def into(self, mode: LoopMode) -> None:
        """Open or close the loop, where it is not."""
        if LoopMode(self._state().mode) is not mode:
            if mode is LoopMode.OPEN:
                self.client.open_loop()
                return
            self.client.close_loop()
            takeover = SETTLING_FRAMES + FADING_FRAMES if isinstance(self.loop.law, LinearLaw) else 0
            self.wait(takeover + self.loop.settling_frames())

    def rest(self) -> None:
        """Take the command to zero and begin anew."""
        self.client.stop()
        self.client.open_loop()
        self.client.reset()
        self.wait(2)
        while self._state().returning_to_zero:
            self.wait(2)

    def wait(self, frames: int) -> None:
        """Let some frames pass."""
        for _ in self.client.steps(frames):
            pass

    def play(
        self, kind: Kind, what: dict[str, Any], mode: LoopMode, table: Single, basis: Single | None = None
    ) -> Played:
        """Play a table and keep what the loop does meanwhile; without shapes in `basis` it goes to the offset.

        A table without columns is a stretch in which nothing is played.
        """
        modes = len(self.calibration.noll)
        basis = np.zeros((modes, 0), np.float32) if basis is None else basis
        self.into(mode)
        before, frames = self._state(), len(table)
        steps = self.client.steps()
        first = self.client.note(ANNOUNCEMENT + json.dumps({"test": kind, **what, "frames": frames})).frame_sequence
        if table.shape[1]:
            answer = self.client.play(basis, table) if basis.size else self.client.play_offset(table)
            first = answer.frame_sequence
        kept: list[Step] = []
        for step in steps:
            if step.frame_sequence < first:
                continue
            if step.frame_sequence >= first + frames:
                break
            kept.append(step)
            passed = step.frame_sequence - first + 1
            self._progress(self._past + passed, max(self._expected, self._past + frames))
            if step.mode is not mode or set(step.reasons) & set(LIMITS):
                break  # who looks at it says what is wrong
        steps.close()
        self._past += frames
        after = self._state()
        if [getattr(before, name) for name in _LAW] != [getattr(after, name) for name in _LAW]:
            raise AcceptanceError("gains, or the law, were changed while the loop was measured: measure again")
        loop = loop_of(before, self.calibration, self.loop.rate_hz, self.client.laws())
        target = "" if not table.shape[1] else MIRROR if basis.size else OFFSET
        return played(what, loop, target, table, basis, first, of_steps(kept, modes))

    def _state(self) -> wire.ControllerState:
        state = self.client.status().state
        if state is None or not state.gain:
            raise AcceptanceError("the controller has no calibration: `lowfc ctl load` gives it one")
        return state
