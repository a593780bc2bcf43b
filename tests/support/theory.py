"""Laws for tests, a loop that runs them, and a theory of the integrator independent of `lowfc.control.laws.margins`."""

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

from lowfc.arrays import Array
from lowfc.control.laws.integrator import Integrator
from lowfc.control.laws.linear_law import (
    LinearLaw,
    Signal,
    at_rest,
    integrator,
    integrator_block,
    law_from_blocks,
    predict_and_update,
    respond,
)
from lowfc.control.laws.pi_notch import Notch, pi_notch
from lowfc.control.laws.spectra import TimeSeries
from lowfc.control.laws.stability import delay_weights, open_loop
from lowfc.control.laws.vibration import Model
from sim_camera.disturbance import Disturbance, Sampler


def law_of(
    gain: npt.ArrayLike = 0.5, leak: npt.ArrayLike = 0.0, limit_nm: npt.ArrayLike = 1000.0, modes: int = 3
) -> Integrator:
    """An integrator; gain, leak and limit are each one value for all modes, or one for each mode."""
    return Integrator(*(np.broadcast_to(np.asarray(each, np.float32), (modes,)) for each in (gain, leak, limit_nm)))


def linear(
    law: Integrator, noll: tuple[int, ...] = (2, 3, 4), delay_frames: float = 1.0, rate_hz: float = 1e3
) -> LinearLaw:
    """An integrator as a linear law."""
    return integrator(law.gain, law.leak, noll, delay_frames, rate_hz)


def one_piece(values: Array) -> TimeSeries:
    """The values (frames, modes) as a time series without gaps."""
    return TimeSeries((values,), 0)


def rejection(frequency_hz: Array, rate_hz: float, gain: float, leak: float, delay_frames: float) -> Array:
    """|S|: amplitude of the true residual relative to that of the disturbance."""
    return np.abs(1 / (1 + open_loop(2 * np.pi * frequency_hz / rate_hz, gain, leak, delay_frames)))


def noise_transfer(frequency_hz: Array, rate_hz: float, gain: float, leak: float, delay_frames: float) -> Array:
    """|T|: amplitude of the true residual relative to that of the measurement noise."""
    loop = open_loop(2 * np.pi * frequency_hz / rate_hz, gain, leak, delay_frames)
    return np.abs(loop / (1 + loop))


def noise_gain(gain: float, leak: float, delay_frames: float) -> float:
    """Variance of the residual per variance of white measurement noise: the mean of |T|^2 over frequency."""
    cycles = (np.arange(1 << 14) + 0.5) / (1 << 15)
    return float(np.mean(noise_transfer(cycles, 1.0, gain, leak, delay_frames) ** 2))


def integrators(modes: Iterable[tuple[float, float]], signal: Signal, delay_frames: float) -> LinearLaw:
    """Integrators with these gains and leaks as a linear law of this signal, at 1 kHz."""
    blocks = [integrator_block(gain, leak, signal, delay_frames) for gain, leak in modes]
    return law_from_blocks(blocks, signal, "integrator", tuple(range(2, 2 + len(blocks))), delay_frames, 1000.0)


def run(law: LinearLaw, disturbance_nm: Array, delay_frames: float, limit_nm: float = np.inf) -> tuple[Array, Array]:
    """Errors and commands (frames, modes), nm, of a loop without noise; its delay may differ from the law's."""
    weights = delay_weights(delay_frames).astype(np.float32)
    assumed = delay_weights(law.delay_frames).astype(np.float32)
    history = np.zeros((max(len(weights), len(assumed)), disturbance_nm.shape[1]), np.float32)
    limit, x, errors, commands = np.float32(limit_nm), at_rest(law), [], []
    for disturbance in disturbance_nm.astype(np.float32):
        error = disturbance + weights.dot(history[: len(weights)])
        y = error - assumed.dot(history[: len(assumed)]) if law.signal == "pol" else error
        x = predict_and_update(law, x, y, history[0])
        history[1:] = history[:-1]
        history[0] = np.minimum(np.maximum(respond(law, x), -limit), limit)
        errors.append(error)
        commands.append(history[0].copy())
    return np.array(errors, float), np.array(commands, float)


def realised(model: Model, frames: int, seed: int = 0) -> Array:
    """Realisation (frames, 1), nm, of a model's disturbance plus its measurement noise."""
    rng = np.random.default_rng(seed)
    F, Q, C = model.states()
    root = np.linalg.svd(Q)
    steps = rng.standard_normal((frames, len(F))) @ (root.U * np.sqrt(root.S)).T
    x = np.zeros(len(F))
    for step in steps:
        x = step[:] = F.dot(x) + step
    return steps @ C[:, None] + np.sqrt(model.noise_nm2) * rng.standard_normal((frames, 1))


def modes_nm(disturbance: Disturbance, first: int, count: int, rate_hz: float) -> Array:
    """Modes (count, modes) of a disturbance, nm rms, at the starts of the exposures of frames from `first` on."""
    sampler = Sampler(disturbance, np.zeros(1), rate_hz)
    return np.array([sampler.at(index)[0] for index in range(first, first + count)], np.float64)


_GAIN, _ZERO = np.array([0.5, 0.3, 0.1]), np.zeros(3)
_NOTCHES = [(Notch(18, 8, 10), Notch(71, 8, 5))] * 3
LAWS = {
    "pi": pi_notch((2, 3, 4), _GAIN, _GAIN / 2, _ZERO, [()] * 3, 1.0, 1000.0),
    "notch": pi_notch((2, 3, 4), _GAIN, _ZERO, _ZERO, _NOTCHES, 1.0, 1000.0),
}
"""Laws for three modes and a delay of one frame, at 1 kHz."""
