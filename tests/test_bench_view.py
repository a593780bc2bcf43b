"""What a view costs is measured on a real loop beside a real view, and said with its spread."""

import json
import subprocess
import sys
from collections.abc import Callable
from itertools import islice

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from lowfc.adapters.log_reader import Logged
from lowfc.contract.messages import HEALTH, STEP, TIMING, TRUTH, Message, Topic, timestamp, wire
from lowfc.programs.bench import view_loop as bench_view_loop
from lowfc.programs.bench.view import bench_view, cost, isolation, render
from lowfc.programs.bench.view_hour import Tape, growth, render_hour
from lowfc.programs.bench.view_loop import Cost, Losses, Phase, Reading

RATE_HZ, SECONDS = 200, 0.4
PHASES = ["off", "starting", "on", "hung", "viewer hung", "killed"]
HOUR = """
import json
from lowfc.programs.bench.view_hour import measure_hour
print(json.dumps(measure_hour(1000, 120)))
"""
START_NS, PERIOD_NS, SEQUENCE = 1_800_000_000_000_000_000, 4_000_000, 7 << 32


@pytest.fixture(scope="module")
def figures() -> dict[str, object]:
    app = typer.Typer()
    app.command()(bench_view)
    with pytest.MonkeyPatch.context() as patch:
        for pause in ("SETTLE_S", "HEALTH_S"):
            patch.setattr(bench_view_loop, pause, 0.05)
        words = ["--rate", str(RATE_HZ), "--seconds", str(SECONDS), "--repeats", "1", "--json"]
        done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    assert len(done.stdout.splitlines()) == 1
    return json.loads(done.stdout)


@pytest.mark.slow
def test_every_phase_is_measured_in_one_run(figures: dict[str, object]) -> None:
    assert list(figures["phases"]) == PHASES
    for phase in figures["phases"].values():
        assert 0 < phase["frames"] <= RATE_HZ * (SECONDS + 1)
        assert phase["p99_us"]["median"] >= phase["p50_us"]["median"] > 0
        assert min(phase["frames_skipped"], phase["frames_missing"], phase["messages_lost"]) >= 0
    run = figures["run"]
    assert run["frames_published"] >= sum(phase["frames"] for phase in figures["phases"].values())
    assert run["messages_recorded"] > 4 * run["frames_published"]
    assert run["realtime_granted"]


@pytest.mark.slow
def test_the_view_that_works_is_a_real_one(figures: dict[str, object]) -> None:
    for view in (figures["view"], figures["view_alone"]):
        assert view["bridge_cpu_percent"] > 0
        assert view["viewer_cpu_percent"] >= 0
        assert view["bridge_mb"] > 50
        assert view["viewer_mb"] > 10
    assert figures["view_alone"]["moments_hz"] > 1


@pytest.mark.slow
def test_a_person_reads_one_line_for_each_phase(figures: dict[str, object]) -> None:
    title, *lines = render(figures).splitlines()
    assert "p99" in title
    *phases, spread, beside, alone, renewals = lines
    assert [line[:12].strip() for line in phases] == PHASES
    assert "not known" in spread
    assert "of a processor" in beside
    assert "of a processor" in alone
    assert renewals == "the view began anew 0 times"


def reading(phase: Phase, p50_us: float, **losses: int) -> Reading:
    """200 frames, of which the slowest four took twice as long."""
    frames_us = np.where(np.arange(200) < 196, p50_us, 2 * p50_us)
    beside = Cost(0.1 * p50_us / 100, 0.01, 200_000_000, 50_000_000, 30.0) if phase is Phase.ON else None
    return Reading(
        phase, (frames_us * 1000).astype(np.int64), Losses(**{"skipped": 0, "missing": 0, "lost": 0, **losses}), beside
    )


def test_a_difference_stands_beside_the_spread() -> None:
    readings = [
        *(reading(Phase.OFF, p50_us) for p50_us in (100.0, 104.0, 102.0)),
        *(reading(Phase.ON, p50_us, skipped=1, lost=2) for p50_us in (103.0, 90.0, 110.0)),
        *(reading(Phase.KILLED, p50_us) for p50_us in (107.0, 107.0, 106.0)),
    ]
    found = isolation(readings)
    assert found["spread_us"] == {"p50": pytest.approx(4.0), "p99": pytest.approx(8.0)}
    off, on, killed = (found["phases"][phase] for phase in ("off", "on", "killed"))
    assert off["p50_us"]["difference"] == 0
    assert off["p50_us"]["within_spread"] is None
    assert on["p50_us"] == {
        "median": pytest.approx(103.0),
        "lowest": pytest.approx(90.0),
        "highest": pytest.approx(110.0),
        "difference": pytest.approx(1.0),
        "ratio": pytest.approx(103 / 102),
        "within_spread": True,
    }
    assert on["p99_us"]["median"] == pytest.approx(206.0)
    assert (on["frames"], on["frames_skipped"], on["messages_lost"]) == (600, 3, 6)
    assert killed["p50_us"]["within_spread"] is False
    assert killed["p99_us"]["within_spread"] is False
    assert cost([one.cost for one in readings if one.cost is not None]) == {
        "bridge_cpu_percent": pytest.approx(10.3),
        "viewer_cpu_percent": pytest.approx(1.0),
        "bridge_mb": 200.0,
        "viewer_mb": 50.0,
        "moments_hz": 30.0,
    }


def test_one_run_alone_has_no_spread() -> None:
    found = isolation([reading(Phase.OFF, 100.0), reading(Phase.ON, 100.0)])
    assert found["spread_us"] == {"p50": None, "p99": None}
    assert found["phases"]["on"]["p50_us"]["within_spread"] is None


def tape(frames: int) -> Tape:
    """A log with a truth and a step of every frame, timings of every ten, and a Health from before and from between."""

    def logged(topic: Topic, frame: int, message: Message, later_ns: int) -> Logged:
        time_ns = START_NS + frame * PERIOD_NS + later_ns
        message.timestamp.CopyFrom(timestamp(time_ns))
        return Logged(topic.at("camera"), "", message.SerializeToString(), frame, time_ns, time_ns)

    log = [logged(HEALTH, -5, wire.Health(process="camera"), 0)]
    for frame in range(frames):
        sequence = SEQUENCE + frame
        log.append(logged(TRUTH, frame, wire.Truth(frame_sequence=sequence), 0))
        log.append(logged(STEP, frame, wire.ControlStep(frame_sequence=sequence), 1000))
        if frame % 10 == 0 and frame:
            ten = range(sequence - 10, sequence)
            log.append(logged(TIMING, frame, wire.ControlTiming(frame_sequence=ten), 2000))
    log.append(logged(HEALTH, 4, wire.Health(process="camera"), 3000))
    log.append(logged(HEALTH, frames + 5, wire.Health(process="camera", state="stopped"), 0))
    return Tape(sorted(log, key=lambda one: one.log_time_ns))


def test_times_and_sequences_go_on_over_the_seam() -> None:
    frames, laps = 31, 4
    played = tape(frames)
    (known,) = played.known
    assert known.topic is HEALTH
    # What came after the last truth, a step and a timing, is no part of a lap.
    messages = list(islice(played.play(), laps * (31 + 30 + 2 + 1)))
    assert np.all(np.diff([message.time_ns for message in messages]) > 0)

    def of(topic: Topic, read: Callable[[bytes], Message]) -> list[Message]:
        return [read(message.payload) for message in messages if message.topic is topic]

    truths = of(TRUTH, wire.Truth.FromString)
    assert [truth.frame_sequence for truth in truths] == [SEQUENCE + number for number in range(laps * frames)]
    assert [truth.timestamp.ToNanoseconds() for truth in truths] == [
        START_NS + number * PERIOD_NS for number in range(laps * frames)
    ]
    steps = [step.frame_sequence for step in of(STEP, wire.ControlStep.FromString)]
    assert np.all(np.diff(np.array(steps, np.int64)) >= 1)
    assert len(steps) == laps * (frames - 1)
    timed = [one for timing in of(TIMING, wire.ControlTiming.FromString) for one in timing.frame_sequence]
    assert np.all(np.diff(np.array(timed, np.int64)) >= 1)
    healths = of(HEALTH, wire.Health.FromString)
    assert np.diff([health.timestamp.ToNanoseconds() for health in healths]).tolist() == [frames * PERIOD_NS] * 3
    assert {health.state for health in healths} == {""}


def test_growth_is_that_of_the_second_half() -> None:
    times_s = np.arange(0.0, 3600.0, 60.0)
    memory = 100e6 + np.minimum(times_s, 1500.0) * 1e5 + times_s * 1e6 / 3600
    found = growth(times_s.tolist(), [round(one) for one in memory])
    assert found["growth_mb_per_hour"] == pytest.approx(1.0, rel=1e-3)
    assert found["most_mb"] == pytest.approx(found["last_mb"])
    assert found["first_mb"] == 100.0


@pytest.mark.slow
def test_the_traffic_of_minutes_stays_within_the_bounds() -> None:
    words = [sys.executable, "-c", HOUR]  # alone in a process: the bridge is the process that measures
    figures = json.loads(subprocess.run(words, capture_output=True, text=True, check=True).stdout)
    assert figures["traffic_s"] >= 120
    assert figures["messages"] > 120 * 2000
    assert figures["failed_panels"] == 0
    for name in ("bridge", "viewer"):
        assert 10 < figures[name]["first_mb"] <= figures[name]["most_mb"] < figures[name]["bound_mb"]
    assert "bridge" in render_hour(figures)
