"""The thread that draws a live run, so that a viewer that takes nothing stops nobody else."""

import threading
import time
from collections.abc import Callable, Iterable

import rerun as rr

from lowfc.adapters.backlog import Backlog
from lowfc.adapters.bus import Sample
from lowfc.adapters.clock import Clock
from lowfc.contract.configuration import Configuration
from lowfc.contract.messages import Topic
from lowfc.programs.view.moment import Gatherer
from lowfc.programs.view.painter import Painter

PICTURES_HZ = 30.0
PICTURES_PER_ROWS = 3
"""Curves grow ten times a second: many rows in one message cost hardly more than one."""


class Brush(threading.Thread):
    """Draws what waits in a backlog, thirty times a second, until it is abandoned.

    Attributes:
        painted_s: when it last had drawn everything, by time.monotonic().
        moments: drawn so far.
        fault: what ended it, other than being abandoned.
    """

    def __init__(
        self,
        config: Configuration,
        clock: Clock,
        backlog: Backlog,
        known: Iterable[tuple[Topic, Sample]],
        make_stream: Callable[[], rr.RecordingStream],
    ) -> None:
        """Make it; `known` are the states that were sent before."""
        super().__init__(name="brush", daemon=True)
        self.painted_s = time.monotonic()
        self.moments = 0
        self.fault: Exception | None = None
        self._config = config
        self._clock = clock
        self._backlog = backlog
        self._known = list(known)
        self._make_stream = make_stream
        self._abandoned = False

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
        painter, gatherer = Painter(self._config, stream), Gatherer()
        for topic, sample in self._known:
            gatherer.take(topic, sample.key, sample.payload, sample.publish_time_ns)
        due_s = time.monotonic()
        while not self._abandoned:
            for _ in range(len(self._backlog)):
                topic, sample = self._backlog.take()
                gatherer.take(topic, sample.key, sample.payload, sample.publish_time_ns)
            rows, behind_s = self.moments % PICTURES_PER_ROWS == 0, time.monotonic() - due_s
            painter.draw(gatherer.moment(self._clock.host_ns(), rows=rows, behind_s=behind_s))
            self.moments += 1
            self.painted_s = time.monotonic()
            due_s = max(due_s + 1 / PICTURES_HZ, self.painted_s)
            time.sleep(due_s - self.painted_s)
        stream.disconnect()
