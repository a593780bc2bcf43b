"""Arithmetic of the benchmarks on synthetic results, and small real runs."""

import json
import subprocess
import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from benchmarks import curves, kernels, load, runner, step, streams, throughput
from benchmarks.peers import comparison, implementations
from benchmarks.peers.implementations import FUSED, IMPLEMENTATIONS
from benchmarks.peers.shared import ACTUATORS, TIME_STAMPS, NumpyStep, RunData
from benchmarks.sizes import Size, configuration, random_calibration
from lowfc.contract.errors import ConfigurationError
from lowfc.contract.sections import Camera
from lowfc.control.kernel import stepping
from lowfc.programs.measure.control_step import ControlStep
from lowfc.programs.measure.frame_source import Payloads

ROOT = Path(__file__).parents[2]
SMALL = Size(side=32, modes=5, mirror_side=10)


def by_heading(lines: runner.Lines) -> list[dict[str, str]]:
    """Each line as a dictionary by heading, last column first; of columns with the same heading, the first is kept."""
    assert len({len(line) for line in lines}) == 1
    return [dict(reversed(list(zip(lines[0], line, strict=True)))) for line in lines[1:]]


@pytest.mark.parametrize("arguments", ["--seconds 0", "--seconds nan", "--repeats 0"])
def test_a_measurement_without_duration_or_repeats_is_refused(
    capsys: pytest.CaptureFixture[str], arguments: str
) -> None:
    with pytest.raises(SystemExit):
        runner.run("kernels", kernels, arguments.split())
    assert "--seconds must be 0.01 to 100000, --repeats at least 1" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("benchmark", "arguments", "message"),
    [
        (curves, "--pixels 16 --modes 0", "at least one pixel and one mode"),
        (throughput, "--highest inf", "--highest, which is finite"),
        (comparison, "--warm-up -1", "--warm-up must be at least 0"),
        (comparison, "--rate nan", "camera.rate_hz"),
        (comparison, "--only nothing", "--only: none of"),
    ],
)
def test_impossible_options_are_refused(benchmark: runner.Benchmark, arguments: str, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        runner.run("one", benchmark, arguments.split())


# The control step


def test_a_step_keeps_no_memory_and_allocates_only_the_frame_and_shapes_of_the_mirror(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    config = configuration(SMALL, step.RATE_HZ)
    calibration, frames = random_calibration(SMALL, config)
    found = step.allocated(ControlStep(config, calibration, 0), Payloads(frames))
    assert abs(found["kept_bytes"]) < 1
    assert 2 * SMALL.pixels < found["peak_bytes"] < 2 * SMALL.pixels + 5 * 4 * SMALL.actuators + 4096
    leaking = Mock(wraps=stepping.integrate)  # keeps the arguments of every call
    monkeypatch.setattr(stepping, "integrate", leaking)
    assert step.allocated(ControlStep(config, calibration, 0), Payloads(frames))["kept_bytes"] > 100


def test_every_stage_of_a_step_has_a_duration_and_the_remainder_is_not_negative(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    no_measures = step.set_up(None, None, lock_memory=False, disable_cpu_idle=False)
    monkeypatch.setattr(step, "set_up", lambda *_, **__: no_measures)  # do not change this process
    original = stepping.limit
    found = step.measure(Namespace(seconds=0.2), lambda _: None)
    assert stepping.limit is original
    (lines,) = step.tables(found)
    assert [line[0] for line in lines[1:]] == [*step.STAGES, step.REMAINDER, step.STEP, step.PRODUCT]
    assert all(float(cell) >= 0 for line in lines[1:] for cell in line[1:])
    ratio = found["hot_us"][step.STEP]["p50"] / found["hot_us"][step.PRODUCT]["p50"]
    assert f"{ratio:.1f} times" in step.about(found)


# Cost curves


def test_a_random_calibration_has_the_stated_noise_and_number_of_bytes() -> None:
    size = Size(32, 7, 16)
    calibration, frames = random_calibration(size, configuration(SMALL, 100.0))
    pixels = frames.reshape(len(frames), -1).astype(float) - calibration.dark
    seen = pixels / pixels.sum(axis=1, keepdims=True) - calibration.reference
    assert 0.5 < np.sqrt(np.mean((seen @ calibration.reconstructor.T) ** 2)) < 2
    read = ("reconstructor", "reference", "dark", "good", "modes_to_actuators")
    assert size.bytes == sum(getattr(calibration, name).nbytes for name in read) + frames[0].nbytes


def test_a_step_that_refuses_frames_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    saturated = configuration(SMALL, 100.0).model_copy(update={"camera": Camera(full_well_e=500.0)})
    monkeypatch.setattr(curves, "configuration", lambda size, rate_hz: saturated)
    with pytest.raises(RuntimeError, match="SATURATED"):
        curves.step_times(SMALL, 0.01)


@pytest.mark.exclusive
@pytest.mark.slow
def test_a_loop_of_any_size_runs_without_an_optical_model() -> None:
    found = curves.loop_latency(Size(side=32, modes=40, mirror_side=16), 500.0, 0.5)
    assert found["frames"] > 200
    assert found["echo_us"]["p50"] > 0
    assert 0 < found["frame_to_command_us"]["p50"] <= found["frame_to_command_us"]["p99"]
    assert found["frame_to_command_us"]["cpu"] > 0
    assert found["frames_without_command"] < found["frames"]


def repeat(step_us: float, without_command: int = 0, failure: str = "") -> dict[str, Any]:
    alone = {"step_us": step_us, "stream_us": 10.0, "products_us": 15.0}
    results: dict[str, Any] = {name: {"p50": us, "p99": 2 * us, "cpu": us} for name, us in alone.items()}
    if failure:
        return results | {"failure": failure}
    results |= {"frame_to_command_us": {"p50": 200.0, "p99": 400.0}, "echo_us": {"p50": 50.0, "p99": 60.0}}
    return results | {"frames": 100, "frames_without_command": without_command}


def curves_result() -> dict[str, Any]:
    points = [
        curves.point(Size(side=32), [repeat(30.0), repeat(20.0, 2), repeat(25.0)]),
        curves.point(Size(side=48), [repeat(50.0, failure="the mirror ended")]),
    ]
    return {
        "curves": {"pixels": points, "modes": points[:1], "actuators": []},
        "default": {"side": 80, "modes": 20, "mirror_side": 34},
        "seconds": 1.0,
        "repeats": 3,
        "rate_hz": 250.0,
        "failed": ["48: the mirror ended"],
    }


def test_a_point_has_the_median_of_its_repeats_and_the_memory_limit() -> None:
    result = json.loads(json.dumps(curves_result()))
    pixels, modes = curves.tables(result)
    first, second = by_heading(pixels)
    assert first["pixels"] == "1024 (32 x 32)"
    assert modes[1][0] == "20"
    assert first["step p50, us"] == "25.0 (20.0 to 30.0)"
    assert first["step / memory limit"] == "2.5"
    assert first["read rate, GB/s"] == f"{Size(side=32).bytes / 10.0 / 1e3:.0f}"
    assert first["frames without a command"] == "2 of 300"
    assert second["loop p50, us"] == "failed"
    assert curves.picture(result).startswith(b"\x89PNG")
    assert "Failed, 48: the mirror ended." in curves.about(result)


def test_the_curves_of_a_few_sizes_are_measured_from_the_command_line() -> None:
    arguments = "--pixels 32 --modes 20 --actuators --no-loop --seconds 0.02 --repeats 2 --json"
    command = [sys.executable, "-m", "benchmarks", "curves", *arguments.split()]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert {name: [one["pixels"] for one in points] for name, points in found["curves"].items()} == {
        "pixels": [1024],
        "modes": [6400],
        "actuators": [],
    }
    for name in ("step_us", "stream_us", "products_us"):
        results = found["curves"]["pixels"][0][name]
        assert 0 < results["p50"] <= results["p99"]
        assert results["cpu"] > 0
    with pytest.raises(ConfigurationError, match="nothing to measure"):
        curves.measure(Namespace(pixels=[], modes=[], actuators=[]), lambda _: None)


# The highest rate


def test_a_grid_is_geometric_up_to_the_highest_rate() -> None:
    assert throughput.grid(500, 800, 1.1) == [500, 550, 605, 666, 732]
    assert throughput.grid(1000, 4000, 2) == [1000, 2000, 4000]
    assert throughput.grid(700, 700, 1.1) == [700]


@pytest.mark.parametrize("edge", range(-1, 32, 3))
@pytest.mark.parametrize("wrong", [None, 7, 15, 30])
def test_the_search_finds_the_highest_sustained_rate_despite_one_wrong_result(edge: int, wrong: int | None) -> None:
    tried: list[int] = []

    def sustains(index: int) -> bool:
        tried.append(index)
        mistaken = index == wrong and tried.count(index) == 1
        return (index <= edge) != mistaken

    assert throughput.search(sustains, 32) == edge
    assert len(tried) <= 2 * 6 + 1  # six bisections of 33 answers, two runs each, and a third run after the wrong one


def sustained(**changed: Any) -> dict[str, Any]:
    """Result of a run that sustains its rate, with changes."""
    latency_us = {"p50": 200.0, "p99": 400.0}
    result = {"requested_hz": 1000.0, "rate_hz": 995.0, "frames": 10_000, "without_command": 10, "messages_lost": 0}
    return result | {"frame_to_command_us": latency_us, "usage": {}} | changed


@pytest.mark.parametrize(
    ("one", "complaints"),
    [
        (sustained(), []),
        (sustained(messages_lost=None), []),
        (sustained(rate_hz=989.0), ["989 frames a second"]),
        (sustained(without_command=11), ["0.11 % of the frames without a command"]),
        (sustained(messages_lost=1), ["1 messages lost"]),
        ({"requested_hz": 1000.0, "failure": "it fell"}, ["it fell"]),
    ],
)
def test_a_rate_is_sustained_if_there_is_no_complaint(one: dict[str, Any], complaints: list[str]) -> None:
    assert throughput.complaints(one) == complaints


def test_a_loop_has_its_highest_rate_and_the_reason_why_the_next_rate_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    shares = {"camera": (0.5, "0"), "controller": (0.6, "1"), "mirror": (0.3, "1"), "recorder": (0.2, "0,1")}
    usage = {role: {"share": share, "processors": processors} for role, (share, processors) in shares.items()}

    def run_once(loop_options: Sequence[str], rate_hz: float, seconds: float) -> dict[str, Any]:
        lost = 0 if rate_hz <= 1300 else 7
        changed = {"messages_lost": lost, "usage": usage, "commands_late_fraction": 0.25}
        return sustained(requested_hz=rate_hz, rate_hz=rate_hz, **changed)

    monkeypatch.setattr(throughput, "run_once", run_once)
    rates = throughput.grid(1000, 2000, 1.1)
    loop = throughput.highest_rate([], rates, 1.0, lambda _: None)
    assert (loop["highest_hz"], loop["run"]["rate_hz"], loop["above"]["requested_hz"]) == (1210, 1210, 1331)
    none = throughput.highest_rate([], [1400.0], 1.0, lambda _: None)
    assert none["highest_hz"] is None
    result = {"loops": {"simulated": loop, "none": none}, "seconds": 1.0, "rates_hz": rates}
    speeds, loads = throughput.tables(json.loads(json.dumps(result)))
    assert speeds[1] == ["simulated", "1210", "200", "400", "25 %", "1331 Hz: 7 messages lost"]
    assert speeds[2] == ["none", "none", "", "", "", "1400 Hz: 7 messages lost"]
    assert loads[1] == ["simulated", "1210", "50 % (0)", "60 % (1)", "30 % (1)", "20 % (0,1)", "0: 50 %, 1: 90 %"]
    assert loads[2][:2] == ["simulated", "1000"]
    assert f"{len(loop['runs']) + len(none['runs'])} runs on a grid of 8 rates" in throughput.about(result)


@pytest.mark.exclusive
@pytest.mark.slow
def test_a_real_loop_with_the_simulated_camera_is_measured() -> None:
    one = throughput.run_once(throughput.LOOPS["simulated camera, recorder"], 100.0, 1.5)
    assert 0 < one["frames"] <= 151
    assert one["messages_lost"] is not None
    assert 0 <= one["commands_late_fraction"] <= 1
    assert set(one["usage"]) == {*load.LOOP, "recorder"}


def test_a_run_of_a_failed_command_has_the_error_of_the_command() -> None:
    one = throughput.run_once(["--camera", "nonsense"], 100.0, 1.0)
    assert "nonsense" in throughput.complaints(one)[0]


# Use of processors and memory


def sample(at_s: float, **used_s: float) -> load.Sample:
    return load.Sample(at_s, {role: load.Usage(one, "0", 2_000_000) for role, one in used_s.items()})


def test_shares_of_processors_are_averaged_over_the_time_in_which_all_processes_ran() -> None:
    samples = [sample(0.0, camera=5.0)]
    samples += [sample(1 + tenth / 10, camera=9 + tenth / 20, controller=1, mirror=tenth / 40) for tenth in range(12)]
    samples += [sample(3.0, camera=99.0)]
    found = load.shares(samples, 1.0)
    assert found["camera"] == {"share": pytest.approx(0.5), "processors": "0", "mb": 2.0}
    assert found["controller"]["share"] == 0
    assert found["mirror"]["share"] == pytest.approx(0.25)
    assert load.shares(samples[:3], 1.0) == load.shares([], 1.0) == {}


def test_roles_of_processes_are_found_from_their_command_lines() -> None:
    assert load.role_of(["python", "-P", "-m", "sim_camera", "--run", "x"]) == "camera"
    assert load.role_of(["python", "-m", "lowfc", "record"]) == "recorder"
    assert load.role_of(["python", "-m", "lowfc", "latency"]) is None
    assert load.role_of(["python", "-m"]) is load.role_of([]) is None


# The comparison with other implementations


def parsed(*arguments: str | Path) -> Namespace:
    parser = ArgumentParser()
    comparison.options(parser)
    return parser.parse_args(list(map(str, arguments)))


def run_result(p50: float, p99: float, without_command: int = 0) -> dict[str, Any]:
    span = {"p50": p50, "p99": p99, "p99_9": 2 * p99, "max": 3 * p99}
    counts = {"frames": 1000, "without_command": without_command, "sent_late": 0, "command_error": 1e-6}
    return counts | {"frame_to_command": span, "frame_to_mirror": None}


def test_the_statistics_of_a_run_are_computed_from_its_times(tmp_path: Path) -> None:
    comparison.write_shared_files(tmp_path, 6)
    due = np.arange(7) * 1_000_000 + 50_000_000
    published = due + 10_000
    published[5] += 1_200_000
    commanded, received = published + np.arange(7) * 1000, published + 50_000
    commanded[4] = received[4] = 0
    for name, times in zip(TIME_STAMPS, (due, published, commanded, received), strict=True):
        times.astype(np.int64).tofile(tmp_path / name)
    found = comparison.run_statistics(tmp_path, 2)  # frames 3 to 6
    assert found["frames"] == 4
    assert found["without_command"] == found["sent_late"] == 1
    assert found["frame_to_command"] == {"p50": 5.0, "p90": 6.0, "p99": 6.0, "p99_9": 6.0, "max": 6.0}
    assert set(found["frame_to_mirror"].values()) == {50.0}
    assert found["command_error"] is None
    commanded.fill(1)
    commanded.tofile(tmp_path / "commanded")
    assert comparison.run_statistics(tmp_path, 2)["command_error"] == 1  # no actuators were received


def test_the_tables_have_ranges_and_differences_within_a_turn_and_name_missing_implementations() -> None:
    runs = {
        "C chain": [run_result(55, 440, 3), run_result(66, 110, 9), None],
        "pyrtcao, stock": [],
        "pyrtcao, fused": [None, None, None],
        FUSED: [run_result(100, 200), run_result(60, 230), run_result(150, 220)],
    }
    result = {
        "runs": runs,
        "missing": {"pyrtcao, stock": "get it"},
        "rules": {"repeats": 3, "seconds": 1.0, "rate_hz": 1000.0, "warm_up": 5},
        "priority": 50,
        "granted": ["processors awake"],
        "refused": ["that"],
        "pinned_to": [0, 1],
        "versions": {"lowfc": "1"},
        "failed": ["pyrtcao, fused: it fell"],
    }
    latencies, differences, features = (
        by_heading(lines) for lines in comparison.tables(json.loads(json.dumps(result)))
    )
    chain, absent, failed, fused = latencies
    assert fused["frame to command p50, us"] == "100 (60 to 150)"
    assert fused["frame to command max, us"] == "660 (600 to 690)"
    assert chain["frames without a command"] == "12 of 2000"
    assert [line["frame to command p50, us"] for line in (absent, failed)] == ["not installed", "failed"]
    (chain_row,) = differences
    assert list(chain_row.values()) == ["1 of 2", "1 of 2", "-60 (-240 to +120)", "+20 (-6 to +45)", "C chain"]
    assert [line["implementation"] for line in features] == list(runs)
    about = comparison.about(result)
    for expected in ("CLOCK_MONOTONIC", "get it", "it fell", "refused: that", "SCHED_FIFO 50"):
        assert expected in about


def test_a_missing_implementation_is_reported_with_a_remedy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    named = {one.name: one for one in IMPLEMENTATIONS}
    chain, fused = named["C chain"], named["pyrtcao, fused"]
    assert "pyrtcao is not installed in /no" in implementations.missing(fused, parsed("--pyrtcao", "/no"))
    monkeypatch.setattr(implementations.shutil, "which", lambda _: "cc")
    assert f"{tmp_path} has no ImageStreamIO.c: git clone" in implementations.missing(chain, parsed("--isio", tmp_path))
    monkeypatch.setattr(implementations.shutil, "which", lambda _: None)
    assert "no C compiler" in implementations.missing(chain, parsed("--isio", tmp_path))


def test_the_step_is_an_integrator_with_a_leak(tmp_path: Path) -> None:
    comparison.write_shared_files(tmp_path, 1)
    run_data = RunData(tmp_path)
    plain_step, pixels = NumpyStep(run_data), run_data.frame(0)
    error_nm = run_data.R @ (pixels.ravel() - run_data.I0)
    for command_nm in (-0.3 * error_nm, -0.3 * 1.99 * error_nm):
        actuators = np.frombuffer(plain_step.command(pixels.tobytes()), np.float32)
        assert actuators.shape == (ACTUATORS,)
        np.testing.assert_allclose(actuators, run_data.to_actuators @ command_nm, rtol=1e-3, atol=1e-3)


@pytest.mark.exclusive
@pytest.mark.parametrize(
    "chosen", [pytest.param(one, id=one.name, marks=[pytest.mark.slow] * bool(one.kernel)) for one in IMPLEMENTATIONS]
)
def test_a_real_run_of_an_implementation_gives_its_latencies(chosen: implementations.Implementation) -> None:
    """The C chain is run if ISIO_DIR is a checkout of ImageStreamIO, pyrtcao if PYRTCAO_PYTHON has it."""
    seconds, rate_hz = 0.5, 200.0
    options = parsed("--seconds", str(seconds), "--rate", str(rate_hz), "--warm-up", "10")
    if why := implementations.missing(chosen, options):
        pytest.skip(why)
    found = comparison.one_run(chosen, options, 0)
    # The warm-up of lowfc is a time, not a number of frames.
    assert found["frames"] == pytest.approx(seconds * rate_hz, abs=10)
    assert found["without_command"] < found["frames"]
    to_command, to_mirror = found["frame_to_command"], found["frame_to_mirror"]
    assert 0 < to_command["p50"] <= to_command["p99"] <= to_command["max"]
    assert to_mirror["max"] > to_command["p50"]
    assert (found["command_error"] or 0) < 1e-4  # None for lowfc's own loop, and if a frame has no command


# Kernels


def test_each_kernel_is_measured_once_in_every_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernels, "set_up", lambda *_, **__: None)
    found = kernels.measure(Namespace(side=[32], repeats=2, seconds=0.01), lambda _: None)
    (one,) = found["sizes"]
    assert [set(turn) for turn in one["turns"]] == [{"numpy", "fused", "product", "memory"}] * 2
    assert one["ratios"]["fused over numpy"][1] == one["turns"][1]["fused"] / one["turns"][1]["numpy"]
    (lines,) = kernels.tables(found)
    assert len(lines) == 6
    assert "product" in kernels.about(found)


# Streams


def test_streams_and_the_direct_link_are_compared_within_each_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    order: list[str] = []

    def one_run(rate_hz: float, seconds: float, name: str) -> dict[str, Any]:
        order.append(name)
        span = run_result(100.0 * len(order), 1000.0)["frame_to_command"]
        spans = dict.fromkeys(("frame_to_command", "frame_to_mirror", "stream_to_camera"), span)
        return spans | {"frames": 500, "without_command": int(name != streams.DIRECT)}

    monkeypatch.setattr(streams, "one_run", one_run)
    found = streams.measure(Namespace(repeats=2, rate_hz=1000.0, seconds=1.0), lambda _: None)
    turn = [streams.DIRECT, streams.CAMERA_PROCESS, streams.IN_CONTROLLER]
    assert order == [*turn, *reversed(turn)]
    (lines,) = streams.tables(json.loads(json.dumps(found)))
    found_p50 = [line["frame to mirror, us: p50"] for line in by_heading(lines)]
    assert found_p50[:3] == ["350 (100 to 600)", "350 (200 to 500)", "350 (300 to 400)"]
    assert found_p50[3:] == ["1.42 (0.83 to 2.00)", "1.83 (0.67 to 3.00)"]
    _, camera_process, _, ratio, _ = by_heading(lines)
    assert camera_process["frames without a command"] == "2 of 1000"
    assert ratio["frame to command, us: p99"] == "1.00 (1.00 to 1.00)"
    assert "includes 350 (200 to 500) us (p50)" in streams.about(found)
    assert "reads the stream itself, 350 (300 to 400) us" in streams.about(found)


@pytest.mark.exclusive
@pytest.mark.slow
@pytest.mark.parametrize("name", [streams.CAMERA_PROCESS, streams.IN_CONTROLLER])
def test_a_real_loop_over_streams_is_measured(name: str) -> None:
    found = streams.one_run(200.0, 1.0, name)
    assert found["frames"] == pytest.approx(200, abs=10)
    assert found["without_command"] < found["frames"]
    assert 0 < found["stream_to_camera"]["p50"] < found["frame_to_command"]["p50"] < found["frame_to_mirror"]["p50"]
