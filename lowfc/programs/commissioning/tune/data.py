"""Data for tuning: pseudo-open-loop modes of a log or of a running loop."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lowfc.adapters.files.factory import contrast_of, frame_noise_nm2
from lowfc.adapters.logs.columns import Steps, steps_as_columns
from lowfc.adapters.logs.history import read_history
from lowfc.adapters.logs.reader import LogReader
from lowfc.arrays import Array, Mask, Single
from lowfc.client import Client, MirrorWatch, configuration_of
from lowfc.contract.codecs.law_codec import driving, gains_of
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import BusError, DataFileError
from lowfc.control.calibration.calibration import Calibration
from lowfc.control.laws.continuous import Timing
from lowfc.control.laws.integrator import Integrator
from lowfc.control.laws.linear_law import LinearLaw
from lowfc.control.laws.spectra import TimeSeries, time_series
from lowfc.control.laws.vibration import FEWEST
from lowfc.control.loop.inputs import Step
from lowfc.control.loop.safety import LoopMode
from lowfc.control.loop.wording import counted
from lowfc.optics.chain.added_contrast import ModalContrast
from lowfc.optics.detector.photometry import tilt_nm_per_mas
from lowfc.programs.logs.what_if.run import LoggedRun

_SETTLING_S = 0.5  # time excluded after the loop was closed


@dataclass(frozen=True, slots=True)
class Telemetry:
    """Modal errors and control law of a run, nm rms of wavefront.

    Attributes:
        source: path of the log, or name of the run.
        noll: Noll index of each mode.
        timing: delay and exposure of the loop, measured if possible.
        law: the integrator's gains; `driving` is the linear law in force instead, if any.
        closed: whether the loop was closed in these frames.
        pol: pseudo-open-loop modes (frames, modes), in pieces without gaps.
        error: modal error of the same frames (frames, modes).
        true_nm2: mean products of the true residual over these frames (modes, modes); None if unknown.
        nm_per_mas: wavefront rms of a tilt of 1 mas; None if the telescope's diameter is unknown.
        contrast: contrast added by the modes, with `noise_nm2`, the computed covariance (modes, modes) of one frame's
            noise; None without a science image.
        warnings: doubts about the results.
    """

    source: str
    noll: tuple[int, ...]
    rate_hz: float
    timing: Timing
    law: Integrator
    driving: LinearLaw | None
    closed: bool
    pol: TimeSeries
    error: TimeSeries
    true_nm2: Array | None
    nm_per_mas: float | None
    contrast: ModalContrast | None
    noise_nm2: Array | None
    warnings: tuple[str, ...]


def telemetry_from_log(log: LogReader) -> Telemetry:
    """The used closed-loop frames of a log; all used frames if there are too few of them.

    Frames with a probe sequence, as in an acceptance test, are excluded: a law must not learn from them.
    """
    history = read_history(log)
    run = LoggedRun(history)
    steps = run.steps
    same = run.delay_frames == run.controller_delay
    pol_nm = steps.pol_nm if same else steps.error_nm - run.seen_nm
    usable = run.used & np.isfinite(pol_nm).all(axis=1) & ~run.torn & ~run.played & (steps.saturated_pixels == 0)
    mode = np.where(run.played, np.uint8(0), steps.mode)  # the loop also settles after a probe sequence
    warnings = list(history.remarks)
    if not same:
        warnings.append(
            f"the controller assumed a delay of {run.controller_delay:g} frames, but measured from "
            f"{run.measured_from} it is {run.measured_delay:.2f}: the law is made for {run.delay_frames:g} frames; set "
            "control.delay_frames"
        )
    if log.damage:
        warnings.append("the log is damaged; unreadable parts are left out")
    config = history.configuration
    return _telemetry(
        str(log.path),
        history.rate_hz,
        run.timing,
        (run.law, driving(history.controller, history.published.laws)),
        replace(steps, pol_nm=pol_nm, mode=mode),
        usable,
        None if run.true_nm is None else run.true_nm[1],
        config,
        run.calibration,
        warnings,
    )


def telemetry_from_run(loop: Client, seconds: float, progress: Callable[[float], None] | None = None) -> Telemetry:
    """The steps of a running loop in the next `seconds`."""
    state = loop.status().state
    calibration = loop.calibration()
    config = configuration_of(loop)
    if seconds * config.camera.rate_hz < FEWEST:
        needed_s = FEWEST / config.camera.rate_hz
        raise DataFileError(
            f"run {loop.run_id!r}: tuning requires at least {FEWEST} consecutive frames, {needed_s:.3g} s at "
            f"{config.camera.rate_hz:g} Hz, but got {seconds:g} s: use --live {np.ceil(1.2 * needed_s):.0f}"
        )
    watch = _watched(loop)
    begun_s = time.monotonic()
    steps: list[Step] = []
    stream = loop.steps()
    for step in stream:
        steps.append(step)
        passed_s = time.monotonic() - begun_s
        if len(steps) % 100 == 0 and progress is not None:
            progress(passed_s)
        if len(steps) % 100 == 0 and watch is not None:
            watch.read()
        if passed_s >= seconds:
            break
    stream.close()
    if state is None or not state.gain:
        raise DataFileError(f"run {loop.run_id!r} has no calibration: load one with `lowfc ctl load`")
    columns = steps_as_columns(steps, len(calibration.noll))
    period_s = float(np.median(np.diff(columns.time_ns))) * 1e-9 if len(steps) > 1 else 0.0
    rate_hz = 1 / period_s if period_s > 0 else config.camera.rate_hz
    return _telemetry(
        loop.run_id,
        rate_hz,
        _timing(float(state.delay_frames), config.camera.exposure_fraction, columns, watch, rate_hz),
        (gains_of(state), driving(state, loop.laws())),
        columns,
        np.isfinite(columns.pol_nm).all(axis=1) & (columns.saturated_pixels == 0),
        None,
        config,
        calibration,
        [f"{counted(stream.lost, 'step')} lost on the way to this command"] if stream.lost else [],
    )


def _watched(loop: Client) -> MirrorWatch | None:
    try:
        return loop.mirror_watch()
    except BusError:  # reports of a user's mirror are optional
        return None


def _timing(delay: float, exposure: float, steps: Steps, watch: MirrorWatch | None, rate_hz: float) -> Timing:
    """Times at which commands are applied, from the mirror's latest reports."""
    ended_ns = dict(zip(steps.sequence.tolist(), steps.time_ns.tolist(), strict=True))
    applied = () if watch is None else watch.applied
    waited_ns = [time_ns - ended_ns[sequence] for sequence, time_ns in applied if sequence in ended_ns]
    if not waited_ns:
        return Timing.of(delay, exposure)
    return Timing.measured(delay, exposure, float(np.median(waited_ns)) * 1e-9 * rate_hz)


def _telemetry(
    source: str,
    rate_hz: float,
    timing: Timing,
    laws: tuple[Integrator, LinearLaw | None],
    steps: Steps,
    usable: Mask,
    true_nm: Single | None,
    config: Configuration | None,
    calibration: Calibration,
    warnings: Sequence[str],
) -> Telemetry:
    was_closed, index = steps.mode == LoopMode.CLOSED, np.arange(len(steps.mode))
    opened = np.flatnonzero(~was_closed)
    frames_closed = index - np.concatenate([[-1], opened])[np.searchsorted(opened, index)]
    closed, rows = True, usable & was_closed & (frames_closed > _SETTLING_S * rate_hz)
    pol = time_series(steps.sequence[rows], steps.pol_nm[rows])
    if _longest(pol) < FEWEST:
        closed, rows = False, usable
        pol = time_series(steps.sequence[rows], steps.pol_nm[rows])
    if _longest(pol) < FEWEST:
        raise DataFileError(
            f"{source}: tuning requires at least {FEWEST} consecutive frames, {FEWEST / rate_hz:.2g} s; the longest "
            f"sequence of good frames has {_longest(pol)}"
        )
    contrast = contrast_of(config) if config is not None and config.noll == calibration.noll else None
    used_nm = None if true_nm is None or not np.isfinite(true_nm[rows]).all() else true_nm[rows].astype(float)
    return Telemetry(
        source=source,
        noll=calibration.noll,
        rate_hz=rate_hz,
        timing=timing,
        law=laws[0],
        driving=laws[1],
        closed=closed,
        pol=pol,
        error=time_series(steps.sequence[rows], steps.error_nm[rows]),
        true_nm2=None if used_nm is None else used_nm.T @ used_nm / len(used_nm),
        nm_per_mas=tilt_nm_per_mas(config.star.diameter_m) if config is not None else None,
        contrast=contrast,
        noise_nm2=frame_noise_nm2(config, calibration) if config is not None and contrast is not None else None,
        warnings=tuple(warnings),
    )


def _longest(run: TimeSeries) -> int:
    return max((len(piece) for piece in run.values), default=0)
