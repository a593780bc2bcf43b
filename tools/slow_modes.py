"""Mean residual of each mode over long windows of the simulated loop: the slow modes of docs/howto/tuning.md."""

from typing import Any

import numpy as np
from rich.progress import track
from threadpoolctl import threadpool_limits

from lowfc.adapters.files.factory import frame_noise_nm
from lowfc.arrays import Array
from lowfc.contract.configuration import FIXED_GAINS, Configuration
from lowfc.design.fisher import cramer_rao, variance_e2
from lowfc.optics.chain.zernike import mode_name
from tools.law_bench import Bench, calibrated, configured
from tools.shared import Results, markdown

WINDOWS, WINDOW_S, SETTLE_S = 10, 100.0, 20.0
TARGET_PM = 20.0
RATE_HZ = 250.0
"""Frame rate, the default. The result depends on the light per second, not on the rate, because the drift is at
least 500 times slower than the frames."""
EXPOSURE_FRACTIONS = (0.5, 0.9)
"""Exposures as fractions of a period: the default, and one that leaves the loop 0.4 ms of the 4 ms period."""
KEYS: dict[str, Any] = {
    "camera.rate_hz": RATE_HZ,
    "camera.read_noise_e": 1.0,
    "star.magnitude": 2.0,
    "disturbance.preset": "thermal",
    "control.start_mode": "closed",
    **FIXED_GAINS,
}


def measure() -> Results:
    """Results of every case."""
    configurations = {
        f"{fraction:g}": configured(**KEYS | {"camera.exposure_fraction": fraction}) for fraction in EXPOSURE_FRACTIONS
    }
    with threadpool_limits(1):
        return {"cases": {name: case(config) for name, config in configurations.items()}}


def case(config: Configuration) -> Results:
    """Mean residual of each mode over windows, rms over the windows; photon-noise bound, and noise through R."""
    calibration = calibrated(config)
    bench = Bench(config, calibration)
    frames = round(WINDOW_S * RATE_HZ)
    residual_nm, drift_nm, mirror_error_nm = (np.zeros((WINDOWS, len(config.noll))) for _ in range(3))
    bench.run(round(SETTLE_S * RATE_HZ))
    for window in track(range(WINDOWS), f"exposure {config.camera.exposure_fraction:g} of the period"):
        bench.new_record()
        bench.run(frames)
        residual_nm[window] = bench.residual_nm(continuous=False).mean(axis=0)
        drift_nm[window] = np.mean([truth.sampled.disturbance_nm for truth in bench.truths], axis=0, dtype=np.float64)
        command_nm = np.mean([step.command_nm for step in bench.steps], axis=0, dtype=np.float64)
        mirror_error_nm[window] = residual_nm[window] - drift_nm[window] - command_nm
    light_e = calibration.flux_dn * config.camera.gain_e_per_dn
    H, I0 = (array.astype(np.float64) * (light_e * frames) for array in (calibration.response, calibration.reference))
    bound_nm = np.sqrt(np.diag(cramer_rao(H, variance_e2(I0, 0.0))))
    noise_nm = frame_noise_nm(config, calibration) / np.sqrt(frames)
    columns = {
        "drift_nm": _rms(drift_nm),
        "residual_pm": 1e3 * _rms(residual_nm),
        "photon_bound_pm": 1e3 * bound_nm,
        "noise_pm": 1e3 * noise_nm,
        "mirror_pm": 1e3 * _rms(mirror_error_nm),
    }
    return {
        "light_e_per_s": light_e * RATE_HZ,
        "gain": config.control.gain,
        "tilt_gain": config.control.tilt_gain,
        "frames_refused": bench.frames_refused,
        "modes": {
            f"{noll} {mode_name(noll)}": {name: float(values[index]) for name, values in columns.items()}
            for index, noll in enumerate(config.noll)
        },
    }


def _rms(windows: Array) -> Array:
    """Rms (modes,) about zero of (windows, modes)."""
    return np.asarray(np.sqrt(np.mean(windows**2, axis=0)))


def render(results: Results) -> str:
    """A row for each mode."""
    cases = results["cases"]
    first, *_ = cases.values()
    head = ["mode", "drift, nm rms"]
    for name in cases:
        head += [f"exposure {name} of the period: residual, pm rms", "photon-noise bound, pm"]
        head += ["photon and read noise through R, pm", f"residual below {TARGET_PM:g} pm"]
    head.append(f"mirror error (applied minus commanded), exposure {next(iter(cases))} of the period, pm rms")
    rows = []
    for mode, one in first["modes"].items():
        cells = [mode, f"{one['drift_nm']:.2f}"]
        for result in (found["modes"][mode] for found in cases.values()):
            verdict = "yes" if result["residual_pm"] < TARGET_PM else "no"
            cells += [f"**{result['residual_pm']:.1f}**", f"{result['photon_bound_pm']:.1f}"]
            cells += [f"{result['noise_pm']:.1f}", verdict]
        rows.append([*cells, f"{one['mirror_pm']:.1f}"])
    passed = ". ".join(
        f"Exposure {name} of the period, {found['light_e_per_s']:.3g} electrons a second: "
        f"{sum(one['residual_pm'] < TARGET_PM for one in found['modes'].values())} of {len(found['modes'])} modes "
        f"below {TARGET_PM:g} pm, {found['frames_refused']} frames refused"
        for name, found in cases.items()
    )
    return (
        f"{markdown(head, rows)}\n{passed}. Disturbance `thermal`, `sam27d10_bal14`, "
        f"V = {KEYS['star.magnitude']:g}, {KEYS['camera.read_noise_e']:g} e- of read noise, {RATE_HZ:g} Hz; the "
        "live loop's `advance` processes the sensor images and drives the simulated mirror, as in lockstep; integrator "
        "with gains "
        f"of {first['tilt_gain']:g} (tilt) and {first['gain']:g}. Means of the true residual over windows of "
        f"{WINDOW_S:g} s, rms about zero over {WINDOWS} windows after {SETTLE_S:g} s; the column drift is the "
        "same statistic of the disturbance."
    )
