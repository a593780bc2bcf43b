"""Loops of any size: random calibrations with matching frames, run by the real processes."""

import os
import warnings
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any

import numpy as np
from astropy.io.fits.verify import VerifyWarning

from lowfc.adapters.bus.run import Run
from lowfc.adapters.files import calibration_file, factory
from lowfc.adapters.process.realtime import spread
from lowfc.arrays import Pixels, Single
from lowfc.contract.codecs.calibration_codec import with_identity
from lowfc.contract.configuration import FIXED_GAINS, Configuration, load
from lowfc.contract.errors import ConfigurationError
from lowfc.control.calibration.calibration import Calibration
from lowfc.optics.detector.detector import saturation_dn
from lowfc.programs.measure.frame_source import FRAMES_FILE
from lowfc.programs.measure.latency.run import prepared

FRAMES = 8
"""Number of different frames for each size."""

_LIGHT_DN = 1000.0  # mean light of a pixel
_LEAK = 0.01  # the frames do not depend on the mirror: without a leak, their noise would accumulate in the command


@dataclass(frozen=True, slots=True)
class Size:
    """One point of a curve: pixels across the frame, modes, actuators across the mirror."""

    side: int = 80
    modes: int = 20
    mirror_side: int = 34

    def __post_init__(self) -> None:
        if self.side < 1 or self.modes < 1:
            raise ConfigurationError(f"a loop has at least one pixel and one mode, got {self}")

    @property
    def pixels(self) -> int:
        """Pixels of a frame."""
        return self.side**2

    @property
    def actuators(self) -> int:
        """Actuators of the mirror."""
        return self.mirror_side**2

    @property
    def bytes(self) -> int:
        """Bytes that a step reads: the frame as uint16; R, reference, dark, mask and the modes' shapes as float32."""
        return 4 * self.pixels * (self.modes + 3) + 2 * self.pixels + 4 * self.modes * self.actuators


def configuration(size: Size, rate_hz: float, **realtime: Any) -> Configuration:
    """Configuration of a loop with a mirror of this size; `realtime` sets keys of the table [realtime]."""
    overrides = {
        "camera.rate_hz": rate_hz,
        "mirror.rows": size.mirror_side,
        "mirror.columns": size.mirror_side,
        "mirror.pitches_per_pupil": size.mirror_side - 3,
        "control.start_mode": "closed",
        **FIXED_GAINS,
        "control.tilt_leak": _LEAK,
        "control.leak": _LEAK,
        **{f"realtime.{key}": value for key, value in realtime.items()},
    }
    return load(None, overrides, spread(os.sched_getaffinity(0), simulated=False))


def random_calibration(size: Size, config: Configuration) -> tuple[Calibration, Pixels]:
    """A random calibration, and frames (frames, rows, columns) whose noise is 1 nm rms in every mode."""
    rng = np.random.default_rng(size.bytes)
    light_dn = _LIGHT_DN * rng.uniform(0.5, 1.5, size.pixels)
    flux_dn = float(light_dn.sum())
    dark_dn = config.camera.bias_dn
    frames = rng.poisson(light_dn, (FRAMES, size.pixels)) + round(dark_dn)
    calibration = Calibration(
        noll=tuple(range(2, 2 + size.modes)),
        reference=(light_dn / flux_dn).astype(np.float32),
        response=_random(rng, (size.pixels, size.modes), 1 / size.pixels),
        reconstructor=_random(rng, (size.modes, size.pixels), flux_dn**0.5),
        good=np.ones(size.pixels, np.float32),
        dark=np.full(size.pixels, dark_dn, np.float32),
        modes_to_actuators=_random(rng, (size.actuators, size.modes), 1 / size.modes**0.5),
        shape=(size.side, size.side),
        grid=(size.mirror_side, size.mirror_side),
        flux_dn=flux_dn,
        saturation_dn=float(saturation_dn(factory.detector(config))),
        estimator="weighted",
        wavelength_nm=config.star.wavelength_nm,
        operator_hash="",
        id="",
    )
    return with_identity(calibration), frames.astype(np.uint16).reshape(FRAMES, size.side, size.side)


def prepared_run(size: Size, config: Configuration) -> AbstractContextManager[Run]:
    """A run of a loop of this size, with the files that its processes read; the end of the `with` block removes it."""

    def write_files(config: Configuration, run: Run) -> None:
        calibration, frames = random_calibration(size, config)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", VerifyWarning)  # with hundreds of modes a card's comment is truncated
            calibration_file.save(calibration, run.path / "calibration.fits")
        (run.path / "config.toml").write_text(config.to_toml(), encoding="utf-8")
        np.save(run.path / FRAMES_FILE, frames)

    return prepared(config, write_files)


def _random(rng: np.random.Generator, shape: tuple[int, int], scale: float) -> Single:
    return rng.standard_normal(shape, np.float32) * np.float32(scale)
