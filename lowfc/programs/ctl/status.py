"""What the controller is doing, as figures and for a person."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from lowfc.contract.envelope import count_of
from lowfc.contract.messages import from_timestamp, wire
from lowfc.control.safety import LoopMode, Reason
from lowfc.control.state import FADING_FRAMES, SETTLING_FRAMES


def figures(state: wire.ControllerState, mirrors: Mapping[str, wire.Health] = MappingProxyType({})) -> dict[str, Any]:
    """The state as `lowfc ctl status --json` prints it; modes in the calibration's order, nm rms of wavefront."""
    playing = None
    if state.HasField("play"):
        play = state.play
        frames = play.frames or (len(play.table) // (4 * play.columns) if play.columns else 0)
        left = play.first_sequence + frames - 1 - state.frame_sequence
        playing = {"target": play.target, "frames": frames, "frames_left": min(max(left, 0), frames)}
    law = {"name": "integrator", "weight": 1.0}
    if state.HasField("law"):
        law = {
            "name": state.law.name,
            "weight": min(max(state.law_frames - SETTLING_FRAMES, 0) / FADING_FRAMES, 1.0),
        }
    command_nm = list(state.command_history_nm)[: len(state.gain)]
    settings = state.settings
    return {
        "mode": LoopMode(state.mode).name.lower() if state.mode else "starting",
        "mode_s": round(max(0, from_timestamp(state.timestamp) - from_timestamp(state.mode_timestamp)) * 1e-9, 3)
        if state.HasField("mode_timestamp")
        else None,
        "mode_cause": state.mode_cause,
        "mirrors": {
            name: {
                "refused": _reason(one.command_refused) if one.command_refused else None,
                "expired": one.command_expired,
                "limits_hit": [_reason(reason) for reason in one.limits_hit],
            }
            for name, one in sorted(mirrors.items())
        },
        "frame": count_of(state.frame_sequence),
        "frame_sequence": state.frame_sequence,
        "frames_used": state.frames_used,
        "steps_left": state.steps_left,
        "homing": state.homing,
        "command_nm": command_nm,
        "command_rms_nm": _rss(command_nm),
        "offset_nm": list(state.offset_nm),
        "offset_rms_nm": _rss(state.offset_nm),
        "law": law,
        "gain": list(state.gain),
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
        "limits_hit": [Reason(reason).name for reason in state.limits_hit],
        "refused": Reason(state.refused).name if state.refused else None,
        "counts": {Reason(line.reason).name: line.count for line in state.counts},
        "stroke_nm": settings.stroke_nm,
        "slew_nm": settings.slew_nm,
        "neighbour_nm": settings.neighbour_nm,
        "delay_frames": settings.delay_frames,
        "calibration_id": state.calibration_id,
    }


def text(state: wire.ControllerState, mirrors: Mapping[str, wire.Health] = MappingProxyType({})) -> str:
    """The same for a person."""
    known = figures(state, mirrors)
    since = "" if known["mode_s"] is None else f" for {known['mode_s']:.0f} s ({known['mode_cause']})"
    mode = known["mode"] + (f", opens after {known['steps_left']} frames" if known["steps_left"] else "")
    law = known["law"]["name"]
    if known["law"]["weight"] < 1:
        law += f", driving with a weight of {known['law']['weight']:.2f}; the integrator has the rest"
    channels = [
        f"{one['name']} {one['rms_nm']:.3g} nm rms of surface"
        f"{'' if one['reached'] else ', on its way'}{'' if one['shifts_zero_point'] else ', zero point not shifted'}"
        for one in known["channels"]
    ]
    playing = known["playing"]
    rows = {
        "loop": mode + since,
        **{name: _of_mirror(one) for name, one in known["mirrors"].items()},
        "frame": f"{known['frame']}, {known['frames_used']} used"
        + (f"; the last was refused: {known['refused']}" if known["refused"] else ""),
        "command": f"{known['command_rms_nm']:.3f} nm rms" + (", on its way to zero" if known["homing"] else ""),
        "offset": f"{known['offset_rms_nm']:.3f} nm rms",
        "law": law,
        "gain": _values(known["gain"]),
        "leak": _values(known["leak"]),
        "limit": f"{_values(known['limit_nm'])} nm",
        "channels": "; ".join(channels) or "none",
        "playing": f"{playing['target']}, {playing['frames_left']} of {playing['frames']} frames left"
        if playing
        else "nothing",
        "mirror limits": f"stroke {known['stroke_nm']:g} nm, slew {known['slew_nm']:g} nm a frame, "
        f"neighbours {known['neighbour_nm']:g} nm; acting: {', '.join(known['limits_hit']) or 'none'}",
        "counted": ", ".join(f"{name} {count}" for name, count in known["counts"].items()) or "nothing",
        "delay": f"{known['delay_frames']:g} frames",
        "calibration": known["calibration_id"][:12] or "none",
    }
    return "\n".join(f"{name:14} {value}" for name, value in rows.items())


def _reason(number: int) -> str:
    """Its name; of a mirror of a later version, its number."""
    return Reason(number).name if number in Reason._value2member_map_ else str(number)


def _of_mirror(mirror: dict[str, Any]) -> str:
    if mirror["refused"]:
        return f"refuses commands: {mirror['refused']}"
    state = "its last command has expired" if mirror["expired"] else "follows"
    return f"{state}; limits acting: {', '.join(mirror['limits_hit'])}" if mirror["limits_hit"] else state


def _values(values: list[float]) -> str:
    """One figure where all are the same."""
    same = len(set(values)) == 1
    return f"{values[0]:g} for all" if same else " ".join(f"{value:g}" for value in values)


def _rss(values: npt.ArrayLike) -> float:
    return float(np.sqrt(np.sum(np.square(np.asarray(values, np.float64)))))


def _rms(actuators: bytes) -> float:
    shape = np.frombuffer(actuators, "<f4").astype(np.float64)
    return float(np.sqrt(np.mean(np.square(shape)))) if shape.size else 0.0
