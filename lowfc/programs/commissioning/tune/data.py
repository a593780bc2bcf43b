"""Data for tuning: pseudo-open-loop modes, errors and control law of a log or of a running loop."""

import contextlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lowfc.adapters.files.factory import contrast_or_none, frame_noise_nm2
from lowfc.adapters.logs.columns import Steps, count_reasons, steps_as_columns
from lowfc.adapters.logs.history import measured_timing, read_history
from lowfc.adapters.logs.reader import LogReader
from lowfc.arrays import Array, Mask, Single
from lowfc.client import Client, MirrorWatch, configuration_of
from lowfc.contract.codecs.law_codec import driving, integrator_of, overruled
from lowfc.contract.codecs.state_codec import calibration_in_use
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import BusError, DataFileError, raised_as
from lowfc.contract.messages import Role, wire
from lowfc.control.calibration.calibration import Calibration
from lowfc.control.laws import margins
from lowfc.control.laws.continuous import Timing
from lowfc.control.laws.integrator import Integrator
from lowfc.control.laws.linear_law import LinearLaw
from lowfc.control.laws.spectra import TimeSeries, time_series
from lowfc.control.laws.stability import settling_frames
from lowfc.control.laws.vibration import FEWEST
from lowfc.control.laws.what_if import delay_from_times, has_new_exposure, missing_before
from lowfc.control.loop.inputs import Step
from lowfc.control.loop.safety import Limit, LoopMode
from lowfc.control.loop.state import FADING_FRAMES, SETTLING_FRAMES
from lowfc.control.loop.wording import counted
from lowfc.optics.chain.added_contrast import ModalContrast
from lowfc.optics.detector.photometry import tilt_nm_per_mas
from lowfc.programs.cli.status import holds_shape
from lowfc.programs.logs.what_if.run import LoggedRun, SeenCommands, during_probe

_SETTLING_S = 0.5  # shortest time excluded after the loop was closed, if enough frames are left
_POLL_FRAMES = 100  # frames between two requests for the state of a running loop


@dataclass(frozen=True, slots=True)
class Telemetry:
    """Modal errors and control law of a run, nm rms of wavefront.

    Attributes:
        source: path of the log, or name of the run.
        noll: Noll index of each mode.
        rate_hz: frame rate.
        timing: delay and exposure of the loop, measured if possible.
        integrator: the integrator's gains, leaks and limits at the end.
        law: the linear law in force at the end; None if the integrator is in force.
        closed: whether the loop was closed in these frames.
        frames_closed: number of these frames with the loop closed.
        pol: pseudo-open-loop modes (frames, modes), in pieces without gaps.
        error: modal error (frames, modes). Error and true residual are from the frames after the last change of law or
            gains, or from all frames if fewer than `FEWEST` frames follow this change.
        true_nm2: mean products of the modes' true residuals at the starts of the exposures (modes, modes); None if
            unknown.
        continuous_rms_nm: continuous-time rms of the true residual (modes,), not only at the starts of the exposures;
            None if unknown.
        nm_per_mas: wavefront rms of a tilt of 1 mas; None if the telescope's diameter is unknown.
        contrast: contrast added by the modes; None without a science image.
        noise_nm2: computed covariance (modes, modes) of one frame's noise; None without a science image.
        warnings: reasons to doubt the results.
    """

    source: str
    noll: tuple[int, ...]
    rate_hz: float
    timing: Timing
    integrator: Integrator
    law: LinearLaw | None
    closed: bool
    frames_closed: int
    pol: TimeSeries
    error: TimeSeries
    true_nm2: Array | None
    continuous_rms_nm: Array | None
    nm_per_mas: float | None
    contrast: ModalContrast | None
    noise_nm2: Array | None
    warnings: tuple[str, ...]


def telemetry_from_log(log: LogReader) -> Telemetry:
    """The usable closed-loop frames of a log; if these are too few, all usable frames.

    Frames during a probe sequence, as in an acceptance test, and of an earlier calibration are excluded.
    """
    history = read_history(log)
    run = LoggedRun(history)
    steps, usable = _without_probes(run.steps, run.seen, run.controller_delay, run.played)
    with raised_as(DataFileError, ValueError, log.path):
        laws = run.law, driving(history.controller, history.published.laws)
    warnings = [
        *history.remarks,
        *_delay_warnings(run.controller_delay, run.seen, run.measured_delay, run.measured_from),
        *_prior_warnings(history.controller, run.calibration),
    ]
    if log.damage:
        warnings.append("the log is damaged; unreadable parts are left out")
    config = history.configuration
    found = _telemetry(
        str(log.path),
        history.rate_hz,
        run.timing,
        laws,
        _last_change(history.controllers, len(run.law.gain)),
        steps,
        usable & run.under_calibration,
        (None if run.true_nm is None else run.true_nm[1], run.continuous_rms_nm),
        config,
        run.calibration if history.controller is None else calibration_in_use(history.controller, run.calibration),
        warnings,
    )
    if found.closed and found.true_nm2 is not None and any(map(holds_shape, history.controllers)):
        shapes = "an offset or channels were in force: the achieved residual contains their shapes, theory does not"
        return replace(found, warnings=(*found.warnings, shapes))
    return found


def telemetry_from_run(loop: Client, seconds: float, progress: Callable[[float], None] | None = None) -> Telemetry:
    """The steps of a running loop in the next `seconds`.

    Frames during a probe sequence are excluded. The state is requested every `_POLL_FRAMES` frames: a shorter sequence
    may not be noticed. DataFileError without a calibration, if `seconds` are too few, or if no frame was used.
    """
    states = [_state(loop)]
    calibration = loop.calibration()
    config = configuration_of(loop)
    if seconds * config.camera.rate_hz < FEWEST:
        needed_s = FEWEST / config.camera.rate_hz
        raise DataFileError(
            f"run {loop.run_id!r}: tuning requires at least {FEWEST} consecutive frames, {needed_s:.3g} s at "
            f"{config.camera.rate_hz:g} Hz, but got {seconds:g} s: use --live {np.ceil(1.2 * needed_s):.0f}"
        )
    watch: MirrorWatch | None = None
    with contextlib.suppress(BusError):  # reports of a user's mirror are optional
        watch = loop.mirror_watch()
    begun_s = time.monotonic()
    received: list[Step] = []
    stream = loop.steps()
    for step in stream:
        received.append(step)
        passed_s = time.monotonic() - begun_s
        if len(received) % _POLL_FRAMES == 0:
            states.append(_state(loop))
            if progress is not None:
                progress(passed_s)
            if watch is not None:
                watch.read()
        if passed_s >= seconds:
            break
    stream.close()
    states.append(_state(loop))
    steps = _from_first_used(loop.run_id, steps_as_columns(received, len(calibration.noll)))
    reports = np.array(() if watch is None else watch.applied, np.int64).reshape(-1, 2)
    applied, applied_ns = reports[:, 0].astype(np.uint64), reports[:, 1]
    if watch is not None and watch.offset is not None:  # onto the clock of the camera's host, as the frames' times
        camera = loop.processes().get(Role.CAMERA, wire.Health())
        applied_ns += watch.offset.offset_ns - camera.router_offset_ns
    period_s = float(np.median(np.diff(steps.time_ns))) * 1e-9 if len(steps.time_ns) > 1 else 0.0
    rate_hz = 1 / period_s if period_s > 0 else config.camera.rate_hz
    assumed_delay = float(states[0].delay_frames)
    measured_delay = delay_from_times(steps.sequence, steps.time_ns - config.exposure_ns, applied, applied_ns)
    if config.lockstep or (measured_delay is not None and measured_delay < assumed_delay):
        measured_delay = None  # simulated time, or the mirror still moves after its report
    played = np.zeros(steps.sequence.shape, np.bool_)
    for state in states:
        if state.HasField("play"):
            played |= during_probe(steps.sequence, state.play.first_sequence, state.play.frames)
    seen = SeenCommands.of(steps, missing_before(steps.sequence), states, assumed_delay, measured_delay, played)
    steps, usable = _without_probes(steps, seen, assumed_delay, played)
    timing = Timing.of(seen.delay_frames, config.camera.exposure_fraction)
    lost = [f"{counted(stream.lost, 'step')} lost between the controller and this program"] if stream.lost else []
    return _telemetry(
        loop.run_id,
        rate_hz,
        measured_timing(timing, steps, applied, applied_ns, rate_hz),
        (integrator_of(states[-1]), driving(states[-1], loop.laws())),
        _last_change(states, len(calibration.noll)),
        steps,
        usable,
        (None, None),
        config,
        calibration_in_use(states[-1], calibration),
        [
            *_delay_warnings(assumed_delay, seen, measured_delay, "the times of frames and mirror"),
            *_prior_warnings(states[-1], calibration),
            *lost,
        ],
    )


def _state(loop: Client) -> wire.ControllerState:
    state = loop.status().state
    if state is None or not state.gain:
        raise DataFileError(f"run {loop.run_id!r} has no calibration: load one with `lowfc ctl load`")
    return state


def _from_first_used(run_id: str, steps: Steps) -> Steps:
    rows = has_new_exposure(steps.reasons)
    used = rows & np.isfinite(steps.error_nm).all(axis=1)
    if not used.any():
        raise DataFileError(f"run {run_id!r}: no frame was used; `lowfc ctl status` gives the reason")
    rows[: int(np.argmax(used))] = False
    return steps.at(rows)


def _without_probes(steps: Steps, seen: SeenCommands, assumed_delay: float, played: Mask) -> tuple[Steps, Mask]:
    """The steps with pseudo-open-loop modes for the measured delay, and whether each step is usable (steps,).

    Steps during a probe sequence (`played`) get mode 0, as if the loop were not closed, so that the time to settle
    after the sequence is excluded, too.
    """
    pol_nm = steps.pol_nm if seen.delay_frames == assumed_delay else steps.error_nm + seen.target_nm - seen.seen_nm
    usable = np.isfinite(pol_nm).all(axis=1) & ~seen.command_lost & ~played & (steps.saturated_pixels == 0)
    return replace(steps, pol_nm=pol_nm, mode=np.where(played, np.uint8(0), steps.mode)), usable


def _delay_warnings(assumed_delay: float, seen: SeenCommands, measured_delay: float | None, source: str) -> list[str]:
    if seen.delay_frames == assumed_delay:
        return []
    return [
        f"the controller assumed a delay of {counted(assumed_delay, 'frame')}, but measured from {source} it is "
        f"{measured_delay:.2f}: the law is made for {counted(seen.delay_frames, 'frame')}; set control.delay_frames"
    ]


def _prior_warnings(state: wire.ControllerState | None, calibration: Calibration) -> list[str]:
    prior_nm2 = [] if state is None else state.prior_nm2
    names = ", ".join(f"Z{index}" for index, power in zip(calibration.noll, prior_nm2, strict=False) if power > 0)
    if not names:
        return []
    return [
        f"the reconstructor has a prior for the modes that automatic gains do not correct ({names}): if these get "
        "gains, the noise of the other modes is higher than predicted"
    ]


def _last_change(states: Sequence[wire.ControllerState], modes: int) -> int:
    """Sequence of the frame after which the last law and gains came into force; 0 if they never changed."""
    newest, changed, before = 0, 0, None
    for state in states:
        newest = max(newest, state.frame_sequence)  # a state after a `clear` has the sequence 0
        if len(state.gain) != modes:
            continue
        gains = [] if state.HasField("law") and not overruled(state) else [*state.gain, *state.leak]
        law = state.law.id, overruled(state), gains
        if before not in (None, law):
            changed = newest
        before = law
    return changed


def _telemetry(
    source: str,
    rate_hz: float,
    timing: Timing,
    laws: tuple[Integrator, LinearLaw | None],
    last_change: int,
    steps: Steps,
    usable: Mask,
    true_residual: tuple[Single | None, Single | None],
    config: Configuration | None,
    calibration: Calibration,
    warnings: Sequence[str],
) -> Telemetry:
    """Telemetry of the usable steps after the closed loop has settled, or of all usable steps if these are too few.

    `laws` are the integrator and the linear law in force, if any; they are in force from the frame after `last_change`
    on. `true_residual` is the residual at the start of each exposure, and the continuous-time rms of each frame period
    (steps, modes).
    """
    was_closed, index = steps.mode == LoopMode.CLOSED, np.arange(len(steps.mode))
    frames_since = index - np.maximum.accumulate(np.where(was_closed, -1, index))  # since the loop was closed
    settling = settling_frames(laws[0].gain, laws[0].leak)
    if laws[1] is not None:
        settling = SETTLING_FRAMES + FADING_FRAMES + margins.settling_frames(laws[1], timing.delay)
    settling = min(max(settling, round(_SETTLING_S * rate_hz)), int(frames_since.max()) - FEWEST)  # `FEWEST` remain
    closed, rows = True, usable & was_closed & (frames_since > settling)
    pol = time_series(steps.sequence[rows], steps.pol_nm[rows])
    if pol.longest < FEWEST:
        if was_closed[usable].any():
            warnings = [
                *warnings,
                f"in closed loop at most {counted(pol.longest, 'good frame')} are consecutive, fewer than {FEWEST}: "
                "open-loop frames are used, too, and the achieved residual is unknown",
            ]
        closed, rows = False, usable
        pol = time_series(steps.sequence[rows], steps.pol_nm[rows])
    if pol.longest < FEWEST:
        raise DataFileError(
            f"{source}: tuning requires at least {FEWEST} consecutive frames, {FEWEST / rate_hz:.2g} s; the longest "
            f"sequence of good frames has {pol.longest}"
        )
    if Limit.LAW_OVERRULED in count_reasons(steps.reasons[rows]):
        warnings = [*warnings, "in some of these frames the integrator drove in place of a law (LAW_OVERRULED)"]
    under_law = rows & (steps.sequence > last_change + settling)
    last = np.count_nonzero(under_law)
    extent = f"that of the last {last} frames, theory is for all of them"
    if last < FEWEST:
        under_law, extent = rows, "that of all of them, theory is for the last law and gains"
    if closed and (steps.sequence[rows] <= last_change).any():
        warnings = [*warnings, f"law or gains changed in these frames: the achieved residual is {extent}"]
    contrast = contrast_or_none(config) if config is not None and config.noll == calibration.noll else None
    finite = [None if each is None else each[under_law & np.isfinite(each).all(axis=1)] for each in true_residual]
    true_nm, rms_nm = (each if each is not None and len(each) else None for each in finite)
    return Telemetry(
        source=source,
        noll=calibration.noll,
        rate_hz=rate_hz,
        timing=timing,
        integrator=laws[0],
        law=laws[1],
        closed=closed,
        frames_closed=int((rows & was_closed).sum()),
        pol=pol,
        error=time_series(steps.sequence[under_law], steps.error_nm[under_law]),
        true_nm2=None if true_nm is None else true_nm.T.astype(float) @ true_nm / len(true_nm),
        continuous_rms_nm=None if rms_nm is None else np.sqrt(np.mean(rms_nm.astype(float) ** 2, axis=0)),
        nm_per_mas=tilt_nm_per_mas(config.star.diameter_m) if config is not None else None,
        contrast=contrast,
        noise_nm2=frame_noise_nm2(config, calibration) if config is not None and contrast is not None else None,
        warnings=tuple(warnings),
    )
