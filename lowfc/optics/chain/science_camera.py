"""The science image of a wavefront known by its modes, fast enough for a live view: `coronagraph.contrast` prepared."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lowfc.arrays import Array, Single, Whole
from lowfc.optics.chain.coronagraph import LyotStop, Wedge, wedge_samples
from lowfc.optics.chain.fourier import kernel
from lowfc.optics.chain.grid import pupil_axis
from lowfc.optics.chain.zernike import zernikes

SingleComplex = npt.NDArray[np.complex64]
_LYOT_SQUARE = 4


class ScienceCamera:
    """Contrast of a coronagraph, in single precision, from modal wavefronts.

    The field is summed over the open samples of the pupil alone. Where the pupil's samples come in equal squares of two
    by two, as those of the shipped one do, a square has the wavefront of its middle; its kernel stays exact. Those of a
    Lyot coronagraph are averaged in squares of four by four.

    Attributes:
        samples: across the square image.
        samples_per: of them in each lambda / D; where they are says `grid.image_axis`.
        wavelength_nm: of the light.
    """

    def __init__(
        self,
        pupil: Array,
        noll: Sequence[int],
        wavelength_nm: float,
        half_width: int = 12,
        samples_per: int = 4,
        lyot: LyotStop | None = None,
    ) -> None:
        """Prepare the kernels.

        Args:
            pupil: (n, n) amplitude transmission.
            noll: Noll index of each mode.
            wavelength_nm: The wavelength.
            half_width: Of the image, in lambda / D.
            samples_per: Samples per lambda / D.
            lyot: Mask and stop of a Lyot coronagraph; None for a shaped pupil alone.

        Raises:
            ValueError: The pupil is not square or lets no light through, or there are no modes.
        """
        if pupil.ndim != 2 or pupil.shape[0] != pupil.shape[1] or not pupil.any():
            raise ValueError(f"a pupil must be square and let light through, got shape {pupil.shape}")
        if not noll:
            raise ValueError("a wavefront must have modes, got none")
        self.samples = 2 * half_width * samples_per
        self.samples_per = samples_per
        self.wavelength_nm = wavelength_nm
        exact = kernel(self.samples, samples_per, len(pupil), 1.0)
        square = (2 if _in_squares(pupil) else 1) if lyot is None else _LYOT_SQUARE
        cells = _averaged(pupil, square)
        used = np.flatnonzero(cells.any(axis=1)), np.flatnonzero(cells.any(axis=0))
        summed = exact.reshape(self.samples, len(cells), square).sum(axis=2)
        peak = (pupil if lyot is None else pupil * lyot.stop).sum()
        self._lyot = None if lyot is None else _Lyot.of(lyot, square, used)
        self._in_y = (summed[:, used[0]] / peak).astype(np.complex64)
        self._in_x = summed[:, used[1]].T.astype(np.complex64)
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
            ValueError: The wavefront has another number of modes.
        """
        modes = len(self._phase_per_nm)
        if modes_nm.shape != (modes,):
            raise ValueError(f"a wavefront must have {modes} modes, got shape {modes_nm.shape}")
        phase = modes_nm.astype(np.float32) @ self._phase_per_nm
        flat = self._field.reshape(-1)
        flat.real[self._open] = self._amplitude * np.cos(phase)
        flat.imag[self._open] = self._amplitude * np.sin(phase)
        field = self._in_y @ (self._field if self._lyot is None else self._lyot.behind(self._field)) @ self._in_x
        return np.asarray(field.real**2 + field.imag**2)

    def mean_contrast(self, image: Single, wedge: Wedge) -> float:
        """Mean of an image's samples (rows, columns) in a wedge, those of `coronagraph.mean_contrast`.

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
    """A `LyotStop` for cells (rows, columns) of several samples, in single precision.

    Attributes:
        to_y, to_x: (k, rows) and (columns, k) from the cells to the opaque part.
        back_y, back_x: (rows, k) and (k, columns) from there.
        opaque: (k, k).
        stop: (rows, columns).
    """

    to_y: SingleComplex
    to_x: SingleComplex
    back_y: SingleComplex
    back_x: SingleComplex
    opaque: Single
    stop: Single

    @classmethod
    def of(cls, lyot: LyotStop, square: int, used: tuple[Whole, Whole]) -> "_Lyot":
        n, k = len(lyot.stop), len(lyot.opaque)
        cells = kernel(k, lyot.samples_per, n, 1.0).reshape(k, n // square, square)
        y, x = (cells[:, each].sum(axis=2).astype(np.complex64) / np.float32(n) for each in used)
        back_y, back_x = ((cells[:, each].mean(axis=2).conj() / lyot.samples_per).astype(np.complex64) for each in used)
        stop = _averaged(lyot.stop, square)[np.ix_(*used)].astype(np.float32)
        return cls(y, x.T, back_y.T, back_x, lyot.opaque.astype(np.float32), stop)

    def behind(self, field: SingleComplex) -> SingleComplex:
        taken_out = self.back_y @ (self.opaque * (self.to_y @ field @ self.to_x)) @ self.back_x
        return np.asarray(self.stop * (field - taken_out))


def _averaged(pupil: Array, square: int) -> Array:
    """Means (n / square, n / square) over squares of samples."""
    cells = len(pupil) // square
    return np.asarray(pupil.reshape(cells, square, cells, square).mean(axis=(1, 3)))


def _in_squares(pupil: Array) -> bool:
    """Whether the samples are the same in every square of two by two."""
    if len(pupil) % 2:
        return False
    squares = pupil.reshape(len(pupil) // 2, 2, len(pupil) // 2, 2)
    return bool((squares == squares[:, :1, :, :1]).all())
