"""Drift and vibration lines that a telescope may have for a given added contrast: theory, checked by simulation."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from lowfc.adapters.files.sensors import coronagraph_from
from lowfc.arrays import Array
from lowfc.contract.errors import ConfigurationError
from lowfc.contract.sections import SensorSection
from lowfc.control.calibration.calibration import noise_nm2
from lowfc.control.laws.vibration import Line
from lowfc.design.drift_trial import simulated_residual_nm2
from lowfc.design.fisher import quantum_information
from lowfc.design.tolerance import KINDS, Kind, tolerated_drift, tolerated_lines, tolerated_variance
from lowfc.optics.chain.added_contrast import ModalContrast
from lowfc.optics.chain.zernike import NOLLS_14, mode_name
from lowfc.optics.detector.photometry import Photometry, electrons
from lowfc.programs.paper.cases import Context, Row, prepared
from lowfc.programs.paper.plots import Line as Curve
from lowfc.programs.paper.plots import curves, draw

SENSORS_COMPARED = ("sam", "sam18_sized", "bar", "clowfs", "clowfs_tuned", "zwfs", "zwfs_tuned", "aplc")
MAGNITUDES = (0.0, 2.0, 5.0, 8.0)
ALLOWED_CONTRASTS = (1e-9, 1e-10, 1e-11)
RATE_HZ, EXPOSURE, READ_NOISE_E = 250.0, 0.5, 1.0  # exposure: as a fraction of the period
LINE_HZ, LINE_WIDTH = 10.0, 0.005  # width: as a fraction of the frequency
ESTIMATORS: dict[Kind, str] = {"integrator": "integrator, best gain", "lqg": "LQG"}

CHECKED_SENSORS, CHECKED_MODES, CHECKED_MAGNITUDES = ("clowfs_tuned", "zwfs_tuned"), (4, 8, 11), (2.0, 5.0)
CHECKED_CONTRAST, SHOWN_CONTRAST = 1e-11, 1e-10
_FRAMES_PER_TRIAL = 20  # in units of 1 / gain, the loop's time constant; with 100 trials a variance has a 3 % error
_SHOWN_NOLLS = (2, 4, 8, 11)
_SHOWN_ENDS = tuple(f"V = {magnitude}, contrast {SHOWN_CONTRAST:g}" for magnitude in (2, 5))
_FITTED_CONTRAST = 6e-9  # largest added contrast from which the fourth order is computed

ABOUT = """This page is for the error budget of a telescope. It gives the drift rate of a mode, or the rms of a
vibration line in it, at which the loop's residual adds a contrast of 1e-10. Both follow from the contrast's quadratic
form, its fourth order (which matters for tilt) and the noise of a frame, by the theory of `lowfc/design/tolerance.py`.
The page has four modes and two stars; `--json` has all modes, four stars and contrasts from 1e-9 to 1e-11. Twelve
points are checked by simulation, at 1e-11. [Sensors](../explanation/sensors.md) describes each sensor.

The last rows are of two stars that a coronagraph observes: a reference of V = 2, and a target of V = 5 with another
colour and roll angle. The reference's exposure is subtracted from the target's. Behind a symmetric pupil and a real
mask, colour changes the image by an even function of position, so the zero point of an aperture mask stays. The zero
points of the Zernike sensor and of CLOWFS move, and I0 has to be measured again on the target.
"""
LOOP = (
    f"{RATE_HZ:g} Hz, exposure of half the period, delay of one frame, 1 e- read noise, weighted fit of all 14 modes, "
    "monochromatic; 2 m, 110 nm, 50 % throughput, quantum efficiency 0.8. Each mode alone adds the contrast, averaged "
    "over the dark zone. limit: the same with noise at the quantum limit."
)
DRIFT = "A random walk. For drift alone LQG equals the integrator with the best gain, unless margins limit this gain."
LINE = (
    f"Rms of a line at {LINE_HZ:g} Hz, {100 * LINE_WIDTH:g} % wide between half-power points; LQG has the line in its "
    "model."
)
CHECK = (
    "predicted: the contrast that this drift should add; lowfc: residual variance of a simulated loop on noisy images, "
    "times the contrast per variance."
)


@dataclass(frozen=True, eq=False)
class Contrasts:
    """Contrast that each mode adds alone: form a^2 + quartic a^4 for an amplitude a in nm rms; arrays (modes,)."""

    form: Array
    quartic: Array

    def variance_nm2(self, mode: int, contrast: float) -> float:
        """Variance of a Gaussian mode that adds this contrast."""
        return tolerated_variance(float(self.form[mode]), float(self.quartic[mode]), contrast)

    def added(self, mode: int, variance_nm2: float) -> float:
        """Contrast added by a Gaussian mode of this variance."""
        return float(self.form[mode] * variance_nm2 + 3.0 * self.quartic[mode] * variance_nm2**2)


@lru_cache(maxsize=8)
def contrasts(pupil: str, focal_radius: float) -> Contrasts:
    """Contrast that each mode adds behind a coronagraph; the fourth order is from full images."""
    section = SensorSection(pupil=pupil, focal_radius=focal_radius)
    modal = ModalContrast(coronagraph_from(section), NOLLS_14, prepared("sam").optics.wavelength_nm)
    flat, form = modal.by_image(np.zeros(len(NOLLS_14))), np.diag(modal.form)
    if not (form > 0).all():
        raise ConfigurationError(
            f"with pupil = {pupil!r} some modes reduce the light in the bright dark zone: they have no tolerance"
        )
    quartic = np.zeros(len(NOLLS_14))
    for mode, per_nm2 in enumerate(form.tolist()):
        amplitude_nm = np.sqrt(_FITTED_CONTRAST / per_nm2)
        while True:
            modes_nm = amplitude_nm * np.eye(len(NOLLS_14))[mode]
            added = (modal.by_image(modes_nm) + modal.by_image(-modes_nm)) / 2 - flat
            if added < _FITTED_CONTRAST:
                break
            amplitude_nm *= 0.7
        quartic[mode] = max((added - per_nm2 * amplitude_nm**2) / amplitude_nm**4, 0.0)
    return Contrasts(form, quartic)


def contrasts_of(name: str) -> Contrasts:
    """Contrast that each mode adds behind a sensor's coronagraph."""
    section = prepared(name).section
    return contrasts(section.pupil, section.focal_radius)


def light_e(magnitude: float) -> float:
    """Electrons of one exposure, of the light entering the open circle."""
    return electrons(Photometry(magnitude), EXPOSURE / RATE_HZ)


@lru_cache(maxsize=256)
def frame_noise_nm2(name: str, magnitude: float) -> Array:
    """Noise variance (14,) of each mode of a loop in a frame, at the central wavelength, with all 14 modes fitted."""
    sensor = prepared(name)
    I0, R = sensor.loop_fit(sensor.I0, sensor.H[:, : len(NOLLS_14)], light_e(magnitude), READ_NOISE_E)
    return np.asarray(np.diag(noise_nm2(R, I0, light_e(magnitude) * float(sensor.I0.sum()), READ_NOISE_E)))


def quantum_noise_nm2(name: str, magnitude: float) -> Array:
    """Variance (14,) of each mode in a frame at the quantum limit, with all 14 modes fitted."""
    return _quantum_noise_of_one_electron_nm2(name) / light_e(magnitude)


@lru_cache(maxsize=16)
def _quantum_noise_of_one_electron_nm2(name: str) -> Array:
    """Variance (14,) at the quantum limit for as much light as yields one electron from the open circle."""
    sensor = prepared(name)
    information = quantum_information(sensor.optics.pupil, sensor.modes[: len(NOLLS_14)], sensor.optics.wavelength_nm)
    return np.asarray(np.diag(np.linalg.inv(information)))


def tolerance(context: Context) -> list[Row]:
    """Rows of tolerated drift and vibration lines, of their check by simulation, and of the pair of stars."""
    from lowfc.programs.paper.tables.star_pair import pair_rows

    names = context.names(*SENSORS_COMPARED)
    context.map("noise", partial(frame_noise_nm2, magnitude=MAGNITUDES[0]), names)  # reports unusable sensors at once
    lines = {kind: tolerated_lines(kind, Line(LINE_HZ, LINE_WIDTH * LINE_HZ, 1.0), RATE_HZ, EXPOSURE) for kind in KINDS}
    rows = [row for each in context.map("tolerance", lambda name: [*_tolerated(name, lines)], names) for row in each]
    rows += _checked(context)
    return rows + [row for name in names if prepared(name).section.pupil == "shaped" for row in pair_rows(name)]


def _tolerated(name: str, lines: dict[Kind, Callable[[Array], Array]]) -> Iterator[Row]:
    """Rows of one sensor; `lines` are the results of `tolerated_lines`."""
    modal = contrasts_of(name)
    for magnitude in MAGNITUDES:
        noises_nm2 = np.column_stack([frame_noise_nm2(name, magnitude), quantum_noise_nm2(name, magnitude)])
        for mode, (noll, noise_and_limit_nm2) in enumerate(zip(NOLLS_14, noises_nm2, strict=True)):
            for allowed, kind in product(ALLOWED_CONTRASTS, KINDS):
                residual_nm2 = modal.variance_nm2(mode, allowed)
                drifts = [tolerated_drift(residual_nm2, nm2, EXPOSURE, kind) for nm2 in noise_and_limit_nm2]
                drift_pm = 1e3 * np.sqrt([drift.step_nm2 * RATE_HZ for drift in drifts])
                line_pm = 1e3 * np.sqrt(lines[kind](residual_nm2 / noise_and_limit_nm2) * noise_and_limit_nm2)
                point = f"Z{noll} {mode_name(noll)}, V = {magnitude:g}, contrast {allowed:g}"
                for term, unit, pm, basis in (("drift", "pm/sqrt(s)", drift_pm, DRIFT), ("line", "pm", line_pm, LINE)):
                    measured, limit = pm.tolist()
                    tolerated = Row(name, f"{term} of {point}", unit, measured, limit=limit)
                    yield replace(tolerated, estimator=ESTIMATORS[kind], assumption=f"{LOOP}\n{basis}")


def _checked(context: Context) -> list[Row]:
    """Rows of the simulated points, six for each of `CHECKED_SENSORS`."""
    # Simulating other sensors takes days.
    names = [name for name in CHECKED_SENSORS if name in context.names(*CHECKED_SENSORS)]
    twins = {name: prepared(name).twin for name in names}  # built before the threads use them
    points = list(product(names, CHECKED_MAGNITUDES, CHECKED_MODES))

    def simulated(point: tuple[str, float, int]) -> Row:
        name, magnitude, noll = point
        mode, modal = NOLLS_14.index(noll), contrasts_of(name)
        noise = float(frame_noise_nm2(name, magnitude)[mode])
        drift = tolerated_drift(modal.variance_nm2(mode, CHECKED_CONTRAST), noise, EXPOSURE)
        frames = int(np.ceil(_FRAMES_PER_TRIAL * context.trials / drift.gain))
        only = np.eye(len(NOLLS_14))[mode]
        rng = context.rng("tolerance", name, round(magnitude), noll)
        step_nm2, gain = drift.step_nm2 * only, drift.gain * only
        residual_nm2 = simulated_residual_nm2(
            twins[name], light_e(magnitude), READ_NOISE_E, EXPOSURE, step_nm2, gain, frames, rng
        )
        return Row(
            name,
            f"contrast added by Z{noll} {mode_name(noll)} at its tolerance, V = {magnitude:g}",
            "",
            modal.added(mode, float(residual_nm2[mode])),
            error=CHECKED_CONTRAST * float(np.sqrt(2.0 / (frames * drift.gain))),
            predicted=CHECKED_CONTRAST,
            estimator=ESTIMATORS["integrator"],
            assumption=CHECK,
        )

    return context.map("tolerance by simulation", simulated, points)


def is_printed(row: Mapping[str, Any]) -> bool:
    """Whether a row is on the page and in its JSON file; `--json` prints all rows."""
    quantity = row["quantity"]
    if not quantity.startswith(("drift", "line")):
        return True
    shown = any(f"of Z{noll} " in quantity for noll in _SHOWN_NOLLS) and quantity.endswith(_SHOWN_ENDS)
    return shown and row["estimator"] == ESTIMATORS["lqg"]


def plot(context: Context, path: Path) -> None:
    """Draw the tolerated drift of four modes against magnitude for each sensor (aplc only if requested)."""
    magnitudes = np.arange(0.0, 10.5, 0.5)
    names = context.names(*(name for name in SENSORS_COMPARED if name != "aplc"))

    def drifts(name: str, mode: int, quantum: bool = False) -> Array:
        residual_nm2 = contrasts_of(name).variance_nm2(mode, SHOWN_CONTRAST)
        pm_per_root_s = []
        for magnitude in magnitudes.tolist():
            noise = (quantum_noise_nm2 if quantum else frame_noise_nm2)(name, magnitude)
            drift = tolerated_drift(residual_nm2, float(noise[mode]), EXPOSURE, "lqg")
            pm_per_root_s.append(1e3 * np.sqrt(drift.step_nm2 * RATE_HZ))
        return np.array(pm_per_root_s)

    panels = []
    for noll in _SHOWN_NOLLS:
        mode = NOLLS_14.index(noll)
        lines = [Curve(name, magnitudes, drifts(name, mode)) for name in names]
        lines.append(Curve("quantum limit", magnitudes, drifts(names[0], mode, quantum=True)))
        panels.append(curves(lines, f"Z{noll} {mode_name(noll)}", "V", "drift, pm/sqrt(s)", "log", legend="lower left"))
    draw(path, panels, f"Drift of one mode that adds {SHOWN_CONTRAST:g} to the dark zone. {LOOP}", columns=2)
