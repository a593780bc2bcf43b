"""The best law for a log: integrator gains after Gendron and Lena, PI with notches, LQG, each with its margins.

All start from pseudo-open-loop modes, pol = disturbance + white noise. A loop leaves error = S pol, and since a frame's
noise is not in the command that it sees, the true residual has the variance of the error less the noise's.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.signal import periodogram

from lowfc.arrays import Array
from lowfc.control.laws import margins
from lowfc.control.laws.kalman import lqg_block
from lowfc.control.laws.linear_law import Block, LinearLaw, integrator, integrator_block, of_blocks
from lowfc.control.laws.pi_notch import Notch, pi_notch
from lowfc.control.laws.spectra import Pieces, Spectrum, floor_nm2_hz, spectrum
from lowfc.control.laws.stability import (
    LEAST_GAIN_MARGIN,
    LEAST_PHASE_MARGIN_DEG,
    LOWEST_GAIN,
    delay_weights,
    highest_gain,
    open_loop,
)
from lowfc.control.laws.vibration import FEWEST, Model, identify, resolution_hz
from lowfc.control.laws.what_if import counterfactual, driven_by

_NARROWER = (0.1, 0.01, 1e-3)  # what a line's width is tried at, of that fitted, where a log cannot resolve it
_FASTER = (10.0,)  # and where lines move
_SETTLING_FRAMES = 5000
_QUIETER = 2.0 ** np.arange(8)  # by which noise is overestimated, until the margins hold


@dataclass(frozen=True, slots=True)
class Tuned:
    """A law for each mode, and what it leaves.

    Attributes:
        law: as it would be loaded.
        margins: for the delay it was made for.
        predicted_nm: (modes,) rms of the true residual.
        kinds: of each mode: integrator, pi-notch or lqg.
        models: of each mode.
    """

    law: LinearLaw
    margins: margins.Margins
    predicted_nm: Array
    kinds: tuple[str, ...]
    models: tuple[Model, ...]


@dataclass(frozen=True, slots=True)
class Gains:
    """Integrator gains (modes,): the best ones, what they leave (nm rms) and one frame's noise (nm rms)."""

    gain: Array
    predicted_nm: Array
    noise_nm: Array


def best_gains(run: Pieces, rate_hz: float, delay_frames: float, leak: Array) -> Gains:
    """The gain of each mode at which an integrator leaves least of pseudo-open-loop modes (Gendron and Lena 1994).

    Args:
        run: (frames, modes) in pieces.
        rate_hz: Frame rate.
        delay_frames: The true delay.
        leak: (modes,) of the integrators.

    Raises:
        ValueError: there are too few frames in a row.
    """
    fine, coarse = _whole_spectrum(run, rate_hz), spectrum(run, rate_hz)
    if fine is None or coarse is None:
        longest = max((len(piece) for piece in run.values), default=0)
        raise ValueError(f"a law is tuned from at least {FEWEST} frames in a row, the longest run has {longest}")
    noise_nm2 = floor_nm2_hz(coarse) * rate_hz / 2
    gains, left_nm2 = np.zeros(len(leak)), np.zeros(len(leak))
    for mode, lost in enumerate(leak.tolist()):
        power = fine.power_nm2_hz[1:, mode]  # an integrator without leak has no value at 0 Hz

        def error_nm2(gain: float, lost: float = lost, power: Array = power) -> float:
            loop = open_loop(2 * np.pi * fine.frequency_hz[1:] / rate_hz, gain, lost, delay_frames)
            return float(power @ np.abs(1 / (1 + loop)) ** 2) * fine.spacing_hz

        bounds = (LOWEST_GAIN, highest_gain(delay_frames, lost))
        found = minimize_scalar(error_nm2, bounds=bounds, method="bounded", options={"xatol": 1e-3})
        gains[mode], left_nm2[mode] = found.x, found.fun - noise_nm2[mode]
    return Gains(gains, np.sqrt(np.maximum(left_nm2, 0.0)), np.sqrt(noise_nm2))


def identified(run: Pieces, rate_hz: float) -> list[Model]:
    """A model of each mode of pseudo-open-loop modes (frames, modes).

    Raises:
        ValueError: there are too few frames in a row.
    """
    found = []
    for mode in range(run.values[0].shape[1] if run.values else 0):
        model = identify(run.columns(slice(mode, mode + 1)), rate_hz)
        if model is None:
            raise ValueError(f"a model is fitted to at least {FEWEST} frames in a row, there are fewer")
        found.append(model)
    return found


def tune_integrator(models: Sequence[Model], gains: Gains, noll: tuple[int, ...], leak: Array, delay: float) -> Tuned:
    """The loop's own integrator with these gains."""
    law = integrator(gains.gain, leak, noll, delay, models[0].rate_hz)
    return _tuned(law, delay, predicted_nm(law, models, delay), ("integrator",) * len(noll), models)


def tune_lqg(
    run: Pieces, models: Sequence[Model], gains: Gains, noll: tuple[int, ...], leak: Array, delay: float
) -> Tuned:
    """LQG for the modes for which it beats the best integrator on this very run, that integrator for the others.

    The run decides, too, how narrow lines are that are narrower than a spectrum tells, and how fast they move.

    Raises:
        ValueError: no filter, or an unstable law.
    """
    rate_hz, finest_hz = models[0].rate_hz, resolution_hz(run, models[0].rate_hz)

    def law_of(blocks: Sequence[Block]) -> LinearLaw:
        return of_blocks(blocks, "pol", "lqg", noll, delay, rate_hz)

    scaled = ([_scaled(model, factor, finest_hz) for model in models] for factor in (*_NARROWER, *_FASTER))
    tried = [models, *scaled]
    robust = [[_within_margins(model, delay) for model in candidates] for candidates in tried]
    steady = [integrator_block(g, lost, "pol", delay) for g, lost in zip(gains.gain, leak, strict=True)]
    error_nm2 = np.nan_to_num([left_of(law_of(blocks), run, delay) for blocks in robust], nan=np.inf)
    best = error_nm2.argmin(axis=0)
    wins = error_nm2.min(axis=0) < left_of(law_of(steady), run, delay)
    modes = range(len(noll))
    chosen = [tried[best[mode]][mode] for mode in modes]
    law = law_of([robust[best[mode]][mode] if wins[mode] else steady[mode] for mode in modes])
    kinds = ["lqg" if better else "integrator" for better in wins]
    return _tuned(law, delay, predicted_nm(law, chosen, delay), kinds, chosen)


def tune_pi_notch(models: Sequence[Model], gains: Gains, noll: tuple[int, ...], leak: Array, delay: float) -> Tuned:
    """An integrator with a notch for each line that one makes smaller within the margins, the strongest line first."""
    rate_hz = models[0].rate_hz
    found = [_notched(*mode, delay) for mode in zip(models, gains.gain.tolist(), leak.tolist(), strict=True)]
    gain, notches = np.array([g for g, _ in found]), [of_mode for _, of_mode in found]
    law = pi_notch(noll, gain, np.zeros(len(noll)), leak, notches, delay, rate_hz)
    kinds = ["pi-notch" if of_mode else "integrator" for of_mode in notches]
    return _tuned(law, delay, predicted_nm(law, models, delay), kinds, models)


def _notched(model: Model, gain: float, leak: float, delay: float) -> tuple[float, tuple[Notch, ...]]:
    """Gain and notches of one mode."""

    def made(notches: Sequence[Notch], g: float) -> LinearLaw:
        return pi_notch((2,), np.array([g]), np.zeros(1), np.array([leak]), [notches], delay, model.rate_hz)

    tried: list[tuple[float, float, tuple[Notch, ...]]] = []
    for share in (1.0, 0.7, 0.5, 0.35):  # less gain leaves room for notches
        g, notches = share * gain, tuple[Notch, ...]()
        least = float(predicted_nm(made(notches, g), [model], delay)[0])
        for line in sorted(model.lines, key=lambda line: -line.variance_nm2):
            width_hz = min(max(4 * line.width_hz, 0.2 * line.frequency_hz), 0.02 * model.rate_hz)
            for depth in (30.0, 10.0, 4.0):
                more = (*notches, Notch(line.frequency_hz, width_hz, depth))
                law = made(more, g)
                left = float(predicted_nm(law, [model], delay)[0])
                if left < least and _holds(margins.margins(law, delay)):
                    notches, least = more, left
                    break
        tried.append((least, g, notches))
    _, g, notches = min(tried, key=lambda one: one[0])
    return g, notches


def _tuned(law: LinearLaw, delay: float, predicted: Array, kinds: Sequence[str], models: Sequence[Model]) -> Tuned:
    margins.check_stable(law, delay)
    return Tuned(law, margins.margins(law, delay), predicted, tuple(kinds), tuple(models))


def predicted_nm(law: LinearLaw, models: Sequence[Model], delay_frames: float) -> Array:
    """Rms (modes,) of the true residual of modes with these models: |S|^2 of the disturbance and |T|^2 of the noise."""
    found = np.zeros(len(models))
    for mode, model in enumerate(models):
        omega = _fine_frequencies(model)
        hz = omega * model.rate_hz / (2 * np.pi)
        S = margins.rejection(law, hz, delay_frames)[:, mode] ** 2
        T = margins.noise_transfer(law, hz, delay_frames)[:, mode] ** 2
        power = S * model.spectrum_nm2(omega) + T * model.noise_nm2
        found[mode] = np.trapezoid(power, omega) / np.pi
    return np.sqrt(found)


def left_of(law: LinearLaw, run: Pieces, delay_frames: float) -> Array:
    """Mean square (modes,) of the measured error that a law would have left of pseudo-open-loop modes (frames, modes).

    Every piece begins with a law at rest and a flat mirror; the frames until it has settled do not count.
    """
    weights = delay_weights(delay_frames).astype(np.float32)
    squares, frames = np.zeros(len(law.noll)), 0
    for piece in run.values:
        skipped = min(_SETTLING_FRAMES, len(piece) // 3)
        every = np.zeros(len(piece), np.int64)
        errors = counterfactual(driven_by(law), weights, piece.astype(np.float32), every)[0][skipped:]
        squares += np.sum(errors.astype(np.float64) ** 2, axis=0)
        frames += len(errors)
    return squares / max(frames, 1)


def _whole_spectrum(run: Pieces, rate_hz: float) -> Spectrum | None:
    """The periodogram of the longest piece: coarse segments would lose a slow mode's drift."""
    longest = max(run.values, key=len, default=None)
    if longest is None or len(longest) < FEWEST:
        return None
    frequency_hz, power = periodogram(longest, rate_hz, "hann", detrend="constant", axis=0)
    return Spectrum(frequency_hz, power, 1)


def _scaled(model: Model, factor: float, finest_hz: float) -> Model:
    lines = (
        replace(line, width_hz=factor * line.width_hz) if line.width_hz < 3 * finest_hz else line
        for line in model.lines
    )
    return replace(model, lines=tuple(lines))


def _within_margins(model: Model, delay_frames: float) -> Block:
    """The filter of a model, its noise taken for higher until the margins hold."""
    for factor in _QUIETER.tolist():
        block = lqg_block(replace(model, noise_nm2=factor * model.noise_nm2), delay_frames)
        law = of_blocks([block], "pol", "lqg", (2,), delay_frames, model.rate_hz)  # or any other mode
        if _holds(margins.margins(law, delay_frames)):
            break
    return block


def _holds(found: margins.Margins) -> bool:
    return bool(
        found.stable
        and found.gain_margin.min() >= LEAST_GAIN_MARGIN
        and found.gain_reduction.max() <= 1 / LEAST_GAIN_MARGIN
        and found.phase_margin_deg.min() >= 0.7 * LEAST_PHASE_MARGIN_DEG
    )


def _fine_frequencies(model: Model) -> Array:
    """Rad per frame from nearly 0 to pi, ascending, densely around each line."""
    apart = np.geomspace(1e-3, 1e4, 120)
    grids = [np.linspace(0, np.pi, 2048), np.geomspace(1e-7, np.pi, 512)]
    for line in model.lines:
        width, centre = (2 * np.pi * hz / model.rate_hz for hz in (line.width_hz, line.frequency_hz))
        grids += [centre - width * apart[::-1], np.array([centre]), centre + width * apart]
    every = np.unique(np.concatenate(grids))
    return np.asarray(every[(every >= 1e-7) & (every <= np.pi)])
