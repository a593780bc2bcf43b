"""A mirror of your own: what `apply` is given goes to its driver. Replace it, the grid and the limits by your mirror's.

Example: python examples/mirror.py --run bench
"""

from contextlib import closing
from functools import partial

import numpy as np
import typer
from google.protobuf.message import DecodeError

from lowfc.adapters.bus.run import mirror_role
from lowfc.adapters.process.join import join
from lowfc.adapters.process.terminal import DEFAULT_RUN, ConfigFile, RunId, configuration, run_app
from lowfc.arrays import Single
from lowfc.contract.codecs.codec import actuators
from lowfc.contract.messages import COMMAND, MIRROR_STATE, wire
from lowfc.control.loop.safety import Limits, limit

GRID, STEP_NM = (34, 34), 1500 / 2**16
LIMITS = Limits(750 - STEP_NM, 150 - STEP_NM, 500 - STEP_NM)  # stroke, slew, neighbours: a step inside the hardware's
LONGEST_VALID_NS, IDLE_STATE_NS = 2_000_000_000, 100_000_000


def apply(actuators_nm: Single, nm_per_unit: float) -> Single:
    """Move the mirror to these (rows, columns) nm of surface from flat; return where it is."""
    units = np.round(actuators_nm / nm_per_unit, 2)  # what your driver takes, and its least step
    return (units * nm_per_unit).astype(np.float32)


def good(payload: bytes, last_sequence: int, clear_id: int) -> tuple[wire.MirrorCommand, Single]:
    """The command in `payload` and its actuators; ValueError says why one must not be followed.

    `clear_id` is that of the last command with one: an operator's new `clear` begins the sequences anew.
    """
    try:
        command = wire.MirrorCommand.FromString(payload)
    except DecodeError:
        raise ValueError("no MirrorCommand") from None
    wanted_nm = actuators(command)  # None where the bytes are not rows x columns float32
    if wanted_nm is None or wanted_nm.shape != GRID:
        raise ValueError(f"{command.rows} x {command.columns} actuators in {len(command.actuators)} bytes, not {GRID}")
    if not np.isfinite(wanted_nm).all():
        raise ValueError("an actuator is not finite")
    if command.clear_id in (0, clear_id) and command.frame_sequence < last_sequence:
        raise ValueError(f"frame_sequence {command.frame_sequence} is below the last, {last_sequence}")
    return command, wanted_nm


def main(run: RunId = DEFAULT_RUN, config: ConfigFile = None) -> None:
    """Follow commands until it is stopped."""
    settings = configuration(config)
    name = settings.mirror.name
    service = join(settings, run, mirror_role(name), settings.realtime.mirror_cpus)  # real-time set-up, clock and bus
    service.catch_signals()
    commands, states = service.mailbox(COMMAND, name), service.publisher(MIRROR_STATE, name)
    moved = partial(apply, nm_per_unit=settings.mirror.nm_per_unit)
    where_nm = moved(np.zeros(GRID, np.float32))
    state = wire.MirrorState(rows=GRID[0], columns=GRID[1], status=wire.MIRROR_STATUS_WAITING)
    obeyed_ns = valid_ns = due_ns = clear_id = 0
    service.state = "running"
    with closing(service.bus):
        while service.running:
            sample, now_ns = commands.take(0.01), service.clock.now_ns()
            followed, time_ns = None, now_ns
            try:
                followed = good(sample.payload, state.frame_sequence, clear_id) if sample is not None else None
            except ValueError as why:
                service.event("COMMAND_REFUSED", reason=why)
            if followed is not None:
                command, wanted_nm = followed
                time_ns = command.timestamp.ToNanoseconds()
                kept_nm, hit = limit(LIMITS, where_nm, wanted_nm)
                where_nm, obeyed_ns, valid_ns = moved(kept_nm), now_ns, min(command.valid_for_ns, LONGEST_VALID_NS)
                state.frame_sequence, state.status = command.frame_sequence, wire.MIRROR_STATUS_FOLLOWING
                state.safe, clear_id = command.safe, command.clear_id or clear_id
                state.command_nm[:] = [] if hit else command.command_nm
                state.limits_hit[:] = [one.value for one in hit]  # type: ignore[misc]  # numbered alike
                service.work += 1
            if state.status == wire.MIRROR_STATUS_FOLLOWING and now_ns - obeyed_ns > valid_ns:  # the dead-man
                state.status = wire.MIRROR_STATUS_EXPIRED
                service.event("COMMAND_EXPIRED", command_timeout_ms=valid_ns / 1e6, action="relaxing to flat")
            relaxing = state.status == wire.MIRROR_STATUS_EXPIRED and where_nm.any()
            if relaxing:
                where_nm = moved(limit(LIMITS, where_nm, np.zeros_like(where_nm)).actuators_nm)
                del state.command_nm[:]  # it is no longer where a command wanted it
            if followed is not None or relaxing or now_ns >= due_ns:  # without commands ten times a second
                state.timestamp.FromNanoseconds(time_ns)
                state.actuators = where_nm.tobytes()
                states.put(state.SerializeToString())
                due_ns = now_ns + IDLE_STATE_NS
            service.beat()  # Health, twice a second
        service.finish()


if __name__ == "__main__":
    run_app(partial(typer.run, main))  # a mistake is one line, not a traceback
