"""Drivers of cameras and mirrors: their interfaces, and the main loops that call them."""

from lowfc.adapters.process.service import Service
from lowfc.arrays import Pixels, Single
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import ConfigurationError
from lowfc.device.camera_clock import CameraClock
from lowfc.device.driver import (
    Camera,
    CameraExtras,
    CameraSettings,
    DriverOptions,
    Exposure,
    Geometry,
    Mirror,
    MirrorExtras,
    Need,
    Puts,
    geometry,
)
from lowfc.device.run import run_camera, run_mirror
from lowfc.device.volts import VoltMap, VoltOptions

__all__ = [
    "Camera",
    "CameraClock",
    "CameraExtras",
    "CameraSettings",
    "Configuration",
    "ConfigurationError",
    "DriverOptions",
    "Exposure",
    "Geometry",
    "Mirror",
    "MirrorExtras",
    "Need",
    "Pixels",
    "Puts",
    "Service",
    "Single",
    "VoltMap",
    "VoltOptions",
    "geometry",
    "run_camera",
    "run_mirror",
]
