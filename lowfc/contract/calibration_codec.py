"""Calibrations and camera settings as messages, both ways."""

from dataclasses import replace

import numpy as np

from lowfc.contract.messages import floats, from_timestamp, timestamp, wire
from lowfc.control.calibration import Calibration
from lowfc.control.camera import CameraSettings
from lowfc.optics.zernike import mode_name


def encode_calibration(calibration: Calibration, time_ns: int) -> bytes:
    """Calibration as a message."""
    message = wire.Calibration(
        timestamp=timestamp(time_ns),
        id=calibration.id,
        operator_hash=calibration.operator_hash,
        estimator=calibration.estimator,
        noll=calibration.noll,
        mode_names=[mode_name(index) for index in calibration.noll],
        wavelength_nm=calibration.wavelength_nm,
        rows=calibration.shape[0],
        columns=calibration.shape[1],
        reference=calibration.reference.tobytes(),
        response=calibration.response.tobytes(),
        reconstructor=calibration.reconstructor.tobytes(),
        mask=calibration.good.astype(np.uint8).tobytes(),
        dark=calibration.dark.tobytes(),
        flux_dn=calibration.flux_dn,
        saturation_dn=calibration.saturation_dn,
        mirror_rows=calibration.grid[0],
        mirror_columns=calibration.grid[1],
        modes_to_actuators=calibration.modes_to_actuators.tobytes(),
        actuators_to_modes=calibration.actuators_to_modes.tobytes(),
        camera=None if calibration.camera is None else wire_camera(calibration.camera),
    )
    return message.SerializeToString()


def identified(calibration: Calibration) -> Calibration:
    """The same calibration with its identity: SHA-256 of everything else in it."""
    return replace(calibration, id=calibration.identity())


def decode_calibration(message: wire.Calibration) -> Calibration:
    """Calibration of a message.

    Raises:
        ValueError: it is not whole, or not the one that its identity says.
    """
    pixels, modes = message.rows * message.columns, len(message.noll)
    actuators, seen = message.mirror_rows * message.mirror_columns, bool(message.actuators_to_modes)
    calibration = Calibration(
        noll=tuple(message.noll),
        reference=floats(message.reference, pixels),
        response=floats(message.response, pixels, modes),
        reconstructor=floats(message.reconstructor, modes, pixels),
        good=np.frombuffer(message.mask, dtype=np.uint8).astype(np.float32),
        dark=floats(message.dark, pixels),
        modes_to_actuators=floats(message.modes_to_actuators, actuators, modes),
        shape=(message.rows, message.columns),
        grid=(message.mirror_rows, message.mirror_columns),
        flux_dn=message.flux_dn,
        saturation_dn=message.saturation_dn,
        estimator=message.estimator,
        wavelength_nm=message.wavelength_nm,
        operator_hash=message.operator_hash,
        id=message.id,
        actuators_to_modes=floats(message.actuators_to_modes, *((modes, actuators) if seen else (0, 0))),
        camera=camera_settings(message.camera) if message.HasField("camera") else None,
    )
    if calibration.identity() != message.id:
        raise ValueError(f"calibration {message.id[:12]} is not whole: its content has another identity")
    return calibration


def wire_camera(camera: CameraSettings) -> wire.CameraState:
    """Camera settings as a message."""
    return wire.CameraState(
        timestamp=timestamp(camera.time_ns),
        gain_e_per_dn=camera.gain_e_per_dn,
        bias_dn=camera.bias_dn,
        read_noise_e=camera.read_noise_e,
        saturation_dn=camera.saturation_dn,
        region_row=camera.region[0],
        region_column=camera.region[1],
        rows=camera.shape[0],
        columns=camera.shape[1],
        em_gain=camera.em_gain,
        start_s=camera.start_s,
    )


def camera_settings(message: wire.CameraState, start_s: int = 0) -> CameraSettings:
    """Camera settings of a message, published by a camera that started at `start_s`; 0 for the message's own."""
    return CameraSettings(
        from_timestamp(message.timestamp),
        (message.rows, message.columns),
        message.bias_dn,
        message.saturation_dn,
        message.gain_e_per_dn,
        message.em_gain,
        message.read_noise_e,
        (message.region_row, message.region_column),
        start_s or message.start_s,
    )
