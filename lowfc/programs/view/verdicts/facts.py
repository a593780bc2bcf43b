"""What is set, in words: run and host, control law and gains, offset and channels, the last note."""

from collections import Counter
from collections.abc import Sequence
from datetime import UTC, datetime

import numpy as np

from lowfc.contract.codecs.law_codec import overruled
from lowfc.contract.messages import from_timestamp, wire
from lowfc.contract.printable import printable
from lowfc.control.loop.state import FADING_FRAMES, SETTLING_FRAMES
from lowfc.control.loop.wording import counted
from lowfc.optics.chain.zernike import mode_name
from lowfc.programs.view.verdicts.run_state import RunState
from lowfc.programs.view.verdicts.tile import short

_MOST = 3
"""Different values, modes or channels that are named one by one."""


def facts(state: RunState) -> dict[str, str]:
    """The facts of a run by title, as far as they are known."""
    controller, note = state.controller_state, "none known"
    if state.note is not None:
        clock = datetime.fromtimestamp(from_timestamp(state.note.timestamp) * 1e-9, UTC)
        note = f"{clock:%H:%M} {short(printable(state.note.message.partition(' ')[2]))}"
    law = shapes = "not known"
    if controller is not None:
        law, shapes = _law(controller), f"{_offset(controller, state.noll)}; {_channels(controller)}"
    run = (f"{state.run} on {state.host}" if state.host else state.run) or "not known"
    return {"RUN": run, "CONTROL LAW": law, "OFFSET AND CHANNELS": shapes, "LAST NOTE": note}


def _law(state: wire.ControllerState) -> str:
    if state.HasField("law"):
        weight = min(max(state.law_frames - SETTLING_FRAMES, 0) / FADING_FRAMES, 1.0)
        fading = "" if weight == 1 else f", taking over from the integrator ({100 * weight:.0f} %)"
        modes = overruled(state)
        instead = f", the integrator in its place for {' and '.join(modes)}" if modes else ""
        law = f"{short(printable(state.law.name))}{fading}{instead}"
    elif state.gain:
        leak = f", leak {_values(state.leak)}" if any(state.leak) else ""
        law = f"integrator, gain {_values(state.gain)}{leak}"
    else:
        law = "integrator, no calibration"
    return f"{law}; delay {counted(state.delay_frames, 'frame')}"


def _values(values: Sequence[float]) -> str:
    """Each value with the number of its modes, where there are few; the range where there are many."""
    counts = Counter(values)
    if len(counts) == 1:
        return f"{values[0]:.3g}"
    if len(counts) > _MOST:
        return f"{min(values):.3g} to {max(values):.3g}"
    return ", ".join(f"{value:.3g} ({counted(count, 'mode')})" for value, count in counts.items())


def _offset(state: wire.ControllerState, noll: tuple[int, ...]) -> str:
    values = np.array(state.offset_nm)
    set_ = np.flatnonzero(values)
    if not set_.size:
        return "no offset"
    if len(noll) != len(values) or len(set_) > _MOST:
        return f"offset {np.linalg.norm(values):.3g} nm rms, {counted(len(set_), 'mode')}"
    return f"offset {', '.join(f'{mode_name(noll[place])} {values[place]:.3g}' for place in set_)} nm"


def _channels(state: wire.ControllerState) -> str:
    named = []
    for one in state.channels[:_MOST]:
        shape = np.frombuffer(one.actuators, "<f4").astype(np.float64)
        rms_nm = float(np.sqrt(np.mean(shape**2))) if shape.size else 0.0
        named.append(f"{printable(one.name)} {rms_nm:.3g} nm{'' if one.actuators == one.reached else ' (on its way)'}")
    if len(state.channels) > _MOST:
        named.append(f"{len(state.channels) - _MOST} more")
    text = f"{'channel' if len(state.channels) == 1 else 'channels'} {', '.join(named)}" if named else "no channels"
    return f"{text}; probe sequence on the {printable(state.play.target)}" if state.HasField("play") else text
