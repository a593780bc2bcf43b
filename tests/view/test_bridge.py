"""The bridge: it draws what the bus says, mends what goes wrong, and holds nobody up."""

import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from loops import until
from report_log import Night
from tape import Tape

from lowfc.adapters.bus import name_in
from lowfc.adapters.clock import HostClock
from lowfc.adapters.rerun_viewer import Show
from lowfc.contract.configuration import Configuration
from lowfc.contract.messages import CALIBRATION, EVENT, FRAME, HEALTH, STEP, Log, topic_of, wire
from lowfc.programs.view import bridge as bridges
from lowfc.programs.view import brush as brushes
from lowfc.programs.view import wavefront
from lowfc.programs.view.bridge import Bridge, Summary, ViewError
from lowfc.programs.view.brush import Brush
from lowfc.programs.view.moment import Moment
from lowfc.testing.memory_bus import MemoryBus, MemoryHub

PATIENCE_S = 10.0


@dataclass
class Screen:
    """In place of the viewer's process."""

    show: Show
    alive: bool = True
    held_bytes: int = 0
    stopped: threading.Event = field(default_factory=threading.Event)
    holds_up: threading.Event = field(default_factory=threading.Event)

    def resident_bytes(self) -> int:
        return self.held_bytes

    def answers(self) -> bool:
        return not self.stopped.is_set()

    def how_it_ended(self) -> str:
        return "the viewer was killed"

    def stop(self) -> None:
        self.alive = False
        self.stopped.set()


class Stuck(Tape):
    """A stream into a viewer that takes nothing until it is stopped."""

    def __init__(self, screen: Screen) -> None:
        super().__init__()
        self.screen = screen

    def log(self, path: str, *archetypes: Any, static: bool = False) -> None:
        if not static:
            self.screen.holds_up.set()
            self.screen.stopped.wait(PATIENCE_S)
        super().log(path, *archetypes, static=static)


class Scene:
    """A bridge on a bus in memory, running in a thread, and a run that was there before it."""

    def __init__(self, show: Show = Show.WEB, stuck: int = 0) -> None:
        self.hub, self.clock = MemoryHub(), HostClock()
        self.night = Night()
        self.night.frames(50)
        self.events: list[str] = []
        self.source = MemoryBus(self.hub, "controller", self.clock)
        self.source.subscribe(EVENT, lambda sample: self.events.append(Log.FromString(sample.payload).message))
        self.publishers = {
            sample.key: self.source.publisher(topic_of(sample.key), name_in(topic_of(sample.key), sample.key))
            for sample in self.night.samples
        }
        self.say()
        self.screens: list[Screen] = []
        self.tapes: list[Tape] = []
        self.stuck = stuck
        self.show = show
        self.bridge = Bridge(
            Configuration(),
            "night",
            self.clock,
            MemoryBus(self.hub, "viewer", self.clock),
            self._screen,  # type: ignore[arg-type]  # stands for the real one
            self._tape,  # type: ignore[arg-type,return-value]
            100_000_000,
        )
        self.summary: Summary | None = None
        self.failure: Exception | None = None
        self.thread = threading.Thread(target=self._run, daemon=True)
        self.thread.start()

    def say(self) -> None:
        """Send the run's messages."""
        for sample in self.night.samples:
            self.publishers[sample.key].put(sample.payload)

    def drawn(self, number: int) -> bool:
        """Whether the newest view shows steps with their calibration, and is the so-manieth."""
        return len(self.tapes) == number and wavefront.ERROR in self.tapes[-1].rows

    def end(self) -> None:
        self.bridge.service.stop("told")
        self.thread.join(PATIENCE_S)
        self.bridge.close()
        assert not self.thread.is_alive()

    def _screen(self) -> Screen:
        self.screens.append(Screen(self.show))
        return self.screens[-1]

    def _tape(self, screen: Screen) -> Tape:
        self.tapes.append(Stuck(screen) if len(self.tapes) < self.stuck else Tape())
        return self.tapes[-1]

    def _run(self) -> None:
        try:
            self.summary = self.bridge.run()
        except Exception as failure:
            self.failure = failure


@pytest.fixture(autouse=True)
def _quickly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bridges, "_LOOK_S", 0.05)
    monkeypatch.setattr(bridges, "_TURN_S", 0.02)
    monkeypatch.setattr(bridges, "resident_bytes", lambda: 0)  # that of all tests in this process is no view's


@pytest.fixture
def scene() -> Iterator[Scene]:
    made = Scene()
    until(lambda: made.tapes)
    yield made
    made.end()


def test_who_comes_late_asks_for_the_calibration(scene: Scene) -> None:
    assert topic_of(CALIBRATION.key).queryable
    scene.publishers[STEP.key].put(next(one.payload for one in scene.night.samples if one.key == STEP.key))
    until(lambda: scene.drawn(1))


def test_who_comes_late_shows_the_events_from_before_once(tmp_path: Path) -> None:
    before = Night()
    before.event("NOTE", text="before the view")
    log = before.write(tmp_path / "night.mcap", finish=False)
    scene = Scene()
    recording = wire.Recording(files=[str(tmp_path / "night.mcap")], folder="/")
    health = wire.Health(process="recorder", state="running", pid=5, recording=recording)
    MemoryBus(scene.hub, "recorder", scene.clock).publisher(HEALTH, "recorder").put(health.SerializeToString())

    def notes() -> list[str]:
        lines = [line for tape in scene.tapes for _, (line,) in list(tape.logged["log/controller"])]
        return [text for text in (str(line.text.as_arrow_array().to_pylist()[0]) for line in lines) if "NOTE" in text]

    until(notes)
    assert len(notes()) == 1
    assert log.name.endswith(".part")
    scene.end()


def test_without_a_recorder_the_view_says_that_it_does_not_know(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bridges, "_RECORDER_S", 0.1)
    scene = Scene()
    until(lambda: scene.tapes and scene.tapes[0].logged["log/view"])
    scene.end()


def test_a_viewer_that_died_is_started_again_and_shows_everything(scene: Scene) -> None:
    scene.say()
    until(lambda: scene.drawn(1))
    scene.screens[0].alive = False
    until(lambda: len(scene.tapes) == 2)
    scene.say()
    until(lambda: scene.drawn(2))
    assert any("VIEW_RENEWED" in event and "killed" in event for event in scene.events)


def test_a_window_that_was_closed_ends_the_view() -> None:
    scene = Scene(Show.NATIVE)
    until(lambda: scene.tapes)
    scene.screens[0].alive = False
    scene.thread.join(PATIENCE_S)
    assert scene.summary is not None
    assert scene.summary.renewals == 0
    scene.end()


def test_a_server_that_takes_nothing_is_started_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bridges, "STUCK_S", 0.3)
    scene = Scene(Show.WEB, stuck=1)
    scene.say()
    until(lambda: len(scene.tapes) == 2)
    assert scene.screens[0].stopped.is_set()
    scene.say()
    until(lambda: scene.drawn(2))
    scene.end()


def test_a_window_that_takes_nothing_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bridges, "STUCK_S", 0.3)
    scene = Scene(Show.NATIVE, stuck=1)
    scene.say()
    until(lambda: any("VIEW_STUCK" in event for event in scene.events))
    time.sleep(0.4)
    assert sum("VIEW_STUCK" in event for event in scene.events) == 1
    assert len(scene.screens) == 1
    scene.screens[0].stopped.set()
    until(lambda: scene.drawn(1))
    scene.end()


def test_memory_of_the_viewer_is_watched(scene: Scene) -> None:
    scene.screens[0].held_bytes = 100_000_000 + bridges.VIEWER_SPARE_BYTES - 1
    time.sleep(0.3)
    assert len(scene.screens) == 1
    scene.screens[0].held_bytes += 2
    until(lambda: len(scene.screens) == 2)


def test_memory_of_the_bridge_is_watched(monkeypatch: pytest.MonkeyPatch, scene: Scene) -> None:
    held = [bridges.OWN_BYTES + 1, 0]
    monkeypatch.setattr(bridges, "resident_bytes", lambda: held.pop(0) if held else 0)
    until(lambda: len(scene.screens) == 2)
    assert scene.screens[0].stopped.is_set()
    assert scene.failure is None


def test_memory_that_stays_ends_the_view(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene()
    until(lambda: scene.tapes)
    monkeypatch.setattr(bridges, "resident_bytes", lambda: bridges.OWN_BYTES + 1)
    scene.thread.join(PATIENCE_S)
    assert isinstance(scene.failure, ViewError)
    scene.end()


def test_a_view_that_fails_again_and_again_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene()
    monkeypatch.setattr(Screen, "alive", property(lambda self: False, lambda self, value: None))
    scene.thread.join(PATIENCE_S)
    assert isinstance(scene.failure, ViewError)
    assert "5 times" in str(scene.failure)
    scene.end()


def test_a_viewer_that_is_stuck_costs_bounded_memory_and_no_publisher() -> None:
    scene = Scene(Show.NATIVE, stuck=1)
    until(lambda: scene.screens and scene.screens[0].holds_up.is_set())
    for _ in range(100):
        scene.say()
    waiting = {topic: len(ring.waiting) for topic, ring in scene.bridge._rings.items()}  # type: ignore[attr-defined]
    assert waiting[STEP] == bridges.WAITING[STEP]
    assert waiting[FRAME] == 1
    assert all(count <= bridges.WAITING[topic] for topic, count in waiting.items())
    scene.screens[0].stopped.set()
    scene.end()


@pytest.mark.parametrize(("pause_s", "every_one"), [(0.3, True), (0.0, False)])
def test_rows_are_taken_by_time_however_slow_the_drawing_is(
    monkeypatch: pytest.MonkeyPatch, pause_s: float, every_one: bool
) -> None:
    whole: list[bool] = []

    class Drawn:
        def __init__(self, *_: object) -> None:
            pass

        def draw(self, moment: Moment) -> None:
            whole.append(moment.whole)
            time.sleep(pause_s)

    class Stream(Tape):
        def disconnect(self) -> None:
            pass

    monkeypatch.setattr(brushes, "Painter", Drawn)
    brush = Brush(Configuration(), HostClock(), {}, Stream)
    brush.start()
    until(lambda: len(whole) >= 4)
    brush.abandon()
    brush.join()
    assert brush.fault is None
    assert all(whole) == every_one
    assert whole[0]
