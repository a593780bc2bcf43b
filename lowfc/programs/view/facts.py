"""What is set, in words: run and host, control law and gains, offset and channels, the last note."""

from collections import Counter
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np

from lowfc.contract.messages import from_timestamp, wire
from lowfc.contract.printable import printable
from lowfc.control.state import FADING_FRAMES, SETTLING_FRAMES
from lowfc.optics.zernike import mode_name
from lowfc.programs.view.tile import counted, short
from lowfc.programs.view.watcher import Watcher

_MOST = 3
"""Different values, modes or channels that are named one by one."""


@dataclass(frozen=True, slots=True)
class Fact:
    """One line of words."""

    title: str
    text: str


def facts(watcher: Watcher) -> tuple[Fact, ...]:
    """The facts of a run, as far as they are known."""
    state = watcher.moment.controller if watcher.moment else None
    calibration = watcher.moment.calibration if watcher.moment else None
    noll = calibration.noll if calibration is not None else ()
    return (
        Fact("RUN", _run(watcher)),
        Fact("CONTROL LAW", "not known" if state is None else _law(state)),
        Fact("OFFSET AND CHANNELS", "not known" if state is None else f"{_offset(state, noll)}; {_channels(state)}"),
        Fact("LAST NOTE", _note(watcher)),
    )


def _run(watcher: Watcher) -> str:
    run, host = watcher.run_and_host()
    if not run:
        return "not known"
    return f"{run} on {host}" if host else run


def _law(state: wire.ControllerState) -> str:
    delay = f"delay {state.delay_frames:g} {'frame' if state.delay_frames == 1 else 'frames'}"
    if state.HasField("law"):
        weight = min(max(state.law_frames - SETTLING_FRAMES, 0) / FADING_FRAMES, 1.0)
        drives = "" if weight == 1 else f", taking over from the integrator ({100 * weight:.0f} %)"
        return f"{short(printable(state.law.name))}{drives}; {delay}"
    if not state.gain:
        return f"integrator, no calibration; {delay}"
    leak = f", leak {_values(list(state.leak))}" if any(state.leak) else ""
    return f"integrator, gain {_values(list(state.gain))}{leak}; {delay}"


def _values(values: list[float]) -> str:
    """Each value with the number of its modes, where there are few; the range where there are many."""
    counts = Counter(values)
    if len(counts) == 1:
        return f"{values[0]:.3g}"
    if len(counts) > _MOST:
        return f"{min(values):.3g} to {max(values):.3g}"
    return ", ".join(f"{value:.3g} ({counted(count, 'mode')})" for value, count in counts.items())


def _offset(state: wire.ControllerState, noll: tuple[int, ...]) -> str:
    values = np.array(state.offset_nm)
    if not values.any():
        return "no offset"
    if len(noll) != len(values) or np.count_nonzero(values) > _MOST:
        return f"offset {np.linalg.norm(values):.3g} nm rms, {counted(int(np.count_nonzero(values)), 'mode')}"
    named = (f"{mode_name(index)} {value:.3g}" for index, value in zip(noll, values.tolist(), strict=True) if value)
    return f"offset {', '.join(named)} nm"


def _channels(state: wire.ControllerState) -> str:
    found = []
    for one in state.channels[:_MOST]:
        shape = np.frombuffer(one.actuators, "<f4").astype(np.float64)
        rms_nm = float(np.sqrt(np.mean(shape**2))) if shape.size else 0.0
        found.append(f"{printable(one.name)} {rms_nm:.3g} nm{'' if one.actuators == one.reached else ' (on its way)'}")
    if len(state.channels) > _MOST:
        found.append(f"{len(state.channels) - _MOST} more")
    said = f"{'channel' if len(state.channels) == 1 else 'channels'} {', '.join(found)}" if found else "no channels"
    return f"{said}; probe sequence on the {printable(state.play.target)}" if state.HasField("play") else said


def _note(watcher: Watcher) -> str:
    if watcher.note is None:
        return "none known"
    clock = datetime.fromtimestamp(from_timestamp(watcher.note.timestamp) * 1e-9, UTC)
    return f"{clock:%H:%M} {short(printable(watcher.note.message.partition(' ')[2]))}"
