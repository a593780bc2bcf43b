"""Results of a what-if: the residual of a log with other gains, another reconstructor or another controller."""

from dataclasses import replace
from typing import Any

import numpy as np

from lowfc.adapters.files.factory import contrast_or_none, detector, equivalent_read_noise_e
from lowfc.adapters.logs.columns import count_reasons
from lowfc.adapters.logs.recovery import missing_end_text
from lowfc.arrays import Array, Mask, Single
from lowfc.contract.codecs.calibration_codec import with_identity
from lowfc.contract.errors import CalibrationError, ConfigurationError, raised_as
from lowfc.contract.messages import MIRROR_STATE
from lowfc.control.calibration.calibration import ESTIMATORS, Calibration, reconstructor
from lowfc.control.laws.continuous import continuous_residual_nm2
from lowfc.control.laws.integrator import TIP_TILT, Integrator
from lowfc.control.laws.stability import limiting_gain
from lowfc.control.laws.what_if import counterfactual, limited_integrator, rms
from lowfc.control.loop.safety import Limit
from lowfc.control.loop.wording import counted
from lowfc.optics.chain.zernike import mode_name
from lowfc.optics.detector.photometry import tilt_nm_per_mas
from lowfc.programs.cli.contrast import added_contrast, added_contrast_in_words, with_variances
from lowfc.programs.cli.result import table
from lowfc.programs.cli.status import holds_shape
from lowfc.programs.logs.what_if.options import LAW_KEYS, WhatIf, law, logged_gains
from lowfc.programs.logs.what_if.run import LoggedRun

LINEAR_WAVES = 5 * tilt_nm_per_mas(2.0) / 550
"""Rms of a mode up to which the sensor is assumed linear: 5 mas of tilt with 2 m at 550 nm, 0.022 waves."""

_LIMITS = (Limit.MODAL_LIMIT, Limit.STROKE, Limit.SLEW, Limit.NEIGHBOUR)
_TITLES = {
    "open": "open loop",
    "was": "as logged",
    "what_if": "what if",
    "true_was": "true as logged",
    "true_what_if": "true what if",
    "continuous_was": "continuous as logged",
    "continuous_what_if": "continuous what if",
}


def what_if(run: LoggedRun, changes: WhatIf) -> dict[str, Any]:
    """Results of the logged run and of the what-if run.

    The what-if loop is closed throughout, starts from a flat mirror, and corrects the pseudo-open-loop modes of every
    used frame; at a refused or missing frame it holds its command, as the live loop does. Its modal limits act,
    actuator limits do not. All results are over the same frames: frames without saturated pixels, with the logged loop
    closed, after both loops have settled. If no frame of the closed loop is usable, the logged loop may be in any mode.
    If the log has truth, the true residual is given, too: the measured one is mostly noise for a faint star. For
    another reconstructor the frames are read in a second pass.
    """
    user_step, noll = changes.step, run.calibration.noll
    new_law = law(changes, noll, run.law)
    calibration = _calibration(changes, run)

    was_nm, seen_nm = run.steps.error_nm, run.seen_nm
    if calibration is run.calibration:
        error_nm = was_nm
    else:
        error_nm = run.measured_again(calibration)
        seen_nm = _in_other_modes(run.calibration, calibration, seen_nm)
    pol_nm = error_nm - seen_nm
    what_if_nm, command_nm = counterfactual(user_step or limited_integrator(new_law), run.weights, pol_nm, run.missing)

    usable = run.used & np.isfinite(what_if_nm).all(axis=1)
    lost = np.count_nonzero(run.used & ~usable)
    rows, settling, compared = run.rows_to_compare([run.law, new_law], usable)
    contrast = None
    columns = {"open": rms(pol_nm, rows), "was": rms(was_nm, rows), "what_if": rms(what_if_nm, rows)}
    if run.true_nm is not None:
        true, contrast = _true_residuals(run, rows, what_if_nm - pol_nm - seen_nm, command_nm)
        columns |= true
    return {
        "log": str(run.history.log.path),
        "complete": run.history.log.complete,
        "rate_hz": run.history.rate_hz,
        "frames": len(rows),
        "frames_compared": int(rows.sum()),
        "compared": compared,
        "settling_s": settling / run.history.rate_hz,
        "frames_refused": int(np.count_nonzero(~run.used)),
        "frames_saturated": int(np.count_nonzero(run.used & (run.steps.saturated_pixels > 0))),
        "frames_missing": int(run.missing.sum()),
        "delay_frames": run.delay_frames,
        "delay_controller_frames": run.controller_delay,
        "delay_measured_frames": run.measured_delay,
        "controller": changes.controller or "integrator",
        "estimator": calibration.estimator,
        "calibration": calibration.id,
        "modes": [
            {"noll": index, "name": mode_name(index), **_law_values(run.law, row, "_was")}
            | ({} if user_step else _law_values(new_law, row))
            | {f"{name}_nm": float(values[row]) for name, values in columns.items()}
            for row, index in enumerate(noll)
        ],
        **{f"{name}_nm": float(np.sqrt(np.sum(values**2))) for name, values in columns.items()},
        **_tilt_mas(run, columns),
        "added_contrast": contrast,
        "warnings": [
            *_log_warnings(run),
            *([f"the log lacks {counted(int(lost), 'used frame')}: the what-if holds its command"] if lost else []),
            *_range_warnings(run.calibration, columns),
            *_prior_warnings(run, calibration, None if user_step else new_law),
            *([] if user_step else _automatic_warnings(changes, noll)),
            *([] if user_step else _law_warnings(run, new_law, command_nm[rows])),
        ],
    }


def _true_residuals(
    run: LoggedRun, rows: Mask, moved_nm: Single, command_nm: Single
) -> tuple[dict[str, Array], dict[str, Any] | None]:
    """Rms (modes,) in nm of the true residual, at starts of exposures and continuous, as logged and for the what-if.

    `moved_nm` (steps, modes) is the what-if's command minus the logged one, as seen by each exposure; `command_nm` is
    the what-if's command. The second value is the contrast that the continuous residual adds to the dark zone, or None.
    """
    assert run.true_nm is not None  # noqa: S101  # the caller has checked it
    disturbance_nm, residual_nm = (values.astype(np.float64) for values in run.true_nm)
    found, covariances = dict[str, Array](), dict[str, Array | None]()
    with_truth = rows & np.isfinite(residual_nm).all(axis=1)
    fraction = run.simulated_delay % 1
    for name, after_nm, law_nm in (
        ("was", residual_nm, run.steps.command_nm),
        ("what_if", residual_nm + moved_nm, command_nm),
    ):
        if with_truth.any():
            found[f"true_{name}"] = rms(after_nm, with_truth)
        squares = np.full(after_nm.shape, np.nan)
        for piece in np.split(np.arange(len(rows)), np.flatnonzero(run.missing)):
            mirror_nm, next_nm = (after_nm - disturbance_nm)[piece], None
            if fraction:  # the sampled residual has the weighted mean of the two commands that the exposure sees
                move_nm = _move_nm(law_nm[piece], run.simulated_delay)
                mirror_nm, next_nm = mirror_nm - (1 - fraction) * move_nm, mirror_nm + fraction * move_nm
            squares[piece] = continuous_residual_nm2(disturbance_nm[piece], mirror_nm, run.moves_at, next_nm)
        with_squares = rows & np.isfinite(squares).all(axis=1)
        if with_squares.any():
            found[f"continuous_{name}"] = np.sqrt(squares[with_squares].mean(axis=0))
            sampled_nm2 = after_nm[with_squares].T @ after_nm[with_squares] / np.count_nonzero(with_squares)
            covariances[name.replace("_", " ")] = with_variances(sampled_nm2, found[f"continuous_{name}"])
    contrast = added_contrast(contrast_or_none(run.history.configuration), covariances)
    return {name: found[name] for name in _TITLES if name in found}, contrast


def _move_nm(command_nm: Single, delay_frames: float) -> Single:
    """The mirror's move (steps, modes) within each exposure, from the older command to the newer one."""
    newer, older = (np.roll(command_nm, int(delay_frames) + later, axis=0) for later in (0, 1))
    return newer - older


def render(results: dict[str, Any]) -> str:
    """The results of `what_if` as a table."""
    columns = [name for name in _TITLES if f"{name}_nm" in results]

    def row(title: str, values: dict[str, Any], key: str, gain: str = "") -> list[str]:
        return [title, *(f"{values[key.format(name)]:.2f}" for name in columns), gain]

    rows = []
    for mode in results["modes"]:
        gain = f"{mode['gain_was']:.3g} -> {mode['gain']:.3g}" if "gain" in mode else ""  # a user's controller has none
        rows.append(row(f"{mode['noll']:>3} {mode['name']}", mode, "{}_nm", gain))
    rows.append(row("all modes", results, "{}_nm"))
    if "tilt_was_mas" in results:
        rows.append(row("tilt per axis, mas", results, "tilt_{}_mas"))
    lines = [
        f"{results['frames_compared']} of {results['frames']} frames compared: {results['compared']}, after "
        f"{results['settling_s']:.2g} s of settling; {results['frames_refused']} were refused, "
        f"{results['frames_saturated']} saturated, {results['frames_missing']} missing",
        f"delay {results['delay_frames']:.2f} frames, {results['estimator']} reconstructor, {results['controller']}",
        "",
        *table(["residual, nm rms", *(_TITLES[name] for name in columns), "gain"], rows),
        "",
        "measured values include sensor noise; true: at the start of each exposure; continuous: true, at all times, "
        "with the mirror held between its moves; the what-if assumes a linear sensor and no actuator limits",
        *([] if results["added_contrast"] is None else [added_contrast_in_words(results["added_contrast"])]),
        *(f"warning: {warning}" for warning in results["warnings"]),
    ]
    return "\n".join(lines)


def _calibration(changes: WhatIf, run: LoggedRun) -> Calibration:
    """The calibration of the what-if; by default the log's."""
    calibration, estimator = run.calibration, changes.estimator
    if changes.calibration is not None:
        from lowfc.adapters.files.calibration_file import load as load_calibration  # the import of astropy is slow

        calibration = load_calibration(changes.calibration)
        for name in ("noll", "shape", "grid"):
            got, expected = getattr(calibration, name), getattr(run.calibration, name)
            if got != expected:
                raise CalibrationError(f"{changes.calibration}: its {name} is {got}, in the log it is {expected}")
    elif estimator is None and changes.config is not None:
        estimator = "+".join((changes.config.control.estimator, *changes.config.control.nuisance))
    if estimator in (None, calibration.estimator):
        return run.calibration if calibration.id == run.calibration.id else calibration
    if estimator not in ESTIMATORS:
        raise ConfigurationError(
            f"--config: {estimator}: nuisance parameters require the sensor's optics; leave out control.nuisance, or "
            "make that calibration and give it with --calibration"
        )
    return _reconstructed(calibration, estimator, run)


def _reconstructed(calibration: Calibration, estimator: str, run: LoggedRun) -> Calibration:
    path, configuration = run.history.log.path, run.history.configuration
    if configuration is None:
        raise ConfigurationError(f"{path} has no configuration, so the noise of a pixel is unknown")
    camera = detector(configuration)
    with raised_as(CalibrationError, ValueError, f"{path}: {estimator} reconstructor"):
        R = reconstructor(
            calibration.reference.astype(float),
            calibration.response.astype(float),
            calibration.good.astype(float),
            calibration.flux_dn * camera.gain_e_per_dn / camera.em_gain,
            equivalent_read_noise_e(camera),
            estimator,
        )
    return with_identity(replace(calibration, reconstructor=R.astype(np.float32), estimator=estimator))


def _in_other_modes(logged: Calibration, other: Calibration, command_nm: Single) -> Single:
    """Convert commands (steps, modes) of the logged calibration to those of the other for the same mirror shape."""
    if np.array_equal(other.modes_to_actuators, logged.modes_to_actuators):
        return command_nm
    change = np.linalg.pinv(other.modes_to_actuators.astype(float)) @ logged.modes_to_actuators.astype(float)
    return np.asarray(command_nm @ change.T, np.float32)


def _law_values(law: Integrator, row: int, suffix: str = "") -> dict[str, float]:
    return {f"{key}{suffix}": round(float(getattr(law, key)[row]), 6) for key in LAW_KEYS}


def _tilt_mas(run: LoggedRun, columns: dict[str, Array]) -> dict[str, float]:
    """Tilt per axis on the sky; empty if the telescope's diameter is unknown."""
    tilts = np.isin(run.calibration.noll, TIP_TILT)
    if run.history.configuration is None or not tilts.any():
        return {}
    nm_per_mas = tilt_nm_per_mas(run.history.configuration.star.diameter_m)
    return {
        f"tilt_{name}_mas": float(np.sqrt(np.mean(rms_nm[tilts] ** 2))) / nm_per_mas for name, rms_nm in columns.items()
    }


def _log_warnings(run: LoggedRun) -> list[str]:
    found, log = list(run.history.remarks), run.history.log
    if log.damage:
        parts = ", ".join(f"byte {one.position}, {one.why}" for one in log.damage)
        found.append(f"the log is damaged; left out: {parts}")
    if not log.finished:
        found.append(missing_end_text(log.paths, finished=False))
    if log.metadata.get("recording", {}).get("stopped"):
        found.append(f"recording stopped: {log.metadata['recording']['stopped']}")
    if run.measured_delay is None:
        found.append(
            f"the delay could not be measured in this log; the controller's value is used: {run.delay_frames:g}"
        )
    elif run.delay_frames != run.controller_delay:
        found.append(
            f"the controller assumed a delay of {counted(float(run.controller_delay), 'frame')}, but the mean measured "
            f"from {run.measured_from} is {run.measured_delay:.2f}: pseudo-open-loop modes were recomputed with the "
            "measured delay"
        )
    counts = count_reasons(run.steps.reasons).items()
    acted = [f"{reason.name.lower()} at {counted(count, 'frame')}" for reason, count in counts if reason in _LIMITS]
    if acted:
        found.append(f"limits acted in the logged run ({', '.join(acted)}); in the what-if only modal limits act")
    if count := np.count_nonzero(run.history.mirror.limits):
        recorded = "" if log.selection.records_all(MIRROR_STATE) else f" (recorded: {log.selection.description})"
        found.append(
            f"the mirror's own limits acted on {counted(int(count), 'command')}{recorded}: pseudo-open-loop modes are "
            "wrong there"
        )
    if any(map(holds_shape, run.history.controllers)):
        true = "" if run.true_nm is None else ", and true values include the shapes of both"
        found.append(f"an offset or channels were in force: the open loop is relative to the offset{true}")
    if changes := sum(one.accepted and one.name in LAW_KEYS for one in run.history.requests):
        found.append(f"gain or leak changed {counted(changes, 'time')} in the logged run; the last values are shown")
    if laws := sorted({state.law.name for state in run.history.controllers if state.HasField("law")}):
        found.append(
            f"a linear law ({', '.join(laws)}) was in use in the logged run: gains and settling time as logged are "
            "those of the integrator in reserve"
        )
    if before := np.count_nonzero(~run.history.under_calibration):
        found.append(
            f"another calibration or camera setting was in use for {counted(int(before), 'step')}; modes and rate are "
            "those of the other steps"
        )
    if lost := np.count_nonzero(run.command_lost):
        found.append(
            f"the log lacks some commands: {counted(int(lost), 'frame')} exposed with a missing command, and the "
            "settling time after each, are left out"
        )
    return found


def _range_warnings(calibration: Calibration, columns: dict[str, Array]) -> list[str]:
    limit_nm = LINEAR_WAVES * calibration.wavelength_nm
    largest = np.max([columns[name] for name in ("open", "was", "what_if")], axis=0)
    beyond = [
        f"{mode_name(index)} with {value:.1f} nm"
        for index, value in zip(calibration.noll, largest, strict=True)
        if value > limit_nm
    ]
    if not beyond:
        return []
    return [
        f"beyond the sensor's linear range of {limit_nm:.1f} nm rms per mode: {', '.join(beyond)}; the results are "
        "only approximate"
    ]


def _prior_warnings(run: LoggedRun, calibration: Calibration, law: Integrator | None) -> list[str]:
    uncorrected = run.uncorrected
    if not uncorrected.any() or (
        calibration is run.calibration and law is not None and not law.gain[uncorrected].any()
    ):
        return []
    names = ", ".join(mode_name(index) for index in np.array(run.calibration.noll)[uncorrected].tolist())
    return [
        f"the logged reconstructor has a prior for the modes that automatic gains did not correct ({names}): the "
        "what-if measures with the same prior, even if it corrects such a mode"
    ]


def _automatic_warnings(changes: WhatIf, noll: tuple[int, ...]) -> list[str]:
    unchanged = logged_gains(changes, noll)
    if not unchanged.any():
        return []
    names = ", ".join(mode_name(index) for index in np.array(noll)[unchanged].tolist())
    return [f"automatic gains of --config are not computed: {names} keep the logged gains; give --set gain=..."]


def _law_warnings(run: LoggedRun, law: Integrator, command_nm: Single) -> list[str]:
    """Remarks on instability and modal limits of the what-if with its commands `command_nm` (frames, modes)."""
    found = []
    noll = run.calibration.noll
    # A measured delay is a mean over punctual and late frames, not a constant fractional delay: round it up.
    delay_frames = run.delay_frames if run.delay_frames == run.controller_delay else np.ceil(run.delay_frames)
    highest = {leak: limiting_gain(delay_frames, leak) for leak in set(law.leak.tolist())}
    unstable = [
        f"{mode_name(index)} from a gain of {highest[leak]:.2f} on"
        for index, gain, leak in zip(noll, law.gain.tolist(), law.leak.tolist(), strict=True)
        if gain >= highest[leak]
    ]
    if unstable:
        found.append(
            f"the what-if is unstable with a delay of {counted(float(delay_frames), 'frame')}: {', '.join(unstable)}"
        )
    limited = [
        f"{mode_name(index)} at {counted(int(count), 'frame')}"
        for index, count in zip(noll, np.count_nonzero(np.abs(command_nm) >= law.limit_nm, axis=0), strict=True)
        if count
    ]
    if limited:
        found.append(f"modal limits act in the what-if: {', '.join(limited)}")
    return found
