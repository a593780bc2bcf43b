"""Inputs and outputs of the controller, with their times."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from lowfc.arrays import Pixels, Single
from lowfc.control.calibration.calibration import Calibration
from lowfc.control.laws.linear_law import LinearLaw
from lowfc.control.loop.camera import CameraSettings
from lowfc.control.loop.command_channels import PlayTable
from lowfc.control.loop.interlocks import BenchReport
from lowfc.control.loop.safety import LoopMode, Reason

COUNT_BITS = 32
"""A frame's sequence is its publisher's start in seconds, shifted left by this many bits, plus the frame's number."""
TICK_NS = 10_000_000
"""Period at which the held command is repeated while no frame arrives."""


class Frame(NamedTuple):
    """A received frame.

    Attributes:
        pixels: (rows, columns) uint16, DN, or None if the message held no valid image.
        ahead: whether the camera's start time, encoded in `sequence`, is too far in the future. The process computes
            this and `age_ns` before it calls `advance`, which reads no clock.
    """

    sequence: int
    time_ns: int
    age_ns: int
    pixels: Pixels | None
    ahead: bool = False


@dataclass(frozen=True, slots=True)
class Request:
    """An operator's request.

    Attributes:
        modes: Noll indices that the values are for; empty for all.
        values: one for all modes, or one for each; for `step` the number of frames for which the loop closes; for a
            lease or permit its duration, s.
        text: name of a channel, target of a probe sequence, holder of a lease, or a note; `AUTO` for automatic gains.
        actuators_nm: one or more shapes of the mirror, concatenated, nm of surface.
        table: (frames, columns) of a probe sequence.
        law: the law to drive the mirror; None for the integrator.
        calibration: the calibration to use.
        played: the checked table and shapes of a probe sequence.
        refusal: reason to refuse the request in any state of the loop.
        prepared: whether the checks that need no state are done; see `lowfc.control.loop.requests.prepared`.
        lease_id: identity of the sender's lease, or of the requested lease; 0 for none.
        requester: user and program that sent the request, for people.
        prior_nm2: (modes,) mean square of each mode that automatic gains leave uncorrected, nm^2, 0 for a corrected
            mode: the prior with which R is computed again.
        flux_dn: the flux at which `prior_nm2` was measured, DN.
    """

    time_ns: int
    name: str
    modes: tuple[int, ...] = ()
    values: tuple[float, ...] = ()
    text: str = ""
    actuators_nm: Single = field(default_factory=lambda: np.zeros(0, np.float32), compare=False)
    table: Single = field(default_factory=lambda: np.zeros((0, 1), np.float32), compare=False)
    law: LinearLaw | None = None
    calibration: Calibration | None = field(default=None, compare=False)
    played: PlayTable | None = field(default=None, compare=False)
    refusal: str = ""
    prepared: bool = field(default=False, compare=False)
    lease_id: int = 0
    requester: str = field(default="", compare=False)
    prior_nm2: tuple[float, ...] = ()
    flux_dn: float = 0.0


@dataclass(frozen=True, slots=True)
class MirrorShape:
    """The mirror's shape: actuators (rows, columns), nm of surface, and the modal command (modes,) of this shape, nm.

    Attributes:
        safe: whether the mirror's last command was sent in safe mode.
    """

    time_ns: int
    actuators_nm: Single
    command_nm: Single
    safe: bool = False


@dataclass(frozen=True, slots=True)
class MirrorReport:
    """Whether the mirror follows commands, as the process found before it called `advance`.

    Attributes:
        fault: the fault, a phrase that continues "the mirror ..."; empty if there is none.
        shape: last known shape of the mirror; None if unknown.
    """

    time_ns: int
    fault: str
    shape: MirrorShape | None = None


@dataclass(frozen=True, slots=True)
class Load:
    """A calibration to use from now on, and its origin."""

    time_ns: int
    calibration: Calibration
    source: str


@dataclass(frozen=True, slots=True)
class Tick:
    """No frame arrived; `silent_ns` is the time since the last frame, computed before the call of `advance`."""

    time_ns: int
    silent_ns: int


Report = MirrorShape | MirrorReport | CameraSettings | BenchReport | Load | Tick
"""Inputs other than frames and requests."""
Input = Frame | Request | Report


class Step(NamedTuple):
    """Result of one frame, used or refused; arrays (modes,) float32, nm of wavefront rms.

    Attributes:
        reasons: rejections of the frame, and limits that acted.
        command_nm: modal command after the frame; empty if there is no active loop.
        error_nm: modal error that the loop drives to zero; None, like `pol_nm`, if the frame was not used.
    """

    frame_sequence: int
    time_ns: int
    mode: LoopMode
    command_nm: Single
    reasons: tuple[Reason, ...]
    error_nm: Single | None = None
    pol_nm: Single | None = None
    flux_dn: float = 0.0
    saturated_pixels: int = 0

    @property
    def frame(self) -> int:
        """Number of the frame since its camera started, as in `lowfc ctl` and the views."""
        return self.frame_sequence & 0xFFFF_FFFF


class Command(NamedTuple):
    """A command to the mirror: (rows, columns) float32, nm of surface.

    Attributes:
        safe: whether the loop is in safe mode.
        clear_id: identity of the operator's last `clear`. Without one it is 0; before the first frame it is the time at
            which the loop mode began, so that a mirror that has applied newer frames accepts the command.
    """

    frame_sequence: int
    time_ns: int
    actuators_nm: Single
    command_nm: Single
    safe: bool = False
    clear_id: int = 0


class PendingEvent(NamedTuple):
    """An event of the table in `lowfc.contract.events`, with its details."""

    name: str
    details: dict[str, object]


class Reply(NamedTuple):
    """The answer to a request, and the first frame for which the request is in force."""

    accepted: bool
    text: str
    frame_sequence: int


class Outputs(NamedTuple):
    """Outputs of one input; `changed` is whether the state changed by more than the ordinary update for a frame."""

    step: Step | None = None
    command: Command | None = None
    reply: Reply | None = None
    events: Sequence[PendingEvent] = ()
    changed: bool = False
