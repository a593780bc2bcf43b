"""The mirror's own protection: limits, command timeout and validation of commands, as pure functions.

It trusts no sender and is the same for simulated and real mirrors. The driver is passed in as a function, `Move`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from lowfc.arrays import Single
from lowfc.control.loop.command_channels import MAX_CHANNELS, MAX_NAME_LENGTH
from lowfc.control.loop.safety import Limit, Limited, Limits, Reason, Rejection, expired, finite, limit

_NONE: Single = np.zeros(0, np.float32)

MAX_VALID_NS = 2_000_000_000
"""Longest time for which a command may be held; a longer `valid_for_ns` is shortened to it."""
MAX_FRAME_AHEAD_NS = 1_000_000_000
"""Largest time by which a frame's time may be ahead of the mirror's clock; beyond it, `tick` uses only that clock."""


Move = Callable[[Single, float], Single]
"""Function that drives the actuators (rows, columns), nm of surface, and returns their positions. Its second argument
is the time to settle, ns: since the previous command if a command arrives, else since the last call; first infinite."""


@dataclass(frozen=True)
class MirrorProtection:
    """Limits of a mirror, and its action on the command timeout: flat if `flatten`, otherwise hold the shape.

    The limits apply after the driver has rounded to `step_nm`.
    """

    grid: tuple[int, int]
    limits: Limits
    step_nm: float
    flatten: bool

    @cached_property
    def tightened_limits(self) -> Limits:
        """Limits tightened by one driver step, so that rounding cannot exceed the real limits."""
        limits, step = self.limits, self.step_nm
        return Limits(limits.stroke_nm - step, limits.slew_nm - step, limits.neighbour_nm - step)


class Command(NamedTuple):
    """A command as received.

    Attributes:
        actuators_nm: (rows, columns) float32, nm of surface; None if the bytes are not a grid.
        safe: whether it was sent in safe mode.
        clear_id: identity of the operator's last `clear`; a new one permits sequences below the newest received.
        ahead: whether its sender's start time (upper bits of the sequence) is too far ahead of the mirror's clock.
    """

    channel: str
    frame_sequence: int
    time_ns: int
    valid_for_ns: int
    actuators_nm: Single | None
    command_nm: Single
    safe: bool = False
    clear_id: int = 0
    ahead: bool = False


class Status(NamedTuple):
    """State of the mirror.

    Attributes:
        driven_nm: (rows, columns) shape sent to the driver, before its rounding, nm of surface; within the limits,
            unless it was read back from the driver.
        surface_nm: (rows, columns) positions of the actuators, nm of surface.
        channels: last shape (rows, columns) of each command channel, nm of surface; the mirror applies their sum.
        command_nm: modal command of the last command; empty if the mirror's own limits changed it.
        limits_hit: the mirror's own limits that acted on the last command.
        frame_sequence: sequence of the frame of the last command.
        time_ns: time of that frame; between commands it advances by the mirror's clock.
        commanded_ns: `time_ns` at the last command.
        received_ns: reception of the last command, ns of the mirror's clock.
        valid_for_ns: time for which the last command may be held.
        following: whether a command is in force.
        safe: channels whose last command was sent in safe mode.
        clear_id: identity of the newest `clear` received with a command.
    """

    driven_nm: Single
    surface_nm: Single
    channels: Mapping[str, Single] = MappingProxyType({})
    command_nm: Single = _NONE
    limits_hit: tuple[Reason, ...] = ()
    frame_sequence: int = 0
    time_ns: int = 0
    commanded_ns: int = 0
    received_ns: int = 0
    valid_for_ns: int = 0
    following: bool = False
    safe: frozenset[str] = frozenset()
    clear_id: int = 0


def apply_command(
    protection: MirrorProtection,
    status: Status,
    command: Command,
    now_ns: int,
    move: Move,
    others_nm: Single | None = None,
) -> tuple[Status, Reason | None]:
    """Apply a command received at `now_ns`; return the new status and None, or the former status and the refusal.

    `others_nm` (rows, columns) is the shape of other programs on the mirror; it uses part of the stroke.
    """
    reason = _refusal(protection, status, command)
    if reason is not None:
        return status, reason
    assert command.actuators_nm is not None  # noqa: S101  # checked in _refusal
    channels = {**status.channels, command.channel: command.actuators_nm}
    target_nm = command.actuators_nm
    if len(channels) > 1:
        with np.errstate(over="ignore", invalid="ignore"):  # a sum that is not finite is refused by `limit`
            target_nm = sum(channels.values(), np.zeros(protection.grid, np.float32))
    limited = _limited(protection, status.driven_nm, target_nm, others_nm)
    # From frame to frame, not from the last tick: ticks use the mirror's own clock, which is ahead of a frame's time.
    elapsed_ns = command.time_ns - status.commanded_ns if status.commanded_ns else np.inf
    if elapsed_ns <= 0:  # a command repeated for the same frame: only the mirror's own clock has advanced
        elapsed_ns = now_ns - status.received_ns
    applied = Status(
        driven_nm=limited.actuators_nm,
        surface_nm=move(limited.actuators_nm, elapsed_ns),
        channels=channels,
        command_nm=command.command_nm if not limited.reasons else _NONE,
        limits_hit=limited.reasons,
        frame_sequence=command.frame_sequence,
        time_ns=command.time_ns,
        commanded_ns=command.time_ns,
        received_ns=now_ns,
        valid_for_ns=min(command.valid_for_ns, MAX_VALID_NS),
        following=True,
        safe=status.safe | {command.channel} if command.safe else status.safe - {command.channel},
        clear_id=command.clear_id or status.clear_id,
    )
    return applied, None


def _limited(protection: MirrorProtection, previous_nm: Single, target_nm: Single, others_nm: Single | None) -> Limited:
    """Limit the command so that its sum with other programs' shape exceeds the stroke no more than that shape alone."""
    if others_nm is None or not others_nm.any() or not finite(target_nm):
        return limit(protection.tightened_limits, previous_nm, target_nm)
    stroke_nm = np.float32(protection.tightened_limits.kept_stroke_nm)
    clipped_nm = np.clip(target_nm, np.minimum(-stroke_nm - others_nm, 0), np.maximum(stroke_nm - others_nm, 0))
    limited = limit(protection.tightened_limits, previous_nm, clipped_nm)
    add_reason = Limit.STROKE not in limited.reasons and not np.array_equal(clipped_nm, target_nm)
    return limited._replace(reasons=(Limit.STROKE, *limited.reasons)) if add_reason else limited


def tick(protection: MirrorProtection, status: Status, now_ns: int, move: Move) -> Status:
    """Advance the mirror without a new command: let it settle, and apply the command timeout."""
    if status.following and expired(now_ns - status.received_ns, status.valid_for_ns):
        status = status._replace(following=False, channels={})
    if not status.following and protection.flatten and status.driven_nm.any():
        flat = limit(protection.tightened_limits, status.driven_nm, np.zeros(protection.grid, np.float32)).actuators_nm
        status = status._replace(driven_nm=flat, limits_hit=(), command_nm=_NONE, channels={})
    has_time = status.time_ns and status.time_ns - now_ns < MAX_FRAME_AHEAD_NS
    time_ns = max(now_ns, status.time_ns) if has_time else now_ns
    elapsed_ns = time_ns - status.time_ns if has_time else np.inf
    return status._replace(surface_nm=move(status.driven_nm, elapsed_ns), time_ns=time_ns)


def _refusal(protection: MirrorProtection, status: Status, command: Command) -> Reason | None:
    if command.actuators_nm is None or command.actuators_nm.shape != protection.grid:
        return Limit.WRONG_GRID
    if not (finite(command.actuators_nm) and finite(command.command_nm)):
        return Limit.NOT_FINITE
    if command.ahead:
        return Rejection.AHEAD
    cleared = command.clear_id and command.clear_id != status.clear_id
    if command.frame_sequence < status.frame_sequence and not cleared:
        return Rejection.OUT_OF_ORDER
    full = len(status.channels) >= MAX_CHANNELS and command.channel not in status.channels
    if full or len(command.channel) > MAX_NAME_LENGTH:
        return Limit.CHANNEL
    return None
