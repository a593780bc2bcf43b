"""Measure every sensor, alone and in the simulated loop, and put the table into docs/sensors.md.

Example:
    python docs/measure_sensors.py            # measures, writes docs/sensors.json and the table
    python docs/measure_sensors.py --render   # the table again from docs/sensors.json
"""

import json
import statistics
import subprocess
import sys
import tempfile
import time
from typing import Any

import numpy as np
from measure import ROOT, command_line, host
from rich.progress import track
from threadpoolctl import threadpool_limits

from lowfc.adapters import instrument
from lowfc.contract.configuration import SENSORS, Configuration, load, sensor_keys
from lowfc.control.calibration import Calibration, normalise_flux
from lowfc.optics.photometry import tilt_nm_per_mas
from lowfc.optics.sensor import light_budget, pupil_radii, reference, response, shear_response
from lowfc.optics.twin import Evaluator
from lowfc.optics.zernike import zernikes

MEASURED = ROOT / "docs" / "sensors.json"
DOCUMENT = ROOT / "docs" / "sensors.md"

LAYOUTS = ("sam18_sized", "sam27d07_bal14", "sam27d10_bal14", "sam27_crb20")
NAMES = (*(name for name in SENSORS if name != "open"), *LAYOUTS, "open")
RATE_HZ = 1000
COMMON = ["--rate", str(RATE_HZ), "--duration", "2", "--lockstep", "--no-record", "--json"]
PRESETS = ("bench", "reaction-wheel")
SHEAR = 1e-3
"""Pupil diameters."""


def configured(name: str, **changed: Any) -> Configuration:
    """The configuration behind `--sensor name` at the loop's rate."""
    keys = {f"sensor.{key}": value for key, value in sensor_keys(name).items()}
    return load(None, keys | {"camera.rate_hz": RATE_HZ} | changed)


def measure() -> dict[str, Any]:
    """Figures of every sensor."""
    found: dict[str, Any] = {"host": host(), "command": ["lowfc", "sim-loop", "--sensor", "NAME", *COMMON]}
    with threadpool_limits(1):
        found["sensors"] = {name: alone(name) for name in track(NAMES, "sensors alone")}
    for name in track(NAMES, "sensors in the loop"):
        found["sensors"][name]["loop"] = (
            {} if name == "open" else {preset: in_the_loop(name, preset) for preset in PRESETS}
        )
    return found


def alone(name: str) -> dict[str, Any]:
    """Light, condition and noise of a sensor, and the speed of its twin."""
    config = configured(name)
    optics = instrument.sensor(config, sys.exit)
    budget = light_budget(optics)
    twin = instrument.twin(config, None, sys.exit)
    evaluator, flat = Evaluator(twin), np.zeros(twin.used.size, np.float32)
    times_s = []
    for _ in range(300):
        begin = time.perf_counter()
        evaluator.image(flat)
        times_s.append(time.perf_counter() - begin)
    figures: dict[str, Any] = {
        "light": budget.total,
        "peak": budget.peak,
        "cond14": float(np.linalg.cond(response(optics, zernikes(config.noll, *pupil_radii(optics))))),
        "twin_us": 1e6 * statistics.median(times_s),
    }
    if name != "open":
        on_nodes = instrument.mirror_on_twin(config, twin, sys.exit)
        plain = instrument.analytic_calibration(config, twin, on_nodes)
        beside_shear = configured(name, **{"control.nuisance": ["shear"]})
        figures["noise_mas"] = tilt_noise_mas(config, plain)
        figures["noise_with_shear_mas"] = tilt_noise_mas(
            beside_shear, instrument.analytic_calibration(beside_shear, twin, on_nodes)
        )
        light = reference(optics).ravel()
        slopes = normalise_flux(light, shear_response(optics), np.ones(light.size))[1]
        taken_nm = SHEAR * np.linalg.norm(plain.reconstructor @ slopes, axis=0)
        figures["shear_taken_for_nm"] = float(np.sqrt(np.mean(taken_nm**2)))
    return figures


def tilt_noise_mas(config: Configuration, calibration: Calibration) -> float:
    """Noise of one frame's tip and tilt, rms of both axes, fitted with all modes."""
    noise_nm = instrument.frame_noise_nm(config, calibration)[:2]
    return float(np.sqrt(np.mean(noise_nm**2)) / tilt_nm_per_mas(config.star.diameter_m))


def in_the_loop(name: str, preset: str) -> dict[str, float]:
    """What the real processes leave of a disturbance."""
    with tempfile.TemporaryDirectory() as folder:
        words = [sys.executable, "-m", "lowfc", "sim-loop", "--sensor", name, "--disturbance", preset, *COMMON]
        done = subprocess.run(words, cwd=folder, stdout=subprocess.PIPE, text=True, check=True)
    wanted = ("disturbance_rms_nm", "residual_rms_nm", "tilt_disturbance_mas", "tilt_residual_mas")
    return {key: value for key, value in json.loads(done.stdout).items() if key in wanted}


def render(measured: dict[str, Any]) -> str:
    """The table in Markdown, with the host it was measured on."""
    loops = " | ".join(f"`{preset}`: nm rms | mas per axis" for preset in PRESETS)
    rows = [
        "| `--sensor` | light, % | peak, % | cond14 | tilt noise, mas | with shear | shear, nm | twin, us | "
        + loops
        + " |",
        "|---" * (8 + 2 * len(PRESETS)) + "|",
    ]
    for name, sensor in measured["sensors"].items():
        keys = ("noise_mas", "noise_with_shear_mas", "shear_taken_for_nm")
        noise = [f"{sensor[key]:.2f}" if key in sensor else "-" for key in keys]
        condition = f"{sensor['cond14']:.0f}" if sensor["cond14"] < 1e6 else f"{sensor['cond14']:.0e}"
        cells = [f"{100 * sensor['light']:.2f}", f"{100 * sensor['peak']:.2f}", condition, *noise]
        cells.append(f"{sensor['twin_us']:.0f}")
        for preset in PRESETS:
            run = sensor["loop"].get(preset)
            cells += (
                [
                    f"{run['disturbance_rms_nm']:.1f} -> {run['residual_rms_nm']:.2f}",
                    f"{run['tilt_disturbance_mas']:.2f} -> {run['tilt_residual_mas']:.2f}",
                ]
                if run
                else ["-", "-"]
            )
        rows.append(f"| {name} | {' | '.join(cells)} |")
    star, about = configured("sam"), measured["host"]
    where = (
        "Light is what falls on the detector, of all that enters the open circle; peak is the brightest pixel's share "
        "of it; cond14 is the condition number of H for Z2 to Z15. The noise is that of tip and tilt, rms of both "
        f"axes, in one frame of {star.exposure_ns / 1e6:g} ms of a star of V = {star.star.magnitude:g}, all "
        f"{len(star.noll)} modes fitted; then with the shear of the beam fitted along; then the wavefront, nm rms over "
        f"the circle, for which a shear of {100 * SHEAR:g} % of the diameter is taken otherwise. The twin's time is "
        "one frame's, on one thread. The loop's columns are open -> closed: the true wavefront over the open pupil "
        f"and the true tilt, in the second half of {COMMON[COMMON.index('--duration') + 1]} simulated seconds at "
        f"{RATE_HZ} Hz with the default gains. Measured {about['date']} on {about['processors']} cores of "
        f"{about['processor']} (load {about['load_before']} before) by `python docs/measure_sensors.py`, which runs "
        f"`{' '.join(measured['command'])}`."
    )
    return "\n".join([*rows, "", where, ""])


if __name__ == "__main__":
    command_line(__doc__, MEASURED, DOCUMENT, measure, render)
