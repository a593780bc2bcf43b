"""What a driver of a camera or of a mirror is: a class with a handful of methods, run by `run_camera` or `run_mirror`.

The loops do all the rest: real-time set-up, bus, envelope, frame numbers, clocks, settings, health, and for a mirror
limits, refusal of bad commands, command timeout, idle state and channels. A driver does not catch, retry or log: it
raises, and the loop counts it, names it in an event and tries again. A `LowfcError`, such as `ConfigurationError`, is
what a user has to put right: the process ends with its sentence.
"""

from dataclasses import dataclass, field, fields
from typing import Literal, NamedTuple, Protocol

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
    """Options of a driver: derive from it and call it `Options` in the driver's class.

    A docstring below a field is its help. Unknown keys are refused, no value is converted, values do not change. They
    come from `[drivers.NAME]` of the configuration, and from the command line: `--frame-rate 100` is `frame_rate`.
    """


class Need(NamedTuple):
    """What a driver needs of its host, for `lowfc doctor --device`.

    A driver's class may have a class method `needs(options)` that returns some.

    Attributes:
        what: a package, a file, a device.
        found: what was found of it; empty where it is not there.
        advice: how to get it.
    """

    what: str
    found: str
    advice: str


@dataclass(frozen=True, slots=True)
class CameraSettings:
    """What a camera is set to.

    Attributes:
        rows: of a frame, that is, of the region read.
        columns: of a frame.
        exposure_ns: exposure time of one frame.
        period_ns: time between the starts of two exposures.
        gain_e_per_dn: electrons per digital number.
        bias_dn: level without light.
        read_noise_e: read noise of one pixel.
        bit_depth: bits of the converter.
        saturation_dn: highest value of a pixel, bias included: full well or converter, whichever is lower; the
            converter's where it is None.
        em_gain: electron-multiplying gain; 1 where there is none.
        region_row: first row of the region read.
        region_column: first column of the region read.
        clock: of `Exposure.end_ns`: CLOCK_MONOTONIC, CLOCK_REALTIME, or the run's (`service.clock`), by which only a
            simulated camera goes: its frame is published once that clock has reached the end of the exposure.
        number_wrap: value at which `Exposure.number` begins again at 0, such as 1 << 16.
        time_ns: time from which they hold, by the run's clock; now where it is None.
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
    clock: Literal["monotonic", "realtime", "run"] = "monotonic"
    number_wrap: int = 1 << 64
    time_ns: int | None = field(default=None, compare=False)

    @classmethod
    def configured(cls, config: Configuration, rows: int, columns: int) -> "CameraSettings":
        """What [camera] says of a camera with frames of this size; a driver replaces what its hardware says."""
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


_PUBLISHED = tuple(one.name for one in fields(CameraSettings) if one.name in wire.CameraState.DESCRIPTOR.fields_by_name)


def camera_state(settings: CameraSettings, time_ns: int) -> wire.CameraState:
    """Message of a camera's settings."""
    state = wire.CameraState(timestamp=timestamp(time_ns), **fields_of(settings, _PUBLISHED))
    if settings.saturation_dn is None:
        state.saturation_dn = 2**settings.bit_depth - 1
    return state


class Exposure(NamedTuple):
    """One frame.

    Attributes:
        pixels: (rows, columns) uint16 in DN as the converter gives them, the low bit at bit 0.
        end_ns: end of the exposure, ns of the clock that the settings name; the moment of reception where it is None.
        number: of the frame as the hardware counts; the loop unwraps it and counts those missing. None without one.
        lost: frames that were lost just before this one, where the hardware has no numbers to tell.
    """

    pixels: Pixels
    end_ns: int | None = None
    number: int | None = None
    lost: int = 0


class Puts(Protocol):
    """Puts messages of a topic."""

    def put(self, payload: bytes) -> Envelope:
        """Send a message; return its envelope."""
        ...


class Camera(Protocol):
    """A camera: `MyCamera(options, config)` opens it.

    It may have a class `Options`, derived from `DriverOptions`, and the methods of `CameraExtras`.
    """

    def settings(self) -> CameraSettings:
        """Settings in force. It is called before every exposure, so it must not wait for the hardware."""
        ...

    def expose(self) -> Exposure | None:
        """Wait for the next frame and return it; None where there was none for about half a second."""
        ...

    def close(self) -> None:
        """Release the hardware; the last call."""
        ...


class CameraExtras:
    """Optional methods of a camera, each by itself; those of this class do nothing."""

    def join(self, service: Service) -> None:
        """The process has joined its run: `service` has its clock, publishers, bus and events."""

    def start(self) -> None:
        """All processes that the first frame waits for are there: the first exposure follows."""

    def sent(self, envelope: Envelope) -> None:
        """The last frame has been published, with this envelope."""

    def step(self) -> None:
        """In lockstep, after each frame: wait until the mirror has applied its command."""

    def through(self, publisher: Publisher) -> Puts:
        """What puts the frames in place of their publisher, as for tests of faults."""
        return publisher

    def fill(self, health: wire.Health) -> None:
        """Add to a Health, twice a second."""


@dataclass(frozen=True, slots=True)
class Geometry:
    """A mirror's actuators and what they can do, nm of surface.

    Attributes:
        rows: of actuators.
        columns: of actuators.
        stroke_nm: largest deviation from flat, either way.
        slew_nm: largest change from one command to the next.
        neighbour_nm: largest difference between neighbours.
        step_nm: least step of the driver: what it rounds to.
    """

    rows: int
    columns: int
    stroke_nm: float
    slew_nm: float
    neighbour_nm: float
    step_nm: float


def geometry(config: Configuration) -> Geometry:
    """The mirror that the section [mirror] of a configuration describes."""
    section, limits = config.mirror, mirror_limits(config)
    step_nm = section.stroke_nm / 2**section.driver_bits
    return Geometry(section.rows, section.columns, limits.stroke_nm, limits.slew_nm, limits.neighbour_nm, step_nm)


class Mirror(Protocol):
    """A mirror: `MyMirror(options, config)` opens it.

    It may have a class `Options`, derived from `DriverOptions`, and the methods of `MirrorExtras`. The actuators that
    it receives are within the limits of its geometry and of [mirror], whichever are tighter.
    """

    @property
    def geometry(self) -> Geometry:
        """Its actuators and limits; they do not change."""
        ...

    def apply(self, actuators_nm: Single) -> Single | None:
        """Move to (rows, columns) nm of surface from flat; return where the actuators are, None for there.

        Do not keep or change the array. It is called for every command on the thread that received it: be quick.
        """
        ...

    def close(self) -> None:
        """Release the hardware; the last call. The shape stays as it is."""
        ...


class MirrorExtras:
    """Optional methods of a mirror, each by itself."""

    def join(self, service: Service) -> None:
        """The process has joined its run: `service` has its clock, publishers, bus and events."""

    def position(self) -> Single:
        """(rows, columns) nm that it holds, of a mirror that can read it; called at the start, and after a fault.

        Without this method the mirror is driven to flat at once.
        """
        raise NotImplementedError

    def beside(self) -> Single | None:
        """(rows, columns) nm that others have on the mirror beside the commands; the stroke holds for the sum."""
        return None

    def settle(self, actuators_nm: Single, elapsed_ns: float) -> Single:
        """Simulated mirrors: `apply` (rows, columns) with the run's time since the last call.

        Without a command, too.
        """
        raise NotImplementedError

    def fill(self, health: wire.Health) -> None:
        """Add to a Health, twice a second."""
