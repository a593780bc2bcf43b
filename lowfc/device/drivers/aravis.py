"""Driver of GigE Vision and USB3 Vision cameras, through the system's library aravis."""

import importlib
from dataclasses import replace
from typing import Any

import numpy as np

from lowfc.device import CameraSettings, Configuration, ConfigurationError, Exposure, Need
from lowfc.device.drivers.genicam import MAX_QUEUED, WAIT_MS, GenicamOptions

ADVICE = (
    "Debian: apt install gir1.2-aravis-0.8 python3-gi; then make the package gi visible to this Python, with an "
    "environment made by `python3 -m venv --system-site-packages`, or, if the system's Python has the same version, "
    "with a link to /usr/lib/python3/dist-packages/gi in its site-packages"
)
_BUFFERS = 32


def _aravis() -> Any:
    try:
        importlib.import_module("gi").require_version("Aravis", "0.8")
        return importlib.import_module("gi.repository.Aravis")
    except (ImportError, ValueError) as fault:
        raise ConfigurationError(f"the driver aravis needs aravis 0.8 and PyGObject ({fault}). {ADVICE}") from None


class AravisCamera:
    """Camera driver; frames with missing packets are dropped and appear as gaps in the camera's frame numbers."""

    Options = GenicamOptions
    _lost = False

    def __init__(self, options: GenicamOptions, config: Configuration) -> None:
        """Open and configure the camera."""
        self._aravis, self._options, self._settings = _aravis(), options, options.settings(config)
        try:
            self._open(options.camera)
        except importlib.import_module("gi.repository.GLib").Error as fault:
            raise ConfigurationError(f"camera {options.camera or '(the first found)'}: {fault.message}") from None

    @classmethod
    def needs(cls, options: GenicamOptions) -> list[Need]:
        """Requirements: the library, and a camera that it detects."""
        try:
            aravis = _aravis()
        except ConfigurationError as fault:
            return [Need("aravis", "", str(fault))]
        aravis.update_device_list()
        detected = [aravis.get_device_id(index) for index in range(aravis.get_n_devices())]
        advice = "connect one; `arv-tool-0.8` lists the connected cameras"
        return [Need("aravis", "0.8", ""), Need("a camera", ", ".join(detected), advice)]

    def start(self) -> None:
        """Start the acquisition."""
        self._camera.start_acquisition()

    def settings(self) -> CameraSettings:
        """Settings; exposure time and, without a trigger, frame period are those that the camera reports."""
        return self._settings

    def expose(self) -> Exposure | None:
        """Next complete frame, timed at its first packet, just after the exposure; a lost camera is opened again."""
        if self._lost:
            try:
                self._open(self._name)
                self.start()
            except BaseException:
                self._lost = True
                raise
        buffer = self._stream.timeout_pop_buffer(WAIT_MS * 1000)
        if buffer is None:
            return None
        while self._stream.get_n_buffers()[1] >= MAX_QUEUED:
            self._stream.push_buffer(buffer)
            buffer = self._stream.timeout_pop_buffer(0)
        try:
            if buffer.get_status() != self._aravis.BufferStatus.SUCCESS:
                return None
            dtype = np.uint8 if self._settings.bit_depth == 8 else np.dtype("<u2")
            shape = buffer.get_image_height(), buffer.get_image_width()
            pixels = np.frombuffer(buffer.get_image_data(), dtype).reshape(shape).astype(np.uint16)
            return Exposure(pixels, buffer.get_system_timestamp(), buffer.get_frame_id())
        finally:
            self._stream.push_buffer(buffer)

    def close(self) -> None:
        """Stop the acquisition."""
        if not self._lost:
            self._camera.stop_acquisition()

    def _open(self, name: str) -> None:
        self._camera = camera = self._aravis.Camera.new(name or None)
        self._name, self._lost = name or camera.get_device_id(), False  # before `connect`: the signal may come at once
        camera.get_device().connect("control-lost", self._mark_lost)
        self._configure(self._options)
        self._stream = camera.create_stream(None, None)
        if camera.is_gv_device():  # a resent packet would arrive too late
            self._stream.set_property("packet-resend", self._aravis.GvStreamPacketResend.NEVER)
        for _ in range(_BUFFERS):
            self._stream.push_buffer(self._aravis.Buffer.new_allocate(camera.get_payload()))

    def _mark_lost(self, device: Any) -> None:
        self._lost = True

    def _configure(self, options: GenicamOptions) -> None:
        camera, settings = self._camera, self._settings
        camera.set_range_check_policy(self._aravis.RangeCheckPolicy.ENABLE)
        camera.set_pixel_format_from_string(options.pixel_format)
        camera.set_region(options.region_column, options.region_row, options.columns, options.rows)
        if camera.is_exposure_auto_available():
            camera.set_exposure_time_auto(self._aravis.Auto.OFF)
        if camera.is_gain_auto_available():
            camera.set_gain_auto(self._aravis.Auto.OFF)
        camera.set_exposure_time(settings.exposure_ns * 1e-3)
        if options.gain is not None:
            camera.set_gain(options.gain)
        period_ns = settings.period_ns
        if options.trigger:
            camera.set_trigger(options.trigger)
        else:
            camera.clear_triggers()
            camera.set_frame_rate(1e9 / period_ns)
            period_ns = round(1e9 / camera.get_frame_rate())
        self._settings = replace(settings, exposure_ns=round(camera.get_exposure_time() * 1e3), period_ns=period_ns)
