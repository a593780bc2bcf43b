"""The simulated loop with a linear sensor instead of diffraction: its measured modes have noise of a given covariance.

The live loop's own `advance` receives frames of a few pixels that encode the measured modes, so that hours can be
simulated. Not included: the sensor's nonlinearity, the mirror's print-through and DAC quantisation.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from lowfc.arrays import Array, Pixels, Single
from lowfc.contract.configuration import Configuration
from lowfc.control.calibration.calibration import Calibration
from lowfc.control.laws.stability import delay_weights
from lowfc.control.loop.inputs import Load
from lowfc.programs.core.gain_watch import GainWatch
from sim_camera.disturbance import BLOCK, Disturbance, Sampler
from sim_camera.driver import disturbance_of
from sim_camera.scene import GAUSS_LEGENDRE
from tools.law_bench import Bench, with_lines_moved

_LEVEL_DN, _DN_PER_NM = 32_000.0, 80.0
_TRUTH_SAMPLES = (np.arange(8) + 0.5) / 8
_NOISE_BLOCK = 1024


def _differential_calibration(noll: tuple[int, ...]) -> Calibration:
    """A sensor with two pixels for each mode, of opposite response, and a mirror with one actuator for each."""
    modes = len(noll)
    flux_dn, pixels = 2 * modes * _LEVEL_DN, 2 * modes
    H = np.vstack([np.eye(modes), -np.eye(modes)]) * _DN_PER_NM / flux_dn
    single: dict[str, Any] = {
        "reference": np.full(pixels, 1 / pixels),
        "response": H,
        "reconstructor": np.linalg.pinv(H),
        "good": np.ones(pixels),
        "dark": np.zeros(pixels),
        "modes_to_actuators": np.eye(modes) / 2,
        "actuators_to_modes": 2 * np.eye(modes),
    }
    single = {name: array.astype(np.float32) for name, array in single.items()}
    return Calibration(
        noll=noll,
        **single,
        shape=(2, modes),
        grid=(modes, 1),
        flux_dn=flux_dn,
        saturation_dn=65_535.0,
        estimator="weighted",
        wavelength_nm=550.0,
        operator_hash="",
        id="modal",
    )


class ModalBench(Bench):
    """A modal loop in one process; it records steps and true residuals since `new_record`."""

    def __init__(
        self,
        config: Configuration,
        covariance_nm2: Array,
        disturbance: Disturbance | None = None,
        *,
        watch: bool = True,
    ) -> None:
        """Build the loop.

        Args:
            config: configuration of the controller and of the simulation.
            covariance_nm2: (modes, modes) of the measurement noise.
            disturbance: replaces the configuration's.
            watch: whether to run the gain watch, which takes a third of the time.
        """
        self._begin(config, Load(0, _differential_calibration(config.noll), "bench"))
        self.watch = GainWatch(self.settings, config.control.on_harm) if watch else None
        self._disturbance = disturbance_of(config) if disturbance is None else disturbance
        self._sampler = self._new_sampler()
        self._mix = np.linalg.cholesky(covariance_nm2).T.astype(np.float32)
        self._noise = np.random.Generator(np.random.SFC64(np.random.SeedSequence([config.seed, 3])))
        self._weights = delay_weights(config.camera.delay_frames).astype(np.float32)
        self._mirror_shapes_nm = [np.zeros(len(config.noll), np.float32)] * len(self._weights)

    def new_record(self) -> None:
        """Begin a new record."""
        super().new_record()
        self._squares: list[Single] = []

    def _new_sampler(self) -> Sampler:
        instants = np.concatenate([self.config.camera.exposure_fraction * GAUSS_LEGENDRE, _TRUTH_SAMPLES])
        return Sampler(self._disturbance, instants, self.config.camera.rate_hz)

    def move_lines(self, factor: float) -> None:
        """Scale the reaction wheel's frequencies from now on, continuous in phase, at a multiple of BLOCK frames."""
        if self._index % BLOCK:
            raise ValueError(f"lines can move only at a frame that is a multiple of {BLOCK}, not at {self._index}")
        moved = with_lines_moved(self._disturbance, factor)
        phase_cycles = (self._disturbance.frequency_hz - moved.frequency_hz) * self._index / self.config.camera.rate_hz
        amplitude_nm = self._disturbance.amplitude_nm * np.exp(2j * np.pi * phase_cycles)[:, None]
        self._disturbance = replace(moved, amplitude_nm=amplitude_nm)
        before, self._sampler = self._sampler, self._new_sampler()
        old_lines, new_lines = vars(before)["_lines"], vars(self._sampler)["_lines"]
        if new_lines is not None:  # damped lines keep their state
            for name in ("_rng", "_next", "_vector"):
                setattr(new_lines, name, getattr(old_lines, name))

    def run(self, frames: int, *, record: bool = True) -> None:
        """Expose, control, move the mirror; events are always recorded."""
        noise_nm = np.zeros((0, 0), np.float32)
        for count in range(frames):
            if not count % _NOISE_BLOCK:
                noise_nm = self._noise.standard_normal((_NOISE_BLOCK, len(self._mix)), np.float32) @ self._mix
            mirror_nm: Any = sum(
                weight * past for weight, past in zip(self._weights, self._mirror_shapes_nm, strict=True)
            )
            modes_nm = self._sampler.at(self._index)
            pixels = _encoded((modes_nm[0] + modes_nm[1]) / 2 + mirror_nm + noise_nm[count % _NOISE_BLOCK])
            self._index += 1
            outputs = self.process_input(self.frame(pixels))
            newest_nm = self._mirror_shapes_nm[0]
            if outputs.command is not None:
                newest_nm = 2 * outputs.command.actuators_nm.ravel()
            self._mirror_shapes_nm = [newest_nm, *self._mirror_shapes_nm[:-1]]
            if self._record_and_watch(outputs, record):
                self._squares.append(np.square(modes_nm[2:] + mirror_nm).sum(axis=0) / len(_TRUTH_SAMPLES))

    def residual_nm(self, *, continuous: bool = True) -> Array:
        """True residual (frames, modes) of the record, rms over each period; ValueError if not `continuous`."""
        if not continuous:
            raise ValueError("a modal bench records only the rms over each frame period")
        return np.sqrt(np.array(self._squares, np.float64))


def _encoded(modes_nm: Single) -> Pixels:
    change_dn = _DN_PER_NM * modes_nm
    pixels = np.rint(_LEVEL_DN + np.array([change_dn, -change_dn]))
    return np.asarray(np.clip(pixels, 0, 65_534), dtype=np.uint16)
