"""The configuration: every key, its unit, default and range, declared once.

A file is TOML with the sections of `Configuration`; what it leaves out has the default. An unknown key is refused with
the nearest known one. `lowfc config show` prints all keys with their sentences.
"""

import difflib
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import tomli_w
from pydantic import BaseModel, Field, ValidationError, model_validator
from pydantic.fields import FieldInfo

from lowfc.contract import toml_text
from lowfc.contract.codecs import input_file
from lowfc.contract.errors import ConfigurationError, brief
from lowfc.contract.former_names import renamed_keys
from lowfc.contract.network import Network as Network
from lowfc.contract.printable import printable
from lowfc.contract.sections import (
    IMPERFECTIONS,
    Camera,
    Disturbance,
    Gateway,
    InterlockSection,
    Mirror,
    NotNegative,
    Positive,
    Section,
    SensorSection,
    Star,
)
from lowfc.control.kernel.tables import KernelName

LATE_NS, HOLD_NS = 20_000_000, 50_000_000
"""Least age of a late frame and least silence of a camera, where the configuration leaves them open."""
MOST_FAULTS = 20
"""Faults that are explained, of a file that may be something else altogether."""
_LONGEST_KEY = 100  # characters of one that the nearest known key is looked for
_ALTERNATIVE = re.compile(r"\.(?:constrained-\w+|literal\[[^]]*\])")  # pydantic's, behind a key of two types


Gain = Annotated[float, Field(ge=0, le=4)]
FIXED_GAINS = {"control.tilt_gain": 0.5, "control.gain": 0.05}
"""Where a run shall not depend on what is measured in it, as one that measures times."""


class Control(Section):
    """The control law."""

    start_mode: Literal["open", "closed"] = "open"
    """Loop mode once a calibration is loaded; sim-loop starts closed where the file is silent."""
    delay_frames: float = Field(0.0, ge=0, le=10)
    """Frames from the one a command is made from to the first exposed wholly under it, as measured; 0 takes the
    camera's. Twice the delay halves the highest stable gain."""
    estimator: Literal["weighted", "pinv"] = "weighted"
    """Noise-weighted or plain pseudo-inverse of H."""
    nuisance: list[Literal["background", "shear"]] = Field(default_factory=list)
    """What is fitted along with the modes so that it does not pass for them: uniform light, shear of the beam."""
    tilt_gain: Gain | Literal["auto"] = "auto"
    """Integrator gain of tip and tilt; auto: the measured one that leaves least of a mode, 0 where any would harm."""
    gain: Gain | Literal["auto"] = "auto"
    """Integrator gain of the other modes."""
    on_harm: Literal["warn", "open", "integrator"] = "warn"
    """What follows where the loop has left more than an open loop for long: an event; or the loop opens, too; or the
    integrator takes over from a law, and where it drives already, the loop opens."""
    tilt_leak: float = Field(0.0, ge=0, le=1)
    """Integrator leak of tip and tilt."""
    leak: float = Field(0.0, ge=0, le=1)
    """Integrator leak of the other modes."""
    tilt_limit_nm: Positive = 150.0
    """Largest modal command of tip and tilt, wavefront rms."""
    limit_nm: Positive = 50.0
    """Largest modal command of the other modes, wavefront rms."""
    max_frame_age_ms: NotNegative = 0.0
    """Age above which a frame is refused; 0 for 20 ms, or two frame periods where they are longer."""
    frame_timeout_ms: NotNegative = 0.0
    """Silence of the camera after which it is an event; 0 for 50 ms, or five frame periods where they are longer."""
    on_frame_timeout: Literal["hold", "flat"] = "hold"
    """During such a silence: hold the command, or relax the mirror to flat."""
    command_timeout_ms: Positive = 200.0
    """How long the mirror may hold a command without another one."""
    max_start_ahead_h: float = Field(24.0, ge=0)
    """Hours by which the start in a camera's or a controller's sequences may lie ahead of this host's clock; 0 for any,
    as on a host whose clock is not set."""
    min_flux_fraction: float = Field(0.2, ge=0, lt=1)
    """Fraction of the expected light below which a frame is dark."""
    max_saturated_pixels: int = Field(8, ge=0)
    """Pixels at full well above which a frame is refused."""
    max_identical_frames: int = Field(3, ge=0)
    """Frames in a row that may be the very image of the one before, as a stuck camera sends it; 0 for any number."""
    law: str = ""
    """File (FITS) of a law that `lowfc tune` wrote, which takes over from the integrator; empty for the integrator."""
    guard: bool = True
    """Guard every law: the integrator takes over where it would leave less, or where the law amplifies."""


class Safety(Section):
    """Limits that the controller keeps; the mirror keeps its own."""

    stroke_nm: float = Field(700.0, gt=0.01)
    """Largest deviation of an actuator from flat, surface, either way."""
    slew_nm: float = Field(100.0, gt=0.01)
    """Largest change of an actuator per command."""
    neighbour_nm: float = Field(400.0, gt=0.01)
    """Largest difference between neighbouring actuators."""


class Acceptance(Section):
    """What a loop must show to be accepted: `lowfc acceptance`."""

    rejection_db: Positive = 1.0
    """Largest deviation of the measured rejection and noise transfer from theory."""
    lowest_hz: Positive = 0.1
    """Frequency from which they are measured."""
    highest_of_rate: float = Field(0.3, gt=0, le=0.5)
    """Frequency up to which they are measured, as a fraction of the frame rate."""
    linear_nm: Positive = 12.0
    """Wavefront rms of a mode up to which the sensor must be linear; 12 nm are 5 mas of tilt at 2 m."""
    gain_error: Positive = 0.05
    """Largest deviation from 1 of a mode's measured over its true amplitude, in this range."""
    crosstalk: Positive = 0.05
    """Largest fraction of a mode that is measured as another one, in this range."""
    capture_tilt_nm: Positive = 34.0
    """Wavefront rms of tip or tilt from which the loop must close; 34 nm are 14 mas at 2 m."""
    capture_nm: Positive = 20.0
    """Wavefront rms of any other mode from which the loop must close."""
    noise_ratio: float = Field(1.2, gt=1)
    """Largest white noise of a mode, relative to its photon and read-out noise."""


class Recorder(Section):
    """The log."""

    folder: str = "logs"
    """Where log files are written."""
    file_mode: str = Field("0640", pattern=r"^06[0246]{2}$")
    """Permissions of a log file, octal: 0640 lets its group read it, 0600 nobody else; the umask may take more away."""
    largest_mb: float = Field(4000.0, ge=1, le=1_000_000)
    """Size at which a log is finished and the next one begun; each can be read by itself."""
    longest_s: float = Field(3600.0, ge=1, le=1_000_000)
    """Age at which a log is finished and the next one begun."""
    min_free_mb: float = Field(500.0, ge=0, le=1_000_000_000)
    """Free space on the disk below which recording is refused, or ends with a complete log while the loop goes on."""
    every: int = Field(1, ge=1, le=1_000_000)
    """Record every Nth frame and mirror state only; steps and commands are always whole. 1: all, as replay needs."""
    topics: list[str] = Field(default_factory=list)
    """Of frames, mirror state, mirror surface, truth and timing, the topics or patterns to record; empty for all."""
    on_event: str = ""
    """Shell command that the recorder runs on events, told which in the variables LOWFC_EVENT, LOWFC_TEXT, LOWFC_LEVEL,
    LOWFC_PROCESS, LOWFC_TIME, LOWFC_RUN and LOWFC_OTHERS; empty for none."""
    on_event_level: Literal["info", "warning", "error"] = "error"
    """Least severe level of event that it is run for."""
    on_event_every_s: float = Field(10.0, ge=0)
    """Time from the end of one run of it to the next, which is for the worst event since; LOWFC_OTHERS counts the
    others."""


class Realtime(Section):
    """What is asked of the host, in every process, before its first bus session."""

    priority: int = Field(50, ge=0, le=98)
    """SCHED_FIFO priority of camera, controller and mirror; 0 for normal scheduling."""
    recorder_priority: int = Field(10, ge=0, le=98)
    """SCHED_FIFO priority of the recorder, below the loop's; 0, or a loop without, for normal scheduling."""
    lock_memory: bool = True
    """Keep the processes' memory from being paged out."""
    disable_cpu_idle: bool = True
    """Keep idle processors awake while the loop runs: waking one takes longer than a hand-off; it costs power."""
    cache_warmup: bool = True
    """Do each control step a second time for nothing, so that the next frame finds the caches warm; not above 2 kHz."""
    kernel: KernelName = "numpy"
    """Arithmetic of the controller's usual frame: numpy, or the fused step, compiled by numba (extra `fast`)."""
    threads: int = Field(1, ge=1, le=8)
    """Threads that share the pass of the fused step over large frames (R of 8 MB or more), each on a processor of
    controller_cpus that nothing else needs."""
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
    interlocks: list[InterlockSection] = Field(default_factory=list, max_length=32)
    """Conditions on values of the bench, each a table [[interlocks]] with name, test (equal, different, above, below),
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
    """Options of drivers of cameras and mirrors by the driver's name, as each driver declares them: [drivers.NAME]."""

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
    def dark_e(self) -> float:
        """Electrons of a pixel in an exposure without light: clock-induced charge and dark current."""
        return self.camera.clock_induced_charge_e + self.camera.dark_current_e_s * self.exposure_ns * 1e-9

    @property
    def imperfections(self) -> dict[str, Any]:
        """Those of the simulated world that are not off, by key."""
        found = {key: getattr(getattr(self, key.partition(".")[0]), key.partition(".")[2]) for key in IMPERFECTIONS}
        return {key: value for key, value in found.items() if value}

    @property
    def max_frame_age_ns(self) -> int:
        """Age above which a frame is refused."""
        return round(self.control.max_frame_age_ms * 1e6) or max(LATE_NS, 2 * self.period_ns)

    @property
    def frame_timeout_ns(self) -> int:
        """Silence of the camera after which it is an event."""
        return round(self.control.frame_timeout_ms * 1e6) or max(HOLD_NS, 5 * self.period_ns)

    @property
    def noll(self) -> tuple[int, ...]:
        """Noll indices of the modes."""
        return tuple(range(2, 2 + self.sensor.modes))

    def to_toml(self) -> str:
        """The whole configuration as TOML."""
        return tomli_w.dumps(self.model_dump())


def load(
    path: Path | None,
    overrides: dict[str, Any] | None = None,
    defaults: dict[str, Any] | None = None,
    remark: Callable[[str], None] = lambda text: None,
) -> Configuration:
    """Read a TOML file (None: all defaults), lay `overrides` over it and `defaults` under it: dotted keys to values.

    A former key has the meaning of the present one, and `remark` is called with a sentence that names both.

    Raises:
        ConfigurationError: the file is missing or no TOML, or a key or value is wrong.
    """
    data: dict[str, Any] = {}
    if path is not None:
        try:
            data = toml_text.parsed(input_file.read_whole(path, toml_text.LARGEST_BYTES))
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
        lines = [explain(detail) for detail in faults[:MOST_FAULTS]]
        if len(faults) > MOST_FAULTS:
            lines.append(f"and {len(faults) - MOST_FAULTS} more")
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


def _nearest(wanted: str, known: Sequence[str]) -> str:
    """The known key that is most like a wrong one; where none is, the one whose name in its section is."""
    names = {one.rpartition(".")[2]: one for one in reversed(known)}
    whole = difflib.get_close_matches(wanted, known, 1, 0.0)
    in_another = difflib.get_close_matches(wanted.rpartition(".")[2], names, 1, 0.75)
    alike = difflib.get_close_matches(wanted, known, 1, 0.8)
    return next(iter(alike or [names[one] for one in in_another] or whole))


def explain(detail: Any) -> str:
    """One of pydantic's errors as a line for a user."""
    key = _ALTERNATIVE.sub("", ".".join(str(part) for part in detail["loc"]))
    if detail["type"] == "missing":
        return printable(f"{key[:_LONGEST_KEY]} is missing")
    if detail["type"] == "extra_forbidden":
        known = [*keys(), *Configuration.model_fields, *keys(InterlockSection, "interlocks.")]
        plain = ".".join(part for part in detail["loc"] if isinstance(part, str))
        return f"unknown key {brief(key)}; the nearest known one is {_nearest(plain[:_LONGEST_KEY], known)!r}"
    message = detail["msg"].removeprefix("Value error, ").replace("Input should be", "must be")
    return printable(f"{key[:_LONGEST_KEY]} = {brief(detail['input'])}: {message[:300]}" if key else message)
