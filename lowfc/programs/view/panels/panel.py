"""One part of what is shown."""

from abc import ABC, abstractmethod

import rerun as rr

from lowfc.programs.view.draw.plots import Plot
from lowfc.programs.view.snapshot import Snapshot


class Panel(ABC):
    """Draws its part of every snapshot, and keeps what it needs of those before.

    Attributes:
        pictures: it shows what is newest, and is therefore drawn for incomplete snapshots too.
        plots: those whose curves are the same in every run.
        period_ns: between two drawings of a panel that asks whether it is `due`.
    """

    pictures = False
    plots: tuple[Plot, ...] = ()
    period_ns = 2_000_000_000
    _drawn_ns = 0

    def begin(self, stream: rr.RecordingStream) -> None:
        """Send what holds for all times, such as names and colours."""
        for plot in self.plots:
            plot.name(stream)

    @abstractmethod
    def draw(self, stream: rr.RecordingStream, snapshot: Snapshot) -> None:
        """Draw what is new."""

    def due(self, snapshot: Snapshot) -> bool:
        """Whether the period is over, or the clock was set back; the next period begins then."""
        over = not 0 <= snapshot.time_ns - self._drawn_ns < self.period_ns
        if over:
            self._drawn_ns = snapshot.time_ns
        return over
