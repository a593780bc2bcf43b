"""Republishing a log with gaps and wrong times, on a bus in memory."""

import io
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console

from lowfc.adapters.bus.run import Run
from lowfc.adapters.process.clock import HostClock
from lowfc.contract.messages import STEP
from lowfc.programs.logs.publish.player import Player, render
from lowfc.programs.logs.publish.selection import PublishedKeys
from lowfc.testing.memory_bus import MemoryBus, MemoryHub
from tests.support.report_log import SyntheticLog
from tests.support.toy import START

STEPS = 5


def published(run: Run, path: Path, last_ns: int) -> tuple[dict[str, Any], str]:
    """Publish a log whose last step has the log time `last_ns`, until a wait is announced; return results and text."""
    night = SyntheticLog().frames(STEPS)
    night.samples = [night.samples[index] for index in night.indices(STEP)]
    night.samples[-1] = night.samples[-1]._replace(receive_time_ns=last_ns)
    text, clock = io.StringIO(), HostClock()
    service = SimpleNamespace(running=True, clock=clock)
    service.beat = lambda: setattr(service, "running", "Ctrl-C" not in text.getvalue())
    buses, console = {"controller": MemoryBus(MemoryHub(), "controller", clock)}, Console(file=text, width=200)
    player = Player(service, buses, PublishedKeys(run.links, [STEP.key], ()), 1.0, console)
    return player.play([night.write(path)]), text.getvalue()


@pytest.mark.parametrize("last_ns", [1 << 63, (1 << 64) - 1])
def test_a_message_of_an_impossible_time_is_not_waited_for(run: Run, tmp_path: Path, last_ns: int) -> None:
    results, text = published(run, tmp_path / "x.mcap", last_ns)
    assert (results["messages"], results["messages_of_impossible_time"], text) == (STEPS - 1, 1, "")
    assert "left out           1 message with a log time after the year 2262" in render({"run": run.run_id, **results})


def test_a_long_gap_in_a_log_is_announced(run: Run, tmp_path: Path) -> None:
    results, text = published(run, tmp_path / "x.mcap", (START + 3600) * 10**9)
    assert re.fullmatch(
        r"the next message, of 2023-11-14 23:13:20.0Z, follows in 3600 s; Ctrl-C ends the publication\n", text
    )
    assert (results["messages"], results["interrupted"]) == (STEPS - 1, True)
