"""Reaction wheels: harmonics of a speed that ramps, wanders or runs down; pure functions of seed and time."""

from dataclasses import dataclass

import numpy as np

from lowfc.arrays import Array, Complex

ORDERS = (1.0, 2.0, 2.9, 4.4, 5.4)
"""Frequencies of the harmonics, as multiples of the wheel's speed; the multiples of the bearings are not integers."""
HEIGHTS = (1.0, 0.5, 0.3, 0.2, 0.15)
"""Amplitudes of the harmonics, relative to the first."""
SOFT_HZ = 5.0
"""First resonance of the structure: below it a harmonic's amplitude is proportional to the frequency squared."""
_WALK_HZ = (1e-4, 10.0)
_WALK_WAVES = 64


def walk(rng: np.random.Generator, per_root_s: Array, slope: float = 2.0) -> tuple[Array, Complex]:
    """Frequencies (waves,) and amplitudes (waves, n) of sine waves, 1e-4 to 10 Hz, nearly even in log(frequency).

    Their power density is per_root_s^2 / (2 pi^2 f^slope) per Hz, for each element of `per_root_s` (n,). Slope 2 is a
    random walk: its rms displacement after t seconds is per_root_s sqrt(t).
    """
    low, high = _WALK_HZ
    spacing = np.log(high / low) / _WALK_WAVES
    frequency_hz = low * np.exp(spacing * (np.arange(_WALK_WAVES) + rng.random(_WALK_WAVES)))
    height = np.sqrt(spacing * frequency_hz ** (1 - slope)) / np.pi
    phases = np.exp(2j * np.pi * rng.random((_WALK_WAVES, per_root_s.size)))
    return frequency_hz, height[:, None] * phases * per_root_s


@dataclass(frozen=True, eq=False)
class Wheel:
    """A reaction wheel that disturbs the modes.

    Attributes:
        start_hz: speed at time 0, revolutions per second.
        course: how the speed changes: "ramp", "walk" or "run-down" (friction proportional to the speed).
        change: for a ramp the change of the speed, for a run-down its decrease at time 0, both in Hz per second; for a
            walk its strength, Hz per root second; 0 for a constant speed.
        amplitude_nm: (harmonics, modes) complex: amplitude and phase at high speed, nm of wavefront rms.
        wander: frequencies (waves,) and amplitudes (waves, 1) in Hz of a random walk of the speed.
    """

    start_hz: float
    course: str
    change: float
    amplitude_nm: Complex
    wander: tuple[Array, Complex]

    def speed_hz(self, time_s: Array) -> Array:
        """Speed (instants,), revolutions per second."""
        if self.course == "walk":
            frequency_hz, height_hz = self.wander
            moved = (np.exp(2j * np.pi * np.outer(time_s, frequency_hz)) - 1) @ height_hz[:, 0]
            return np.asarray(self.start_hz + moved.real)
        if self.course == "run-down":
            return self.start_hz * np.exp(-self.change / self.start_hz * time_s)
        return self.start_hz + self.change * time_s

    def turns(self, time_s: Array) -> Array:
        """Revolutions since time 0 (instants,): the integral of the speed."""
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
        """Contribution of the wheel to the modes (instants, modes), nm of wavefront rms."""
        phases = np.exp(2j * np.pi * np.outer(self.turns(time_s), ORDERS))
        return np.asarray((self._heights(time_s) * phases @ self.amplitude_nm).real)

    def lines(self) -> tuple[Array, Array]:
        """Frequencies (harmonics,) at time 0, Hz, and the variance of each mode at them (harmonics, modes), nm^2."""
        variance_nm2 = np.abs(self._heights(np.zeros(1)).T * self.amplitude_nm) ** 2 / 2
        return np.array(ORDERS) * self.start_hz, variance_nm2

    def _heights(self, time_s: Array) -> Array:
        """Amplitudes (instants, harmonics), relative to those at high speed."""
        squared = np.outer(self.speed_hz(time_s), ORDERS) ** 2
        return np.asarray(squared / (squared + SOFT_HZ**2))


def wheels(
    seed: int, speeds_hz: tuple[float, ...], rms_nm: Array, course: str = "ramp", change: float = 0.0
) -> tuple[Wheel, ...]:
    """Wheels of equal amplitude, one for each speed at time 0.

    `rms_nm` (modes,) is the rms of the first harmonic at high speed.
    """
    spinning = []
    for number, start_hz in enumerate(speeds_hz):
        rng = np.random.default_rng([seed, 7, number])
        phases = np.exp(2j * np.pi * rng.random((len(ORDERS), rms_nm.size)))
        amplitude_nm = np.sqrt(2) * np.outer(HEIGHTS, rms_nm) * phases
        spinning.append(Wheel(start_hz, course, change, amplitude_nm, walk(rng, np.array([change]))))
    return tuple(spinning)
