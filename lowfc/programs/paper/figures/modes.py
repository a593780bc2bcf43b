"""Figures 5, 6 and 8: estimated against true coefficients, coefficient of determination, and linear range."""

from collections.abc import Iterator
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from lowfc.arrays import Array
from lowfc.design.estimators import iterated
from lowfc.design.trials import PAPER_BOUNDS_WAVES, bounds_waves, expected_r_squared, r_squared, random_wavefronts
from lowfc.optics.chain.zernike import NOLLS_14, noll_to_orders
from lowfc.programs.paper import plots
from lowfc.programs.paper.cases import Case, Context, Prepared, Row, assuming, prepared
from lowfc.programs.paper.figures.exposure import BRIGHT, FULL_CHAIN, MODES, PINV, WEIGHTED_2
from lowfc.programs.paper.tables.reconstruction import (
    ITERATIONS,
    Ensemble,
    Input,
    bound_nm2,
    ensemble,
    exposed_e,
    fits,
    inputs,
    iterated_nm,
    label,
)

DEGREES = np.array([noll_to_orders(noll)[0] for noll in NOLLS_14])
AMPLITUDES = np.array([0.005 * step for step in range(1, 31)])
"""Amplitudes of the pure modes of Fig. 8(a), waves rms."""
_MODE_TICKS = [str(noll) for noll in NOLLS_14]
# Least and mean coefficient of determination of the modes.
_PAPER_R2 = {"sam": (0.95, 0.97), "clowfs": (0.79, 0.90)}
_PAPER_DEVIATIONS = {"sam": ("linear", 0.1), "clowfs": ("linear", 0.1), "zwfs": ("linear to 0.03 waves", None)}
"""The paper's deviations from linearity at lambda/20 and at lambda/10; None where the paper has no value."""
_PAPER_ERROR_WAVES = 0.01
_DEVIATION = 0.1  # relative deviation from linearity that ends the linear range


def _matched(sensor: Prepared) -> Input:
    """Bounds of the coefficients (Sect. 3.1), scaled so that the input's rms is that of Table 3."""
    return next(inputs(sensor, MODES, literal=False))


@lru_cache(maxsize=8)
def _ensemble(context: Context, name: str) -> Ensemble:
    return ensemble(context, name, MODES, _matched(prepared(name)))


@assuming(
    "The wavefronts of Table 3, n = 1 to 4, input matched to its rms. The paper only plots the points, 'tight' "
    f"about y = x. {BRIGHT} Images by the full optical chain."
)
def fig5(context: Context) -> Iterator[Row]:
    """Linear fit to estimated against true coefficients of each radial degree, Fig. 5."""
    for name in context.names("sam"):
        sensor, estimated = prepared(name), _ensemble(context, name)
        for degree in range(1, 5):
            truth, estimates = (values[:, degree == DEGREES].ravel() for values in _waves(sensor, estimated))
            (slope, intercept), covariance = np.polyfit(truth, estimates, 1, cov=True)
            fitted = partial(Row, f"{name}, n = {degree}", modes=MODES, estimator=PINV)
            errors = np.sqrt(np.diag(covariance))
            yield fitted("slope", "", float(slope), 1.0, float(errors[0]))
            yield fitted("intercept", "waves", float(intercept), 0.0, float(errors[1]))
            yield fitted("correlation", "", float(np.corrcoef(truth, estimates)[0, 1]))


def plot_fig5(context: Context, path: Path) -> None:
    """Draw Fig. 5: estimated against true coefficients, a panel for each radial degree."""
    name = context.names("sam")[0]
    sensor = prepared(name)
    truth, estimates = _waves(sensor, _ensemble(context, name))
    panels = []
    for degree in range(1, 5):
        lines = [
            plots.Line(f"Z{NOLLS_14[k]}", truth[:, k], estimates[:, k], joined=False)
            for k in np.flatnonzero(degree == DEGREES)
        ]
        axes = ("true, waves rms", "estimated, waves rms")
        panels.append(plots.curves(lines, f"n = {degree}", *axes, diagonal=True, legend="upper left"))
    plots.draw(path, panels, f"Fig. 5. {name}, {PINV}, {len(truth)} wavefronts of Table 3. {BRIGHT}", columns=2)


def _waves(sensor: Prepared, estimated: Ensemble) -> tuple[Array, Array]:
    """True coefficients and their `PINV` estimates (trials, modes) in waves."""
    wavelength_nm = sensor.optics.wavelength_nm
    return estimated.truth_nm / wavelength_nm, estimated.estimates_nm[PINV] / wavelength_nm


@assuming(
    "The wavefronts of Table 3, n = 1 to 4, input matched to its rms; limit: R^2 of "
    f"estimates whose errors are at the Cramer-Rao bound. {BRIGHT} Images by the full optical chain."
)
def fig6(context: Context) -> Iterator[Row]:
    """Coefficient of determination of each mode, Fig. 6 and eq. (15)."""
    for name, values in _r_squared(context).items():
        sensor = prepared(name)
        limits = _r_squared_limit(sensor)
        fitted = partial(Row, unit="", modes=MODES, estimator=PINV)
        paper = _PAPER_R2.get(sensor.paper_name, (None, None))
        yield fitted(name, "least R^2", measured=float(values.min()), paper=paper[0], limit=float(limits.min()))
        yield fitted(name, "mean R^2", measured=float(values.mean()), paper=paper[1], limit=float(limits.mean()))
        for noll, value, limit in zip(NOLLS_14, values, limits, strict=True):
            yield fitted(f"{name}, Z{noll}", "R^2", measured=float(value), limit=float(limit))


def plot_fig6(context: Context, path: Path) -> None:
    """Draw Fig. 6: R^2 against the mode for each sensor."""
    x = np.arange(MODES, dtype=float)
    lines = [plots.Line(name, x, values) for name, values in _r_squared(context).items()]
    lowest = min(float(line.y.min()) for line in lines)
    panel = plots.curves(
        lines,
        f"{PINV}, n = 1 to 4",
        "Noll index",
        "$R^2$",
        y_bounds=(max(min(lowest, 0.75) - 0.05, 0.0), 1.01),
        ticks=_MODE_TICKS,
        legend="lower left",
    )
    plots.draw(path, [panel], f"Fig. 6. {context.trials} wavefronts of Table 3. {BRIGHT}", wide=True)


def _r_squared(context: Context) -> dict[str, Array]:
    """Coefficient of determination of each mode (modes,) by sensor."""
    ensembles = {name: _ensemble(context, name) for name in context.names("sam", "bowtie", "clowfs", "zwfs")}
    return {name: r_squared(each.estimates_nm[PINV], each.truth_nm) for name, each in ensembles.items()}


def _r_squared_limit(sensor: Prepared) -> Array:
    """Coefficient of determination (modes,) of estimates whose errors are at the Cramer-Rao bound."""
    wavefronts = _matched(sensor)
    bounds_nm = bounds_waves(NOLLS_14, wavefronts.low, wavefronts.high) * sensor.optics.wavelength_nm
    return expected_r_squared(np.diag(bound_nm2(sensor, MODES)), bounds_nm)


@lru_cache(maxsize=8)
def _pure_modes(context: Context, name: str) -> Array:
    """Estimates (iterations, modes, amplitudes) in waves of each pure mode from its image, without noise."""
    sensor = prepared(name)
    wavelength_nm, linear = sensor.optics.wavelength_nm, fits(sensor, MODES)["pinv"]
    sensor.model(np.zeros(MODES))  # builds the twin before the threads use it

    def estimate(k: int) -> Array:
        estimates = np.empty((len(ITERATIONS), AMPLITUDES.size))
        for j, amplitude in enumerate(AMPLITUDES):
            truth_nm = np.zeros(MODES)
            truth_nm[k] = amplitude * wavelength_nm
            image_e = linear.scale_e * sensor.model(truth_nm)
            steps_nm = iterated(linear, image_e, sensor.model, ITERATIONS[-1])
            estimates[:, j] = [steps_nm[iterations][k] / wavelength_nm for iterations in ITERATIONS]
        return estimates

    return np.stack(context.map(f"{name}, pure modes", estimate, range(MODES)), axis=1)


def deviations(estimates: Array) -> Array:
    """Relative deviation of estimates (..., amplitudes) of a pure mode from its amplitude; 0 if linear."""
    return np.asarray(np.abs(estimates / AMPLITUDES - 1.0))


def linear_range(deviation: Array) -> float:
    """Amplitude, waves rms, at which a deviation (amplitudes,) first exceeds 10 %; infinite if it never does."""
    x, y = np.append(0.0, AMPLITUDES), np.append(0.0, deviation)
    above = np.flatnonzero(y > _DEVIATION)
    if not above.size:
        return float("inf")
    ends = slice(above[0] - 1, above[0] + 1)
    return float(np.interp(_DEVIATION, y[ends], x[ends]))


@lru_cache(maxsize=8)
def _one_wavefront(context: Context, name: str, literal: bool) -> tuple[Array, dict[str, Array]]:
    """One random wavefront (modes,) and its estimates (modes,) by estimator, waves rms."""
    sensor = prepared(name)
    wavelength_nm, matched = sensor.optics.wavelength_nm, _matched(sensor)
    low, high = PAPER_BOUNDS_WAVES if literal else (matched.low, matched.high)
    truth = random_wavefronts(context.rng("fig8"), 1, NOLLS_14, low, high)[0]
    image_e = exposed_e(sensor, sensor.image(truth * wavelength_nm), context.rng("fig8", name))
    estimates = iterated_nm(sensor, fits(sensor, MODES), image_e)
    return truth, {key: modes_nm / wavelength_nm for key, modes_nm in estimates.items()}


def fig8(context: Context) -> list[Row]:
    """Deviation of pure modes from linearity, Fig. 8(a), and errors of one random wavefront, Fig. 8(b)."""
    names = context.names("sam", "clowfs", "zwfs")
    rows = [row for name in names for row in _range_rows(context, name)]
    paper = _PAPER_ERROR_WAVES if prepared(names[0]).paper_name == "sam" else None
    new_row = partial(Row, names[0], modes=MODES, assumption=f"One wavefront and one exposure. {BRIGHT} {FULL_CHAIN}")
    for literal, bounds in ((False, "matched"), (True, "literal")):
        truth, estimates = _one_wavefront(context, names[0], literal)
        for key in (PINV, WEIGHTED_2):
            worst = float(np.abs(estimates[key] - truth).max())
            quantity = f"largest error of a random wavefront, {bounds} input"
            rows.append(new_row(quantity, "waves", worst, paper, estimator=key))
    return rows


def _range_rows(context: Context, name: str) -> Iterator[Row]:
    assumption = (
        "Pure modes of one sign from 0.005 to 0.15 waves rms, fitted with 14 modes, no noise, images by the twin, "
        "accurate to about 1e-5; deviation: fraction by which a mode's own estimate differs from its amplitude."
    )
    indices = {
        "lambda/20": int(np.argmin(np.abs(AMPLITUDES - 0.05))),
        "lambda/10": int(np.argmin(np.abs(AMPLITUDES - 0.1))),
    }
    in_paper = dict(zip(indices, _PAPER_DEVIATIONS.get(prepared(name).paper_name, (None, None)), strict=True))
    for iterations, estimates in zip(ITERATIONS, _pure_modes(context, name), strict=True):
        deviation = deviations(estimates)
        fitted = partial(Row, modes=MODES, estimator=label("pinv", iterations), assumption=assumption)
        for amplitude, j in indices.items():
            paper = in_paper[amplitude] if iterations == 0 else None
            quantity = f"relative deviation from linearity at {amplitude}"
            yield fitted(name, f"mean {quantity}", "", float(deviation[:, j].mean()), paper)
            yield fitted(name, f"largest {quantity}", "", float(deviation[:, j].max()))
        ranges = np.array([linear_range(mode) for mode in deviation])
        quantity = "amplitude of 10 % deviation"
        yield fitted(name, f"{quantity}, median mode", "waves", _amplitude(float(np.median(ranges))))
        yield fitted(name, f"{quantity}, worst mode", "waves", _amplitude(float(ranges.min())))
        if iterations == 0:
            for noll, each in zip(NOLLS_14, ranges, strict=True):
                yield fitted(f"{name}, Z{noll}", quantity, "waves", _amplitude(each))


def _amplitude(waves: float) -> float | str:
    return waves if np.isfinite(waves) else f"above {AMPLITUDES[-1]:.2f}"


def plot_fig8(context: Context, path: Path) -> None:
    """Draw Fig. 8: response to pure modes, mean deviation from linearity, and one random wavefront."""
    names = context.names("sam", "clowfs", "zwfs")
    responses = _pure_modes(context, names[0])[0]
    truth, estimates = _one_wavefront(context, names[0], False)
    modes = [plots.Line(f"Z{noll}", AMPLITUDES, each) for noll, each in zip(NOLLS_14, responses, strict=True)]
    means = [
        plots.Line(f"{name}, {label('pinv', i)}", AMPLITUDES, 100.0 * deviations(each).mean(axis=0))
        for name in names
        for i, each in zip(ITERATIONS, _pure_modes(context, name), strict=True)
        if i != 1
    ]
    x_label, fitted = "amplitude, waves rms", {"true": truth, PINV: estimates[PINV]}
    errors = {key: estimates[key] - truth for key in (PINV, WEIGHTED_2)}
    panels: list[plots.Panel] = [
        plots.curves(
            modes, f"(a) {names[0]}, {PINV}", x_label, "estimate, waves rms", diagonal=True, legend="upper left"
        ),
        plots.curves(
            means, "mean of 14 modes", x_label, "deviation from linearity, %", y_bounds=(0.0, 40.0), legend="upper left"
        ),
        plots.bars(fitted, _MODE_TICKS, f"(b) {names[0]}, {PINV}", "waves rms"),
        plots.bars(errors, _MODE_TICKS, f"{names[0]}, errors of (b)", "waves rms"),
    ]
    plots.draw(
        path,
        panels,
        "Fig. 8. (a) Estimates of pure modes without noise, by the twin. (b) One random wavefront, n = 1 to 4, input "
        f"matched to Table 3's rms, by Noll index. {BRIGHT}",
        columns=2,
        wide=True,
    )


CASES = {
    "fig5": Case("Fig. 5: estimated against true coefficients", fig5, plot_fig5),
    "fig6": Case("Fig. 6: coefficient of determination of each mode", fig6, plot_fig6),
    "fig8": Case("Fig. 8: linear range of pure modes, and one random wavefront", fig8, plot_fig8),
}
