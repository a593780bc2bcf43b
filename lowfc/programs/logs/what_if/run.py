"""Input of a what-if: exposures of the logged run, the measured delay, and the command seen by each exposure."""

from collections.abc import Mapping, Sequence
from copy import deepcopy
from typing import NamedTuple

import numpy as np

from lowfc.adapters.files.factory import settings
from lowfc.adapters.logs.columns import Steps
from lowfc.adapters.logs.history import History
from lowfc.arrays import Integers, Mask, Sequences, Single
from lowfc.contract.codecs.codec import decode_frame
from lowfc.contract.codecs.law_codec import integrator_of
from lowfc.contract.codecs.state_codec import calibration_in_use
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import DataFileError
from lowfc.contract.messages import FRAME, Role, floats, wire
from lowfc.control.calibration.calibration import Calibration
from lowfc.control.laws.continuous import Timing
from lowfc.control.laws.integrator import Integrator
from lowfc.control.laws.stability import delay_weights, settling_frames
from lowfc.control.laws.what_if import (
    MAX_DELAY_FRAMES,
    delay_from_times,
    delay_from_truth,
    frames_since,
    has_new_exposure,
    missing_before,
    seen_nm,
)
from lowfc.control.loop.command_channels import PlayTable
from lowfc.control.loop.estimator import Estimator
from lowfc.control.loop.safety import LoopMode

DELAY_DIFFERS = 0.05
"""Difference in frames beyond which a measured delay counts as different from the controller's, or as fractional."""
_COMMAND_LOST_NM = 0.01  # a command seen that differs by more than this from the logged ones is not in the log


class SeenCommands(NamedTuple):
    """Commands seen by the exposures of consecutive steps.

    Attributes:
        delay_frames: the controller's delay, unless the measured one differs. The measured one is rounded if it is
            nearly whole.
        weights: `delay_weights` of this delay.
        seen_nm: (steps, modes) commands seen. With the controller's delay they come from the steps, and are NaN for
            unused frames.
        command_lost: (steps,) True where the exposure saw a command that is in no logged step.
        target_nm: (steps, modes) target of the loop, which has been subtracted from the steps' errors.
    """

    delay_frames: float
    weights: Single
    seen_nm: Single
    command_lost: Mask
    target_nm: Single

    @classmethod
    def of(
        cls,
        steps: Steps,
        missing: Integers,
        states: Sequence[wire.ControllerState],
        controller_delay: float,
        measured_delay: float | None,
        played: Mask,
    ) -> "SeenCommands":
        """Commands seen by these steps; the first step must have a used frame, and `states` supply the loop's target.

        A probe sequence may change the target, too: in its steps (`played`) the commands seen come from the logged
        commands, not from error minus POL.
        """
        weights = delay_weights(controller_delay).astype(np.float32)
        target_nm = _target_nm(states, steps.sequence, steps.error_nm.shape[1])
        assumed_nm = steps.error_nm + target_nm - steps.pol_nm
        computed_nm = seen_nm(weights, steps.command_nm, missing, assumed_nm[0])
        assumed_nm[played] = computed_nm[played]
        command_lost: Mask = np.abs(computed_nm - assumed_nm).max(axis=1) > _COMMAND_LOST_NM
        command_lost[: len(weights)] = False  # these may have seen commands from before the log
        if measured_delay is None or abs(measured_delay - controller_delay) <= DELAY_DIFFERS:
            return cls(controller_delay, weights, assumed_nm, command_lost, target_nm)
        rounded = round(measured_delay)
        delay_frames = float(rounded) if abs(measured_delay - rounded) <= DELAY_DIFFERS else measured_delay
        weights = delay_weights(delay_frames).astype(np.float32)
        seen = seen_nm(weights, steps.command_nm, missing, assumed_nm[0])
        return cls(delay_frames, weights, seen, command_lost, target_nm)


class LoggedRun:
    """Steps of a log that have a new exposure (no repeated frames), from the first step whose frame was used.

    Attributes:
        steps: these steps.
        missing: (steps,) number of exposures without a step that precede each step.
        true_nm: disturbance and residual (steps, modes) at the start of each exposure, NaN where unknown; None without
            any.
        continuous_rms_nm: rms of the true residual (steps, modes) over each period; None if the log does not have it.
        calibration: calibration of the log.
        used: (steps,) whether the frame was used.
        under_calibration: (steps,) see `History.under_calibration`.
        law: last integrator of the run.
        controller_delay: delay assumed by the controller, frames.
        measured_delay: delay measured from the log, frames; None if it cannot be measured.
        measured_from: what the delay was measured from, in words.
        played: (steps,) True during a probe sequence, which moves the mirror or the loop's target.
        seen: commands seen by the exposures.
        delay_frames, weights, seen_nm, command_lost: those of `seen`; the comparison uses this delay.
    """

    def __init__(self, history: History) -> None:
        """Extract the run from a history."""
        self.history = history
        rows = has_new_exposure(history.steps.reasons)
        used = rows & np.isfinite(history.steps.error_nm).all(axis=1)
        if history.calibration is None:
            raise DataFileError(f"{history.log.path}: it has no calibration")
        if not used.any():
            raise DataFileError(f"{history.log.path}: its controller used no frame")
        if not history.rate_hz:
            raise DataFileError(f"{history.log.path}: its frame rate is unknown: it has too few frames")
        rows[: int(np.argmax(used))] = False  # before the first used frame, the disturbance is unknown
        self.calibration = history.calibration
        self.steps = history.steps.at(rows)
        true = history.true
        self.true_nm = None if true is None else (true.disturbance_nm[rows], true.residual_nm[rows])
        self.continuous_rms_nm = true.modes_residual_rms_nm[rows] if true is not None and true.continuous else None
        self.used: Mask = used[rows]
        self.under_calibration: Mask = history.under_calibration[rows]
        self.missing = missing_before(self.steps.sequence)
        self.played = _played(self.steps.sequence, history.requests, history.published.plays)
        self.law, self.controller_delay = _law_and_delay(history, self.calibration)

        self.measured_delay, self.measured_from = self._measured_delay()
        self.seen = SeenCommands.of(
            self.steps, self.missing, history.controllers, self.controller_delay, self.measured_delay, self.played
        )
        self.delay_frames, self.weights, self.seen_nm, self.command_lost, _ = self.seen

    @property
    def uncorrected(self) -> Mask:
        """Modes (modes,) that automatic gains did not correct at the end of the run.

        The reconstructor in use was computed with a prior variance for these modes (`prior_nm2`).
        """
        state = self.history.controller
        modes = len(self.calibration.noll)
        if state is None or state.calibration_id != self.calibration.id or len(state.prior_nm2) != modes:
            return np.zeros(modes, np.bool_)
        return np.array(state.prior_nm2) > 0

    @property
    def timing(self) -> Timing:
        """Times of the exposures and of the mirror's moves."""
        return self.history.timing(self.delay_frames)

    @property
    def simulated_delay(self) -> float:
        """Delay of the simulated camera, frames; only the simulated camera logs a true wavefront."""
        return (self.history.configuration or Configuration()).camera.delay_frames

    @property
    def moves_at(self) -> float:
        """Time at which the mirror moves, frame periods after the start of an exposure.

        It is 1, the end of the period, in lockstep with a whole delay. With a fractional delay of the simulated camera,
        the mirror moves during the exposure.
        """
        if self.simulated_delay % 1:
            return self.history.timing(self.simulated_delay).applied % 1
        timing = self.history.timing(float(np.ceil(self.delay_frames)))
        return timing.applied - timing.delay + 1

    def rows_to_compare(self, laws: list[Integrator], usable: Mask) -> tuple[Mask, int, str]:
        """Usable steps to compare, the settling time of the laws in frames, and which steps these are, as text."""
        steps, missing = self.steps, self.missing
        closed, compared = steps.mode == LoopMode.CLOSED, "closed loop"
        if not (closed & usable).any():
            compared = "no usable frame in closed loop" if closed.any() else "the loop was never closed"
            closed = np.ones_like(closed)
        since = frames_since(self.command_lost, closed, missing)
        settling = max(settling_frames(law.gain, law.leak, self.history.rate_hz) for law in laws)
        settling = min(settling, int(since.max()) // 2)
        rows = usable & (since >= settling) & (steps.saturated_pixels == 0)
        if not rows.any():
            raise DataFileError(
                f"{self.history.log.path}: no frame is left to compare: of {len(rows)} frames, "
                f"{np.count_nonzero(~usable)} were refused, {np.count_nonzero(steps.saturated_pixels)} have saturated "
                f"pixels and {np.count_nonzero(since < settling)} are within the settling time of {settling} frames"
            )
        return rows, settling, compared

    def measured_again(self, calibration: Calibration) -> Single:
        """Errors (steps, modes) measured in the used frames with another calibration, in a second pass.

        The reconstructor of `calibration` is weighted like the logged one at the end of the run, see `uncorrected`.
        """
        steps, log = self.steps, self.history.log
        if not log.selection.has_every_frame:
            raise DataFileError(
                f"{log.path}: it does not have every frame ({log.selection.description}): another reconstructor "
                "cannot be tried, other gains, leaks and limits can"
            )
        error_nm = np.full_like(steps.error_nm, np.nan)
        if self.uncorrected.any():
            state = deepcopy(self.history.controllers[-1])
            state.calibration_id = calibration.id
            calibration = calibration_in_use(state, calibration)
        estimator = Estimator.of(calibration)
        rows = {sequence: row for row, sequence in enumerate(steps.sequence.tolist()) if self.used[row]}
        for message in self.history.reader(FRAME):
            row = rows.get(message.sequence)
            pixels = decode_frame(message.payload, message.sequence, 0).pixels if row is not None else None
            if pixels is not None and pixels.shape == calibration.shape:
                found = estimator.estimate(pixels.reshape(-1), 0.0)
                if found is not None:
                    error_nm[row] = found.error_nm
        return error_nm

    def _measured_delay(self) -> tuple[float | None, str]:
        history, steps = self.history, self.steps
        if self.true_nm is not None:
            disturbance_nm, residual_nm = self.true_nm
            moved_nm = residual_nm - disturbance_nm
            moved_nm[self.played] = np.nan
            return delay_from_truth(moved_nm, steps.command_nm, self.missing), "the true wavefront"
        if history.camera is None:
            return None, ""
        starts_ns = steps.time_ns + history.camera_clock_offset_ns(Role.RECORDER) - int(history.camera.exposure_ns)
        mirror = history.mirror
        delay = delay_from_times(steps.sequence, starts_ns, mirror.sequence, mirror.publish_time_ns)
        return delay, "the times of frames and mirror"


def _played(sequence: Sequences, requests: Sequence[wire.Request], plays: Mapping[str, PlayTable]) -> Mask:
    rows = np.zeros(sequence.shape, np.bool_)
    for request in requests:
        if request.name == "play" and request.accepted:
            first = request.frame_sequence
            stored = plays.get(request.play_id)
            table = floats(request.table, -1, request.columns or 1) if stored is None else stored.rows
            rows |= during_probe(sequence, first, len(table))
    return rows


def during_probe(sequence: Sequences, first: int, frames: int) -> Mask:
    """Steps (steps,) whose exposure may have seen a probe sequence of `frames` rows from the frame `first` on."""
    return (sequence >= first) & (sequence < first + frames + MAX_DELAY_FRAMES)


def _target_nm(states: Sequence[wire.ControllerState], sequence: Sequences, modes: int) -> Single:
    """Target (steps, modes) of the loop: the offset of the last state before each step, or else of the first state.

    A state is logged at every change. The state after `clear` has frame sequence 0, because `clear` resets it.
    """
    offsets = [(state.frame_sequence, state.offset_nm or [0.0] * modes) for state in states]
    offsets = [(frame, offset_nm) for frame, offset_nm in offsets if len(offset_nm) == modes]
    if not offsets:
        return np.zeros((len(sequence), modes), np.float32)
    frames = np.maximum.accumulate(np.array([frame for frame, _ in offsets], np.uint64))
    rows = np.searchsorted(frames, sequence) - 1
    return np.array([offset_nm for _, offset_nm in offsets], np.float32)[np.maximum(rows, 0)]


def _law_and_delay(history: History, calibration: Calibration) -> tuple[Integrator, float]:
    state = history.controller
    if state is not None and len(state.gain) == len(calibration.noll):
        return integrator_of(state), state.delay_frames
    if history.configuration is None:
        raise DataFileError(
            f"{history.log.path}: its gains and delay are unknown: it has no configuration, and no controller state "
            "for its modes"
        )
    configured = settings(history.configuration)
    if any(configured.auto_gain):
        raise DataFileError(
            f"{history.log.path}: its gains are unknown: they are automatic in its configuration, and it has no "
            "controller state"
        )
    return configured.integrator(calibration.noll), configured.delay_frames
