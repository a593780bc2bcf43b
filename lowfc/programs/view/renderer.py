"""Everything that is shown, drawn onto a stream snapshot by snapshot."""

from collections.abc import Callable
from dataclasses import dataclass

import rerun as rr

from lowfc.adapters.files.sensors import science_pupil
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import LowfcError
from lowfc.optics.detector.photometry import tilt_nm_per_mas
from lowfc.programs.view.draw.plots import at
from lowfc.programs.view.panels.latency import Latency
from lowfc.programs.view.panels.loop import LOG, Loop
from lowfc.programs.view.panels.mirror import Mirror
from lowfc.programs.view.panels.panel import Panel
from lowfc.programs.view.panels.pointing import Pointing
from lowfc.programs.view.panels.science import Science
from lowfc.programs.view.panels.sensor import Sensor
from lowfc.programs.view.panels.spectra import Spectra
from lowfc.programs.view.panels.tiles import Tiles
from lowfc.programs.view.panels.trend import Trend
from lowfc.programs.view.panels.wavefront import Wavefront
from lowfc.programs.view.snapshot import Snapshot

RETRY_NS = 5_000_000_000
"""After which a panel that failed is made again."""


@dataclass(slots=True)
class _Slot:
    """A panel's place: how to make it, the panel or None while it is left out, and when to try again."""

    make: Callable[[], Panel]
    panel: Panel | None = None
    again_ns: int = 0


class Renderer:
    """All panels of a view.

    An unforeseen message must take no more from the operator than the panel that it breaks, and not for ever: the
    panel is left out, with a line in the view's log, and made again a little later.
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
        ]
        try:
            pupil = science_pupil(config.sensor)
            if pupil is not None:
                made.append(lambda: Science(pupil, config.star.wavelength_nm))
            else:
                self._remarks.append("no science camera: behind a Lyot stop its image is not modelled")
        except LowfcError as error:
            self._remarks.append(f"no science camera: {error}")
        self._slots = [_Slot(make) for make in made]
        for slot in self._slots:
            self._make(slot)

    @property
    def panels(self) -> list[Panel]:
        """Those that are drawn."""
        return [slot.panel for slot in self._slots if slot.panel is not None]

    def draw(self, snapshot: Snapshot) -> None:
        """Draw what is new."""
        for slot in self._slots:
            if slot.panel is None and snapshot.time_ns >= slot.again_ns:
                self._make(slot)
            if slot.panel is not None and (snapshot.complete or slot.panel.pictures):
                try:
                    slot.panel.draw(self._stream, snapshot)
                except Exception as fault:
                    self._remarks.append(f"{type(slot.panel).__name__} is left out of the view for a while: {fault!r}")
                    slot.panel, slot.again_ns = None, snapshot.time_ns + RETRY_NS
        for remark in self._remarks:
            at(self._stream, snapshot.time_ns)
            self._stream.log(f"{LOG}/view", rr.TextLog(remark, level=rr.TextLogLevel.ERROR))
        self._remarks.clear()

    def _make(self, slot: _Slot) -> None:
        slot.panel = slot.make()
        slot.panel.begin(self._stream)
