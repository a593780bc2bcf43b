"""Performance, predicted for a search, of sensors that use all light from the focal-plane mask (Zernike, CLOWFS).

The fields on the focal-plane mask depend on neither the phase spot nor the defocus: they are computed once, and
propagated from the mask to the detector for each candidate.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from scipy.optimize import minimize_scalar

from lowfc.arrays import Array, Complex
from lowfc.control.calibration.calibration import reconstructor
from lowfc.design.merit import BAND, WAVELENGTH_NM, PupilForms, Signal
from lowfc.design.paper import MODES, TABLE3_INPUT_WAVES
from lowfc.design.trials import PAPER_BOUNDS_WAVES, bounds_waves, input_rms, random_wavefronts, residual_rms
from lowfc.optics.chain import pupil
from lowfc.optics.chain.band import Band, monochromatic
from lowfc.optics.chain.fourier import to_image
from lowfc.optics.chain.sensor import Sensor, from_focus, pixel_sums, pupil_radii
from lowfc.optics.chain.zernike import NOLLS_20, zernikes

_WAVEFRONTS = 20  # random wavefronts for each number of modes
_SEED = 1


@dataclass(frozen=True, eq=False)
class FocalLight:
    """Light on a focal-plane mask.

    Attributes:
        forms: Quadratic forms of the pupil.
        fields: By wavelength, nm: (1 + modes, k, k) fields on the mask, of the pupil and of the pupil times each mode.
        wavefronts_nm: By the number of modes, (wavefronts, modes) random wavefronts matched to Table 3's input.
        aberrated: By the number of modes, (wavefronts, k, k) their fields on the mask at the central wavelength.
    """

    forms: PupilForms
    fields: dict[float, Complex]
    wavefronts_nm: dict[int, Array]
    aberrated: dict[int, Complex]

    @classmethod
    def of(cls, sensor: Sensor) -> "FocalLight":
        """Propagate from the pupil of a sensor to its focal-plane mask."""
        modes = zernikes(NOLLS_20, *pupil_radii(sensor))

        def focal(pupil_field: Array | Complex, wavelength_nm: float = WAVELENGTH_NM) -> Complex:
            return to_image(pupil_field, len(sensor.focal_mask), sensor.samples_per, WAVELENGTH_NM / wavelength_nm)

        all_nm = {WAVELENGTH_NM, *BAND.wavelengths_nm}
        fields = {nm: np.array([focal(sensor.pupil * shape, nm) for shape in (1.0, *modes)]) for nm in all_nm}
        forms, drawn, aberrated = PupilForms.of(sensor.pupil, modes), {}, {}
        for count in MODES:
            nolls, (low, high) = NOLLS_20[:count], PAPER_BOUNDS_WAVES
            scale = TABLE3_INPUT_WAVES[count] / input_rms(forms.gram[:count, :count], bounds_waves(nolls, low, high))
            waves = random_wavefronts(np.random.default_rng(_SEED), _WAVEFRONTS, nolls, low * scale, high * scale)
            phases = (np.tensordot(wavefront, modes[:count], 1) for wavefront in waves)
            drawn[count] = waves * WAVELENGTH_NM
            aberrated[count] = np.array([focal(pupil.aberrated(sensor.pupil, phase, 1.0)) for phase in phases])
        return cls(forms, fields, drawn, aberrated)


@dataclass(frozen=True, eq=False)
class FullLight:
    """A sensor without a relay mask as a `lowfc.design.merit.Candidate`.

    It is compared with the paper's rows of CLOWFS, the only sensor of this kind in the paper.

    Attributes:
        sensor: The optics.
        focal_light: Light on its focal-plane mask.
    """

    sensor: Sensor
    focal_light: FocalLight
    paper_rows = ("clowfs",)
    paper_tilt = "clowfs"

    @property
    def forms(self) -> PupilForms:
        """Quadratic forms of the pupil."""
        return self.focal_light.forms

    def central(self, row: str = "clowfs") -> Signal:
        """I0 and H at the central wavelength, the same for every row."""
        return self._central

    @cached_property
    def _central(self) -> Signal:
        return self._signal(monochromatic(WAVELENGTH_NM))

    @cached_property
    def in_band(self) -> Signal:
        """I0 and H in the band of Table 4."""
        return self._signal(BAND)

    def nonlinearity_waves(self, modes: int) -> float:
        """Mean residual rms over the open pupil, waves, for random wavefronts without noise and the pseudo-inverse."""
        return _nonlinearity_waves(self, modes)

    def image(self, focal: Complex) -> Array:
        """Image (pixels,) at the central wavelength of a field on the mask, in fractions of the open circle's light."""
        return self._intensity(self._on_sensor(focal, WAVELENGTH_NM))

    def _signal(self, band: Band) -> Signal:
        pixels = self.sensor.pixels**2
        I0, H = np.zeros(pixels), np.zeros((pixels, len(NOLLS_20)))
        for nm, weight in zip(band.wavelengths_nm, band.weights, strict=True):
            flat, *modes = (self._on_sensor(field, nm) for field in self.focal_light.fields[nm])
            slopes = [(4.0 * np.pi / nm) * (flat * np.conj(1j * mode)).real for mode in modes]
            I0 += weight * self._intensity(flat)
            H += weight * np.array([pixel_sums(self.sensor, slope).ravel() for slope in slopes]).T
        return Signal(I0, H, 1.0, float(I0.max()))

    def _on_sensor(self, focal: Complex, wavelength_nm: float) -> Complex:
        return from_focus(self.sensor, focal * self.sensor.focal_mask, wavelength_nm)

    def _intensity(self, field: Complex) -> Array:
        return pixel_sums(self.sensor, field.real**2 + field.imag**2).ravel()


@lru_cache(maxsize=8)
def _nonlinearity_waves(candidate: FullLight, modes: int) -> float:
    signal, truth = candidate.central(), candidate.focal_light.wavefronts_nm[modes]
    R = reconstructor(signal.I0, signal.H[:, :modes], np.ones_like(signal.I0), 1.0, 0.0, "pinv")
    images = [candidate.image(field) for field in candidate.focal_light.aberrated[modes]]
    residuals = truth - (np.array(images) - signal.I0) @ R.T
    return float(residual_rms(candidate.forms.gram[:modes, :modes], residuals).mean()) / WAVELENGTH_NM


def sweep(merit_of: Callable[[float], float], low: float, high: float, count: int) -> tuple[Array, float]:
    """Minimise a merit over a range; return evenly spaced values (count,), and the refined value of least merit.

    The refinement searches between the neighbours of the best evenly spaced value.

    Args:
        merit_of: Function from a value to its merit, which is minimised.
        low: Lower end of the range.
        high: Upper end; equal to `low` for a single value.
        count: Number of evenly spaced values, at least 3.
    """
    if low == high:
        return np.array([low]), low
    values = np.linspace(low, high, count)
    best = int(np.argmin([merit_of(value) for value in values.tolist()]))
    bounds = values[max(best - 1, 0)], values[min(best + 1, count - 1)]
    found = minimize_scalar(merit_of, bounds=bounds, method="bounded", options={"xatol": 1e-3 * (high - low)})
    return values, float(min((found.x, values[best]), key=merit_of))
