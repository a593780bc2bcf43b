"""The simulated mirror: commands in, surface out; pure functions of values.

It trusts nobody: its own limits, its own dead-man, its own check of what it is told.
"""

from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from lowfc.control.safety import Limits, Reason, expired, limit

Single = npt.NDArray[np.float32]

LONGEST_VALID_NS = 2_000_000_000
"""However long a command says that it is valid, the mirror does not hold it longer."""


@dataclass(frozen=True, slots=True)
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


@dataclass(frozen=True, slots=True)
class Told:
    """A command as it came: actuators (rows, columns) float32, nm of surface, or None where the bytes made no grid."""

    channel: str
    frame_sequence: int
    time_ns: int
    valid_for_ns: int
    actuators_nm: Single | None
    command_nm: Single


@dataclass(frozen=True, slots=True)
class Status:
    """Where the mirror is.

    Attributes:
        driven_nm: (rows, columns) what the driver puts out: always within the limits.
        surface_nm: (rows, columns) where the actuators are.
        channels: last actuators of each channel; the mirror follows their sum.
        command_nm: the modal command behind it; empty where the mirror's own limits changed it.
        limits_hit: the mirror's own limits that acted on the last command.
        frame_sequence: of the frame behind the last command; its time is `time_ns`.
        received_ns: when the last command came, by the mirror's clock.
        valid_for_ns: how long it may be held.
        following: whether there is a command in force.
    """

    driven_nm: Single
    surface_nm: Single
    channels: dict[str, Single] = field(default_factory=dict)
    command_nm: Single = field(default_factory=lambda: np.zeros(0, np.float32))
    limits_hit: tuple[Reason, ...] = ()
    frame_sequence: int = 0
    time_ns: int = 0
    received_ns: int = 0
    valid_for_ns: int = 0
    following: bool = False


def initial(device: Device) -> Status:
    """Flat, and waiting for the first command."""
    flat = np.zeros(device.grid, np.float32)
    return Status(flat, _at_rest(device, flat))


def obey(device: Device, status: Status, told: Told, now_ns: int) -> tuple[Status, Reason | None]:
    """Follow a command that came at `now_ns`; a refused one changes nothing, and the reason is returned."""
    reason = _refusal(device, status, told)
    if reason is not None:
        return status, reason
    assert told.actuators_nm is not None  # noqa: S101  # _refusal
    channels = status.channels | {told.channel: told.actuators_nm}
    wanted = told.actuators_nm if len(channels) == 1 else sum(channels.values(), np.zeros(device.grid, np.float32))
    driven_nm, limits_hit = _drive(device, status.driven_nm, wanted)
    status = replace(
        status,
        driven_nm=driven_nm,
        channels=channels,
        command_nm=told.command_nm if not limits_hit else np.zeros(0, np.float32),
        limits_hit=limits_hit,
        frame_sequence=told.frame_sequence,
        received_ns=now_ns,
        valid_for_ns=min(told.valid_for_ns, LONGEST_VALID_NS),
        following=True,
    )
    return _settle(device, status, told.time_ns), None


def tick(device: Device, status: Status, now_ns: int) -> Status:
    """Without a command: settle, and act on one that has expired."""
    if status.following and expired(now_ns - status.received_ns, status.valid_for_ns):
        status = replace(status, following=False)
    if not status.following and device.flatten and status.driven_nm.any():
        driven_nm, limits_hit = _drive(device, status.driven_nm, np.zeros(device.grid, np.float32))
        empty = np.zeros(0, np.float32)
        status = replace(status, driven_nm=driven_nm, limits_hit=limits_hit, command_nm=empty, channels={})
    return _settle(device, status, max(now_ns, status.time_ns))


def _refusal(device: Device, status: Status, told: Told) -> Reason | None:
    if told.actuators_nm is None or told.actuators_nm.shape != device.grid:
        return Reason.WRONG_GRID
    if not np.isfinite(told.actuators_nm).all():
        return Reason.NOT_FINITE
    if told.frame_sequence < status.frame_sequence:
        return Reason.OUT_OF_ORDER
    return None


def _drive(device: Device, previous_nm: Single, wanted_nm: Single) -> tuple[Single, tuple[Reason, ...]]:
    """Limit, then round to the driver's steps; the limits are one step tighter, so that rounding cannot cross them."""
    step, limits = device.step_nm, device.limits
    tighter = Limits(limits.stroke_nm - step, limits.slew_nm - step, limits.neighbour_nm - step)
    limited = limit(tighter, previous_nm, wanted_nm)
    steps = np.round(limited.actuators_nm / np.float32(step))
    return (steps * np.float32(step)).astype(np.float32), limited.reasons


def _settle(device: Device, status: Status, time_ns: int) -> Status:
    """First-order response of the actuators up to `time_ns`."""
    elapsed_ns = time_ns - status.time_ns if status.time_ns else np.inf
    if device.settling_ns <= 0 or elapsed_ns > 20 * device.settling_ns:
        surface = status.driven_nm
    else:
        fraction = np.float32(-np.expm1(-max(elapsed_ns, 0) / device.settling_ns))
        surface = status.surface_nm + fraction * (status.driven_nm - status.surface_nm)
    return replace(status, surface_nm=_at_rest(device, surface), time_ns=time_ns)


def _at_rest(device: Device, surface_nm: Single) -> Single:
    """Dead and stuck actuators stay where they are."""
    return np.where(np.isnan(device.fixed_nm), surface_nm, device.fixed_nm)
