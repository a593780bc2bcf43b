"""Calibration through the bus: pokes are played by the controller, frames come back, H is fitted to them."""

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from lowfc.adapters import instrument
from lowfc.adapters.progress import Counted
from lowfc.client import configuration_of
from lowfc.contract.errors import CalibrationError, LowfcError
from lowfc.contract.messages import wire
from lowfc.control import poke_plan
from lowfc.control.calibration import Calibration
from lowfc.control.camera import CameraSettings
from lowfc.control.delay_fit import Delay, measure_delay
from lowfc.control.response_fit import (
    Cycle,
    LinearRange,
    Measured,
    Sums,
    cycle_response,
    linear_range,
    measured,
    normalised,
)
from lowfc.programs.calibrate.partial import go_on, keep, partial_of
from lowfc.programs.calibrate.recording import Answered, Loop, PlayInterruptedError, Recording, play

Array = npt.NDArray[np.float64]
Say = Callable[[str], None]

METHODS = ("poke", "hadamard", "in-loop")
AMPLITUDE_NM = {"poke": 8.0, "hadamard": 3.0, "in-loop": 2.0}
MOST_HADAMARD_NM = 3.0
"""Of a mode: all modes at once add up to some four times that, and the sensor must stay linear."""
DELAY_FRAMES = 600
SETTLE = 2
"""Frames left out after each change: one for a delay that is a fraction, one for a command that comes late."""
HOLD = 4
DITHER_HOLD = 2
"""Frames between the changes of a dither: the longer, the more of it the loop works against."""
PIECE = 1024
"""Frames of a piece of a dither."""
LEAST_CYCLES = 4
"""So that their scatter says something."""
MOST_FAILURES = 5
RANGE_LEVELS = (0.25, 0.5, 0.75, 1.0)
RANGE_ERROR = 0.03
MOST_RANGE_NM = 60.0
_OF_THE_SLEW = 0.8
_LIKE = 0.3
"""Likeness of the first pokes' picture to the calibration in use below which something is said."""


class Status(Answered, Protocol):
    """The controller's state beside the answer."""

    @property
    def state(self) -> wire.ControllerState | None:
        """Complete."""
        ...


class Controller(Loop, Protocol):
    """What of `lowfc.client.Client` a calibration needs."""

    def status(self) -> Status:
        """What the controller is doing."""
        ...

    def open(self) -> Answered:
        """Hold the mirror."""
        ...

    def close_loop(self) -> Answered:
        """Let the law drive the mirror."""
        ...

    def camera(self) -> CameraSettings | None:
        """See `Client.camera`."""
        ...

    def calibration(self) -> Calibration:
        """The one in use."""
        ...

    def configuration(self) -> str:
        """The controller's, TOML."""
        ...


@dataclass(frozen=True, slots=True)
class Wanted:
    """What a calibration shall be.

    Attributes:
        method: poke, hadamard or in-loop.
        amplitude_nm: of a mode, wavefront rms; None for the usual.
        snr: to which R shall be known; None where `cycles` says how long.
        cycles: how many; None where `snr` says.
        out: the file to be written; the cycles done are kept beside it.
        resume: go on from those.
        seed: of a dither.
        range: measure the linear range.
    """

    method: str
    amplitude_nm: float | None
    snr: float
    cycles: int | None
    out: Path
    resume: bool
    seed: int = 1
    range: bool = True


class Taken(NamedTuple):
    """What was measured."""

    measured: Measured
    delay: Delay


class Calibrator:
    """One calibration of a running loop; the mirror is afterwards where it was."""

    def __init__(self, loop: Controller, wanted: Wanted, say: Say, progress: Counted) -> None:
        """Ask the controller what it has."""
        self._loop = loop
        self._wanted = wanted
        self._say = say
        self._progress = progress
        self.config = configuration_of(loop)
        self.before = replace(loop.calibration(), camera=loop.camera())
        self._basis = self.before.modes_to_actuators.T
        self._modes = len(self.before.noll)
        self._dark = self.before.dark.astype(np.float64)
        self._good = self.before.good.astype(np.float64)
        self.noise_nm = instrument.frame_noise_nm(self.config, self.before)
        self._closed = wanted.method == "in-loop"
        self.amplitude_nm = self._amplitude()

    @contextlib.contextmanager
    def holding(self) -> Iterator[None]:
        """The loop as the method needs it; afterwards it is as it was.

        Raises:
            CalibrationError: the loop is open where it must be closed, or safed.
        """
        state = self._loop.status().state
        mode = state.mode if state is not None else wire.LOOP_MODE_OPEN
        if mode not in (wire.LOOP_MODE_OPEN, wire.LOOP_MODE_CLOSED):
            raise CalibrationError("the loop must be open or closed: `lowfc ctl clear` leaves the safe state")
        if self._closed and mode != wire.LOOP_MODE_CLOSED:
            raise CalibrationError(
                "--method in-loop dithers under a closed loop, but the loop is open: `lowfc ctl close` first"
            )
        if self._closed or mode != wire.LOOP_MODE_CLOSED:
            yield
            return
        self._say("the loop is opened for the calibration, and closed again after it")
        self._loop.open()
        try:
            yield
        except BaseException:
            try:
                self._loop.close_loop()
            except LowfcError as fault:  # what went wrong first is what is told
                self._say(f"warning: the loop is not closed again: {fault}")
            raise
        self._loop.close_loop()

    def run(self) -> Taken:
        """Check that pokes are seen, measure the delay, then the response.

        Raises:
            CalibrationError: pokes are not seen, frames are lost, or a limit acts.
        """
        delay = self.delay()
        return Taken(self._cycles(delay), delay)

    def linear_range(self, made: Calibration, delay: Delay) -> LinearRange:
        """How far each mode is linear, seen with a new calibration; the loop is open.

        Raises:
            CalibrationError: frames were lost, or a limit acts.
        """
        top = np.minimum(MOST_RANGE_NM, self._largest_nm())
        amplitudes = np.outer(RANGE_LEVELS, top)
        noise = float(self.noise_nm.max()) / (RANGE_ERROR * float(amplitudes[0].min()))
        plan = poke_plan.ladder(amplitudes, int(np.clip(np.ceil(noise**2 / 2), 2, 200)), SETTLE)
        self._progress("linear range", 0, len(plan))
        for _ in range(MOST_FAILURES):
            try:
                recording = play(self._loop, self._basis, plan.table)
                fractions, _ = self._fractions(recording)
                modes_nm = (fractions - made.reference) @ made.reconstructor.T.astype(np.float64)
                use = recording.usable(plan, delay.delay_frames)
                poked = recording.played(plan.table, delay.delay_frames)
                return linear_range(modes_nm[use], poked[use], recording.blocks(plan, delay.delay_frames)[use])
            except (PlayInterruptedError, ValueError) as error:
                self._say(f"once more: {error}")
        raise CalibrationError(
            f"in {MOST_FAILURES} attempts the linear range was not measured: `lowfc doctor` looks for why frames are "
            "lost; the cycles are kept, --resume --no-linear-range makes the calibration of them"
        )

    def _amplitude(self) -> float:
        """What was asked for, or the usual, as far as the mirror's slew limit lets it."""
        asked, method = self._wanted.amplitude_nm, self._wanted.method
        if method == "hadamard" and asked is not None and asked > MOST_HADAMARD_NM:
            raise CalibrationError(
                f"--amplitude {asked:g} nm is too much for hadamard, which pokes all modes at once: at most "
                f"{MOST_HADAMARD_NM:g} nm of each"
            )
        shapes = self._plan(0, 1.0).table @ self._basis
        steepest = float(np.abs(np.diff(shapes, axis=0)).max())
        largest = _OF_THE_SLEW * self._slew_nm / max(steepest, 1e-9)
        if asked is None:
            return min(AMPLITUDE_NM[method], largest)
        if asked > largest:
            raise CalibrationError(
                f"--amplitude {asked:g} nm: from push to pull an actuator would move by more than {_OF_THE_SLEW:g} "
                f"of the slew limit; at most {largest:.3g} nm"
            )
        return asked

    @property
    def _slew_nm(self) -> float:
        return min(self.config.safety.slew_nm, self.config.mirror.slew_nm)

    def _largest_nm(self) -> Array:
        """(modes,) amplitude at which the mirror goes from push to pull within its slew limit."""
        steepest = np.abs(self._basis).max(axis=1)
        return np.asarray(_OF_THE_SLEW * self._slew_nm / (2 * np.maximum(steepest, 1e-9)), dtype=np.float64)

    def _fractions(self, recording: Recording) -> tuple[Array, Array]:
        try:
            return normalised(recording.pixels, self._dark, self._good)
        except ValueError as error:
            raise CalibrationError(str(error)) from None

    def delay(self) -> Delay:
        """From poke to image, with the mode that is measured best.

        Raises:
            CalibrationError: no poke is seen, or frames are lost.
        """
        mode = int(self.noise_nm.argmin())
        amplitude = self.amplitude_nm if self._closed else AMPLITUDE_NM["poke"]
        amplitude = min(amplitude, float(self._largest_nm()[mode]))
        plan = poke_plan.dither(1, amplitude, DELAY_FRAMES, 1, self._wanted.seed)
        self._progress("looking for pokes", 0, DELAY_FRAMES)
        for _ in range(MOST_FAILURES):
            try:
                recording = play(self._loop, self._basis[mode : mode + 1], plan.table)
            except PlayInterruptedError as error:
                self._say(f"once more: {error}")
                continue
            if recording.whole:
                break
            self._say("frames were lost or refused while the delay was measured: once more")
        else:
            raise CalibrationError(
                f"in {MOST_FAILURES} attempts there was no run of {DELAY_FRAMES} frames without a lost or refused "
                "one: `lowfc doctor` looks for why"
            )
        fractions, _ = self._fractions(recording)
        command = recording.command_nm[:DELAY_FRAMES, mode] if self._closed else None
        try:
            found = measure_delay(
                fractions[:DELAY_FRAMES], self.before.reference.astype(np.float64), plan.table[:, 0], command
            )
        except ValueError as error:
            raise CalibrationError(str(error)) from None
        self._compare_picture(found.picture, mode)
        self._say(
            f"pokes of Z{self.before.noll[mode]} are seen after {found.delay_frames:.3f} +- {found.error_frames:.3f} "
            f"frames, {found.delay_frames * self.config.period_ns * 1e-6:.3g} ms from the end of one exposure to that "
            "of the one that sees what was made of it"
        )
        return found

    def _compare_picture(self, picture: Array, mode: int) -> None:
        known = self.before.response[:, mode].astype(np.float64)
        like = float(picture @ known) / max(float(np.linalg.norm(picture) * np.linalg.norm(known)), 1e-300)
        if abs(like) < _LIKE:
            self._say(
                f"warning: the picture of Z{self.before.noll[mode]} is not like that of the calibration in use (their "
                f"correlation is {like:.2f}): is the sensor aligned (`lowfc calibrate align`)?"
            )
        elif like < 0:
            self._say(
                f"warning: Z{self.before.noll[mode]} is seen with the opposite sign of the calibration in use: the "
                "mirror or the camera is reflected or turned; do not close the loop on that one"
            )

    def _cycles(self, delay: Delay) -> Measured:
        wanted = self._wanted
        example = self._plan(0, self.amplitude_nm)
        needed = wanted.cycles
        if needed is None:
            frames = poke_plan.frames_for(wanted.snr, float(self.noise_nm.max()), self.amplitude_nm)
            needed = -(-frames // example.per_column)
        needed = max(needed, LEAST_CYCLES)
        what: dict[str, Any] = {
            "method": wanted.method,
            "amplitude_nm": self.amplitude_nm,
            "calibration": self.before.id,
        }
        path = partial_of(wanted.out)
        sums = Sums.none(self._good.size, self._modes)
        if wanted.resume:
            sums = go_on(path, what)
            self._say(f"going on after {sums.cycles} cycles")
        seconds = (needed - sums.cycles) * len(example) / self.config.camera.rate_hz
        self._say(f"{needed} cycles of {len(example)} frames; about {max(seconds, 0):.0f} s to go")
        failures = 0
        while sums.cycles < needed:
            self._progress(f"{wanted.method} cycles", sums.cycles, needed)
            try:
                sums = sums.plus(self._cycle(sums.cycles, delay))
                failures = 0
            except (PlayInterruptedError, ValueError) as error:
                failures += 1
                if failures >= MOST_FAILURES:
                    raise CalibrationError(f"{failures} cycles in a row were of no use: {error}") from None
                self._say(f"a cycle is repeated: {error}")
                continue
            keep(path, sums, what)
        self._progress(f"{wanted.method} cycles", needed, needed)
        return measured(sums)

    def _plan(self, number: int, amplitude_nm: float) -> poke_plan.Plan:
        wanted = self._wanted
        if self._closed:
            seed = wanted.seed + 1000 * (number + 1)
            return poke_plan.dither(self._modes, amplitude_nm, PIECE, DITHER_HOLD, seed)
        patterns = poke_plan.hadamard_patterns if wanted.method == "hadamard" else poke_plan.poke_patterns
        rest = max(16, len(poke_plan.SIGNS) * HOLD)
        return poke_plan.cycle(patterns(self._modes, amplitude_nm), HOLD, SETTLE, rest, backwards=number % 2 == 1)

    def _cycle(self, number: int, delay: Delay) -> Cycle:
        """Play and fit one cycle; ValueError where it is of no use."""
        plan = self._plan(number, self.amplitude_nm)
        recording = play(self._loop, self._basis, plan.table)
        fractions, flux = normalised(recording.pixels, self._dark, self._good)
        poked = recording.played(plan.table, delay.delay_frames)
        moved = poked + recording.commands(delay.delay_frames) if self._closed else poked
        use = recording.usable(plan, delay.delay_frames)
        return cycle_response(fractions, flux, moved, poked, use.astype(np.float64))
