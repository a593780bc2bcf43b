"""What protects a mirror: its own limits, its own dead-man, its own check of commands; functions of values.

It trusts no sender, and it is the same for every mirror, simulated or real. The mirror itself is a function `Move`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from lowfc.arrays import Single
from lowfc.control.loop.command_channels import LONGEST_NAME, MOST_CHANNELS
from lowfc.control.loop.safety import Limit, Limited, Limits, Reason, Rejection, expired, limit

_NONE: Single = np.zeros(0, np.float32)

LONGEST_VALID_NS = 2_000_000_000
"""Longest validity of a command, whatever the command says."""
AHEAD_NS = 1_000_000_000
"""How far a frame's time may be ahead of the mirror's clock and still be taken for the time of the surface."""


Move = Callable[[Single, float], Single]
"""Drives the actuators (rows, columns), nm of surface; returns where they are. The second is the time of the run since
the last call, ns."""


@dataclass(frozen=True)
class Guard:
    """Limits of a mirror, after its driver has rounded to `step_nm`, and what it does once the last command expires.

    `flatten`: it relaxes to flat then, and holds its shape otherwise.
    """

    grid: tuple[int, int]
    limits: Limits
    step_nm: float
    flatten: bool

    @cached_property
    def tighter(self) -> Limits:
        """Limits before the driver rounds, one step tighter, so that rounding cannot cross those that count."""
        limits, step = self.limits, self.step_nm
        return Limits(limits.stroke_nm - step, limits.slew_nm - step, limits.neighbour_nm - step)


@dataclass(frozen=True, slots=True)
class Command:
    """A command as it came.

    Attributes:
        actuators_nm: (rows, columns) float32, nm of surface, or None where the bytes made no grid.
        safe: it was sent in safe mode.
        clear_id: identity of the operator's last clear; a new one makes the mirror forget the newest sequence.
        ahead: its sequence starts further ahead of the mirror's clock than allowed (a clock's verdict).
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
    """Where the mirror is.

    Attributes:
        driven_nm: (rows, columns) what the driver is given, before it rounds: always within the limits.
        surface_nm: (rows, columns) where the actuators are.
        channels: last actuators of each channel; the mirror follows their sum.
        command_nm: the modal command behind it; empty where the mirror's own limits changed it.
        limits_hit: the mirror's own limits that acted on the last command.
        frame_sequence: of the frame behind the last command; its time is `time_ns`.
        commanded_ns: `time_ns` at the last command; between commands `time_ns` goes on by the mirror's clock.
        received_ns: when the last command came, by the mirror's clock.
        valid_for_ns: how long it may be held.
        following: whether there is a command in force.
        safe: channels whose last command was sent in safe mode.
        clear_id: of the newest clear that a command carried.
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
    guard: Guard, status: Status, command: Command, now_ns: int, move: Move, beside_nm: Single | None = None
) -> tuple[Status, Reason | None]:
    """Follow a command that came at `now_ns`; a refused one changes nothing, and the reason is returned.

    What others have on the mirror, `beside_nm` (rows, columns), leaves less of the stroke.
    """
    reason = _refusal(guard, status, command)
    if reason is not None:
        return status, reason
    assert command.actuators_nm is not None  # noqa: S101  # _refusal
    channels = {**status.channels, command.channel: command.actuators_nm}
    wanted = command.actuators_nm
    if len(channels) > 1:
        with np.errstate(over="ignore", invalid="ignore"):  # a sum that is not finite is refused by `limit`
            wanted = sum(channels.values(), np.zeros(guard.grid, np.float32))
    limited = _limited(guard, status.driven_nm, wanted, beside_nm)
    # From frame to frame, not from the last tick: ticks go by the mirror's own clock, which is ahead of a frame's time.
    elapsed_ns = command.time_ns - status.commanded_ns if status.commanded_ns else np.inf
    if elapsed_ns <= 0:  # the same frame again, while the camera is silent: only the mirror's own clock goes on
        elapsed_ns = now_ns - status.received_ns
    followed = Status(
        driven_nm=limited.actuators_nm,
        surface_nm=move(limited.actuators_nm, elapsed_ns),
        channels=channels,
        command_nm=command.command_nm if not limited.reasons else _NONE,
        limits_hit=limited.reasons,
        frame_sequence=command.frame_sequence,
        time_ns=command.time_ns,
        commanded_ns=command.time_ns,
        received_ns=now_ns,
        valid_for_ns=min(command.valid_for_ns, LONGEST_VALID_NS),
        following=True,
        safe=status.safe | {command.channel} if command.safe else status.safe - {command.channel},
        clear_id=command.clear_id or status.clear_id,
    )
    return followed, None


def _limited(guard: Guard, previous_nm: Single, wanted_nm: Single, beside_nm: Single | None) -> Limited:
    """The command in its limits; in a sum with others each actuator goes no further than the stroke, or not at all."""
    if beside_nm is None or not beside_nm.any() or not np.isfinite(wanted_nm).all():
        return limit(guard.tighter, previous_nm, wanted_nm)
    stroke_nm = np.float32(guard.tighter.kept_stroke_nm)
    room_nm = np.clip(wanted_nm, np.minimum(-stroke_nm - beside_nm, 0), np.maximum(stroke_nm - beside_nm, 0))
    limited = limit(guard.tighter, previous_nm, room_nm)
    cut = Limit.STROKE not in limited.reasons and not np.array_equal(room_nm, wanted_nm)
    return limited._replace(reasons=(Limit.STROKE, *limited.reasons)) if cut else limited


def tick(guard: Guard, status: Status, now_ns: int, move: Move) -> Status:
    """Without a command: settle, and act on one that has expired."""
    if status.following and expired(now_ns - status.received_ns, status.valid_for_ns):
        status = status._replace(following=False, channels={})
    if not status.following and guard.flatten and status.driven_nm.any():
        flat = limit(guard.tighter, status.driven_nm, np.zeros(guard.grid, np.float32)).actuators_nm
        status = status._replace(driven_nm=flat, limits_hit=(), command_nm=_NONE, channels={})
    known = status.time_ns and status.time_ns - now_ns < AHEAD_NS
    time_ns = max(now_ns, status.time_ns) if known else now_ns
    elapsed_ns = time_ns - status.time_ns if known else np.inf
    return status._replace(surface_nm=move(status.driven_nm, elapsed_ns), time_ns=time_ns)


def _refusal(guard: Guard, status: Status, command: Command) -> Reason | None:
    if command.actuators_nm is None or command.actuators_nm.shape != guard.grid:
        return Limit.WRONG_GRID
    if not (np.isfinite(command.actuators_nm).all() and np.isfinite(command.command_nm).all()):
        return Limit.NOT_FINITE
    if command.ahead:
        return Rejection.AHEAD
    cleared = command.clear_id and command.clear_id != status.clear_id
    if command.frame_sequence < status.frame_sequence and not cleared:
        return Rejection.OUT_OF_ORDER
    full = len(status.channels) >= MOST_CHANNELS and command.channel not in status.channels
    if full or len(command.channel) > LONGEST_NAME:
        return Limit.CHANNEL
    return None
