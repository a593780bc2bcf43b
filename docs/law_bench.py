"""The simulated loop without processes, law after law: sensor images, the live loop's own `advance`, true residuals."""

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from lowfc.adapters import instrument
from lowfc.contract.configuration import Configuration, load, sensor_keys
from lowfc.control.calibration import Calibration
from lowfc.control.inputs import Frame, Load, Request
from lowfc.control.linear_law import LinearLaw
from lowfc.control.loop import advance
from lowfc.control.safety import LoopMode
from lowfc.control.spectra import Pieces
from lowfc.control.stability import delay_weights
from lowfc.control.state import State
from lowfc.optics.photometry import tilt_nm_per_mas
from sim_camera.bench import Bench as Scene
from sim_camera.disturbance import LINES_HZ, Disturbance
from sim_camera.process import disturbance_of

Array = npt.NDArray[np.float64]

RATE_HZ = 1000.0


def configured(
    sensor: str = "sam27d10_bal14", seed: int = 1, delay_frames: float = 1.0, **changed: Any
) -> Configuration:
    """The reaction wheel's 14 mas rms per axis before a star of V = 0, at 1 kHz; `changed` are more keys."""
    keys: dict[str, Any] = {f"sensor.{key}": value for key, value in sensor_keys(sensor).items()}
    keys |= {"camera.rate_hz": RATE_HZ, "camera.delay_frames": delay_frames, "star.magnitude": 0.0, "seed": seed}
    return load(None, keys | {"disturbance.preset": "reaction-wheel"} | changed)


def calibrated(config: Configuration) -> Calibration:
    """The analytic calibration of a configuration."""
    optics = instrument.twin(config, None, print)
    return instrument.analytic_calibration(config, optics, instrument.mirror_on_twin(config, optics, print))


def with_lines_moved(shaken: Disturbance, factor: float) -> Disturbance:
    """The same disturbance with its lines at other frequencies."""
    lines = np.isin(shaken.frequency_hz, LINES_HZ)
    return replace(shaken, frequency_hz=np.where(lines, factor * shaken.frequency_hz, shaken.frequency_hz))


class Bench:
    """A loop that begins open, its mirror flat; what it did is kept until `forget`.

    Attributes:
        noll: Noll index of each mode.
        nm_per_mas: of tilt.
        refused: frames that the controller did not use.
    """

    def __init__(self, config: Configuration, calibration: Calibration, shaken: Disturbance | None = None) -> None:
        """Build the optics; `shaken` is another disturbance than the configuration's."""
        self._config = config
        optics = instrument.twin(config, None, print)
        self._scene = Scene(
            optics,
            instrument.mirror_on_twin(config, optics, print),
            instrument.detector(config),
            instrument.electrons_per_exposure(config),
            disturbance_of(config) if shaken is None else shaken,
            config.camera.rate_hz,
            config.seed,
        )
        settings = replace(instrument.settings(config), start_mode=LoopMode.OPEN)
        self._settings = settings
        self._state = advance(settings, State(), Load(0, calibration, "bench"))[0]
        weights = delay_weights(config.camera.delay_frames).astype(np.float32)
        self._weights = weights
        self._shapes = [np.zeros(calibration.grid, np.float32)] * len(weights)
        self._index = 0
        self.noll = calibration.noll
        self.nm_per_mas = tilt_nm_per_mas(config.star.diameter_m)
        self.refused = 0
        self.forget()

    def forget(self) -> None:
        """Begin a new record."""
        self._pol: list[npt.NDArray[np.float32]] = []
        self._true: list[npt.NDArray[np.float32]] = []

    def ask(self, name: str, **fields: Any) -> None:
        """An operator's request; ValueError where it is refused."""
        request = Request(self._index * self._config.period_ns, name, **fields)
        self._state, outputs = advance(self._settings, self._state, request)
        if outputs.reply is None or not outputs.reply.accepted:
            raise ValueError(f"{name}: {outputs.reply}")

    def load(self, law: LinearLaw) -> None:
        """Let a law drive the mirror."""
        self.ask("law", law=law)

    def run(self, frames: int) -> None:
        """Expose, control, move the mirror."""
        for _ in range(frames):
            seen = np.tensordot(self._weights, np.array(self._shapes), 1)
            pixels, truth = self._scene.expose(self._index, seen)
            frame = Frame((1 << 32) + self._index + 1, 10**18 + self._index * self._config.period_ns, 0, pixels)
            self._state, outputs = advance(self._settings, self._state, frame)
            self._index += 1
            if outputs.step is not None and outputs.step.pol_nm is not None:
                self._pol.append(outputs.step.pol_nm)
                self._true.append(truth.residual_nm)
            else:
                self.refused += 1
            shape = outputs.command.actuators_nm if outputs.command is not None else self._shapes[0]
            self._shapes = [shape, *self._shapes[:-1]]

    def pol(self) -> Pieces:
        """Pseudo-open-loop modes (frames, modes) of the record."""
        return Pieces((np.array(self._pol, np.float64),), 0)

    def residual_nm(self) -> Array:
        """True residual (frames, modes) of the record."""
        return np.array(self._true, np.float64)

    def tilt_mas(self, last: int) -> float:
        """True tilt, rms per axis over the last frames."""
        return float(np.sqrt(np.mean(self.residual_nm()[-last:, :2] ** 2)) / self.nm_per_mas)
