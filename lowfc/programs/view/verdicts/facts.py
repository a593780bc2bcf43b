"""Facts of a run as text: run and host, control law and gains, offset and channels, last note."""

import numpy as np

from lowfc.contract.messages import Role, from_timestamp, wire
from lowfc.contract.printable import printable
from lowfc.control.loop.wording import counted
from lowfc.optics.chain.zernike import mode_name
from lowfc.programs.cli.status import channels_in_words, json_object, law_in_words
from lowfc.programs.view.snapshot import Snapshot
from lowfc.programs.view.verdicts.run_state import RunState
from lowfc.programs.view.verdicts.tile import clock, numbers, short

_MAX_NAMED = 3
"""Largest number of modes of an offset that are named one by one."""


def facts(state: RunState) -> dict[str, str]:
    """The facts of a run by title; a text says which are not known."""
    snapshot, note = state.snapshot, "none known"
    if state.note is not None:
        at = clock(from_timestamp(state.note.timestamp), "%H:%M")
        note = f"{at} {short(state.note.message.partition(' ')[2])}"
    law = shapes = "not known"
    if snapshot.controller is not None:
        status = json_object(snapshot.controller)
        law = short(law_in_words(status))
        if not snapshot.controller.HasField("law"):
            leak = f", leak {numbers(status['leak'])}" if any(status["leak"]) else ""
            law += f", gain {numbers(status['gain'])}{leak}" if status["gain"] else ", no calibration"
        law += f"; delay {counted(snapshot.controller.delay_frames, 'frame')}"
        shapes = f"{_offset(status['offset_nm'], snapshot.noll)}; {short(channels_in_words(status))}"
        if status["playing"]:
            shapes += f"; probe sequence on the {printable(status['playing']['target'])}"
    return {"RUN": _run(snapshot), "CONTROL LAW": law, "OFFSET AND CHANNELS": shapes, "LAST NOTE": note}


def _run(snapshot: Snapshot) -> str:
    if snapshot.ended is not None:
        name, host = snapshot.ended.run, snapshot.ended.host
    else:
        reported = {name: one.health for name, one in snapshot.health.items() if name != Role.VIEWER}
        health = reported.get(Role.CONTROLLER) or next(iter(reported.values()), wire.Health())
        name, host = printable(health.run_id), printable(health.host)
    return (f"{name} on {host}" if host else name) or "not known"


def _offset(values_nm: list[float], noll: tuple[int, ...]) -> str:
    indices = np.flatnonzero(values_nm)
    if not indices.size:
        return "no offset"
    if len(noll) != len(values_nm) or len(indices) > _MAX_NAMED:
        return f"offset {np.linalg.norm(values_nm):.3g} nm rms, {counted(len(indices), 'mode')}"
    return f"offset {', '.join(f'{mode_name(noll[index])} {values_nm[index]:.3g}' for index in indices)} nm"
