"""Measure every control law in the simulated loop, beside its theory, and put the table into docs/tuning.md.

Example:
    python docs/measure_laws.py            # measures, writes docs/laws.json and the table
    python docs/measure_laws.py --render   # the table again from docs/laws.json
"""

from typing import Any

import numpy as np
from law_bench import RATE_HZ, Bench, calibrated, configured, tuned, with_lines_moved
from measure import BEGIN, END, ROOT, command_line, host
from rich.progress import track
from scipy.optimize import minimize
from threadpoolctl import threadpool_limits

from lowfc.adapters.instrument import frame_noise_nm
from lowfc.contract.configuration import Configuration
from lowfc.control.calibration import Calibration
from lowfc.control.kalman import lqg
from lowfc.control.linear_law import LinearLaw
from lowfc.control.margins import noise_gain, rejection
from lowfc.control.spectra import Pieces
from lowfc.control.vibration import Line, Model
from lowfc.optics.photometry import tilt_nm_per_mas
from sim_camera.disturbance import LINES_HZ
from sim_camera.process import disturbance_of

MEASURED = ROOT / "docs" / "laws.json"
DOCUMENT = ROOT / "docs" / "tuning.md"

CASES: dict[str, dict[str, Any]] = {
    "`sam27d10_bal14`, 14 modes": {},
    "`sam27d10_bal14`, 14 modes, two frames of delay": {"delay_frames": 2.0},
    "`sam27d10_bal14`, 2 modes": {"sensor.modes": 2},
    "`zwfs`, 14 modes": {"sensor": "zwfs"},
}
KINDS = ("integrator", "pi-notch", "lqg")
SHORTER = (8_000, 16_000)
"""Frames of the same loop, the last ones, from which an LQG law is made for comparison."""
IDENTIFY, SETTLE, MEASURE = 48_000, 12_000, 12_000
"""Frames of the closed loop that a law is identified from, until a law has settled, and over which it is measured."""
_NO_WIDTH_HZ = 1e-8
_DRIFT_BOUNDS = ((-5.0, 2.0), (-1.0, 2.6))
"""Decades of the walk's step, nm^2, and of its corner, Hz, between which the optimum is looked for."""


def measure() -> dict[str, Any]:
    """Figures of every case."""
    found: dict[str, Any] = {"host": host(), "cases": {}}
    with threadpool_limits(1):
        for name in track(CASES, "laws"):
            found["cases"][name] = case(configured(**CASES[name]))
    return found


def case(config: Configuration) -> dict[str, Any]:
    """What each law leaves of the reaction wheel, mas rms per axis, and the theory of it."""
    calibration = calibrated(config)
    bench = Bench(config, calibration)
    if config.camera.delay_frames > 1:
        bench.ask("gain", modes=(2, 3), values=(0.3,))
    bench.ask("close")
    bench.run(SETTLE)
    bench.forget()
    bench.run(IDENTIFY)
    figures: dict[str, Any] = {"identified_under_mas": bench.tilt_mas(IDENTIFY), "laws": {}}
    noise_nm = frame_noise_nm(config, calibration)[:2]
    figures["noise_mas"] = float(np.sqrt(np.mean(noise_nm**2)) / bench.nm_per_mas)
    run = bench.pol()
    laws = tuned(run, config, KINDS)
    figures["theory_by_frames_mas"] = {
        str(frames): float(np.hypot(*theory_mas(config, calibration, tuned(tilts(run, frames), config)["lqg"].law)))
        for frames in SHORTER
    }
    for kind, one in laws.items():
        bench.load(one.law)
        bench.forget()
        bench.run(SETTLE + MEASURE)
        S, T = theory_mas(config, calibration, one.law)
        figures["laws"][kind] = {
            "got_mas": bench.tilt_mas(MEASURE),
            "predicted_mas": float(np.sqrt(np.mean(one.predicted_nm[:2] ** 2)) / bench.nm_per_mas),
            "disturbance_mas": S,
            "noise_mas": T,
            "gain_margin": float(one.margins.gain_margin[:2].min()),
            "phase_margin_deg": float(one.margins.phase_margin_deg[:2].min()),
        }
    figures["optimum_mas"] = optimum_mas(config, calibration)
    figures["moved"] = moved(config, calibration, laws["lqg"].law)
    return figures


def tilts(run: Pieces, frames: int) -> Pieces:
    """The last frames of tip and tilt."""
    return Pieces((run.values[0][-frames:, :2],), 0)


def moved(config: Configuration, calibration: Calibration, law: LinearLaw) -> dict[str, float]:
    """The lines 2 % higher: under the law of before, and after identifying them again from that closed loop."""
    bench = Bench(config, calibration, with_lines_moved(disturbance_of(config), 1.02))
    bench.load(law)
    bench.ask("close")
    bench.run(SETTLE)
    bench.forget()
    bench.run(IDENTIFY)
    before = bench.tilt_mas(MEASURE)
    bench.load(tuned(bench.pol(), config)["lqg"].law)
    bench.run(SETTLE + MEASURE)
    return {"before_mas": before, "after_mas": bench.tilt_mas(MEASURE)}


def theory_mas(config: Configuration, calibration: Calibration, law: LinearLaw) -> tuple[float, float]:
    """What a law leaves of the disturbance's known sine waves, and what it makes of noise; rms of both axes, mas."""
    shaken, delay = disturbance_of(config), config.camera.delay_frames
    S = rejection(law, shaken.frequency_hz, delay)[:, :2]
    waves = np.mean(np.sum(np.abs(shaken.amplitude_nm[:, :2]) ** 2 / 2 * S**2, axis=0))
    noise = np.mean(frame_noise_nm(config, calibration)[:2] ** 2 * noise_gain(law, delay)[:2])
    nm_per_mas = tilt_nm_per_mas(config.star.diameter_m)
    return float(np.sqrt(waves) / nm_per_mas), float(np.sqrt(noise) / nm_per_mas)


def optimum_mas(config: Configuration, calibration: Calibration) -> float:
    """The least that an LQG law leaves in theory which knows the wheel's lines: without width, noise, the best drift.

    The simulated drift is a sum of sine waves, too: a log that is long enough to tell them apart leads below this.

    Raises:
        RuntimeError: the search ended at its edge: what it found is no least.
    """
    shaken, delay = disturbance_of(config), config.camera.delay_frames
    noise_nm = frame_noise_nm(config, calibration)[:2]
    best = []
    for axis in (0, 1):
        power = np.abs(shaken.amplitude_nm[:, axis]) ** 2 / 2
        known = tuple(Line(hz, _NO_WIDTH_HZ, float(power[shaken.frequency_hz == hz].sum())) for hz in LINES_HZ)
        variance = float(noise_nm[axis] ** 2)

        def left(
            drift: Any, axis: int = axis, power: Any = power, known: Any = known, variance: float = variance
        ) -> float:
            step, cutoff_hz = 10.0 ** np.asarray(drift)
            law = lqg([Model(step, cutoff_hz, known, variance, RATE_HZ)], (2 + axis,), delay)
            S = rejection(law, shaken.frequency_hz, delay)[:, 0]
            return float(power @ S**2 + variance * noise_gain(law, delay)[0])

        found = minimize(left, (-2.0, 0.7), method="Nelder-Mead", bounds=_DRIFT_BOUNDS, options={"xatol": 0.02})
        if any(min(x - low, high - x) < 0.05 for x, (low, high) in zip(found.x, _DRIFT_BOUNDS, strict=True)):
            raise RuntimeError(f"the least is not within {_DRIFT_BOUNDS}: ended at {found.x}")
        best.append(found.fun)
    return float(np.sqrt(np.mean(best)) / tilt_nm_per_mas(config.star.diameter_m))


def render(measured: dict[str, Any]) -> str:
    """The table in Markdown, with the host it was measured on."""
    rows = [
        "| sensor | law | tilt left, mas rms per axis | predicted from the log | of it disturbance, noise (theory) "
        "| gain margin | phase margin, deg |",
        "|---|---|---|---|---|---|---|",
    ]
    notes = []
    for name, one in measured["cases"].items():
        for kind, law in one["laws"].items():
            rows.append(
                f"| {name} | {kind} | **{law['got_mas']:.3f}** | {law['predicted_mas']:.3f} | "
                f"{law['disturbance_mas']:.3f}, {law['noise_mas']:.3f} | {law['gain_margin']:.1f} "
                f"| {law['phase_margin_deg']:.0f} |"
            )
        notes.append(
            f"- {name}: one frame's noise is {one['noise_mas']:.2f} mas; identified from a loop that left "
            f"{one['identified_under_mas']:.2f} mas; LQG left {beside(one)}; {shorter(one)}; "
            f"with the lines 2 % higher it left {one['moved']['before_mas']:.2f} mas, and "
            f"{one['moved']['after_mas']:.3f} after they were identified again from that very run."
        )
    about = measured["host"]
    where = (
        f"Reaction wheel, 14 mas rms per axis, V = 0, {RATE_HZ:g} Hz, sensor images through the live loop's own "
        f"`advance`; laws identified from {IDENTIFY / RATE_HZ:g} s of the closed loop, measured over "
        f"{MEASURE / RATE_HZ:g} s, {SETTLE / RATE_HZ:g} s after they were loaded. Measured {about['date']} by "
        "`python docs/measure_laws.py`."
    )
    return "\n".join([*rows, "", *notes, "", where, ""])


def beside(one: dict[str, Any]) -> str:
    """What LQG left, beside the theory of that very law and beside the optimum."""
    law = one["laws"]["lqg"]
    theory = float(np.hypot(law["disturbance_mas"], law["noise_mas"]))
    return (
        f"{law['got_mas'] / theory:.2f} times what theory gives for that law ({theory:.3f} mas), and "
        f"{law['got_mas'] / one['optimum_mas']:.2f} times the least of an LQG law that knows the wheel's lines exactly "
        f"and takes the drift for a random walk behind a low-pass ({one['optimum_mas']:.3f} mas)"
    )


def shorter(one: dict[str, Any]) -> str:
    """What theory gives for laws from less of the log."""
    each = (f"{mas:.3f} mas from {int(frames) / RATE_HZ:g} s" for frames, mas in one["theory_by_frames_mas"].items())
    return f"from less of that run theory gives for LQG {', '.join(each)}"


if __name__ == "__main__":
    command_line(__doc__, MEASURED, DOCUMENT, measure, render, BEGIN, END)
