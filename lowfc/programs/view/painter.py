"""Everything that is shown, drawn onto a stream moment by moment."""

import rerun as rr

from lowfc.contract.configuration import Configuration
from lowfc.optics.photometry import tilt_nm_per_mas
from lowfc.programs.view.loop import LOG, Loop
from lowfc.programs.view.marks import at
from lowfc.programs.view.mirror import Mirror
from lowfc.programs.view.moment import Moment
from lowfc.programs.view.panel import Panel
from lowfc.programs.view.pointing import Pointing
from lowfc.programs.view.sensor import Sensor
from lowfc.programs.view.tiles import Tiles
from lowfc.programs.view.wavefront import Wavefront


class Painter:
    """All panels of a view.

    Attributes:
        panels: those that are drawn; one that fails is left out from then on, with a line in the view's log.
    """

    def __init__(self, config: Configuration, stream: rr.RecordingStream) -> None:
        self._stream = stream
        self.panels: list[Panel] = [
            Tiles(tilt_nm_per_mas(config.star.diameter_m)),
            Sensor(),
            Mirror(),
            Wavefront(config.star.diameter_m),
            Pointing(config.star.diameter_m),
            Loop(),
        ]
        for panel in self.panels:
            panel.begin(stream)

    def draw(self, moment: Moment) -> None:
        """Draw what is new."""
        for panel in list(self.panels):
            try:
                panel.draw(self._stream, moment)
            except Exception as fault:  # a message that nobody foresaw must not take the other panels from the operator
                self.panels.remove(panel)
                at(self._stream, moment.time_ns)
                text = f"{type(panel).__name__} is left out of the view: {fault!r}"
                self._stream.log(f"{LOG}/view", rr.TextLog(text, level=rr.TextLogLevel.ERROR))
