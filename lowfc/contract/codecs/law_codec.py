"""Encode and decode control laws, command channels and probe sequences."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from lowfc.arrays import Single
from lowfc.contract.messages import fields_of, floats, timestamp, wire
from lowfc.control.laws.integrator import Integrator
from lowfc.control.laws.linear_law import LinearLaw, matrix_shapes
from lowfc.control.loop.command_channels import Channel, CommandChannels, Play, PlayTable
from lowfc.control.loop.guard import NAMES

_PLAIN = ("name", "signal", "delay_frames", "rate_hz")  # fields of the same name in law and message


def law_header(law: LinearLaw) -> wire.LinearLaw:
    """Message of a law without its matrices, which the reader finds by the law's identity."""
    return wire.LinearLaw(noll=law.noll, states=len(law.transition), id=law.id, **fields_of(law, _PLAIN))


def wire_law(law: LinearLaw, time_ns: int = 0) -> wire.LinearLaw:
    """Message of a complete law."""
    message = law_header(law)
    message.timestamp.CopyFrom(timestamp(time_ns))
    for name in matrix_shapes(0, 0):
        setattr(message, name, getattr(law, name).tobytes())
    return message


def law_of(message: wire.LinearLaw, laws: Mapping[str, LinearLaw] = MappingProxyType({})) -> LinearLaw:
    """The law of a message; if the message has no matrices, the law with its identity in `laws`.

    ValueError if the law is incomplete or not in `laws`.
    """
    if message.id and not message.transition:
        if message.id not in laws:
            raise ValueError(f"the law {message.id[:12]} is missing")
        return laws[message.id]
    shapes = matrix_shapes(message.states, len(message.noll))
    matrices: dict[str, Any] = {name: floats(getattr(message, name), *shape) for name, shape in shapes.items()}
    return LinearLaw(noll=tuple(message.noll), **fields_of(message, _PLAIN), **matrices)


def driving(state: wire.ControllerState | None, laws: Mapping[str, LinearLaw]) -> LinearLaw | None:
    """The law that drives the mirror, or will once the loop is closed; None for the integrator."""
    return law_of(state.law, laws) if state is not None and state.HasField("law") else None


def overruled(state: wire.ControllerState) -> list[str]:
    """Groups of modes that the integrator drives instead of the law."""
    return [name for name, group in zip(NAMES, state.guard.groups, strict=False) if group.overruled]


def integrator_of(state: wire.ControllerState) -> Integrator:
    """The integrator of a controller's state."""
    gain, leak, limit_nm = (np.array(values, np.float32) for values in (state.gain, state.leak, state.limit_nm))
    return Integrator(gain, leak, limit_nm)


def wire_play(table: PlayTable, time_ns: int) -> wire.Play:
    """Message of the complete table of a probe sequence."""
    return wire.Play(
        target=table.target,
        columns=table.rows.shape[1],
        table=table.rows.tobytes(),
        basis=table.basis.tobytes(),
        id=table.id,
        frames=len(table.rows),
        timestamp=timestamp(time_ns),
    )


def put_command_channels(message: wire.ControllerState, command_channels: CommandChannels) -> None:
    """Write offset, shifts of the zero point, command channels and probe sequence into a state."""
    message.offset_nm.extend(command_channels.offset_nm.tolist())
    message.shift_history_nm.extend(np.concatenate(command_channels.shifts_nm).tolist())
    for channel in command_channels.channels:
        shape, reached = channel.shape_nm.tobytes(), channel.reached_nm.tobytes()
        message.channels.add(name=channel.name, actuators=shape, shifts=channel.shifts, reached=reached)
    play = command_channels.play
    if play is not None:
        message.play.target = play.table.target
        message.play.first_sequence = play.first_sequence
        message.play.columns = play.table.rows.shape[1]
        message.play.frames = play.frames
        message.play.id = play.table.id


def command_channels_of(
    message: wire.ControllerState, empty: CommandChannels, to_modes: Single, plays: Mapping[str, PlayTable]
) -> CommandChannels | None:
    """Offset, command channels and probe sequence of a state; None if it has none.

    `empty` defines the shapes of the arrays. The table of a probe sequence is found in `plays` by its identity; states
    from versions before 0.2 contain the rows to play instead.

    Raises:
        ValueError: the shapes do not match, or the table is missing.
    """
    if not (message.offset_nm or message.channels or message.HasField("play")):
        return None
    rows, columns = empty.sum_nm.shape
    modes, frames = empty.shift_nm.size, len(empty.shifts_nm)
    offset_nm = np.array(message.offset_nm, np.float32).reshape(modes)
    shifts_nm = np.array(message.shift_history_nm, np.float32).reshape(frames, modes)
    channels = tuple(
        Channel.of(stored.name, floats(stored.actuators, rows, columns), floats(stored.reached, rows, columns))
        for stored in message.channels
    )
    play = None
    if message.HasField("play"):
        stored_play = message.play
        if not stored_play.id:
            table = floats(stored_play.table, -1, stored_play.columns or 1)
            basis = floats(stored_play.basis, -1, rows * columns)
            played = PlayTable(stored_play.target, table, basis, largest=np.zeros(0), reach_nm=0.0, id="")
            play = Play(played, stored_play.first_sequence, len(table))
        elif stored_play.id not in plays:
            raise ValueError(f"the table {stored_play.id[:12]} of the probe sequence is missing")
        else:
            play = Play(plays[stored_play.id], stored_play.first_sequence, stored_play.frames)
    return empty._replace(offset_nm=offset_nm, shifts_nm=tuple(shifts_nm), play=play).with_all(channels, to_modes)
