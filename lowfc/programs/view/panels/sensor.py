"""Sensor panel: the frame, its difference from the reference image, the reference image, and the raw frame."""

import numpy as np
import rerun as rr

from lowfc.arrays import Single
from lowfc.control.calibration.calibration import Calibration
from lowfc.control.loop.estimator import difference
from lowfc.programs.view.draw.colours import Rgb, sequential
from lowfc.programs.view.draw.pictures import Picture, Scale, SignedPicture
from lowfc.programs.view.panels.panel import Panel
from lowfc.programs.view.snapshot import Snapshot

FRAME, DIFFERENCE, REFERENCE, RAW = "sensor/frame", "sensor/difference", "sensor/reference", "sensor/raw"


class Sensor(Panel):
    """Pictures of the newest frame, its difference from the reference image, and the calibration's reference image."""

    pictures = True
    period_ns = 500_000_000  # between two raw frames

    def __init__(self) -> None:
        self._calibration: Calibration | None = None
        self._difference = np.zeros(0, np.float32)
        self._frame, self._reference = Picture(FRAME), Picture(REFERENCE)
        self._change = SignedPicture(DIFFERENCE, "DN")
        self._brightest = Scale(10.0)

    def draw(self, stream: rr.RecordingStream, snapshot: Snapshot) -> None:
        """Show the newest frame."""
        calibration, frame, time_ns = snapshot.calibration, snapshot.frame, snapshot.frame_ns
        if calibration is not None and calibration is not self._calibration:
            self._calibration = calibration
            self._difference = np.empty(calibration.dark.size, np.float32)
            expected_dn = (calibration.reference * calibration.flux_dn).reshape(calibration.shape)
            limit_dn = float(expected_dn.max())
            caption = f"0 to {limit_dn:.0f} DN expected, logarithmic"
            self._reference.show(stream, snapshot.time_ns, _log_stretched(expected_dn, limit_dn), caption)
        if frame is None:
            return
        light_dn = frame.astype(np.float32)
        if calibration is not None and calibration.shape == frame.shape:
            light_dn = np.maximum(light_dn - calibration.dark.reshape(frame.shape), 0)
            # Without light the difference is undefined; zero is shown.
            flux_dn = difference(calibration, frame.ravel(), 0.0, self._difference) or 0.0
            change_dn = self._difference * flux_dn * calibration.good if flux_dn else np.zeros(frame.size)
            self._change.show_values(stream, time_ns, change_dn.reshape(frame.shape))
        self._brightest.fit(light_dn, time_ns)
        limit_dn = self._brightest.limit
        caption = f"0 to {limit_dn:g} DN, logarithmic"
        self._frame.show(stream, time_ns, _log_stretched(light_dn, limit_dn), caption)
        if self.due(snapshot):
            stream.log(RAW, rr.Image(frame, color_model="L"))


def _log_stretched(light_dn: Single, limit_dn: float) -> Rgb:
    """Colours of the two decades below the limit, logarithmic; anything darker is nearly black."""
    knee_dn = np.float32(limit_dn * 1e-2)
    return sequential(np.log1p(np.maximum(light_dn, 0) / knee_dn) / np.log1p(limit_dn / knee_dn))
