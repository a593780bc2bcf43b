"""Soaks: growth is detected, noise is not, gaps in the logs are counted, and a soak ends with its results."""

import json
import signal
from collections import Counter
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import psutil
import pytest

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.logs.selection import EVERYTHING, Selection
from lowfc.adapters.logs.writer import LogWriter
from lowfc.adapters.process.clock import HostClock
from lowfc.contract.configuration import FIXED_GAINS, load
from lowfc.contract.envelope import sequence_of
from lowfc.contract.messages import FRAME, STEP, TIMING, TRUTH, wire
from lowfc.programs.reliability.chaos.bench import ChaosBench
from lowfc.programs.reliability.chaos.processes import CommandTimes
from lowfc.programs.reliability.soak import run
from lowfc.programs.reliability.soak.evaluation import (
    Usage,
    latency_statistics,
    process_statistics,
    render,
    slope,
    too_short,
)
from lowfc.programs.reliability.soak.run import LogChecker
from lowfc.testing.memory_bus import MemoryBus, MemoryHub
from tests.reliability.toy_bench import CAMERA_PID, TOY_KEYS, ToyBench
from tests.support.loops import lowfc

SECONDS = 1800
START_S = 1_800_000_000
COUNTS = {
    "frames_published": 10,
    "frames_skipped": 1,
    "frames_missing": 0,
    "messages_recorded": 50,
    "messages_lost": 0,
    "logs": 2,
    "gaps": 0,
}


@pytest.fixture
def stub(tmp_path: Path) -> Any:
    """A bench of a closed loop without processes."""
    return SimpleNamespace(
        bus=MemoryBus(MemoryHub(), "launcher", HostClock()),
        outcome=SimpleNamespace(mode=wire.LOOP_MODE_CLOSED, measurements={}),
        folder=tmp_path,
        health={},
        children={},
    )


def usage(leak_mb_per_hour: float, seed: int = 1, handles_per_hour: float = 0.0) -> list[Usage]:
    """Usage of a process in each second of half an hour: 100 MB plus growth, with noise of 2 MB rms."""
    rng = np.random.default_rng(seed)
    times = np.arange(SECONDS)
    memory = 100e6 + leak_mb_per_hour * 1e6 * times / 3600 + 2e6 * rng.standard_normal(SECONDS)
    memory[: SECONDS // 8] -= 20e6  # caches fill at the start
    return [
        Usage(float(time), round(one), 20 + int(handles_per_hour * time / 3600), 5)
        for time, one in zip(times, memory, strict=True)
    ]


@pytest.mark.parametrize("seed", range(5))
def test_noise_and_the_warm_up_do_not_count_as_growth(seed: int) -> None:
    found = process_statistics(usage(0.0, seed))
    assert found["grows"] == []
    assert abs(found["memory_mb_per_hour"]) < 4 * found["memory_mb_per_hour_error"] < 4


@pytest.mark.parametrize("seed", range(5))
def test_a_memory_leak_is_detected_with_its_rate(seed: int) -> None:
    found = process_statistics(usage(20.0, seed))
    assert found["grows"] == ["memory"]
    assert found["memory_mb_per_hour"] == pytest.approx(20, abs=5 * found["memory_mb_per_hour_error"])


def test_a_growing_number_of_handles_is_detected() -> None:
    assert process_statistics(usage(0.0, handles_per_hour=60))["grows"] == ["handles"]


def test_too_few_samples_are_reported_as_too_short_to_judge() -> None:
    assert slope([0.0, 1.0, 2.0], [1.0, 2.0, 3.0]) is None
    assert slope(range(100), [5.0] * 100) == (0.0, 0.0)
    processes = {"camera": process_statistics(usage(0.0)), "recorder": process_statistics(usage(0.0)[:3])}
    latency = latency_statistics([])
    assert (processes["camera"]["too_short"], processes["recorder"]["grows"]) == ([], [])
    short = too_short(processes, latency)
    assert short == ["the recorder's memory", "the recorder's handles", "the recorder's threads", "the latency"]
    results = {"processes": processes, "latency": latency, **COUNTS, "too_short": short, "why": []}
    assert json.loads(json.dumps(results, allow_nan=False)) == results
    text = render(results)
    assert "nan" not in text
    assert "too short to judge" in text.splitlines()[2]
    assert "p50 too short to judge; p99 too short to judge" in text
    assert text.endswith(f"too short to judge: {', '.join(short)}")
    latency = latency_statistics([(one, 500 + 8 * one / 3600, 900.0) for one in map(float, range(SECONDS))])
    text = render(results | {"latency": latency, "why": ["growth of the camera's memory"]})
    assert "p50 502 us, +8.0 +- 0.0 us per hour" in text
    assert text.endswith("FAILED: growth of the camera's memory")


def test_latencies_are_those_of_the_controllers_timing_messages(stub: Any) -> None:
    times = CommandTimes(stub)
    stub.bus.publisher(TRUTH).put(wire.Truth(residual_rms_nm=9).SerializeToString())
    stub.bus.publisher(TIMING).put(wire.ControlTiming(frame_to_command_ns=[100_000, 300_000]).SerializeToString())
    assert times.drain() == {"frames": 2, "p50_us": 200.0, "p99_us": 298.0}
    assert times.drain() == {}


def test_a_loop_that_is_not_closed_or_not_recorded_at_the_end_fails(stub: Any) -> None:
    soak = run._Soak(stub)
    assert soak.results(60.0, 1.0, [])["why"] == []
    soak.mode = wire.LOOP_MODE_OPEN
    stub.health["recorder"] = wire.Health(recording=wire.Recording(failure="the disk is full"))
    not_closed = "the loop should be closed at the end, its mode is open"
    assert soak.results(60.0, 1.0, [])["why"] == ["the recording ended: the disk is full", not_closed]


def test_a_slow_loop_has_time_to_settle() -> None:
    """250 frames at 2 Hz take 125 s; a minute, enough for a fast loop, is added."""
    bench = Mock(config=load(None, {"camera.rate_hz": 2.0}))
    ChaosBench.await_settled(bench, 250)
    assert bench.wait.call_args.args[-1] == 185.0


def test_a_soak_closes_the_loop_whatever_the_start_mode(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    soak_loop = Mock(return_value={"passed": True, "interrupted": False})
    monkeypatch.setattr("lowfc.programs.reliability.soak.run.soak_loop", soak_loop)
    monkeypatch.setattr("lowfc.programs.reliability.soak.evaluation.render", lambda _: "passed")
    file = tmp_path / "open.toml"
    file.write_text('[control]\nstart_mode = "open"\n')
    done = lowfc("soak", "--hours", "0.01", "--config", file)
    assert done.exit_code == 0, done.output
    assert soak_loop.call_args.args[0].control.start_mode == "closed"


def test_an_interrupted_soak_returns_its_results_so_far(stub: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    stub.begin, stub.end = Mock(), Mock()
    monkeypatch.setattr(run, "ChaosBench", lambda *_: stub)
    monkeypatch.setattr(run, "SAMPLE_S", 0.01)
    found = run.soak_loop(load(None), 3600.0, lambda _: signal.raise_signal(signal.SIGINT))
    assert found["interrupted"]
    assert found["hours"] < 0.01
    stub.end.assert_called_once()


def log(folder: Path, name: str, numbers_by_key: dict[str, list[int]], selection: Selection = EVERYTHING) -> None:
    writer = LogWriter(folder / f"{name}.mcap", 0, selection.metadata)
    for key, numbers in numbers_by_key.items():
        for number in numbers:
            writer.write(Sample(key, b"", sequence_of(START_S, number), number, number))
    writer.finish({})


def test_missing_messages_are_counted_within_logs_and_between_them(tmp_path: Path) -> None:
    checker = LogChecker(tmp_path)
    log(tmp_path, "1", {STEP.key: [0, 1, 3], TRUTH.key: [5, 6]})
    checker.check()
    assert (checker.logs, checker.messages, checker.gaps) == (1, 5, 1)
    assert list(tmp_path.iterdir()) == []
    log(tmp_path, "2", {STEP.key: [4, 5], TRUTH.key: [9]})
    checker.check()
    assert (checker.logs, checker.messages, checker.gaps) == (2, 8, 3)
    log(tmp_path, "3", {FRAME.key: [10, 20]}, Selection(10))  # recorder.every = 10
    checker.check()
    assert (checker.messages, checker.gaps) == (10, 3)


def test_a_soak_finds_the_process_whose_memory_grows(monkeypatch: pytest.MonkeyPatch) -> None:
    """The loop, with the toy sensor, runs in simulated time and loses no message."""

    def new_bench(*arguments: Any) -> ToyBench:
        toy_bench = ToyBench(*arguments)
        toy_bench.replace_time(run, monkeypatch.setattr)
        return toy_bench

    samples = Counter[int]()

    def process(pid: int) -> Any:
        samples[pid] += 1
        memory = SimpleNamespace(rss=10**8 + (pid == CAMERA_PID) * 10**6 * samples[pid])
        return SimpleNamespace(memory_info=lambda: memory, num_fds=lambda: 20, num_threads=lambda: 5)

    monkeypatch.setattr(run, "ChaosBench", new_bench)
    monkeypatch.setattr(run, "psutil", SimpleNamespace(Error=psutil.Error, Process=process))
    elapsed_s: list[float] = []
    config = load(None, FIXED_GAINS | TOY_KEYS | {"control.start_mode": "closed", "camera.rate_hz": 10.0})
    found = run.soak_loop(config, 33.0, elapsed_s.append)
    assert elapsed_s == pytest.approx(list(range(33)), abs=0.2)
    assert found["frames_published"] >= 33 * 10
    assert (found["logs"], found["gaps"], found["frames_missing"], found["messages_lost"]) == (1, 0, 0, 0)
    assert found["processes"]["controller"]["memory_last_mb"] == 100
    assert found["why"] == ["growth of the camera's memory"]
    assert not found["passed"]
