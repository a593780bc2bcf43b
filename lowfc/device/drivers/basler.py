"""Driver of Basler cameras, through the vendor's package pypylon."""

import importlib
import re
from dataclasses import replace
from typing import Any

import numpy as np

from lowfc.adapters.process.extras import install_advice, package_required
from lowfc.device import CameraSettings, Configuration, ConfigurationError, Exposure, Need
from lowfc.device.drivers.genicam import MAX_QUEUED, WAIT_MS, GenicamOptions

_EXPOSURES = "ExposureTime", "ExposureTimeAbs"
"""Node names of newer and older cameras; the emulation has both, and the older one takes effect."""
_RATES = "AcquisitionFrameRate", "AcquisitionFrameRateAbs"
_RESULTS = "ResultingFrameRate", "ResultingFrameRateAbs", "BslResultingAcquisitionFrameRate"
_BUFFERS = 16


def _pylon() -> Any:
    with package_required("the driver basler requires the package pypylon", "basler"):
        return importlib.import_module("pypylon.pylon")


class BaslerCamera:
    """Camera driver; lost and failed frames appear as gaps in the camera's frame numbers."""

    Options = GenicamOptions
    _lost = False

    def __init__(self, options: GenicamOptions, config: Configuration) -> None:
        """Open and configure the camera."""
        self._pylon, self._options, self._settings = _pylon(), options, options.settings(config)
        try:
            self._open(options.camera)
        except importlib.import_module("pypylon.genicam").GenericException as fault:
            which = options.camera or "(the first found)"
            why = re.split(r" : \w+ thrown", str(fault))[0]  # without the line of the library's source
            raise ConfigurationError(f"Basler camera {which}: {why}") from None

    @classmethod
    def needs(cls, options: GenicamOptions) -> list[Need]:
        """Requirements: the package, and a camera that it detects."""
        try:
            pylon = _pylon()
        except ConfigurationError:
            return [Need("pypylon", "", install_advice("basler"))]
        detected = [device.GetFriendlyName() for device in pylon.TlFactory.GetInstance().EnumerateDevices()]
        advice = "connect one and switch it on; PYLON_CAMEMU=1 in the environment emulates one"
        return [Need("pypylon", pylon.GetPylonVersionString(), ""), Need("a camera", ", ".join(detected), advice)]

    def start(self) -> None:
        """Start grabbing."""
        self._camera.StartGrabbing(self._pylon.GrabStrategy_LatestImages)

    def settings(self) -> CameraSettings:
        """Settings as the camera accepted them."""
        return self._settings

    def expose(self) -> Exposure | None:
        """Next complete frame; a camera that was disconnected is opened again."""
        if self._lost or self._camera.IsCameraDeviceRemoved():
            self._lost = True
            self._open(self._serial)
            self.start()
            self._lost = False
        result = self._camera.RetrieveResult(WAIT_MS, self._pylon.TimeoutHandling_Return)
        if not result.IsValid():
            return None
        with result:
            if not result.GrabSucceeded():
                return None
            return Exposure(result.GetArray().astype(np.uint16), None, result.GetBlockID())

    def close(self) -> None:
        """Release the camera."""
        self._camera.Close()

    def _open(self, serial: str) -> None:
        info, factory = self._pylon.DeviceInfo(), self._pylon.TlFactory.GetInstance()
        if serial:
            info.SetSerialNumber(serial)
        self._camera = camera = self._pylon.InstantCamera(factory.CreateFirstDevice(info))
        self._serial = serial or camera.GetDeviceInfo().GetSerialNumber()
        camera.Open()
        self._configure(self._options)

    def _configure(self, options: GenicamOptions) -> None:
        camera, settings = self._camera, self._settings
        camera.PixelFormat.Value = options.pixel_format
        camera.OffsetX.Value = camera.OffsetY.Value = 0  # otherwise the size may not fit
        camera.Width.Value, camera.Height.Value = options.columns, options.rows
        camera.OffsetX.Value, camera.OffsetY.Value = options.region_column, options.region_row
        self._write(("ExposureAuto", "GainAuto"), "Off")
        self._write(_EXPOSURES, settings.exposure_ns * 1e-3)
        if options.gain is not None:
            camera.Gain.Value = options.gain
        camera.TriggerSelector.Value = "FrameStart"
        camera.TriggerMode.Value = "On" if options.trigger else "Off"
        period_ns = settings.period_ns
        if options.trigger:
            camera.TriggerSource.Value = options.trigger
        else:
            camera.AcquisitionFrameRateEnable.Value = True
            self._write(_RATES, 1e9 / period_ns)
            period_ns = round(1e9 / min(self._read(_RESULTS + _RATES)))
        camera.MaxNumBuffer.Value, camera.OutputQueueSize.Value = _BUFFERS, MAX_QUEUED
        exposure_ns = round(self._read(_EXPOSURES)[0] * 1e3)
        self._settings = replace(settings, exposure_ns=exposure_ns, period_ns=period_ns)

    def _write(self, names: tuple[str, ...], value: float | str) -> None:
        for node in (getattr(self._camera, name) for name in names):
            if node.IsWritable():
                node.Value = value

    def _read(self, names: tuple[str, ...]) -> list[float]:
        return [node.Value for name in names if (node := getattr(self._camera, name)).IsReadable()]
