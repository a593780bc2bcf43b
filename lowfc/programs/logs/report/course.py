"""The course of a run: loop modes, events, requests, flux, refused frames, stroke of the mirror."""

from collections import Counter
from operator import itemgetter

import numpy as np

from lowfc.adapters.logs.columns import count_reasons
from lowfc.adapters.logs.history import History
from lowfc.arrays import Long
from lowfc.contract.events import Level
from lowfc.contract.messages import wire
from lowfc.control.loop.safety import Limit, mode_name
from lowfc.programs.logs.report.source import Results, Run, row_after

_LEVELS = {level.value: level.name.lower() for level in Level}


def mode_spans(run: Run) -> list[Results]:
    """Loop modes in order, with start and end in seconds since the first step."""
    mode = run.history.steps.mode
    if not mode.size:
        return []
    starts = np.flatnonzero(np.diff(mode.astype(int), prepend=-1))
    ends = np.append(starts[1:], mode.size - 1)
    times_s = run.step_s
    return [
        {"mode": mode_name(int(mode[first])), "from_s": float(times_s[first]), "to_s": float(times_s[last])}
        for first, last in zip(starts, ends, strict=True)
    ]


def mode_steps(history: History) -> dict[str, int]:
    """Number of steps in each loop mode."""
    return {mode_name(number): count for number, count in sorted(Counter(history.steps.mode.tolist()).items())}


def events(run: Run) -> list[Results]:
    """Events in the order in which they were sent, with level, process, name and sentence."""
    found = sorted(run.history.events, key=itemgetter(0))
    times_s = run.seconds([time_ns for time_ns, _ in found])
    return [
        {
            "time_s": float(time_s),
            "level": _LEVELS.get(int(event.level), "info"),
            "process": event.name,
            "name": event.message.partition(" ")[0],
            "text": event.message.partition(" ")[2],
        }
        for time_s, (_, event) in zip(times_s, found, strict=True)
    ]


def requests(run: Run) -> list[Results]:
    """Requests, including the controller's own, and their answers, but no periodic ones that change nothing."""
    if not run.history.steps.sequence.size:
        return []
    return [
        {
            "time_s": _request_time_s(run, one),
            "name": one.name,
            "modes": list(one.modes),
            "values": list(one.values),
            "accepted": one.accepted,
            "reply": one.reply,
        }
        for one in run.history.requests
        if one.name not in ("status", "configuration", "renew")
    ]


def laws(run: Run) -> list[Results]:
    """The laws in force, with their start times; gain and leak are those of the integrator."""
    return [
        {
            "from_s": float(run.step_s[law.first]),
            "law": law.law_name,
            "gain": list(law.gain),
            "leak": list(law.leak),
            "delay_frames": law.delay_frames,
        }
        for law in run.laws
    ]


def light_results(history: History) -> Results:
    """Flux, saturation of the used frames, and the number of frames refused for each reason."""
    steps = history.steps
    flux = steps.flux_dn[steps.flux_dn > 0]
    counts = count_reasons(steps.reasons).items()
    refused = {reason.name.lower(): count for reason, count in counts if reason < Limit.MODAL_LIMIT}
    return {
        "flux_expected_dn": history.calibration.flux_dn if history.calibration is not None else None,
        "flux_mean_dn": float(flux.mean()) if flux.size else None,
        "flux_least_dn": float(flux.min()) if flux.size else None,
        "flux_largest_dn": float(flux.max()) if flux.size else None,
        "frames_saturated": int((steps.saturated_pixels > 0).sum()),
        "saturated_pixels_most": int(steps.saturated_pixels.max(initial=0)),
        "frames_refused": sum(refused.values()),
        "refused": refused,
    }


def mirror_results(history: History) -> Results:
    """Stroke used, and limits that acted in the controller and in the mirror."""
    mirror, controller = history.mirror, history.controller
    limit_nm = (controller.settings.stroke_nm or None) if controller is not None else None
    most_nm = float(mirror.stroke_nm.max()) if mirror.stroke_nm.size else None
    return {
        "stroke_limit_nm": limit_nm,
        "stroke_most_nm": most_nm,
        "stroke_most_share": most_nm / limit_nm if most_nm is not None and limit_nm else None,
        "states": int(mirror.sequence.size),
        "limits_at_controller": _limits(history.steps.reasons),
        "limits_at_mirror": _limits(mirror.limits),
    }


def _limits(reasons: Long) -> dict[str, int]:
    """Number of times that each limit acted; LAW_OVERRULED is not a limit."""
    counts = count_reasons(reasons).items()
    return {
        reason.name.lower(): count
        for reason, count in counts
        if reason >= Limit.MODAL_LIMIT and reason is not Limit.LAW_OVERRULED
    }


def _request_time_s(run: Run, request: wire.Request) -> float:
    """Time, since the log's first step, of the first step with a request in force; of the last step if none follows."""
    row = row_after(run.history, max(request.frame_sequence - 1, 0), request.timestamp)
    return float(run.step_s[min(row, run.history.steps.sequence.size - 1)])
