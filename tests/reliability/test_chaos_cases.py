"""Chaos cases in one process and in simulated time, judged by the same rules as with real processes."""

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest

from lowfc.client import client
from lowfc.programs.reliability.chaos import bench, case, console, control, junk, processes
from lowfc.programs.reliability.chaos.cases import CASES
from lowfc.programs.reliability.chaos.command import run_case
from tests.reliability.toy_bench import TOY_KEYS, ToyBench

CONTROL = (
    *("gain", "law-that-fails", "interlock", "safed-restart", "safe-without-directory"),
    *("reversed-calibration", "foreign-calibration", "damaged-calibration"),
)
JUNK = ("junk", "forged-commands", "forged-frames", "malformed-requests", "concurrent-requests")


@pytest.fixture
def in_simulated_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace every bench by a `ToyBench`, in whose simulated time cases wait and intruders send."""

    def new_bench(*arguments: Any) -> ToyBench:
        toy_bench = ToyBench(*arguments)
        for module in (control, junk, processes, console):
            toy_bench.replace_time(module, monkeypatch.setattr)
        for module in (client, junk, console):
            monkeypatch.setattr(module, "HostClock", lambda: toy_bench.clock)
        monkeypatch.setattr(junk, "ZenohBus", lambda _, role, __: toy_bench.connection(role))
        return toy_bench

    monkeypatch.setattr(bench, "ChaosBench", new_bench)
    monkeypatch.setattr(case, "HOLD_FRAMES", 100)
    monkeypatch.setattr(control, "HOLD_FRAMES", 100)
    monkeypatch.setattr(junk, "FLOOD_S", 0.3)
    monkeypatch.setattr(junk, "FORGED_MESSAGES", 60)
    monkeypatch.setattr(control, "FLOOD_VALUES", 600)


@pytest.mark.usefixtures("in_simulated_time")
@pytest.mark.parametrize("name", [*CONTROL, *JUNK])
def test_the_loop_withstands_a_case(name: str, tmp_path: Path) -> None:
    row = run_case(replace(CASES[name], config=dict(CASES[name].config) | TOY_KEYS), 2, tmp_path)
    assert row["passed"], row["findings"]


@pytest.mark.usefixtures("in_simulated_time")
def test_a_console_is_measured_in_every_phase(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    process = Mock()
    shown = nullcontext(SimpleNamespace(process=process, start_s=0.5, cpu_s=lambda: 2.0))
    monkeypatch.setattr(console, "TerminalConsole", lambda run: shown)
    monkeypatch.setattr(console, "PHASE_S", 0.3)
    monkeypatch.setattr(processes, "_SETTLE_S", 0.1)
    row = run_case(replace(CASES["console"], config=TOY_KEYS), 2, tmp_path)
    assert row["passed"], row["findings"]
    phases = ("without", "open", "flooded", "flooded and frozen", "frozen", "killed", "flood without")
    assert tuple(row["figures"]["frame_to_command"]) == phases
    assert row["figures"]["console"] == {"start_s": 0.5, "share": 0.0}
    assert [call[0] for call in process.method_calls] == ["send_signal", "kill"]
