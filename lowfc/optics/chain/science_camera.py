"""Science images for modal wavefronts, fast enough for a live view: `coronagraph.contrast` with prepared kernels."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lowfc.arrays import Array, Integers, Single, SingleComplex
from lowfc.optics.chain.coronagraph import SAMPLES_PER, Coronagraph, LyotStop, Wedge, wedge_samples
from lowfc.optics.chain.fourier import kernel
from lowfc.optics.chain.grid import pupil_axis
from lowfc.optics.chain.zernike import zernikes

_LYOT_SQUARE = 4  # pupil samples across a cell, for a Lyot coronagraph


class ScienceCamera:
    """Contrast of a coronagraph, in single precision, from modal wavefronts.

    The field is summed over the open cells of the pupil only: the wavefront is evaluated at each cell's centre, and the
    Fourier kernel is summed over the cell's samples. For a shaped pupil alone, cells have 2 x 2 samples if the pupil is
    constant within each, as in the package's pupil, otherwise one. For a Lyot coronagraph they have 4 x 4 samples, over
    which the pupil is averaged.

    Attributes:
        samples: Number of samples across the square image; their positions are those of `grid.image_axis`.
        samples_per: Samples per lambda / D.
        wavelength_nm: The wavelength.
    """

    def __init__(
        self,
        coronagraph: Coronagraph,
        noll: Sequence[int],
        wavelength_nm: float,
        half_width: int = 12,
        samples_per: int = SAMPLES_PER,
    ) -> None:
        """Prepare the kernels.

        Args:
            coronagraph: The optics.
            noll: Noll index of each mode.
            wavelength_nm: The wavelength.
            half_width: Half of the image's width, in lambda / D.
            samples_per: Samples per lambda / D.

        Raises:
            ValueError: The pupil is not square or transmits no light; with a Lyot stop, its samples across are no
                multiple of 4; or there are no modes.
        """
        pupil, lyot = coronagraph.pupil, coronagraph.lyot
        if pupil.ndim != 2 or pupil.shape[0] != pupil.shape[1] or not pupil.any():
            raise ValueError(f"a pupil must be square and let light through, got shape {pupil.shape}")
        if lyot is not None and len(pupil) % _LYOT_SQUARE:
            raise ValueError(
                f"the pupil of a Lyot coronagraph must be a multiple of {_LYOT_SQUARE} samples across, got {len(pupil)}"
            )
        if not noll:
            raise ValueError("a wavefront must have modes, got none")
        self.samples = 2 * half_width * samples_per
        self.samples_per = samples_per
        self.wavelength_nm = wavelength_nm
        sample_kernel = kernel(self.samples, samples_per, len(pupil), 1.0)
        square = (2 if _in_squares(pupil) else 1) if lyot is None else _LYOT_SQUARE
        cells = _averaged(pupil, square)
        used = np.flatnonzero(cells.any(axis=1)), np.flatnonzero(cells.any(axis=0))
        cell_kernel = sample_kernel.reshape(self.samples, len(cells), square).sum(axis=2)
        self._lyot = None if lyot is None else _Lyot.of(lyot, square, used)
        self._in_y = (cell_kernel[:, used[0]] / coronagraph.peak).astype(np.complex64)
        self._in_x = cell_kernel[:, used[1]].T.astype(np.complex64)
        cells = cells[np.ix_(*used)]
        rows, columns = np.nonzero(cells)
        radii = 2 * pupil_axis(len(pupil) // square)
        phase_per_nm = zernikes(noll, radii[used[1]][columns], radii[used[0]][rows]) * (2 * np.pi / wavelength_nm)
        self._phase_per_nm: Single = phase_per_nm.astype(np.float32)
        self._amplitude: Single = cells[rows, columns].astype(np.float32)
        self._open = np.ravel_multi_index((rows, columns), cells.shape)
        self._field = np.zeros(cells.shape, np.complex64)

    def image(self, modes_nm: npt.NDArray[np.floating]) -> Single:
        """Contrast (samples, samples) with a wavefront (modes,) in nm rms of each mode.

        Raises:
            ValueError: The wavefront has the wrong number of modes.
        """
        modes = len(self._phase_per_nm)
        if modes_nm.shape != (modes,):
            raise ValueError(f"a wavefront must have {modes} modes, got shape {modes_nm.shape}")
        phase = modes_nm.astype(np.float32) @ self._phase_per_nm
        flattened = self._field.reshape(-1)
        flattened.real[self._open] = self._amplitude * np.cos(phase)
        flattened.imag[self._open] = self._amplitude * np.sin(phase)
        field = self._in_y @ (self._field if self._lyot is None else self._lyot.behind(self._field)) @ self._in_x
        return np.asarray(field.real**2 + field.imag**2)

    def mean_contrast(self, image: Single, wedge: Wedge) -> float:
        """Mean of an image (samples, samples) over the samples in a wedge, as in `coronagraph.mean_contrast`.

        Raises:
            ValueError: The wedge reaches beyond the image.
        """
        if 2 * wedge.outer * self.samples_per > self.samples:
            raise ValueError(
                f"the image ends {self.samples / (2 * self.samples_per):g} lambda/D from the star, got {wedge}"
            )
        inside = wedge_samples(wedge, self.samples, self.samples, self.samples_per)
        return float(image[inside].mean(dtype=np.float64))


@dataclass(frozen=True, eq=False)
class _Lyot:
    """A `LyotStop` in single precision for the used cells (rows, columns) of the pupil.

    Attributes:
        to_y, to_x: (k, rows) and (columns, k) kernels from the cells to the opaque mask.
        back_y, back_x: (rows, k) and (k, columns) kernels from the opaque mask to the stop.
        opaque: (k, k) fraction of the amplitude that the mask blocks.
        stop: (rows, columns) amplitude transmission.
    """

    to_y: SingleComplex
    to_x: SingleComplex
    back_y: SingleComplex
    back_x: SingleComplex
    opaque: Single
    stop: Single

    @classmethod
    def of(cls, lyot: LyotStop, square: int, used: tuple[Integers, Integers]) -> "_Lyot":
        n, k = len(lyot.stop), len(lyot.opaque)
        cells = kernel(k, lyot.samples_per, n, 1.0).reshape(k, n // square, square)
        y, x = (cells[:, each].sum(axis=2).astype(np.complex64) / np.float32(n) for each in used)
        back_y, back_x = ((cells[:, each].mean(axis=2).conj() / lyot.samples_per).astype(np.complex64) for each in used)
        stop = _averaged(lyot.stop, square)[np.ix_(*used)].astype(np.float32)
        return cls(y, x.T, back_y.T, back_x, lyot.opaque.astype(np.float32), stop)

    def behind(self, field: SingleComplex) -> SingleComplex:
        blocked = self.back_y @ (self.opaque * (self.to_y @ field @ self.to_x)) @ self.back_x
        return np.asarray(self.stop * (field - blocked))


def _averaged(pupil: Array, square: int) -> Array:
    """Means (n / square, n / square) over squares of samples."""
    cells = len(pupil) // square
    return np.asarray(pupil.reshape(cells, square, cells, square).mean(axis=(1, 3)))


def _in_squares(pupil: Array) -> bool:
    """Whether the samples within every 2 x 2 square are equal."""
    if len(pupil) % 2:
        return False
    squares = pupil.reshape(len(pupil) // 2, 2, len(pupil) // 2, 2)
    return bool((squares == squares[:, :1, :, :1]).all())
