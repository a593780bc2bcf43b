"""Control of the live loop by the acceptance tests: probe sequences, announced by notes in the loop's log."""

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from lowfc.adapters.logs.columns import steps_as_columns
from lowfc.arrays import Single
from lowfc.client import Client, Step, configuration_of
from lowfc.contract.codecs.codec import max_bytes
from lowfc.contract.messages import wire
from lowfc.control.laws.linear_law import LinearLaw
from lowfc.control.loop.command_channels import MIRROR, OFFSET
from lowfc.control.loop.safety import LoopMode
from lowfc.control.loop.state import FADING_FRAMES, SETTLING_FRAMES
from lowfc.programs.commissioning.acceptance.probe import (
    ANNOUNCEMENT,
    LIMITS,
    AcceptanceError,
    Kind,
    ProbeResponse,
    loop_of,
    probe_response,
)
from lowfc.programs.commissioning.calibrate.recording import await_mirror

ATTEMPTS = 3
"""Attempts to play a probe sequence; if mirror or camera interrupt every attempt, the test ends with an error."""
_OTHER_BYTES = 1000  # bytes of a request to play besides its table and shapes
_LAW_FIELDS = ("gain", "leak", "limit_nm", "law", "calibration_id")


class Live:
    """The live loop; `restored` stops probe sequences and restores the mode at the end."""

    def __init__(self, client: Client, progress: Callable[[int, int], None], report: Callable[[str], object]) -> None:
        """Read calibration, configuration and mode of the loop; AcceptanceError unless the loop is open or closed."""
        self.client = client
        self.calibration = client.calibration()
        self.configuration = configuration_of(client)
        state = self._state()
        self._initial_mode = LoopMode(state.mode)
        if self._initial_mode not in (LoopMode.OPEN, LoopMode.CLOSED):
            raise AcceptanceError(f"the loop is {self._initial_mode.in_words}: it must be open or closed for a test")
        self._progress, self._report = progress, report
        self._done = self._expected = 0
        self.loop = loop_of(state, self.calibration, self.configuration.camera.rate_hz, self.client.laws())

    @contextmanager
    def restored(self) -> Iterator[None]:
        """At the end, also after an exception, stop a probe sequence and restore the loop mode; safe mode stays."""
        try:
            yield
        finally:
            self.client.check_lease()  # raises if another operator ended the lease: the loop is left to them
            self.client.stop()
            now = LoopMode(self._state().mode)
            if now in (LoopMode.OPEN, LoopMode.CLOSED) and now is not self._initial_mode:
                self.set_mode(self._initial_mode)

    def expect(self, frames: int) -> None:
        """Set the total number of frames for the progress bar; by default it covers one probe sequence."""
        self._expected = frames

    def skip(self, frames: int) -> None:
        """Count expected frames as done without playing them."""
        self._done += frames

    def set_mode(self, mode: LoopMode) -> None:
        """Open or close the loop unless it is in this mode already; after closing it, wait until it has settled."""
        if LoopMode(self._state().mode) is not mode:
            if mode is LoopMode.OPEN:
                self.client.open_loop()
                return
            self.client.close_loop()
            takeover = SETTLING_FRAMES + FADING_FRAMES if isinstance(self.loop.law, LinearLaw) else 0
            self.wait(takeover + self.loop.settling_frames())

    def return_to_zero(self) -> None:
        """Open the loop, reset the command and wait until the command is zero."""
        self.client.stop()
        self.client.open_loop()
        self.client.reset()
        self.wait(2)
        while self._state().returning_to_zero:
            self.wait(2)

    def wait(self, frames: int) -> None:
        """Wait for this many frames."""
        for _ in self.client.steps(frames):
            pass

    def check_length(self, frames: int, columns: int, basis: Single | None) -> None:
        """Raise AcceptanceError if a table of this size, with the shapes `basis`, is too large for a request."""
        shape_bytes = 0 if basis is None else basis.nbytes
        max_frames = (max_bytes("play") - _OTHER_BYTES - shape_bytes) // (4 * max(columns, 1))
        if columns and frames > max_frames:
            longest_s = max_frames / self.loop.rate_hz
            raise AcceptanceError(f"a probe sequence of {columns} columns is too long: shorten it to {longest_s:.0f} s")

    def play(
        self, kind: Kind, parameters: dict[str, Any], mode: LoopMode, table: Single, basis: Single | None = None
    ) -> ProbeResponse:
        """Play a table and return the loop's response; without shapes (`basis`) the table is added to the offset.

        A table without columns adds no probe: only the steps are recorded. AcceptanceError if the table is too large
        for a request, gains or law changed, or the mirror or the camera interrupted each of `ATTEMPTS` attempts.
        """
        self.check_length(frames := len(table), table.shape[1], basis)
        self.set_mode(mode)
        for _ in range(ATTEMPTS):
            response, interruption = self._play_once(kind, parameters, mode, table, basis)
            if not interruption:
                self._done += frames
                return response
            now = LoopMode(self._state().mode)
            if now is not mode:  # changed by an interlock, for example: the loop is not closed again
                raise AcceptanceError(f"{interruption} during the measurement, and the loop is {now.in_words} now")
            self._report(f"{kind}: {interruption} during a probe sequence, which is repeated")
            self.wait(self.loop.settling_frames())
        raise AcceptanceError(f"in {ATTEMPTS} attempts no probe sequence was undisturbed; the last: {interruption}")

    def _play_once(
        self, kind: Kind, parameters: dict[str, Any], mode: LoopMode, table: Single, basis: Single | None
    ) -> tuple[ProbeResponse, str]:
        """Play a table once; return the response, and what interrupted the probe sequence, empty if nothing did."""
        frames, columns = table.shape
        before = self._state()
        steps, watch = self.client.steps(), self.client.mirror_watch()
        await_mirror(self.client)
        answer = self.client.note(ANNOUNCEMENT + json.dumps({"test": kind, **parameters, "frames": frames}))
        target = ""
        if basis is not None:
            target, answer = MIRROR, self.client.play(basis, table)
        elif columns:
            target, answer = OFFSET, self.client.play_offset(table)
        first = answer.frame_sequence
        recorded: list[Step] = []
        for step in steps:
            watch.read()
            if step.frame_sequence < first:
                continue
            if step.frame_sequence >= first + frames:
                break
            recorded.append(step)
            passed = step.frame_sequence - first + 1
            self._progress(self._done + passed, max(self._expected, self._done + frames))
            if step.mode is not mode or set(step.reasons) & set(LIMITS) or (columns and watch.interruption):
                break  # `play` reports an interruption, `judge` any other cause
        steps.close()
        after = self._state()
        if [getattr(before, name) for name in _LAW_FIELDS] != [getattr(after, name) for name in _LAW_FIELDS]:
            raise AcceptanceError("gains or control law changed during the measurement: measure again")
        watch.read()
        loop = loop_of(before, self.calibration, self.loop.rate_hz, self.client.laws())
        response = probe_response(parameters, loop, target, table, first, steps_as_columns(recorded, len(loop.noll)))
        return response, watch.interruption if columns else ""

    def _state(self) -> wire.ControllerState:
        state = self.client.status().state
        if state is None or not state.gain:
            raise AcceptanceError("the controller has no calibration: load one with `lowfc ctl load`")
        return state
