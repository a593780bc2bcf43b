"""Late commands: reported when they become a habit, however late in a run, and when they no longer are."""

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from lowfc.adapters.process.service import Service
from lowfc.contract.configuration import Configuration
from lowfc.contract.messages import EVENT, MIRROR_STATE, Log, wire
from lowfc.testing.clock import FakeClock
from lowfc.testing.memory_bus import MemoryBus, MemoryHub
from sim_camera.bench import Bench
from sim_camera.lateness import WINDOW, Lateness
from sim_camera.process import CameraProcess


@pytest.mark.parametrize("before", [0, 1, WINDOW, 3 * WINDOW + 7])
def test_a_quarter_of_a_window_is_a_habit_and_an_eighth_is_none(before: int) -> None:
    lateness = Lateness()
    assert not any(lateness.add(False) for _ in range(before))
    changes = [lateness.add(True) for _ in range(WINDOW)]
    assert changes.index(True) == WINDOW // 4
    assert sum(changes) == 1
    assert lateness.percent == 100
    changes = [lateness.add(False) for _ in range(WINDOW)]
    assert changes.index(True) == WINDOW - WINDOW // 8 - 1
    assert (sum(changes), lateness.habitual, lateness.percent, lateness.total) == (1, False, 0, WINDOW)


def test_a_few_late_commands_are_no_habit() -> None:
    lateness = Lateness()
    assert not any(lateness.add(number % 5 == 0) for number in range(10 * WINDOW))
    assert lateness.percent == 20


def test_the_camera_reports_the_habit_each_time() -> None:
    hub, clock, config = MemoryHub(), FakeClock(), Configuration()
    events: list[str] = []
    MemoryBus(hub, "operator", clock).subscribe(
        EVENT, lambda sample: events.append(Log.FromString(sample.payload).message)
    )
    service = Service("camera", "night", clock, MemoryBus(hub, "camera", clock))
    camera = CameraProcess(config, service, cast("Bench", SimpleNamespace(shape=(80, 80))), None)
    states = MemoryBus(hub, "mirror-dm", clock).publisher(MIRROR_STATE, config.mirror.name)
    shape = np.zeros((config.mirror.rows, config.mirror.columns), np.float32)
    sequence = 0
    for late in (False, True, False, True):
        for _ in range(2 * WINDOW):
            sequence += 1
            camera._last_frame = sequence + late
            states.put(
                wire.MirrorState(
                    frame_sequence=sequence, rows=shape.shape[0], columns=shape.shape[1], actuators=shape.tobytes()
                ).SerializeToString()
            )
            camera._drain()
    said = [event.split()[0] for event in events if event.startswith("COMMANDS_")]
    assert said == ["COMMANDS_LATE", "COMMANDS_IN_TIME", "COMMANDS_LATE"]
    assert camera._lateness.total == 4 * WINDOW
