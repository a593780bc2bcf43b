"""A soak: the simulated loop for hours, looked at once a second, its logs checked and removed as they are finished."""

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError
from rich.console import Console

from lowfc.adapters.bus import Sample
from lowfc.adapters.child import Child
from lowfc.adapters.clock import HostClock
from lowfc.adapters.log_reader import LogReader
from lowfc.adapters.run import new_run_id, open_run
from lowfc.adapters.usage import resident_bytes
from lowfc.adapters.zenoh_bus import ZenohBus
from lowfc.contract.configuration import Configuration
from lowfc.contract.envelope import count_of, start_of
from lowfc.contract.errors import DataFileError
from lowfc.contract.messages import EVENT, FRAME, HEALTH, TIMING, Role, wire
from lowfc.programs.processes import start_all, stop_all
from lowfc.programs.sim_loop import check, children_of, prepare
from lowfc.programs.soak.figures import Usage, of_latency, of_process, too_short
from lowfc.programs.watch import Watch, topic_count

LOOK_S = 1.0
_READY_S = 240.0
_PATIENCE_S = 10.0
_LAST_HEALTH_S = 0.2


class LogChecker:
    """Reads each log once it is finished, and removes it: a night's would not fit on a disk.

    Attributes:
        logs: how many there were.
        messages: in all of them.
        gaps: messages that are not in the logs, between others of the same publisher.
    """

    def __init__(self, folder: Path) -> None:
        """Check the logs of a folder."""
        self._folder = folder
        self._last: dict[tuple[str, int], int] = {}
        self.logs = self.messages = self.gaps = 0

    def look(self) -> None:
        """Check and remove what has been finished.

        Raises:
            DataFileError: a log is damaged.
        """
        for path in sorted(self._folder.glob("*.mcap"), key=lambda one: (one.stat().st_mtime_ns, one.name)):
            for message in LogReader(path):
                self.messages += 1
                if message.key != EVENT.key:  # all publish there, and their counts do not tell them apart
                    self._enter((message.key, start_of(message.sequence)), count_of(message.sequence))
            self.logs += 1
            path.unlink()

    def _enter(self, line: tuple[str, int], count: int) -> None:
        before = self._last.get(line)
        if before is not None and count > before:
            self.gaps += count - before - 1
        self._last[line] = max(count, before or 0)


class _Soak:
    """The processes of a soak, and what is seen of them."""

    def __init__(self, config: Configuration, folder: Path) -> None:
        self.checker = LogChecker(folder)
        self.watch = Watch({}, [])
        self.usage: dict[str, list[Usage]] = {}
        self.latency: list[tuple[float, float, float]] = []
        self._taken_ns: list[int] = []
        self.run = open_run(new_run_id(), (config.mirror.name,), listeners=(Role.LAUNCHER,))
        prepare(config, self.run, Console(stderr=True, quiet=True))
        self.children = children_of(config, self.run, None, record=True)

    def hear_timing(self, sample: Sample) -> None:
        try:
            self._taken_ns += wire.ControlTiming.FromString(sample.payload).frame_to_command_ns
        except DecodeError:
            return

    def look(self, now_s: float) -> None:
        for child in self.children:
            if child.status is None:
                self.usage.setdefault(child.name, []).append(_usage(child, now_s))
        taken, self._taken_ns = self._taken_ns, []
        if taken:
            p50, p99 = np.percentile(np.array(taken) / 1e3, (50, 99))
            self.latency.append((now_s, float(p50), float(p99)))
        self.checker.look()


def _usage(child: Child, now_s: float) -> Usage:
    assert child.process is not None  # noqa: S101  # it was started
    there = Path(f"/proc/{child.process.pid}")
    handles, threads = (sum(1 for _ in (there / name).iterdir()) for name in ("fd", "task"))
    return Usage(now_s, resident_bytes(child.process.pid), handles, threads)


def soak_loop(config: Configuration, seconds: float, progress: Callable[[float], None]) -> dict[str, Any]:
    """Run the loop for so long; the figures that `lowfc soak --json` prints.

    Args:
        config: of the loop; its logs go elsewhere.
        seconds: of looking, from the first frame on.
        progress: told how many have passed.

    Raises:
        ProcessDiedError: a process ended by itself.
        DataFileError: a log is damaged.
    """
    with tempfile.TemporaryDirectory(prefix="lowfc-soak-") as name:
        logged = config.model_copy(update={"recorder": config.recorder.model_copy(update={"folder": name})})
        soak = _Soak(logged, Path(name))
        try:
            start_all(soak.children)
            bus = ZenohBus(soak.run.links, Role.LAUNCHER, HostClock())
            try:
                bus.subscribe(HEALTH, soak.watch.hear)
                bus.subscribe(TIMING, soak.hear_timing)
                _look(soak, seconds, progress)
                begun_s = time.monotonic()
                stop_all(soak.children, _PATIENCE_S)
                stopped_s = time.monotonic() - begun_s
                time.sleep(_LAST_HEALTH_S)
            finally:
                bus.close()
                stop_all(soak.children)
            soak.checker.look()
            unfinished = [path.name for path in Path(name).glob("*.part")]
        finally:
            soak.run.remove()
    return _figures(soak, seconds, stopped_s, unfinished)


def _look(soak: _Soak, seconds: float, progress: Callable[[float], None]) -> None:
    deadline_s = time.monotonic() + _READY_S
    while not topic_count(soak.watch.of(Role.CONTROLLER), FRAME.key).received:
        check(soak.children)
        if time.monotonic() >= deadline_s:
            raise DataFileError(f"no frame came within {_READY_S:g} s")
        time.sleep(LOOK_S / 10)
    begun_s = time.monotonic()
    while (elapsed_s := time.monotonic() - begun_s) < seconds:
        check(soak.children)
        soak.look(elapsed_s)
        progress(elapsed_s)
        time.sleep(max(0.0, LOOK_S - (time.monotonic() - begun_s - elapsed_s)))


def _figures(soak: _Soak, seconds: float, stopped_s: float, unfinished: list[str]) -> dict[str, Any]:
    frames = topic_count(soak.watch.of(Role.CONTROLLER), FRAME.key)
    recording = soak.watch.of(Role.RECORDER).recording
    processes = {name: of_process(samples) for name, samples in soak.usage.items()}
    figures: dict[str, Any] = {
        "hours": seconds / 3600,
        "rate_hz": round(soak.watch.of(Role.CAMERA).mean_rate_hz, 2),
        "frames_published": topic_count(soak.watch.of(Role.CAMERA), FRAME.key).published,
        "frames_skipped": frames.skipped,
        "frames_missing": frames.missing,
        "messages_recorded": soak.checker.messages,
        "messages_lost": recording.lost,
        "logs": soak.checker.logs,
        "gaps": soak.checker.gaps,
        "stopped_within_s": round(stopped_s, 2),
        "processes": processes,
        "latency": of_latency(soak.latency),
    }
    why = [f"the {name}'s {what} grow" for name, one in processes.items() for what in one["grows"]]
    why += [f"{figures[key]} {word}" for key, word in _NONE_OF if figures[key]]
    why += [f"{name} was not finished" for name in unfinished]
    if recording.messages != soak.checker.messages:
        why.append(f"the recorder says {recording.messages} messages, in the logs are {soak.checker.messages}")
    unjudged = too_short(processes, figures["latency"])
    return figures | {"why": why, "too_short": unjudged, "passed": not why and not unjudged}


_NONE_OF = (
    ("messages_lost", "messages lost"),
    ("gaps", "messages missing in the logs"),
    ("frames_missing", "frames never arrived"),
)
