"""The command of `recorder.on_event`: which events it is run for, what it is told, and how often."""

import os
from pathlib import Path

from lowfc.adapters.process.clock import HostClock
from lowfc.adapters.process.service import Service
from lowfc.contract.events import Level
from lowfc.contract.messages import EVENT, Log
from lowfc.programs.core.recording import alarm as alarms
from lowfc.programs.core.recording.alarm import Alarm
from lowfc.testing.memory_bus import MemoryBus, MemoryHub
from tests.support.loops import until

TELL = 'printf "%s\\n" "$LOWFC_RUN|$LOWFC_LEVEL|$LOWFC_PROCESS|$LOWFC_EVENT|$LOWFC_TEXT|$LOWFC_OTHERS" >> told; '


class Night:
    """A camera that has events, and a recorder with an alarm."""

    def __init__(self, command: str, every_s: float = 0.0) -> None:
        hub, clock = MemoryHub(), HostClock()
        self.camera, self.recorder = (
            Service(name, "night", clock, MemoryBus(hub, name, clock)) for name in ("camera", "recorder")
        )
        self.events: list[str] = []
        self.camera.bus.subscribe(EVENT, lambda sample: self.events.append(Log.FromString(sample.payload).message))
        Alarm(self.recorder, command, Level.WARNING, every_s)

    def failures(self) -> list[str]:
        return [event for event in self.events if event.startswith("ON_EVENT_FAILED")]


def test_the_command_is_told_the_worst_of_what_happened_while_it_ran(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    night = Night(TELL + "until test -e go; do sleep 0.01; done")
    night.camera.event("MIRROR_BACK")
    night.camera.event("MIRROR_REFUSED", why="it is\n`touch harm`")
    told = Path("told")
    until(told.exists)
    night.camera.event("CAMERA_RESTARTED")
    night.camera.event("MIRROR_LOST", fault="is silent")
    night.camera.event("CAMERA_RESTARTED")
    Path("go").touch()
    until(lambda: told.read_text().count("\n") == 2)
    first, second = told.read_text().splitlines()
    assert first.startswith("night|warning|camera|MIRROR_REFUSED|the mirror's shape is not adopted: it is")
    assert first.endswith("`touch harm`|0")
    assert second.startswith("night|error|camera|MIRROR_LOST|the mirror is silent")
    assert second.endswith("|2")
    assert {path.name for path in tmp_path.iterdir()} == {"told", "go"}
    assert not night.failures()


def test_it_is_run_in_the_normal_class_and_not_again_at_once(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    night = Night("chrt -p $$ > told; nice >> told", every_s=60.0)
    for _ in range(3):
        night.camera.event("CAMERA_RESTARTED")
    until(lambda: Path("told").exists() and len(Path("told").read_text().splitlines()) == 3)
    said = Path("told").read_text()
    assert "SCHED_OTHER" in said
    assert said.splitlines()[-1] == str(os.nice(0) + 5), "and the thread's own, not the recorder's"


def test_a_command_that_fails_or_hangs_is_an_event_that_calls_for_no_other(monkeypatch) -> None:
    monkeypatch.setattr(alarms, "PATIENCE_S", 0.2)
    night = Night("if test $LOWFC_EVENT = MIRROR_LOST; then sleep 100; fi; exit 3")
    night.camera.event("CAMERA_RESTARTED")
    until(night.failures)
    night.camera.event("MIRROR_LOST", fault="is silent")
    until(lambda: len(night.failures()) == 2)
    assert [event.partition("failed: ")[2] for event in night.failures()] == [
        "it ended with exit status 3",
        "it was killed after 0.2 s",
    ]
