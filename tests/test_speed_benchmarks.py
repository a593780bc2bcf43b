"""Cost curves and highest rates: their arithmetic on made-up figures, and one small run of each for real."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import measure_speed
import numpy as np
import pytest

from benchmarks import cells, curves, load, throughput
from benchmarks.sizes import Size
from lowfc.contract.configuration import Camera
from lowfc.contract.messages import FRAME, wire

ROOT = Path(__file__).parents[1]

SMALL = Size(side=32, modes=5, mirror_side=10)
HOST = {"processors": 2, "processor": "P", "kernel": "6.1", "clock_source": "tsc", "python": "3.11"}
ABOUT = {"host": HOST, "load_before": 0.1, "date": "2026-01-01"}


def test_a_made_up_calibration_sees_noise_and_has_the_bytes_that_are_counted() -> None:
    calibration, frames = curves.made_up(Size(32, 7, 16), curves.configuration(SMALL, 100.0))
    pixels = frames.reshape(len(frames), -1).astype(float) - calibration.dark
    seen = pixels / pixels.sum(axis=1, keepdims=True) - calibration.reference
    error_nm = seen @ calibration.reconstructor.T
    assert 0.5 < np.sqrt(np.mean(error_nm**2)) < 2
    touched = ("reconstructor", "reference", "dark", "good", "modes_to_actuators")
    assert Size(32, 7, 16).bytes == sum(getattr(calibration, name).nbytes for name in touched) + frames[0].nbytes


@pytest.mark.parametrize("size", [SMALL, Size(side=48, modes=5, mirror_side=10), Size(modes=50), Size(mirror_side=23)])
def test_a_step_of_any_size_is_timed_beside_its_limits(size: Size) -> None:
    found = curves.step_figures(size, 0.02)
    assert set(found) == {"step_us", "stream_us", "products_us"}
    for figures in found.values():
        assert 0 < figures["p50"] <= figures["p99"]
        assert figures["cpu"] > 0


def test_a_step_that_holds_its_command_is_no_measurement(monkeypatch: pytest.MonkeyPatch) -> None:
    dazzled = curves.configuration(SMALL, 100.0).model_copy(update={"camera": Camera(full_well_e=500.0)})
    monkeypatch.setattr(curves, "configuration", lambda size, rate_hz: dazzled)
    with pytest.raises(RuntimeError, match="SATURATED"):
        curves.step_figures(SMALL, 0.01)


@pytest.mark.slow
def test_a_loop_of_sizes_without_an_optical_model_is_run() -> None:
    found = curves.loop_figures(Size(side=32, modes=40, mirror_side=16), 500.0, 0.5)
    assert "failure" not in found
    assert found["frames"] > 200
    assert found["echo_us"]["p50"] > 0
    assert 0 < found["frame_to_command_us"]["p50"] <= found["frame_to_command_us"]["p99"]
    assert found["frame_to_command_us"]["cpu"] > 0
    assert found["frames_without_command"] < found["frames"]


def repeat(step: float, without: int = 0, **more: Any) -> dict[str, Any]:
    return {
        "step_us": {"p50": step, "p99": 2 * step, "cpu": step},
        "stream_us": {"p50": 10.0, "p99": 11.0, "cpu": 10.0},
        "products_us": {"p50": 15.0, "p99": 16.0, "cpu": 15.0},
        "frame_to_command_us": {"p50": 200.0, "p99": 400.0},
        "echo_us": {"p50": 50.0, "p99": 60.0},
        "frames": 100,
        "frames_without_command": without,
    } | more


def curves_result() -> dict[str, Any]:
    failed = {name: value for name, value in repeat(50.0).items() if name.endswith("_us") and name[0] != "f"}
    points = [
        curves.point(Size(side=32), [repeat(30.0), repeat(20.0, 2), repeat(25.0)]),
        curves.point(Size(side=48), [failed | {"failure": "the mirror ended"}]),
    ]
    return ABOUT | {
        "curves": {"pixels": points, "modes": points[:1], "actuators": []},
        "default": {"side": 80, "modes": 20, "mirror_side": 34},
        "seconds": 1.0,
        "repeats": 3,
        "rate_hz": 250.0,
        "command": "python -m benchmarks.curves",
    }


def test_a_point_is_the_median_of_its_repeats_and_says_what_the_limit_is() -> None:
    result = json.loads(json.dumps(curves_result()))
    (pixels, modes) = curves.tables(result).values()
    first, second = (dict(zip(pixels[0], line, strict=False)) for line in pixels[1:])
    assert first["pixels"] == "1024 (32 x 32)"
    assert modes[1][0] == "20"
    assert first["step p50, us"] == "25.0 (20.0 to 30.0)"
    assert first["step of the limit"] == "2.5"
    assert first["read at, GB/s"] == f"{Size(side=32).bytes / 10.0 / 1e3:.0f}"
    assert first["frames without a command"] == "2 of 300"
    assert second["loop p50, us"] == "failed"
    for said in (curves.text(result), curves.markdown(result)):
        assert "Failed, 2304 (48 x 48) pixels: the mirror ended." in said
        assert "`python -m benchmarks.curves`" in said
    assert len({len(line) for line in pixels}) == 1
    assert curves.picture(result).startswith(b"\x89PNG")


def test_the_curves_of_a_few_sizes_from_the_command_line(tmp_path: Path) -> None:
    words = ["--pixels", "32", "--modes", "20", "--actuators", "--no-loop", "--seconds", "0.02", "--repeats", "2"]
    command = [sys.executable, "-m", "benchmarks.curves", *words, "--json", "--plot", str(tmp_path / "curves.png")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert [one["pixels"] for one in found["curves"]["pixels"]] == [1024]
    assert [one["pixels"] for one in found["curves"]["modes"]] == [6400]
    assert found["curves"]["actuators"] == []
    assert (tmp_path / "curves.png").read_bytes().startswith(b"\x89PNG")
    assert "1024 (32 x 32)" in curves.markdown(found)


def test_a_grid_is_geometric_and_has_both_ends() -> None:
    assert throughput.grid(500, 800, 1.1) == [500, 550, 605, 666, 732]
    assert throughput.grid(1000, 4000, 2) == [1000, 2000, 4000]
    assert throughput.grid(700, 700, 1.1) == [700]


@pytest.mark.parametrize("edge", range(-1, 32))
def test_the_search_finds_the_last_rate_that_holds(edge: int) -> None:
    asked: list[int] = []

    def sustains(place: int) -> bool:
        asked.append(place)
        return place <= edge

    assert throughput.search(sustains, 32) == edge
    assert all(asked.count(place) == 2 for place in (edge, edge + 1) if 0 <= place < 32)
    assert len(asked) <= 6 + 2


def test_the_search_is_not_misled_by_one_wrong_verdict() -> None:
    for wrong in (7, 15, 11, 12, 13):
        told: set[int] = set()

        def sustains(place: int, wrong: int = wrong, told: set[int] = told) -> bool:
            mistaken = place == wrong and place not in told
            told.add(place)
            return (place <= 11) != mistaken

        assert throughput.search(sustains, 16) == 11
    assert throughput.search(lambda place: True, 0) == -1


def good(**changed: Any) -> dict[str, Any]:
    latency_us = {"p50": 200.0, "p99": 400.0}
    run = {"asked_hz": 1000.0, "rate_hz": 995.0, "frames": 10_000, "without_command": 10, "messages_lost": 0}
    return run | {"frame_to_command_us": latency_us, "usage": {}} | changed


def test_a_rate_holds_where_nothing_is_to_be_complained_of() -> None:
    assert throughput.complaints(good()) == []
    assert throughput.complaints(good(messages_lost=None)) == []
    assert throughput.complaints(good(rate_hz=989.0)) == ["989 frames a second"]
    assert throughput.complaints(good(without_command=11)) == ["0.11 % of the frames without a command"]
    assert throughput.complaints(good(messages_lost=1)) == ["1 messages lost"]
    assert throughput.complaints({"asked_hz": 1000.0, "failure": "it fell"}) == ["it fell"]


def test_a_way_has_its_highest_rate_and_why_it_goes_no_faster(monkeypatch: pytest.MonkeyPatch) -> None:
    def measure(words: list[str], rate_hz: float, seconds: float) -> dict[str, Any]:
        lost = 0 if rate_hz <= 1300 else 7
        usage = {
            "camera": {"share": 0.5, "processors": "0"},
            "controller": {"share": 0.6, "processors": "1"},
            "mirror": {"share": 0.3, "processors": "1"},
            "recorder": {"share": 0.2, "processors": "0-1"},
        }
        return good(asked_hz=rate_hz, rate_hz=rate_hz, messages_lost=lost, usage=usage, commands_late=0.25)

    monkeypatch.setattr(throughput, "measure", measure)
    rates = throughput.grid(1000, 2000, 1.1)
    way = throughput.find(["sim-loop"], rates, 1.0, lambda _: None)
    assert way["highest_hz"] == 1210
    assert throughput.find(["sim-loop"], [1400.0], 1.0, lambda _: None)["highest_hz"] is None
    ways = {"simulated": way, "none": throughput.find(["sim-loop"], [1400.0], 1.0, lambda _: None)}
    free = {"free": good(asked_hz=None, rate_hz=2345.6), "fallen": {"asked_hz": None, "failure": "it fell"}}
    result = ABOUT | {"ways": ways, "free_running": free, "seconds": 1.0, "rates_hz": rates, "command": "a command"}
    speeds, use = throughput.tables(json.loads(json.dumps(result)))
    assert speeds[1] == ["simulated", "1210", "200", "400", "25 %", "1331 Hz: 7 messages lost"]
    assert speeds[2] == ["none", "none", "", "", "", "1400 Hz: 7 messages lost"]
    assert speeds[3][:3] == ["free", "2346", "200"]
    assert speeds[4][-1] == "it fell"
    assert use[1] == ["simulated", "1210", "50 % (0)", "60 % (1)", "30 % (1)", "20 % (0-1)", "0: 50 %, 1: 90 %"]
    assert use[2][:2] == ["simulated", "1000"]
    assert f"{len(way['runs']) + len(ways['none']['runs'])} runs on a grid of 8 rates" in throughput.text(result)
    assert {len(line) for line in speeds} == {6}
    assert {len(line) for line in use} == {7}
    assert "| simulated | 1210 | 50 % (0) |" in throughput.markdown(result)


def health(process: str, at_s: float, published: int = 0, received: int = 0, skipped: int = 0) -> throughput.Heard:
    frames = wire.TopicCount(topic=FRAME.key, published=published, received=received, skipped=skipped, missing=skipped)
    made = wire.Health(process=process, state="running", uptime_ns=round(at_s * 1e9), topics=[frames])
    return throughput.Heard(at_s, made)


def test_the_start_of_a_simulated_loop_is_left_out() -> None:
    heard = [health("camera", 10 + half / 2, published=1 + 250 * half) for half in range(6)]
    heard += [health("controller", 10.1 + half / 2, received=200 * half, skipped=20 + (half == 4)) for half in range(6)]
    found = throughput.steady(sorted(heard, key=lambda one: one.at_s))
    assert found == {"rate_hz": 500.0, "frames": 601, "without_command": 2}
    assert throughput.steady(heard[:2]) is None
    assert throughput.steady([]) is None


def moment(at_s: float, **used_s: float) -> load.Moment:
    return load.Moment(at_s, used_s, dict.fromkeys(used_s, "0"))


def test_shares_are_of_the_time_in_which_all_were_there() -> None:
    moments = [moment(0.0, camera=5.0)]
    moments += [moment(1 + tenth / 10, camera=9 + tenth / 20, controller=1, mirror=tenth / 40) for tenth in range(12)]
    moments += [moment(3.0, camera=99.0)]
    found = load.shares(moments, 1.0)
    assert found["camera"].share == pytest.approx(0.5)
    assert found["camera"].processors == "0"
    assert found["controller"].share == 0
    assert found["mirror"].share == pytest.approx(0.25)
    assert load.shares(moments[:3], 1.0) == {}
    assert load.shares([], 1.0) == {}


def test_processes_are_known_by_what_python_was_told_to_run() -> None:
    assert load.role_of(["python", "-P", "-m", "sim_camera", "--run", "x"]) == "camera"
    assert load.role_of(["python", "-m", "lowfc", "record"]) == "recorder"
    assert load.role_of(["python", "-m", "lowfc", "latency"]) is None
    assert load.role_of(["python", "-m"]) is load.role_of([]) is None


def test_real_processes_below_this_one_are_watched() -> None:
    busy, idle = "while True: pass", "import time; time.sleep(60)"
    told = {
        "camera": (busy, ["sim_camera"]),
        "controller": (idle, ["lowfc", "controller"]),
        "mirror": (idle, ["sim_dm"]),
    }
    children = [subprocess.Popen([sys.executable, "-c", code, "-m", *words]) for code, words in told.values()]
    try:
        with load.Watched(os.getpid()) as watched:
            time.sleep(1.2)
    finally:
        for child in children:
            child.kill()
            child.wait()
    found = watched.shares(1.0)
    assert set(found) == load.LOOP
    assert found["camera"].share > 0.1 > found["controller"].share
    assert found["mirror"].processors == found["camera"].processors != ""


@pytest.mark.slow
def test_a_simulated_loop_is_measured_for_real() -> None:
    run = throughput.measure([throughput.SIMULATED], 100.0, 1.5)
    assert "failure" not in run
    assert 0 < run["frames"] <= 150
    assert run["messages_lost"] is not None
    assert 0 <= run["commands_late"] <= 1
    assert set(run["usage"]) == {*load.LOOP, "recorder"}


def test_a_command_that_fails_says_why() -> None:
    run = throughput.measure([throughput.SIMULATED, "--sensor", "no-such-mask"], 100.0, 1.0)
    assert "no-such-mask" in throughput.complaints(run)[0]


def test_both_tables_of_cells_have_every_cell() -> None:
    lines = [["a", "bb", "ff"], ["ccc", "1", "d|e"]]
    assert cells.text(lines) == "a    bb  ff\nccc   1  d|e"
    assert cells.markdown(lines) == "| a | bb | ff |\n|---|---|---|\n| ccc | 1 | d/e |"


def test_a_section_is_added_once_and_its_tables_replaced(tmp_path: Path) -> None:
    document = tmp_path / "performance.md"
    document.write_text("# Performance\n")
    result = curves_result()
    measure_speed.place(document, "curves", result)
    measure_speed.place(document, "curves", result | {"date": "2027-02-03"})
    begin, end = measure_speed.marks("curves")
    said = document.read_text()
    assert said.startswith("# Performance\n\n## What a frame costs\n")
    assert said.count(begin) == said.count(end) == said.count("## ") == 1
    assert "2027-02-03" in said
    assert "2026-01-01" not in said


def test_a_section_is_added_before_what_a_view_costs(tmp_path: Path) -> None:
    document = tmp_path / "performance.md"
    document.write_text(f"# Performance\n\n{measure_speed.NEXT}\nIts table.\n")
    measure_speed.place(document, "curves", curves_result())
    first, _, after = document.read_text().partition(measure_speed.NEXT)
    assert first.startswith("# Performance\n\n## What a frame costs\n")
    assert first.endswith(f"{measure_speed.marks('curves')[1]}\n\n")
    assert after == "\nIts table.\n"


def test_the_document_has_what_was_measured() -> None:
    measured = json.loads(measure_speed.MEASURED.read_text()) if measure_speed.MEASURED.exists() else {}
    document = measure_speed.DOCUMENT.read_text()
    for name in measure_speed.BENCHES:
        begin, end = measure_speed.marks(name)
        assert document.count(begin) == document.count(end) == (name in measured)
        if name in measured:
            assert document.partition(begin)[2].partition(end)[0] == measure_speed.render(name, measured[name])
    assert measure_speed.PICTURE.exists() == ("curves" in measured)
