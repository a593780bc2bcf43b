"""What the controller takes in and gives out: values, with the time each was taken."""

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
"""A frame's sequence is its publisher's start in seconds, shifted by this, and its count."""


class Frame(NamedTuple):
    """A sensor image that arrived.

    Attributes:
        pixels: (rows, columns) uint16, DN, or None where the message made no image.
        ahead: its sequence starts further ahead of the host's clock than allowed (a clock's verdict, as its age is).
    """

    sequence: int
    time_ns: int
    age_ns: int
    pixels: Pixels | None
    ahead: bool = False


@dataclass(frozen=True, slots=True)
class Request:
    """What an operator asks.

    Attributes:
        modes: Noll indices that the values are for; empty for all.
        values: one for all modes, or one for each.
        text: name of a channel, target of a play, a note.
        actuators_nm: one or more shapes of the mirror, one after the other, nm of surface.
        table: of a play, (frames, columns).
        law: that shall drive the mirror; None for the integrator.
        calibration: that shall be used.
        played: what a play's table and shapes make, once they were checked.
        refusal: why it is refused whatever the state of the loop.
        prepared: it has been checked for what needs no state; see `lowfc.control.loop.requests.prepared`.
        lease_id: of the lease under which it is asked for, or that is asked for; 0 for none.
        requester: user and program that ask, for people.
        prior_nm2: of automatic gains, as `lowfc.control.loop.state.Weighting`; with the light `flux_dn`.
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
    """Where the mirror is: actuators (rows, columns) nm of surface, and the modal command behind them.

    Attributes:
        safe: its last command was sent in safe mode.
    """

    time_ns: int
    actuators_nm: Single
    command_nm: Single
    safe: bool = False


@dataclass(frozen=True, slots=True)
class MirrorReport:
    """Whether the mirror follows commands (a clock's verdict).

    Attributes:
        fault: what is wrong, to be read after "the mirror"; empty where it follows.
        shape: where it last was; None where that is not known.
    """

    time_ns: int
    fault: str
    shape: MirrorShape | None = None


@dataclass(frozen=True, slots=True)
class Load:
    """A calibration to use from now on, and where it came from."""

    time_ns: int
    calibration: Calibration
    source: str


@dataclass(frozen=True, slots=True)
class Tick:
    """No frame came; `silent_ns` is how long it has been (a clock's verdict)."""

    time_ns: int
    silent_ns: int


Report = MirrorShape | MirrorReport | CameraSettings | BenchReport | Load | Tick
"""What is neither a frame nor a request."""
Input = Frame | Request | Report


class Step(NamedTuple):
    """One step of the control law, for every frame that arrived; arrays (modes,) float32, nm of wavefront rms."""

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
        """Number of its frame within its camera's start, as `lowfc ctl` and the views show it."""
        return self.frame_sequence & 0xFFFF_FFFF


class Command(NamedTuple):
    """Where the mirror shall be: (rows, columns) float32, nm of surface.

    Attributes:
        safe: the loop is in safe mode.
        clear_id: identity of the operator's last clear; 0 without one.
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
    """The answer to a request, and the first frame for which it is in force."""

    accepted: bool
    text: str
    frame_sequence: int


class Outputs(NamedTuple):
    """What one input gave rise to; `changed` says that more of the state changed than the next frame will show."""

    step: Step | None = None
    command: Command | None = None
    reply: Reply | None = None
    events: Sequence[PendingEvent] = ()
    changed: bool = False
