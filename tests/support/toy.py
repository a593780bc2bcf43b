"""A small, exactly linear sensor and mirror without diffraction, for tests of the control law."""

from collections.abc import Container

import numpy as np
import numpy.typing as npt

from lowfc.arrays import Array, Pixels
from lowfc.control.calibration.calibration import Calibration, normalise_flux, reconstructor
from lowfc.control.laws.stability import delay_weights
from lowfc.control.loop.advance import advance
from lowfc.control.loop.camera import CameraSettings
from lowfc.control.loop.inputs import Frame, Input, Load, Outputs, Step
from lowfc.control.loop.safety import Limits, LoopMode
from lowfc.control.loop.state import Settings, State

SHAPE, GRID, NOLL = (6, 7), (4, 5), (2, 3, 4)  # pixels, actuators, modes
FLUX_DN, DARK_DN, SATURATION_DN = 200_000.0, 100.0, 60_000.0
START = 1_700_000_000  # start of every process, s since 1970
PERIOD_NS = 1_000_000
WAVE_NM = (10.0, -5.0, 3.0)  # modes of a wavefront, nm
# Clock-induced charge and dark current lift the dark above the bias.
CAMERA = CameraSettings(0, SHAPE, DARK_DN - 40, SATURATION_DN, 1.0, 1.0, 3.0, start_s=START)


def frame_sequence(count: int, start: int = START) -> int:
    return start << 32 | count


class Toy:
    """Reference image (pixels,) and response (pixels, modes) before normalisation, and modes to actuators."""

    def __init__(self) -> None:
        rng = np.random.default_rng(11)
        count = SHAPE[0] * SHAPE[1]
        self.reference = rng.uniform(0.5, 1.5, count)
        self.response = 0.002 * rng.standard_normal((count, len(NOLL)))
        self.response -= self.response.mean(axis=0)  # the flux stays the same, so that the sensor is linear
        y, x = np.meshgrid(np.linspace(-1, 1, GRID[0]), np.linspace(-1, 1, GRID[1]), indexing="ij")
        self.modes_to_actuators = np.stack([x, y, x**2 + y**2 - 1]).reshape(len(NOLL), -1).T / 2

    def pixels(self, modes_nm: npt.ArrayLike, flux_dn: float = FLUX_DN) -> Pixels:
        """Frame (rows, columns) of a wavefront, exactly linear up to the rounding to DN."""
        image = self.reference + self.response.dot(np.asarray(modes_nm, float))
        return np.rint(DARK_DN + flux_dn * image.reshape(SHAPE) / self.reference.sum()).astype(np.uint16)


TOY = Toy()


def calibration(noll: tuple[int, ...] = NOLL, scale: float = 1.0) -> Calibration:
    """Calibration of the toy with some of its modes; another `scale` of the response makes another calibration."""
    good = np.ones(SHAPE[0] * SHAPE[1])
    chosen = [NOLL.index(index) for index in noll]
    I0, H = normalise_flux(TOY.reference, TOY.response[:, chosen] * scale, good)
    R = reconstructor(I0, H, good, FLUX_DN, 1.0)
    return Calibration(
        noll=noll,
        reference=I0.astype(np.float32),
        response=H.astype(np.float32),
        reconstructor=R.astype(np.float32),
        good=good.astype(np.float32),
        dark=np.full(good.size, DARK_DN, np.float32),
        modes_to_actuators=TOY.modes_to_actuators[:, chosen].astype(np.float32),
        shape=SHAPE,
        grid=GRID,
        flux_dn=FLUX_DN,
        saturation_dn=SATURATION_DN,
        estimator="weighted",
        wavelength_nm=550.0,
        operator_hash="",
        id="toy",
    )


def settings(**changes: object) -> Settings:
    defaults: dict[str, object] = {
        "limits": Limits(700.0, 100.0, 400.0),
        "delay_frames": 1.0,
        "start_mode": LoopMode.CLOSED,
        "max_frame_age_ns": 20_000_000,
        "frame_timeout_ns": 50_000_000,
        "on_frame_timeout": "hold",
        "min_flux_fraction": 0.2,
        "max_saturated_pixels": 8,
        "gain": (0.5, 0.3),
        "leak": (0.0, 0.0),
        "limit_nm": (150.0, 50.0),
    }
    return Settings(**(defaults | changes))


def loaded(settings: Settings) -> State:
    """State of a controller that has loaded the toy's calibration."""
    return advance(settings, State(), Load(0, calibration(), "test"))[0]


def frame(count: int, modes_nm: npt.ArrayLike = (0, 0, 0), **changes: object) -> Frame:
    defaults: dict[str, object] = {
        "sequence": frame_sequence(count),
        "time_ns": START * 10**9 + count * PERIOD_NS,
        "age_ns": 100_000,
        "pixels": TOY.pixels(modes_nm),
    }
    return Frame(**(defaults | changes))


def feed(settings: Settings, state: State, *inputs: Input) -> tuple[State, list[Outputs]]:
    """State after these inputs, and the outputs of each."""
    all_outputs = []
    for input_ in inputs:
        state, outputs = advance(settings, state, input_)
        all_outputs.append(outputs)
    return state, all_outputs


def running(setup: Settings | None = None, frames: int = 5) -> State:
    """State of a closed loop after frames of the wavefront `WAVE_NM`; the mirror is not flat."""
    setup = setup or settings()
    return feed(setup, loaded(setup), *(frame(count, WAVE_NM) for count in range(1, frames + 1)))[0]


def names(all_outputs: list[Outputs]) -> list[str]:
    """Names of all events of these outputs."""
    return [event.name for outputs in all_outputs for event in outputs.events]


def check_reply(outputs: Outputs, accepted: bool, *texts: str) -> None:
    """Assert that a request was accepted or refused with a reply that contains these texts."""
    assert outputs.reply.accepted is accepted, outputs.reply.text
    for text in texts:
        assert text in outputs.reply.text


def run_toy(
    settings: Settings,
    disturbance_nm: Array,
    noise_nm: npt.ArrayLike = 0.0,
    state: State | None = None,
    first: int = 1,
    missing: Container[int] = (),
    dark: Container[int] = (),
) -> tuple[list[Step], Array, State]:
    """Run the loop; return its steps, the residual (frames, modes) in each exposure, and the final state.

    Args:
        settings: settings of the controller.
        disturbance_nm: (frames, modes) disturbance, nm rms of wavefront.
        noise_nm: measurement noise, added to the residual.
        state: initial state; that of `loaded` when None.
        first: number of the first frame.
        missing: indices of exposures whose frames do not arrive, from 0.
        dark: indices of exposures without light.
    """
    state = loaded(settings) if state is None else state
    weights, to_modes = delay_weights(settings.delay_frames), np.linalg.pinv(TOY.modes_to_actuators)
    commanded = [np.zeros(len(NOLL))] * len(weights)
    noise_nm = np.broadcast_to(noise_nm, disturbance_nm.shape)
    steps, residual_nm = [], np.empty(disturbance_nm.shape)
    for count, wave_nm in enumerate(disturbance_nm):
        residual_nm[count] = wave_nm + sum(weight * past for weight, past in zip(weights, commanded, strict=True))
        newest = commanded[0]
        if count not in missing:
            light = {"pixels": TOY.pixels((0, 0, 0), flux_dn=0)} if count in dark else {}
            state, outputs = advance(
                settings, state, frame(first + count, residual_nm[count] + noise_nm[count], **light)
            )
            assert outputs.step is not None
            steps.append(outputs.step)
            if outputs.command is not None:
                newest = to_modes.dot(outputs.command.actuators_nm.reshape(-1))
        commanded = [newest, *commanded[:-1]]
    return steps, residual_nm, state
