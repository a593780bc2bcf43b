"""Control laws, channels and plays as messages, both ways."""

from typing import cast

import numpy as np
import numpy.typing as npt

from lowfc.contract.messages import floats, wire
from lowfc.control.additions import Additions, Channel, Play
from lowfc.control.linear_law import LinearLaw, Signal

Single = npt.NDArray[np.float32]

_MATRICES = ("follow", "gain", "kept", "coast", "output")


def wire_law(law: LinearLaw) -> wire.LinearLaw:
    """A law as a message."""
    message = wire.LinearLaw(
        name=law.name,
        signal=law.signal,
        noll=law.noll,
        delay_frames=law.delay_frames,
        rate_hz=law.rate_hz,
        states=len(law.follow),
    )
    for name in _MATRICES:
        setattr(message, name, getattr(law, name).tobytes())
    return message


def law_of(message: wire.LinearLaw) -> LinearLaw:
    """The law of a message.

    Raises:
        ValueError: it is not whole.
    """
    states, modes = message.states, len(message.noll)
    follow, coast = (floats(each, states, states) for each in (message.follow, message.coast))
    gain, kept = (floats(each, states, modes) for each in (message.gain, message.kept))
    return LinearLaw(
        cast("Signal", message.signal),  # a law refuses any other
        follow,
        gain,
        kept,
        coast,
        floats(message.output, modes, states),
        message.name,
        tuple(message.noll),
        message.delay_frames,
        message.rate_hz,
    )


def put_additions(message: wire.ControllerState, additions: Additions) -> None:
    """What is added to the law's command, into a state."""
    message.offset_nm.extend(additions.offset_nm.tolist())
    message.shift_history_nm.extend(np.concatenate(additions.shifts_nm).tolist())
    for one in additions.channels:
        wanted, reached = one.wanted_nm.tobytes(), one.reached_nm.tobytes()
        message.channels.add(name=one.name, actuators=wanted, shifts=one.shifts, reached=reached)
    play = additions.play
    if play is not None:
        message.play.target = play.target
        message.play.first_sequence = play.first_sequence
        message.play.columns = play.table.shape[1]
        message.play.table = play.table.tobytes()
        message.play.basis = play.basis.tobytes()


def additions_of(message: wire.ControllerState, none: Additions, to_modes: Single) -> Additions | None:
    """What is added, of a state; `none` has its shapes. None where the state has nothing of it.

    Raises:
        ValueError: it does not fit.
    """
    if not message.offset_nm:
        return None
    rows, columns = none.sum_nm.shape
    modes, frames = none.shift_nm.size, len(none.shifts_nm)
    offset_nm = np.array(message.offset_nm, np.float32).reshape(modes)
    shifts_nm = np.array(message.shift_history_nm, np.float32).reshape(frames, modes)
    channels = tuple(
        Channel.of(one.name, floats(one.actuators, rows, columns), floats(one.reached, rows, columns))
        for one in message.channels
    )
    play = None
    if message.HasField("play"):
        one = message.play
        basis = floats(one.basis, -1, rows * columns) if one.basis else np.zeros((0, rows * columns), np.float32)
        play = Play(one.target, one.first_sequence, floats(one.table, -1, one.columns), basis)
    return none._replace(offset_nm=offset_nm, shifts_nm=tuple(shifts_nm), play=play).at(channels, to_modes)
