"""Residual and added contrast with each imperfection of the simulated bench: the table of docs/measured/world.md."""

from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from rich.progress import track
from threadpoolctl import threadpool_limits

from lowfc.adapters.files import factory
from lowfc.contract.configuration import Configuration
from lowfc.control.calibration.calibration import Calibration
from sim_camera.driver import scene
from tools.law_bench import Bench, calibrated, configured
from tools.shared import Results, markdown

SENSORS, MAGNITUDES = ("sam27d10_bal14", "zwfs"), (2, 5)
PRESET, RATE_HZ, SECONDS = "bench", 500.0, 4.0
_UNTIL_GAINS_S = 2.5  # simulated before the automatic gains are read; longer than the first window of their estimate
_FRAMES = 2000  # averaged for the dark and for the reference image
WHEEL = {"disturbance.wheel_hz": 12.0}
CASES: dict[str, dict[str, Any]] = {
    "none": {},
    "a steady wheel": WHEEL,
    "a wheel whose speed ramps": WHEEL | {"disturbance.wheel_change": 2.0},
    "a wheel whose speed wanders": WHEEL | {"disturbance.wheel_course": "walk", "disturbance.wheel_change": 0.5},
    "a wheel that runs down": WHEEL | {"disturbance.wheel_course": "run-down", "disturbance.wheel_change": 3.0},
    "two wheels that beat": WHEEL | {"disturbance.second_wheel_hz": 0.5},
    "jitter above half the frame rate": {"disturbance.jitter_mas": 1.0},
    "drift as a random walk": {"disturbance.drift_nm": {str(noll): 0.2 for noll in range(2, 16)}},
    "drift with a 1/f spectrum": {
        "disturbance.drift_nm": {str(noll): 0.2 for noll in range(2, 16)},
        "disturbance.drift_slope": 1.0,
    },
    "shear of the beam": {"disturbance.shear": 1e-3},
    "actuator gain errors": {"mirror.gain_error": 0.1},
    "hysteresis": {"mirror.hysteresis": 0.1},
    "creep": {"mirror.creep": 0.01},
    "dark current": {"camera.dark_current_e_s": 1000.0},
    "hot pixels": {"camera.hot_pixels": 0.005},
    "nonlinear pixel response": {"camera.nonlinearity": 0.02},
    "pixel gain errors": {"camera.nonuniformity": 0.01},
}
CALIBRATED = ("hot pixels", "nonlinear pixel response", "pixel gain errors")
"""Cases that are repeated with dark and reference image measured on that detector."""


def measure() -> Results:
    """Measure every case with each sensor and star."""
    rows = []
    with threadpool_limits(1):
        for name, keys in track(CASES.items(), "cases"):
            for calibrate_detector in (False, True) if name in CALIBRATED else (False,):
                pairs = [(sensor, magnitude) for sensor in SENSORS for magnitude in MAGNITUDES]
                figures = [_residual(*pair, keys, calibrate_detector) | {"of": pair} for pair in pairs]
                rows.append({"name": name, "keys": keys, "calibrated": calibrate_detector, "figures": figures})
    return {"rows": rows, "seconds": SECONDS}


def _configured(sensor: str, magnitude: float, keys: dict[str, Any]) -> Configuration:
    base: dict[str, Any] = {"disturbance.preset": PRESET, "star.magnitude": float(magnitude), "camera.rate_hz": RATE_HZ}
    return configured(sensor, **base | {"control.start_mode": "closed"} | keys)


@lru_cache
def _gains(sensor: str, magnitude: float) -> tuple[float, ...]:
    """First automatic gains (modes,) of the loop without imperfections; most of the later ones are lower."""
    automatic = {"control.tilt_gain": "auto", "control.gain": "auto"}
    config = _configured(sensor, magnitude, automatic)
    bench = Bench(config, calibrated(config))
    bench.run(round(_UNTIL_GAINS_S * RATE_HZ))
    assert bench.state.loop is not None  # noqa: S101  # a calibration is loaded
    return tuple(bench.state.loop.integrator.gain.tolist())


def _residual(sensor: str, magnitude: float, keys: dict[str, Any], calibrate_detector: bool) -> Results:
    """Residual wavefront over the open pupil, nm rms, and added contrast, in continuous time; second half of the run.

    With `calibrate_detector`, dark and reference image are measured on the detector of the case.
    """
    config = _configured(sensor, magnitude, keys)
    calibration = calibrated(config)
    bench = Bench(config, _calibrated_on_detector(config, calibration) if calibrate_detector else calibration)
    bench.ask("gain", modes=config.noll, values=_gains(sensor, magnitude))
    frames = round(SECONDS * RATE_HZ)
    bench.run(frames)
    truths = bench.truths[-frames // 2 :]
    modes_nm = np.concatenate([truth.instants_nm[1] for truth in truths]).astype(float)
    modal = factory.contrast_of(config)
    squares_nm2 = [truth.continuous.residual_rms_nm**2 for truth in truths if truth.continuous is not None]
    return {
        "residual_nm": float(np.sqrt(np.mean(squares_nm2))),
        "contrast": float(np.einsum("nj,jl,nl->", modes_nm, modal.form, modes_nm)) / len(modes_nm),
        "refused": bench.frames_refused,
    }


def _calibrated_on_detector(config: Configuration, calibration: Calibration) -> Calibration:
    """The calibration with dark and reference image averaged from frames of this detector."""
    quiet = config.disturbance.model_copy(update={"preset": "quiet"})
    flat = np.zeros(calibration.grid, np.float32)
    means = []
    for magnitude in (20.0, config.star.magnitude):
        star = config.star.model_copy(update={"magnitude": magnitude})
        simulated = scene(config.model_copy(update={"disturbance": quiet, "star": star}))
        means.append(np.mean([simulated.expose(index, flat).ravel() for index in range(_FRAMES)], axis=0))
    light = means[1] - means[0]
    reference = light / light.sum() * calibration.reference.sum()
    return replace(calibration, dark=means[0].astype(np.float32), reference=reference.astype(np.float32))


def render(results: Results) -> str:
    """A row for each case."""
    rows = results["rows"]
    head = ["imperfection", "keys"]
    for sensor, magnitude in (one["of"] for one in rows[0]["figures"]):
        star = f"`{sensor}`, V = {magnitude}"
        head += [f"{star}: residual, nm rms", f"{star}: added contrast"]
    lines = []
    for row in rows:
        keys = ", ".join(f"`{key} = {_shown(value)}`" for key, value in row["keys"].items())
        name = row["name"] + (", dark and I0 measured" if row["calibrated"] else "")
        cells = [(f"{one['residual_nm']:.2f}", f"{one['contrast']:.1e}") for one in row["figures"]]
        lines.append([name, keys, *(cell for pair in cells for cell in pair)])
    return (
        f"{markdown(head, lines)}\nResidual: true wavefront over the open pupil, in continuous time. Added contrast: "
        "mean over the dark zone, from the quadratic form of the modes. Both are of the second half of "
        f"{results['seconds']:g} s at {RATE_HZ:g} Hz, with the disturbance `{PRESET}` and one seed. Gains: the first "
        f"automatic ones of the loop without imperfections, read {_UNTIL_GAINS_S:g} s after its start; from 4 s on, "
        "most gains of modes other than tilt are lower. The live loop's own `advance` processes the sensor images and "
        "commands the simulated mirror. The calibration is analytic and includes no imperfection except dark current; "
        '"dark and I0 measured" means on the detector of that row.'
    )


def _shown(value: object) -> str:
    return f"{{2..15 = {next(iter(value.values()))}}}" if isinstance(value, dict) else str(value)
