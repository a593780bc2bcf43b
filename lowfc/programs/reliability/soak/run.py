"""A soak: the simulated loop for hours, sampled once a second; finished logs are checked and removed."""

import contextlib
import random
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil

from lowfc.adapters.logs.reader import LogReader
from lowfc.adapters.logs.selection import EVERYTHING
from lowfc.contract.configuration import Configuration
from lowfc.contract.envelope import count_of, start_of
from lowfc.contract.messages import EVENT, FRAME, Role, topic_of, wire
from lowfc.contract.sequence_gaps import Gaps
from lowfc.control.loop.safety import mode_name
from lowfc.programs.launch.sim_loop import deferred_signals, raise_if_died
from lowfc.programs.launch.watch import topic_count
from lowfc.programs.reliability.chaos.bench import ChaosBench
from lowfc.programs.reliability.chaos.processes import CommandTimes
from lowfc.programs.reliability.soak.evaluation import Usage, latency_statistics, process_statistics, too_short

SAMPLE_S = 1.0
_PATIENCE_S = 10.0  # for a process to exit
_MUST_BE_ZERO = {
    "messages_lost": "messages lost",
    "gaps": "messages missing in the logs",
    "frames_missing": "frames missing",
}


class LogChecker:
    """Checks each finished log for gaps, then removes it, because the logs of a night would fill the disk."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._selection = EVERYTHING
        self._received: dict[tuple[str, int], Gaps] = {}
        self.logs = self.messages = 0

    @property
    def gaps(self) -> int:
        """Messages missing from the logs: gaps in each publisher's counts, on topics that are recorded in full."""
        received = self._received.items()
        return sum(gaps.missing for (key, _), gaps in received if self._selection.records_all(topic_of(key)))

    def check(self) -> None:
        """Check and remove the finished logs."""
        for path in sorted(self._folder.glob("*.mcap"), key=lambda log: (log.stat().st_mtime_ns, log.name)):
            reader = LogReader(path)
            for message in reader:
                self.messages += 1
                if message.key != EVENT.key:  # all processes publish events: the publisher is ambiguous
                    count = count_of(message.sequence)
                    self._received.setdefault((message.key, start_of(message.sequence)), Gaps(count)).add(count)
            self._selection = reader.selection
            self.logs += 1
            path.unlink()


class _Soak:
    """The samples of a running bench, and the results from them."""

    def __init__(self, bench: ChaosBench) -> None:
        self.bench = bench
        self.checker = LogChecker(bench.folder)
        self.usage: dict[str, list[Usage]] = {}
        self.latency: list[tuple[float, float, float]] = []
        self.mode = bench.outcome.mode
        self._times = CommandTimes(bench)

    def sample(self, now_s: float) -> None:
        """Sample processes and latency `now_s` seconds after the start, and check finished logs."""
        children = list(self.bench.children.values())
        raise_if_died(children)
        for child in children:
            assert child.process is not None  # noqa: S101  # it was started
            with contextlib.suppress(psutil.Error):  # the process has just ended: the next check raises
                process = psutil.Process(child.process.pid)
                used = Usage(now_s, process.memory_info().rss, process.num_fds(), process.num_threads())
                self.usage.setdefault(child.name, []).append(used)
        if timed := self._times.drain():
            self.latency.append((now_s, timed["p50_us"], timed["p99_us"]))
        self.checker.check()

    def results(self, seconds: float, stopped_s: float, unfinished: list[str]) -> dict[str, Any]:
        """The results that `lowfc soak --json` prints."""
        controller, recorder, camera = (
            self.bench.health.get(role, wire.Health()) for role in (Role.CONTROLLER, Role.RECORDER, Role.CAMERA)
        )
        frames, recording = topic_count(controller, FRAME.key), recorder.recording
        processes = {name: process_statistics(samples) for name, samples in self.usage.items()}
        measured: dict[str, Any] = {
            "hours": seconds / 3600,
            "rate_hz": round(camera.mean_rate_hz, 2),
            "frames_published": topic_count(camera, FRAME.key).published,
            "frames_skipped": frames.skipped,
            "frames_missing": frames.missing,
            "messages_recorded": self.checker.messages,
            "messages_lost": recording.lost,
            "logs": self.checker.logs,
            "gaps": self.checker.gaps,
            "stopped_within_s": round(stopped_s, 2),
            "processes": processes,
            "latency": latency_statistics(self.latency),
        }
        why = [f"growth of the {name}'s {what}" for name, process in processes.items() for what in process["grows"]]
        why += [f"{measured[key]} {text}" for key, text in _MUST_BE_ZERO.items() if measured[key]]
        if recording.failure:
            why.append(f"the recording ended: {recording.failure}")
        why += [f"{name} was not finished" for name in unfinished]
        if self.mode != wire.LOOP_MODE_CLOSED:
            why.append(f"the loop should be closed at the end, its mode is {mode_name(self.mode)}")
        if recording.messages != self.checker.messages:
            why.append(f"the recorder reports {recording.messages} messages, the logs have {self.checker.messages}")
        unjudged = too_short(processes, measured["latency"])
        return measured | {"why": why, "too_short": unjudged, "passed": not why and not unjudged}


def soak_loop(config: Configuration, seconds: float, progress: Callable[[float], None]) -> dict[str, Any]:
    """Run the loop for `seconds`, or until Ctrl-C; return the results that `lowfc soak --json` prints."""
    with tempfile.TemporaryDirectory(prefix="lowfc-soak-") as name:
        logged = config.model_copy(update={"recorder": config.recorder.model_copy(update={"folder": name})})
        bench = ChaosBench(logged, Path(name), random.Random(), None)  # noqa: S311  # nothing secret
        try:
            bench.begin()
            soak = _Soak(bench)
            begun_s = time.monotonic()
            with deferred_signals() as interrupted:
                while (elapsed_s := time.monotonic() - begun_s) < seconds and not interrupted():
                    soak.sample(elapsed_s)
                    progress(elapsed_s)
                    time.sleep(max(0.0, SAMPLE_S - (time.monotonic() - begun_s - elapsed_s)))
            soak.mode = bench.outcome.mode  # before the processes are stopped
        finally:
            begun_s = time.monotonic()
            bench.end(_PATIENCE_S)
            stopped_s = time.monotonic() - begun_s
        soak.checker.check()
        unfinished = [path.name for path in Path(name).glob("*.part")]
    return soak.results(min(elapsed_s, seconds), stopped_s, unfinished) | {"interrupted": interrupted()}
