"""A mirror's process: passes commands to its driver and publishes its state and its surface."""

import contextlib
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.bus.start_check import StartCheck
from lowfc.adapters.files.factory import true_mirror
from lowfc.adapters.process.clock import SimulatedClock
from lowfc.adapters.process.service import Service
from lowfc.arrays import Single
from lowfc.contract.codecs.codec import actuators
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import ConfigurationError
from lowfc.contract.messages import (
    COMMAND,
    MIRROR_STATE,
    SURFACE,
    checked_sequence,
    checked_time_ns,
    image,
    timestamp,
    wire,
)
from lowfc.control.loop.safety import Limits, Reason, Rejection, finite
from lowfc.device.driver import Mirror, MirrorExtras, geometry, own_method
from lowfc.device.mirror_protection import Command, MirrorProtection, Status, apply_command, tick
from lowfc.device.watch import CLOSE_S, DriverWatch
from lowfc.optics.chain.grid import pupil_axis
from lowfc.optics.chain.mirror import influence_factors

TICK_NS = 10_000_000
"""Period of the calls of `tick` without commands."""
IDLE_STATE_NS = 100_000_000
"""Period at which the state is published without commands; a restarted controller starts from the published shape."""
PICTURE_PIXELS = 64
"""Pixels across the published picture of the surface."""
PATIENCE_S = 0.5
"""Timeout of a call of the driver."""


class _LostError(Exception):
    """The driver failed or hung: the position of the mirror is unknown."""


_NO_EXTRAS = MirrorExtras()
_NONE: Single = np.zeros(0, np.float32)


def protection_of(driver: Mirror, config: Configuration) -> MirrorProtection:
    """Protection of a mirror, with the tighter of its driver's limits and those of [mirror].

    ConfigurationError if its grid is not that of [mirror], or if the driver's step is not below every limit; ValueError
    if a limit of the driver is impossible.
    """
    own, configured = driver.geometry, geometry(config)
    if (own.rows, own.columns) != (configured.rows, configured.columns):
        raise ConfigurationError(
            f"the mirror has {own.rows} x {own.columns} actuators; mirror.rows and mirror.columns say "
            f"{configured.rows} x {configured.columns}"
        )
    limits = Limits(
        min(own.stroke_nm, configured.stroke_nm),
        min(own.slew_nm, configured.slew_nm),
        min(own.neighbour_nm, configured.neighbour_nm),
    )
    bound_nm = min(limits.stroke_nm, limits.slew_nm, limits.neighbour_nm) - 2 * limits.margin_nm
    if not 0 <= own.step_nm < bound_nm:
        raise ConfigurationError(
            f"the mirror's smallest step is {own.step_nm:g} nm, expected 0 or more and below {bound_nm:g} nm, so that "
            "rounding stays within the stroke, slew and neighbour limits"
        )
    return MirrorProtection((own.rows, own.columns), limits, own.step_nm, config.mirror.on_command_timeout == "flat")


class MirrorLoop:
    """Applies commands until it is stopped."""

    def __init__(self, driver: Mirror, service: Service, config: Configuration) -> None:
        """Declare publishers and subscribers on the bus, and find the mirror's position."""
        name = config.mirror.name
        self._driver = driver
        self._service = service
        self._protection = protection_of(driver, config)
        self._settle = own_method(driver, "settle", MirrorExtras.settle)
        self._beside = getattr(driver, "beside", None)
        getattr(driver, "join", _NO_EXTRAS.join)(service)
        self._fill_extra = getattr(driver, "fill", _NO_EXTRAS.fill)
        self.watch = DriverWatch(service, PATIENCE_S, self._report_hang)
        self._driver_lock = threading.Lock()
        self._applied_ns = self._picture_due_ns = self._state_due_ns = 0
        self._states = service.publisher(MIRROR_STATE, name)
        self._surfaces = service.publisher(SURFACE, name)
        mirror, axis = true_mirror(config), pupil_axis(PICTURE_PIXELS)
        self._y_factors: Single = influence_factors(mirror, axis, mirror.rows).astype(np.float32)
        self._x_factors: Single = influence_factors(mirror, axis, mirror.columns).astype(np.float32)
        self._refused: Reason | None = None
        report_ahead = partial(service.event, "START_AHEAD", what="commands")
        self._start_check = StartCheck(service.clock, config.control.max_start_ahead_h, report_ahead)
        flat_nm = np.zeros(self._protection.grid, np.float32)
        self._status = Status(flat_nm, flat_nm)
        self._position_known = self._returning = False
        self._driven_nm: Single | None = None
        with contextlib.suppress(_LostError):
            self._start(flat_nm)
        service.fill = self._fill
        service.dispatch(COMMAND, self._arrived, name, period_ns=config.period_ns)
        service.awaited = lambda: "" if self._status.received_ns else "a controller"
        service.state = "ready"

    def _start(self, flat_nm: Single) -> None:
        """Start from the mirror's position if its driver can read it; otherwise drive it to flat."""
        held_nm = self._read_shape()
        if held_nm is None:
            self._status = Status(flat_nm, self._drive(flat_nm, np.inf))
        else:
            self._status, self._driven_nm = Status(held_nm, held_nm), held_nm
        self._position_known = True

    def run(self) -> None:
        """Run the command timeout and the recovery from faults; the receive thread applies commands."""
        service = self._service
        with self.watch.until_closed(self._close, self._fill_extra):
            while service.running:
                time.sleep(TICK_NS * 1e-9)
                acquired = self._driver_lock.acquire(timeout=TICK_NS * 1e-9)
                if acquired:
                    try:
                        if not service.clock.lockstep and service.clock.host_ns() - self._applied_ns >= TICK_NS:
                            self._idle()
                    finally:
                        self._driver_lock.release()
                service.beat(alive=acquired)
        service.finish()

    def _close(self) -> None:
        self._service.stop(self._service.why)  # also after a fault: no further command is passed to the driver
        acquired = self._driver_lock.acquire(timeout=CLOSE_S)  # a call of the driver may still run, and never return
        try:
            self._driver.close()
        finally:
            if acquired:
                self._driver_lock.release()

    def _arrived(self, sample: Sample) -> None:
        """Handle a command on the receive thread; superseded commands are skipped."""
        with self._driver_lock:
            if self._service.running:
                self._next_command(sample)

    def _next_command(self, sample: Sample) -> None:
        clock = self._service.clock
        command = command_of(sample.payload, self._start_check)
        if isinstance(clock, SimulatedClock):
            clock.set_ns(command.time_ns)
        before, refused_before = self._status, self._refused
        refused: Reason | None = Rejection.NO_MIRROR
        if not self._returning:
            try:  # faster than `suppress`
                others_nm = None if self._beside is None else self._call(self._beside)
                self._status, refused = apply_command(
                    self._protection, before, command, clock.now_ns(), self._drive, others_nm
                )
            except _LostError:
                pass
        self._refused = refused
        self._publish(self._status.time_ns or clock.now_ns())
        self._service.work += 1
        if refused is not None and refused is not refused_before:
            why = f", {self.watch.why}" if refused is Rejection.NO_MIRROR else ""
            self._service.event("COMMAND_REFUSED", reason=f"{refused.name}{why}")
        if refused is None:
            self._applied_ns = clock.host_ns()
        if not before.following and before.frame_sequence and refused is None:
            self._service.event("COMMAND_BACK")
        for reason in self._status.limits_hit:
            if reason not in before.limits_hit:
                self._service.event("LIMIT_HIT", reason=reason.name)

    def _drive(self, actuators_nm: Single, elapsed_ns: float) -> Single:
        """Call the driver to move; a real mirror is called only with a new command."""
        if self._settle is not None:
            reached_nm = self._call(self._settle, actuators_nm, elapsed_ns)
        elif actuators_nm is self._driven_nm:
            return self._status.surface_nm
        else:
            reached_nm = self._call(self._driver.apply, actuators_nm)
        self.watch.worked()  # not after other calls: they would reset the pauses between retries of a failing `apply`
        self._driven_nm = actuators_nm
        return actuators_nm if reached_nm is None else reached_nm

    def _read_shape(self) -> Single | None:
        position = getattr(self._driver, "position", None)
        return None if position is None else self._call(position)

    def _call(self, method: Callable[..., Single | None], *arguments: object) -> Single | None:
        """Call a method of the driver and return the shape that it returns, copied; None if it returns none.

        _LostError if it failed or hung: the position is then unknown until the driver moves the mirror again.
        A LowfcError of the driver is raised unchanged.
        """
        self.watch.begin()
        try:
            shape_nm = method(*arguments)
            if shape_nm is not None:
                shape_nm = np.array(shape_nm, np.float32, order="C")  # a driver may use its array again
                if shape_nm.shape != (grid := self._protection.grid):
                    raise ValueError(f"it returned positions of shape {shape_nm.shape}, expected {grid}")
                if not finite(shape_nm):
                    raise ValueError("it returned positions that are NaN or infinite, expected nm of surface")
            if self.watch.returned():
                return shape_nm
        except (Exception, SystemExit) as fault:  # a driver's `sys.exit` would end only the receive thread
            self.watch.failed(fault)
        self._position_known, self._returning, self._driven_nm = False, True, None
        self._status = self._status._replace(following=False, channels={}, command_nm=_NONE)
        raise _LostError

    def _report_hang(self) -> None:
        """Publish the position as unknown; called on the watch's thread."""
        self._position_known, self._refused = False, Rejection.NO_MIRROR
        self._publish(self._service.clock.now_ns())

    def _return_to_idle(self) -> None:
        """After a fault, step towards the idle state: flat, or the shape read back or last commanded."""
        if self._service.clock.host_ns() < self.watch.retry_ns:
            return
        protection = self._protection
        if self._driven_nm is None:
            if (held_nm := self._read_shape()) is not None:
                self._status = self._status._replace(driven_nm=held_nm)
            else:  # the failed call may have moved the mirror: repeat the last shape, surely within the slew limit
                protection = replace(protection, flatten=False)
        self._status = tick(protection, self._status, self._service.clock.now_ns(), self._drive)
        self._position_known = True
        self._returning = self._protection.flatten and bool(self._status.driven_nm.any())
        if not self._returning:
            self._refused = None

    def _idle(self) -> None:
        now_ns = self._service.clock.now_ns()
        before = self._status
        with contextlib.suppress(_LostError):
            if self._returning:
                self._return_to_idle()
            else:
                self._status = tick(self._protection, before, now_ns, self._drive)
        if before.following and not self._status.following and not self._returning:
            action = "relaxing to flat" if self._protection.flatten else "holding the shape"
            self._service.event("COMMAND_EXPIRED", command_timeout_ms=before.valid_for_ns / 1e6, action=action)
        moved = self._status.surface_nm is not before.surface_nm  # at rest it is the same array
        if (moved and (self._status.surface_nm != before.surface_nm).any()) or now_ns >= self._state_due_ns:
            self._publish(now_ns)

    def _publish(self, time_ns: int) -> None:
        status = self._status
        self._states.put(
            state_of(status, time_ns, self._refused, position_known=self._position_known).SerializeToString()
        )
        now_ns = self._service.clock.now_ns()  # not `time_ns`, which may be the time in a command, and wrong
        self._state_due_ns = now_ns + IDLE_STATE_NS
        if now_ns >= self._picture_due_ns and self._position_known:
            picture = np.asarray(self._y_factors @ status.surface_nm @ self._x_factors.T, np.float32)
            self._surfaces.put(image(picture, time_ns, "mirror").SerializeToString())
            self._picture_due_ns = now_ns + int(1e9 / float(SURFACE.rate))

    def _fill(self, health: wire.Health) -> None:
        """Add the mirror's fields to a Health; an operator's `status` shows them."""
        status = self._status
        health.command_refused = self._refused.value if self._refused is not None else 0  # type: ignore[assignment]
        health.command_expired = bool(status.received_ns) and not status.following
        health.limits_hit.extend(reason.value for reason in status.limits_hit)  # type: ignore[misc]
        self.watch.fill(self._fill_extra, health)


def state_of(
    status: Status, time_ns: int, refused: Reason | None = None, *, position_known: bool = True
) -> wire.MirrorState:
    """Message of a mirror's state; `refused` is the reason if the last command was refused."""
    rows, columns = status.surface_nm.shape
    following = wire.MIRROR_STATUS_FOLLOWING if status.following and position_known else wire.MIRROR_STATUS_EXPIRED
    return wire.MirrorState(
        timestamp=timestamp(time_ns),
        frame_sequence=status.frame_sequence,
        status=following if status.received_ns or not position_known else wire.MIRROR_STATUS_WAITING,
        rows=rows,
        columns=columns,
        actuators=status.surface_nm.tobytes() if position_known else b"",
        command_nm=status.command_nm.tolist(),
        limits_hit=[reason.value for reason in status.limits_hit],  # type: ignore[misc]  # numbered alike
        channels=sorted(status.channels),
        safe=bool(status.safe),
        refused=0 if refused is None else refused.value,  # type: ignore[arg-type]  # numbered alike
    )


def command_of(payload: bytes, start_check: StartCheck | None = None) -> Command:
    """Decode a MirrorCommand; DecodeError if it cannot be read, BadMessageError for an impossible sequence or time."""
    message = wire.MirrorCommand.FromString(payload)
    return Command(
        message.channel,
        checked_sequence(message.frame_sequence),
        checked_time_ns(message.timestamp),
        message.valid_for_ns,
        actuators(message),
        np.fromiter(message.command_nm, np.float32, len(message.command_nm)),
        message.safe,
        message.clear_id,
        start_check is not None and start_check.ahead(message.frame_sequence),
    )
