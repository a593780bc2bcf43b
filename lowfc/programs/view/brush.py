"""The thread that draws a live run, so that a viewer that takes nothing stops nobody else."""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from itertools import chain

import rerun as rr

from lowfc.adapters.bus import Ring, Sample
from lowfc.adapters.clock import Clock
from lowfc.contract.configuration import Configuration
from lowfc.contract.messages import Topic
from lowfc.programs.view.moment import PICTURES_HZ, PICTURES_PER_WHOLE, Gatherer
from lowfc.programs.view.painter import Painter


class Brush(threading.Thread):
    """Draws what arrived, thirty times a second, until it is abandoned.

    Attributes:
        painted_s: when it last had drawn everything, by time.monotonic().
        moments: drawn so far.
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
        super().__init__(name="brush", daemon=True)
        self.painted_s = time.monotonic()
        self.moments = 0
        self.fault: Exception | None = None
        self._config = config
        self._clock = clock
        self._rings = rings
        self._told: deque[tuple[Topic, Sample]] = deque()
        self._make_stream = make_stream
        self._abandoned = False

    def tell(self, states: Iterable[tuple[Topic, Sample]]) -> None:
        """Let it know states that were sent before anybody listened."""
        self._told.extend(states)

    def abandon(self) -> None:
        """Let it end by itself: at once, or when the call that it hangs in comes back."""
        self._abandoned = True

    def run(self) -> None:
        """Draw."""
        try:
            self._draw()
        except Exception as fault:  # whoever watches begins anew, and says why
            self.fault = fault

    def _draw(self) -> None:
        stream = self._make_stream()
        painter = Painter(self._config, stream)
        gatherer = Gatherer(self._clock.now_ns() if self._clock.lockstep else None)
        due_s = began_s = whole_due_s = time.monotonic()
        while not self._abandoned:
            now_s = time.monotonic()
            behind_s, began_s = max(0.0, now_s - began_s - 1 / PICTURES_HZ), now_s  # what arrived may be that old
            whole = now_s >= whole_due_s
            if whole:
                whole_due_s = now_s + (PICTURES_PER_WHOLE - 0.5) / PICTURES_HZ  # by time: rings wait no longer
            self._gather(gatherer, whole=whole)
            painter.draw(gatherer.moment(self._clock.host_ns(), whole=whole, behind_s=behind_s))
            self.moments += 1
            self.painted_s = time.monotonic()
            due_s = max(due_s + 1 / PICTURES_HZ, self.painted_s)
            time.sleep(due_s - self.painted_s)
        stream.disconnect()

    def _gather(self, gatherer: Gatherer, *, whole: bool) -> None:
        """Take what arrived: everything, or what is drawn at once; many messages in a row cost less each."""
        told = [self._told.popleft() for _ in range(len(self._told))]
        rings = [(topic, ring) for topic, ring in self._rings.items() if whole or topic.newest_only]
        arrived = ((topic, sample) for topic, ring in rings for sample in ring.drain())
        for topic, sample in chain(told, arrived):
            gatherer.take(topic, sample.key, sample.payload, sample.publish_time_ns, sample.sequence)
