"""A camera before calibration: size and rate of its frames, dark, bad pixels, and the reference image."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lowfc.arrays import Array
from lowfc.client import Frame
from lowfc.contract.codecs.calibration_codec import camera_settings
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import CalibrationError, raised_as
from lowfc.contract.messages import wire
from lowfc.control.calibration.calibration import Calibration
from lowfc.control.calibration.dark_frames import check_dark, measure_dark
from lowfc.control.loop.camera import CameraSettings
from lowfc.programs.commissioning.calibrate.recording import Report
from lowfc.programs.commissioning.checks import Status
from lowfc.programs.commissioning.conformance.settings import agreement_checks

MAX_RATE_DIFFERENCE = 0.05
"""Largest relative difference between the rate of the frames' times and the rate in the camera's settings."""
_MAX_BRIGHTNESS = 0.9  # largest value of a good pixel in the reference frames, as a fraction of saturation
_NS_PER_S = 1e9


class Sensor(NamedTuple):
    """Settings, dark and bad pixels of a camera.

    Attributes:
        camera: settings of the camera.
        dark_dn: dark (pixels,), DN: mean of the dark frames, or the camera's bias.
        good: 1 for each pixel used, 0 otherwise (pixels,).
        measured: whether the dark was measured.
    """

    camera: CameraSettings
    dark_dn: Array
    good: Array
    measured: bool


def checked_camera(
    config: Configuration, state: wire.CameraState, images: Sequence[Frame], report: Report
) -> CameraSettings:
    """The camera's settings; CalibrationError if the frames or the configuration contradict them."""
    checks = list(agreement_checks(config, state))
    faults = [
        f"{check.name}: the camera has {check.got}, expected {check.expected}; {check.advice}"
        for check in checks
        if check.status is Status.WRONG
    ]
    shapes = {image.pixels.shape for image in images}
    if shapes != {(state.rows, state.columns)}:
        sizes = ", ".join(f"{rows} x {columns}" for rows, columns in sorted(shapes))
        faults.append(f"size: the camera reports {state.rows} x {state.columns} pixels, its frames have {sizes}")
    period_ns = float(np.median(np.diff([image.time_ns for image in images])))
    if not (state.period_ns and period_ns > 0):
        faults.append(f"times: the camera's period_ns is {state.period_ns}, but its frames are {period_ns:g} ns apart")
    elif abs(period_ns / state.period_ns - 1) > MAX_RATE_DIFFERENCE:
        reported_hz, measured_hz = _NS_PER_S / state.period_ns, _NS_PER_S / period_ns
        faults.append(f"rate: the camera reports {reported_hz:.5g} Hz, its frames arrive at {measured_hz:.5g} Hz")
    if faults:
        raise CalibrationError("the camera cannot be used:\n" + "\n".join(f"  {fault}" for fault in faults))
    for check in checks:
        if check.status is Status.WARNING:
            report(f"remark: {check.name}: the camera has {check.got}, expected {check.expected}")
    report(
        f"{state.rows} x {state.columns} pixels of {state.bit_depth} bits at {_NS_PER_S / period_ns:.5g} Hz, brightest "
        f"pixel {max(int(image.pixels.max()) for image in images)} of {state.saturation_dn:g} DN"
    )
    return replace(camera_settings(state), start_s=0)


def with_measured_dark(camera: CameraSettings, frames: npt.NDArray[np.number], report: Report) -> Sensor:
    """A sensor with dark and bad pixels from dark frames (frames, rows, columns)."""
    if frames.shape[1:] != camera.shape:
        raise CalibrationError(f"the dark frames have {frames.shape[1:]} pixels, the camera {camera.shape}")
    with raised_as(CalibrationError, ValueError):
        measured = measure_dark(frames.reshape(len(frames), -1))
    report(str(measured))
    return Sensor(camera, measured.dark_dn, measured.good, measured=True)


def calibration_with_reference(
    sensor: Sensor, frames: npt.NDArray[np.number], computed: Calibration, report: Report
) -> Calibration:
    """A calibration with the reference image of these frames (frames, rows, columns), and no response yet.

    Its modes and its matrix from modes to actuators are those of the calibration `computed`.
    """
    pixels, saturation_dn = frames.reshape(len(frames), -1), float(sensor.camera.saturation_dn)
    brightest_dn = int((pixels.max(axis=0) * (sensor.good > 0)).max())
    if brightest_dn > _MAX_BRIGHTNESS * saturation_dn:
        raise CalibrationError(
            f"the brightest good pixel is at {brightest_dn} of {saturation_dn:g} DN; shorten the exposure until this "
            "pixel is below half of full well; a hot pixel is excluded by a dark, but not with --no-dark"
        )
    image = pixels.astype(np.float64).mean(axis=0) - sensor.dark_dn
    flux_dn = float(image @ sensor.good)
    noise_dn = float(np.std(pixels.astype(np.float64) @ sensor.good)) / np.sqrt(len(frames))
    if not flux_dn > max(10 * noise_dn, 0.0):
        raise CalibrationError(
            f"no flux above the dark: {flux_dn:.4g} DN in total, with a standard error of "
            f"{noise_dn:.2g} DN; is the star blocked now, or was it not blocked for the dark?"
        )
    reference = image * sensor.good / flux_dn
    if sensor.measured:
        with raised_as(CalibrationError, ValueError):
            check_dark(sensor.dark_dn, reference, flux_dn)
    modes = len(computed.noll)
    report(f"flux {flux_dn:.4g} DN per frame, mean of {len(frames)} frames")
    return replace(
        computed,
        reference=reference.astype(np.float32),
        response=np.zeros((image.size, modes), np.float32),
        reconstructor=np.zeros((modes, image.size), np.float32),
        good=sensor.good.astype(np.float32),
        dark=sensor.dark_dn.astype(np.float32),
        shape=sensor.camera.shape,
        flux_dn=flux_dn,
        saturation_dn=saturation_dn,
        estimator="none",
        operator_hash="",
        id="",
        actuators_to_modes=np.zeros((0, 0), np.float32),
        camera=sensor.camera,
    )
