"""The sensor's pictures: the frame, what it differs by from the reference, and the reference itself."""

import numpy as np
import numpy.typing as npt
import rerun as rr
import rerun.blueprint as rrb

from lowfc.control.calibration import Calibration
from lowfc.control.estimator import difference
from lowfc.programs.view.colours import Rgb, diverging, sequential
from lowfc.programs.view.marks import Pictures, caption
from lowfc.programs.view.moment import Moment
from lowfc.programs.view.panel import Panel
from lowfc.programs.view.scale import Scale

FRAME, DIFFERENCE, REFERENCE, RAW = "sensor/frame", "sensor/difference", "sensor/reference", "sensor/raw"
_RAW_PERIOD_NS = 500_000_000
_LEAST_DN = 10.0

Single = npt.NDArray[np.float32]


class Sensor(Panel):
    """Frame and difference as they come; the reference when there is another."""

    pictures = True

    def __init__(self) -> None:
        self._calibration: Calibration | None = None
        self._difference = np.zeros(0, np.float32)
        self._frames, self._differences, self._references = Pictures(FRAME), Pictures(DIFFERENCE), Pictures(REFERENCE)
        self._brightest = Scale(_LEAST_DN)
        self._stretch = np.zeros((1, 3), np.uint8)
        self._largest = Scale(_LEAST_DN / 10)
        self._raw_due_ns = 0

    def draw(self, stream: rr.RecordingStream, moment: Moment) -> None:
        """Show the newest frame."""
        if moment.calibration is not None and moment.calibration is not self._calibration:
            self._calibrate(stream, moment.calibration, moment.time_ns)
        if moment.frame is None:
            return
        calibration, dark_dn = self._calibration, 0
        if calibration is not None and calibration.shape == moment.frame.shape:
            dark_dn = round(float(calibration.dark[0]))
            self._show_difference(stream, calibration, moment.frame, moment.frame_ns)
        self._show_frame(stream, moment.frame, dark_dn, moment.frame_ns)
        if moment.frame_ns >= self._raw_due_ns:
            self._raw_due_ns = moment.frame_ns + _RAW_PERIOD_NS
            stream.log(RAW, rr.Image(moment.frame, color_model="L"))

    def _show_frame(
        self, stream: rr.RecordingStream, frame: npt.NDArray[np.uint16], dark_dn: int, time_ns: int
    ) -> None:
        brightest = np.array([max(0, int(frame.max()) - dark_dn)])
        changed = self._brightest.fit(brightest, time_ns)
        limit = round(self._brightest.limit)
        if changed:  # a colour for each DN: looking up is cheaper than a logarithm of every pixel
            self._stretch = _log_stretched(np.arange(limit + 1, dtype=np.float32), limit)
        light = np.clip(frame, dark_dn, dark_dn + limit) - np.uint16(dark_dn)
        self._frames.show(stream, time_ns, np.take(self._stretch, light, axis=0))
        if changed:
            caption(stream, FRAME, f"0 to {limit} DN, logarithmic", frame.shape)

    def _calibrate(self, stream: rr.RecordingStream, calibration: Calibration, time_ns: int) -> None:
        self._calibration = calibration
        self._difference = np.empty(calibration.dark.size, np.float32)
        reference_dn = (calibration.reference * calibration.flux_dn).reshape(calibration.shape)
        limit_dn = float(reference_dn.max())
        self._references.show(stream, time_ns, _log_stretched(reference_dn, limit_dn))
        caption(stream, REFERENCE, f"0 to {limit_dn:.0f} DN expected, logarithmic", calibration.shape)

    def _show_difference(
        self, stream: rr.RecordingStream, calibration: Calibration, frame: npt.NDArray[np.uint16], time_ns: int
    ) -> None:
        flux_dn = difference(calibration, frame.ravel(), 0.0, self._difference)
        if flux_dn is None:  # no light: nothing differs
            self._difference.fill(0.0)
            flux_dn = 0.0
        change_dn = (self._difference * flux_dn * calibration.good).reshape(frame.shape)
        changed = self._largest.fit(change_dn, time_ns)
        self._differences.show(stream, time_ns, diverging(change_dn / self._largest.limit))
        if changed:
            text = f"blue -{self._largest.limit:g}, orange +{self._largest.limit:g} DN"
            caption(stream, DIFFERENCE, text, frame.shape)


def frame_view() -> rrb.View:
    """The frame."""
    return rrb.Spatial2DView(origin=FRAME, name="Sensor frame, DN")


def difference_view() -> rrb.View:
    """What differs from the reference."""
    return rrb.Spatial2DView(origin=DIFFERENCE, name="I - I0, DN")


def reference_view() -> rrb.View:
    """The reference."""
    return rrb.Spatial2DView(origin=REFERENCE, name="Reference I0, DN")


def raw_view() -> rrb.View:
    """The frame's own values, to be read with the pointer."""
    return rrb.Spatial2DView(origin=RAW, name="Frame as it came, DN")


def _log_stretched(light_dn: Single, limit_dn: float) -> Rgb:
    """Two decades below the limit, in colours; less light is nearly black."""
    knee_dn = np.float32(limit_dn * 1e-2)
    return sequential(np.log1p(np.maximum(light_dn, 0) / knee_dn) / np.log1p(limit_dn / knee_dn))
