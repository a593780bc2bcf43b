"""Every sensor, alone and in the simulated loop: the table of docs/explanation/sensors.md."""

import statistics
import sys
import tempfile
import timeit
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import track
from threadpoolctl import threadpool_limits

from lowfc.adapters.files import factory
from lowfc.contract.configuration import Configuration, load
from lowfc.contract.sections import SENSORS, sensor_keys
from lowfc.control.calibration.calibration import Calibration, normalise_flux
from lowfc.design.fisher import cramer_rao, quantum_information, variance_e2
from lowfc.optics.chain.sensor import light_budget, pupil_radii, reference, response, shear_response
from lowfc.optics.chain.zernike import zernikes
from lowfc.optics.detector.photometry import tilt_nm_per_mas
from lowfc.optics.twin.twin import Evaluator
from tools.law_bench import calibrated
from tools.shared import Results, json_of, markdown

LAYOUTS = ("sam18_sized", "sam27d07_bal14", "sam27d10_bal14", "sam27_crb20")
NAMES = (*(name for name in SENSORS if name != "open"), *LAYOUTS, "open")
RATE_HZ = 1000
DURATION_S = 2
GAINS = "[control]\ntilt_gain = 0.5\ngain = 0.05\n"
COMMAND = f"lowfc sim-loop --sensor NAME --rate {RATE_HZ} --duration {DURATION_S} --lockstep --no-record --config FILE"
PRESETS = ("bench", "reaction-wheel")
SHEAR = 1e-3
"""Shear whose wavefront error the table gives, pupil diameters."""


def configured(name: str, **changed: Any) -> Configuration:
    """The configuration of `--sensor name` at the loop's rate."""
    keys = {f"sensor.{key}": value for key, value in sensor_keys(name).items()}
    return load(None, keys | {"camera.rate_hz": RATE_HZ} | changed)


def measure() -> Results:
    """Measure every sensor, alone and in the loop."""
    with threadpool_limits(1):
        by_name = {name: alone(name) for name in track(NAMES, "sensors alone")}
    for name in track(NAMES, "sensors in the loop"):
        by_name[name]["loop"] = {} if name == "open" else {preset: in_the_loop(name, preset) for preset in PRESETS}
    return {"sensors": by_name}


def alone(name: str) -> Results:
    """Light, condition number and noise of a sensor, and the time of its twin for an image."""
    config = configured(name)
    optics = factory.sensor(config, sys.exit)  # a warning ends the measurement
    modes = zernikes(config.noll, *pupil_radii(optics))
    budget = light_budget(optics)
    twin = factory.twin(config, None, sys.exit)
    evaluator, flat = Evaluator(twin), np.zeros(twin.used.size, np.float32)
    times_s = timeit.repeat(lambda: evaluator.image(flat), repeat=300, number=1)
    results: Results = {
        "light": budget.total,
        "peak": budget.peak,
        "cond14": float(np.linalg.cond(response(optics, modes))),
        "twin_us": 1e6 * statistics.median(times_s),
    }
    if name != "open":
        on_nodes = factory.mirror_on_twin(config, twin, sys.exit)
        plain = factory.analytic_calibration(config, twin, on_nodes)
        with_shear = configured(name, **{"control.nuisance": ["shear"]})
        results["noise_mas"] = tilt_noise_mas(config, plain)
        results["noise_with_shear_mas"] = tilt_noise_mas(
            with_shear, factory.analytic_calibration(with_shear, twin, on_nodes)
        )
        in_band = configured(name, **{"sensor.wavelengths": 4})
        results["noise_in_band_mas"] = tilt_noise_mas(in_band, calibrated(in_band))
        light = reference(optics).ravel()
        bound = cramer_rao(response(optics, modes), variance_e2(light, 0.0))
        limit = np.linalg.inv(quantum_information(optics.pupil, modes, optics.wavelength_nm))
        results["quantum_share"] = float(np.median(np.diag(limit) / np.diag(bound)))
        slopes = normalise_flux(light, shear_response(optics), np.ones(light.size))[1]
        mistaken_nm = SHEAR * np.linalg.norm(plain.reconstructor @ slopes, axis=0)
        results["error_from_shear_nm"] = float(np.sqrt(np.mean(mistaken_nm**2)))
    return results


def tilt_noise_mas(config: Configuration, calibration: Calibration) -> float:
    """Noise of one frame's tip and tilt, per axis (rms of the two axes), fitted with all modes."""
    noise_nm = factory.frame_noise_nm(config, calibration)[:2]
    return float(np.sqrt(np.mean(noise_nm**2)) / tilt_nm_per_mas(config.star.diameter_m))


def in_the_loop(name: str, preset: str) -> dict[str, float]:
    """Disturbance and residual of the simulated loop, run by the real processes."""
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "FILE").write_text(GAINS)
        run = json_of(f"{COMMAND.replace('NAME', name)} --disturbance {preset}", folder)
    keys = ("disturbance_rms_nm", "residual_rms_nm", "tilt_disturbance_mas", "tilt_residual_mas")
    return {key: run[key] for key in keys}


def render(results: Results) -> str:
    """A row for each sensor."""
    head = [
        *(
            "`--sensor`",
            "light, %",
            "peak, %",
            "condition number",
            "quantum limit / Cramer-Rao bound, %",
            "tilt noise, mas",
        ),
        *("tilt noise in the band, mas", "tilt noise, shear fitted, mas", "error from shear, nm", "twin time, us"),
        *(f"`{preset}`: {column}" for preset in PRESETS for column in ("wavefront, nm rms", "tilt, mas rms per axis")),
    ]
    rows = []
    for name, sensor in results["sensors"].items():
        keys = ("noise_mas", "noise_in_band_mas", "noise_with_shear_mas", "error_from_shear_nm")
        cells = [name, f"{100 * sensor['light']:.2f}", f"{100 * sensor['peak']:.2f}"]
        cells.append(f"{sensor['cond14']:.0f}" if sensor["cond14"] < 1e6 else f"{sensor['cond14']:.0e}")
        cells.append(f"{100 * sensor['quantum_share']:.1f}" if "quantum_share" in sensor else "-")
        cells += [f"{sensor[key]:.2f}" if key in sensor else "-" for key in keys]
        cells.append(f"{sensor['twin_us']:.0f}")
        for preset in PRESETS:
            run = sensor["loop"].get(preset)
            cells.append(f"{run['disturbance_rms_nm']:.1f} -> {run['residual_rms_nm']:.2f}" if run else "-")
            cells.append(f"{run['tilt_disturbance_mas']:.2f} -> {run['tilt_residual_mas']:.2f}" if run else "-")
        rows.append(cells)
    star = configured("sam")
    return (
        f"{markdown(head, rows)}\nLight is the fraction of the light entering the open circle that falls on the "
        "detector; peak is the brightest pixel's share of that light. The condition number is that of H for Z2 to Z15. "
        "Quantum limit / Cramer-Rao bound is a ratio of variances: the median of the modes, without read noise. "
        "Tilt noise is the rms of the two axes in one frame of "
        f"{star.exposure_ns / 1e6:g} ms of a star of V = {star.star.magnitude:g}, with all {len(star.noll)} modes "
        "fitted and all photons at the central wavelength; then with "
        "the same photons over a band 20 % of the central wavelength wide, in four wavelengths; then with "
        "the shear of the beam as an additional "
        f"fitted parameter. Error from shear is the wavefront error, nm rms over the circle, from a shear of "
        f"{100 * SHEAR:g} % of the diameter that is not fitted. The twin's time is for one frame on one thread. "
        "The last columns are open loop -> closed loop for two disturbances: true wavefront over the open pupil, and "
        "true tilt, "
        f"in the second half of {DURATION_S} simulated seconds at "
        f"{RATE_HZ} Hz with gains of 0.5 for tilt and 0.05 for the other modes, set in FILE."
    )
