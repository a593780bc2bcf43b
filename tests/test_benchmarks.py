"""The benchmarks' own arithmetic, on made-up figures, and one contestant run for real."""

import json
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from benchmarks import releases
from benchmarks.host import host
from benchmarks.peers import contest, table
from benchmarks.peers.contestants import BARE, CONTESTANTS, TIMER
from benchmarks.peers.lowfc_step import LowfcStep
from benchmarks.peers.problem import ACTUATORS, NumpyStep, Problem
from benchmarks.peers.process import MARKS, Plan
from benchmarks.peers.ring import WAKES, Ring
from lowfc.contract.messages import wire

ROOT = Path(__file__).parents[1]

SECONDS = 0.3
RATE_HZ = 500.0


def run(p50: float, p99: float, without: int = 0, **more: int) -> dict[str, object]:
    span = {"p50_us": p50, "p99_us": p99, "p99_9_us": 2 * p99, "max_us": 3 * p99}
    return {
        "frames": 1000,
        "without_command": without,
        "sent_late": 0,
        "frame_to_command": span,
        "frame_to_mirror": None,
    } | more


def row(contestant: str, *runs: dict[str, object], scheduling: str = "normal", **more: object) -> dict[str, object]:
    fixed = {"contestant": contestant, "what": "what it is", "scheduling": scheduling, "failures": []}
    return fixed | {"repeats": list(runs)} | more


def test_the_figures_of_a_run_are_those_of_its_times(tmp_path: Path) -> None:
    Plan(1000.0, 6, {}, {}).write(tmp_path)
    due = np.arange(7) * 1_000_000 + 50_000_000
    published = due + 10_000
    published[5] += 1_200_000
    commanded, received = published + np.arange(7) * 1000, published + 50_000
    commanded[4] = received[4] = 0
    for name, times in zip(MARKS, (due, published, commanded, received, np.arange(7) % 2), strict=True):
        times.astype(np.int64).tofile(tmp_path / name)
    found = contest.figures(tmp_path, 2, observed=True)  # frames 3 to 6
    assert found["frames"] == 4
    assert found["without_command"] == found["sent_late"] == 1
    assert found["frame_to_command"] == {"p50_us": 5.0, "p99_us": 6.0, "p99_9_us": 6.0, "max_us": 6.0}
    assert found["frame_to_mirror"] == {"p50_us": 50.0, "p99_us": 50.0, "p99_9_us": 50.0, "max_us": 50.0}
    assert found["frames_observed"] == 2


def test_the_table_has_minimum_and_median_and_ratios_within_a_class() -> None:
    lines = table.table(
        [
            row(TIMER, run(50, 60)),
            row(BARE, run(100, 200), run(110, 230), run(150, 220)),
            row("other", run(55, 440, 3), run(66, 110, 9), run(40, 120, 1)),
            row(BARE, run(1000, 1000), scheduling="FIFO"),
            row("other", run(500, 100), scheduling="FIFO"),
        ]
    )
    cells = [dict(zip(table.HEADINGS, line, strict=True)) for line in lines]
    assert cells[1]["p50, us"] == "100/110"
    assert cells[1]["max, us"] == "600/660"
    assert cells[2]["p50, us"] == "40/55"
    assert (cells[2]["p50 of zenoh's"], cells[2]["p99"]) == ("0.50", "0.55")
    assert cells[2]["without a command"] == "3 of 1000"
    assert (cells[4]["p50 of zenoh's"], cells[4]["p99"]) == ("0.50", "0.10")
    assert cells[0]["without a command"] == cells[0]["p50 of zenoh's"] == ""


def test_who_is_not_there_has_no_figures() -> None:
    absent = row("pyrtcao, stock", missing="not installed: get it")
    failed = row("pyrtcao, fused") | {"failures": ["it fell"]}
    silent = row("deaf", {**run(1, 1), "frame_to_command": None, "without_command": 1000})
    lines = table.table([absent, failed, silent])
    assert [line[2] for line in lines] == ["not installed", "failed", ""]
    assert lines[2][8] == "1000 of 1000"
    assert not any("".join(line[3:]) for line in lines[:2])


def test_what_is_printed_says_where_and_how_it_was_measured() -> None:
    result = {
        "rows": [row(BARE, run(100, 200, frames_observed=998)), row("pyrtcao, stock", missing="not installed: get it")],
        "rules": {"repeats": 1, "seconds": 1.0, "rate_hz": 1000.0, "warm_up": 5},
        "sizes": "80 x 80",
        "notes": ["a note"],
        "host": host() | {"load_before": 0.5},
        "pinned_to": [0, 1],
        "versions": {"lowfc": "0.1"},
        "date": "2026-01-01",
        "command_line": "python -m benchmarks.peers",
    }
    printed, written = table.text(result), table.markdown(result)
    for said in (
        "CLOCK_MONOTONIC",
        "998 of 1000 frames",
        "get it",
        "a note",
        host()["kernel"],
        "`python -m benchmarks.peers`",
    ):
        assert said in printed
        assert said in written
    rows = [line for line in written.splitlines() if line.startswith("|")]
    assert len(rows) == 4
    assert len({line.count("|") for line in rows}) == 1


def test_pyrtcao_is_said_to_be_missing_and_how_to_get_it() -> None:
    stock = next(one for one in CONTESTANTS if one.name == "pyrtcao, stock")
    (found,) = contest.hold([stock], contest.Rules(0.1, 0, 100.0, "/no/such/python"), 1, ["normal"])
    assert not found["repeats"]
    assert "/no/such/python" in found["missing"]
    assert table.table([found])[0][2] == "not run"


def test_both_steps_give_the_same_actuators() -> None:
    """Up to the flux of a frame, by which lowfc divides it: set to the expected one here."""
    problem = Problem()
    ours, plain = LowfcStep(problem), NumpyStep(problem)
    pixels = problem.I0.round().astype(np.uint16).reshape(problem.frames.shape[1:]).copy()
    pixels.flat[:20] += 30
    pixels.flat[20:40] -= 30
    pixels.flat[40] += int(problem.I0.sum()) - int(pixels.sum(dtype=np.int64))
    for number in (1, 2, 3):
        answer = wire.MirrorCommand.FromString(ours.command(ours.payload(pixels, 0), number, 0))
        wanted = np.frombuffer(plain.command(plain.payload(pixels, 0), number, 0), np.float32)
        assert wanted.shape == (ACTUATORS,)
        np.testing.assert_allclose(np.frombuffer(answer.actuators, np.float32), wanted, rtol=0.01, atol=0.01)
    assert np.abs(wanted).max() > 0.1


@pytest.mark.parametrize("wake", WAKES)
def test_a_ring_hands_over_the_newest_and_wakes(tmp_path: Path, wake: str) -> None:
    there = Ring(tmp_path / "ring", 9, wake, make=True)
    here = Ring(tmp_path / "ring", 9, wake, make=False)
    for number in range(1, 12):  # once around, and nobody takes
        there.put(number, 100 * number, b"message" + str(number).encode())
    assert here.take() == (11, 1100, b"message11")
    later = threading.Timer(0.05, there.put, (12, 1200, b"short"))
    later.start()
    assert here.take() == (12, 1200, b"short")
    later.join()


def test_shared_memory_is_really_run() -> None:
    one = next(one for one in CONTESTANTS if one.name == "shared memory, semaphore")
    found = contest.one_run(one, contest.Rules(SECONDS, 10, RATE_HZ), 0)
    assert found["frames"] == SECONDS * RATE_HZ
    assert found["without_command"] < found["frames"]
    there, back = found["frame_to_command"], found["frame_to_mirror"]
    assert 0 < there["p50_us"] <= there["p99_us"] <= there["max_us"]
    assert back["max_us"] > there["p50_us"]


TODAY = {
    "latency_us": {"frame_to_command": {"p50": 150.0, "p99": 300.0}},
    "echo_us": {"round_trip": {"p50": 100.0, "p99": 150.0}},
    "over_echo_and_step": {"p50": 1.2},
    "frames": 1000,
    "frames_without_command": 2,
    "echo_frames": {"frames": 500},
    "histogram": [1, 2, 3],
    "host": {"name": "here", "quiet": True},
}


def test_figures_are_flat_numbers() -> None:
    flat = releases.flat(TODAY)
    assert flat["latency_us.frame_to_command.p99"] == 300.0
    assert not [path for path in flat if path.startswith(("histogram", "host"))]


def test_today_and_the_last_release_are_set_against_their_own_echo(tmp_path: Path) -> None:
    before = releases.flat(TODAY) | {"latency_us.frame_to_command.p50": 400.0, "echo_us.round_trip.p50": 200.0}
    oldest = releases.entry(releases.flat(TODAY), "0.1") | {"date": "2001-01-01"}
    releases.store(tmp_path, oldest)
    releases.store(tmp_path, releases.entry(before, "0.2"))
    last = releases.last(tmp_path)
    assert last is not None
    assert last["release"] == "0.2"
    assert set(json.loads((tmp_path / "0.2.json").read_text())) == {"release", "date", "host", "kernel", "figures"}
    lines = {line["figure"]: line for line in releases.compare(releases.entry(releases.flat(TODAY), "0.3"), last)}
    assert set(lines) == {
        "latency_us.frame_to_command.p50",
        "latency_us.frame_to_command.p99",
        "frames_without_command",
    }
    p50 = lines["latency_us.frame_to_command.p50"]
    assert (p50["to_echo"], p50["before_to_echo"], p50["change"]) == (1.5, 2.0, 0.75)
    assert lines["frames_without_command"] == {"figure": "frames_without_command", "today": 2, "before": 2}


def test_the_command_prints_stores_and_never_overwrites(tmp_path: Path) -> None:
    (tmp_path / "today.json").write_text(json.dumps(TODAY))
    words = [
        sys.executable,
        "-m",
        "benchmarks.releases",
        str(tmp_path / "today.json"),
        "--folder",
        str(tmp_path / "of"),
    ]

    def said(*more: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run([*words, *more], cwd=ROOT, capture_output=True, text=True, check=False)

    first = said("--store", "--release", "1.0")
    assert first.returncode == 0, first.stderr
    assert "no release stored" in first.stdout
    assert "1.0 of 20" in said().stdout
    again = said("--store", "--release", "1.0")
    assert again.returncode == 2
    assert "there already" in again.stderr
    (tmp_path / "today.json").write_text("{}")
    assert said().returncode == 2
