"""Reaction wheels: harmonics of one speed, which ramps, wanders or runs down; pure functions of seed and time."""

from dataclasses import dataclass

import numpy as np

from lowfc.arrays import Array, Complex

ORDERS = (1.0, 2.0, 2.9, 4.4, 5.4)
"""Frequencies of the harmonics, in turns of the wheel; those of its bearings are no whole numbers."""
HEIGHTS = (1.0, 0.5, 0.3, 0.2, 0.15)
"""Amplitudes of the harmonics, of the first one's."""
SOFT_HZ = 5.0
"""First resonance of the structure: below it a harmonic falls with the square of its frequency, as the force does."""
_WALK_HZ = (1e-4, 10.0)
_WALK_WAVES = 64


def walk(rng: np.random.Generator, per_root_s: Array, slope: float = 2.0) -> tuple[Array, Complex]:
    """Sine waves (waves,) and (waves, any), evenly spread in the logarithm of frequency from 1e-4 to 10 Hz.

    Their density is per_root_s^2 / (2 pi^2 f^slope) per Hz; a random walk's with slope 2, which then moves by
    per_root_s in a second and by the root of a longer time.
    """
    low, high = _WALK_HZ
    spacing = np.log(high / low) / _WALK_WAVES
    frequency_hz = low * np.exp(spacing * (np.arange(_WALK_WAVES) + rng.random(_WALK_WAVES)))
    height = np.sqrt(spacing * frequency_hz ** (1 - slope)) / np.pi
    phases = np.exp(2j * np.pi * rng.random((_WALK_WAVES, per_root_s.size)))
    return frequency_hz, height[:, None] * phases * per_root_s


@dataclass(frozen=True, eq=False)
class Wheel:
    """A wheel that shakes the modes.

    Attributes:
        start_hz: its speed at time 0, turns per second.
        course: ramp, walk or run-down (by friction in proportion to the speed).
        change: of the speed: Hz per second, of a walk Hz per root second; 0 for a steady one.
        amplitude_nm: (harmonics, modes) complex: amplitude and phase at high speed, nm of wavefront rms.
        wander: (waves,) and (waves, 1) of a walk's speed in Hz.
    """

    start_hz: float
    course: str
    change: float
    amplitude_nm: Complex
    wander: tuple[Array, Complex]

    def speed_hz(self, time_s: Array) -> Array:
        """Turns per second (instants,)."""
        if self.course == "walk":
            frequency_hz, height_hz = self.wander
            moved = (np.exp(2j * np.pi * np.outer(time_s, frequency_hz)) - 1) @ height_hz[:, 0]
            return np.asarray(self.start_hz + moved.real)
        if self.course == "run-down":
            return self.start_hz * np.exp(-self.change / self.start_hz * time_s)
        return self.start_hz + self.change * time_s

    def turns(self, time_s: Array) -> Array:
        """Turns since time 0 (instants,): the integral of the speed."""
        if self.course == "walk":
            frequency_hz, height_hz = self.wander
            omega = 2j * np.pi * frequency_hz
            moved = np.expm1(np.outer(time_s, omega)) @ (height_hz[:, 0] / omega)
            return np.asarray(self.start_hz * time_s + moved.real - time_s * height_hz[:, 0].real.sum())
        if self.course == "run-down" and self.change:
            rate = self.change / self.start_hz
            return -self.start_hz / rate * np.expm1(-rate * time_s)
        return self.start_hz * time_s + self.change / 2 * time_s**2

    def modes_nm(self, time_s: Array) -> Array:
        """What it adds to the modes (instants, modes), nm of wavefront rms."""
        return np.asarray((self._heights(time_s) * self._phases(time_s) @ self.amplitude_nm).real)

    def lines(self) -> tuple[Array, Array]:
        """Frequencies (harmonics,) at time 0, in Hz, and the variance of each mode at each (harmonics, modes), nm^2."""
        variance_nm2 = np.abs(self._heights(np.zeros(1)).T * self.amplitude_nm) ** 2 / 2
        return np.array(ORDERS) * self.start_hz, variance_nm2

    def _phases(self, time_s: Array) -> Complex:
        return np.asarray(np.exp(2j * np.pi * np.outer(self.turns(time_s), ORDERS)))

    def _heights(self, time_s: Array) -> Array:
        """(instants, harmonics), of those at high speed."""
        squared = np.outer(self.speed_hz(time_s), ORDERS) ** 2
        return np.asarray(squared / (squared + SOFT_HZ**2))


def wheels(
    seed: int, speeds_hz: tuple[float, ...], rms_nm: Array, course: str = "ramp", change: float = 0.0
) -> tuple[Wheel, ...]:
    """A wheel for each speed at time 0, all of one kind; `rms_nm` (modes,) of the first harmonic at high speed."""
    found = []
    for number, start_hz in enumerate(speeds_hz):
        rng = np.random.default_rng([seed, 7, number])
        phases = np.exp(2j * np.pi * rng.random((len(ORDERS), rms_nm.size)))
        amplitude_nm = np.sqrt(2) * np.outer(HEIGHTS, rms_nm) * phases
        found.append(Wheel(start_hz, course, change, amplitude_nm, walk(rng, np.array([change]))))
    return tuple(found)
