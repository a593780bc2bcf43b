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
    """

    pictures = False
    plots: tuple[Plot, ...] = ()

    def begin(self, stream: rr.RecordingStream) -> None:
        """Send what holds for all times, such as names and colours."""
        for plot in self.plots:
            plot.name(stream)

    @abstractmethod
    def draw(self, stream: rr.RecordingStream, snapshot: Snapshot) -> None:
        """Draw what is new."""
