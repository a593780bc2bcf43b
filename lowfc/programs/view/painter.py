"""Everything that is shown, drawn onto a stream moment by moment."""

import rerun as rr

from lowfc.adapters.masks import science_pupil
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import LowfcError
from lowfc.optics.photometry import tilt_nm_per_mas
from lowfc.programs.view.latency import Latency
from lowfc.programs.view.loop import LOG, Loop
from lowfc.programs.view.marks import at
from lowfc.programs.view.mirror import Mirror
from lowfc.programs.view.moment import Moment
from lowfc.programs.view.panel import Panel
from lowfc.programs.view.pointing import Pointing
from lowfc.programs.view.science import Science
from lowfc.programs.view.sensor import Sensor
from lowfc.programs.view.spectra import Spectra
from lowfc.programs.view.tiles import Tiles
from lowfc.programs.view.wavefront import Wavefront


class Painter:
    """All panels of a view.

    Attributes:
        panels: those that are drawn; one that fails is left out from then on, with a line in the view's log.
    """

    def __init__(self, config: Configuration, stream: rr.RecordingStream) -> None:
        self._stream = stream
        self._remarks: list[str] = []
        nm_per_mas = tilt_nm_per_mas(config.star.diameter_m)
        self.panels: list[Panel] = [
            Tiles(nm_per_mas),
            Sensor(),
            Mirror(),
            Wavefront(nm_per_mas),
            Pointing(nm_per_mas),
            Loop(),
            Latency(),
            Spectra(),
            *self._science(config),
        ]
        for panel in self.panels:
            panel.begin(stream)

    def draw(self, moment: Moment) -> None:
        """Draw what is new."""
        for panel in [panel for panel in self.panels if moment.whole or panel.pictures]:
            try:
                panel.draw(self._stream, moment)
            except Exception as fault:  # a message that nobody foresaw must not take the other panels from the operator
                self.panels.remove(panel)
                self._remarks.append(f"{type(panel).__name__} is left out of the view: {fault!r}")
        for remark in self._remarks:
            at(self._stream, moment.time_ns)
            self._stream.log(f"{LOG}/view", rr.TextLog(remark, level=rr.TextLogLevel.ERROR))
        self._remarks.clear()

    def _science(self, config: Configuration) -> list[Panel]:
        """The science camera, where its image can be computed."""
        try:
            pupil = science_pupil(config.sensor)
        except LowfcError as error:
            self._remarks.append(f"no science camera: {error}")
            return []
        if pupil is None:
            self._remarks.append("no science camera: behind a Lyot stop its image is not modelled")
            return []
        return [Science(pupil, config.star.wavelength_nm)]
