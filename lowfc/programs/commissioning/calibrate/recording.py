"""Probe sequences on the mirror of a running loop: play them, record frames and steps, fit the response."""

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from time import monotonic, sleep
from typing import NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from lowfc.arrays import Array, Integers, Long, Mask, Pixels
from lowfc.client import Client, Frame, MirrorWatch
from lowfc.contract.envelope import start_of
from lowfc.contract.errors import CalibrationError, LowfcError
from lowfc.contract.messages import wire
from lowfc.control.calibration.calibration import Calibration
from lowfc.control.calibration.delay_fit import Delay, NotSeenError, measure_delay
from lowfc.control.calibration.poke_plan import Plan, seen_rows, usable_exposures
from lowfc.control.calibration.response_fit import Cycle, cycle_response, normalised
from lowfc.control.laws.stability import delay_weights
from lowfc.control.loop.advance import UNMEASURED
from lowfc.control.loop.inputs import Step
from lowfc.control.loop.safety import Limit, LoopMode

Report = Callable[[str], None]
T = TypeVar("T")

TRAILING_FRAMES = 8
"""Frames recorded after the end of a probe sequence, more than the longest delay that can be measured."""
MAX_FRAMES_BEHIND = 100
"""Frames by which mirror reports may lag behind controller steps; with a larger lag the sequence is repeated."""
LEASE_CHECK_FRAMES = 100
"""Frames between two checks that the lease is still in force."""
MAX_REFUSED_FRAMES = 50
"""Consecutive refused frames after which a probe sequence is abandoned."""
ATTEMPTS = 5
"""Attempts at a probe sequence, if frames are lost or a device restarts."""
FAULT_S = 5.0
"""Longest wait, before a probe sequence, for the end of a fault of the mirror."""
DITHER_SLOWEST = 1 / 16
"""Lowest frequency, cycles per frame, at which a dither is evaluated; most of the disturbance is at lower ones."""
_LIMITS = frozenset(Limit) - {Limit.LAW_OVERRULED}  # limits that end a probe sequence


class PlayInterruptedError(CalibrationError):
    """A device restarted or stalled during the pokes: repeat them."""


class PokesNotSeenError(CalibrationError):
    """The frames show no response to the pokes: they may be too small."""


class Recording(NamedTuple):
    """Frames and steps of a probe sequence; number 0 is the first frame whose command had a row of the table.

    Attributes:
        sequence: frame numbers (frames,), increasing; lost frames, and those without a step, are missing.
        pixels: pixels (frames, pixels), uint16, DN.
        steps: frame numbers (steps,) of the controller's steps, also of those whose frame was lost.
        commanded: whether each step sent the next row of the table to the mirror (steps,).
        command_nm: the loop's own modal command (steps, modes).
    """

    sequence: Long
    pixels: Pixels
    steps: Long
    commanded: Mask
    command_nm: Array

    def played(self, table: Array, delay_frames: float) -> Array:
        """The table as seen by each exposure (frames, columns)."""
        return seen_rows(table, _weights(delay_frames), self.steps, self.commanded)[self._steps_of_frames]

    def commands(self, delay_frames: float) -> Array:
        """The loop's own command that each exposure saw (frames, modes)."""
        frames = np.arange(self.steps[-1] + 1)
        newest = np.maximum(np.searchsorted(self.steps, frames, "right") - 1, 0)  # for a missing step, the one before
        every_step = np.ones(len(self.steps), np.bool_)
        return seen_rows(self.command_nm[newest], _weights(delay_frames), self.steps, every_step)[self._steps_of_frames]

    def usable(self, plan: Plan, delay_frames: float) -> Mask:
        """Whether each frame may be used (frames,)."""
        return usable_exposures(plan, self.steps, self.commanded, int(max(delay_frames, 1.0)))[self._steps_of_frames]

    @property
    def complete(self) -> bool:
        """Whether no frame was lost or refused."""
        return bool(self.commanded.all()) and len(self.sequence) == len(self.steps) == self.steps[-1] + 1

    @property
    def _steps_of_frames(self) -> Integers:
        return np.searchsorted(self.steps, self.sequence)


def _weights(delay_frames: float) -> Array:
    """Fraction (lags,) of an exposure that sees the row commanded 0, 1, ... frames before it."""
    return np.concatenate([[0.0], delay_weights(max(delay_frames, 1.0))])


def play(loop: Client, basis_nm: npt.NDArray[np.floating], table: npt.NDArray[np.floating]) -> Recording:
    """Play a table on the mirror and record until exposures have seen its last row.

    Args:
        loop: A connection to the controller.
        basis_nm: Shapes (shapes, actuators), nm of surface.
        table: Amplitude of each shape (frames, shapes).

    Raises:
        CalibrationError: the sequence was ended; the subclass PlayInterruptedError if camera or mirror restarted or
            stalled.
    """
    loop.check_lease()
    await_mirror(loop)
    with _streams(loop) as (frames, steps):
        mirror = loop.mirror_watch()
        first = loop.play(basis_nm.astype(np.float32), table.astype(np.float32)).frame_sequence
        last = first + len(table) - 1
        end = last + 1 + TRAILING_FRAMES
        images: list[Frame] = []
        recorded: list[Step] = []
        image, step = next(frames), next(steps)
        mode = None
        while image.sequence < end or step.frame_sequence < end or mirror.frame_sequence < last:
            if image.sequence <= step.frame_sequence:
                if first <= image.sequence:
                    images.append(image)
                image = next(frames)
            else:
                if first <= step.frame_sequence:
                    mode = _checked_mode(loop, step, mode, ended=step.frame_sequence > last)
                    _check_devices(mirror, step.frame_sequence, first)
                    recorded.append(step)
                    _check_refused(recorded)
                    if len(recorded) % LEASE_CHECK_FRAMES == 0:
                        loop.check_lease()
                step = next(steps)
        _check_devices(mirror, step.frame_sequence, first)
        loop.check_lease()
    return _recording(images, recorded, first)


def await_mirror(loop: Client) -> None:
    """Wait until the controller reports no fault of the mirror, as a probe sequence requires; at most `FAULT_S`.

    After a restart of the mirror, its first state arrives up to 0.1 s before the controller ends the fault.
    """
    deadline_s = monotonic() + FAULT_S
    while (state := loop.status().state) and state.mirror_fault and monotonic() < deadline_s:
        sleep(0.05)


def next_frames(loop: Client, count: int) -> Pixels:
    """The next `count` frames (count, rows, columns), DN; BusError if they stop."""
    return np.array([image.pixels for image in loop.frames(count)])


def check_size(shape: tuple[int, ...], in_use: Calibration) -> None:
    """CalibrationError unless the frames have the size (rows, columns) of the calibration in use."""
    if shape != in_use.shape:
        raise CalibrationError(
            f"the frames have {shape[0]} x {shape[1]} pixels and are refused as WRONG_SIZE: the calibration in use, "
            f"with its dark and bad pixels, is for {in_use.shape[0]} x {in_use.shape[1]}: load one for these frames, "
            "or measure one with `lowfc commission`"
        )


def warn_of_added_shapes(loop: Client, report: Report) -> None:
    """Warn of an offset and channels that a new reference image will contain: a loop with it adds them again."""
    state = loop.status().state or wire.ControllerState()
    added = [f"channel {channel.name}" for channel in state.channels if channel.shifts]
    added += ["the offset"] * any(state.offset_nm)
    if added:
        report(
            f"warning: the new reference image contains {', '.join(added)}; a loop with this image adds them again: "
            "set the offset to zero, and remove the channels, or keep their shapes on the channel flat"
        )


@contextlib.contextmanager
def _streams(loop: Client) -> Iterator[tuple[Iterator[Frame], Iterator[Step]]]:
    """Context with the frames and steps from now on; an error ends the probe sequence."""
    with contextlib.closing(loop.frames()) as frames, contextlib.closing(loop.steps()) as steps:
        try:
            yield frames, steps
        except BaseException:
            with contextlib.suppress(LowfcError):  # the first error is the one raised
                loop.stop()
            raise


def _checked_mode(loop: Client, step: Step, previous: LoopMode | None, *, ended: bool) -> LoopMode:
    """The mode of a step; raise if the probe sequence was stopped, unless it has `ended`: all rows precede the step."""
    if not ended and previous is not None and step.mode is not previous:
        loop.check_lease()  # its error names who ended the lease
        raise CalibrationError(
            f"the loop went from {previous.name.lower()} to {step.mode.name.lower()} during the pokes, which ended "
            "them; do not operate the loop during a calibration"
        )
    limits = [reason.name for reason in step.reasons if reason in _LIMITS]
    if limits and not ended:
        raise CalibrationError(
            f"a limit acted on the pokes ({', '.join(limits)}), which ended them: bring the mirror closer to flat, or "
            "poke less, as with `lowfc calibrate --amplitude`"
        )
    return step.mode


def _commanded(step: Step) -> bool:
    """Whether this step sent the next row to the mirror; in open loop it does even if the frame was not measured."""
    return step.error_nm is not None or (step.mode is not LoopMode.CLOSED and step.reasons[0] in UNMEASURED)


def _check_refused(steps: list[Step]) -> None:
    last = steps[-MAX_REFUSED_FRAMES:]
    if len(last) == MAX_REFUSED_FRAMES and not any(_commanded(step) for step in last):
        reasons = sorted({reason.name for step in last for reason in step.reasons})
        raise CalibrationError(
            f"the last {MAX_REFUSED_FRAMES} frames were refused as {', '.join(reasons)}, which ended the sequence; "
            "correct this first: `lowfc ctl status` shows whether frames are used again"
        )


def _check_devices(mirror: MirrorWatch, sequence: int, first: int) -> None:
    """Raise if the pokes up to a frame were not all on the mirror, or the camera restarted."""
    mirror.read()
    behind = sequence - max(mirror.frame_sequence, first)
    if start_of(sequence) != start_of(first):
        why = "the camera restarted"
    elif mirror.interruption or behind <= MAX_FRAMES_BEHIND:
        why = mirror.interruption
    else:
        why = f"the mirror has not reported an applied command for {behind} frames"
    if why:
        raise PlayInterruptedError(f"{why} during the pokes")


def _recording(images: list[Frame], steps: list[Step], first: int) -> Recording:
    stepped = {step.frame_sequence for step in steps}
    images = [image for image in images if image.sequence in stepped]
    if not images:
        raise CalibrationError("no frame of the probe sequence was received: is the loop's camera running?")
    modes = max(step.command_nm.size for step in steps)
    command = np.zeros((len(steps), modes))
    for row, step in enumerate(steps):
        command[row] = step.command_nm if step.command_nm.size == modes else command[max(row - 1, 0)]
    return Recording(
        np.array([image.sequence - first for image in images]),
        np.array([image.pixels for image in images]).reshape(len(images), -1),
        np.array([step.frame_sequence - first for step in steps]),
        np.array([_commanded(step) for step in steps]),
        command,
    )


@dataclass(frozen=True, slots=True)
class Player:
    """Plays sequences of pokes on the mirror of a loop; repeats them if frames were lost or a device restarted.

    Attributes:
        loop: connection to the controller.
        in_use: calibration in use: dark, good pixels, reference image and the mirror's commands.
        report: function that receives the reason if a sequence is repeated.
        closed: whether the loop is closed and corrects the pokes.
    """

    loop: Client
    in_use: Calibration
    report: Report
    closed: bool = False

    def first_poke(self, mode: int, plan: Plan) -> Delay:
        """Poke one mode in a pseudo-random sequence to measure the delay and the image of the poke."""

        def attempt() -> Recording:
            played = self._play(plan, slice(mode, mode + 1))
            if not played.complete:
                raise ValueError("frames were lost or refused during the measurement of the delay")
            return played

        recording = self._repeated(
            attempt,
            "the delay is measured again",
            f"there were no {len(plan)} consecutive frames without a lost or refused one: see `lowfc doctor`",
        )
        command = recording.command_nm[: len(plan), mode] if self.closed else None
        try:
            fractions, _ = self._normalised(recording)
            reference = self.in_use.reference.astype(float)
            return measure_delay(fractions[: len(plan)], reference, plan.table[:, 0], command)
        except NotSeenError as error:
            raise PokesNotSeenError(str(error)) from None
        except ValueError as error:
            raise CalibrationError(str(error)) from None

    def cycle(self, plan: Plan, delay_frames: float) -> Cycle:
        """Play a cycle of pokes of all modes; `delay_frames` is the delay from a poke to its image."""

        def attempt() -> Cycle:
            recording = self._play(plan)
            fractions, flux = self._normalised(recording)
            poked = recording.played(plan.table, delay_frames)
            moved = poked + recording.commands(delay_frames) if self.closed else poked
            used = recording.usable(plan, delay_frames)
            return cycle_response(fractions, flux, moved, poked, used, DITHER_SLOWEST if self.closed else 0.0)

        return self._repeated(attempt, "a cycle is repeated", "no cycle was usable")

    def _play(self, plan: Plan, modes: slice = slice(None)) -> Recording:
        return play(self.loop, self.in_use.modes_to_actuators.T[modes], plan.table)

    def _normalised(self, recording: Recording) -> tuple[Array, Array]:
        return normalised(recording.pixels, self.in_use.dark.astype(float), self.in_use.good.astype(float))

    def _repeated(self, attempt: Callable[[], T], repeat_text: str, failure_text: str) -> T:
        for _ in range(ATTEMPTS):
            try:
                return attempt()
            except (PlayInterruptedError, ValueError) as error:
                cause = error
                self.report(f"{repeat_text}: {error}")
        raise CalibrationError(f"in {ATTEMPTS} attempts {failure_text}; the last attempt: {cause}")
