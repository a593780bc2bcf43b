"""Latencies of a past run, from the envelopes in its log and the controller's own timing."""

from collections import defaultdict
from collections.abc import Callable
from typing import Any

from lowfc.adapters.bus.bus import name_in
from lowfc.adapters.logs.history import read_history
from lowfc.adapters.logs.parts import LogFiles, WholeLog
from lowfc.adapters.logs.recovery import missing_parts
from lowfc.contract.errors import DataFileError
from lowfc.contract.messages import FRAME, HEALTH, MIRROR_STATE, TIMING, Role, wire
from lowfc.programs.measure.latency.frame_statistics import controller_counts, frame_outcomes, repeat_statistics

_LOOP = frozenset({Role.CAMERA, Role.CONTROLLER, Role.MIRROR})


def log_statistics(files: LogFiles, progress: Callable[[int, int], None]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Latency statistics of a log, like those of one repeat of `lowfc latency`; and the log's path, gaps and host.

    For a run on several hosts, `clock_error_us` is the largest error of a latency between two of them.

    Raises:
        DataFileError: no frame after the warm-up was timed.
    """
    log = WholeLog(files, progress)
    history = read_history(log)
    mirror = history.mirror.sequence, history.mirror.publish_time_ns
    timing = history.timed_sequence, history.stages_ns
    statistics = repeat_statistics(
        frame_outcomes(history.frame_sequence, history.frame_publish_ns, None, timing, mirror)
    )
    if "frame_to_command" not in statistics["latency_us"]:
        raise DataFileError(
            f"{log.path} has no timed frame after its first 0.5 s: it is short, is not of a loop, or lacks {FRAME.key} "
            f"or {TIMING.key}"
        )
    if MIRROR_STATE in log.selection.excluded:
        statistics["frames_without_mirror_state"] = None
    statistics["rate_hz"] *= log.selection.interval_frames  # rate of the loop, not of the recorded frames
    controller = history.health.get(Role.CONTROLLER, wire.Health())
    host: dict[str, Any] = dict(log.metadata.get("lowfc", {}))
    host |= {"granted": list(controller.realtime_granted), "refused": list(controller.realtime_refused)}
    if any(health.router_round_trip_ns for health in history.health.values()):
        round_trips_ns: dict[str, int] = defaultdict(int)
        for message in history.reader(HEALTH):
            if (name := name_in(HEALTH, message.key)).partition("-")[0] in _LOOP:
                trip_ns = wire.Health.FromString(message.payload).router_round_trip_ns
                round_trips_ns[name] = max(round_trips_ns[name], trip_ns)
        host["clock_error_us"] = sum(sorted(round_trips_ns.values())[-2:]) / 2e3
    log_facts = {
        "settings": {"log": str(log.path), "selection": log.selection.description},
        **missing_parts(log),
        "host": host,
    }
    return statistics | controller_counts(controller), log_facts
