"""The road down: every patch finds what it replaces, turns and ratios are right, the load loads, documents hold."""

import json
import os
import platform
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import measure_speed
import pytest
import zenoh

from benchmarks import cells
from benchmarks.road import loaded, measure, patches, report, table, trip
from benchmarks.road.__main__ import settings
from benchmarks.road.changes import CHANGES, Change, Loop
from benchmarks.road.load import background
from lowfc.adapters import join, realtime, zenoh_bus
from lowfc.adapters.clock import HostClock
from lowfc.adapters.run import open_run
from lowfc.adapters.zenoh_bus import ZenohBus
from lowfc.contract.configuration import keys
from lowfc.contract.messages import FRAME
from lowfc.programs import controller
from lowfc.programs.latency import run as latency_run

ROOT = Path(__file__).parents[1]
BY_NAME = {change.name: change for change in CHANGES}


def figures(p50: float, without: int = 0, **stages_us: float) -> dict[str, Any]:
    high = dict.fromkeys(("p99", "p99_9", "max", "due_p99_9", "mirror_p50"), 2 * p50)
    counts = {"frames": 1000, "frames_without_command": without, "granted": ["all"], "stages_us": stages_us}
    return {"p50": p50, **high, **counts}


@pytest.mark.parametrize("name", patches.PATCHES)
def test_every_patch_finds_what_it_replaces_and_belongs_to_a_change(name: str) -> None:
    assert BY_NAME[name].variables["LOWFC_ROAD"].split(",")[-1] == name
    with patches.applied(name) as replaced:
        changed = [(owner, attribute, vars(owner)[attribute]) for owner, attribute, _ in replaced]
        assert changed
        assert all(new is not old for (*_, new), (*_, old) in zip(changed, replaced, strict=True))
    assert all(vars(owner)[attribute] is not new for owner, attribute, new in changed)


def test_every_change_switches_something() -> None:
    assert len(BY_NAME) == len(CHANGES)
    for change in CHANGES:
        assert change.keys or change.variables != change.loop.variables, change.name
        assert set(change.keys) <= set(keys()), change.name
        if change.keys:
            before = settings().model_dump()["realtime"]
            words = [
                f"realtime.{key}" for key, value in before.items() if change.keys.get(f"realtime.{key}", value) != value
            ]
            assert words or len(os.sched_getaffinity(0)) == 1, f"{change.name} changes nothing"


def test_a_patch_without_a_target_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(realtime, "let_send")
    with pytest.raises(patches.PatchError, match="has no let_send to replace"), patches.applied("let-send"):
        pass
    with pytest.raises(patches.PatchError, match="no patch 'nonsense'"), patches.applied("shortcut,nonsense"):
        pass


@pytest.mark.parametrize(("names", "thread"), [("shortcut", "Dummy-"), ("shortcut,channel", "Thread-")])
def test_without_the_short_way_frames_come_by_the_bus(tmp_path: Path, names: str, thread: str) -> None:
    links, clock = open_run("road", base=tmp_path).links, HostClock(tmp_path)
    heard: list[str] = []
    with (
        patches.applied(names),
        closing(ZenohBus(links, "controller", clock)) as reader,
        closing(ZenohBus(links, "camera", clock)) as writer,
    ):
        reader.subscribe(FRAME, lambda _: heard.append(threading.current_thread().name))
        frames, deadline_s = writer.publisher(FRAME), time.monotonic() + 20
        while len(heard) < 3 and time.monotonic() < deadline_s:
            frames.put(b"frame")
            time.sleep(0.01)
    assert len(heard) >= 3
    assert all(name.startswith(thread) for name in heard), heard
    way = links.shortcut("controller")
    assert way is not None
    assert not way.exists()


EDITS = ("retry", "socket", "low-latency", "qos", "batching", "queues", "shared-memory", "password")


@pytest.mark.parametrize("name", EDITS)
def test_zenoh_takes_the_changed_settings(tmp_path: Path, name: str) -> None:
    links = open_run("road", base=tmp_path).links
    before = zenoh_bus.session_config(links, "controller")
    with patches.applied(name):
        after = zenoh_bus.session_config(links, "controller")
    assert after != before
    zenoh.Config.from_json5(json.dumps(after))
    if name == "socket":
        assert all(one.startswith("unixsock-stream/") for one in after["connect"]["endpoints"])


def test_the_mirror_is_ahead(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[object] = []
    monkeypatch.setattr(join, "set_up", lambda priority, *_, **__: asked.append(priority))
    monkeypatch.setattr(join, "receive_in_one_thread", lambda: None)
    with patches.applied("mirror-ahead"):
        for role in ("mirror-dm", "controller"):
            join.prepare(settings(), role, [])
    assert asked == [settings().realtime.priority + 1, settings().realtime.priority]


def test_telemetry_goes_before_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    monkeypatch.setattr(controller.Controller, "_send", lambda self, outputs: said.append(f"send {outputs}"))
    monkeypatch.setattr(controller.Controller, "_tell", lambda self, outputs: said.append(f"tell {outputs}"))
    with patches.applied("telemetry"):
        one: Any = object.__new__(controller.Controller)
        first, second = "first", "second"
        one._send(first)
        one._tell(first)
        one._tell(second)
    assert said == ["tell first", "send first", "tell second"]


SEEN = """
import gc, sys
import numpy as np
from lowfc.adapters import realtime
granted = realtime._quiet_interpreter()
print(gc.isenabled(), f"{sys.getswitchinterval():g}", "memory kept" in granted, np.float32(2e-38) / np.float32(4) > 0)
"""


def seen(name: str) -> "subprocess.CompletedProcess[str]":
    path = os.pathsep.join([str(trip.SITE), str(ROOT)])
    environment = {**os.environ, "PYTHONPATH": path, "LOWFC_ROAD": name}
    words = [sys.executable, "-P", "-c", SEEN]
    return subprocess.run(words, env=environment, capture_output=True, text=True, check=False)


@pytest.mark.parametrize(
    ("name", "found"),
    [
        ("", "False 0.005 True True\n"),
        ("collector", "True 0.005 True True\n"),
        ("switch-interval", "False 0.0001 True True\n"),
        ("shortcut,collector", "True 0.005 True True\n"),
        ("memory-kept", "False 0.005 False True\n"),
        pytest.param(
            "denormals",
            "False 0.005 True False\n",
            marks=pytest.mark.skipif(platform.machine() != "x86_64", reason="of x86-64"),
        ),
    ],
)
def test_a_patch_is_in_force_in_a_process(name: str, found: str) -> None:
    done = seen(name)
    assert done.stdout == found, done.stderr


def test_a_process_that_cannot_be_changed_does_not_run() -> None:
    done = seen("nonsense")
    assert (done.returncode, done.stdout) == (1, "")
    assert "there is no patch 'nonsense'" in done.stderr


KEPT = Change("kept", "a thing kept", kept=True, often=True)
LEFT = Change("left", "a thing left", kept=False, why="it is odd")
BROKEN = Change("broken", "a thing refused", kept=False, often=True)
BY_BUS = Change("by-bus", "a thing of the bus", kept=True, often=True, loop=Loop.BY_BUS)


def test_every_change_runs_between_two_of_its_loop_as_that_is() -> None:
    order: list[str] = []

    def travel(change: Change | None, loop: Loop) -> Mapping[str, Any]:
        order.append(("" if change is None else change.name) + "+" * (loop is Loop.BY_BUS))
        return {"refused": "no"} if change is BROKEN else figures(100.0)

    tried = measure.in_turns([KEPT, LEFT, BROKEN, BY_BUS], measure.SELDOM + 1, travel)
    turn = ["", "kept", "", "left", "", "+", "by-bus+", "+"]
    assert order == [
        "",
        "kept",
        "",
        "left",
        "",
        "broken",
        "",
        "+",
        "by-bus+",
        "+",
        *turn[:],
        *turn[:],
        *turn[:3],
        *turn[5:],
    ]
    assert [len(one.runs) for one in tried] == [4, 3, 0, 4]
    assert tried[2].refused == "no"
    with pytest.raises(trip.TripError, match="as it is does not run: dead"):
        measure.in_turns([KEPT], 1, lambda *_: {"refused": "dead"})


def test_before_is_without_a_change_and_after_with_it() -> None:
    runs: list[Mapping[str, Any]] = [figures(200.0, 7, wakeup=80.0), figures(300.0, 0, wakeup=90.0)]
    neighbours: list[tuple[Mapping[str, Any], Mapping[str, Any]]] = [
        (figures(90.0, wakeup=20.0), figures(110.0, wakeup=22.0)),
        (figures(150.0, wakeup=24.0),) * 2,
    ]
    kept = measure.figures(measure.Tried(KEPT, runs, neighbours))
    left = measure.figures(measure.Tried(LEFT, runs, neighbours))
    assert kept["ratio"]["p50"] == {"median": 0.5, "lowest": 0.5, "highest": 0.5}
    assert left["ratio"]["p99"] == {"median": 2.0, "lowest": 2.0, "highest": 2.0}
    assert kept["before"] == left["after"]
    assert kept["before"]["p50"] == {"median": 250.0, "lowest": 200.0, "highest": 300.0}
    assert kept["after"]["p99"] == {"median": 260.0, "lowest": 180.0, "highest": 300.0}
    assert kept["frames_without_command"] == {"before": 7, "after": 0}
    assert kept["frames"] == {"before": 2000, "after": 4000}
    assert kept["stages_us"] == {"before": {"wakeup": 85.0}, "after": {"wakeup": 23.0}}
    refused = measure.figures(measure.Tried(BROKEN, refused="zenoh says no"))
    headings, *lines = table.road({"changes": [kept, left, refused]})
    assert lines[0][1:3] == ("250 (200 to 300)", "130 (90 to 150)")
    assert lines[0][5:] == ("0.50 (0.50 to 0.50)",) * 3 + ("7 of 2000 / 0 of 4000", "wakeup -62 us", "yes", "")
    assert lines[1][-1] == "it is odd; worse p50, worse p99, worse p50 to the mirror"
    assert lines[2][-2:] == ("no", "it does not run: zenoh says no")
    assert {len(line) for line in lines} == {len(table.HEADINGS)}
    assert cells.markdown([headings, *lines]).count("\n") == 4
    assert "zenoh says no" in cells.text([headings, *lines])
    by_bus = measure.figures(measure.Tried(BY_BUS, runs, neighbours))
    assert [line[0] for line in table.road({"changes": [kept, by_bus]})][1:] == [
        "a thing kept",
        "a thing of the bus (by the bus alone)",
    ]


def test_how_many_times_the_set_up_lowers_what() -> None:
    runs: dict[tuple[bool, bool], list[dict[str, Any]]] = {
        (load, plain): [
            figures(p50 * (1 + 3 * plain)) | ({"load_share": 0.5} if load else {}) for p50 in (100.0, 200.0)
        ]
        for load, plain in loaded.KINDS
    }
    found = loaded.figures(runs)
    assert found["lowered"]["loaded"]["p99_9"] == {"median": 4.0, "lowest": 4.0, "highest": 4.0}
    _, *lines = table.loaded(found)
    assert [line[:3] for line in lines[:2]] == [
        ("yes", "with", "150 (100 to 200)"),
        ("yes", "without", "600 (400 to 800)"),
    ]
    assert {len(line) for line in lines} == {len(table.LOADED_HEADINGS)}
    assert "loaded: p50 4.00 (4.00 to 4.00)" in table.ratios(found)
    about = {"settings": {"seconds": 1, "repeats": 2, "rate_hz": 1000.0}, "date": "2026-01-01", "command": "it"}
    host = {
        "host": dict.fromkeys(("processor", "processors", "kernel", "clock_source", "python", "load_before"), "this")
    }
    assert "it took 50 % of the processors" in report.loaded_markdown(found | about | host)
    assert "Granted by the host: all." in report.road_markdown({"changes": [], "granted": ["all"]} | about | host)


def test_the_load_loads() -> None:
    with background(1) as load:
        folder = load._children[0].said.parent
        written, begun_s, deadline_s = folder / "written-0", load.used_s(), time.monotonic() + 20
        missing = {"processor time", "file"}
        while missing and time.monotonic() < deadline_s:
            time.sleep(0.01)
            if load.used_s() - begun_s > 0.2:
                missing.discard("processor time")
            if written.exists() and written.stat().st_size == 4 << 20:
                missing.discard("file")
        assert not missing
        processes = [child.process for child in load._children]
    assert all(process is not None and process.poll() is not None for process in processes)
    assert not folder.exists()


def test_a_load_that_ends_is_noticed() -> None:
    with background(1) as load:
        process = load._children[0].process
        assert process is not None
        process.kill()
        process.wait()
        with pytest.raises(RuntimeError, match="memory 0 was killed by SIGKILL"):
            load.used_s()


def test_what_is_in_the_document_is_the_whole_road() -> None:
    measured = json.loads(measure_speed.MEASURED.read_text())
    if "road" in measured:
        assert [one["name"] for one in measured["road"]["changes"]] == list(BY_NAME)
    for name in measured.keys() & {"road", "loaded"}:
        words, _ = measure_speed.BENCHES[name]
        assert measured[name]["command"] == f"python -m {' '.join(words)} --json"


def test_without_the_set_up_nothing_of_it_is_left() -> None:
    assert callable(latency_run._loop)
    plain = settings(plain=True).realtime
    left = [plain.priority, plain.lock_memory, plain.stay_awake, plain.controller_cpus, plain.mirror_cpus]
    assert not any(left)


@pytest.mark.slow
def test_the_road_for_real() -> None:
    words = [
        sys.executable,
        "-m",
        "benchmarks.road",
        "--seconds",
        "0.5",
        "--repeats",
        "1",
        "--only",
        "fifo",
        "memoryview",
    ]
    done = subprocess.run([*words, "--json"], cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    fifo, view = json.loads(done.stdout)["changes"]
    assert fifo["frames"]["before"] >= 400
    assert fifo["before"]["p50"]["median"] > 0
    assert "memoryview" in view["refused"]
