"""Live view of a run. The viewer may start, hang, die and restart without any effect on the loop.

Messages wait in ring buffers that keep the newest. A render thread draws them; the main thread monitors that thread,
the viewer's process, and the memory of this process and of the viewer. After a failure the viewer restarts, with an
event that gives the reason. A hung window is only reported. A closed window ends the view; a failure to write the file
ends it with an error.
"""

import contextlib
import platform
import threading
import time
from collections import deque
from collections.abc import Callable
from functools import partial
from pathlib import Path

from lowfc.adapters.bus.bus import Bus, Sample, last_messages
from lowfc.adapters.logs.reader import LogReader
from lowfc.adapters.logs.writer import UNFINISHED
from lowfc.adapters.process.clock import Clock
from lowfc.adapters.process.host import resident_bytes
from lowfc.adapters.process.service import Service
from lowfc.adapters.viewer.rerun_viewer import RerunViewer, Show, ViewerError
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import BusError, DataFileError, LowfcError
from lowfc.contract.events import Level
from lowfc.contract.messages import EVENT, STEP, TRUTH, Log, Role, timestamp, wire
from lowfc.programs.view.layout import LIVE_WINDOW_S
from lowfc.programs.view.renderer import RenderThread
from lowfc.programs.view.snapshot import SHOWN
from lowfc.programs.view.target import Target

RING_LENGTHS = {topic: 1 if topic.latest_only else 100 for topic in SHOWN} | {STEP: 2000, TRUTH: 2000}
"""Messages kept by each ring buffer: 1 of images and mirror states, 2000 (two seconds at 1 kHz) of steps and truths,
100 of the others. Each kept message holds its receive buffer of 16 kB."""
OWN_BYTES = 512_000_000
"""Memory of this process above which the view restarts. Normal use is at most 390 MB: 160 MB for the process itself, 80
MB in ring buffers, and 150 MB of data that the viewer has not read."""
VIEWER_SPARE_BYTES = 1_500_000_000
"""Memory granted to a viewer for textures, plots and window, beyond `--memory-mb` for the stream."""
STUCK_S = 10.0
"""Time without a drawn snapshot after which the viewer counts as hung."""
MAX_EARLIER_EVENTS = 1000
"""Largest number of events shown from before the start of the view."""

_RECORDER_S = 3.0  # time without the recorder's Health after which the recorder counts as absent
_FILE_S = 60.0  # longest time for the last data to be written to a file
_POLL_S = 0.1
_CHECK_S = 1.0  # time between two checks of viewer, render thread and memory
_SUSPENDED_S = 3.0  # a longer time between two checks means that this process was suspended meanwhile
_MAX_RENEWALS = 5  # restarts allowed within `_RENEWALS_S`; a further one ends the view
_RENEWALS_S = 60.0


class ViewError(LowfcError):
    """The view cannot continue."""

    exit_status = 1


class LiveView:
    """One live view of a run; `renewals` counts its restarts, `peak_bytes` is the peak memory of this process."""

    def __init__(self, config: Configuration, run_id: str, clock: Clock, bus: Bus, target: Target) -> None:
        """Subscribe to everything that is shown; drawing starts with `run`."""
        self._config = config
        self._clock = clock
        self._bus = bus
        self._target = target
        self.viewer: RerunViewer | None = None
        self._render: RenderThread | None = None
        self._drawn = self.renewals = self.peak_bytes = 0
        self._renewed_s: deque[float] = deque(maxlen=_MAX_RENEWALS)
        self._stuck = self._earlier_events_requested = False
        self._resumed_s = self._began_s = time.monotonic()
        self._rings = {topic: bus.ring(topic, RING_LENGTHS[topic]) for topic in SHOWN}
        self.service = Service(Role.VIEWER, run_id, clock, bus)

    def run(self, duration_s: float | None = None, ready: Callable[[], None] = lambda: None) -> None:
        """Show the run until the view is stopped, its window is closed or `duration_s` is over.

        `ready` is called once the viewer runs.

        Raises:
            ViewerError, ViewError: no viewer starts, it fails repeatedly, memory stays above its limit, or writing the
                view to a file fails.
        """
        try:
            self._begin()
            ready()
            self.service.state = "ready"
            began_s = checked_s = time.monotonic()
            while self.service.running and (duration_s is None or time.monotonic() - began_s < duration_s):
                self.service.work = self.snapshots
                self.service.beat()
                time.sleep(_POLL_S)
                now_s = time.monotonic()
                if now_s - checked_s >= _CHECK_S:
                    if now_s - checked_s > _SUSPENDED_S:
                        self._resumed_s = now_s  # the render thread could not draw while this process was suspended
                    checked_s = now_s
                    self._check(now_s)
        finally:
            self.service.finish()
            if self.viewer is not None and not self.viewer.answers():
                self.viewer.stop()  # otherwise the render thread would wait for it
            self._end_render()

    def close(self) -> None:
        """Close the viewer; this releases a stream that is blocked on it."""
        if self.viewer is not None:
            self.viewer.stop()

    @property
    def snapshots(self) -> int:
        """Snapshots drawn so far."""
        return self._drawn + (self._render.snapshots if self._render is not None else 0)

    def _begin(self) -> None:
        self.viewer = self._target.viewer()
        make_stream = partial(self._target.stream, self.viewer, self.service.run_id, LIVE_WINDOW_S)
        self._render = RenderThread(self._config, self._clock, self._rings, make_stream)
        self._render.start()
        self._began_s = time.monotonic()
        self._earlier_events_requested = self._stuck = False
        self._add_earlier(self._render)

    def _end_render(self) -> None:
        if self._render is not None:
            self._render.abandon()
            self._render.join(_FILE_S if self.viewer is None else 3.0)  # a file is complete when the thread ends
            self._drawn += self._render.snapshots
            fault, self._render = self._render.fault, None
            if fault is not None and self.viewer is None:
                self._renew(f"drawing failed: {fault!r}")  # raises a ViewError

    def _add_earlier(self, render: RenderThread) -> None:
        """Add messages published before this view began; in a thread, because a suspended process answers late."""
        recorder = self.service.last_health.get(Role.RECORDER)
        events_due = not self._earlier_events_requested and (
            recorder is not None or self._recorder_absent(time.monotonic())
        )
        self._earlier_events_requested |= events_due

        def add() -> None:
            with contextlib.suppress(BusError):  # the view has ended
                render.add_earlier(sample for _, sample in last_messages(self._bus, SHOWN))
            if events_due:
                render.add_earlier(earlier_events(recorder, self._clock.now_ns()))

        threading.Thread(target=add, name="earlier", daemon=True).start()

    def _recorder_absent(self, now_s: float) -> bool:
        return now_s - self._began_s > _RECORDER_S

    def _check(self, now_s: float) -> None:
        render, viewer = self._render, self.viewer
        assert render is not None  # noqa: S101  # `_begin` made it
        if self.service.has_newcomers() or (not self._earlier_events_requested and self._recorder_absent(now_s)):
            self._add_earlier(render)
        own_bytes, stuck_s = resident_bytes(), now_s - max(render.drawn_s, self._resumed_s)
        viewer_bytes = viewer.resident_bytes() if viewer is not None else 0
        self.peak_bytes = max(self.peak_bytes, own_bytes)
        native = viewer is not None and viewer.show is Show.NATIVE
        was_stuck, self._stuck = self._stuck, native and stuck_s > STUCK_S
        if viewer is not None and not viewer.alive:
            if native:
                self.service.stop("the viewer was closed")
            else:
                self._renew(viewer.exit_description())
        elif render.fault is not None:
            self._renew(f"drawing failed: {render.fault!r}")
        elif self._stuck:  # a hung window is reported, not restarted: it belongs to its user
            if not was_stuck:
                self.service.event("VIEW_STUCK", stuck_s=stuck_s)
        elif stuck_s > STUCK_S:
            self._renew(f"the viewer read nothing for {stuck_s:.0f} s")
        elif own_bytes > OWN_BYTES:
            self._renew(f"the view uses {own_bytes / 1e6:.0f} MB, more than {OWN_BYTES / 1e6:.0f} MB")
            if resident_bytes() > OWN_BYTES:
                raise ViewError(
                    f"the view uses more than {OWN_BYTES / 1e6:.0f} MB even after a restart; start it again"
                )
        elif viewer_bytes > self._target.memory_mb * 1e6 + VIEWER_SPARE_BYTES:
            self._renew(f"the viewer uses {viewer_bytes / 1e6:.0f} MB")

    def _renew(self, why: str) -> None:
        """Restart with a new viewer on the same ports.

        It raises ViewError after too many restarts, or if the view is written to a file: this file is kept, but cannot
        be continued.
        """
        if self.viewer is None:
            raise ViewError(f"writing the view to a file failed: {why}")
        while True:
            now_s = time.monotonic()
            if len(self._renewed_s) == _MAX_RENEWALS and now_s - self._renewed_s[0] < _RENEWALS_S:
                raise ViewError(
                    f"the view was restarted {_MAX_RENEWALS} times in {_RENEWALS_S:g} s; the last time: {why}"
                )
            self._renewed_s.append(now_s)
            self.service.event("VIEW_RENEWED", why=why)
            self.renewals += 1
            self.viewer.stop()
            self._end_render()
            try:
                self._begin()
                return
            except ViewerError as error:
                why = str(error)


def earlier_events(recorder: wire.Health | None, now_ns: int) -> list[Sample]:
    """The newest events in a recorder's logs, and an event of the view for each reason why some or all are missing.

    Only chunks with events are read, which takes a second for a log of 4 GB.
    """
    if recorder is None:
        return [_view_event("earlier events are not shown: there is no recorder", now_ns)]
    if recorder.host and recorder.host != platform.node():
        return [_view_event(f"earlier events are not shown: they are in the log on {recorder.host}", now_ns)]
    events: list[Sample] = []
    missing = []
    for name in reversed(recorder.recording.files):
        finished = Path(recorder.recording.folder, name.removesuffix(UNFINISHED))
        unfinished = finished.with_name(finished.name + UNFINISHED)
        log = unfinished if unfinished.exists() else finished
        try:
            events = [*LogReader(log, topics=(EVENT,), skip_damaged=True, sparse=True), *events]
        except DataFileError as fault:
            missing.append(_view_event(f"some earlier events are missing: {fault}", now_ns))
        if len(events) >= MAX_EARLIER_EVENTS:
            break
    return [*events[-MAX_EARLIER_EVENTS:], *missing]


def _view_event(text: str, now_ns: int) -> Sample:
    log = Log(timestamp=timestamp(now_ns), level=Level.INFO.value, name="view", message=text)  # type: ignore[arg-type]
    return Sample(EVENT.key, log.SerializeToString(), 0, now_ns, now_ns)
