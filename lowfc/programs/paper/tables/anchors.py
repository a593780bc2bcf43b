"""Published results of other systems, and lowfc's results by the same definitions, with the assumptions."""

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from math import sqrt
from pathlib import Path
from typing import Any

import numpy as np

from lowfc.adapters.logs.history import History, read_history
from lowfc.adapters.logs.reader import LogReader
from lowfc.arrays import Array
from lowfc.contract.codecs.input_file import user_path
from lowfc.contract.errors import LowfcError
from lowfc.control.laws.continuous import Timing
from lowfc.control.laws.kalman import lqg
from lowfc.control.laws.spectra import time_series
from lowfc.control.laws.tuning import identify_modes, predicted_nm
from lowfc.design.paper import TABLE4_MAS
from lowfc.design.tolerance import best_gain, drift_residual_nm2
from lowfc.design.trials import noisy_e
from lowfc.optics.chain.zernike import NOLLS_14, mode_name
from lowfc.optics.detector.photometry import tilt_nm_per_mas
from lowfc.programs.paper.cases import Context, Row, prepared, section_of
from lowfc.programs.paper.dark_hole import GAINS, SHIFTED, STEPS, dark_hole
from lowfc.programs.paper.plots import Line as Curve
from lowfc.programs.paper.plots import curves, draw
from lowfc.programs.paper.tables import pointing, tolerance

LOOP_SENSORS = ("sam", "zwfs_tuned")
"""Sensors for which loops are run."""
RATE_HZ, MAGNITUDE, EXPOSURE = 1000.0, 2.0, 0.5  # exposure: as a fraction of the period
OBSERVED_S, CLOSED_S, MEAN_S = 10.0, 24.0, 2.0
"""Durations of the loop from which a law is identified, of the loop that is judged, and of a mean as in SCExAO."""
ROMAN_MAS, SCEXAO_MAS = 0.4, {"laboratory": 0.02, "sky": 0.15}
AVERAGED_S = 100.0
DRIFT_PM = 20.0  # per root second, in each mode
REACHED, NOT_REACHED = "reached", "not reached"

ABOUT = """This page compares lowfc with other low-order wavefront control. An anchor is a published value (*paper*) and
lowfc's value by the same definition. *limit* is lowfc's value with noise at the quantum limit of the light, unless the
assumption says otherwise. [Sensors](../explanation/sensors.md) describes each sensor.

Loops are the real processes in lockstep. Their tilt is that of the true wavefront, in continuous time, over the second
half of a run; means as in SCExAO are of the tilt at the start of each exposure, from 4 s on. The verdict is "reached"
if the predicted value, or lowfc's value if there is no prediction, is at most the published one. The tilt scatter of
`clowfs_tuned` and `zwfs_tuned` is compared with that of the paper's CLOWFS.
"""
LOOP = (
    f"lowfc sim-loop --lockstep: V = {MAGNITUDE:g}, 2 m, {RATE_HZ:g} Hz, exposure of half the period, delay of one "
    "frame, 14 modes, 1 e- read noise, monochromatic with the photons of 110 nm; true tilt, rms per axis."
)
ROMAN = (
    "Roman (WFIRST) coronagraph, Milestone 6 (Shi et al., final report, 2015): about 14 mas of jitter (AAS 17-115) "
    "reduced to less than 0.4 mas rms per axis for most reaction-wheel speeds. lowfc: preset reaction-wheel has five "
    "lines, 0.5 % wide, up to 117 Hz, and drift; in reaction-wheel-ideal the lines have no width, as on a testbed. "
    f"LQG is identified from {OBSERVED_S:g} s of the closed loop. limit: predicted from the log, with the noise of the "
    "quantum limit; one run may be below it. A mirror that holds its command for a frame leaves 0.72 mas of these "
    "lines at 1 kHz with any sensor, and 0.36 mas at 2 kHz: 0.4 mas needs a faster loop or weaker lines."
)
SCEXAO = (
    f"SCExAO LLOWFS (Singh et al.): standard deviation of the tilt's means over {MEAN_S:g} s, per axis, "
    "at 8.2 m and 1.6 um. lowfc: 2 m, 550 nm, where 0.15 mas is 0.0026 lambda/D; for SCExAO it is 0.0037. "
    "Laboratory: preset bench, integrator; sky: reaction-wheel, LQG."
)
HICAT = (
    f"{STEPS} random steps of 2 nm rms of surface on a dark hole's channel (V = -2): fraction that the loop undoes. "
    "HiCAT digs its dark hole while its low-order loop runs (A&A 663, A49, 2022; arXiv 2301.03242). The verdict is "
    "'reached' if the fraction is at most 1 %."
)
HUNDRED = (
    f"Standard deviation of a mode's mean over {AVERAGED_S:g} s of frames at {tolerance.RATE_HZ:g} Hz, V = 2, "
    "wavefront flat, all 14 modes fitted. predicted: from the noise of one frame."
)
AGAINST_V = (
    f"Drift of {DRIFT_PM:g} pm/sqrt(s) in each of 14 modes, integrators with the best gains, {tolerance.RATE_HZ:g} Hz: "
    "contrast that the residual of drift and noise adds to the dark zone of the sensor's coronagraph."
)


def anchors(context: Context) -> list[Row]:
    """Rows of every anchor, with a verdict if there is a published value."""
    names = context.names(*LOOP_SENSORS)
    rows = [row for name in names for row in _pointing(context, name)]
    if "sam" in context.names("sam"):
        rows += _hicat(context)
    rows += _table4(context)
    rows += [row for name in names for row in _hundred_seconds(context, name)]
    return rows + [row for name in context.names(*tolerance.SENSORS_COMPARED) for row in _added_contrast_rows(name)]


def _with_verdict(row: Row, allowed: float | None = None) -> list[Row]:
    """A row, and its verdict if there is an allowed or published value; judges `predicted`, or else `measured`."""
    limit = row.paper if allowed is None else allowed
    ours = row.measured if row.predicted is None else row.predicted
    if limit is None:
        return [row]
    assert isinstance(ours, float)  # noqa: S101  # compared values are numbers
    assert isinstance(limit, float)  # noqa: S101
    verdict = Row(row.name, f"verdict, {row.quantity}", "", REACHED if ours <= limit else NOT_REACHED)
    return [row, replace(verdict, modes=row.modes, estimator=row.estimator, assumption=row.assumption)]


def _pointing(context: Context, name: str) -> list[Row]:
    """Rows of the tilt as in Roman's milestone, and of the tilt's means as for SCExAO's sensor."""
    rows: list[Row] = []
    nm_per_mas = tilt_nm_per_mas(2.0)
    new_row = partial(Row, name, unit="mas", modes=len(NOLLS_14))
    with tempfile.TemporaryDirectory() as path:
        folder = Path(path)
        sensor_toml = _sensor_toml(name)
        (folder / "gains.toml").write_text(f"{GAINS}{sensor_toml}")
        for preset in ("reaction-wheel", "reaction-wheel-ideal"):
            context.progress(f"anchors {name}, {preset}", len(rows), 12)
            observed = _history(folder / _sim_loop(preset, folder, "gains.toml", OBSERVED_S, context.seed)["log"])
            law = folder / f"{preset}.fits"
            _lowfc(folder, "tune", str(observed.log.path), "--controller", "lqg", "--out", str(law))
            (folder / "law.toml").write_text(f'{GAINS}law = "{law}"\n{sensor_toml}')
            run = _sim_loop(preset, folder, "law.toml", CLOSED_S, context.seed + 1000)
            limit = _quantum_pointing_nm(observed, name) / nm_per_mas
            new_lqg_row = partial(new_row, estimator="LQG")
            rows.append(new_row(f"open-loop tilt, {preset}", measured=run["tilt_disturbance_mas"], assumption=LOOP))
            rows += _with_verdict(
                new_lqg_row(
                    f"residual tilt, {preset}",
                    measured=run["tilt_residual_mas"],
                    paper=ROMAN_MAS,
                    limit=limit,
                    assumption=f"{LOOP}\n{ROMAN}",
                )
            )
            if preset == "reaction-wheel":
                rows += _with_verdict(_means_row(new_lqg_row, _history(folder / run["log"]), "sky"))
        context.progress(f"anchors {name}, bench", 9, 12)
        run = _sim_loop("bench", folder, "gains.toml", CLOSED_S, context.seed)
        rows += _with_verdict(
            _means_row(partial(new_row, estimator="integrator"), _history(folder / run["log"]), "laboratory")
        )
    return rows


def _means_row(new_row: Callable[..., Row], history: History, site: str) -> Row:
    """Row of the standard deviation of the true tilt's means over `MEAN_S`, after the first four seconds."""
    truths = history.true
    assert truths is not None  # noqa: S101  # a simulated loop logs the truth
    frames = round(MEAN_S * RATE_HZ)
    tilt_nm = truths.residual_nm[2 * frames :, :2].astype(np.float64)
    blocks = len(tilt_nm) // frames
    means = tilt_nm[: blocks * frames].reshape(blocks, frames, 2).mean(axis=1) / tilt_nm_per_mas(2.0)
    spread = float(np.sqrt(means.var(axis=0, ddof=1).mean()))
    return new_row(
        f"std of {MEAN_S:g} s means of tilt, {site}",
        measured=spread,
        paper=SCEXAO_MAS[site],
        error=spread / np.sqrt(4.0 * (blocks - 1)),
        assumption=f"{LOOP}\n{SCEXAO}",
    )


def _quantum_pointing_nm(history: History, name: str) -> float:
    """Residual tilt, nm rms per axis, predicted for LQG on this log's disturbance with noise at the quantum limit."""
    steps = history.steps
    models = identify_modes(time_series(steps.sequence, steps.pol_nm[:, :2]), RATE_HZ)
    scale = (EXPOSURE / RATE_HZ) / (tolerance.EXPOSURE / tolerance.RATE_HZ)
    noise = tolerance.quantum_noise_nm2(name, MAGNITUDE)[:2] / scale
    models = [replace(model, noise_nm2=float(n)) for model, n in zip(models, noise, strict=True)]
    timing = Timing.of(1.0, EXPOSURE)
    return float(np.sqrt(np.mean(predicted_nm(lqg(models, NOLLS_14[:2], timing), models, timing) ** 2)))


def _hicat(context: Context) -> list[Row]:
    """Rows of the fraction of a dark hole's steps that the loop undoes, and of the verdict."""
    context.progress("anchors, a dark hole while the loop runs", 10, 12)
    with tempfile.TemporaryDirectory() as folder:
        undone, error = dark_hole(Path(folder), 2.0, seed=context.seed).channels[SHIFTED].undone()
    row = Row(
        "sam", "fraction of a dark hole's steps undone", "%", abs(100 * undone), error=100 * error, assumption=HICAT
    )
    return _with_verdict(row, allowed=1.0)


def _table4(context: Context) -> list[Row]:
    """Rows of the paper's Table 4 by its own definition: tip and tilt fitted, 1 mas, 0.05 s of V = 4.83."""
    names = context.names("sam", "sam18_sized", "clowfs_tuned", "zwfs_tuned")
    rows = pointing.table4(replace(context, sensors=names))
    scatter = "std of x tilt, 1 mas, own photometry"
    chosen = [row for row in rows if (row.quantity, row.modes, row.estimator) == (scatter, 2, "weighted")]
    papers = {"clowfs_tuned": TABLE4_MAS["clowfs"][1], "zwfs_tuned": TABLE4_MAS["clowfs"][1]}
    return [each for row in chosen for each in _with_verdict(replace(row, paper=papers.get(row.name, row.paper)))]


def _hundred_seconds(context: Context, name: str) -> Iterator[Row]:
    """Rows of the noise of each mode's mean over `AVERAGED_S`, simulated as one exposure: all light and read noise."""
    frames = AVERAGED_S * tolerance.RATE_HZ
    sensor, light_e = prepared(name), tolerance.light_e(MAGNITUDE)
    normalised_I0, R = sensor.loop_fit(sensor.I0, sensor.H[:, : len(NOLLS_14)], light_e, tolerance.READ_NOISE_E)

    def trial(i: int) -> Array:
        rng = context.rng("anchors", name, i)
        image = noisy_e(rng, sensor.I0 * light_e * frames, tolerance.READ_NOISE_E * np.sqrt(frames))
        return np.asarray(R @ (image / image.sum() - normalised_I0))

    measured = np.array(context.map(f"anchors {name}, 100 s", trial, range(context.trials))).std(axis=0, ddof=1)
    predicted = np.sqrt(tolerance.frame_noise_nm2(name, MAGNITUDE) / frames)
    limit = np.sqrt(tolerance.quantum_noise_nm2(name, MAGNITUDE) / frames)
    modes_pm = 1e3 * np.column_stack([measured, predicted, limit])
    for noll, (measured_pm, predicted_pm, limit_pm) in zip(NOLLS_14, modes_pm.tolist(), strict=True):
        yield Row(
            name,
            f"std of {AVERAGED_S:g} s mean, Z{noll} {mode_name(noll)}",
            "pm",
            measured_pm,
            error=measured_pm / sqrt(2 * (context.trials - 1)),
            predicted=predicted_pm,
            limit=limit_pm,
            modes=len(NOLLS_14),
            estimator="weighted",
            assumption=HUNDRED,
        )


def added_contrast(name: str, magnitude: float, quantum: bool = False) -> float:
    """Contrast added by the residual of drift and noise, with the best gains; `quantum`: noise at the quantum limit."""
    noise = (tolerance.quantum_noise_nm2 if quantum else tolerance.frame_noise_nm2)(name, magnitude)
    step_nm2 = (DRIFT_PM / 1e3) ** 2 / tolerance.RATE_HZ  # variance of the drift in a period
    residual_nm2 = [
        drift_residual_nm2(step_nm2, n, tolerance.EXPOSURE, best_gain(step_nm2, n, tolerance.EXPOSURE))
        for n in noise.tolist()
    ]
    return float(sum(tolerance.contrasts_of(name).added(mode, each) for mode, each in enumerate(residual_nm2)))


def _added_contrast_rows(name: str) -> Iterator[Row]:
    for magnitude in tolerance.MAGNITUDES:
        yield Row(
            name,
            f"added contrast, V = {magnitude:g}",
            "",
            added_contrast(name, magnitude),
            limit=added_contrast(name, magnitude, quantum=True),
            modes=len(NOLLS_14),
            estimator="integrator, best gain",
            assumption=AGAINST_V,
        )


def plot(context: Context, path: Path) -> None:
    """Draw the added contrast against magnitude for each sensor (aplc only if requested) and for the quantum limit."""
    magnitudes = np.arange(0.0, 10.5, 0.5)
    names = context.names(*(name for name in tolerance.SENSORS_COMPARED if name != "aplc"))
    lines = [
        Curve(name, magnitudes, np.array([added_contrast(name, V) for V in magnitudes.tolist()])) for name in names
    ]
    least = np.array([added_contrast(names[0], V, quantum=True) for V in magnitudes.tolist()])
    lines.append(Curve("quantum limit", magnitudes, least))
    panel = curves(lines, "added contrast", "V", "contrast", "log", legend="upper left")
    draw(path, [panel], AGAINST_V, wide=True)


def _sensor_toml(name: str) -> str:
    """Section [sensor] of a configuration file in another folder: the path of a layout file is made absolute."""
    keys = section_of(name).model_dump(exclude_unset=True)
    if keys.get("sam", "").partition(":")[0].endswith(".json"):
        keys["sam"] = str(Path.cwd() / user_path(keys["sam"]))
    return "\n".join(["[sensor]", *(f"{key} = {json.dumps(value)}" for key, value in keys.items()), ""])


def _sim_loop(preset: str, folder: Path, config: str, duration_s: float, seed: int) -> dict[str, Any]:
    source = ("--rate", f"{RATE_HZ:g}", "--disturbance", preset, "--star-magnitude", f"{MAGNITUDE:g}")
    run = ("--lockstep", "--duration", f"{duration_s:g}", "--seed", str(seed), "--config", config)
    return _lowfc(folder, "sim-loop", *source, *run)


def _lowfc(folder: Path, *arguments: str) -> dict[str, Any]:
    """JSON printed by a command; LowfcError if it failed."""
    command = [sys.executable, "-P", "-m", "lowfc", *arguments, "--json"]
    process = subprocess.run(  # noqa: S603  # our own program
        command, cwd=folder, capture_output=True, text=True, check=False
    )
    if process.returncode:
        raise LowfcError(
            f"`lowfc {' '.join(arguments)}` ended with exit status {process.returncode}: {process.stderr.strip()}"
        )
    printed: dict[str, Any] = json.loads(process.stdout)
    return printed


def _history(log: Path) -> History:
    return read_history(LogReader(log))
