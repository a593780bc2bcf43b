"""State of the controller, as a JSON object and as text."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from lowfc.contract.codecs.law_codec import overruled
from lowfc.contract.envelope import count_of
from lowfc.contract.messages import FRAME, Role, from_timestamp, wire
from lowfc.control.loop.command_channels import FLAT
from lowfc.control.loop.safety import Limit, Rejection, reason_name
from lowfc.control.loop.state import FADING_FRAMES, SETTLING_FRAMES
from lowfc.control.loop.wording import PAUSED, counted, mode_word
from lowfc.programs.cli.contrast import ESTIMATED, QUADRATIC, contrast_cases, contrast_in_words, costliest_modes
from lowfc.programs.launch.watch import mode_name, topic_count, wavefront

NO_HEALTH = wire.Health()
"""Health of an absent process."""


def json_object(
    state: wire.ControllerState, processes: Mapping[str, wire.Health] = MappingProxyType({}), run: str = ""
) -> dict[str, Any]:
    """The state as `lowfc ctl status --json` prints it; modes are in the calibration's order, nm rms of wavefront."""
    playing = None
    if state.HasField("play"):
        play = state.play
        frames = play.frames or (len(play.table) // (4 * play.columns) if play.columns else 0)
        left = play.first_sequence + frames - 1 - state.frame_sequence
        playing = {"target": play.target, "frames": frames, "frames_left": min(max(left, 0), frames)}
    law: dict[str, Any] = {"name": "integrator", "weight": 1.0, "overruled": []}
    if state.HasField("law"):
        law = {
            "name": state.law.name,
            "weight": min(max(state.law_frames - SETTLING_FRAMES, 0) / FADING_FRAMES, 1.0),
            "overruled": overruled(state),
        }
    command_nm = list(state.command_history_nm)[: len(state.gain)]
    settings = state.settings
    controller, recorder = (processes.get(role, NO_HEALTH) for role in (Role.CONTROLLER, Role.RECORDER))
    last_second, frames_in = controller.last_second, topic_count(controller, FRAME.key)
    camera = processes.get(Role.CAMERA, NO_HEALTH)
    simulated = wavefront(camera.recent_wavefront) if camera.HasField("recent_wavefront") else None
    contrast = simulated
    # Without frames the statistics are out of date.
    measured = controller.HasField("recent_wavefront") and last_second.frames
    if measured and (simulated is None or simulated["added_contrast"] is None):
        contrast = wavefront(controller.recent_wavefront)
    return {
        "run": run,
        "mode": mode_name(state.mode) or "starting",
        "paused": state.mode == wire.LOOP_MODE_OPEN and state.mode_cause == PAUSED,
        "rate_hz": controller.rate_hz,
        "frames_used_last_second": last_second.frames,
        "residual_rms_nm": last_second.residual_rms_nm if last_second.frames else None,
        "true_residual_rms_nm": None if simulated is None else simulated["residual_rms_nm"],
        "added_contrast": contrast and contrast["added_contrast"],
        "added_contrast_estimated": contrast is not simulated,
        "costliest_modes": contrast and contrast["costliest_modes"],
        "flux_fraction": last_second.flux_fraction if last_second.frames else None,
        "frames_skipped": frames_in.skipped,
        "frames_missing": frames_in.missing,
        "recording": recording_state(recorder),
        "log": recorder.recording.file or None,
        "last_warning": _last_warning(state, processes),
        "mode_s": round(max(0, from_timestamp(state.timestamp) - from_timestamp(state.mode_timestamp)) * 1e-9, 3)
        if state.HasField("mode_timestamp")
        else None,
        "mode_cause": state.mode_cause,
        "holding": controller.holding or None,
        "mirrors": {
            name: {
                "refused": reason_name(one.command_refused) if one.command_refused else None,
                "expired": one.command_expired,
                "limits_hit": [reason_name(reason) for reason in one.limits_hit],
            }
            for name, one in sorted(processes.items())
            if name.partition("-")[0] == Role.MIRROR
        },
        "frame": count_of(state.frame_sequence),
        "frame_sequence": state.frame_sequence,
        "frames_used": state.frames_used,
        "steps_left": state.steps_left,
        "homing": state.returning_to_zero,
        "command_nm": command_nm,
        "command_rms_nm": float(np.linalg.norm(command_nm)),
        "offset_nm": list(state.offset_nm),
        "offset_rms_nm": float(np.linalg.norm(list(state.offset_nm))),
        "law": law,
        "gain": list(state.gain),
        "gain_automatic": list(state.automatic) or [False] * len(state.gain),
        "closing_harm": controller.closing_harm or None,
        "leak": list(state.leak),
        "limit_nm": list(state.limit_nm),
        "channels": [
            {
                "name": one.name,
                "rms_nm": _rms(one.actuators),
                "shifts_zero_point": one.shifts,
                "reached": one.actuators == one.reached,
            }
            for one in state.channels
        ],
        "playing": playing,
        "reserved_for": state.lease.holder if state.lease.id and not state.lease.ended else None,
        "interlocks": [
            {"name": settings.interlocks[one.number].name, "action": one.action, "why": one.why}
            for one in state.interlocks_acting
        ],
        "interlocks_configured": len(settings.interlocks),
        "limits_hit": [reason_name(reason) for reason in state.limits_hit],
        "refused": reason_name(state.refused) if state.refused else None,
        "counts": {reason_name(each.reason): each.count for each in state.counts},
        "stroke_nm": settings.stroke_nm,
        "slew_nm": settings.slew_nm,
        "neighbour_nm": settings.neighbour_nm,
        "delay_frames": settings.delay_frames,
        "calibration_id": state.calibration_id,
        "calibration_provisional": state.calibration_provisional,
    }


def text(status: dict[str, Any]) -> str:
    """The state as text; the first line is a summary."""
    since = "" if status["mode_s"] is None else f" for {status['mode_s']:.0f} s ({status['mode_cause']})"
    opens = f", opens after {counted(status['steps_left'], 'frame')}" if status["steps_left"] else ""
    playing = status["playing"]
    rows = {
        "loop": _mode_in_words(status, since) + opens,
        **{name: _mirror_in_words(one) for name, one in status["mirrors"].items()},
        "frame": f"number {status['frame']}; {status['frames_used']} used since the controller started"
        + (f"; the last was refused as {_in_words(status['refused'])}" if status["refused"] else ""),
        "command": f"{status['command_rms_nm']:.3f} nm rms" + (", returning to zero" if status["homing"] else ""),
        "offset": f"{status['offset_rms_nm']:.3f} nm rms",
        **_contrast_row(status),
        "law": law_in_words(status),
        "gain": _values(status["gain"])
        + _automatic_in_words(status["gain_automatic"])
        + ("" if status["law"]["name"] == "integrator" else ", for the integrator only"),
        "leak": _values(status["leak"]),
        "limit": _values(status["limit_nm"], " nm"),
        "channels": channels_in_words(status),
        "playing": f"{playing['target']}, {playing['frames_left']} of {counted(playing['frames'], 'frame')} left"
        if playing
        else "nothing",
        "reserved": f"for {status['reserved_for']}" if status["reserved_for"] else "no",
        "interlocks": interlocks_in_words(status),
        "mirror limits": f"stroke {status['stroke_nm']:g} nm, slew {status['slew_nm']:g} nm a frame, "
        f"neighbours {status['neighbour_nm']:g} nm; {_limits_in_words(status['limits_hit'])}",
        "counted": ", ".join(_count_text(name, count) for name, count in status["counts"].items()) or "nothing refused",
        "delay": counted(float(status["delay_frames"]), "frame"),
        "calibration": (status["calibration_id"][:12] or "none")
        + (", provisional: from the first steps of commissioning" if status["calibration_provisional"] else ""),
    }
    return "\n".join([_summary_line(status), *(f"{name:14} {value}" for name, value in rows.items())])


def _contrast_row(status: dict[str, Any]) -> dict[str, str]:
    if status["added_contrast"] is None:
        return {}
    source = ESTIMATED if status["added_contrast_estimated"] else ""
    cases = contrast_cases(status["added_contrast"])
    return {"contrast": contrast_in_words(cases, costliest_modes(status), method=source + QUADRATIC)}


def law_in_words(status: dict[str, Any]) -> str:
    """Text of the law in force and of the modes that the integrator drives in its place."""
    law, weight = status["law"], status["law"]["weight"]
    fading = "" if weight == 1 else f" with weight {weight:.2f}; the integrator has weight {1 - weight:.2f}"
    overruled_modes = f"; overruled: the integrator drives {' and '.join(law['overruled'])}" if law["overruled"] else ""
    return f"{law['name']}{fading}{overruled_modes}"


def channels_in_words(status: dict[str, Any]) -> str:
    """Text of the command channels."""
    channels = [
        f"{one['name']} {one['rms_nm']:.3g} nm rms of surface"
        f"{'' if one['reached'] else ', not reached'}{'' if one['shifts_zero_point'] else ', zero point not shifted'}"
        for one in status["channels"]
    ]
    return "; ".join(channels) or "no channel"


def interlocks_in_words(status: dict[str, Any]) -> str:
    """Text of the interlocks that act."""
    if status["interlocks"]:
        return "; ".join(f"{one['why']} ({one['action'].replace('_', ' ')})" for one in status["interlocks"])
    count = status["interlocks_configured"]
    return f"none of {count} acts" if count else "none"


def holds_shape(state: wire.ControllerState | None) -> bool:
    """Whether an offset or a channel other than `flat` is set: the true residual then contains its shape, too."""
    return state is not None and (any(state.offset_nm) or any(one.name != FLAT for one in state.channels))


def recording_state(recorder: wire.Health) -> str:
    """State of the recorder: recording, stopped (by an operator), failed, or none (no recorder is ready)."""
    if recorder.recording.failure:
        return "failed"
    if recorder.state not in ("ready", "running"):
        return "none"
    return "stopped" if recorder.recording.stopped else "recording"


def _summary_line(status: dict[str, Any]) -> str:
    """One line: mode, residual and flux of the last second, lost frames, recording, run, law, last warning.

    The true residual is that of the simulated camera's last two seconds; lost frames are counted from the controller's
    start.
    """
    measured = ["no frame used in the last second"]
    if status["frames_used_last_second"]:
        true_nm = status["true_residual_rms_nm"]
        on_purpose = any(status["offset_nm"]) or any(channel["name"] != FLAT for channel in status["channels"])
        shapes = ", with offset and channels" if on_purpose else ""
        measured = [
            f"residual {status['residual_rms_nm']:.2f} nm rms, noise included"
            + ("" if true_nm is None else f" (true {true_nm:.2f} over 2 s{shapes})"),
            f"light {100 * status['flux_fraction']:.0f} %",
        ]
    recording = {"recording": f"recording {status['log']}", "none": "not recording"}
    warning = status["last_warning"]
    return " · ".join(
        (
            _mode_in_words(status),
            *measured,
            f"{counted(status['frames_skipped'] + status['frames_missing'], 'frame')} lost",
            recording.get(status["recording"], f"recording {status['recording']}"),
            f"run {status['run']}",
            f"law {status['law']['name']}" + (", overruled" if status["law"]["overruled"] else ""),
            "no warning"
            if warning is None
            else f"{warning['age_s']:.0f} s ago {warning['process']}: {warning['text']}",
        )
    )


def _last_warning(state: wire.ControllerState, processes: Mapping[str, wire.Health]) -> dict[str, Any] | None:
    """The newest warning; if a mirror's driver failed, that mirror's newest one, as the failure causes the others."""
    warnings = [
        (from_timestamp(one.last_warning_timestamp), name) for name, one in processes.items() if one.last_warning
    ]
    if not warnings:
        return None
    failing = [one for one in warnings if processes[one[1]].command_refused == wire.REASON_NO_MIRROR]
    time_ns, process = max(failing or warnings)
    text = processes[process].last_warning
    age_s = max(0, from_timestamp(state.timestamp) - time_ns) * 1e-9
    return {"process": process, "age_s": round(age_s, 3), "text": text}


def _mode_in_words(status: dict[str, Any], since: str = "") -> str:
    word = ("paused" if status["paused"] else mode_word(status["mode"])) + since
    return f"{word}, not correcting: {status['holding']}" if status["holding"] else word


def _mirror_in_words(mirror: dict[str, Any]) -> str:
    if mirror["refused"]:
        return f"refuses commands: {mirror['refused']}"
    state = "last command expired" if mirror["expired"] else "follows commands"
    return f"{state}; {_limits_in_words(mirror['limits_hit'])}" if mirror["limits_hit"] else state


def _automatic_in_words(modes: list[bool]) -> str:
    if not any(modes):
        return ""
    return " (automatic)" if all(modes) else f" (automatic: {sum(modes)} of {len(modes)})"


def _limits_in_words(limits: list[str]) -> str:
    return f"limits acting: {', '.join(map(_in_words, limits))}" if limits else "no limit acting"


def _count_text(reason: str, count: int) -> str:
    """Text of a count: how often frames were refused for a reason, or a limit acted."""
    if reason == Rejection.NO_FRAME.name:
        return f"no frame {counted(count, 'time')}"
    if reason in Rejection.__members__:
        return f"{counted(count, 'frame')} refused as {_in_words(reason)}"
    if reason not in Limit.__members__:  # from a controller of a later version
        return f"reason {reason} {counted(count, 'time')}"
    return f"{_in_words(reason)} acted on {counted(count, 'command')}"


def _in_words(reason: str) -> str:
    return reason.lower().replace("_", " ")


def _values(values: list[float], unit: str = "") -> str:
    """All values, or one value if they are equal; "none" without a calibration."""
    if not values:
        return "none"
    same = len(set(values)) == 1
    return f"{values[0]:g}{unit} for all" if same else " ".join(f"{value:.4g}" for value in values) + unit


def _rms(actuators: bytes) -> float:
    shape = np.frombuffer(actuators, "<f4").astype(np.float64)
    return float(np.sqrt(np.mean(np.square(shape)))) if shape.size else 0.0
