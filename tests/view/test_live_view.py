"""The live view draws the messages of the bus, restarts failed viewers, and keeps its memory bounded."""

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from lowfc.adapters.bus.bus import name_in
from lowfc.adapters.process.clock import HostClock
from lowfc.adapters.viewer.rerun_viewer import Show
from lowfc.contract.configuration import Configuration
from lowfc.contract.messages import CALIBRATION, FRAME, HEALTH, STEP, topic_of, wire
from lowfc.programs.view import live_view
from lowfc.programs.view import renderer as render_threads
from lowfc.programs.view.live_view import LiveView, ViewError
from lowfc.programs.view.panels import wavefront
from lowfc.programs.view.renderer import RenderThread
from lowfc.programs.view.snapshot import Snapshot
from lowfc.testing.listener import Listener
from lowfc.testing.memory_bus import MemoryBus
from tests.support.loops import until
from tests.support.report_log import SyntheticLog
from tests.support.stage import Tape

PATIENCE_S = 10.0


class FakeViewer:
    """Stand-in for the viewer's process and the stream to it, which blocks while the viewer hangs."""

    def __init__(self, show: Show | None, hangs: bool) -> None:
        self.show, self.hangs, self.alive, self.memory_bytes = show, hangs, True, 0
        self.stopped, self.blocked = threading.Event(), threading.Event()
        self.tape = Tape()
        self._log = self.tape.log
        self.tape.log = self.log

    def log(self, path: str, *archetypes: Any, static: bool = False) -> None:
        if self.hangs and not static:
            self.blocked.set()
            self.stopped.wait(PATIENCE_S)
        self._log(path, *archetypes, static=static)

    def resident_bytes(self) -> int:
        return self.memory_bytes

    def answers(self) -> bool:
        return not self.stopped.is_set()

    def exit_description(self) -> str:
        return "the viewer was killed"

    def stop(self) -> None:
        self.alive = False
        self.stopped.set()


class ViewBench(Listener):
    """A live view in a thread, of a run that started before it on a memory bus; the first `stuck` viewers hang."""

    memory_mb = 100.0

    def __init__(self, show: Show | None = Show.WEB, stuck: int = 0) -> None:
        super().__init__(HostClock())
        self.night = SyntheticLog().frames(50)
        source = MemoryBus(self.hub, "controller", self.clock)
        self.publishers = {
            sample.key: source.publisher(topic_of(sample.key), name_in(topic_of(sample.key), sample.key))
            for sample in self.night.samples
        }
        self.publish()
        self.viewers: list[FakeViewer] = []
        self.show, self.stuck = show, stuck
        self.view = LiveView(Configuration(), "night", self.clock, MemoryBus(self.hub, "viewer", self.clock), self)
        self.failure: Exception | None = None
        self.thread = threading.Thread(target=self._run, daemon=True)
        self.thread.start()
        until(lambda: self.viewers)

    def viewer(self) -> FakeViewer | None:
        """Stand-in for `Target.viewer`."""
        self.viewers.append(FakeViewer(self.show, len(self.viewers) < self.stuck))
        return self.viewers[-1] if self.show is not None else None

    def stream(self, viewer: FakeViewer | None, recording: str, window_s: float) -> Tape:
        """Stand-in for `Target.stream`."""
        return self.viewers[-1].tape

    def publish(self) -> None:
        for sample in self.night.samples:
            self.publishers[sample.key].put(sample.payload)

    def drawn(self, number: int) -> bool:
        """Whether there are this many viewers, and the newest one has drawn modal errors of steps."""
        return len(self.viewers) == number and wavefront.ERROR.path in self.viewers[-1].tape.rows

    def end(self) -> None:
        self.view.service.stop("the test is over")
        self.thread.join(PATIENCE_S)
        self.view.close()
        assert not self.thread.is_alive()

    def _run(self) -> None:
        try:
            self.view.run()
        except Exception as failure:
            self.failure = failure


@pytest.fixture(autouse=True)
def _short_periods(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_view, "_CHECK_S", 0.05)
    monkeypatch.setattr(live_view, "_POLL_S", 0.02)
    monkeypatch.setattr(render_threads, "PICTURES_HZ", 100.0)
    monkeypatch.setattr(live_view, "resident_bytes", lambda: 0)  # the memory of the test process is not that of a view


ViewBenches = Callable[..., ViewBench]


@pytest.fixture
def benches() -> Iterator[ViewBenches]:
    with contextlib.ExitStack() as stack:

        def make(*arguments: Any, **options: Any) -> ViewBench:
            bench = ViewBench(*arguments, **options)
            stack.callback(bench.end)
            return bench

        yield make


def failure_of(bench: ViewBench) -> str:
    """Wait until the view fails; return its error."""
    bench.thread.join(PATIENCE_S)
    assert isinstance(bench.failure, ViewError)
    return str(bench.failure)


def test_a_late_view_requests_the_calibration(benches: ViewBenches) -> None:
    assert CALIBRATION.queryable
    bench = benches()
    step = next(one.payload for one in bench.night.samples if one.key == STEP.key)
    # repeatedly: steps before the calibration are not drawn
    until(lambda: bench.drawn(1), each=lambda: bench.publishers[STEP.key].put(step))


def test_a_late_view_shows_earlier_events_once(benches: ViewBenches, tmp_path: Path) -> None:
    earlier = SyntheticLog()
    earlier.event("NOTE", text="before the view")
    assert earlier.write(tmp_path / "night.mcap", finish=False).name.endswith(".part")
    bench = benches()
    recording = wire.Recording(files=[str(tmp_path / "night.mcap")], folder="/")
    health = wire.Health(process="recorder", state="running", pid=5, recording=recording)
    MemoryBus(bench.hub, "recorder", bench.clock).publisher(HEALTH, "recorder").put(health.SerializeToString())

    def notes() -> list[str]:
        return [text for viewer in bench.viewers for text in viewer.tape.texts("log/controller") if "NOTE" in text]

    until(notes)
    assert len(notes()) == 1


def test_without_a_recorder_a_line_reports_that_earlier_events_are_missing(
    benches: ViewBenches, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live_view, "_RECORDER_S", 0.0)
    bench = benches()
    until(lambda: any("there is no recorder" in text for text in bench.viewers[0].tape.texts("log/view")))


def viewer_dies(bench: ViewBench, monkeypatch: pytest.MonkeyPatch) -> None:
    bench.viewers[0].alive = False


def viewer_reads_nothing(bench: ViewBench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_view, "STUCK_S", 0.1)


def viewer_grows(bench: ViewBench, monkeypatch: pytest.MonkeyPatch) -> None:
    bench.viewers[0].memory_bytes = 100_000_000 + live_view.VIEWER_SPARE_BYTES - 1
    time.sleep(0.1)
    assert len(bench.viewers) == 1
    bench.viewers[0].memory_bytes += 2


def view_grows(bench: ViewBench, monkeypatch: pytest.MonkeyPatch) -> None:
    sizes = [live_view.OWN_BYTES + 1]  # above the limit in one check
    monkeypatch.setattr(live_view, "resident_bytes", lambda: sizes.pop() if sizes else 0)


@pytest.mark.parametrize(
    ("fail", "stuck", "reason"),
    [
        (viewer_dies, 0, "the viewer was killed"),
        (viewer_reads_nothing, 1, "read nothing for"),
        (viewer_grows, 0, "the viewer uses 16"),
        (view_grows, 0, "the view uses 512 MB"),
    ],
)
def test_a_failed_viewer_is_restarted_and_shows_everything(
    benches: ViewBenches, monkeypatch: pytest.MonkeyPatch, fail: Callable[..., None], stuck: int, reason: str
) -> None:
    bench = benches(stuck=stuck)
    bench.publish()
    until(lambda: stuck or bench.drawn(1))
    fail(bench, monkeypatch)
    until(lambda: len(bench.viewers) == 2)
    assert bench.viewers[0].stopped.is_set()
    bench.publish()
    until(lambda: bench.drawn(2))
    assert any(reason in event for event in bench.event_texts("VIEW_RENEWED"))
    assert bench.failure is None


def test_the_end_of_a_native_viewer_ends_the_view_without_a_restart(benches: ViewBenches) -> None:
    bench = benches(Show.NATIVE)
    bench.viewers[0].alive = False
    bench.thread.join(PATIENCE_S)
    assert (bench.failure, bench.view.renewals) == (None, 0)


def test_a_hung_window_is_not_restarted_and_memory_stays_bounded(
    benches: ViewBenches, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live_view, "STUCK_S", 0.1)
    bench = benches(Show.NATIVE, stuck=1)
    until(lambda: bench.viewers[0].blocked.is_set())
    for _ in range(100):
        bench.publish()
    waiting = {topic: len(ring.waiting) for topic, ring in bench.view._rings.items()}
    assert (waiting[STEP], waiting[FRAME]) == (live_view.RING_LENGTHS[STEP], 1)
    assert all(count <= live_view.RING_LENGTHS[topic] for topic, count in waiting.items())
    until(lambda: bench.event_texts("VIEW_STUCK"))
    time.sleep(0.2)
    assert len(bench.event_texts("VIEW_STUCK")) == 1
    assert len(bench.viewers) == 1
    bench.viewers[0].stopped.set()
    until(lambda: bench.drawn(1))


def test_memory_above_the_limit_after_a_restart_ends_the_view(
    benches: ViewBenches, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = benches()
    monkeypatch.setattr(live_view, "resident_bytes", lambda: live_view.OWN_BYTES + 1)
    assert "even after a restart" in failure_of(bench)


def test_repeated_failures_end_the_view(benches: ViewBenches, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(FakeViewer, "alive", property(lambda self: False, lambda self, value: None), raising=False)
    assert "5 times" in failure_of(benches())


@pytest.mark.parametrize("method", ["set_time", "flush"])
def test_a_view_to_a_file_is_not_restarted(benches: ViewBenches, monkeypatch: pytest.MonkeyPatch, method: str) -> None:
    bench = benches(None)
    monkeypatch.setattr(Tape, method, None)
    if method == "flush":  # as on a full disk, at the end
        bench.view.service.stop("the test is over")
    assert "writing the view to a file failed: drawing failed" in failure_of(bench)


@pytest.mark.parametrize(("pause_s", "all_complete"), [(0.1, True), (0.0, False)])
def test_complete_snapshots_are_drawn_on_time_even_if_drawing_is_slow(
    monkeypatch: pytest.MonkeyPatch, pause_s: float, all_complete: bool
) -> None:
    """A complete snapshot has all new data; another has only the newest frame, mirror state and surface."""
    complete: list[bool] = []

    def draw(snapshot: Snapshot) -> None:
        complete.append(snapshot.complete)
        time.sleep(pause_s)

    monkeypatch.setattr(render_threads, "Renderer", lambda *_: SimpleNamespace(draw=draw))
    thread = RenderThread(Configuration(), HostClock(), {}, Tape)
    thread.start()
    until(lambda: len(complete) >= 4)
    thread.abandon()
    thread.join()
    assert thread.fault is None
    assert all(complete) == all_complete
    assert complete[0]
