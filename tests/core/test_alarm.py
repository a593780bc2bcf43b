"""The command of `recorder.on_event`: events that trigger it, its environment, and its minimum interval."""

import contextlib
import os
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from lowfc.adapters.process.clock import HostClock
from lowfc.contract.events import Level
from lowfc.programs.core.recording import alarm as alarms
from lowfc.programs.core.recording.alarm import Alarm
from lowfc.testing.listener import Listener
from tests.support.loops import until

# Shell command that appends a line about the event to the file `notes`.
NOTE = 'printf "%s\\n" "$LOWFC_RUN|$LOWFC_LEVEL|$LOWFC_PROCESS|$LOWFC_EVENT|$LOWFC_TEXT|$LOWFC_OTHERS" >> notes; '


class AlarmBench:
    """A camera that publishes events, and a recorder with an alarm."""

    def __init__(self, command: str, min_interval_s: float = 0.0) -> None:
        self.listener = Listener(HostClock())
        self.camera = self.listener.service("camera")
        self.alarm = Alarm(self.listener.service("recorder"), command, Level.WARNING, min_interval_s)

    def failures(self) -> list[str]:
        return self.listener.event_texts("ON_EVENT_FAILED")


def test_events_while_the_command_runs_cause_one_more_run_for_the_most_severe(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    run = AlarmBench(NOTE + "until test -e go; do sleep 0.01; done")
    run.camera.event("MIRROR_BACK")
    run.camera.event("MIRROR_REFUSED", why="it is\n`touch harm`")
    notes = Path("notes")
    until(notes.exists)
    run.camera.event("CAMERA_RESTARTED")
    run.camera.event("MIRROR_LOST", fault="is silent")
    run.camera.event("CAMERA_RESTARTED")
    Path("go").touch()
    until(lambda: notes.read_text().count("\n") == 2)
    first, second = notes.read_text().splitlines()
    assert first.startswith("test|warning|camera|MIRROR_REFUSED|the mirror's shape is not adopted: it is")
    assert first.endswith("`touch harm`|0")
    assert second.startswith("test|error|camera|MIRROR_LOST|the mirror is silent")
    assert second.endswith("|2")
    assert {path.name for path in tmp_path.iterdir()} == {"notes", "go"}, "text of an event is not run by the shell"
    assert not run.failures()


def real_time() -> None:
    """Give this thread the real-time class, as a recorder may have it, if the host permits it."""
    with contextlib.suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))


def test_the_command_leaves_the_real_time_class_and_runs_at_most_once_per_interval(tmp_path: Path) -> None:
    notes = tmp_path / "notes"  # absolute: by the second run another test may have changed the working directory
    with ThreadPoolExecutor(1, initializer=real_time) as recorder:
        run = recorder.submit(AlarmBench, f"chrt -p $$ >> {notes}; nice >> {notes}", min_interval_s=60.0).result()
        permitted = recorder.submit(os.sched_getscheduler, 0).result() == os.SCHED_RR
    run.camera.event("CAMERA_RESTARTED")
    until(lambda: notes.exists() and len(notes.read_text().splitlines()) == 3)
    run.camera.event("CAMERA_RESTARTED")
    time.sleep(0.2)  # a second run would append to the file
    lines = notes.read_text().splitlines()
    assert len(lines) == 3
    idle = os.sched_getscheduler(0) == os.SCHED_IDLE and not permitted
    assert ("SCHED_IDLE" if idle else "SCHED_OTHER") in lines[0]
    assert lines[2] == str(min(os.nice(0) + 5, 19)), "the niceness of the alarm's thread, not of the recorder"
    run.alarm.close()
    assert len(notes.read_text().splitlines()) == 6, "the waiting event runs the command when the recorder ends"


def test_a_command_that_fails_or_hangs_raises_an_event_that_does_not_run_it_again(monkeypatch) -> None:
    monkeypatch.setattr(alarms, "TIMEOUT_S", 0.2)
    run = AlarmBench("if test $LOWFC_EVENT = MIRROR_LOST; then sleep 100; fi; exit 3")
    run.camera.event("CAMERA_RESTARTED")
    until(run.failures)
    run.camera.event("MIRROR_LOST", fault="is silent")
    until(lambda: len(run.failures()) == 2)
    assert [event.partition("failed: ")[2] for event in run.failures()] == [
        "it ended with exit status 3",
        "it was killed after 0.2 s",
    ]
