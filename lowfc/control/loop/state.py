"""The controller's fixed settings and its changing state."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from lowfc.arrays import Mask, Single
from lowfc.control.calibration.calibration import Calibration
from lowfc.control.calibration.map_reconstructor import map_rows
from lowfc.control.kernel.tables import NUMPY, Estimate, Kernel
from lowfc.control.laws import linear_law
from lowfc.control.laws.integrator import TIP_TILT, Integrator
from lowfc.control.laws.linear_law import LinearLaw
from lowfc.control.laws.stability import delay_weights
from lowfc.control.loop.camera import CameraSettings
from lowfc.control.loop.command_channels import CommandChannels, Play
from lowfc.control.loop.estimator import Estimator
from lowfc.control.loop.guard import LawGuard
from lowfc.control.loop.interlocks import Acting, Interlock
from lowfc.control.loop.lease import Lease
from lowfc.control.loop.safety import Limits, LoopMode, Reason, Rejection
from lowfc.control.loop.wording import MEASURED_FIRST

SETTLING_FRAMES = 100
"""Frames for which a new linear law is updated but does not drive the mirror."""
FADING_FRAMES = 100
"""Frames of the cross-fade in which a law takes over."""
MAX_PREDICTED_FRAMES = 100
"""Most consecutive missing frames that a law predicts; after more, it observes and fades in again."""


@dataclass(frozen=True, slots=True)
class Settings:
    """Settings of the controller, fixed during a run.

    Attributes:
        limits: limits of the mirror, applied here and again by the mirror.
        delay_frames: delay from the frame measured to the first exposed entirely under the resulting command.
        start_mode: mode once a calibration is loaded: open, closed, or safe if safe mode was latched.
        max_frame_age_ns: age above which a frame is refused.
        frame_timeout_ns: time without frames after which an event is raised and `on_frame_timeout` applies.
        on_frame_timeout: hold the command, or relax the mirror to flat.
        min_flux_fraction: fraction of the expected flux below which a frame is refused.
        max_saturated_pixels: number of good pixels at full well above which a frame is refused.
        max_identical_frames: most consecutive frames with the same measurement as the frame before; 0 for no limit.
        gain: gain of tip and tilt, and gain of the other modes; `leak` and `limit_nm` (nm) have the same order.
        rate_hz: frame rate; 0 if unknown.
        guard: whether laws are guarded.
        auto_gain: whether the gains of tip and tilt, and of the other modes, are automatic.
        interlocks: conditions on bench values.
        kernel: implementation of the control step for normal frames.
    """

    limits: Limits
    delay_frames: float
    start_mode: LoopMode
    max_frame_age_ns: int
    frame_timeout_ns: int
    on_frame_timeout: str
    min_flux_fraction: float
    max_saturated_pixels: int
    gain: tuple[float, float]
    leak: tuple[float, float]
    limit_nm: tuple[float, float]
    max_identical_frames: int = 0
    rate_hz: float = 0.0
    guard: bool = False
    auto_gain: tuple[bool, bool] = (False, False)
    interlocks: tuple[Interlock, ...] = ()
    kernel: Kernel = NUMPY

    def integrator(self, noll: tuple[int, ...]) -> Integrator:
        """The integrator for these modes: the first value of each pair for tip and tilt, the second for the others."""
        tilt, pairs = np.isin(noll, TIP_TILT), (self.gain, self.leak, self.limit_nm)
        gain, leak, limit_nm = (np.where(tilt, *pair).astype(np.float32) for pair in pairs)
        return Integrator(gain, leak, limit_nm)

    def automatic(self, noll: tuple[int, ...]) -> Mask:
        """The modes (modes,) whose gain is automatic at the start."""
        return np.where(np.isin(noll, TIP_TILT), *self.auto_gain)


class LawRunner(NamedTuple):
    """A running linear law: its state x (states,), and the number of `frames` processed since it began to observe.

    It observes for `SETTLING_FRAMES`; over the next `FADING_FRAMES` it takes over from the integrator in a cross-fade,
    so that the mirror does not jump. When the loop closes, `frames` is set back to at most `SETTLING_FRAMES`. Once
    the law drives alone, a `guard` compares it with the integrator.
    """

    law: LinearLaw
    x: Single
    frames: int = 0
    guard: LawGuard | None = None

    @classmethod
    def at_rest(cls, law: LinearLaw, *, guarded: bool) -> "LawRunner":
        """A law before its first frame."""
        return cls(law, linear_law.at_rest(law), 0, LawGuard.of(law) if guarded else None)

    def restarted(self) -> "LawRunner":
        """The same law, at rest; modes in which it is overruled stay overruled."""
        return LawRunner(self.law, linear_law.at_rest(self.law), 0, self.guard and self.guard.at_rest())

    def advanced(self, error_nm: Single, pol_nm: Single, command_nm: Single) -> "LawRunner":
        """A copy advanced by one frame, from error and POL (modes,) relative to the target, and the last command."""
        signal = error_nm if self.law.signal == "error" else pol_nm
        x = linear_law.predict_and_update(self.law, self.x, signal, command_nm)
        return LawRunner(self.law, x, self.frames + 1, self.guard)

    def predicted(self, frames: int, command_nm: Single) -> "LawRunner":
        """A copy advanced by some missing or refused frames."""
        x = self.x
        for _ in range(min(frames, MAX_PREDICTED_FRAMES)):
            x = linear_law.predict(self.law, x, command_nm)
        if frames > MAX_PREDICTED_FRAMES:
            return LawRunner(self.law, x, 0, self.guard)
        return LawRunner(self.law, x, self.frames, None if self.guard is None else self.guard.held(frames, self.law))

    @property
    def weight(self) -> np.float32 | Single:
        """The law's share of the command, one number or (modes,); the integrator has the rest."""
        weight = np.float32(min(max(self.frames - SETTLING_FRAMES, 0) / FADING_FRAMES, 1))
        return weight if self.guard is None or not self.guard.overruled else weight * self.guard.weight

    def alone(self, later: int = 0) -> bool:
        """Whether the law determines the whole command, now or this number of frames later."""
        frames = self.frames + later
        return frames >= SETTLING_FRAMES + FADING_FRAMES and (self.guard is None or not self.guard.overruled)

    def taking_over(self) -> "LawRunner":
        """A copy for a loop that has just been closed: the law fades in."""
        return self._replace(frames=min(self.frames, SETTLING_FRAMES), guard=self.guard and self.guard.reset())


class Weighting(NamedTuple):
    """Prior and flux from which `map_rows` computes R for automatic gains.

    Attributes:
        prior_nm2: (modes,) mean square of each uncorrected mode, nm^2; 0 for a mode that the loop corrects.
        flux_dn: flux of the star, DN.
    """

    prior_nm2: Single
    flux_dn: float


class ActiveLoop(NamedTuple):
    """The loop once the mirror's grid is known, from a calibration or from the mirror's report.

    Attributes:
        calibration: the calibration in use; without modes or pixels if none was loaded.
        estimator: computes the modal errors of a frame.
        integrator: gain, leak and limit of each mode; a law has these limits too.
        to_actuators: (actuators, modes) as in the calibration, in the memory layout in which its product is faster.
        inverse: (modes, actuators) modal command of a mirror shape.
        to_modes: (modes, actuators) modes that R measures of a mirror shape, nm of wavefront rms per nm of surface.
        delay_weights: (index in `history_nm`, fraction) of each command that an exposure sees.
        camera: camera settings in the calibration, else the first received settings that fit it; None until then.
        automatic: (modes,) whether the gain of a mode is automatic.
        weighting: weighting of R; None for the calibration's own R.
        law_runner: linear law in use instead of the integrator; None for the integrator.
        command_channels: additions to the law's command; None for none.
        history_nm: modal commands (modes,), newest first.
        actuators_nm: (rows, columns), the last command.
    """

    calibration: Calibration
    estimator: Estimator
    integrator: Integrator
    to_actuators: Single
    inverse: Single
    to_modes: Single
    delay_weights: tuple[tuple[int, np.float32], ...]
    camera: CameraSettings | None
    automatic: Mask
    weighting: Weighting | None
    law_runner: LawRunner | None
    command_channels: CommandChannels | None
    history_nm: tuple[Single, ...]
    actuators_nm: Single

    @classmethod
    def at_rest(cls, settings: Settings, calibration: Calibration) -> "ActiveLoop":
        """A loop before its first command, with the initial integrator of the settings."""
        modes = len(calibration.noll)
        weights = delay_weights(settings.delay_frames).astype(np.float32)
        inverse = np.linalg.pinv(calibration.modes_to_actuators.astype(np.float64)).astype(np.float32)
        integrator = settings.integrator(calibration.noll)
        loop = cls(
            calibration,
            Estimator.of(calibration, settings.kernel),
            integrator,
            np.asfortranarray(calibration.modes_to_actuators),
            inverse,
            _own_to_modes(calibration, inverse),
            tuple((lag, weight) for lag, weight in enumerate(weights) if weight),
            calibration.camera,
            settings.automatic(calibration.noll),
            weighting=None,
            law_runner=None,
            command_channels=None,
            history_nm=(np.zeros(modes, np.float32),) * len(weights),
            actuators_nm=np.zeros(calibration.grid, np.float32),
        )
        return loop.with_gains(integrator)

    def with_gains(self, integrator: Integrator) -> "ActiveLoop":
        """A copy with these gains; the command of a mode whose automatic gain is 0 relaxes to zero."""
        return self._replace(integrator=replace(integrator, uncorrected=self.automatic & (integrator.gain == 0)))

    def with_weighting(self, weighting: Weighting | None) -> "ActiveLoop":
        """A copy with R and `to_modes` for this weighting; for None, with R and `to_modes` of the calibration."""
        calibration, channels = self.calibration, self.command_channels
        to_modes = _own_to_modes(calibration, self.inverse)
        if weighting is not None:
            own = calibration.reconstructor, to_modes
            R, to_modes = map_rows(calibration, weighting.prior_nm2, weighting.flux_dn, self.camera, *own)
            calibration = replace(calibration, reconstructor=R)
        return self._replace(
            weighting=weighting,
            estimator=Estimator.of(calibration, self.estimator.kernel),
            to_modes=to_modes,
            command_channels=channels and channels.with_all(channels.channels, to_modes).at_once(channels),
        )

    def channels_or_empty(self) -> CommandChannels:
        """The command channels; an empty object if there are none."""
        if self.command_channels is not None:
            return self.command_channels
        return CommandChannels.none(self.calibration.grid, len(self.calibration.noll), len(self.history_nm))

    @property
    def play(self) -> Play | None:
        """The current probe sequence."""
        return None if self.command_channels is None else self.command_channels.play

    def stopped(self, sequence: int) -> "ActiveLoop":
        """A copy whose probe sequence ends after this frame."""
        return self._replace(command_channels=self.command_channels and self.command_channels.stopped(sequence))

    def with_command(self, command_nm: Single, actuators_nm: Single) -> "ActiveLoop":
        """A copy advanced by one frame, with this command."""
        fixed = self[:-3]  # the fields but the last three; `_replace` would take twice as long
        command_channels = None if self.command_channels is None else self.command_channels.passed()
        return ActiveLoop(*fixed, command_channels, (command_nm, *self.history_nm[:-1]), actuators_nm)

    def holding_command(self, frames: int) -> "ActiveLoop":
        """A copy advanced by some frames in which the command is held."""
        held, channels = min(frames, len(self.history_nm)), self.command_channels
        history_nm = (self.history_nm[:1] * held + self.history_nm)[: len(self.history_nm)]
        return self._replace(history_nm=history_nm, command_channels=channels and channels.passed(frames))

    def missed(self, frames: int) -> "ActiveLoop":
        """A copy advanced by some frames without measurements."""
        return self.predicted(frames).holding_command(frames)

    def predicted(self, frames: int) -> "ActiveLoop":
        """A copy whose law is advanced by some frames without measurements."""
        if self.law_runner is None:
            return self
        return self._replace(law_runner=self.law_runner.predicted(frames, self.history_nm[0]))


def _own_to_modes(calibration: Calibration, inverse: Single) -> Single:
    """`ActiveLoop.to_modes` for the calibration's own R."""
    return calibration.actuators_to_modes if calibration.actuators_to_modes.size else inverse


class Conditions(NamedTuple):
    """The rarely changing part of the state.

    Attributes:
        camera: settings of the camera as last received; None before the first.
        camera_awaited: whether the camera restarted and its settings have not been received since.
        clear_id: identity of the operator's last clear; 0 without one.
        mode_since_ns: time of the change to this loop mode.
        mode_cause: cause of this change.
        lease: the lease in force, or else the last lease; None before the first.
        mirror_fault: why the mirror does not follow commands; empty if it does.
        acting: the acting interlocks.
    """

    camera: CameraSettings | None = None
    camera_awaited: bool = False
    clear_id: int = 0
    mode_since_ns: int = 0
    mode_cause: str = ""
    lease: Lease | None = None
    mirror_fault: str = ""
    acting: tuple[Acting, ...] = ()


class State(NamedTuple):
    """Everything the next command depends on.

    Attributes:
        frame_sequence: sequence of the newest frame; 0 before the first frame and after `clear`.
        frame_time_ns: time of the newest frame.
        refused: why the last frame was refused; None if it was used.
        refused_count: number of frames refused in a row, up to the last frame.
        limits_hit: limits that acted on the last command.
        frame_timeout: whether no frame has come for longer than the frame timeout.
        commanded: whether a command has been sent, so that the mirror's shape is no longer adopted.
        counts: number of frames, or of frame timeouts, for each reason.
        steps_left: used frames until the loop opens automatically; 0 for never.
        returning_to_zero: whether the modal command is returning to zero.
        estimate: the last measurement.
        identical_frames: number of consecutive measurements before `estimate` that were equal to it.
        input_number: count of the inputs that changed the state or produced output; the order of replay.
    """

    mode: LoopMode = LoopMode.IDLE
    loop: ActiveLoop | None = None
    frame_sequence: int = 0
    frame_time_ns: int = 0
    frames_used: int = 0
    refused: Rejection | None = None
    refused_count: int = 0
    limits_hit: tuple[Reason, ...] = ()
    frame_timeout: bool = False
    commanded: bool = False
    counts: Mapping[Reason, int] = MappingProxyType({})
    steps_left: int = 0
    returning_to_zero: bool = False
    estimate: Estimate | None = None
    identical_frames: int = 0
    conditions: Conditions = Conditions()
    input_number: int = 0

    @property
    def may_command(self) -> bool:
        """Whether commands may be sent. The first to a mirror with a fault, which might jump, needs safe mode."""
        return self.commanded or not self.conditions.mirror_fault or self.mode is LoopMode.SAFE

    @property
    def waits_for_gains(self) -> bool:
        """Whether the loop is open only until its gains are measured."""
        return self.mode is LoopMode.OPEN and self.conditions.mode_cause == MEASURED_FIRST
