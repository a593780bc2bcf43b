"""Sections of the configuration: the instrument (star, sensor, camera, disturbance, mirror), interlocks, gateways."""

from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from lowfc.contract.network import Section as Section
from lowfc.contract.network import WithoutNul

Preset = Literal["quiet", "bench", "thermal", "reaction-wheel", "reaction-wheel-ideal", "step", "kolmogorov"]

MIRROR_NAME = r"^[a-z][a-z0-9_]{0,49}$"
"""Regular expression for a mirror's name; with "mirror-" before it, it fits the common name of a TLS certificate."""
BENCH_NAME = r"^[A-Za-z][A-Za-z0-9_-]{0,63}$"
"""Regular expression for the name of a bench value."""
MAX_VALUE = 1e12
"""Largest value of a key without a limit of its own; a far larger number overflows in single precision."""
Positive = Annotated[float, Field(gt=0, le=MAX_VALUE)]
MirrorLimit = Annotated[float, Field(gt=0.01, le=MAX_VALUE)]
NotNegative = Annotated[float, Field(ge=0, le=MAX_VALUE)]
Signed = Annotated[float, Field(ge=-MAX_VALUE, le=MAX_VALUE)]


class InterlockSection(Section):
    """A condition on a bench value, and the action while the condition is true."""

    name: str = Field(pattern=BENCH_NAME)
    """Name of the value: the last part of its topic, lowfc/bench/NAME."""
    test: Literal["equal", "different", "above", "below"] = "equal"
    """The interlock acts if the bench value is equal to, different from, above or below `value`."""
    value: bool | float | Annotated[str, Field(max_length=200)]
    """Value to compare with: true or false, a number (required for above and below), or a text."""
    action: Literal["hold", "open", "safe", "refuse_close", "warn"]
    """Action: a closed loop holds its command, the loop opens, goes to safe mode, cannot be closed, or only a warning
    is raised. All but warn refuse to close the loop while the condition is true."""
    max_age_s: float = Field(5.0, ge=0.01, le=3600)
    """Age above which a value is too old; its publisher must send it at least twice in this time."""
    when_old: Literal["acts", "passes"] = "acts"
    """Whether the interlock acts on a value that is too old, of the wrong type, or never received."""

    @model_validator(mode="after")
    def _comparable(self) -> "InterlockSection":
        if self.test in ("above", "below") and not isinstance(self.value, float):
            raise ValueError(f"{self.test} compares numbers, but value is {self.value!r}")
        return self


class Gateway(Section):
    """Gateways to control systems: `lowfc gateway`."""

    prefix: str = Field("lowfc:", pattern=r"^[A-Za-z0-9_:.-]{1,40}$")
    """Prefix of the names of all offered variables."""
    listen: WithoutNul = Field("127.0.0.1", min_length=1)
    """Address on which the gateway serves; default: loopback only."""
    port: int = Field(5075, ge=1, le=65534)
    """TCP port; searches are answered on the UDP port with the next number."""
    search: WithoutNul = "127.0.0.1"
    """Addresses searched for variables of other servers, separated by spaces."""
    bench: dict[Annotated[str, Field(pattern=BENCH_NAME)], Annotated[str, Field(min_length=1)]] = Field(
        default_factory=dict, max_length=64
    )
    """Variables of other servers that become bench values: name of the value = name of the variable. At most 64, as a
    recorder records no more bench values."""


class Star(Section):
    """The star and the telescope (Sect. 3.3 of the paper)."""

    magnitude: float = Field(2.0, ge=-2, le=20)
    """Apparent V magnitude. The zero point, 1.005e8 photons per s, m^2 and nm, does not change with the wavelength."""
    diameter_m: float = Field(2.0, gt=0, le=100)
    """Diameter of the open circular aperture."""
    wavelength_nm: float = Field(550.0, ge=100, le=30_000)
    """Central wavelength."""
    bandwidth: float = Field(0.2, gt=0, lt=1)
    """Width of the band as a fraction of the central wavelength."""
    throughput: float = Field(0.5, gt=0, le=1)
    """Transmission of the optics upstream of the coronagraph."""


class SensorSection(Section):
    """Optics of the wavefront sensor and the coronagraph."""

    kind: Literal["sam", "clowfs", "zwfs", "bar", "open"] = "sam"
    """sam: sparse aperture mask; clowfs: coronagraphic low-order sensor; zwfs: Zernike sensor; bar: relay pupil
    with a bar; open: open relay pupil."""
    pupil: str = "shaped"
    """shaped: shaped-pupil coronagraph; circle: classical Lyot; prolate: apodised-pupil Lyot; or a pupil FILE.npz."""
    focal_mask: Literal["disk", "bowtie"] = "disk"
    """Reflective focal-plane mask: a disk, or the bowtie of the paper's Fig. 3."""
    focal_radius: float = Field(4.0, ge=1, le=10)
    """Radius of the focal-plane mask, lambda/D; at most 7 for a prolate pupil."""
    lyot_stop: float = Field(0.9, gt=0, le=1)
    """For circle and prolate: diameter of the Lyot stop in front of the science camera, pupil diameters."""
    sam: str = "sam27d07"
    """For sam: a layout of the package, FILE.json, or FILE.json:NAME."""
    hole_samples: int = Field(1, ge=1, le=16)
    """For sam: subsamples across a pupil sample, to find its open fraction. 1, as in the paper: a sample is open if its
    centre is in a hole; 4 for a real mask."""
    defocus_mm: float = Field(6.0, ge=1, le=50)
    """For clowfs: defocus of the detector."""
    focal_ratio: float = Field(20.0, ge=1, le=200)
    """For clowfs: focal ratio at the focal-plane mask."""
    inner_radius: float = Field(0.0, ge=0, lt=10)
    """For clowfs: radius of the hole in the reflective disk, lambda/D."""
    spot_diameter: float = Field(1.06, gt=0, le=8)
    """For zwfs: diameter of the phase spot, lambda/D."""
    bar_width: float = Field(0.1, gt=0, lt=1)
    """For bar: its width, pupil diameters."""
    bar_angle_deg: float = Field(20.0, ge=0, lt=360)
    """For bar: its direction from the x axis towards y."""
    modes: int = Field(14, ge=1, le=35)
    """Number of Zernike modes, from Noll 2."""
    wavelengths: int = Field(1, ge=1, le=9)
    """Wavelengths of the simulated band; 1 is monochromatic."""
    quadrature: Literal["gauss-legendre", "uniform"] = "gauss-legendre"
    """Choice of the wavelengths: uniform, as in the paper, includes both ends and is far less accurate."""
    nodes: Literal[32, 64] = 32
    """Pupil nodes across the diameter in the real-time twin."""
    rank: int = Field(60, ge=20, le=200)
    """Rank of the compressed optical operator in the real-time twin. Error of an image relative to its peak: 1e-4 at
    60, 5e-3 at 40, 0.2 at 20."""


SENSORS: dict[str, dict[str, Any]] = {
    "sam": {"kind": "sam"},
    "bowtie": {"kind": "sam", "focal_mask": "bowtie", "sam": "sam27d07_bowtie"},
    "clowfs": {"kind": "clowfs"},
    "clowfs_tuned": {"kind": "clowfs", "defocus_mm": 3.0},
    "zwfs": {"kind": "zwfs"},
    "zwfs_tuned": {"kind": "zwfs", "spot_diameter": 2.0},
    "bar": {"kind": "bar"},
    "open": {"kind": "open"},
    "lyot": {"kind": "sam", "pupil": "circle"},
    "aplc": {"kind": "sam", "pupil": "prolate", "focal_radius": 2.5},
}
"""Named sensors of the command line, as keys of [sensor]."""


def sensor_keys(name: str) -> dict[str, Any]:
    """Keys of [sensor] for one of `SENSORS`; any other name is that of a sparse aperture mask's layout."""
    return SENSORS.get(name, {"kind": "sam", "sam": name})


class Camera(Section):
    """The sensor camera."""

    rate_hz: float = Field(250.0, ge=0.001, le=20_000)
    """Frames per second."""
    exposure_fraction: float = Field(0.5, gt=0, le=1)
    """Exposure time as a fraction of the frame period; the rest is for read-out, computation and the mirror."""
    quantum_efficiency: float = Field(0.8, gt=0, le=1)
    """Electrons per photon."""
    read_noise_e: NotNegative = 1.0
    """Read noise of one pixel."""
    gain_e_per_dn: Positive = 1.0
    """Electrons per digital number."""
    bias_dn: float = Field(100.0, ge=0, le=60_000)
    """Level without light."""
    full_well_e: Positive = 40_000.0
    """Full-well capacity of a pixel, electrons."""
    bit_depth: int = Field(16, ge=8, le=16)
    """Bits of the converter."""
    em_gain: float = Field(1.0, ge=1, le=5000)
    """Electron-multiplying gain; 1 for a conventional detector. Read noise, gain and full well are those after
    multiplication."""
    clock_induced_charge_e: NotNegative = 0.0
    """Spurious electrons per pixel and frame before multiplication."""
    dark_current_e_s: NotNegative = 0.0
    """Dark current of every pixel, electrons per second; an analytic calibration includes it, as a dark frame does."""
    hot_pixels: float = Field(0.0, ge=0, le=0.5)
    """Simulated camera: fraction of hot pixels, which an analytic calibration does not include."""
    hot_pixel_e_s: float = Field(20_000.0, gt=0, le=MAX_VALUE)
    """Simulated camera: mean dark current of a hot pixel, electrons per second, exponentially distributed."""
    nonlinearity: float = Field(0.0, ge=0, le=0.5)
    """Simulated camera: relative excess of the gain at low signal over the gain at full well."""
    nonuniformity: float = Field(0.0, ge=0, le=0.3)
    """Simulated camera: rms pixel response non-uniformity, a fraction; not included in an analytic calibration."""
    delay_frames: float = Field(1.0, ge=1, le=3)
    """Delay in frames: a command computed from frame n first acts on the whole exposure of frame n + delay."""
    instants: int = Field(8, ge=1, le=64)
    """Simulated camera: instants of each period over which the true wavefront is averaged. With 1, wavefront and image
    are those at the start of the exposure, without blur."""
    noise: bool = True
    """Simulated camera: photon and read noise; off only for tests of the control law."""
    photon_noise: Literal["fast", "exact"] = "fast"
    """Noise of the simulated camera. fast: faint pixels are drawn from a tabulated distribution, whose variance is at
    most 6e-5 e-^2 too large; exact: the electrons of every pixel are drawn."""


class Disturbance(Section):
    """The simulated disturbance: a function of the seed and of time."""

    preset: Preset = "bench"
    """quiet, bench, thermal, reaction-wheel, reaction-wheel-ideal (lines without a width), step or kolmogorov."""
    scale: NotNegative = 1.0
    """Multiplies the preset's amplitude."""
    line_width: float = Field(0.005, ge=0, le=0.05)
    """For reaction-wheel: width of the lines between half-power points, as a fraction of their frequency."""
    static_nm: dict[str, Signed] = Field(default_factory=dict)
    """Constant wavefront added to the preset: Noll index = nm rms."""
    drift_nm: dict[str, Signed] = Field(default_factory=dict)
    """Random walk added to the preset, from 1e-4 to 10 Hz: Noll index = nm per root second."""
    drift_slope: float = Field(2.0, ge=0, le=4)
    """Exponent of the drift's spectrum, drift_nm^2 / (2 pi^2 f^slope) per Hz; 2 for a random walk."""
    jitter_mas: NotNegative = 0.0
    """Jitter too fast for the loop, mas rms per axis: white from 0.5 to 1.5 times the frame rate."""
    shear: float = Field(0.0, ge=0, le=0.05)
    """Slow beam wander on the sensor's masks, pupil diameters rms per axis; computed to first order."""
    wheel_hz: NotNegative = 0.0
    """Initial speed of a reaction wheel, turns per second (0: none). It excites tip and tilt at its harmonics."""
    wheel_mas: NotNegative = 3.0
    """Amplitude of the wheel's first harmonic at high speed, mas rms per axis; the others have 0.5 to 0.15 of it."""
    wheel_course: Literal["ramp", "walk", "run-down"] = "ramp"
    """Change of the wheel's speed. ramp: linear; walk: random walk; run-down: slowed by friction."""
    wheel_change: Signed = 0.0
    """Rate of change of the wheel's speed: ramp, Hz per second; walk, Hz per root second; run-down, decrease at time 0
    in Hz per second. 0 for constant speed."""
    second_wheel_hz: Signed = 0.0
    """Initial speed of a second, identical wheel minus that of the first, turns per second; the two beat. 0: no second
    wheel."""

    @model_validator(mode="after")
    def _possible(self) -> "Disturbance":
        for name in ("static_nm", "drift_nm"):
            for key in getattr(self, name):
                if not key.isdecimal() or int(key) < 2:
                    raise ValueError(f"{name}: {key!r} is not a Noll index of 2 or more")
        speeds_hz = self.wheel_hz, self.wheel_hz + self.second_wheel_hz
        if self.wheel_hz and self.wheel_course == "run-down" and (self.wheel_change < 0 or min(speeds_hz) < 1e-6):
            raise ValueError("wheels that run down have speeds of 1e-6 Hz or more and a wheel_change of 0 or more")
        return self


IMPERFECTIONS = (
    *("disturbance.wheel_hz", "disturbance.drift_nm", "disturbance.jitter_mas", "disturbance.shear"),
    *("mirror.gain_error", "mirror.hysteresis", "mirror.creep"),
    *("camera.dark_current_e_s", "camera.hot_pixels", "camera.nonlinearity", "camera.nonuniformity"),
)
"""Keys of the simulated imperfections that a report lists; each is off by default."""


class Mirror(Section):
    """The deformable mirror."""

    name: str = Field("dm", pattern=MIRROR_NAME)
    """Name of the mirror in the topics."""
    rows: int = Field(34, ge=2, le=128)
    """Rows of actuators."""
    columns: int = Field(34, ge=2, le=128)
    """Columns of actuators."""
    pitches_per_pupil: float = Field(31.0, gt=1, le=128)
    """Actuator pitches across the pupil."""
    coupling: float = Field(0.15, gt=0, lt=1)
    """Height of an influence function at the neighbouring actuator, as a fraction of its peak."""
    stroke_nm: float = Field(1500.0, gt=0, le=MAX_VALUE)
    """Full range of an actuator, nm of surface."""
    driver_bits: int = Field(16, ge=8, le=24)
    """Bits of the driver over the full range."""
    settling_us: NotNegative = 50.0
    """Simulated mirror: time constant of an actuator's first-order response; without lockstep, images are correct if
    it is at most a fifth of the frame period."""
    dead: list[int] = Field(default_factory=list)
    """Simulated mirror: actuators that stay flat, row * columns + column; exclude known ones with `active`."""
    stuck_nm: dict[str, Signed] = Field(default_factory=dict)
    """Simulated mirror: actuators stuck at a height, row * columns + column = nm; exclude known ones with `active`."""
    slew_nm: MirrorLimit = 150.0
    """The mirror's own limit: largest change of an actuator per command."""
    neighbour_nm: MirrorLimit = 500.0
    """The mirror's own limit: largest difference between neighbouring actuators."""
    on_command_timeout: Literal["hold", "flat"] = "flat"
    """Action after a command timeout: hold the shape, or relax to flat within the slew limit."""
    flat: str = ""
    """Flat map (FITS or .npy), nm of surface, applied from the start; empty for none."""
    active: str = ""
    """Map of the active actuators (FITS or .npy), 0 or 1: modes and flat map exclude the others; empty for all."""
    nm_per_unit: float = Field(1.0, ge=1e-9, le=1e9)
    """nm of surface per unit written, for your own driver or one with VoltMap; isio has an option of this name."""
    shift_pitches: float = Field(0.0, ge=-2, le=2)
    """Simulated mirror: misregistration of its actuators along x and along y, pitches."""
    magnification: float = Field(1.0, ge=0.9, le=1.1)
    """Simulated mirror: its size in the pupil relative to the configured one."""
    gain_error: float = Field(0.0, ge=0, le=0.5)
    """Simulated mirror: rms error of the actuators' gains, a fraction; drawn from the seed."""
    hysteresis: float = Field(0.0, ge=0, le=0.5)
    """Simulated mirror: fraction of a move that reverses only after a backlash of 2 to 512 nm; 0.1 for a piezo."""
    creep: float = Field(0.0, ge=0, le=0.1)
    """Simulated mirror: creep per decade of time, 0.1 to 100 s, as a fraction of a move; 0.01 for a piezo."""
