"""Common options and camera settings of the drivers of GenICam cameras."""

from dataclasses import replace
from typing import Literal

from pydantic import Field

from lowfc.contract.configuration import Configuration
from lowfc.device import CameraSettings, DriverOptions

FRAME_ID_WRAP = 65535
"""GigE Vision counts frames from 1 to 65535, then from 1 again; all frame numbers are compared modulo 65535, also
those of 64 bits."""
WAIT_MS = 500
"""Longest wait for a frame."""
MAX_QUEUED = 2
"""Number of newest frames that may wait for the process. Older ones are dropped and count as lost: frames that arrive
while the process is suspended all see the same mirror shape."""


class GenicamOptions(DriverOptions):
    """Region and format of the frames; exposure and rate default to those of [camera]."""

    camera: str = ""
    """Serial number (basler), or identifier or address (aravis); empty for the first camera found."""
    rows: int = Field(ge=1)
    """Rows of the region read."""
    columns: int = Field(ge=1)
    """Columns of the region read."""
    region_row: int = Field(default=0, ge=0)
    """First row of the region read."""
    region_column: int = Field(default=0, ge=0)
    """First column of the region read."""
    pixel_format: Literal["Mono8", "Mono10", "Mono12", "Mono14", "Mono16"] = "Mono12"
    """Pixel format, unpacked."""
    exposure_us: float | None = Field(default=None, gt=0)
    """Exposure time."""
    rate_hz: float | None = Field(default=None, gt=0)
    """Frame rate of the camera, or of its trigger."""
    gain: float | None = None
    """Gain, in the camera's unit, mostly dB; by default the camera keeps its gain."""
    trigger: str = ""
    """Line that triggers each frame, by the camera's name for it (`Line1`); empty: free-running."""

    def settings(self, config: Configuration) -> CameraSettings:
        """Settings requested by the options; the bit depth follows from the pixel format."""
        configured = CameraSettings.configured(config, self.rows, self.columns)
        bits = int(self.pixel_format.removeprefix("Mono"))
        full_dn = 2**bits - 1
        return replace(
            configured,
            exposure_ns=configured.exposure_ns if self.exposure_us is None else round(self.exposure_us * 1e3),
            period_ns=configured.period_ns if self.rate_hz is None else round(1e9 / self.rate_hz),
            saturation_dn=min(configured.saturation_dn or full_dn, full_dn),
            bit_depth=bits,
            region_row=self.region_row,
            region_column=self.region_column,
            clock="realtime",
            number_wrap=FRAME_ID_WRAP,
        )
