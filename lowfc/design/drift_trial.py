"""Simulation of integrators on noisy images of a drifting wavefront, to check `lowfc.design.tolerance`."""

import numpy as np

from lowfc.arrays import Array
from lowfc.control.calibration.calibration import normalise_flux, reconstructor
from lowfc.design.trials import noisy_e
from lowfc.optics.chain.zernike import NOLLS_14, zernikes
from lowfc.optics.twin.twin import Evaluator, Twin, node_radii, reference, response

_INSTANTS = 0.5 + np.array([-0.5, 0.5]) / np.sqrt(3.0)  # instants of an exposure (Gauss-Legendre), in exposure times
_SAMPLE_TIMES = (np.arange(8) + 0.5) / 8  # times at which the residual is sampled, in frame periods
_SETTLING_TIME_CONSTANTS = 8.0  # time in which the loop settles, in time constants of its slowest mode


def simulated_residual_nm2(
    twin: Twin,
    light_e: float,
    read_noise_e: float,
    exposure: float,
    step_nm2: Array,
    gain: Array,
    frames: int,
    rng: np.random.Generator,
) -> Array:
    """Residual variance (14,), nm^2, of a simulated loop with a delay of one frame, averaged over each frame period.

    Args:
        twin: Twin of the sensor.
        light_e: Electrons per exposure of the light through the open circle.
        read_noise_e: Read noise of a pixel, electrons.
        exposure: Exposure time, in frame periods.
        step_nm2: (14,) variance of each mode's step in a frame, nm^2.
        gain: (14,) gains of the integrators; 0 for a mode that is not controlled; at least one is above 0.
        frames: Number of frames over which the residual is averaged, after those in which the loop settles.
        rng: Generator of all random numbers.
    """
    basis = zernikes(NOLLS_14, *node_radii(twin))
    I0, H = reference(twin).ravel(), response(twin, basis)
    good = np.ones(I0.size)
    normalised_I0, normalised_H = normalise_flux(I0, H, good)
    R = reconstructor(normalised_I0, normalised_H, good, light_e * float(I0.sum()), read_noise_e, "weighted")
    evaluator, on_nodes = Evaluator(twin), basis.astype(np.float32)
    times = np.concatenate([exposure * _INSTANTS, _SAMPLE_TIMES, [1.0]])
    order = np.argsort(times, kind="stable")
    lengths = np.diff(times[order], prepend=0.0)
    settling = int(np.ceil(_SETTLING_TIME_CONSTANTS / gain[gain > 0].min()))
    start, command, squares = np.zeros(len(gain)), np.zeros(len(gain)), np.zeros(len(gain))
    moves = np.sqrt(lengths[:, None] * step_nm2)
    for frame in range(settling + frames):
        path = np.empty((len(times), len(gain)))
        path[order] = start + np.cumsum(moves * rng.standard_normal(path.shape), axis=0)
        residual = path + command
        opds = residual[: len(_INSTANTS)].astype(np.float32) @ on_nodes
        image = noisy_e(rng, evaluator.image(opds).ravel() * (light_e / len(opds)), read_noise_e)
        if frame >= settling:
            squares += np.square(residual[len(_INSTANTS) : -1]).mean(axis=0)
        command = command - gain * (R @ (image / image.sum() - normalised_I0))
        start = path[-1]
    return squares / frames
