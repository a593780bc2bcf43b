"""Base class of the panels."""

from abc import ABC, abstractmethod

import rerun as rr

from lowfc.programs.view.draw.plots import Plot
from lowfc.programs.view.snapshot import Snapshot


class Panel(ABC):
    """Draws its part of every snapshot, and keeps what it needs from earlier ones.

    Attributes:
        pictures: whether the panel shows pictures, which are drawn for incomplete snapshots too.
        plots: plots whose curves are the same in every run.
        period_ns: time between two drawings by a panel that draws only when it is `due`.
    """

    pictures = False
    plots: tuple[Plot, ...] = ()
    period_ns = 2_000_000_000
    _drawn_ns = 0

    def begin(self, stream: rr.RecordingStream) -> None:
        """Send data for all times, such as names and colours."""
        for plot in self.plots:
            plot.name(stream)

    @abstractmethod
    def draw(self, stream: rr.RecordingStream, snapshot: Snapshot) -> None:
        """Draw the new data."""

    def due(self, snapshot: Snapshot) -> bool:
        """Whether the period has passed or the clock was set back; if so, the next period begins."""
        is_due = not 0 <= snapshot.time_ns - self._drawn_ns < self.period_ns
        if is_due:
            self._drawn_ns = snapshot.time_ns
        return is_due
