"""The configuration: every key, its unit, default and range, declared once.

A file is TOML with the sections of `Configuration`; what it leaves out has the default. An unknown key is refused with
the nearest known one. `lowfc config show` prints all keys with their sentences.
"""

import difflib
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import tomli_w
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from pydantic.fields import FieldInfo

from lowfc.contract.errors import ConfigurationError

Preset = Literal["quiet", "bench", "thermal", "reaction-wheel", "step", "kolmogorov"]
PRESETS: tuple[str, ...] = get_args(Preset)

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]


class Section(BaseModel):
    """A section: unknown keys are errors, values do not change."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True, allow_inf_nan=False)


class Star(Section):
    """The star and the telescope: Sect. 3.3."""

    magnitude: float = Field(2.0, ge=-2, le=20)
    """Apparent V magnitude."""
    diameter_m: float = Field(2.0, gt=0, le=100)
    """Diameter of the open circular aperture."""
    wavelength_nm: float = Field(550.0, ge=100, le=30_000)
    """Central wavelength."""
    bandwidth: float = Field(0.2, gt=0, lt=1)
    """Width of the band as a fraction of the central wavelength."""
    throughput: float = Field(0.5, gt=0, le=1)
    """Light that is left after all reflections upstream of the coronagraph."""


class SensorSection(Section):
    """The wavefront sensor's optics, and of the coronagraph what it lives on."""

    kind: Literal["sam", "clowfs", "zwfs", "bar", "open"] = "sam"
    """Sparse aperture mask, coronagraphic low-order sensor, Zernike sensor, pupil with a bar, or open relay pupil."""
    pupil: str = "shaped"
    """Coronagraph: the shaped pupil; circle for a classical Lyot, prolate for an apodised one; or FILE.npz."""
    focal_mask: Literal["disk", "bowtie"] = "disk"
    """Reflective focal-plane mask: a disk, or the bowtie of Fig. 3."""
    focal_radius: float = Field(4.0, ge=1, le=10)
    """Radius of its disk, lambda/D."""
    sam: str = "sam27d07"
    """Of a sam: a shipped layout, or FILE.json, or FILE.json:NAME."""
    defocus_mm: float = Field(6.0, ge=1, le=50)
    """Of a clowfs: the detector's distance from focus."""
    focal_ratio: float = Field(20.0, ge=1, le=200)
    """Of a clowfs: focal length over pupil diameter at the focal-plane mask."""
    inner_radius: float = Field(0.0, ge=0, lt=10)
    """Of a clowfs: radius of the hole in the reflecting disk, lambda/D."""
    spot_diameter: float = Field(1.06, gt=0, le=8)
    """Of a zwfs: the phase spot's diameter, lambda/D."""
    bar_width: float = Field(0.1, gt=0, lt=1)
    """Of a bar: its width, pupil diameters."""
    bar_angle_deg: float = Field(20.0, ge=0, lt=360)
    """Of a bar: its direction from the x axis towards y."""
    modes: int = Field(14, ge=1, le=35)
    """Zernike modes after piston, from Noll 2 on."""
    wavelengths: int = Field(1, ge=1, le=9)
    """Wavelengths of the simulated band; 1 is monochromatic."""
    quadrature: Literal["gauss-legendre", "uniform"] = "gauss-legendre"
    """How the wavelengths are chosen: uniform is the paper's, both ends included, and far less accurate."""
    nodes: Literal[32, 64] = 32
    """Pupil nodes across the diameter in the real-time twin."""
    rank: int = Field(60, ge=20, le=200)
    """Modes kept of the optical operator in the real-time twin."""


SENSORS: dict[str, dict[str, Any]] = {
    "sam": {"kind": "sam"},
    "bowtie": {"kind": "sam", "focal_mask": "bowtie", "sam": "sam27d07_bowtie"},
    "clowfs": {"kind": "clowfs"},
    "zwfs": {"kind": "zwfs"},
    "bar": {"kind": "bar"},
    "open": {"kind": "open"},
    "lyot": {"kind": "sam", "pupil": "circle"},
    "aplc": {"kind": "sam", "pupil": "prolate", "focal_radius": 2.5},
}
"""The sensors that have a name on the command line, as keys of [sensor]."""


def sensor_keys(name: str) -> dict[str, Any]:
    """Keys of [sensor] for one of `SENSORS`; any other name is that of a sparse aperture mask's layout."""
    return SENSORS.get(name, {"kind": "sam", "sam": name})


class Camera(Section):
    """The sensor camera."""

    rate_hz: float = Field(250.0, gt=0, le=20_000)
    """Frames per second."""
    exposure_fraction: float = Field(0.5, gt=0, le=1)
    """Part of the period during which light is collected; the rest is for the loop to react."""
    quantum_efficiency: float = Field(0.8, gt=0, le=1)
    """Electrons per photon."""
    read_noise_e: NotNegative = 1.0
    """Read noise of one pixel."""
    gain_e_per_dn: Positive = 1.0
    """Electrons per digital number."""
    bias_dn: float = Field(100.0, ge=0, le=60_000)
    """Level without light."""
    full_well_e: Positive = 40_000.0
    """Electrons that a pixel can hold."""
    bit_depth: int = Field(16, ge=8, le=16)
    """Bits of the converter."""
    em_gain: float = Field(1.0, ge=1, le=5000)
    """Electron-multiplying gain; 1 is a plain detector."""
    clock_induced_charge_e: NotNegative = 0.0
    """Spurious electrons per pixel and frame before multiplication."""
    delay_frames: float = Field(1.0, ge=1, le=3)
    """Frames from the one a command is made from to the first exposed wholly under it; 1 is the least."""
    noise: bool = True
    """Photon and read noise; off only for tests of the control law."""
    photon_noise: Literal["fast", "exact"] = "fast"
    """Faint pixels from a table of their law (its variance is 6e-5 e-^2 too large at most), or every electron drawn."""


class Disturbance(Section):
    """What shakes the wavefront: a function of the seed and the frame index."""

    preset: Preset = "bench"
    """quiet, bench, thermal, reaction-wheel, step or kolmogorov."""
    scale: NotNegative = 1.0
    """Multiplies the preset's amplitude."""
    static_nm: dict[str, float] = Field(default_factory=dict)
    """Constant wavefront added to it: Noll index = nm rms."""

    @model_validator(mode="after")
    def _noll_indices(self) -> "Disturbance":
        for key in self.static_nm:
            if not key.isdecimal() or int(key) < 2:
                raise ValueError(f"static_nm: {key!r} is not a Noll index of 2 or more")
        return self


class Mirror(Section):
    """The deformable mirror."""

    name: str = Field("dm", pattern=r"^[a-z][a-z0-9_]*$")
    """Its name in the topics."""
    rows: int = Field(34, ge=2, le=128)
    """Rows of actuators."""
    columns: int = Field(34, ge=2, le=128)
    """Columns of actuators."""
    pitches_per_pupil: float = Field(31.0, gt=1, le=128)
    """Actuator pitches across the pupil."""
    coupling: float = Field(0.15, gt=0, lt=1)
    """Height of an influence function at the neighbouring actuator."""
    stroke_nm: float = Field(1500.0, gt=0)
    """Whole range of an actuator, surface."""
    driver_bits: int = Field(16, ge=8, le=24)
    """Bits of the driver over the whole range."""
    settling_us: NotNegative = 50.0
    """Time constant of an actuator's first-order response."""
    dead: list[int] = Field(default_factory=list)
    """Actuators that stay flat: row * columns + column."""
    stuck_nm: dict[str, float] = Field(default_factory=dict)
    """Actuators stuck at a height: row * columns + column = nm."""
    slew_nm: float = Field(150.0, gt=0.01)
    """Largest change of an actuator per command that the mirror accepts."""
    neighbour_nm: float = Field(500.0, gt=0.01)
    """Largest difference between neighbouring actuators that the mirror accepts."""
    expired: Literal["hold", "flat"] = "flat"
    """When the last command has expired: hold the shape, or relax to flat within the slew limit."""


class Control(Section):
    """The control law."""

    start_mode: Literal["open", "closed"] = "open"
    """Loop mode once a calibration is loaded; sim-loop takes closed where the file says nothing."""
    delay_frames: float = Field(0.0, ge=0, le=10)
    """Frames from the one a command is made from to the first exposed wholly under it, as measured; 0 takes the
    camera's. Twice the delay halves the highest stable gain."""
    estimator: Literal["weighted", "pinv"] = "weighted"
    """Noise-weighted or plain pseudo-inverse of H."""
    nuisance: list[Literal["background", "shear"]] = Field(default_factory=list)
    """What is fitted along with the modes so that it does not pass for them: uniform light, shear of the beam."""
    tilt_gain: float = Field(0.5, ge=0, le=4)
    """Integrator gain of tip and tilt."""
    gain: float = Field(0.05, ge=0, le=4)
    """Integrator gain of the other modes."""
    tilt_leak: float = Field(0.0, ge=0, le=1)
    """Integrator leak of tip and tilt."""
    leak: float = Field(0.0, ge=0, le=1)
    """Integrator leak of the other modes."""
    tilt_limit_nm: Positive = 150.0
    """Largest modal command of tip and tilt, wavefront rms."""
    limit_nm: Positive = 50.0
    """Largest modal command of the other modes, wavefront rms."""
    late_ms: Positive = 20.0
    """Age above which a frame is refused."""
    hold_ms: Positive = 50.0
    """Silence of the camera after which it is an event."""
    silence: Literal["hold", "flat"] = "hold"
    """During such a silence: hold the command, or relax the mirror to flat."""
    valid_ms: Positive = 200.0
    """How long the mirror may hold a command without another one."""
    least_flux: float = Field(0.2, ge=0, lt=1)
    """Fraction of the expected light below which a frame is dark."""
    most_saturated: int = Field(8, ge=0)
    """Pixels at full well above which a frame is refused."""


class Safety(Section):
    """Limits that the controller keeps; the mirror keeps its own."""

    stroke_nm: float = Field(700.0, gt=0.01)
    """Largest deviation of an actuator from flat, surface, either way."""
    slew_nm: float = Field(100.0, gt=0.01)
    """Largest change of an actuator per command."""
    neighbour_nm: float = Field(400.0, gt=0.01)
    """Largest difference between neighbouring actuators."""


class Recorder(Section):
    """The log."""

    folder: str = "logs"
    """Where log files are written."""
    largest_mb: float = Field(4000.0, ge=1, le=1_000_000)
    """Size at which a log is finished and the next one begun; each can be read by itself."""
    longest_s: float = Field(3600.0, ge=1, le=1_000_000)
    """Age at which a log is finished and the next one begun."""
    min_free_mb: float = Field(500.0, ge=0, le=1_000_000_000)
    """Free space on the disk below which recording is refused, or ends with a complete log while the loop goes on."""


class Realtime(Section):
    """What is asked of the host, in every process, before its first bus session."""

    priority: int = Field(50, ge=0, le=98)
    """SCHED_FIFO priority of camera, controller and mirror; 0 for normal scheduling."""
    recorder_priority: int = Field(10, ge=0, le=98)
    """SCHED_FIFO priority of the recorder, below the loop's; 0, or a loop without, for normal scheduling."""
    lock_memory: bool = True
    """Keep the processes' memory from being paged out."""
    stay_awake: bool = True
    """Keep idle processors awake while the loop runs: waking one takes longer than a hand-off; it costs power."""
    rehearse: bool = True
    """Do each control step a second time for nothing, so that the next frame finds the caches warm; not above 2 kHz."""
    camera_cpus: list[int] = Field(default_factory=list)
    """Processors of the camera; empty for all. Where the file says nothing, sim-loop gives the controller its own."""
    controller_cpus: list[int] = Field(default_factory=list)
    """Processors of the controller; empty for all."""
    mirror_cpus: list[int] = Field(default_factory=list)
    """Processors of the mirror; empty for all."""
    recorder_cpus: list[int] = Field(default_factory=list)
    """Processors of the recorder; empty for all. sim-loop keeps it off the controller's."""


class Configuration(Section):
    """All sections."""

    seed: int = Field(1, ge=0, lt=2**63)
    """Seed of every random number in the simulation."""
    lockstep: bool = False
    """Expose the next frame only when the mirror has applied the last command; time is simulated."""
    star: Star = Star()
    sensor: SensorSection = SensorSection()
    camera: Camera = Camera()
    disturbance: Disturbance = Disturbance()
    mirror: Mirror = Mirror()
    control: Control = Control()
    safety: Safety = Safety()
    recorder: Recorder = Recorder()
    realtime: Realtime = Realtime()

    @model_validator(mode="after")
    def _consistent(self) -> "Configuration":
        if self.safety.stroke_nm > self.mirror.stroke_nm / 2:
            raise ValueError(
                f"safety.stroke_nm is {self.safety.stroke_nm:g} nm either way, but mirror.stroke_nm gives only "
                f"{self.mirror.stroke_nm / 2:g} nm either way"
            )
        step_nm = self.mirror.stroke_nm / 2**self.mirror.driver_bits
        for name in ("slew_nm", "neighbour_nm"):
            if getattr(self.mirror, name) < step_nm + 0.01:
                raise ValueError(
                    f"mirror.{name} is {getattr(self.mirror, name):g} nm, but one step of a driver of "
                    f"{self.mirror.driver_bits} bits is {step_nm:g} nm already"
                )
        if 0 < self.control.delay_frames < 1:
            raise ValueError(
                f"control.delay_frames is at least 1, or 0 for the camera's; got {self.control.delay_frames}"
            )
        if 0 < self.realtime.priority <= self.realtime.recorder_priority:
            raise ValueError(
                f"realtime.recorder_priority, {self.realtime.recorder_priority}, must be below the loop's "
                f"realtime.priority, {self.realtime.priority}"
            )
        actuators = self.mirror.rows * self.mirror.columns
        for key in map(str, (*self.mirror.dead, *self.mirror.stuck_nm)):
            if not key.isdecimal() or int(key) >= actuators:
                raise ValueError(f"mirror: actuator {key!r} is not one of 0 to {actuators - 1}")
        return self

    @property
    def period_ns(self) -> int:
        """Time between the starts of two exposures."""
        return round(1e9 / self.camera.rate_hz)

    @property
    def exposure_ns(self) -> int:
        """Exposure time."""
        return round(self.period_ns * self.camera.exposure_fraction)

    @property
    def noll(self) -> tuple[int, ...]:
        """Noll indices of the modes."""
        return tuple(range(2, 2 + self.sensor.modes))

    def to_toml(self) -> str:
        """The whole configuration as TOML."""
        return tomli_w.dumps(self.model_dump())


def load(
    path: Path | None, overrides: dict[str, Any] | None = None, defaults: dict[str, Any] | None = None
) -> Configuration:
    """Read a TOML file (None: all defaults), lay `overrides` over it and `defaults` under it: dotted keys to values.

    Raises:
        ConfigurationError: the file is missing or no TOML, or a key or value is wrong.
    """
    data: dict[str, Any] = {}
    if path is not None:
        try:
            data = tomllib.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise ConfigurationError(f"{path}: there is no such configuration file") from None
        except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
            raise ConfigurationError(f"{path}: not a readable TOML file: {error}") from None
    for key, value in (defaults or {}).items():
        _put(path, data, key, value, replace=False)
    for key, value in (overrides or {}).items():
        _put(path, data, key, value, replace=True)
    try:
        return Configuration.model_validate(data)
    except ValidationError as error:
        lines = [_explain(detail) for detail in error.errors()]
        where = f"{path}: " if path is not None else ""
        raise ConfigurationError("\n".join(f"{where}{line}" for line in lines)) from None


def _put(path: Path | None, data: dict[str, Any], key: str, value: object, *, replace: bool) -> None:
    *sections, last = key.split(".")
    target = data
    for section in sections:
        target = target.setdefault(section, {})
        if not isinstance(target, dict):
            raise ConfigurationError(f"{path}: {section} must be a section, [{section}]")
    if replace or last not in target:
        target[last] = value


def keys(section: type[BaseModel] = Configuration, prefix: str = "") -> dict[str, FieldInfo]:
    """Every key by its dotted name, in the order of declaration."""
    found: dict[str, FieldInfo] = {}
    for name, info in section.model_fields.items():
        if isinstance(info.annotation, type) and issubclass(info.annotation, BaseModel):
            found |= keys(info.annotation, f"{prefix}{name}.")
        else:
            found[prefix + name] = info
    return found


def _explain(detail: Any) -> str:
    key = ".".join(str(part) for part in detail["loc"])
    if detail["type"] == "extra_forbidden":
        known = [*keys(), *Configuration.model_fields]
        near = difflib.get_close_matches(key, known, n=1, cutoff=0.0)
        return f"unknown key {key!r}; the nearest known one is {near[0]!r}"
    message = detail["msg"].removeprefix("Value error, ")
    return f"{key} = {detail['input']!r}: {message}" if key else message
