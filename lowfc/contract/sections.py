"""The sections of the configuration that say what the instrument is: star, sensor, camera, disturbance, mirror."""

from typing import Annotated, Any, Literal, get_args

from pydantic import Field, model_validator

from lowfc.contract.network import Section as Section

Preset = Literal["quiet", "bench", "thermal", "reaction-wheel", "reaction-wheel-ideal", "step", "kolmogorov"]
PRESETS: tuple[str, ...] = get_args(Preset)

BENCH_NAME = r"^[A-Za-z][A-Za-z0-9_-]{0,63}$"
"""Of a bench value, a regular expression."""
Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]


class InterlockSection(Section):
    """A condition on a value that something else on the bench publishes, and what follows while it holds."""

    name: str = Field(pattern=BENCH_NAME)
    """Name of the value: the last part of its topic, lowfc/bench/NAME."""
    test: Literal["equal", "different", "above", "below"] = "equal"
    """How the value compares with `value` where the interlock acts; above and below are for numbers."""
    value: bool | float | Annotated[str, Field(max_length=200)]
    """What it is compared with: true or false, a number, or a text."""
    action: Literal["hold", "open", "safe", "refuse_close", "warn"]
    """What follows: a closed loop holds its command, the loop opens, it goes into safe mode, it is not closed, or a
    warning alone. All but the last refuse to close the loop meanwhile."""
    max_age_s: float = Field(5.0, ge=0.01, le=3600)
    """Time without a new value after which the last one is too old; publish at least twice as often."""
    when_old: Literal["acts", "passes"] = "acts"
    """What counts for a value that is too old, of another kind, or was never received."""

    @model_validator(mode="after")
    def _comparable(self) -> "InterlockSection":
        if self.test in ("above", "below") and not isinstance(self.value, float):
            raise ValueError(f"{self.test} compares numbers, and value is {self.value!r}")
        return self


class Gateway(Section):
    """The gateways to control systems: `lowfc gateway`."""

    prefix: str = Field("lowfc:", pattern=r"^[A-Za-z0-9_:.-]{1,40}$")
    """Beginning of the name of every variable that it offers."""
    listen: str = "127.0.0.1"
    """Address on which it serves; loopback alone unless another is named."""
    port: int = Field(5075, ge=1, le=65534)
    """TCP port; searches are answered at the next UDP port."""
    search: str = "127.0.0.1"
    """Addresses at which variables of others are searched, with a space between two."""
    bench: dict[Annotated[str, Field(pattern=BENCH_NAME)], str] = Field(default_factory=dict)
    """Variables of others that become bench values: name of the value = name of the variable."""


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
    lyot_stop: float = Field(0.9, gt=0, le=1)
    """Of circle and prolate: diameter of the stop in front of the science camera, pupil diameters."""
    sam: str = "sam27d07"
    """Of a sam: a shipped layout, or FILE.json, or FILE.json:NAME."""
    hole_samples: int = Field(1, ge=1, le=16)
    """Of a sam: points across a pupil sample that say how much of it a hole covers. 1, as the paper: all or nothing, by
    its centre; 4 for a mask that is made."""
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
    "clowfs_tuned": {"kind": "clowfs", "defocus_mm": 3.0},
    "zwfs": {"kind": "zwfs"},
    "zwfs_tuned": {"kind": "zwfs", "spot_diameter": 2.0},
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
    dark_current_e_s: NotNegative = 0.0
    """Dark current of every pixel, electrons per second; known to an analytic calibration, as from a dark frame."""
    hot_pixels: float = Field(0.0, ge=0, le=0.5)
    """Of the simulated camera: fraction of pixels that are hot; an analytic calibration does not know of them."""
    hot_pixel_e_s: Positive = 20_000.0
    """Of the simulated camera: mean dark current of a hot pixel, electrons per second, exponentially distributed."""
    nonlinearity: float = Field(0.0, ge=0, le=0.5)
    """Of the simulated camera: by which fraction the gain of a faint pixel exceeds that of one at full well."""
    nonuniformity: float = Field(0.0, ge=0, le=0.3)
    """Of the simulated camera: rms of the pixels' response, a fraction; an analytic calibration does not know of it."""
    delay_frames: float = Field(1.0, ge=1, le=3)
    """Frames from the one a command is made from to the first exposed wholly under it; 1 is the least."""
    instants: int = Field(8, ge=1, le=64)
    """Of the simulated camera: instants of each period over which the true wavefront is the mean. With 1 it is that of
    the instant at which the exposure starts, and so is the image, which is not blurred."""
    noise: bool = True
    """Photon and read noise; off only for tests of the control law."""
    photon_noise: Literal["fast", "exact"] = "fast"
    """Faint pixels from a table of their law (its variance is 6e-5 e-^2 too large at most), or every electron drawn."""


class Disturbance(Section):
    """The simulated disturbance: a function of the seed and of time."""

    preset: Preset = "bench"
    """quiet, bench, thermal, reaction-wheel, reaction-wheel-ideal (lines without a width), step or kolmogorov."""
    scale: NotNegative = 1.0
    """Multiplies the preset's amplitude."""
    line_width: float = Field(0.005, ge=0, le=0.05)
    """Of the reaction wheel's lines, between half-power points, as a fraction of their frequency."""
    static_nm: dict[str, float] = Field(default_factory=dict)
    """Constant wavefront added to it: Noll index = nm rms."""
    drift_nm: dict[str, float] = Field(default_factory=dict)
    """Random walk added to it, from 1e-4 to 10 Hz: Noll index = nm per root second."""
    drift_slope: float = Field(2.0, ge=0, le=4)
    """Power of frequency with which the drift's spectrum falls: drift_nm^2 / (2 pi^2 f^slope) per Hz; 2 for a walk."""
    jitter_mas: NotNegative = 0.0
    """Jitter too fast for the loop, mas rms per axis: white from half the frame rate to one and a half."""
    shear: float = Field(0.0, ge=0, le=0.05)
    """Slow wander of the beam on the sensor's masks, pupil diameters rms per axis; its effect to first order."""
    wheel_hz: NotNegative = 0.0
    """Speed of a reaction wheel at the start, turns per second; 0 for none. It shakes tip and tilt at its harmonics."""
    wheel_mas: NotNegative = 3.0
    """Of its first harmonic at high speed, mas rms per axis; the others are a half to a seventh."""
    wheel_course: Literal["ramp", "walk", "run-down"] = "ramp"
    """How its speed changes: evenly, at random, or as friction slows it."""
    wheel_change: float = 0.0
    """Of a ramp and, at its start, of a run-down Hz per second; of a walk Hz per root second; 0 for a steady wheel."""
    second_wheel_hz: float = 0.0
    """By which a second wheel of the same kind is faster at the start, so that the two beat; 0 for none."""

    @model_validator(mode="after")
    def _noll_indices(self) -> "Disturbance":
        for name in ("static_nm", "drift_nm"):
            for key in getattr(self, name):
                if not key.isdecimal() or int(key) < 2:
                    raise ValueError(f"{name}: {key!r} is not a Noll index of 2 or more")
        return self


IMPERFECTIONS = (
    *("disturbance.wheel_hz", "disturbance.drift_nm", "disturbance.jitter_mas", "disturbance.shear"),
    *("mirror.gain_error", "mirror.hysteresis", "mirror.creep"),
    *("camera.dark_current_e_s", "camera.hot_pixels", "camera.nonlinearity", "camera.nonuniformity"),
)
"""Keys by which the simulated world is less kind; each is off by default."""


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
    on_command_timeout: Literal["hold", "flat"] = "flat"
    """When the last command has expired: hold the shape, or relax to flat within the slew limit."""
    flat: str = ""
    """File (FITS or .npy) of the flat map, nm of surface, which is on the mirror from the start; empty for none."""
    active: str = ""
    """File (FITS or .npy) of the active actuators, 0 or 1: modes and flat map leave the others out; empty for all."""
    nm_per_unit: Positive = 1.0
    """For the mirror's driver: nm of surface that one unit of what it writes to the hardware makes."""
    shift_pitches: float = Field(0.0, ge=-2, le=2)
    """Of the simulated mirror: how far its actuators lie from where they are believed, along x and along y."""
    magnification: float = Field(1.0, ge=0.9, le=1.1)
    """Of the simulated mirror: its size in the pupil, of the one that is believed."""
    gain_error: float = Field(0.0, ge=0, le=0.5)
    """Of the simulated mirror: rms error of the actuators' gains, a fraction; from the seed."""
    hysteresis: float = Field(0.0, ge=0, le=0.5)
    """Of the simulated mirror: part of a move that turns back only after a play of 1 to 256 nm; 0.1 for a piezo."""
    creep: float = Field(0.0, ge=0, le=0.1)
    """Of the simulated mirror: part of a move that follows in each decade of time, 0.1 to 100 s; 0.01 for a piezo."""
