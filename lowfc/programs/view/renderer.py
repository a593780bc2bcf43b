"""Draw all panels onto a stream, snapshot by snapshot; for a live run in a separate thread."""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from functools import partial

import rerun as rr

from lowfc.adapters.bus.bus import Ring, Sample
from lowfc.adapters.files.sensors import coronagraph_from
from lowfc.adapters.process.clock import Clock
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import LowfcError
from lowfc.contract.messages import Topic
from lowfc.optics.detector.photometry import tilt_nm_per_mas
from lowfc.programs.view.draw.plots import at
from lowfc.programs.view.panels.latency import Latency
from lowfc.programs.view.panels.loop import LOG, Loop
from lowfc.programs.view.panels.mirror import Mirror
from lowfc.programs.view.panels.panel import Panel
from lowfc.programs.view.panels.pointing import Pointing
from lowfc.programs.view.panels.science import Science
from lowfc.programs.view.panels.sensor import Sensor
from lowfc.programs.view.panels.spectra import Spectra
from lowfc.programs.view.panels.tiles import Tiles
from lowfc.programs.view.panels.trend import Trend
from lowfc.programs.view.panels.wavefront import Wavefront
from lowfc.programs.view.snapshot import PICTURES_HZ, PICTURES_PER_COMPLETE, Accumulator, Snapshot

RETRY_NS = 5_000_000_000
"""Time from a panel's failure until it is created again."""


class Renderer:
    """All panels of a view.

    A panel that fails to draw a snapshot is left out, with a line in the view's log, and created again after
    `RETRY_NS`; the other panels continue.
    """

    def __init__(self, config: Configuration, stream: rr.RecordingStream) -> None:
        self._stream = stream
        self._remarks: list[str] = []
        nm_per_mas = tilt_nm_per_mas(config.star.diameter_m)
        self._makers: list[Callable[[], Panel]] = [
            partial(Tiles, nm_per_mas),
            Sensor,
            Mirror,
            partial(Wavefront, nm_per_mas),
            partial(Pointing, nm_per_mas),
            Trend,
            Loop,
            Latency,
            Spectra,
        ]
        try:
            self._makers.append(partial(Science, coronagraph_from(config.sensor), config.star.wavelength_nm))
        except LowfcError as error:
            self._remarks.append(f"no science camera: {error}")
        self._panels: list[Panel | None] = [self._started(make) for make in self._makers]
        self._retry_ns = [0] * len(self._makers)

    def draw(self, snapshot: Snapshot) -> None:
        """Draw a snapshot."""
        for number, panel in enumerate(self._panels):
            if panel is None and snapshot.time_ns >= self._retry_ns[number]:
                panel = self._panels[number] = self._started(self._makers[number])
            if panel is not None and (snapshot.complete or panel.pictures):
                try:
                    panel.draw(self._stream, snapshot)
                except Exception as fault:
                    self._remarks.append(f"{type(panel).__name__} is left out of the view for a while: {fault!r}")
                    self._panels[number], self._retry_ns[number] = None, snapshot.time_ns + RETRY_NS
        for remark in self._remarks:
            at(self._stream, snapshot.time_ns)
            self._stream.log(f"{LOG}/view", rr.TextLog(remark, level=rr.TextLogLevel.ERROR))
        self._remarks.clear()

    def _started(self, make: Callable[[], Panel]) -> Panel:
        panel = make()
        panel.begin(self._stream)
        return panel


class RenderThread(threading.Thread):
    """Draws pictures thirty times a second and curves about four times, until it is abandoned or fails.

    Attributes:
        drawn_s: end of the last drawing, by time.monotonic().
        snapshots: number of snapshots drawn.
        fault: why it failed; None while it has not.
    """

    def __init__(
        self,
        config: Configuration,
        clock: Clock,
        rings: Mapping[Topic, Ring],
        make_stream: Callable[[], rr.RecordingStream],
    ) -> None:
        """Create the thread; `rings` receive the messages."""
        super().__init__(name="render", daemon=True)
        self.drawn_s = time.monotonic()
        self.snapshots = 0
        self.fault: Exception | None = None
        self._config = config
        self._clock = clock
        self._rings = rings
        self._earlier: deque[Sample] = deque()
        self._make_stream = make_stream
        self._abandoned = False

    def add_earlier(self, samples: Iterable[Sample]) -> None:
        """Also draw these messages, which were published before the view began."""
        self._earlier.extend(samples)

    def abandon(self) -> None:
        """Ask the thread to end: at once, or when the call in which it hangs returns."""
        self._abandoned = True

    def run(self) -> None:
        """Draw until abandoned."""
        try:
            self._draw()
        except Exception as fault:  # the live view restarts the viewer and reports the reason
            self.fault = fault

    def _draw(self) -> None:
        stream = self._make_stream()
        renderer = Renderer(self._config, stream)
        accumulator = Accumulator(self._clock.now_ns() if self._clock.lockstep else None)
        due_s = began_s = complete_due_s = time.monotonic()
        while not self._abandoned:
            now_s = time.monotonic()
            behind_s = max(0.0, now_s - began_s - 1 / PICTURES_HZ)  # largest age of a waiting message
            began_s = now_s
            if complete := now_s >= complete_due_s:
                complete_due_s = now_s + (PICTURES_PER_COMPLETE - 0.5) / PICTURES_HZ  # before the rings overflow
            arrived = [self._earlier.popleft() for _ in range(len(self._earlier))]
            for topic, ring in self._rings.items():
                if complete or topic.latest_only:  # points of curves are cheaper in large batches
                    arrived += ring.drain()
            for sample in arrived:
                accumulator.add(sample)
            renderer.draw(accumulator.snapshot(self._clock.host_ns(), complete=complete, behind_s=behind_s))
            self.snapshots += 1
            self.drawn_s = time.monotonic()
            due_s = max(due_s + 1 / PICTURES_HZ, self.drawn_s)
            time.sleep(due_s - self.drawn_s)
        stream.flush()  # unlike `disconnect`, raises an error if the disk is full
        stream.disconnect()
