"""Camera settings, and the changes that make a calibration invalid."""

from dataclasses import dataclass, field

MIN_TOLERANCE_DN = 1.0
"""Change of bias or saturation that is always tolerated, DN."""
GAIN_TOLERANCE = 0.01
"""Relative change of a gain that is tolerated; small, as gains are settings, without measurement noise."""


@dataclass(frozen=True, slots=True)
class CameraSettings:
    """Camera settings: those that a calibration depends on, and their time.

    Attributes:
        time_ns: when they were published; ignored by `==`.
        shape: rows and columns of the frame.
        bias_dn: level without light and without dark current.
        saturation_dn: highest value a pixel can have.
        gain_e_per_dn: conversion gain; 0 if unknown.
        em_gain: electron-multiplying gain; 0 if unknown.
        read_noise_e: read noise of one pixel; 0 if unknown.
        region: first row and first column that are read.
        start_s: start of the camera, unix seconds; 0 if unknown.
    """

    time_ns: int = field(compare=False)
    shape: tuple[int, int]
    bias_dn: float
    saturation_dn: float
    gain_e_per_dn: float = 0.0
    em_gain: float = 0.0
    read_noise_e: float = 0.0
    region: tuple[int, int] = (0, 0)
    start_s: int = 0

    @property
    def noise_dn(self) -> float:
        """Read noise of a pixel in a frame, DN; 0 if unknown."""
        return self.read_noise_e / self.gain_e_per_dn if self.gain_e_per_dn > 0 else 0.0


def changes(now: CameraSettings, then: CameraSettings) -> list[str]:
    """Phrases for the changes that make a calibration invalid: `then` are its settings, `now` those of the camera."""
    tolerance_dn = max(MIN_TOLERANCE_DN, then.noise_dn)
    exact = (
        ("rows", now.shape[0], then.shape[0]),
        ("columns", now.shape[1], then.shape[1]),
        ("region_row", now.region[0], then.region[0]),
        ("region_column", now.region[1], then.region[1]),
    )
    levels = (("bias_dn", now.bias_dn, then.bias_dn), ("saturation_dn", now.saturation_dn, then.saturation_dn))
    gains = (("gain_e_per_dn", now.gain_e_per_dn, then.gain_e_per_dn), ("em_gain", now.em_gain, then.em_gain))
    different: list[tuple[str, float, float]] = [(name, new, old) for name, new, old in exact if new != old]
    different += [(name, new, old) for name, new, old in levels if not abs(new - old) <= tolerance_dn]
    known_gains = ((name, new, old) for name, new, old in gains if min(new, old) > 0)
    different += [(name, new, old) for name, new, old in known_gains if abs(new / old - 1) > GAIN_TOLERANCE]
    return [f"{name} is {new:g}, was {old:g} at the calibration" for name, new, old in different]
