"""Encode and decode calibrations and camera settings."""

from dataclasses import replace
from typing import Any

import numpy as np

from lowfc.contract.messages import fields_of, floats, from_timestamp, timestamp, wire
from lowfc.control.calibration.calibration import Calibration, array_shapes
from lowfc.control.loop.camera import CameraSettings
from lowfc.optics.chain.zernike import mode_name

# Fields of the same name in values and messages.
_PLAIN = ("id", "operator_hash", "estimator", "noll", "wavelength_nm", "flux_dn", "saturation_dn")
_ARRAYS = ("reference", "response", "reconstructor", "dark", "modes_to_actuators", "actuators_to_modes")
_CAMERA = ("bias_dn", "saturation_dn", "gain_e_per_dn", "em_gain", "read_noise_e")


def encode_calibration(calibration: Calibration, time_ns: int) -> bytes:
    """Calibration as a message."""
    message = wire.Calibration(
        timestamp=timestamp(time_ns),
        mode_names=[mode_name(index) for index in calibration.noll],
        rows=calibration.shape[0],
        columns=calibration.shape[1],
        mask=calibration.good.astype(np.uint8).tobytes(),
        mirror_rows=calibration.grid[0],
        mirror_columns=calibration.grid[1],
        camera=None if calibration.camera is None else wire_camera(calibration.camera),
        **fields_of(calibration, _PLAIN),
        **{name: getattr(calibration, name).tobytes() for name in _ARRAYS},
    )
    return message.SerializeToString()


def with_identity(calibration: Calibration) -> Calibration:
    """The calibration with its correct `id`, see `Calibration.identity`."""
    return replace(calibration, id=calibration.identity())


def decode_calibration(message: wire.Calibration) -> Calibration:
    """Calibration of a message; ValueError if it is incomplete or its content does not match its identity."""
    shape, grid = (message.rows, message.columns), (message.mirror_rows, message.mirror_columns)
    shapes = array_shapes(len(message.noll), shape, grid)
    if not message.actuators_to_modes:
        shapes["actuators_to_modes"] = (0, 0)
    plain = fields_of(message, _PLAIN) | {"noll": tuple(message.noll)}
    arrays: dict[str, Any] = {name: floats(getattr(message, name), *shapes[name]) for name in _ARRAYS}
    calibration = Calibration(
        good=np.frombuffer(message.mask, dtype=np.uint8).astype(np.float32),
        shape=shape,
        grid=grid,
        camera=camera_settings(message.camera) if message.HasField("camera") else None,
        **plain,
        **arrays,
    )
    if calibration.identity() != message.id:
        raise ValueError(f"calibration {message.id[:12]} is damaged: its content has another identity")
    return calibration


def wire_camera(camera: CameraSettings) -> wire.CameraState:
    """Camera settings as a message."""
    return wire.CameraState(
        timestamp=timestamp(camera.time_ns),
        region_row=camera.region[0],
        region_column=camera.region[1],
        rows=camera.shape[0],
        columns=camera.shape[1],
        start_s=camera.start_s,
        **fields_of(camera, _CAMERA),
    )


def camera_settings(message: wire.CameraState, start_s: int = 0) -> CameraSettings:
    """Camera settings of a message; `start_s` is the camera's start, unix seconds, 0 for the start in the message."""
    return CameraSettings(
        from_timestamp(message.timestamp),
        (message.rows, message.columns),
        region=(message.region_row, message.region_column),
        start_s=start_s or message.start_s,
        **fields_of(message, _CAMERA),
    )
