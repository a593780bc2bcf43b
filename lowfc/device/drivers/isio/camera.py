"""Driver of a camera whose images another program writes to an ImageStreamIO stream."""

import time
from dataclasses import fields, replace
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field

from lowfc.adapters.image_stream.reader import StreamReader
from lowfc.adapters.image_stream.stream import Stream, StreamError, stream_path
from lowfc.adapters.process.service import Service
from lowfc.arrays import Pixels
from lowfc.contract.configuration import Configuration
from lowfc.device import CameraSettings, DriverOptions, Exposure

Setting = Literal[
    "exposure_s", "gain_e_per_dn", "bias_dn", "read_noise_e", "saturation_dn", "em_gain", "region_row", "region_column"
]
_INTEGERS = ("region_row", "region_column")
_WAIT_S = 0.5
_FULL_DN = 65535


class IsioCamera:
    """Camera driver that reads another program's stream."""

    class Options(DriverOptions):
        """Stream and camera settings; those not given are taken from [camera]."""

        stream: str
        """Name of the stream."""
        atime: Literal["end", "start", "none"] = "end"
        """Meaning of the stream's `atime`: end or start of the exposure; none: frames are timed when read."""
        scale_dn: float = 1.0
        """DN per unit of a pixel."""
        zero_dn: float = 0.0
        """DN of a pixel with value 0."""
        exposure_us: float | None = Field(default=None, gt=0)
        """Exposure time."""
        gain_e_per_dn: float | None = Field(default=None, gt=0)
        """Conversion gain."""
        bias_dn: float | None = None
        """Level without light."""
        read_noise_e: float | None = Field(default=None, ge=0)
        """Read noise of one pixel."""
        saturation_dn: float | None = Field(default=None, gt=0)
        """Highest value of a pixel, bias included; default: the configured one, at most the converter's."""
        bit_depth: int | None = Field(default=None, ge=1, le=16)
        """Bits of the converter."""
        em_gain: float | None = Field(default=None, ge=1)
        """Electron-multiplying gain."""
        region_row: int = Field(default=0, ge=0)
        """First row of the region read."""
        region_column: int = Field(default=0, ge=0)
        """First column of the region read."""
        keywords: dict[Setting, str] = Field(default_factory=dict)
        """Keywords of the stream that contain settings, in the setting's unit: `{exposure_s = "tint"}`."""

    def __init__(self, options: Options, config: Configuration) -> None:
        """Open the stream."""
        self._options = options
        self._reader = StreamReader(stream_path(options.stream))
        if self._reader.stream is None:
            raise StreamError(
                f"there is no stream {options.stream!r} ({stream_path(options.stream)}): start the camera's program, "
                "or set MILK_SHM_DIR to its folder"
            )
        shape = self._reader.stream.layout.shape[1:]
        settings = options.model_dump(include={part.name for part in fields(CameraSettings)}, exclude_none=True)
        if options.exposure_us is not None:
            settings["exposure_ns"] = round(options.exposure_us * 1e3)
        configured = CameraSettings.configured(config, *shape)
        if options.bit_depth is not None:
            full_dn = 2**options.bit_depth - 1
            settings.setdefault("saturation_dn", min(configured.saturation_dn or full_dn, full_dn))
        self._settings = replace(configured, clock="realtime", **settings)
        self._generation = self._reader.generation
        self._silent, self._image_s = False, time.monotonic()

    def join(self, service: Service) -> None:
        """Keep the process's service for events."""
        self._service = service

    def settings(self) -> CameraSettings:
        """Settings as configured; the size and the settings in keywords come from the stream."""
        stream = self._reader.stream
        if stream is not None and stream.current():
            rows, columns = stream.layout.shape[1:]
            in_stream = self._from_keywords(stream) if self._options.keywords else {}
            self._settings = replace(self._settings, rows=rows, columns=columns, **in_stream)
        return self._settings

    def expose(self) -> Exposure | None:
        """Next image of the stream."""
        image = self._reader.next(_WAIT_S)
        if image is None:
            if not self._silent and time.monotonic() - self._image_s >= 2e-9 * self._settings.period_ns:
                self._silent = True
                self._service.event("STREAM_SILENT", stream=self._options.stream, why=self._reader.silence_cause())
            return None
        self._silent, self._image_s = False, time.monotonic()
        if image.generation != self._generation:
            self._generation = image.generation
            rows, columns = image.pixels.shape
            self._service.event("STREAM_RENEWED", stream=self._options.stream, columns=columns, rows=rows)
        start = self._options.atime == "start"
        end_ns = image.acquired_ns + (self._settings.exposure_ns if start else 0)
        return Exposure(self._in_dn(image.pixels), None if self._options.atime == "none" else end_ns, image.number)

    def close(self) -> None:
        """Release the semaphore."""
        self._reader.close()

    def _from_keywords(self, stream: Stream) -> dict[str, Any]:
        keywords, settings = stream.keywords(), dict[str, Any]()
        for setting, keyword in self._options.keywords.items():
            if isinstance(value := keywords.get(keyword), str):
                raise StreamError(f"keyword {keyword!r} of stream {stream.name!r} is {value!r}, expected a number")
            if value is not None:
                settings[setting] = value
        if "exposure_s" in settings:
            settings["exposure_ns"] = round(settings.pop("exposure_s") * 1e9)
        return {name: int(value) if name in _INTEGERS else value for name, value in settings.items()}

    def _in_dn(self, pixels: npt.NDArray[np.generic]) -> Pixels:
        scale, zero = self._options.scale_dn, self._options.zero_dn
        if pixels.dtype == np.uint16 and (scale, zero) == (1, 0):
            return pixels  # type: ignore[return-value]
        scaled = np.rint(pixels.astype(np.float64) * scale + zero)
        return np.nan_to_num(scaled, nan=0).clip(0, _FULL_DN).astype(np.uint16)
