"""One part of what is shown."""

from abc import ABC, abstractmethod

import rerun as rr

from lowfc.programs.view.moment import Moment


class Panel(ABC):
    """Draws its part of every moment, and keeps what it needs of those before.

    Attributes:
        pictures: it shows what is newest, so that it is drawn at moments that are not whole, too.
    """

    pictures = False

    def begin(self, stream: rr.RecordingStream) -> None:  # noqa: B027  # most have something to say here, not all
        """Say what holds for all times, such as names and colours."""

    @abstractmethod
    def draw(self, stream: rr.RecordingStream, moment: Moment) -> None:
        """Draw what is new."""
