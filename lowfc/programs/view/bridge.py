"""The bridge from a run to a viewer: it may start, hang, die and start again, and the loop never notices.

What arrives waits in rings that keep the newest, a brush draws from them, and the main thread watches the brush, the
viewer's process and the memory of both. What goes wrong is mended by beginning anew, with an event that says why.
"""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import rerun as rr

from lowfc.adapters.bus import Bus, states
from lowfc.adapters.clock import Clock
from lowfc.adapters.rerun_viewer import RerunViewer, Show, ViewerError
from lowfc.adapters.service import Service
from lowfc.adapters.usage import resident_bytes
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import LowfcError
from lowfc.contract.messages import EVENT, STEP, TRUTH, Role
from lowfc.programs.view.brush import Brush
from lowfc.programs.view.earlier import earlier_events
from lowfc.programs.view.moment import SHOWN

WAITING = {topic: 1 if topic.newest_only else 100 for topic in SHOWN} | {STEP: 2000, TRUTH: 2000}
"""Messages that wait, by topic: of pictures the newest, of rows two seconds at 1 kHz; each may hold 16 kB."""
OWN_BYTES = 512_000_000
"""Memory of this process above which the view begins anew: 160 MB, 80 MB of rings and 150 MB unsent stay below it."""
VIEWER_SPARE_BYTES = 1_500_000_000
"""Memory of a viewer beyond what it may keep of the stream: its textures, plots and window are not in that limit."""
STUCK_S = 10.0
"""Without a moment drawn, the viewer is taken for hung."""

_RECORDER_S = 3.0  # after which a recorder that has not been heard is none
_TURN_S = 0.1
_LOOK_S = 1.0
_FROZEN_S = 3.0
_MOST_RENEWALS = 5
_RENEWALS_S = 60.0


class ViewError(LowfcError):
    """The view cannot go on."""

    exit_status = 1


@dataclass(frozen=True, slots=True)
class Summary:
    """What a view did: moments drawn, times it began anew, most memory of this process."""

    moments: int
    renewals: int
    most_bytes: int


class Bridge:
    """One live view of a run."""

    def __init__(
        self,
        config: Configuration,
        run_id: str,
        clock: Clock,
        bus: Bus,
        open_viewer: Callable[[], RerunViewer] | None,
        make_stream: Callable[[RerunViewer | None], rr.RecordingStream],
        viewer_bytes: int,
    ) -> None:
        """Subscribe to everything that is shown; drawing starts with `run`.

        Args:
            config: of what is looked at.
            run_id: of the run.
            clock: the run's.
            bus: of the role viewer.
            open_viewer: starts a viewer, on the same ports each time; None where a file is written.
            make_stream: stream to that viewer, or into the file.
            viewer_bytes: what the viewer may keep of the stream.
        """
        self._config = config
        self._clock = clock
        self._bus = bus
        self._open_viewer = open_viewer
        self._make_stream = make_stream
        self._viewer_bytes = viewer_bytes
        self._viewer: RerunViewer | None = None
        self._brush: Brush | None = None
        self._drawn = self._renewals = self._most_bytes = 0
        self._renewed_s: list[float] = []
        self._stuck = self._past_known = False
        self._awake_s = self._began_s = time.monotonic()
        self._rings = {topic: bus.ring(topic, WAITING[topic]) for topic in SHOWN}
        self.service = Service(Role.VIEWER, run_id, clock, bus)

    @property
    def viewer(self) -> RerunViewer | None:
        """The viewer, once it runs."""
        return self._viewer

    def run(self, until_s: float | None = None, ready: Callable[[], None] | None = None) -> Summary:
        """Show the run until told to stop, until a window is closed, or for a time.

        Args:
            until_s: for so long; None for ever.
            ready: called once the viewer is there.

        Raises:
            ViewerError: no viewer can be started.
            ViewError: it fails again and again, or memory stays beyond its bound.
        """
        try:
            self._begin()
            if ready is not None:
                ready()
            self.service.state = "ready"
            began_s = looked_s = time.monotonic()
            while self.service.running:
                self.service.work = self._moments
                self.service.beat()
                time.sleep(_TURN_S)
                now_s = time.monotonic()
                if now_s - looked_s >= _LOOK_S:
                    if now_s - looked_s > _FROZEN_S:
                        self._awake_s = now_s  # this process stood still, and so did the brush
                    looked_s = now_s
                    self._look(now_s)
                if until_s is not None and now_s - began_s >= until_s:
                    break
            return Summary(self._moments, self._renewals, self._most_bytes)
        finally:
            self.service.finish()
            if self._viewer is not None and not self._viewer.answers():
                self._viewer.stop()  # or the brush would wait for it
            self._lay_down()

    def close(self) -> None:
        """Close the viewer; a stream that it held up is free then."""
        if self._viewer is not None:
            self._viewer.stop()

    @property
    def _moments(self) -> int:
        return self._drawn + (self._brush.moments if self._brush is not None else 0)

    def _begin(self) -> None:
        self._viewer = self._open_viewer() if self._open_viewer is not None else None
        viewer = self._viewer
        self._brush = Brush(self._config, self._clock, self._rings, lambda: self._make_stream(viewer))
        self._brush.start()
        self._began_s = time.monotonic()
        self._past_known = self._stuck = False
        self._inform(self._brush)

    def _lay_down(self, patience_s: float = 3.0) -> None:
        """End the brush, as far as it can be ended."""
        if self._brush is not None:
            self._brush.abandon()
            self._brush.join(patience_s)
            self._drawn += self._brush.moments
            self._brush = None

    def _inform(self, brush: Brush) -> None:
        """Let a brush know what was sent before this view received anything; a peer that is frozen answers late."""
        recorder = self.service.heard.get(Role.RECORDER)
        past_known = self._past_known
        if recorder is not None or time.monotonic() - self._began_s > _RECORDER_S:
            self._past_known = True

        def ask() -> None:
            brush.tell(states(self._bus, SHOWN))
            if self._past_known and not past_known:
                brush.tell((EVENT, event) for event in earlier_events(recorder, self._clock.now_ns()))

        threading.Thread(target=ask, name="ask", daemon=True).start()

    def _look(self, now_s: float) -> None:
        """Is everything well?"""
        if self._brush is not None and (
            self.service.newcomers() or (not self._past_known and now_s - self._began_s > _RECORDER_S)
        ):
            self._inform(self._brush)
        own_bytes = resident_bytes()
        self._most_bytes = max(self._most_bytes, own_bytes)
        if self._viewer is not None and not self._viewer.alive:
            if self._viewer.show is Show.NATIVE:
                self.service.stop("the viewer was closed")
            else:
                self._renew(self._viewer.how_it_ended())
        elif self._brush is not None and self._brush.fault is not None:
            self._renew(f"drawing failed: {self._brush.fault!r}")
        elif self._brush is not None and self._stuck_s(now_s) > STUCK_S:
            self._unstick(self._stuck_s(now_s))
        elif own_bytes > OWN_BYTES:
            self._renew(f"the bridge holds {own_bytes / 1e6:.0f} MB, more than {OWN_BYTES / 1e6:.0f} MB")
            if resident_bytes() > OWN_BYTES:
                raise ViewError(f"the view holds more than {OWN_BYTES / 1e6:.0f} MB even when new; start it again")
        elif self._viewer is not None and self._viewer.resident_bytes() > self._viewer_bytes + VIEWER_SPARE_BYTES:
            self._renew(f"the viewer holds {self._viewer.resident_bytes() / 1e6:.0f} MB")
        else:
            self._stuck = False

    def _stuck_s(self, now_s: float) -> float:
        return now_s - max(self._brush.painted_s, self._awake_s) if self._brush is not None else 0.0

    def _unstick(self, stuck_s: float) -> None:
        """A window belongs to whoever looks at it: it is waited for. A server is started again."""
        if self._viewer is not None and self._viewer.show is Show.NATIVE:
            if not self._stuck:
                self.service.event("VIEW_STUCK", stuck_s=stuck_s)
            self._stuck = True
        else:
            self._renew(f"the viewer took nothing for {stuck_s:.0f} s")

    def _renew(self, why: str) -> None:
        """Begin anew, with a new viewer on the same ports; a file cannot be begun anew, and is kept as far as it is."""
        if self._open_viewer is None:
            raise ViewError(f"the view into a file ended: {why}")
        while True:
            now_s = time.monotonic()
            self._renewed_s = [at_s for at_s in self._renewed_s if now_s - at_s < _RENEWALS_S] + [now_s]
            if len(self._renewed_s) > _MOST_RENEWALS:
                raise ViewError(
                    f"the view began anew {_MOST_RENEWALS} times in {_RENEWALS_S:g} s; the last time: {why}"
                )
            self.service.event("VIEW_RENEWED", why=why)
            self._renewals += 1
            if self._viewer is not None:
                self._viewer.stop()
            self._lay_down()
            try:
                self._begin()
                return
            except ViewerError as error:
                why = str(error)
