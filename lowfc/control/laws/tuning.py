"""The best law for a log: integrator gains after Gendron and Lena, PI with notches, LQG, each with its margins.

All start from pseudo-open-loop modes, pol = disturbance + white noise, and minimise the true residual: the residual
wavefront in continuous time, during and between exposures. It exceeds the residual that the sensor sees: exposures
average, and the star moves while the mirror holds.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lowfc.arrays import Array
from lowfc.control.laws import margins
from lowfc.control.laws.continuous import Timing, commanded, held_residual_nm2, residual_spectrum
from lowfc.control.laws.kalman import lqg_block
from lowfc.control.laws.linear_law import Block, LinearLaw, integrator, integrator_block, law_from_blocks
from lowfc.control.laws.margins import sensitivity
from lowfc.control.laws.pi_notch import Notch, pi_notch
from lowfc.control.laws.spectra import TimeSeries, floor_nm2_hz, spectrum
from lowfc.control.laws.stability import LOWEST_GAIN, MIN_GAIN_MARGIN, MIN_PHASE_MARGIN_DEG, delay_weights, highest_gain
from lowfc.control.laws.vibration import FEWEST, Model, identify, resolution_hz
from lowfc.control.laws.what_if import controller_of, counterfactual

_NARROWER = (0.1, 0.01, 1e-3)  # factors tried for the fitted width of a line that a log cannot resolve
_WIDER = (10.0,)  # factors tried for lines that move
_SETTLING_FRAMES = 5000  # largest number of frames of a piece in which a simulated law settles
_OCTAVES = (0.0, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0)  # log2 of factors tried on the noise until the margins suffice
_NEAR_ENOUGH = 0.25
"""Width of the bracket, in octaves of noise, at which the search for sufficient margins ends. The residuals of the
filters at its two ends agree within half a percent."""


@dataclass(frozen=True, slots=True)
class Tuned:
    """A law for all modes, and its predicted residual.

    Attributes:
        law: the law, ready to load.
        margins: margins of the law at the delay for which it was made.
        predicted_nm: (modes,) rms of the true residual.
        kinds: law of each mode: integrator, pi-notch or lqg.
        models: model of each mode.
    """

    law: LinearLaw
    margins: margins.Margins
    predicted_nm: Array
    kinds: tuple[str, ...]
    models: tuple[Model, ...]


@dataclass(frozen=True, slots=True)
class Gains:
    """Integrator gains (modes,) and their residuals, nm rms.

    Attributes:
        gain: gain with the least true residual.
        predicted_nm: true residual.
        sensed_nm: residual averaged over each exposure, as the sensor sees it, without noise.
        noise_nm: noise of one frame.
    """

    gain: Array
    predicted_nm: Array
    sensed_nm: Array
    noise_nm: Array


def best_gains(series: TimeSeries, rate_hz: float, timing: Timing, leak: Array) -> Gains:
    """The gain of each mode with the least true residual of an integrator (after Gendron and Lena 1994).

    Args:
        series: Pieces (frames, modes) of pseudo-open-loop modes, nm.
        rate_hz: Frame rate.
        timing: The loop's true timing.
        leak: (modes,) leak of each integrator.

    Raises:
        ValueError: there are too few consecutive frames.
    """
    from scipy.optimize import minimize_scalar

    # Coarse segments would lose a slow mode's drift.
    fine, coarse = spectrum(series, rate_hz, series.longest), spectrum(series, rate_hz)
    if fine is None or coarse is None or series.longest < FEWEST:
        raise ValueError(f"a law needs at least {FEWEST} consecutive frames, the longest piece has {series.longest}")
    noise_nm2 = floor_nm2_hz(coarse) * rate_hz / 2
    omega = 2 * np.pi * fine.frequency_hz[1:] / rate_hz  # an integrator without leak has no value at 0 Hz
    measured = fine.power_nm2_hz[1:] * rate_hz / 2
    leaks: list[float] = leak.tolist()
    means_nm = [float(max(series.values, key=len)[:, mode].mean()) for mode in range(len(leaks))]
    gains, residual_nm2, sensed_nm2 = np.zeros((3, len(leaks)))

    def law_of(gain: float, mode: int) -> LinearLaw:
        return integrator([gain], [leaks[mode]], (2,), timing.delay, rate_hz)  # the Noll index does not matter

    def steady_nm2(gain: float, mode: int) -> float:
        """Square of what a leak leaves of the mean: the fraction |S| at 0 Hz."""
        return means_nm[mode] ** 2 * (leaks[mode] / (leaks[mode] + gain)) ** 2

    def residual(gain: float, mode: int) -> float:
        own = slice(mode, mode + 1)
        power = residual_spectrum(law_of(gain, mode), omega, measured[:, own], noise_nm2[own], timing)
        return float(power.sum()) * fine.spacing_hz * 2 / rate_hz + steady_nm2(gain, mode)

    for mode in range(len(leaks)):
        bounds = (LOWEST_GAIN, highest_gain(timing.delay, leaks[mode]))
        found = minimize_scalar(residual, args=(mode,), bounds=bounds, method="bounded", options={"xatol": 1e-3})
        gains[mode], residual_nm2[mode] = found.x, found.fun
        error = np.abs(sensitivity(law_of(found.x, mode), omega, timing.delay)) ** 2 * measured[:, mode : mode + 1]
        sensed_nm2[mode] = error.sum() * fine.spacing_hz * 2 / rate_hz + steady_nm2(found.x, mode) - noise_nm2[mode]
    rms = (np.sqrt(np.maximum(each, 0.0)) for each in (residual_nm2, sensed_nm2, noise_nm2))
    return Gains(gains, *rms)


def identify_modes(series: TimeSeries, rate_hz: float) -> list[Model]:
    """A model of each mode of pseudo-open-loop modes (frames, modes).

    Raises:
        ValueError: there are too few consecutive frames.
    """
    models = []
    for mode in range(series.values[0].shape[1] if series.values else 0):
        model = identify(series.columns(slice(mode, mode + 1)), rate_hz)
        if model is None:
            raise ValueError(f"a model is fitted to at least {FEWEST} frames in a row, there are fewer")
        models.append(model)
    return models


def tune_integrator(models: Sequence[Model], gains: Gains, noll: tuple[int, ...], leak: Array, timing: Timing) -> Tuned:
    """The loop's own integrator with these gains and leaks (modes,), without unit."""
    law = integrator(gains.gain, leak, noll, timing.delay, models[0].rate_hz)
    return _tuned(law, timing, ("integrator",) * len(noll), models)


def tune_lqg(
    series: TimeSeries, models: Sequence[Model], gains: Gains, noll: tuple[int, ...], leak: Array, timing: Timing
) -> Tuned:
    """LQG for modes in which it beats the best integrator, else that integrator; leaks (modes,) without unit.

    Several widths are tried on the series for lines that the spectrum does not resolve; a large one suits moving lines.

    Raises:
        ValueError: a filter does not converge, or the law is unstable.
    """
    rate_hz, finest_hz = models[0].rate_hz, resolution_hz(series, models[0].rate_hz)
    noise_nm2 = np.array([model.noise_nm2 for model in models])

    def law_of(blocks: Sequence[Block]) -> LinearLaw:
        return law_from_blocks(blocks, "pol", "lqg", noll, timing.delay, rate_hz)

    def residual(blocks: Sequence[Block]) -> Array:
        return simulated_residual_nm2(law_of(blocks), series, noise_nm2, timing)

    scaled = ([_scaled(model, factor, finest_hz) for model in models] for factor in (*_NARROWER, *_WIDER))
    tried = [models, *scaled]
    integrators = [integrator_block(*each, "pol", timing.delay) for each in zip(gains.gain, leak, strict=True)]
    filters = [[within_margins(model, timing) for model in candidates] for candidates in tried]
    robust = [[block or other for block, other in zip(blocks, integrators, strict=True)] for blocks in filters]
    residual_nm2 = np.nan_to_num([residual(blocks) for blocks in robust], nan=np.inf)
    best = residual_nm2.argmin(axis=0)
    modes = range(len(noll))
    wins = residual_nm2.min(axis=0) < residual(integrators)  # false without any filter within the margins
    chosen = [tried[best[mode]][mode] for mode in modes]
    law = law_of([robust[best[mode]][mode] if wins[mode] else integrators[mode] for mode in modes])
    return _tuned(law, timing, ["lqg" if better else "integrator" for better in wins], chosen)


def tune_pi_notch(models: Sequence[Model], gains: Gains, noll: tuple[int, ...], leak: Array, timing: Timing) -> Tuned:
    """An integrator with a notch for each line that it can reduce with sufficient margins.

    Leaks (modes,) without unit.
    """
    rate_hz = models[0].rate_hz
    tuned = [_notched(*mode, timing) for mode in zip(models, gains.gain.tolist(), leak.tolist(), strict=True)]
    gain, notches = np.array([g for g, _ in tuned]), [mode_notches for _, mode_notches in tuned]
    law = pi_notch(noll, gain, np.zeros(len(noll)), leak, notches, timing.delay, rate_hz)
    return _tuned(law, timing, ["pi-notch" if mode_notches else "integrator" for mode_notches in notches], models)


def _notched(model: Model, gain: float, leak: float, timing: Timing) -> tuple[float, tuple[Notch, ...]]:
    """Gain and notches of one mode."""

    def law_of(notches: Sequence[Notch], g: float) -> LinearLaw:
        return pi_notch((2,), np.array([g]), np.zeros(1), np.array([leak]), [notches], timing.delay, model.rate_hz)

    tried: list[tuple[float, float, tuple[Notch, ...]]] = []
    for share in (1.0, 0.7, 0.5, 0.35):  # less gain leaves room for notches
        g, notches = share * gain, tuple[Notch, ...]()
        least = float(predicted_nm(law_of(notches, g), [model], timing)[0])
        for line in sorted(model.lines, key=lambda line: -line.variance_nm2):
            width_hz = min(max(4 * line.width_hz, 0.2 * line.frequency_hz), 0.02 * model.rate_hz)
            for depth in (30.0, 10.0, 4.0):
                with_another = (*notches, Notch(line.frequency_hz, width_hz, depth))
                law = law_of(with_another, g)
                residual = float(predicted_nm(law, [model], timing)[0])
                if residual < least and _sufficient(margins.margins(law, timing.delay)):
                    notches, least = with_another, residual
                    break
        tried.append((least, g, notches))
    _, g, notches = min(tried, key=lambda attempt: attempt[0])
    return g, notches


def _tuned(law: LinearLaw, timing: Timing, kinds: Sequence[str], models: Sequence[Model]) -> Tuned:
    margins.check_stable(law, timing.delay)
    law_margins = margins.margins(law, timing.delay)
    return Tuned(law, law_margins, predicted_nm(law, models, timing), tuple(kinds), tuple(models))


def predicted_nm(law: LinearLaw, models: Sequence[Model], timing: Timing) -> Array:
    """Rms (modes,) of the true residual that these models predict."""
    variance_nm2 = np.zeros(len(models))
    for mode, model in enumerate(models):
        omega = fine_frequencies(model)
        measured = model.spectrum_nm2(omega)[:, None] + model.noise_nm2
        noise_nm2 = np.full(len(models), model.noise_nm2)
        power = residual_spectrum(law, omega, measured, noise_nm2, timing)[:, mode]
        variance_nm2[mode] = np.trapezoid(power, omega) / np.pi
    return np.sqrt(variance_nm2)


def predicted_covariance_nm2(law: LinearLaw, models: Sequence[Model], noise_nm2: Array, timing: Timing) -> Array:
    """Covariance (modes, modes) of the true residual that these models predict, for modes coupled by noise alone.

    The covariance (modes, modes) of one frame's noise is scaled to the models' noise.
    """
    omega = np.linspace(0, np.pi, 2049)[1:]
    passed = commanded(law, omega, timing.delay)
    covariance_nm2 = np.asarray((passed.T @ passed.conj()).real / len(omega) * frame_noise_nm2(models, noise_nm2))
    np.fill_diagonal(covariance_nm2, predicted_nm(law, models, timing) ** 2)
    return covariance_nm2


def frame_noise_nm2(models: Sequence[Model], noise_nm2: Array) -> Array:
    """Covariance (modes, modes) of one frame's noise, scaled to these models."""
    scale = np.sqrt([model.noise_nm2 for model in models] / np.diag(noise_nm2))
    return np.asarray(noise_nm2 * np.outer(scale, scale))


def simulated_residual_nm2(law: LinearLaw, series: TimeSeries, noise_nm2: Array, timing: Timing) -> Array:
    """Mean square (modes,) of the residual, averaged over the time in which each command is in force.

    Changes within that time, which no law can remove, are not included. Each piece (frames, modes) of the series of
    pseudo-open-loop modes, with noise (modes,), starts with a law at rest and a flat mirror; its first 5000 frames, or
    its first third if that is shorter, do not count.
    """
    weights = delay_weights(timing.delay).astype(np.float32)
    squares, frames = np.zeros(len(law.noll)), 0
    for piece in series.values:
        skipped = min(_SETTLING_FRAMES, len(piece) // 3)
        missing = np.zeros(len(piece), np.int64)
        command_nm = counterfactual(controller_of(law), weights, piece.astype(np.float32), missing)[1]
        measured_nm, commanded_nm = piece[skipped:].astype(np.float64), command_nm[skipped:].astype(np.float64)
        piece_squares, piece_frames = held_residual_nm2(law, measured_nm, commanded_nm, noise_nm2, timing)
        squares, frames = squares + piece_squares, frames + piece_frames
    return np.asarray(squares / max(frames, 1))


def _scaled(model: Model, factor: float, finest_hz: float) -> Model:
    """The model with the widths of its unresolved lines multiplied by a factor."""
    lines = (
        replace(line, width_hz=factor * line.width_hz) if line.width_hz < 3 * finest_hz else line
        for line in model.lines
    )
    return replace(model, lines=tuple(lines))


def within_margins(model: Model, timing: Timing) -> Block | None:
    """Filter of a model, with its noise overestimated until the margins suffice; None if they cannot suffice.

    A filter with less weight on its measurements predicts more smoothly; the residual of a mode with a modelled line
    hardly increases.
    """

    def filtered(octaves: float) -> Block | None:
        block = lqg_block(replace(model, noise_nm2=2.0**octaves * model.noise_nm2), timing)
        law = law_from_blocks([block], "pol", "lqg", (2,), timing.delay, model.rate_hz)  # the mode does not matter
        return block if _sufficient(margins.margins(law, timing.delay)) else None

    low = 0.0
    for high in _OCTAVES:
        found = filtered(high)
        if found is not None:
            break
        low = high
    else:
        return None
    while high - low > _NEAR_ENOUGH:
        middle = (low + high) / 2
        nearer = filtered(middle)
        if nearer is None:
            low = middle
        else:
            high, found = middle, nearer
    return found


def _sufficient(found: margins.Margins) -> bool:
    """Whether a law is stable, with the gain margin that integrators must keep and 0.7 of their phase margin."""
    return bool(
        found.stable
        and found.gain_margin.min() >= MIN_GAIN_MARGIN
        and found.gain_reduction.max() <= 1 / MIN_GAIN_MARGIN
        and found.phase_margin_deg.min() >= 0.7 * MIN_PHASE_MARGIN_DEG
    )


def fine_frequencies(model: Model) -> Array:
    """Frequencies (n,) from nearly 0 to pi rad per frame, ascending, dense around each line."""
    apart = np.geomspace(1e-3, 1e4, 120)
    grids = [np.linspace(0, np.pi, 2048), np.geomspace(1e-7, np.pi, 512)]
    for line in model.lines:
        width, centre = (2 * np.pi * hz / model.rate_hz for hz in (line.width_hz, line.frequency_hz))
        grids += [centre - width * apart[::-1], np.array([centre]), centre + width * apart]
    omega = np.unique(np.concatenate(grids))
    return np.asarray(omega[(omega >= 1e-7) & (omega <= np.pi)])
