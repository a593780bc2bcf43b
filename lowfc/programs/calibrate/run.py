"""Calibration through the bus: pokes are played by the controller, frames come back, H is fitted to them."""

import contextlib
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from lowfc.adapters import instrument
from lowfc.adapters.progress import Counted
from lowfc.client import configuration_of
from lowfc.contract.errors import CalibrationError, LowfcError
from lowfc.contract.messages import wire
from lowfc.control.calibration import Calibration, comparable
from lowfc.control.camera import CameraSettings
from lowfc.control.delay_fit import Delay
from lowfc.control.poke_plan import Plan
from lowfc.control.regularised import pixel_variance
from lowfc.control.response_fit import (
    Check,
    Cycle,
    Initial,
    LinearRange,
    Measured,
    Sums,
    check,
    cycle_response,
    initial_of,
    linear_range,
    measured,
    normalised,
)
from lowfc.programs.calibrate.first_poke import first_poke
from lowfc.programs.calibrate.frame_count import FrameCount, Say
from lowfc.programs.calibrate.partial import go_on, keep, partial_of
from lowfc.programs.calibrate.pokes import AMPLITUDE_NM as AMPLITUDE_NM
from lowfc.programs.calibrate.pokes import DITHER_SLOWEST, Pokes, checks
from lowfc.programs.calibrate.pokes import Wanted as Wanted
from lowfc.programs.calibrate.recording import Answered, Loop, PlayInterruptedError, Recording, play

Array = npt.NDArray[np.float64]

MOST_FAILURES = 5
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


class Taken(NamedTuple):
    """What was measured."""

    measured: Measured
    delay: Delay


class Calibrator:
    """One calibration of a running loop; the mirror is afterwards where it was.

    Attributes:
        config: the loop's.
        before: the calibration in use.
        noise_nm: (modes,) of one frame, with that calibration.
        pokes: what is played.
        kept: cycles that another calibration can go on from.
    """

    def __init__(
        self, loop: Controller, wanted: Wanted, say: Say, progress: Counted, computed: Calibration | None = None
    ) -> None:
        """Ask the controller what it has.

        Args:
            loop: A connection to it.
            wanted: What is asked for.
            say: For people.
            progress: For people: frames so far, and of how many.
            computed: What the optical model says, of which R is made where its pixels are the loop's.
        """
        self._loop = loop
        self._wanted = wanted
        self._say = say
        self.config = configuration_of(loop)
        self.before = replace(loop.calibration(), camera=loop.camera())
        self._computed = computed
        self._basis = self.before.modes_to_actuators.T
        self._dark = self.before.dark.astype(np.float64)
        self._good = self.before.good.astype(np.float64)
        self.noise_nm = instrument.frame_noise_nm(self.config, self.before)
        self._closed = wanted.method == "in-loop"
        self.pokes = Pokes(self.config, self.before, self.noise_nm, wanted)
        self._count = FrameCount(progress)
        self.kept = 0

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
                self._loop.check_lease()  # whoever ended it has the last word on the loop
                self._loop.close_loop()
            except LowfcError as fault:  # what went wrong first is what is told
                self._say(f"warning: the loop is not closed again: {fault}")
            raise
        self._loop.close_loop()

    def run(self, delay: Delay | None = None) -> Taken:
        """Check that pokes are seen, measure the delay unless it is known, then the response.

        Raises:
            CalibrationError: pokes are not seen, frames are lost, or a limit acts.
        """
        delay = self.delay() if delay is None else delay
        return Taken(self._cycles(delay), delay)

    def check(self, made: Calibration, taken: Taken) -> Check:
        """The cross-talk of a new calibration at the present zero point, from cycles of its own.

        Raises:
            CalibrationError: frames were lost, or a limit acts.
        """
        R = made.reconstructor.astype(np.float64)
        cycles = taken.measured.cycles
        count = checks(cycles)
        answers = []
        for number in range(count):
            left = self.pokes.frames(cycles, cycles + number)
            cycle = self._useful_cycle(cycles + number, taken.delay, f"check {number + 1} of {count}", left)
            answers.append(R @ cycle.response)
        return check(np.array(answers), R @ taken.measured.response, taken.measured.error * np.sqrt(cycles))

    def linear_range(self, made: Calibration, delay: Delay) -> LinearRange:
        """How far each mode is linear, seen with a new calibration; the loop is open.

        Raises:
            CalibrationError: frames were lost, or a limit acts.
        """
        plan = self.pokes.ladder()
        for _ in range(MOST_FAILURES):
            try:
                recording = self._play(self._basis, plan, "linear range", len(plan))
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

    @property
    def _best(self) -> int:
        """Place of the mode that is measured best; tip and tilt, which are shaken most, only without others."""
        tilt = np.array([index in (2, 3) for index in self.before.noll])
        return int(np.where(tilt & ~tilt.all(), np.inf, self.noise_nm).argmin())

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
        mode = self._best
        plan = self.pokes.delay(mode)
        loop = self._count.of(self._loop, "looking for pokes", len(plan) + self.pokes.frames(self.pokes.cycles()))
        found = first_poke(loop, self.before, mode, plan, self._say, closed=self._closed)
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
        pokes, wanted = self.pokes, self._wanted
        what: dict[str, Any] = {
            "method": wanted.method,
            "amplitude_nm": pokes.amplitude_nm,
            "calibration": self.before.id,
        }
        path = partial_of(wanted.out)
        if wanted.resume:
            sums = go_on(path, what)
            self.kept = sums.cycles
            self._say(f"going on after {sums.cycles} cycles")
        else:
            sums = Sums.none(self._initial(delay))
        needed = max(pokes.cycles(), sums.cycles)
        self._say(
            f"{needed} cycles of {len(pokes.cycle(0))} frames and {checks(needed)} to check them"
            + (", then the linear range; " if pokes.ranged else "; ")
            + self._to_go(needed, sums.cycles)
        )
        while True:
            while sums.cycles < needed:
                done = sums.cycles
                left = pokes.frames(needed, done)
                sums = sums.plus(self._useful_cycle(done, delay, f"{wanted.method} cycle {done + 1} of {needed}", left))
                keep(path, sums, what)
                self.kept = sums.cycles
            found = measured(sums)
            more = pokes.more_cycles(needed, float(found.error.max()))
            if more <= needed:
                return found
            self._say(
                f"the cycles scatter by more than photons and read-out: {more} of them instead of {needed}; "
                + self._to_go(more, needed)
            )
            needed = more

    def _to_go(self, needed: int, done: int) -> str:
        return f"about {self.pokes.frames(needed, done) / self.config.camera.rate_hz:.0f} s to go"

    def _initial(self, delay: Delay) -> Initial:
        """The reconstructor of which the measured one is made: the computed one, unless that in use sees more."""
        before = self.before
        of = [each for each in (self._computed, before) if each is not None and comparable(each, before)]
        candidates = [Initial(each.reconstructor * self._good, each.estimator) for each in of]
        whole = [each for each in candidates if np.linalg.matrix_rank(each.matrix) == len(before.noll)]
        if not whole:
            raise CalibrationError(
                "neither the optical model nor the calibration in use tells all modes apart on these pixels, and R is "
                "made from one of them: `lowfc calibrate align` computes it for this sensor"
            )
        camera = instrument.detector(self.config)
        variance = pixel_variance(
            before.reference.astype(np.float64),
            before.flux_dn * camera.gain_e_per_dn / camera.em_gain,
            instrument.equivalent_read_noise_e(camera),
        )
        return initial_of(whole, delay.picture, self._best, variance)

    def _play(self, basis_nm: npt.NDArray[np.floating], plan: Plan, doing: str, left: int) -> Recording:
        """Play a plan; `left` frames are left with it."""
        return play(self._count.of(self._loop, doing, left), basis_nm, plan.table)

    def _useful_cycle(self, number: int, delay: Delay, doing: str, left: int) -> Cycle:
        """Play and fit one cycle, again where it is of no use."""
        for failures in range(1, MOST_FAILURES + 1):
            try:
                return self._cycle(number, delay, doing, left)
            except (PlayInterruptedError, ValueError) as error:
                if failures == MOST_FAILURES:
                    raise CalibrationError(f"{failures} cycles in a row were of no use: {error}") from None
                self._say(f"a cycle is repeated: {error}")
        raise AssertionError

    def _cycle(self, number: int, delay: Delay, doing: str, left: int) -> Cycle:
        """Play and fit one cycle; ValueError where it is of no use."""
        plan = self.pokes.cycle(number)
        recording = self._play(self._basis, plan, doing, left)
        fractions, flux = normalised(recording.pixels, self._dark, self._good)
        poked = recording.played(plan.table, delay.delay_frames)
        moved = poked + recording.commands(delay.delay_frames) if self._closed else poked
        use = recording.usable(plan, delay.delay_frames)
        slowest = DITHER_SLOWEST if self._closed else 0.0
        return cycle_response(fractions, flux, moved, poked, use.astype(np.float64), slowest)
