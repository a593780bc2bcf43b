"""The thread that draws a live run, so that a viewer that hangs stops nothing else."""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from itertools import chain

import rerun as rr

from lowfc.adapters.bus.bus import Ring, Sample
from lowfc.adapters.process.clock import Clock
from lowfc.contract.configuration import Configuration
from lowfc.contract.messages import Topic
from lowfc.programs.view.renderer import Renderer
from lowfc.programs.view.snapshot import PICTURES_HZ, PICTURES_PER_COMPLETE, Accumulator


class RenderThread(threading.Thread):
    """Draws what arrived, thirty times a second, until it is abandoned.

    Attributes:
        drawn_s: when it last had drawn everything, by time.monotonic().
        snapshots: drawn so far.
        fault: what ended it, other than being abandoned.
    """

    def __init__(
        self,
        config: Configuration,
        clock: Clock,
        rings: Mapping[Topic, Ring],
        make_stream: Callable[[], rr.RecordingStream],
    ) -> None:
        """Make it; `rings` hold what arrives."""
        super().__init__(name="render", daemon=True)
        self.drawn_s = time.monotonic()
        self.snapshots = 0
        self.fault: Exception | None = None
        self._config = config
        self._clock = clock
        self._rings = rings
        self._earlier: deque[tuple[Topic, Sample]] = deque()
        self._make_stream = make_stream
        self._abandoned = False

    def add_earlier(self, samples: Iterable[tuple[Topic, Sample]]) -> None:
        """Draw messages, too, that were sent before the view received anything."""
        self._earlier.extend(samples)

    def abandon(self) -> None:
        """Let it end by itself: at once, or when the call that it hangs in returns."""
        self._abandoned = True

    def run(self) -> None:
        """Draw."""
        try:
            self._draw()
        except Exception as fault:  # the bridge begins anew, and reports why
            self.fault = fault

    def _draw(self) -> None:
        stream = self._make_stream()
        renderer = Renderer(self._config, stream)
        accumulator = Accumulator(self._clock.now_ns() if self._clock.lockstep else None)
        due_s = began_s = complete_due_s = time.monotonic()
        while not self._abandoned:
            now_s = time.monotonic()
            behind_s, began_s = max(0.0, now_s - began_s - 1 / PICTURES_HZ), now_s  # what arrived may be that old
            complete = now_s >= complete_due_s
            if complete:
                complete_due_s = now_s + (PICTURES_PER_COMPLETE - 0.5) / PICTURES_HZ  # by time: rings wait no longer
            earlier = [self._earlier.popleft() for _ in range(len(self._earlier))]
            rings = [(topic, ring) for topic, ring in self._rings.items() if complete or topic.latest_only]
            arrived = ((topic, sample) for topic, ring in rings for sample in ring.drain())
            for topic, sample in chain(earlier, arrived):  # many messages in a row cost less each
                accumulator.add(topic, sample.key, sample.payload, sample.publish_time_ns, sample.sequence)
            renderer.draw(accumulator.snapshot(self._clock.host_ns(), complete=complete, behind_s=behind_s))
            self.snapshots += 1
            self.drawn_s = time.monotonic()
            due_s = max(due_s + 1 / PICTURES_HZ, self.drawn_s)
            time.sleep(due_s - self.drawn_s)
        stream.disconnect()
