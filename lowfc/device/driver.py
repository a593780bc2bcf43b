"""Interfaces of camera and mirror drivers: a class with a few methods, run by `run_camera` or `run_mirror`.

The loops do everything else: real-time set-up, bus, envelope, frame numbers, clocks, settings, health, and for a mirror
limits, refusal of bad commands, command timeout, idle state and channels. A driver does not catch, retry or log: it
raises, and the loop counts the fault, reports it in an event and tries again. A `LowfcError`, such as
`ConfigurationError`, is a fault that a user has to correct: the process ends with its message.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from math import isfinite
from numbers import Integral, Real
from typing import Any, Literal, NamedTuple, Protocol, get_args

from lowfc.adapters.bus.bus import Publisher
from lowfc.adapters.files.factory import detector, mirror_limits
from lowfc.adapters.process.service import Service
from lowfc.arrays import Pixels, Single
from lowfc.contract.configuration import Configuration
from lowfc.contract.envelope import Envelope
from lowfc.contract.messages import fields_of, timestamp, wire
from lowfc.contract.network import Section
from lowfc.optics.detector.detector import saturation_dn


class DriverOptions(Section):
    """Base class of a driver's options: derive from it in the driver's class, under the name `Options`.

    A docstring below a field is its help. Unknown keys and values of another type are refused (a tuple or path is a
    list or text in TOML); options are immutable. They come from `[drivers.NAME]` of the configuration and from the
    command line: `--frame-rate 100` sets `frame_rate`.
    """


class Need(NamedTuple):
    """A requirement of a driver on its host, for `lowfc doctor --device`.

    A driver's class may have a class method `needs(options)` that returns its requirements.

    Attributes:
        what: a package, file or device.
        found: what was found; empty if it is missing.
        advice: how to get it.
    """

    what: str
    found: str
    advice: str


Clock = Literal["monotonic", "realtime", "run"]


@dataclass(frozen=True, slots=True)
class CameraSettings:
    """Settings of a camera.

    Attributes:
        rows: rows of a frame, that is, of the region read.
        columns: columns of a frame.
        exposure_ns: exposure time of one frame.
        period_ns: time between the starts of successive exposures.
        gain_e_per_dn: electrons per digital number.
        bias_dn: level without light.
        read_noise_e: read noise of one pixel.
        bit_depth: bits of the converter.
        saturation_dn: highest value of a pixel, bias included: full well or converter, whichever is lower; None for
            the converter's.
        em_gain: electron-multiplying gain; 1 if there is none.
        region_row: first row of the region read.
        region_column: first column of the region read.
        clock: clock of `Exposure.end_ns`: CLOCK_MONOTONIC, CLOCK_REALTIME, or the run's (`service.clock`), only for
            simulated cameras: a frame is published once that clock has reached the end of the exposure.
        number_wrap: value at which `Exposure.number` wraps to 0, such as 1 << 16.
        time_ns: time from which the settings hold, by the run's clock; None for now.
    """

    rows: int
    columns: int
    exposure_ns: int
    period_ns: int
    gain_e_per_dn: float = 1.0
    bias_dn: float = 0.0
    read_noise_e: float = 0.0
    bit_depth: int = 16
    saturation_dn: float | None = None
    em_gain: float = 1.0
    region_row: int = 0
    region_column: int = 0
    clock: Clock = "monotonic"
    number_wrap: int = 1 << 64
    time_ns: int | None = field(default=None, compare=False)

    @classmethod
    def configured(cls, config: Configuration, rows: int, columns: int) -> "CameraSettings":
        """Settings from [camera] for frames of this size; a driver replaces those that its hardware reports."""
        camera = config.camera
        return cls(
            rows,
            columns,
            exposure_ns=config.exposure_ns,
            period_ns=config.period_ns,
            gain_e_per_dn=camera.gain_e_per_dn,
            bias_dn=camera.bias_dn,
            read_noise_e=camera.read_noise_e,
            bit_depth=camera.bit_depth,
            saturation_dn=saturation_dn(detector(config)),
            em_gain=camera.em_gain,
        )


_PUBLISHED = tuple(
    part.name for part in fields(CameraSettings) if part.name in wire.CameraState.DESCRIPTOR.fields_by_name
)

_LOWEST = dict.fromkeys(("rows", "columns", "period_ns", "bit_depth", "number_wrap"), 1) | dict.fromkeys(
    ("exposure_ns", "region_row", "region_column"), 0
)
"""Whole numbers among the settings, with their lowest values."""


def camera_state(settings: CameraSettings, time_ns: int) -> wire.CameraState:
    """Message of a camera's settings; ValueError if a value is impossible."""
    for name, lowest in _LOWEST.items():
        if not isinstance(value := getattr(settings, name), Integral) or value < lowest:
            raise ValueError(f"{name} of the settings is {value!r}, expected a whole number of {lowest} or more")
    if settings.saturation_dn is None:
        settings = replace(settings, saturation_dn=2 ** int(settings.bit_depth) - 1)
    for name in ("gain_e_per_dn", "bias_dn", "read_noise_e", "saturation_dn", "em_gain"):
        if not isinstance(number := getattr(settings, name), Real) or not isfinite(number):
            raise ValueError(f"{name} of the settings is {number}, expected a finite number")
    if settings.clock not in get_args(Clock):
        raise ValueError(f"clock of the settings is {settings.clock!r}, expected {', '.join(get_args(Clock))}")
    return wire.CameraState(timestamp=timestamp(time_ns), **fields_of(settings, _PUBLISHED))


class Exposure(NamedTuple):
    """A frame as returned by `Camera.expose`.

    Attributes:
        pixels: (rows, columns) uint16, DN of the converter, least significant bit at bit 0.
        end_ns: end of the exposure, ns of the clock named in the settings; None for the time of reception.
        number: the hardware's frame number; the loop unwraps it and counts missing frames. None if there is none.
        lost: frames lost just before this one, if the hardware has no frame numbers.
    """

    pixels: Pixels
    end_ns: int | None = None
    number: int | None = None
    lost: int = 0


class Puts(Protocol):
    """Publisher of one topic, as far as the camera loop needs it."""

    def put(self, payload: bytes) -> Envelope:
        """Publish a message and return its envelope."""
        ...


class Camera(Protocol):
    """A camera: `MyCamera(options, config)` opens it.

    It may have a class `Options`, derived from `DriverOptions`, and the methods of `CameraExtras`.
    """

    def settings(self) -> CameraSettings:
        """Return the settings in force. Called before every exposure, so it must not wait for the hardware."""
        ...

    def expose(self) -> Exposure | None:
        """Wait for the next frame and return it; None if none arrived for about half a second."""
        ...

    def close(self) -> None:
        """Release the hardware; no call follows."""
        ...


class CameraExtras:
    """Optional methods of a camera, independent of each other; the defaults do nothing."""

    def join(self, service: Service) -> None:
        """Called when the process has joined its run; `service` has its clock, publishers, bus and events."""

    def start(self) -> None:
        """Called before the first exposure, when all processes that the first frame waits for are running."""

    def sent(self, envelope: Envelope) -> None:
        """Called when a frame has been published, with its envelope."""

    def step(self) -> None:
        """Called after each frame in lockstep: wait until the mirror has applied the frame's command."""

    def through(self, publisher: Publisher) -> Puts:
        """Replace the publisher of frames, for example in fault tests."""
        return publisher

    def fill(self, health: wire.Health) -> None:
        """Add fields to the Health message, twice a second."""

    def finish(self) -> None:
        """Called once after the last frame, before the last `fill` and `close`."""


@dataclass(frozen=True, slots=True)
class Geometry:
    """A mirror's actuator grid and limits, nm of surface.

    Attributes:
        rows: rows of actuators.
        columns: columns of actuators.
        stroke_nm: largest deviation from flat, either way.
        slew_nm: largest change from one command to the next.
        neighbour_nm: largest difference between neighbours.
        step_nm: smallest step of the driver, to which it rounds; 0 if it does not round.
    """

    rows: int
    columns: int
    stroke_nm: float
    slew_nm: float
    neighbour_nm: float
    step_nm: float


def geometry(config: Configuration) -> Geometry:
    """Geometry from the section [mirror] of a configuration."""
    section, limits = config.mirror, mirror_limits(config)
    step_nm = section.stroke_nm / 2**section.driver_bits
    return Geometry(section.rows, section.columns, limits.stroke_nm, limits.slew_nm, limits.neighbour_nm, step_nm)


class Mirror(Protocol):
    """A mirror: `MyMirror(options, config)` opens it.

    It may have a class `Options`, derived from `DriverOptions`, and the methods of `MirrorExtras`. The commands that it
    receives are within the tighter of its geometry's limits and those of [mirror].
    """

    @property
    def geometry(self) -> Geometry:
        """Actuators and limits; they do not change."""
        ...

    def apply(self, actuators_nm: Single) -> Single | None:
        """Move to (rows, columns) nm of surface from flat; return the actuators' positions, None if as commanded.

        Do not keep or change the array. Called for every command on the receiving thread: be quick. Another thread
        calls it, never at the same time, to relax the mirror to flat.
        """
        ...

    def close(self) -> None:
        """Release the hardware; no call follows. The mirror keeps its shape."""
        ...


class MirrorExtras:
    """Optional methods of a mirror, independent of each other; those that a driver does not define have no effect."""

    def join(self, service: Service) -> None:
        """Called when the process has joined its run; `service` has its clock, publishers, bus and events."""

    def position(self) -> Single | None:
        """Read back the shape (rows, columns), nm of surface; called at the start and after a fault.

        Without this method, or if it returns None, the mirror is driven to flat at the start; after a fault its last
        commanded shape is assumed as its position.
        """
        return None

    def beside(self) -> Single | None:
        """Shape (rows, columns), nm of surface, that other programs add; the stroke limit applies to the sum."""
        return None

    def settle(self, actuators_nm: Single, elapsed_ns: float) -> Single:
        """Called instead of `apply`, for simulated mirrors; also called repeatedly without a new command.

        Return the positions reached. `actuators_nm` is the shape to approach, (rows, columns) nm of surface.
        `elapsed_ns` is the run's time since the previous command or, without a new one, since the last call; infinite
        at first.
        """
        raise NotImplementedError

    def fill(self, health: wire.Health) -> None:
        """Add fields to the Health message, twice a second; called on another thread, also while `apply` runs."""


def own_method(driver: object, name: str, default: Callable[..., object]) -> Callable[..., Any] | None:
    """A driver's optional method; None if it has none, or only the `default` of `CameraExtras` or `MirrorExtras`."""
    method: Callable[..., Any] | None = getattr(driver, name, None)
    return None if getattr(method, "__func__", None) is default else method
