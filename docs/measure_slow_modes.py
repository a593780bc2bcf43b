"""Measure how well the simulated loop holds slow drifts, mode by mode, and put the table into docs/tuning.md.

Example:
    python docs/measure_slow_modes.py            # measures, writes docs/slow_modes.json and the table
    python docs/measure_slow_modes.py --render   # the table again from docs/slow_modes.json
"""

from typing import Any

import numpy as np
import numpy.typing as npt
from law_bench import Bench, calibrated, configured
from measure import ROOT, command_line, host
from rich.progress import track
from threadpoolctl import threadpool_limits

from lowfc.adapters.instrument import frame_noise_nm
from lowfc.contract.configuration import Configuration
from lowfc.control.calibration import Calibration
from lowfc.design.fisher import cramer_rao, variance_e
from lowfc.optics.zernike import mode_name

Array = npt.NDArray[np.float64]

MEASURED = ROOT / "docs" / "slow_modes.json"
DOCUMENT = ROOT / "docs" / "tuning.md"
BEGIN, END = "<!-- slow modes: begin -->\n", "<!-- slow modes: end -->"

WINDOWS, WINDOW_S, SETTLE_S = 10, 100.0, 20.0
WANTED_PM = 20.0
RATE_HZ = 250.0
"""The configuration's own; photons per second are what counts, and the drift is a thousand times slower."""
EXPOSED = (0.5, 0.9)
"""Parts of a frame in which light is collected: the configuration's own, and what the loop's latency leaves of 4 ms."""
KEYS: dict[str, Any] = {
    "camera.rate_hz": RATE_HZ,
    "camera.read_noise_e": 1.0,
    "star.magnitude": 2.0,
    "disturbance.preset": "thermal",
    "control.start_mode": "closed",
}


def measure() -> dict[str, Any]:
    """Figures of every case."""
    found: dict[str, Any] = {"host": host(), "cases": {}}
    with threadpool_limits(1):
        for exposed in EXPOSED:
            found["cases"][f"{exposed:g}"] = case(configured(**KEYS | {"camera.exposure_fraction": exposed}))
    return found


def case(config: Configuration) -> dict[str, Any]:
    """What is left of each mode in the means over windows, rms over the windows, and what light and camera allow."""
    calibration = calibrated(config)
    bench = Bench(config, calibration)
    frames = round(WINDOW_S * RATE_HZ)
    left_nm, drift_nm, other_nm = (np.zeros((WINDOWS, len(config.noll))) for _ in range(3))
    bench.run(round(SETTLE_S * RATE_HZ))
    for window in track(range(WINDOWS), f"exposed for {config.camera.exposure_fraction:g} of a frame"):
        bench.forget()
        bench.run(frames)
        left_nm[window] = bench.residual_nm().mean(axis=0)
        drift_nm[window] = np.mean([truth.disturbance_nm for truth in bench.truths], axis=0, dtype=np.float64)
        command_nm = np.mean([step.command_nm for step in bench.steps], axis=0, dtype=np.float64)
        other_nm[window] = left_nm[window] - drift_nm[window] - command_nm
    light_e = calibration.flux_dn * config.camera.gain_e_per_dn
    bound_nm = photon_bound_nm(calibration, light_e * frames)
    noise_nm = frame_noise_nm(config, calibration) / np.sqrt(frames)
    columns = {
        "drift_nm": _rms(drift_nm),
        "left_pm": 1e3 * _rms(left_nm),
        "photon_bound_pm": 1e3 * bound_nm,
        "noise_pm": 1e3 * noise_nm,
        "mirror_pm": 1e3 * _rms(other_nm),
    }
    return {
        "light_e_per_s": light_e * RATE_HZ,
        "gain": config.control.gain,
        "tilt_gain": config.control.tilt_gain,
        "frames_refused": bench.refused,
        "modes": {
            f"{noll} {mode_name(noll)}": {name: float(values[place]) for name, values in columns.items()}
            for place, noll in enumerate(config.noll)
        },
    }


def photon_bound_nm(calibration: Calibration, light_e: float) -> Array:
    """The least standard deviation (modes,) that any unbiased estimate from so many electrons can have, nm."""
    H, I0 = calibration.response.astype(np.float64) * light_e, calibration.reference.astype(np.float64) * light_e
    return np.asarray(np.sqrt(np.diag(cramer_rao(H, variance_e(I0, 0.0)))))


def _rms(windows: Array) -> Array:
    """Rms (modes,) about zero of (windows, modes)."""
    return np.asarray(np.sqrt(np.mean(windows**2, axis=0)))


def render(measured: dict[str, Any]) -> str:
    """The table in Markdown, with the host it was measured on."""
    cases = measured["cases"]
    heads = ["mode", "drift, nm rms"]
    for name in cases:
        heads += [f"light for {name} of a frame: left, pm rms", "photon-noise bound, pm"]
        heads += ["photon and read noise through R, pm", f"below {WANTED_PM:g} pm"]
    heads.append("the mirror's part, pm rms")
    rows = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    first, *_ = cases.values()
    for mode, one in first["modes"].items():
        cells = [mode, f"{one['drift_nm']:.2f}"]
        for found in cases.values():
            of = found["modes"][mode]
            verdict = "yes" if of["left_pm"] < WANTED_PM else "no"
            cells += [f"**{of['left_pm']:.1f}**", f"{of['photon_bound_pm']:.1f}", f"{of['noise_pm']:.1f}", verdict]
        rows.append(f"| {' | '.join([*cells, format(one['mirror_pm'], '.1f')])} |")
    about = measured["host"]
    passed = ". ".join(
        f"Light for {name} of a frame, {found['light_e_per_s']:.3g} electrons a second: "
        f"{sum(one['left_pm'] < WANTED_PM for one in found['modes'].values())} of {len(found['modes'])} modes below "
        f"{WANTED_PM:g} pm, {found['frames_refused']} frames refused"
        for name, found in cases.items()
    )
    where = (
        f"{passed}. Disturbance `thermal`, `sam27d10_bal14`, V = {KEYS['star.magnitude']:g}, "
        f"{KEYS['camera.read_noise_e']:g} e- of read noise, {RATE_HZ:g} Hz; sensor images through the live loop's own "
        f"`advance` and the simulated mirror, as in lockstep; integrator with gains of {first['tilt_gain']:g} "
        f"(tilt) and {first['gain']:g}. Means of the true residual over windows of {WINDOW_S:g} s, rms about zero over "
        f"{WINDOWS} windows after {SETTLE_S:g} s; drift is the same of the disturbance. Measured {about['date']} by "
        "`python docs/measure_slow_modes.py`."
    )
    return "\n".join([*rows, "", where, ""])


if __name__ == "__main__":
    command_line(__doc__, MEASURED, DOCUMENT, measure, render, BEGIN, END)
