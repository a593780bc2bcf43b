"""Latencies of a past run, from the envelopes in its log and the controller's own timing."""

from collections.abc import Callable
from typing import Any

from google.protobuf.message import DecodeError

from lowfc.adapters.bus.bus import name_in
from lowfc.adapters.logs.columns import Columns, TimingRows
from lowfc.adapters.logs.parts import LogFiles, WholeLog
from lowfc.contract.errors import DataFileError
from lowfc.contract.messages import COMMAND, FRAME, HEALTH, MIRROR_STATE, TIMING, Role, wire
from lowfc.programs.measure.latency.figures import controllers_account, join, repeat_figures

_LOOP = frozenset({Role.CAMERA, Role.CONTROLLER, Role.MIRROR})


def log_figures(files: LogFiles, progress: Callable[[int, int], None]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Figures of one log as of one repeat, and what its metadata say of the host.

    Returns:
        `repeat_figures` and `controllers_account`; and `provenance`, with what the host granted the controller and,
        where the loop was on several hosts, `clock_error_us`: what a span from one to another is wrong by at most.

    Raises:
        DataFileError: this is no log, it is damaged, or it has no frame whose timing is known.
    """
    log = WholeLog(files, topics=(FRAME, COMMAND, MIRROR_STATE, TIMING, HEALTH))
    log.progress = progress
    frames, commands = Columns(sequence="Q", publish_ns="q"), Columns(sequence="Q")
    states, timings = Columns(sequence="Q", publish_ns="q"), TimingRows()
    controller = wire.Health()
    round_trips_ns: dict[str, int] = {}
    for message in log:
        try:
            if FRAME.matches(message.key):
                frames.add(sequence=message.sequence, publish_ns=message.publish_time_ns)
            elif COMMAND.matches(message.key):
                commands.add(sequence=wire.MirrorCommand.FromString(message.payload).frame_sequence)
            elif MIRROR_STATE.matches(message.key):
                sequence = wire.MirrorState.FromString(message.payload).frame_sequence
                states.add(sequence=sequence, publish_ns=message.publish_time_ns)
            elif TIMING.matches(message.key):
                timings.add(wire.ControlTiming.FromString(message.payload))
            elif (name := name_in(HEALTH, message.key)).partition("-")[0] in _LOOP:
                health = wire.Health.FromString(message.payload)
                round_trips_ns[name] = max(round_trips_ns.get(name, 0), health.router_round_trip_ns)
                if name == Role.CONTROLLER:
                    controller = health
        except (DecodeError, OverflowError):
            continue  # a message that nobody of the loop could read either
    mirror = states.taken("sequence"), states.taken("publish_ns")
    sent = frames.taken("sequence"), frames.taken("publish_ns")
    figures = repeat_figures(join(*sent, None, timings.taken(), mirror, commands.taken("sequence")))
    if "frame_to_command" not in figures["latency_us"]:
        raise DataFileError(
            f"{log.path} has no frame after the first half second whose timing the controller reported; it is too "
            "short, or of no loop"
        )
    host: dict[str, Any] = dict(log.metadata.get("lowfc", {}))
    host |= {"granted": list(controller.realtime_granted), "refused": list(controller.realtime_refused)}
    if any(round_trips_ns.values()):
        host["clock_error_us"] = sum(sorted(round_trips_ns.values())[-2:]) / 2e3
    return figures | controllers_account(controller), host
