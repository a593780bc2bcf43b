"""The probe sequences of a calibration: their amplitudes, cycles and frames."""

from dataclasses import dataclass
from math import ceil, log
from pathlib import Path

import numpy as np

from lowfc.adapters.files.factory import frame_noise_nm
from lowfc.arrays import Array
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import CalibrationError
from lowfc.control.calibration import poke_plan
from lowfc.control.calibration.calibration import Calibration
from lowfc.control.calibration.response_fit import MIN_CYCLES
from lowfc.programs.commissioning.calibrate.recording import TRAILING_FRAMES

AMPLITUDE_NM = {"poke": 8.0, "hadamard": 3.0, "in-loop": 2.0}
"""Default amplitude of a mode by method, nm rms of wavefront."""
MIN_SNR = 20.0
"""Signal-to-noise ratio required by default if the number of cycles is given."""
FULL_AMPLITUDE_SNR = 70.0
"""Signal-to-noise ratio above which the default amplitude is reduced: nonlinearity grows as the amplitude squared."""
MAX_HADAMARD_NM = 3.0
"""Largest amplitude of a mode, nm rms: all modes at once add up to some four times that, within the linear range."""
SETTLE = 2
"""Unused frames after each change: one for a fractional delay, and one for a late command."""
HOLD = 4
"""Used frames of each push or pull."""
DITHER_HOLD = 2
"""Frames for which each value of a dither is held; the loop corrects more of a dither that is held longer."""
PIECE = 1024
"""Length of a piece of a dither, frames."""
MARGIN = 0.9
"""Error for which cycles are planned, relative to the required error, so that scatter seldom requires more cycles."""
MAX_CYCLES_RATIO = 4
"""Largest ratio of cycles to the number required by photon and read noise; the operator may request more cycles."""
ALWAYS_ALLOWED_CYCLES = 32
"""Number of cycles allowed even beyond `MAX_CYCLES_RATIO`: on a bright star they take little time."""
CHECK_FRACTION = 0.25
"""Number of check cycles relative to the cycles that R is computed from."""
_MIN_CHECKS = 3
_SLEW_FRACTION = 0.8
"""Largest fraction of the slew limit that a poke uses."""
SEED = 1
DELAY_FRAMES = 600
"""Length of the sequence that measures the delay, frames."""


@dataclass(frozen=True, slots=True)
class CalibrationRequest:
    """A calibration as requested.

    Attributes:
        method: poke, hadamard or in-loop.
        out: output file; completed cycles are kept beside it.
        snr: signal-to-noise ratio to reach; with `cycles`, the one required for a recommendation.
        cycles: number of cycles; None to derive it from `snr`.
        amplitude_nm: amplitude of a mode, nm rms of wavefront; None for the default.
        resume: continue after the completed cycles.
        truncate: discard singular values below this fraction of the largest.
        tikhonov: damp singular values below about this fraction of the largest.
    """

    method: str
    out: Path
    snr: float
    cycles: int | None = None
    amplitude_nm: float | None = None
    resume: bool = False
    truncate: float = 0.0
    tikhonov: float = 0.0


class Pokes:
    """The poke plans of one calibration.

    Attributes:
        noise_nm: noise of one frame with the calibration in use (modes,), nm rms of wavefront.
        amplitude_nm: amplitude of a mode, nm rms of wavefront.
    """

    def __init__(self, config: Configuration, calibration: Calibration, request: CalibrationRequest) -> None:
        """Choose the amplitude; CalibrationError if the requested one is too large."""
        self._request = request
        self.noise_nm = frame_noise_nm(config, calibration)
        self._modes = len(calibration.noll)
        self._largest_amplitude_nm = largest_amplitude_nm(config, calibration)
        self.amplitude_nm = self._amplitude(config, calibration)

    def cycle(self, number: int) -> poke_plan.Plan:
        """The plan of cycle `number`."""
        return self._cycle(number, self.amplitude_nm)

    def delay_plan(self, mode: int) -> poke_plan.Plan:
        """The plan for measuring the delay: pokes of one mode; in closed loop with the rms of all modes of a dither."""
        closed = self._request.method == "in-loop"
        amplitude = self.amplitude_nm * float(np.sqrt(self._modes)) if closed else AMPLITUDE_NM["poke"]
        return first_poke_plan(min(amplitude, float(self._largest_amplitude_nm[mode])))

    def cycles(self) -> int:
        """Number of cycles: the requested number, or else the number that photon and read noise require."""
        request = self._request
        if request.cycles is not None:
            return request.cycles
        frames = poke_plan.frames_for_snr(request.snr / MARGIN, float(self.noise_nm.max()), self.amplitude_nm)
        return max(ceil(frames / self.cycle(0).per_column), MIN_CYCLES)

    def required_cycles(self, cycles: int, error: float) -> int:
        """Number of cycles required, given the standard error of R H after `cycles` cycles.

        It is `cycles` if these suffice, if the number was requested, or if too many would be required.
        """
        if self._request.cycles is not None or error * self._request.snr <= 1:
            return cycles
        needed = cycles_for(self._request.snr, cycles, error)
        return needed if needed <= max(MAX_CYCLES_RATIO * self.cycles(), ALWAYS_ALLOWED_CYCLES) else cycles

    def frames(self, cycles: int, done: int = 0) -> int:
        """Number of frames in the cycles that remain after `done` cycles, and in all check cycles."""
        return (cycles + check_cycles(cycles) - done) * (len(self.cycle(0)) + TRAILING_FRAMES)

    def _cycle(self, number: int, amplitude_nm: float) -> poke_plan.Plan:
        request = self._request
        if request.method == "in-loop":
            seed = SEED + 1000 * (number + 1)
            return poke_plan.dither(self._modes, amplitude_nm, PIECE, DITHER_HOLD, seed)
        patterns = poke_plan.hadamard_patterns if request.method == "hadamard" else poke_plan.poke_patterns
        shapes = patterns(self._modes, amplitude_nm)
        # a different order in each pair of cycles, so that their scatter shows vibrations
        shapes = np.random.default_rng([SEED, number // 2]).permutation(shapes)
        return poke_plan.cycle(shapes, HOLD, SETTLE, len(poke_plan.SIGNS) * HOLD, backwards=number % 2 == 1)

    def _amplitude(self, config: Configuration, calibration: Calibration) -> float:
        """The requested or default amplitude, within the mirror's slew limit."""
        requested, method = self._request.amplitude_nm, self._request.method
        if method == "hadamard" and requested is not None and requested > MAX_HADAMARD_NM:
            raise CalibrationError(
                f"--amplitude {requested:g} nm is too large for hadamard, which pokes all modes at once: at most "
                f"{MAX_HADAMARD_NM:g} nm of each"
            )
        shapes = self._cycle(0, 1.0).table @ calibration.modes_to_actuators.T
        steepest = float(np.abs(np.diff(shapes, axis=0)).max())
        largest = _largest_move_nm(config) / max(steepest, 1e-9)
        if requested is None:
            return min(default_amplitude_nm(method, self._request.snr), largest)
        if requested > largest:
            raise CalibrationError(
                f"--amplitude {requested:g} nm: from push to pull an actuator would move by more than "
                f"{_SLEW_FRACTION:g} of the slew limit; give at most {largest:.3g} nm"
            )
        return requested


def first_poke_plan(amplitude_nm: float) -> poke_plan.Plan:
    """The pokes of one mode for `Player.first_poke`; amplitude in nm rms of wavefront."""
    return poke_plan.dither(1, amplitude_nm, DELAY_FRAMES, 1, SEED)


def largest_amplitude_nm(config: Configuration, calibration: Calibration) -> Array:
    """Largest amplitude (modes,) at which push to pull stays within the slew limit, nm rms of wavefront."""
    steepest = np.abs(calibration.modes_to_actuators).max(axis=0)
    return np.asarray(_largest_move_nm(config) / (2 * np.maximum(steepest, 1e-9)), dtype=np.float64)


def _largest_move_nm(config: Configuration) -> float:
    """Largest move of an actuator from push to pull, nm of surface."""
    return _SLEW_FRACTION * min(config.safety.slew_nm, config.mirror.slew_nm)


def default_amplitude_nm(method: str, snr: float) -> float:
    """Default amplitude of a mode, nm rms: halved above `FULL_AMPLITUDE_SNR`, and again above 4, 16, ... times it."""
    halvings = max(0, ceil(log(snr / FULL_AMPLITUDE_SNR, 4)))
    return float(AMPLITUDE_NM[method] / 2**halvings)


def cycles_for(snr: float, cycles: int, error: float) -> int:
    """Number of cycles to reach a signal-to-noise ratio, given the standard `error` of R H after `cycles` cycles."""
    return max(ceil(min(cycles * (error * snr / MARGIN) ** 2, 1e9)), cycles + 1)


def check_cycles(cycles: int) -> int:
    """Number of check cycles for a reconstructor that is computed from `cycles` cycles."""
    return max(_MIN_CHECKS, round(CHECK_FRACTION * cycles))
