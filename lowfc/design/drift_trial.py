"""A loop on simulated images whose modes drift: what it leaves, to check `lowfc.design.tolerance` by."""

from dataclasses import dataclass

import numpy as np

from lowfc.arrays import Array
from lowfc.control.calibration.calibration import normalise_flux, reconstructor
from lowfc.design.trials import noisy_e
from lowfc.optics.chain.zernike import zernikes
from lowfc.optics.twin.twin import Evaluator, Twin, node_radii, reference, response

_SEEN = np.array([0.5 - 0.5 / np.sqrt(3.0), 0.5 + 0.5 / np.sqrt(3.0)])  # instants of an exposure
_INSTANTS = (np.arange(8) + 0.5) / 8  # of a period
_SETTLED = 8.0  # time constants of the slowest mode that do not count


@dataclass(frozen=True, eq=False)
class DriftTrial:
    """A sensor, a star and a loop.

    Attributes:
        twin: of the sensor.
        noll: of the modes that are fitted.
        light_e: electrons of the open circle's light in an exposure.
        read_noise_e: of a pixel.
        exposure: of the period.
    """

    twin: Twin
    noll: tuple[int, ...]
    light_e: float
    read_noise_e: float
    exposure: float

    def left_nm2(self, step_nm2: Array, gain: Array, frames: int, rng: np.random.Generator) -> Array:
        """Mean square (modes,) over all time of what integrators leave.

        Args:
            step_nm2: (modes,) variance of each mode's step in a frame, nm^2.
            gain: (modes,) of the integrators; 0 for a mode that stays.
            frames: That count.
            rng: Source of all randomness.
        """
        basis = zernikes(self.noll, *node_radii(self.twin))
        I0, H = reference(self.twin).ravel(), response(self.twin, basis)
        good = np.ones(I0.size)
        seen, slopes = normalise_flux(I0, H, good)
        R = reconstructor(seen, slopes, good, self.light_e * float(I0.sum()), self.read_noise_e, "weighted")
        evaluator, on_nodes = Evaluator(self.twin), basis.astype(np.float32)
        times = np.concatenate([self.exposure * _SEEN, _INSTANTS, [1.0]])
        order = np.argsort(times, kind="stable")
        lengths = np.diff(times[order], prepend=0.0)
        first = int(np.ceil(_SETTLED / gain[gain > 0].min()))
        start, command, squares = np.zeros(len(gain)), np.zeros(len(gain)), np.zeros(len(gain))
        moves = np.sqrt(lengths[:, None] * step_nm2)
        for frame in range(first + frames):
            path = np.empty((len(times), len(gain)))
            path[order] = start + np.cumsum(moves * rng.standard_normal(path.shape), axis=0)
            left = path + command
            opds = left[: len(_SEEN)].astype(np.float32) @ on_nodes
            mean = np.mean([evaluator.image(opd).copy() for opd in opds], axis=0).ravel()  # it overwrites its image
            image = noisy_e(rng, mean * self.light_e, self.read_noise_e)
            if frame >= first:
                squares += np.square(left[len(_SEEN) : -1]).mean(axis=0)
            command = command - gain * (R @ (image / image.sum() - seen))
            start = path[-1]
        return squares / frames
