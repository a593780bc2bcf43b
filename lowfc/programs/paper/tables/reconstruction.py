"""Table 3: residual of random wavefronts after subtraction of their estimate, for every sensor and estimator."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np

from lowfc.arrays import Array
from lowfc.design import trials
from lowfc.design.estimators import KINDS, Fit, estimate, iterated
from lowfc.design.fisher import cramer_rao, variance_e2
from lowfc.design.paper import MODES, PEAK_E, TABLE3_INPUT_WAVES, TABLE3_READ_NOISE_E, TABLE3_WAVES
from lowfc.optics.chain.zernike import NOLLS_20
from lowfc.programs.paper.cases import DEFAULT_SAM, Context, Prepared, Row, prepared, sparse_apertures

OTHER_SENSORS = (
    *("bowtie", f"bowtie:{DEFAULT_SAM}", "clowfs", "clowfs_tuned", "zwfs", "zwfs_tuned", "bar", "lyot", "aplc"),
)
"""Sensors in addition to the packaged sparse apertures."""
ITERATIONS = (0, 1, 2)
WITH_NUISANCES = "weighted, flux and shear fitted too"
EVEN = (
    "If pupil and masks are real and the pupil is symmetric, flux and shear change the image by an even function of "
    "position, and every mode changes it by an odd one. So fitting flux and shear costs a sparse aperture mask "
    "nothing. CLOWFS and the Zernike sensor mistake shear for tilt."
)

PAPER_INPUT_PV_WAVES = {14: 0.097, 20: 0.11}
PAPER_WAVES = TABLE3_WAVES | {"sam": TABLE3_WAVES["disk"]}

NOISE = (
    "40,000 e- in the brightest pixel of the sensor's own flat image (which favours masks with low throughput: compare "
    "Table 4), 3 e- read noise, whole electrons, total flux known, monochromatic. Residuals are over the open area "
    "(transmission above 0.5), without piston. RMS and its limit (Cramer-Rao bound) are root mean squares over the "
    "wavefronts; P-V is a mean."
)


def label(kind: str, iterations: int) -> str:
    """An estimator's name: its kind and the number of iterations with the full model."""
    return kind if iterations == 0 else f"{kind} + {iterations} iteration{'s' * (iterations > 1)}"


@dataclass(frozen=True)
class Input:
    """An interpretation of Sect. 3.1: largest coefficients, waves rms, to degree 2 (`low`) and above it (`high`)."""

    name: str
    low: float
    high: float
    assumption: str


def inputs(sensor: Prepared, modes: int, literal: bool) -> Iterator[Input]:
    """Interpretations of Sect. 3.1: matched to the input of Table 3, and if `literal` also with the text's bounds."""
    low, high = trials.PAPER_BOUNDS_WAVES
    bounds = trials.bounds_waves(NOLLS_20[:modes], low, high)
    literal_rms = trials.input_rms(sensor.gram[:modes, :modes], bounds)
    scale = TABLE3_INPUT_WAVES[modes] / literal_rms
    yield Input(
        "matched",
        low * scale,
        high * scale,
        f"Coefficients uniform within {low * scale:.4f} (n <= 2) and {high * scale:.4f} waves rms, which gives the "
        f"input rms of Table 3, {TABLE3_INPUT_WAVES[modes]}; the text's {low} and {high} would give {literal_rms:.3f}.",
    )
    if literal:
        yield Input("literal", low, high, f"Coefficients uniform within {low} and {high} waves rms, as in the text.")
        yield Input(
            "quarter",
            low / 4,
            high / 4,
            f"Coefficients uniform within {low / 4} and {high / 4} waves rms, as if the bounds of the text were peak "
            "to valley.",
        )


@dataclass(frozen=True, eq=False)
class Ensemble:
    """Random wavefronts and their estimates by one sensor.

    Attributes:
        truth_nm: (trials, modes) true coefficients.
        estimates_nm: (trials, modes) estimates, by estimator.
        bound_nm: Residual rms over the open pupil at the Cramer-Rao bound.
    """

    truth_nm: Array
    estimates_nm: dict[str, Array]
    bound_nm: float


def scale_e(sensor: Prepared) -> float:
    """Electrons of the open circle's light for Table 3's exposure."""
    return PEAK_E / float(sensor.I0.max())


def exposed_e(sensor: Prepared, image: Array, rng: np.random.Generator) -> Array:
    """A noisy image (pixels,) in electrons, from an image in fractions of the open circle's light."""
    return trials.noisy_e(rng, scale_e(sensor) * image, TABLE3_READ_NOISE_E)


def bound_nm2(sensor: Prepared, modes: int) -> Array:
    """Cramer-Rao bound (modes, modes) of Table 3's exposure."""
    light_e = scale_e(sensor)
    return cramer_rao(light_e * sensor.H[:, :modes], variance_e2(light_e * sensor.I0, TABLE3_READ_NOISE_E))


def fits(sensor: Prepared, modes: int, nuisances: bool = False) -> dict[str, Fit]:
    """The linear estimators of Table 3, by name; `nuisances` adds one that also fits flux and shear."""
    exposure = (modes, scale_e(sensor), TABLE3_READ_NOISE_E)
    estimators = {kind: sensor.fit(*exposure, kind) for kind in KINDS}
    if nuisances:
        estimators[WITH_NUISANCES] = sensor.fit(*exposure, "weighted", nuisance=sensor.nuisance)
    return estimators


def iterated_nm(sensor: Prepared, linear: dict[str, Fit], image_e: Array) -> dict[str, Array]:
    """Estimates (modes,) from an image (pixels,) in electrons by each linear estimator after 0, 1 and 2 iterations."""
    steps_nm = {kind: iterated(fit, image_e, sensor.model, ITERATIONS[-1]) for kind, fit in linear.items()}
    return {label(kind, k): steps_nm[kind][k] for kind in linear for k in ITERATIONS}


def ensemble(context: Context, name: str, modes: int, wavefronts: Input, nuisances: bool = False) -> Ensemble:
    """Draw wavefronts, image them with the full chain and noise, and estimate them; only `weighted` is iterated."""
    sensor = prepared(name)
    linear, wavelength_nm = fits(sensor, modes, nuisances), sensor.optics.wavelength_nm
    rng = context.rng("table3", modes, wavefronts.name)
    nolls = NOLLS_20[:modes]
    truth_nm = wavelength_nm * trials.random_wavefronts(rng, context.trials, nolls, wavefronts.low, wavefronts.high)
    sensor.model(np.zeros(modes))  # builds the twin before the threads use it

    def trial(i: int) -> dict[str, Array]:
        noise = context.rng("table3", name, modes, wavefronts.name, i)
        image_e = exposed_e(sensor, sensor.image(truth_nm[i]), noise)
        linear_nm = {key: estimate(each, image_e) for key, each in linear.items()}
        return linear_nm | iterated_nm(sensor, {"weighted": linear["weighted"]}, image_e)

    results = context.map(f"table3 {name}, {modes} modes, {wavefronts.name}", trial, range(context.trials))
    bound_nm = trials.expected_rms(sensor.gram[:modes, :modes], bound_nm2(sensor, modes))
    return Ensemble(truth_nm, {key: np.stack([each[key] for each in results]) for key in results[0]}, bound_nm)


def mean_and_error(values: Array) -> tuple[float, float]:
    """Mean of (n,) values and its standard error."""
    return float(values.mean()), float(values.std(ddof=1) / np.sqrt(len(values)))


def table3(context: Context) -> list[Row]:
    """Rows of Table 3: input, then rms and P-V residual for each sensor, number of modes, input and estimator."""
    rows: list[Row] = []
    inputs_shown: set[tuple[bytes, int, str]] = set()
    for name in context.names(*sparse_apertures(), *OTHER_SENSORS):
        sensor = prepared(name)
        in_paper = name in ("sam", "clowfs")
        for modes in MODES:
            for wavefronts in inputs(sensor, modes, literal=in_paper):
                estimated = ensemble(
                    context, name, modes, wavefronts, nuisances=in_paper and wavefronts.name == "matched"
                )
                pupil_and_input = sensor.open.tobytes(), modes, wavefronts.name
                if pupil_and_input not in inputs_shown:
                    rows += _input_rows(sensor, modes, wavefronts, estimated)
                    inputs_shown.add(pupil_and_input)
                rows += _residual_rows(sensor, modes, wavefronts, estimated)
    return rows


def _input_rows(sensor: Prepared, modes: int, wavefronts: Input, estimated: Ensemble) -> Iterator[Row]:
    drawn = partial(Row, f"input, pupil of {sensor.name}", modes=modes, assumption=wavefronts.assumption)
    for statistic, paper, (mean, error) in (
        ("RMS", TABLE3_INPUT_WAVES, _rms(sensor, estimated.truth_nm)),
        ("P-V", PAPER_INPUT_PV_WAVES, _pv(sensor, estimated.truth_nm)),
    ):
        yield drawn(f"{statistic}, {wavefronts.name} input", "waves", mean, paper[modes], error)


def _residual_rows(sensor: Prepared, modes: int, wavefronts: Input, estimated: Ensemble) -> Iterator[Row]:
    paper = PAPER_WAVES.get(sensor.paper_name, {}).get(modes, (None, None))
    for estimator, estimates_nm in estimated.estimates_nm.items():
        residuals_nm = estimated.truth_nm - estimates_nm
        assumption = "\n".join((wavefronts.assumption, NOISE, *((EVEN,) if estimator == WITH_NUISANCES else ())))
        fitted = partial(Row, sensor.name, unit="waves", modes=modes, estimator=estimator, assumption=assumption)
        for statistic, value, limit, (mean, error) in (
            ("RMS", paper[0], estimated.bound_nm / sensor.optics.wavelength_nm, _rms(sensor, residuals_nm)),
            ("P-V", paper[1], None, _pv(sensor, residuals_nm)),
        ):
            quantity = f"{statistic} residual, {wavefronts.name} input"
            yield fitted(quantity, measured=mean, paper=value, error=error, limit=limit)


def _rms(sensor: Prepared, coefficients_nm: Array) -> tuple[float, float]:
    """Rms over wavefronts and over the open pupil, and its standard error to first order, waves."""
    modes = coefficients_nm.shape[1]
    values = trials.residual_rms(sensor.gram[:modes, :modes], coefficients_nm) / sensor.optics.wavelength_nm
    mean, error = mean_and_error(values)
    rms = float(np.sqrt(np.mean(values**2)))
    return rms, error * mean / rms


def _pv(sensor: Prepared, coefficients_nm: Array) -> tuple[float, float]:
    """Mean peak to valley over the open pupil of wavefronts, and its standard error, waves."""
    values = trials.residual_pv(sensor.open_modes[: coefficients_nm.shape[1]], coefficients_nm)
    return mean_and_error(values / sensor.optics.wavelength_nm)
