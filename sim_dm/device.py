"""The simulated mirror: commands in, surface out; pure functions of values.

It trusts nobody: its own limits, its own dead-man, its own check of what it is told.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from math import expm1
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lowfc.control.loop.command_channels import LONGEST_NAME, MOST_CHANNELS
from lowfc.control.loop.safety import Limit, Limits, Reason, Rejection, expired, limit

Single = npt.NDArray[np.float32]

_NONE: Single = np.zeros(0, np.float32)

LONGEST_VALID_NS = 2_000_000_000
"""However long a command says that it is valid, the mirror does not hold it longer."""
AHEAD_NS = 1_000_000_000
"""By which a frame's time may be ahead of the mirror's clock and still say when the surface was where it was."""


@dataclass(frozen=True)
class Device:
    """What the mirror is.

    Attributes:
        grid: rows and columns of actuators.
        limits: which it keeps, whatever it is told.
        step_nm: least step of the driver.
        settling_ns: time constant of the actuators.
        fixed_nm: (rows, columns) height of dead and stuck actuators, NaN for those that move.
        flatten: whether it relaxes to flat once the last command has expired, or holds its shape.
    """

    grid: tuple[int, int]
    limits: Limits
    step_nm: float
    settling_ns: float
    fixed_nm: Single
    flatten: bool

    @cached_property
    def tighter(self) -> Limits:
        """Limits before the driver rounds, one step tighter, so that rounding cannot cross those that count."""
        limits, step = self.limits, self.step_nm
        return Limits(limits.stroke_nm - step, limits.slew_nm - step, limits.neighbour_nm - step)

    @cached_property
    def fixed(self) -> npt.NDArray[np.intp] | None:
        """Which of the flattened actuators are dead or stuck; None where all move."""
        found = np.flatnonzero(np.isfinite(self.fixed_nm))
        return found if found.size else None


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
        clear_id: of the newest clear that a command told of.
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


def initial(device: Device) -> Status:
    """Flat, and waiting for the first command."""
    flat = np.zeros(device.grid, np.float32)
    return Status(flat, _at_rest(device, flat))


def apply_command(device: Device, status: Status, told: Command, now_ns: int) -> tuple[Status, Reason | None]:
    """Follow a command that came at `now_ns`; a refused one changes nothing, and the reason is returned."""
    reason = _refusal(device, status, told)
    if reason is not None:
        return status, reason
    assert told.actuators_nm is not None  # noqa: S101  # _refusal
    channels = {**status.channels, told.channel: told.actuators_nm}
    wanted = told.actuators_nm
    if len(channels) > 1:
        with np.errstate(over="ignore", invalid="ignore"):  # a sum that is not finite is refused by `limit`
            wanted = sum(channels.values(), np.zeros(device.grid, np.float32))
    limited = limit(device.tighter, status.driven_nm, wanted)
    # From frame to frame, not from the last tick: ticks go by the mirror's own clock, which is ahead of a frame's time.
    elapsed_ns = told.time_ns - status.commanded_ns if status.commanded_ns else np.inf
    if elapsed_ns <= 0:  # the same frame again, while the camera is silent: only the mirror's own clock goes on
        elapsed_ns = now_ns - status.received_ns
    followed = Status(
        driven_nm=limited.actuators_nm,
        surface_nm=_settled(device, limited.actuators_nm, status.surface_nm, elapsed_ns),
        channels=channels,
        command_nm=told.command_nm if not limited.reasons else _NONE,
        limits_hit=limited.reasons,
        frame_sequence=told.frame_sequence,
        time_ns=told.time_ns,
        commanded_ns=told.time_ns,
        received_ns=now_ns,
        valid_for_ns=min(told.valid_for_ns, LONGEST_VALID_NS),
        following=True,
        safe=status.safe | {told.channel} if told.safe else status.safe - {told.channel},
        clear_id=told.clear_id or status.clear_id,
    )
    return followed, None


def tick(device: Device, status: Status, now_ns: int) -> Status:
    """Without a command: settle, and act on one that has expired."""
    if status.following and expired(now_ns - status.received_ns, status.valid_for_ns):
        status = status._replace(following=False, channels={})
    if not status.following and device.flatten and status.driven_nm.any():
        flat = limit(device.tighter, status.driven_nm, np.zeros(device.grid, np.float32)).actuators_nm
        status = status._replace(driven_nm=flat, limits_hit=(), command_nm=_NONE, channels={})
    known = status.time_ns and status.time_ns - now_ns < AHEAD_NS
    time_ns = max(now_ns, status.time_ns) if known else now_ns
    elapsed_ns = time_ns - status.time_ns if known else np.inf
    surface_nm = _settled(device, status.driven_nm, status.surface_nm, elapsed_ns)
    return status._replace(surface_nm=surface_nm, time_ns=time_ns)


def _refusal(device: Device, status: Status, told: Command) -> Reason | None:
    if told.actuators_nm is None or told.actuators_nm.shape != device.grid:
        return Limit.WRONG_GRID
    if not (np.isfinite(told.actuators_nm).all() and np.isfinite(told.command_nm).all()):
        return Limit.NOT_FINITE
    if told.ahead:
        return Rejection.AHEAD
    cleared = told.clear_id and told.clear_id != status.clear_id
    if told.frame_sequence < status.frame_sequence and not cleared:
        return Rejection.OUT_OF_ORDER
    full = len(status.channels) >= MOST_CHANNELS and told.channel not in status.channels
    if full or len(told.channel) > LONGEST_NAME:
        return Limit.CHANNEL
    return None


def _settled(device: Device, driven_nm: Single, surface_nm: Single, elapsed_ns: float) -> Single:
    """Round to the driver's steps; first-order response of the actuators from a surface of `elapsed_ns` ago."""
    step = np.float32(device.step_nm)
    settled = driven_nm / step
    np.rint(settled, out=settled)
    settled *= step
    if device.settling_ns > 0 and elapsed_ns <= 20 * device.settling_ns:
        settled -= surface_nm
        settled *= np.float32(-expm1(-max(elapsed_ns, 0) / device.settling_ns))
        settled += surface_nm
    return _at_rest(device, settled)


def _at_rest(device: Device, surface_nm: Single) -> Single:
    """Dead and stuck actuators stay where they are."""
    if device.fixed is None:
        return surface_nm
    kept = surface_nm.copy()
    kept.flat[device.fixed] = device.fixed_nm.flat[device.fixed]
    return kept
