"""The configuration: every key with its unit, default and range.

A file is TOML with the sections of `Configuration`; missing keys have their defaults. An unknown key is an error that
names a similar known one. `lowfc config show` prints all keys with their descriptions.
"""

import difflib
import re
from collections.abc import Callable, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Annotated, Any, Literal

import tomli_w
from pydantic import BaseModel, Field, ValidationError, model_validator
from pydantic.fields import FieldInfo

from lowfc.contract import toml_text
from lowfc.contract.codecs import input_file
from lowfc.contract.errors import ConfigurationError, brief, reworded
from lowfc.contract.former_names import renamed_keys
from lowfc.contract.network import Network as Network
from lowfc.contract.network import WithoutNul
from lowfc.contract.printable import printable
from lowfc.contract.sections import (
    IMPERFECTIONS,
    MAX_VALUE,
    Camera,
    Disturbance,
    Gateway,
    InterlockSection,
    Mirror,
    MirrorLimit,
    Positive,
    Section,
    SensorSection,
    Star,
)
from lowfc.control.kernel.tables import KernelName
from lowfc.control.loop.safety import MAX_LIMIT_NM, Limits

MIN_FRAME_AGE_NS, MIN_FRAME_TIMEOUT_NS = 20_000_000, 50_000_000
"""Minimum of max_frame_age_ms and of frame_timeout_ms if the configuration does not set them."""
MAX_FAULTS = 20
"""Largest number of faults of a file that an error explains."""
_MAX_KEY_LENGTH = 100  # characters of an unknown key that are compared with the known ones
_ALTERNATIVE = re.compile(
    r"\.(?:constrained-\w+|literal\[[^]]*\])|(?<=\.value)\.(?:bool|float)"
)  # appended by pydantic to a key of two types


Milliseconds = Annotated[float, Field(ge=0, le=1e9)]
Cpus = list[Annotated[int, Field(ge=0, lt=8192)]]  # the kernel's largest number of processors
Count = Annotated[int, Field(ge=0, lt=2**32)]  # uint32 in the controller's state
Gain = Annotated[float, Field(ge=0, le=4)]
Amplitude = Annotated[float, Field(ge=1e-6, le=1e5)]  # acceptance plays it in small steps, whose table must fit memory
ModalLimit = Annotated[float, Field(gt=0, le=MAX_LIMIT_NM)]
FIXED_GAINS = {"control.tilt_gain": 0.5, "control.gain": 0.05}
"""Integrator gains for runs that must not depend on automatic gains, such as timing measurements."""


class Control(Section):
    """The control law."""

    start_mode: Literal["open", "closed"] = "open"
    """Loop mode once a calibration is loaded; with automatic gains, closed takes effect once these are measured.
    sim-loop starts closed if the file does not set this key."""
    delay_frames: float = Field(0.0, ge=0, le=10)
    """Measured delay in frames, counted as camera.delay_frames is; 0: the value of that key. Doubling the delay about
    halves the highest stable gain."""
    estimator: Literal["weighted", "pinv"] = "weighted"
    """Pseudo-inverse of H. weighted: noise-weighted; pinv: plain."""
    nuisance: list[Literal["background", "shear"]] = Field(default_factory=list)
    """Nuisance parameters fitted together with the modes: uniform background light, shear of the beam."""
    tilt_gain: Gain | Literal["auto"] = "auto"
    """Integrator gain of tip and tilt; auto: optimised per mode for the least residual, 0 if no gain reduces it."""
    gain: Gain | Literal["auto"] = "auto"
    """Integrator gain of the other modes."""
    on_harm: Literal["warn", "open", "integrator"] = "warn"
    """Action if the residual stays larger than in open loop. warn: event only; open: the loop opens; integrator: the
    integrator takes over from a law, or the loop opens if the integrator is already in force."""
    tilt_leak: float = Field(0.0, ge=0, le=1)
    """Integrator leak of tip and tilt: fraction of the command lost per frame."""
    leak: float = Field(0.0, ge=0, le=1)
    """Integrator leak of the other modes."""
    tilt_limit_nm: ModalLimit = 150.0
    """Largest modal command of tip and tilt, wavefront rms."""
    limit_nm: ModalLimit = 50.0
    """Largest modal command of the other modes, wavefront rms."""
    max_frame_age_ms: Milliseconds = 0.0
    """Age above which a frame is refused; 0: 20 ms or two frame periods, whichever is longer. In any case a frame is
    refused at an age on arrival of 5 ms or three periods, the longer; if it waited behind another, of one period."""
    frame_timeout_ms: Milliseconds = 0.0
    """Time without a frame after which an event is raised; 0: 50 ms or five frame periods, whichever is longer."""
    on_frame_timeout: Literal["hold", "flat"] = "hold"
    """Action after a frame timeout: hold the command, or relax the mirror to flat."""
    command_timeout_ms: float = Field(200.0, gt=0, le=1e9)
    """Time without a new command after which the mirror's last command expires; more than 2000 acts as 2000. Without
    frames the controller repeats its command every 10 ms, so below 20 the command expires between slow frames."""
    max_start_ahead_h: float = Field(24.0, ge=0, le=1e9)
    """Hours by which the start time of a camera or controller may be ahead of this host's clock; 0: no limit, for a
    host whose clock is not set."""
    min_flux_fraction: float = Field(0.2, ge=0, lt=1)
    """Fraction of the calibration's flux below which a frame is refused as dark."""
    max_saturated_pixels: Count = 8
    """Number of saturated pixels above which a frame is refused."""
    max_identical_frames: Count = 3
    """Consecutive frames that may equal the one before, as from a stuck camera; 0, or camera.noise off: no limit."""
    law: str = ""
    """Law file (FITS) written by `lowfc tune`; empty for the integrator."""
    guard: bool = True
    """The integrator replaces a law that amplifies the disturbance or has a larger residual than the integrator."""


class Safety(Section):
    """Limits enforced by the controller; the mirror enforces its own."""

    stroke_nm: MirrorLimit = 700.0
    """Largest deviation of an actuator from flat, in either direction, nm of surface."""
    slew_nm: MirrorLimit = 100.0
    """Largest change of an actuator per command."""
    neighbour_nm: MirrorLimit = 400.0
    """Largest difference between neighbouring actuators."""


class Acceptance(Section):
    """Requirements of `lowfc acceptance`."""

    rejection_db: Positive = 1.0
    """Largest deviation of the measured rejection and noise transfer from theory."""
    lowest_hz: Positive = 0.1
    """Lowest frequency at which rejection and noise transfer are measured."""
    highest_of_rate: float = Field(0.3, gt=0, le=0.5)
    """Highest frequency at which rejection and noise transfer are measured, as a fraction of the frame rate."""
    linear_nm: Amplitude = 12.0
    """Wavefront rms of a mode up to which the sensor must be linear; 12 nm is 5 mas of tilt for a 2 m pupil."""
    gain_error: Positive = 0.05
    """Largest deviation from 1 of the ratio of measured to true amplitude of a mode, up to linear_nm."""
    crosstalk: Positive = 0.05
    """Largest fraction of a mode that is measured as another mode, up to linear_nm."""
    capture_tilt_nm: Amplitude = 34.0
    """Wavefront rms of tip or tilt from which the loop must close; 34 nm is 14 mas for a 2 m pupil."""
    capture_nm: Amplitude = 20.0
    """Wavefront rms of any other mode from which the loop must close."""
    noise_ratio: float = Field(1.2, gt=1, le=MAX_VALUE)
    """Largest white noise of a mode, relative to its photon and read-out noise."""


class Recorder(Section):
    """The log."""

    folder: WithoutNul = "logs"
    """Where log files are written."""
    file_mode: str = Field("0640", pattern=r"^06[0246]{2}$")
    """Permissions of a log file, octal: 0640 readable by its group, 0600 by its owner only; the umask also applies."""
    largest_mb: float = Field(4000.0, ge=1, le=1_000_000)
    """Size at which the next log is started; every log can be read by itself."""
    longest_s: float = Field(3600.0, ge=1, le=1_000_000)
    """Duration after which the next log is started."""
    min_free_mb: float = Field(500.0, ge=0, le=1_000_000_000)
    """Free disk space below which recording is refused or stops with a complete log; the loop goes on."""
    every: int = Field(1, ge=1, le=1_000_000)
    """Record every Nth frame and mirror state; steps and commands are always complete. Replay requires 1."""
    topics: list[str] = Field(default_factory=list)
    """Topics or patterns to record among frames, mirror state, mirror surface, truth and timing; empty for all."""
    on_event: WithoutNul = ""
    """Shell command that the recorder runs on events, described by the variables LOWFC_EVENT, LOWFC_TEXT, LOWFC_LEVEL,
    LOWFC_PROCESS, LOWFC_TIME, LOWFC_RUN and LOWFC_OTHERS; empty for none."""
    on_event_level: Literal["info", "warning", "error"] = "error"
    """Lowest event level that runs the command."""
    on_event_every_s: float = Field(10.0, ge=0, le=1_000_000)
    """Shortest time from the end of the command to its next run, which reports the most severe event since the last
    run began; LOWFC_OTHERS is the number of the other events."""


class Realtime(Section):
    """Real-time measures requested from the host; each process applies them before its first bus session."""

    priority: int = Field(50, ge=0, le=98)
    """SCHED_FIFO priority of camera, controller, mirror and router; 0 for normal scheduling, as always in lockstep."""
    recorder_priority: int = Field(10, ge=0, le=98)
    """SCHED_FIFO priority of the recorder, below `priority`; the batch class if either is 0, or in lockstep."""
    lock_memory: bool = True
    """Lock the memory of camera, controller, mirror, router; the first three use huge pages once ready (Linux 6.1)."""
    disable_cpu_idle: bool = True
    """Keep processors out of deep idle states while the loop runs: lower latency, more power."""
    cache_warmup: bool = True
    """Repeat the control step just before the next frame to keep the caches warm; only below 2 kHz."""
    kernel: KernelName = "numpy"
    """Implementation of the control step: numpy, or the fused step compiled by numba (extra `fast`)."""
    threads: int = Field(1, ge=1, le=8)
    """Threads of the fused step for large frames (R of 8 MB or more); each needs a processor of controller_cpus to
    itself."""
    camera_cpus: Cpus = Field(default_factory=list)
    """Processors of the camera; empty for all. sim-loop sets this key and the next three unless the file does: with
    three processors or more, the controller gets its own."""
    controller_cpus: Cpus = Field(default_factory=list)
    """Processors of the controller; empty for all."""
    mirror_cpus: Cpus = Field(default_factory=list)
    """Processors of the mirror; empty for all."""
    recorder_cpus: Cpus = Field(default_factory=list)
    """Processors of the recorder; empty for all."""


class Configuration(Section):
    """The configuration: a field per section."""

    seed: int = Field(1, ge=0, lt=2**63)
    """Seed of every random number in the simulation."""
    lockstep: bool = False
    """Expose the next frame only when the mirror has applied the last command; time is simulated."""
    interlocks: list[InterlockSection] = Field(default_factory=list, max_length=32)
    """Conditions on bench values, each a table [[interlocks]] with name, test (equal, different, above, below),
    value, action (hold, open, safe, refuse_close, warn), max_age_s and when_old (acts, passes)."""
    star: Star = Star()
    sensor: SensorSection = SensorSection()
    camera: Camera = Camera()
    disturbance: Disturbance = Disturbance()
    mirror: Mirror = Mirror()
    control: Control = Control()
    safety: Safety = Safety()
    acceptance: Acceptance = Acceptance()
    recorder: Recorder = Recorder()
    realtime: Realtime = Realtime()
    network: Network = Network()
    gateway: Gateway = Gateway()
    drivers: dict[str, dict[str, Any]] = Field(default_factory=dict)
    """Options of the camera and mirror drivers, as each driver declares them: [drivers.NAME]."""

    @model_validator(mode="after")
    def _consistent(self) -> "Configuration":
        if self.safety.stroke_nm > self.mirror.stroke_nm / 2:
            raise ValueError(
                f"safety.stroke_nm is {self.safety.stroke_nm:g} nm either way, but mirror.stroke_nm gives only "
                f"{self.mirror.stroke_nm / 2:g} nm either way"
            )
        _limits("safety", self.safety.stroke_nm, self.safety)
        limits = _limits("mirror", self.mirror.stroke_nm / 2, self.mirror)
        step_nm = self.mirror.stroke_nm / 2**self.mirror.driver_bits
        least_nm = step_nm + max(0.01, 2 * limits.margin_nm)
        for name in ("slew_nm", "neighbour_nm"):
            if getattr(self.mirror, name) <= least_nm:
                raise ValueError(
                    f"mirror.{name} must be above {least_nm:g} nm, one step of a driver of {self.mirror.driver_bits} "
                    f"bits ({step_nm:g} nm) with the margin for rounding; got {getattr(self.mirror, name):g} nm"
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
        for key in (*self.disturbance.static_nm, *self.disturbance.drift_nm):
            if int(key) not in self.noll:
                raise ValueError(f"disturbance: Z{key} is not one of the sensor's modes, Z2 to Z{self.noll[-1]}")
        actuators = self.mirror.rows * self.mirror.columns
        for key in map(str, (*self.mirror.dead, *self.mirror.stuck_nm)):
            if not key.isdecimal() or int(key) >= actuators:
                raise ValueError(f"mirror: actuator {key!r} is not one of 0 to {actuators - 1}")
        return self

    @property
    def period_ns(self) -> int:
        """Frame period: time between the starts of successive exposures."""
        return round(1e9 / self.camera.rate_hz)

    @property
    def lockstep_hz(self) -> float | None:
        """Frame rate in simulated time; None unless the run is in lockstep."""
        return self.camera.rate_hz if self.lockstep else None

    @property
    def exposure_ns(self) -> int:
        """Exposure time."""
        return round(self.period_ns * self.camera.exposure_fraction)

    @property
    def dark_e(self) -> float:
        """Electrons of a pixel in an exposure without light: clock-induced charge and dark current."""
        return self.camera.clock_induced_charge_e + self.camera.dark_current_e_s * self.exposure_ns * 1e-9

    @property
    def imperfections(self) -> dict[str, Any]:
        """Imperfections of the simulation that are switched on, by key."""
        values = {key: attrgetter(key)(self) for key in IMPERFECTIONS}
        return {key: value for key, value in values.items() if value}

    @property
    def max_frame_age_ns(self) -> int:
        """Age above which a frame is refused."""
        return round(self.control.max_frame_age_ms * 1e6) or max(MIN_FRAME_AGE_NS, 2 * self.period_ns)

    @property
    def frame_timeout_ns(self) -> int:
        """Time without a frame after which an event is raised."""
        return round(self.control.frame_timeout_ms * 1e6) or max(MIN_FRAME_TIMEOUT_NS, 5 * self.period_ns)

    @property
    def noll(self) -> tuple[int, ...]:
        """Noll indices of the modes."""
        return tuple(range(2, 2 + self.sensor.modes))

    def to_toml(self) -> str:
        """The whole configuration as TOML."""
        return tomli_w.dumps(self.model_dump())


def _limits(key: str, stroke_nm: float, section: Safety | Mirror) -> Limits:
    try:
        return Limits(stroke_nm, section.slew_nm, section.neighbour_nm)
    except ValueError as fault:
        raise ValueError(f"{key}.{fault}") from None


def load(
    path: Path | None,
    overrides: dict[str, Any] | None = None,
    defaults: dict[str, Any] | None = None,
    remark: Callable[[str], None] = lambda text: None,
) -> Configuration:
    """Read a TOML file (None: all defaults); `overrides` replace its values, `defaults` fill in missing ones.

    Both map dotted keys to values. Former key names are accepted; for each, `remark` is called with a message.

    Raises:
        ConfigurationError: the file is missing or not TOML, or a key or value is wrong.
    """
    data: dict[str, Any] = {}
    if path is not None:
        try:
            data = toml_text.parsed(input_file.read_whole(path, toml_text.MAX_BYTES))
            for text in renamed_keys(data):
                remark(f"{path}: {text}")
        except FileNotFoundError:
            raise ConfigurationError(f"{path}: there is no such configuration file") from None
        except (OSError, ValueError) as error:
            why = error.strerror if isinstance(error, OSError) else error
            raise ConfigurationError(f"{path}: not a readable TOML file: {why}") from None
    for key, value in (defaults or {}).items():
        _put(path, data, key, value, replace=False)
    for key, value in (overrides or {}).items():
        _put(path, data, key, value, replace=True)
    try:
        return Configuration.model_validate(data)
    except ValidationError as error:
        faults = error.errors()
        lines = [explain(detail) for detail in faults[:MAX_FAULTS]]
        if len(faults) > MAX_FAULTS:
            lines.append(f"and {len(faults) - MAX_FAULTS} more")
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
    """All keys by their dotted names, in the order of declaration."""
    infos: dict[str, FieldInfo] = {}
    for name, info in section.model_fields.items():
        if isinstance(info.annotation, type) and issubclass(info.annotation, BaseModel):
            infos |= keys(info.annotation, f"{prefix}{name}.")
        else:
            infos[prefix + name] = info
    return infos


def _nearest(key: str, valid_keys: Sequence[str]) -> str:
    """Suffix of an error about an unknown key: the most similar known key of any section, or a remark on its quotes."""
    if key in valid_keys:
        return "; write it without quotes, which make it one name"
    by_name = {dotted.rpartition(".")[2]: dotted for dotted in reversed(valid_keys)}
    elsewhere = difflib.get_close_matches(key.rpartition(".")[2], by_name, 1, 0.75)
    similar = difflib.get_close_matches(key, valid_keys, 1, 0.8)
    close = similar or [by_name[name] for name in elsewhere] or difflib.get_close_matches(key, valid_keys, 1)
    return f"; the nearest known one is {close[0]!r}" if close else ""


def explain(detail: Any) -> str:
    """One of pydantic's errors as a message for the user."""
    key = _ALTERNATIVE.sub("", ".".join(str(part) for part in detail["loc"]))
    if detail["type"] == "missing":
        return printable(f"{key[:_MAX_KEY_LENGTH]} is missing")
    if detail["type"] == "extra_forbidden":
        valid_keys = [*keys(), *Configuration.model_fields, *keys(InterlockSection, "interlocks.")]
        plain = ".".join(part for part in detail["loc"] if isinstance(part, str))
        return f"unknown key {brief(key)}{_nearest(plain[:_MAX_KEY_LENGTH], valid_keys)}"
    message = reworded(detail["msg"])
    return printable(f"{key[:_MAX_KEY_LENGTH]} = {brief(detail['input'])}: {message[:300]}" if key else message)
