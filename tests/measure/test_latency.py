"""Latencies of synthetic frames, of a real loop and of its log; comparison of two results; cost of recording."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Mapping
from mmap import mmap
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lowfc.adapters.bus.run import runtime_base
from lowfc.adapters.process.clock import HostClock
from lowfc.adapters.process.host import Counters, Counts, busiest_thread
from lowfc.contract.configuration import load
from lowfc.contract.errors import ConfigurationError, DataFileError
from lowfc.contract.messages import RawImage, image
from lowfc.programs.measure.bench import record as bench_module
from lowfc.programs.measure.bench.record import render
from lowfc.programs.measure.control_step import ControlStep, time_alone
from lowfc.programs.measure.frame_source import Payloads, prepared_frames
from lowfc.programs.measure.latency.frame_statistics import (
    LOOP_SPANS,
    SPANS,
    STAGES,
    WARM_UP_S,
    FrameOutcomes,
    edges_us,
    frame_outcomes,
    histogram,
    percentiles,
    repeat_statistics,
)
from lowfc.programs.measure.latency.stalls import CountChanges, Trace, signs_of, stalls_of
from lowfc.programs.measure.latency.summary import combine, compare, kernel_summary, ratio
from lowfc.programs.measure.latency.text import compared, sparkline, table
from tests.support.loops import json_of, lowfc, refusal, until
from tools.law_bench import calibrated

START = 1_700_000_000 << 32  # sequence of the first frame
MS_NS = 1_000_000
RATE_HZ, SECONDS = 200, 0.5
HISTORY = Path(__file__).parents[2] / "benchmarks" / "history"


def frames(
    put_ns: Any = 1000,
    command_us: Any = 100.0,
    late_us: Any = 0.0,
    mirror_lost: tuple[int, ...] = (),
    *,
    scheduled: bool = True,
) -> FrameOutcomes:
    """Frames published at `put_ns` (an integer: their number, 1 ms apart), `late_us` after they were due.

    They are commanded after `command_us` (NaN: never) and applied 50 us later, except those in `mirror_lost`.
    """
    put_ns = np.arange(put_ns) * MS_NS if isinstance(put_ns, int) else put_ns
    sequence = START + np.arange(put_ns.size, dtype=np.uint64)
    command_ns = np.broadcast_to(np.asarray(command_us) * 1e3, put_ns.shape)
    timed = np.isfinite(command_ns)
    stages: dict[str, Any] = dict.fromkeys(("transport", *STAGES), np.full(timed.sum(), 40_000))
    stages["frame_to_command"] = command_ns[timed].astype(np.int64)
    applied = timed & ~np.isin(np.arange(put_ns.size), mirror_lost)
    mirror_ns = (put_ns[applied] + command_ns[applied] + 50_000).astype(np.int64)
    due_ns = put_ns - np.asarray(np.round(np.asarray(late_us) * 1e3), np.int64) if scheduled else None
    return frame_outcomes(sequence, put_ns, due_ns, (sequence[timed], stages), (sequence[applied], mirror_ns))


def test_percentiles_are_measured_values() -> None:
    found = percentiles(np.random.default_rng(1).permutation(np.arange(1.0, 1001.0)))
    assert found == {"p50": 500, "p90": 900, "p99": 990, "p99_9": 999, "max": 1000}
    assert percentiles(np.array([np.nan, 3.0])) == dict.fromkeys(("p50", "p90", "p99", "p99_9", "max"), 3.0)
    assert percentiles(np.array([np.nan])) is None


def test_timings_and_mirror_states_are_joined_to_their_frames() -> None:
    sequence = START + np.arange(4, dtype=np.uint64)
    timed = sequence[[0, 1, 3]]  # the third frame was skipped
    columns = {"transport": 10, "wakeup": 20, "compute": 30, "publish": 40, "frame_to_command": 100}
    stages = {stage: np.array([0, 1, 3]) + value for stage, value in columns.items()}
    states = sequence[[0, 0, 3]], np.array([1200, 9999, 4200])  # two states of the first frame, none of the second
    put_ns = np.array([1000, 2000, 3000, 4000])
    found = frame_outcomes(sequence, put_ns, put_ns - [5, 5, 5, 705], (timed, stages), states)
    assert found.commanded.tolist() == [True, True, False, True]
    expected_ns = {
        "frame_to_receive": [10, 11, np.nan, 13],
        "receive_to_command": [90, 90, np.nan, 90],
        "frame_to_command": [100, 101, np.nan, 103],
        "compute": [30, 31, np.nan, 33],
        "command_to_mirror": [100, np.nan, np.nan, 97],
        "frame_to_mirror": [200, np.nan, np.nan, 200],
        "due_to_frame": [5, 5, 5, 705],
        "due_to_command": [105, 106, np.nan, 808],
        "due_to_mirror": [205, np.nan, np.nan, 905],
    }
    assert list(found.spans_us) == list(SPANS)
    for span, values_ns in expected_ns.items():
        np.testing.assert_allclose(found.spans_us[span] * 1e3, values_ns)
    assert "due_to_command" not in frames(3, scheduled=False).spans_us


def test_statistics_leave_the_warm_up_out_and_count_missing_commands_and_states() -> None:
    command_us = np.full(1000, 100.0)
    command_us[:500] = 9000  # warm-up
    command_us[700] = np.nan
    command_us[900] = 400
    found = repeat_statistics(frames(command_us=command_us, mirror_lost=(800,)))
    assert (found["frames"], found["warm_up_frames"]) == (500, 500)
    assert (found["frames_without_command"], found["frames_untimed"], found["frames_without_mirror_state"]) == (1, 0, 2)
    assert (found["frames_crowded_out"], found["frames_sent_late"]) == (0, 0)
    assert found["rate_hz"] == pytest.approx(1000)
    assert found["latency_us"]["frame_to_command"] == {"p50": 100, "p90": 100, "p99": 100, "p99_9": 400, "max": 400}
    assert sum(found["histogram"]["frame_to_command"]) == 499
    assert max(found["over_time"]["max_us"]) == 400
    assert found["over_time"]["seconds"][0] == 0


def test_frames_without_command_are_counted_as_crowded_out_only_in_a_burst() -> None:
    put_ns = np.arange(1000) * MS_NS
    due_ns = put_ns.copy()
    put_ns[800] = put_ns[802] - 2000  # two frames of a stalled source, late, just before the next one
    put_ns[801] = put_ns[802] - 1000
    command_us = np.full(1000, 100.0)
    command_us[[600, 800, 801]] = np.nan
    nothing = repeat_statistics(frames(0))
    assert (nothing["frames"], nothing["latency_us"]) == (0, {})
    assert repeat_statistics(frames(1, scheduled=False))["frames_sent_late"] is None
    found = repeat_statistics(frames(put_ns, command_us, (put_ns - due_ns) / 1e3))
    assert (found["frames_without_command"], found["frames_crowded_out"]) == (3, 2)
    assert found["frames_sent_late"] == 1  # frame 800, by 2 ms; frame 801 is late by less than a period
    put_ns[900:] += 3600 * 10**9  # the camera waited for its trigger for an hour
    found = repeat_statistics(frames(put_ns, command_us))
    assert (found["frames_crowded_out"], found["rate_hz"]) == (2, pytest.approx(1000, abs=5))


def test_a_histogram_counts_values_beyond_its_edges_in_the_outermost_bins() -> None:
    counts = histogram(np.array([0.1, 1.0, 100.0, 101.0, 1e9, np.nan]))
    assert counts.sum() == 5
    assert counts[0] == 2  # 1.0, and 0.1 below the edge
    assert counts[-1] == 1
    bin_of_100 = int(np.searchsorted(edges_us(), 100.0, side="right")) - 1
    assert counts[bin_of_100] == 2
    assert sparkline([0, 1, 0, 1000, 0]) == " ▁ █"
    assert len(sparkline([1] * 160)) == 32


def repeat(command_us: float, echo_us: float = 100, **changes: Any) -> dict[str, Any]:
    """Results of a repeat in which every frame has the same latencies."""
    names = ("p50", "p90", "p99", "p99_9", "max")
    results = repeat_statistics(frames(command_us=float(command_us)))
    alone_us = {"echo_us": echo_us, "step_us": 50.0, "hot_step_us": 25.0, "timer_us": 5.0}
    alone = {name: dict.fromkeys(names, us) for name, us in alone_us.items()}
    counts = {"echo_lost": 1, "frames_skipped": 2, "frames_missing": 0, "reasons": {"LATE": 1}}
    return results | alone | counts | changes


def test_repeats_are_combined_as_medians_with_their_range() -> None:
    found = combine([repeat(100), repeat(300), repeat(110, echo_us=20)])
    command = found["latency_us"]["frame_to_command"]
    assert (command["p50"], command["max"]) == (110, 300)
    assert found["spread_us"]["frame_to_command"]["p99"] == [100, 300]
    assert found["echo_us"]["round_trip"]["p50"] == 100
    assert found["ratio"]["p50"] == pytest.approx(110 / 60)  # the median of 100/100, 300/100 and 110/60
    assert found["ratio_spread"]["p99"] == [1.0, 3.0]
    assert found["ratio_hot"]["p50"] == pytest.approx(110 / 35)
    assert (found["frames"], found["frames_skipped"], found["echo_lost"]) == (1500, 6, 3)
    assert found["reasons"] == {"LATE": 3}
    assert sum(found["histogram"]["counts"]["frame_to_command"]) == 1500
    assert len(found["histogram"]["edges_us"]) == len(found["histogram"]["counts"]["frame_to_command"]) + 1
    assert ratio(repeat(300), "p99", "ratio_hot") == 4


def trace(
    wakings: int = 1000, late_us: Mapping[int, float] | None = None, steps: Mapping[str, tuple[int, int]] | None = None
) -> Trace:
    """Trace of a bare loop with frames 1 ms apart.

    `late_us`: lateness of some wakings, by index; `steps`: the waking at which a count rises, and by how much.
    """
    due_ns = np.arange(wakings) * MS_NS + MS_NS // 2
    woke_ns = due_ns + 20_000
    for index, late in (late_us or {}).items():
        woke_ns[index] = due_ns[index] + round(late * 1e3)
    counts = {name: np.zeros(wakings, np.int64) for name in Trace._fields[2:]}
    for name, (index, by) in (steps or {}).items():
        counts[name][index:] += by
    return Trace(due_ns, np.maximum.accumulate(woke_ns), **counts)


def test_a_trace_has_the_counters_of_the_kernel_and_page_faults_are_counted() -> None:
    assert Trace._fields == ("due_ns", "woke_ns", *Counts._fields)
    own = os.getpid()
    counters = Counters(own, busiest_thread(own, 0.01), {0})
    before = counters.read()
    with mmap(-1, 1 << 25) as fresh:  # new pages: memory from the allocator may be mapped already
        fresh[::4096] = bytes(1 << 13)
    after = counters.read()
    assert after.minor_faults > before.minor_faults > 0
    assert all(later >= earlier for later, earlier in zip(after, before, strict=True))
    with pytest.raises(FileNotFoundError):
        Counters(own, 0, set())


def test_the_stolen_time_of_the_last_of_many_processors_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stat = tmp_path / "stat"
    stat.write_text("".join(f"cpu{number} {'1000000000 ' * 7}{number} 0 0\n" for number in range(512)))
    monkeypatch.setattr("lowfc.adapters.process.host._STAT", stat)
    stolen_ns = Counters(os.getpid(), os.getpid(), {511}).read().stolen_ns
    assert stolen_ns == 511 * 1_000_000_000 // os.sysconf("SC_CLK_TCK")


def test_evidence_of_a_stall_is_divided_into_evidence_for_the_host_and_for_the_loop() -> None:
    nothing: Any = dict.fromkeys(CountChanges.model_fields, 0)
    cases: list[tuple[dict[str, float], tuple[list[str], list[str]]]] = [
        ({"bare_late_us": 250}, (["bare loop 250 us late"], [])),
        ({"bare_late_us": 249, "waited_us": 249, "minor_faults": 249, "preempted": 9}, ([], [])),
        ({"stolen_ms": 10}, (["10 ms stolen"], [])),
        ({"throttled": 1}, (["quota used up"], [])),
        ({"waited_us": 800, "stolen_ms": 10}, (["10 ms stolen"], ["waited 800 us for the processor"])),
        ({"major_faults": 1, "minor_faults": 600}, ([], ["1 pages read", "600 pages mapped"])),
    ]
    for counted, expected in cases:
        assert signs_of(CountChanges(**nothing | counted), 1000) == expected


def test_the_cause_of_a_stall_is_found_from_the_counts_during_it() -> None:
    command_us = np.full(1000, 100.0)
    command_us[100] = 5000  # warm-up
    command_us[600], command_us[601] = 3000, np.nan  # frame 601 is superseded while the host stalls
    command_us[[700, 800, 900, 950]] = 1500, 2000, 1200, 1100
    late_us = np.zeros(1000)
    late_us[900] = 800  # this stall begins when the frame is due, 0.8 ms before it is published
    steps = {"stolen_ns": (701, 10 * MS_NS), "waited_ns": (801, 1_200_000), "major_faults": (899, 3)}
    traces = {"camera": trace(late_us={600: 2200}), "controller": trace(steps=steps)}
    found = stalls_of(frames(command_us=command_us, late_us=late_us), MS_NS, traces)
    assert [(stall.second, stall.held_up_by, stall.signs) for stall in found.stalls] == [
        (0.6, "host", "camera: bare loop 2200 us late"),
        (0.601, "host", "camera: bare loop 2200 us late"),
        (0.7, "host", "controller: 10 ms stolen"),
        (0.8, "loop", "controller: waited 1200 us for the processor"),
        (0.9, "loop", "controller: 3 pages read"),
        (0.95, "unknown", "none"),
    ]
    assert [stall.frame_to_command_us for stall in found.stalls] == [3000, None, 1500, 2000, 1200, 1100]
    assert (found.frames, found.stalled, found.of_host, found.of_loop, found.unknown) == (500, 6, 3, 2, 1)
    assert [(bare.beside, bare.wakings, bare.stalled) for bare in found.bare] == [
        ("camera", 1000, 2),  # the next waking was late, too
        ("controller", 1000, 0),
    ]
    both = combine([repeat(100, stalls=found), repeat(100, stalls=found)])["stalls"]
    assert (both["stalled"], len(both["stalls"]), both["bare"][0]["stalled"]) == (12, 12, 4)
    quiet = stalls_of(frames(), MS_NS, {"camera": trace(0)})
    assert (quiet.stalled, quiet.bare[0].late_us) == (0, None)


def test_the_ratio_of_two_kernels_is_the_median_over_their_pairs() -> None:
    pairs = [("numpy", 100), ("fused", 80), ("fused", 60), ("numpy", 120), ("numpy", 100), ("fused", 70)]
    found = kernel_summary([repeat(us, kernel=name) for name, us in pairs])
    assert (found["kernel"], found["frames"]) == ("both", 1500)
    assert found["latency_us"]["frame_to_command"]["p50"] == 70
    assert found["kernel_ratio"]["p99"] == pytest.approx(0.7)
    assert found["kernel_ratio_spread"]["p50"] == [0.5, 0.8]
    assert found["numpy_us"]["p50"] == 100
    alone = kernel_summary([repeat(us, kernel="fused") for us in (1, 2)])
    assert (alone["kernel"], "kernel_ratio" in alone) == ("fused", False)


def test_a_difference_is_compared_with_the_spread() -> None:
    before, after = combine([repeat(100), repeat(130)]), combine([repeat(120), repeat(140)])
    rows = {(row["name"], row["at"]): row for row in compare(before, after)["rows"]}
    command = rows["frame_to_command", "p50"]
    assert (command["a"], command["b"], command["difference"], command["spread"]) == (115, 130, 15, 30)
    assert (command["better"], command["beyond_spread"]) == ("a", False)
    assert command["ratio"] == pytest.approx(130 / 115)
    far = {(row["name"], row["at"]): row for row in compare(before, combine([repeat(10), repeat(11)]))["rows"]}
    assert far["frame_to_command", "p99"]["better"] == "b"
    assert far["frame_to_command", "p99"]["beyond_spread"] is True
    assert far["over_echo_and_step", "p50"]["b"] == pytest.approx(0.105)
    assert far["frame_to_receive", "p50"]["better"] == "same"
    single = compare(before, combine([repeat(10)]))["rows"]
    assert {row["spread"] for row in single} == {None}
    assert "within the spread" in compared({"a": "a.json", "b": "b.json"} | compare(before, after))
    for values in (before["latency_us"], before["spread_us"]):
        values["span_of_a_later_release"] = values["frame_to_command"]
    assert "span_of_a_later_release" in compared({"a": "a.json", "b": "b.json"} | compare(before, before))


def test_the_results_of_every_release_can_be_compared_with_present_ones() -> None:
    today = combine([repeat(100), repeat(130)])
    files = list(HISTORY.glob("*.json"))
    assert files
    for file in files:
        found = compare(json.loads(file.read_text()), today)
        compared_at = {(row["name"], row["at"]) for row in found["rows"]}
        assert compared_at >= {("frame_to_mirror", "p99"), ("over_echo_and_step", "p50")}
        assert found["counts"]["frames"][1] == today["frames"]
        assert "skipped by the controller: a 0, b 4" in compared({"a": "a.json", "b": "b.json"} | found)


@pytest.mark.exclusive
def test_the_step_alone_uses_every_prepared_frame() -> None:
    config = load(None, {"control.start_mode": "closed", "control.tilt_leak": 0.01, "control.leak": 0.01})
    calibration = calibrated(config)
    pixels = prepared_frames(config)
    assert len({frame.tobytes() for frame in pixels}) == len(pixels)
    payloads = Payloads(pixels)
    payload = payloads.at(len(pixels) + 1, 123)
    assert RawImage.FromString(payload) == image(pixels[1], 123, "lowfc_camera")
    clock = HostClock()
    step = ControlStep(config, calibration, clock.host_ns())
    timer_ns, paced_ns = time_alone(step, payloads, clock, 0.1, MS_NS)
    no_timer_ns, hot_ns = time_alone(step, payloads, clock, 0.05, None)
    assert 0 < timer_ns.size == paced_ns.size <= 101
    assert no_timer_ns.size == 0
    assert timer_ns.min() >= 0
    assert step.state.frames_used == paced_ns.size + hot_ns.size  # none was refused
    assert not step.state.counts


def runs() -> set[Path]:
    """Directories of all runs, including those of other tests."""
    return {path for path in runtime_base().iterdir() if path.is_dir()}


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Path]:
    folder = tmp_path_factory.mktemp("latency")
    (folder / "loop.toml").write_text(f'[recorder]\nfolder = "{folder}"\nmin_free_mb = 0\n')
    before = runs()
    options = f"--duration {SECONDS} --rate {RATE_HZ} --trace --record --json".split()
    done = lowfc("latency", *options, "--config", folder / "loop.toml", "--plot", folder / "latency.png")
    assert done.exit_code == 0, (done.output, done.exception)
    assert runs() == before
    (folder / "a.json").write_text(done.stdout)
    return json.loads(done.stdout), folder


@pytest.mark.exclusive
def test_every_frame_of_a_real_loop_is_counted(measured: tuple[dict[str, Any], Path]) -> None:
    results, folder = measured
    text = table(results)
    for label in ("frame to command", "due to command", "half a bare echo", "timer wake-up", "without a command"):
        assert label in text
    assert (folder / "latency.png").read_bytes().startswith(b"\x89PNG")
    sent = round(RATE_HZ * (SECONDS + WARM_UP_S))
    assert results["frames"] + results["warm_up_frames"] == sent
    assert results["frames_untimed"] == results["frames_missing"] == 0
    counted = sum(results["histogram"]["counts"]["frame_to_command"])
    assert counted == results["frames"] - results["frames_without_command"] > 0.5 * results["frames"]
    assert set(results["latency_us"]) >= set(LOOP_SPANS)
    for span in (*LOOP_SPANS[:3], "due_to_command", "frame_to_mirror"):
        values = results["latency_us"][span]
        assert 0 < values["p50"] <= values["p90"] <= values["p99"] <= values["p99_9"] <= values["max"]
    assert results["latency_us"]["due_to_command"]["p50"] > results["latency_us"]["frame_to_command"]["p50"]
    for alone in (results["echo_us"]["round_trip"], results["step_us"], results["hot_step_us"], results["timer_us"]):
        assert 0 < alone["p50"] <= alone["max"]
    reference_us = results["echo_us"]["round_trip"]["p50"] / 2 + results["step_us"]["p50"]
    assert results["ratio"]["p50"] == pytest.approx(results["latency_us"]["frame_to_command"]["p50"] / reference_us)
    assert results["settings"]["rate_hz"] == RATE_HZ
    assert results["host"]["kernel"]
    assert results["host"]["clock_source"]
    assert any("garbage collector off" in measure for measure in results["host"]["granted"])


@pytest.mark.exclusive
def test_stalls_of_a_real_loop_are_traced_beside_bare_loops(measured: tuple[dict[str, Any], Path]) -> None:
    results, _ = measured
    found = results["stalls"]
    assert found["frames"] == results["frames"]
    assert results["frames_without_command"] <= found["stalled"] == len(found["stalls"])
    assert found["stalled"] == found["of_host"] + found["of_loop"] + found["unknown"]
    assert [loop["beside"] for loop in found["bare"]] == ["camera", "controller"]
    for loop in found["bare"]:
        assert 0.5 * found["frames"] < loop["wakings"] <= RATE_HZ * (SECONDS + WARM_UP_S)
        assert 0 < loop["late_us"]["p50"] <= loop["late_us"]["max"]
    assert "bare loop beside the" in table(results)
    assert refusal("latency", "--trace", "--camera", "simulated", kind=ConfigurationError)


@pytest.mark.exclusive
def test_the_log_of_the_run_gives_the_same_latencies(measured: tuple[dict[str, Any], Path]) -> None:
    live, folder = measured
    assert live["messages_lost"] == 0
    logged = json_of("latency", live["logs"][0])
    assert (logged["frames"], logged["warm_up_frames"]) == (live["frames"], live["warm_up_frames"])
    assert logged["frames_without_command"] == live["frames_without_command"]
    assert logged["frames_skipped"] == live["frames_skipped"]
    for span in LOOP_SPANS:
        assert logged["latency_us"][span] == live["latency_us"][span]
    assert "due_to_command" not in logged["latency_us"]
    assert logged["host"]["processor"] == live["host"]["processor"]
    rows = json_of("latency", "--compare", folder / "a.json", folder / "a.json")["rows"]
    assert {row["better"] for row in rows} == {"same"}
    (folder / "log.json").write_text(json.dumps(logged))
    done = lowfc("latency", "--compare", folder / "a.json", folder / "log.json")
    assert done.exit_code == 0, done.output
    assert "frame to mirror" in done.stdout


def test_files_that_are_no_results_or_logs_are_errors(tmp_path: Path) -> None:
    other = tmp_path / "other.json"
    listed = '{"latency_us": [1], "ratio": null, "repeats": []}'
    ranges = {"x": {at: [1, 2, 3] for at in ("p50", "p99", "p99_9")}}
    ranged = json.dumps({"latency_us": ranges, "spread_us": ranges, "ratio": None, "repeats": [1, 2]})
    for content, expected in (
        ("{", "not JSON"),
        ("[]", "no latency_us"),
        ("[" * 100_000, "not JSON"),
        ('{"latency_us": {}}', "ratio"),
        (listed, "at least one is not"),
        (ranged, "at least one is not"),
    ):
        other.write_text(content)
        assert expected in refusal("latency", "--compare", other, other, kind=DataFileError)
    assert isinstance(lowfc("latency", tmp_path / "none.mcap").exception, DataFileError)
    assert "not a regular file" in refusal("latency", "--plot", tmp_path)  # before it measures


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--compare", "a.json", "b.json", "--plot", "c.png"), "--plot has no effect with --compare: omit it"),
        (("--compare", "a.json", "b.json", "log.mcap"), "logs has no effect with --compare"),
        (("log.mcap", "--trace"), "--trace has no effect with logs"),
        (("log.mcap", "--duration", "10", "--json"), "--duration has no effect with logs"),
    ],
)
def test_options_without_effect_are_refused(arguments: tuple[str, ...], message: str) -> None:
    assert message in refusal("latency", *arguments, kind=ConfigurationError)


LATENCY_PROGRAM = (
    "from lowfc.adapters.process.terminal import *; from lowfc.programs.measure.latency.command import latency; "
    "app = new_app(''); app.command()(latency); run_app(app)"
)


def child(launcher: int, program: str) -> int:
    """Process id of the launcher's child that runs this program; 0 for none."""
    for pid in map(int, Path(f"/proc/{launcher}/task/{launcher}/children").read_text().split()):
        if f"-m {program} " in Path(f"/proc/{pid}/cmdline").read_text().replace("\0", " "):
            return pid
    return 0


@pytest.mark.exclusive
@pytest.mark.slow
@pytest.mark.parametrize(
    ("victim", "number", "status", "error"),
    [
        ("", signal.SIGINT, 130, "interrupted"),
        ("lowfc controller", signal.SIGKILL, 1, "controller was killed by SIGKILL"),
        ("lowfc.programs.measure.frame_source", signal.SIGKILL, 1, "camera was killed by SIGKILL"),
        ("lowfc.programs.measure.echo answer", signal.SIGKILL, 1, "echo (answer) was killed by SIGKILL"),
    ],
)
def test_an_interrupted_or_failed_measurement_removes_its_run(
    victim: str, number: int, status: int, error: str
) -> None:
    seconds, before = "2" if "echo" in victim else "30", runs()
    command = [sys.executable, "-c", LATENCY_PROGRAM, "--duration", seconds, "--rate", "100"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        until(lambda: child(process.pid, victim or "lowfc controller"))
        os.kill(child(process.pid, victim) if victim else process.pid, number)
        _, stderr = process.communicate(timeout=30)
    assert process.returncode == status
    assert stderr.strip().splitlines()[-1].removeprefix("error: ").startswith(error)
    assert runs() == before


def test_every_log_of_a_measured_recording_is_removed_and_its_size_counted(tmp_path: Path) -> None:
    logs = [tmp_path / "1.mcap", tmp_path / "2.mcap"]
    for log in logs:
        log.write_bytes(b"1234")
    assert bench_module._remove(logs) == 8
    assert list(tmp_path.iterdir()) == []


@pytest.mark.exclusive
def test_the_cost_of_recording_is_measured_at_every_rate(tmp_path: Path) -> None:
    rates_hz = (100, 200)
    rates = [word for rate in rates_hz for word in ("--rate", str(rate))]
    results = json_of("bench", "record", "--seconds", "0.5", *rates, "--folder", tmp_path)
    assert list(tmp_path.iterdir()) == []
    assert [rate["rate_hz"] for rate in results["rates"]] == list(rates_hz)
    for rate in results["rates"]:
        count = rate["rate_hz"] * (bench_module._WARM_UP_S + 0.5)
        assert rate["messages_lost"] == 0
        assert min(rate["messages_published"], rate["messages_recorded"]) >= 5 * count
        assert rate["log_bytes"] > 0.5 * count * results["payload_bytes_per_frame"]
        copying = results["copy_us_per_frame"] * rate["offered_hz"] / 1e6
        assert 0 < rate["ratio"] == pytest.approx(rate["cpu_share"] / copying)
        assert rate["longest_unflushed_ms"] >= rate["longest_wait_ms"] > 0
        assert rate["longest_write_ms"] > 0
    assert results["payload_bytes_per_frame"] > 80 * 80 * 2 + 2 * 34 * 34 * 4
    title, *lines, note = render(results).splitlines()
    assert "processor" in title
    assert "kill -9" in note
    assert [line.split()[1] for line in lines] == ["Hz"] * len(rates_hz)
