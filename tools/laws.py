"""Residual of every control law in the simulated loop, and in theory: two tables of docs/howto/tuning.md."""

from typing import Any

import numpy as np
from rich.progress import track
from scipy.optimize import minimize
from threadpoolctl import threadpool_limits

from lowfc.adapters.files.factory import frame_noise_nm
from lowfc.contract.configuration import Configuration
from lowfc.control.calibration.calibration import Calibration
from lowfc.control.laws.continuous import residual_power
from lowfc.control.laws.kalman import lqg_block
from lowfc.control.laws.linear_law import LinearLaw, integrator, law_from_blocks
from lowfc.control.laws.margins import noise_gain
from lowfc.control.laws.spectra import TimeSeries
from lowfc.control.laws.stability import highest_gain
from lowfc.control.laws.tuning import within_margins
from lowfc.control.laws.vibration import Line, Model
from lowfc.optics.detector.photometry import tilt_nm_per_mas
from sim_camera.disturbance import variances_nm2
from sim_camera.driver import disturbance_of
from tools.law_bench import RATE_HZ, Bench, calibrated, configured, timing_of, tuned, with_lines_moved
from tools.shared import Results, markdown

CASES: dict[str, dict[str, Any]] = {
    "`sam27d10_bal14`, 14 modes": {},
    "`sam27d10_bal14`, 14 modes, V = 2": {"star.magnitude": 2.0},
    "`sam27d10_bal14`, 14 modes, V = 5": {"star.magnitude": 5.0},
    "`sam27d10_bal14`, 14 modes, two frames of delay": {"delay_frames": 2.0},
    "`sam27d10_bal14`, 2 modes": {"sensor.modes": 2},
    "`zwfs`, 14 modes": {"sensor": "zwfs"},
}
KINDS = ("integrator", "pi-notch", "lqg")
SHORTER = (8_000, 16_000)
"""Numbers of the last frames of the same loop from which further LQG laws are identified for comparison."""
IDENTIFY, SETTLE, MEASURE = 48_000, 12_000, 12_000
"""Frames of the closed loop: for identification of a law, for settling, for the measurement."""
_DRIFT_BOUNDS = ((-5.0, 2.0), (-1.0, 4.0))
"""Bounds of the search for the optimum: log10 of the random walk's step, nm^2, and of its low-pass corner, Hz.

The highest corners are far above half the frame rate, where the low-pass has no effect; the optimum may be there.
"""


def measure() -> Results:
    """Results of every case."""
    with threadpool_limits(1):
        return {"cases": {name: case(configured(**CASES[name])) for name in track(CASES, "laws")}}


def case(config: Configuration) -> Results:
    """Residual of the reaction wheel under each law, mas rms per axis, in the simulated loop and in theory."""
    calibration = calibrated(config)
    bench = Bench(config, calibration)
    if config.camera.delay_frames > 1:
        bench.ask("gain", modes=(2, 3), values=(0.3,))
    bench.settle(SETTLE)
    bench.run(IDENTIFY)
    results: Results = {"identified_under_mas": bench.tilt_mas(IDENTIFY), "laws": {}}
    noise_nm = frame_noise_nm(config, calibration)[:2]
    results["noise_mas"] = float(np.sqrt(np.mean(noise_nm**2)) / bench.nm_per_mas)
    run = bench.pol()
    laws = tuned(run, config, KINDS)
    results["theory_by_frames_mas"] = {}
    for frames in SHORTER:
        last_tilts = TimeSeries((run.values[0][-frames:, :2],), 0)
        law = tuned(last_tilts, config)["lqg"].law
        results["theory_by_frames_mas"][str(frames)] = float(np.hypot(*theory_mas(config, calibration, law)))
    for kind, tuned_law in laws.items():
        bench.ask("law", law=tuned_law.law)
        bench.new_record()
        bench.run(SETTLE + MEASURE)
        disturbance_mas, noise_mas = theory_mas(config, calibration, tuned_law.law)
        results["laws"][kind] = {
            "got_mas": bench.tilt_mas(MEASURE),
            "predicted_mas": float(np.sqrt(np.mean(tuned_law.predicted_nm[:2] ** 2)) / bench.nm_per_mas),
            "disturbance_mas": disturbance_mas,
            "noise_mas": noise_mas,
            "gain_margin": float(tuned_law.margins.gain_margin[:2].min()),
            "phase_margin_deg": float(tuned_law.margins.phase_margin_deg[:2].min()),
        }
    results["optimum_mas"] = optimum_mas(config, calibration)
    results["moved"] = moved_lines_mas(config, calibration, laws["lqg"].law)
    return results


def moved_lines_mas(config: Configuration, calibration: Calibration, law: LinearLaw) -> dict[str, float]:
    """Residual with lines 2 % higher, mas rms per axis: with `law`, and with a law identified from the higher lines."""
    bench = Bench(config, calibration, with_lines_moved(disturbance_of(config), 1.02))
    bench.ask("law", law=law)
    bench.settle(SETTLE)
    bench.run(IDENTIFY)
    before = bench.tilt_mas(MEASURE)
    bench.ask("law", law=tuned(bench.pol(), config)["lqg"].law)
    bench.run(SETTLE + MEASURE)
    return {"before_mas": before, "after_mas": bench.tilt_mas(MEASURE)}


def theory_mas(config: Configuration, calibration: Calibration, law: LinearLaw) -> tuple[float, float]:
    """Theoretical tilt residual, mas rms per axis, in continuous time: the disturbance's part, and the noise's part."""
    frequency_hz, variance_nm2 = variances_nm2(disturbance_of(config))
    passed = residual_power(law, 2 * np.pi * frequency_hz / config.camera.rate_hz, timing_of(config))[:, :2]
    disturbance_nm2 = np.mean(np.sum(variance_nm2[:, :2] * passed, axis=0))
    noise_nm2 = np.mean(frame_noise_nm(config, calibration)[:2] ** 2 * noise_gain(law, config.camera.delay_frames)[:2])
    nm_per_mas = tilt_nm_per_mas(config.star.diameter_m)
    return float(np.sqrt(disturbance_nm2) / nm_per_mas), float(np.sqrt(noise_nm2) / nm_per_mas)


def tilt_residual_mas(config: Configuration) -> float:
    """Predicted tilt residual of the integrator, mas rms per axis, by a linear model for residuals of a few mas.

    The spectrum of sine waves, damped lines and steady wheels is known; square wave and static wavefront are left out.
    Photon and read noise propagate through R. For an automatic gain, the highest gain within the margins is used.
    """
    control, delay_frames = config.control, config.camera.delay_frames
    gain = highest_gain(delay_frames) if control.tilt_gain == "auto" else control.tilt_gain
    law = integrator([gain], [control.tilt_leak], (2,), delay_frames, config.camera.rate_hz)
    return float(np.hypot(*theory_mas(config, calibrated(config), law)))


def optimum_mas(config: Configuration, calibration: Calibration, *, robust: bool = False) -> float:
    """Theoretical residual of an LQG law with the wheel's exact lines, the noise and the best drift model.

    Args:
        config: the loop.
        calibration: calibration of the loop, for the noise of a frame.
        robust: keep the margins that `lowfc tune` requires.

    Raises:
        RuntimeError: the search ended at one of its bounds, other than the highest corner; this is no minimum.
    """
    disturbance, timing = disturbance_of(config), timing_of(config)
    frequency_hz, variance_nm2 = variances_nm2(disturbance)
    noise_nm = frame_noise_nm(config, calibration)[:2]

    def best_nm2(axis: int) -> float:
        power, variance = variance_nm2[:, axis], float(noise_nm[axis] ** 2)
        exact_lines = tuple(
            Line(line.frequency_hz, line.width_hz, float(line.rms_nm[axis] ** 2)) for line in disturbance.lines
        )

        def residual(drift: Any) -> float:
            step, cutoff_hz = 10.0 ** np.asarray(drift)
            model = Model(step, cutoff_hz, exact_lines, variance, RATE_HZ)
            block = within_margins(model, timing) if robust else lqg_block(model, timing)
            if block is None:
                return np.inf
            law = law_from_blocks([block], "pol", "lqg", (2 + axis,), timing.delay, RATE_HZ)
            passed = residual_power(law, 2 * np.pi * frequency_hz / RATE_HZ, timing)[:, 0]
            return float(power @ passed + variance * noise_gain(law, timing.delay)[0])

        minimum = minimize(residual, (-2.0, 0.7), method="Nelder-Mead", bounds=_DRIFT_BOUNDS, options={"xatol": 0.02})
        (step, corner), ((lowest_step, highest_step), (lowest_corner, _)) = minimum.x, _DRIFT_BOUNDS
        if min(step - lowest_step, highest_step - step, corner - lowest_corner) < 0.05:
            raise RuntimeError(f"no minimum within {_DRIFT_BOUNDS}: ended at {minimum.x}")
        return float(minimum.fun)

    return float(np.sqrt(np.mean([best_nm2(0), best_nm2(1)])) / tilt_nm_per_mas(config.star.diameter_m))


def render(results: Results) -> str:
    """A table with a row for each case and law, and a table of LQG with a row for each case."""
    head = (
        *("sensor", "law", "residual tilt, mas rms per axis", "predicted from the identified model, mas"),
        *("in theory, mas: disturbance part, noise part", "gain margin", "phase margin, deg"),
    )
    rows = [
        (
            *(name, kind, f"**{law['got_mas']:.3f}**", f"{law['predicted_mas']:.3f}"),
            f"{law['disturbance_mas']:.3f}, {law['noise_mas']:.3f}",
            *(f"{law['gain_margin']:.1f}", f"{law['phase_margin_deg']:.0f}"),
        )
        for name, one in results["cases"].items()
        for kind, law in one["laws"].items()
    ]
    first, *_ = results["cases"].values()
    shorter = [f"theory, identified from {int(frames) / RATE_HZ:g} s" for frames in first["theory_by_frames_mas"]]
    lqg_head = (
        *("sensor; LQG, tilt in mas rms per axis", "noise of a frame", "residual during identification"),
        *("theory", "residual / theory", "exact lines", "residual / exact lines", *shorter),
        *("lines 2 % higher", "lines 2 % higher, identified again"),
    )
    return (
        f"{markdown(head, rows)}\n{markdown(lqg_head, map(_lqg_row, results['cases'].items()))}\nReaction wheel with "
        f"damped lines, 14 mas rms per axis, V = 0 unless stated, {RATE_HZ:g} Hz; the residual is the true tilt in "
        "continuous time (8 samples in each frame). The live loop's own `advance` processes blurred sensor images. "
        f"Laws are identified from {IDENTIFY / RATE_HZ:g} s of the closed loop; the residual is measured over "
        f"{MEASURE / RATE_HZ:g} s, {SETTLE / RATE_HZ:g} s after a law was loaded. Exact lines: the residual of an LQG "
        "law with the exact lines of the wheel, and a random walk behind a low-pass as drift. Theory: both parts of "
        "the first table, added in quadrature; identified from 8 or 16 s: of laws from only the last 8 or 16 s of "
        "that time. Lines 2 % higher: the residual of the LQG law when the lines have moved, and after identification "
        "from that run."
    )


def _lqg_row(case: tuple[str, Results]) -> tuple[str, ...]:
    name, one = case
    lqg = one["laws"]["lqg"]
    theory_mas = float(np.hypot(lqg["disturbance_mas"], lqg["noise_mas"]))
    return (
        *(name, f"{one['noise_mas']:.2f}", f"{one['identified_under_mas']:.2f}"),
        *(f"{theory_mas:.3f}", f"{lqg['got_mas'] / theory_mas:.2f}"),
        *(f"{one['optimum_mas']:.3f}", f"{lqg['got_mas'] / one['optimum_mas']:.2f}"),
        *(f"{mas:.3f}" for mas in one["theory_by_frames_mas"].values()),
        *(f"{one['moved']['before_mas']:.2f}", f"{one['moved']['after_mas']:.3f}"),
    )
