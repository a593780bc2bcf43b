"""Everything that is shown, drawn onto a stream moment by moment."""

from collections.abc import Callable
from dataclasses import dataclass

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
from lowfc.programs.view.trend import Trend
from lowfc.programs.view.wavefront import Wavefront

RETRY_NS = 5_000_000_000
"""After which a panel that failed is made again."""


@dataclass(slots=True)
class _Slot:
    """Where a panel belongs: how to make it, it or None while it is left out, and when to try again."""

    make: Callable[[], Panel]
    panel: Panel | None = None
    again_ns: int = 0


class Painter:
    """All panels of a view.

    A message that nobody foresaw must not take more from the operator than the panel that it breaks, nor that for ever:
    it is left out, with a line in the view's log, and made again a little later.
    """

    def __init__(self, config: Configuration, stream: rr.RecordingStream) -> None:
        self._stream = stream
        self._remarks: list[str] = []
        nm_per_mas = tilt_nm_per_mas(config.star.diameter_m)
        made: list[Callable[[], Panel]] = [
            lambda: Tiles(nm_per_mas),
            Sensor,
            Mirror,
            lambda: Wavefront(nm_per_mas),
            lambda: Pointing(nm_per_mas),
            Trend,
            Loop,
            Latency,
            Spectra,
            *self._science(config),
        ]
        self._slots = [_Slot(make) for make in made]
        for slot in self._slots:
            self._make(slot)

    @property
    def panels(self) -> list[Panel]:
        """Those that are drawn."""
        return [slot.panel for slot in self._slots if slot.panel is not None]

    def draw(self, moment: Moment) -> None:
        """Draw what is new."""
        for slot in self._slots:
            if slot.panel is None and moment.time_ns >= slot.again_ns:
                self._make(slot)
            if slot.panel is not None and (moment.whole or slot.panel.pictures):
                self._draw(slot, slot.panel, moment)
        for remark in self._remarks:
            at(self._stream, moment.time_ns)
            self._stream.log(f"{LOG}/view", rr.TextLog(remark, level=rr.TextLogLevel.ERROR))
        self._remarks.clear()

    def _make(self, slot: _Slot) -> None:
        slot.panel = slot.make()
        slot.panel.begin(self._stream)

    def _draw(self, slot: _Slot, panel: Panel, moment: Moment) -> None:
        try:
            panel.draw(self._stream, moment)
        except Exception as fault:
            slot.panel, slot.again_ns = None, moment.time_ns + RETRY_NS
            self._remarks.append(f"{type(panel).__name__} is left out of the view for a while: {fault!r}")

    def _science(self, config: Configuration) -> list[Callable[[], Panel]]:
        """The science camera, where its image can be computed."""
        try:
            pupil = science_pupil(config.sensor)
        except LowfcError as error:
            self._remarks.append(f"no science camera: {error}")
            return []
        if pupil is None:
            self._remarks.append("no science camera: behind a Lyot stop its image is not modelled")
            return []
        return [lambda: Science(pupil, config.star.wavelength_nm)]
