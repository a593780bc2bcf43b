"""Implementations of the control step, and a calibration's arrays in the layout of the compiled functions."""

from collections.abc import Callable
from typing import Final, Literal, NamedTuple, get_args

import numpy as np

from lowfc.arrays import Pixels, Sequences, Single, aligned, single
from lowfc.control.calibration.calibration import Calibration

KernelName = Literal["numpy", "fused"]
"""Implementation of the control step for normal frames."""
KERNELS: tuple[KernelName, ...] = get_args(KernelName)
FUSED: Final = "fused"
BLOCK = 6400
"""Largest number of pixels in a block: 25.6 kB as float32, which fits into an L1 data cache of 32 to 48 kB."""
DARK_MARGIN = 1e-3
"""Margin above the lowest allowed flux, as a fraction of the expected flux: within it, where rounding matters, the
reference step decides whether a frame is dark."""


class Kernel(NamedTuple):
    """Implementation for normal frames: `measure` and `respond` of `lowfc.control.kernel.functions`, compiled.

    If one is None, the reference implementation is used, regardless of the name.
    """

    name: str
    measure: Callable[..., float] | None = None
    respond: Callable[..., bool] | None = None


NUMPY = Kernel("numpy")


class Estimate(NamedTuple):
    """R (I - I0) (modes,) of a frame, nm of wavefront rms, and the sum of its good pixels, dark subtracted, DN."""

    error_nm: Single
    flux_dn: float

    def same(self, other: "Estimate | None") -> bool:
        """Whether both come from identical images, as from a stuck camera; photon noise makes real images differ."""
        return other is not None and self.flux_dn == other.flux_dn and np.array_equal(self.error_nm, other.error_nm)


class Tables(NamedTuple):
    """Arrays of a calibration for the compiled functions; most are as in `lowfc.control.kernel.functions`.

    Attributes:
        full_well: lowest count of a saturated pixel; above all counts if no pixel can be saturated.
        margin_dn: `DARK_MARGIN` in DN.
        shapes: (modes, actuators) nm of surface per nm of wavefront.
        zeros_nm: (modes,) shift and target for `respond` without channels or offset.
        no_channels: (rows, columns) zeros, likewise.
        no_states: (0,), for `respond` without a linear law; `no_law` (0, 0) likewise.
    """

    measure: Callable[..., float]
    respond: Callable[..., bool]
    good: Pixels
    dark: Single
    tiles: Single
    scratch: Single
    sums_nm: Single
    totals: Sequences
    reference_nm: Single
    full_well: int
    dark_sum_dn: float
    margin_dn: float
    shapes: Single
    zeros_nm: Single
    no_states: Single
    no_law: Single
    no_channels: Single

    @classmethod
    def of(cls, kernel: Kernel, calibration: Calibration, reference_nm: Single) -> "Tables | None":
        """Tables of a calibration; None without compiled functions, pixels or modes."""
        modes, pixels = calibration.reconstructor.shape
        if kernel.measure is None or kernel.respond is None or not modes * pixels:
            return None
        blocks = -(-pixels // BLOCK)
        block = -(-pixels // blocks)
        padded = np.zeros((-(-modes // 5) * 5, blocks * block), np.float32)
        padded[:modes, :pixels] = calibration.reconstructor
        return cls(
            kernel.measure,
            kernel.respond,
            good=np.where(calibration.good > 0, 0xFFFF, 0).astype(np.uint16),
            dark=aligned(calibration.dark),
            tiles=aligned(padded.reshape(-1, blocks, block).swapaxes(0, 1)).reshape(-1, block),
            scratch=aligned(np.empty(block, np.float32)),
            sums_nm=np.empty((blocks, len(padded)), np.float32),
            totals=np.empty((blocks, 2), np.uint64),
            reference_nm=reference_nm,
            full_well=int(np.ceil(min(calibration.saturation_dn, 0x1_0000))),
            dark_sum_dn=float(calibration.dark.astype(np.float64) @ calibration.good),
            margin_dn=DARK_MARGIN * calibration.flux_dn,
            shapes=single(calibration.modes_to_actuators.T),
            zeros_nm=np.zeros(modes, np.float32),
            no_states=np.zeros(0, np.float32),
            no_law=np.zeros((0, 0), np.float32),
            no_channels=np.zeros(calibration.grid, np.float32),
        )

    def estimate(self, pixels: Pixels, min_flux_dn: float) -> Estimate | None:
        """Estimate of a frame (pixels,), DN, by the fused step; None if the frame needs the reference step.

        A frame needs it if a good pixel is saturated, or the flux is not above `min_flux_dn` plus the margin.
        """
        error_nm = np.empty_like(self.reference_nm)
        least_dn = min_flux_dn + self.margin_dn
        scanned = pixels, self.good, self.dark, self.tiles, self.scratch, self.sums_nm, self.totals
        flux_dn = self.measure(*scanned, self.reference_nm, self.full_well, self.dark_sum_dn, least_dn, error_nm)
        return Estimate(error_nm, flux_dn) if flux_dn else None
