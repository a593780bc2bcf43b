"""Rms of the true wavefront over the second half of a run of unknown length, and over its most recent frames."""

from typing import Any

import numpy as np
import numpy.typing as npt

from lowfc.arrays import Single
from lowfc.control.laws.integrator import TIP_TILT
from lowfc.optics.chain.added_contrast import by_group, costliest
from sim_camera.scene import Truth, Wavefront

MAX_BLOCKS = 1024
"""Number of stored blocks, at first of one frame each. When all are full, pairs are merged, so that memory is bounded.

The second half of the run begins at the border of a block.
"""

_RMS = "disturbance_rms_nm", "residual_rms_nm", "tilt_disturbance_mas", "tilt_residual_mas"


class WavefrontAccumulator:
    """Sums, in blocks of frames, of the contrast added by each mode and of the squared wavefront.

    Statistics are named as in the message `WavefrontFigures`: rms over the open pupil in nm, and rms of the tilt per
    axis in mas, at the starts of exposures. Those named `continuous_...` are over whole periods, from `instants`
    samples of each; they are absent if not computed.
    """

    def __init__(self, noll: tuple[int, ...], nm_per_mas: float, recent: int, instants: int = 0) -> None:
        """Start without frames.

        Args:
            noll: Noll index of each mode.
            nm_per_mas: wavefront rms of a milliarcsecond of tilt.
            recent: number of frames in the recent statistics.
            instants: samples of each period in the continuous truth; 0 if it is not computed.
        """
        self._noll, self._instants = noll, instants
        value_count = 1 + len(noll) + (8 if instants else 4)
        self._tilts = slice(0, sum(index in TIP_TILT for index in noll))  # tip and tilt are the first modes
        self._nm_per_mas = nm_per_mas
        self._blocks = np.zeros((MAX_BLOCKS, value_count))
        self._frames, self._block_frames = 0, 1
        self._recent = np.zeros((recent, value_count))

    def add(self, truth: Truth, added_flat: float, added: Single) -> None:
        """Add a frame.

        Args:
            truth: the frame's true wavefront.
            added_flat: contrast that the disturbance adds with a flat mirror.
            added: (modes,) contrast that each mode of the residual adds.
        """
        values = (added_flat, *added.tolist(), *self._squares(truth.sampled))
        if truth.continuous is not None:
            values += self._squares(truth.continuous)
        if self._frames == len(self._blocks) * self._block_frames:
            merged = self._blocks[::2] + self._blocks[1::2]
            self._blocks = np.concatenate((merged, np.zeros_like(merged)))
            self._block_frames *= 2
        self._blocks[self._frames // self._block_frames] += values
        self._recent[self._frames % len(self._recent)] = values
        self._frames += 1

    def wavefront(self) -> dict[str, Any]:
        """Statistics over the second half of the frames; empty before the first frame, like those of `recent`."""
        first = self._frames // 2 // self._block_frames
        frames = self._frames - first * self._block_frames
        return self._statistics(self._blocks[first:].sum(axis=0) / frames) if frames else {}

    def recent(self) -> dict[str, Any]:
        """Statistics over the most recent frames."""
        frames = self._recent[: self._frames]
        return self._statistics(frames.mean(axis=0)) if len(frames) else {}

    def _squares(self, wavefront: Wavefront) -> tuple[float, ...]:
        """Squares in nm^2 in the order of `_RMS`; those of tilt are summed over its axes."""
        disturbance_nm, residual_nm = wavefront.disturbance_nm[self._tilts], wavefront.residual_nm[self._tilts]
        pupil_nm2 = wavefront.disturbance_rms_nm**2, wavefront.residual_rms_nm**2
        return (*pupil_nm2, float(disturbance_nm @ disturbance_nm), float(residual_nm @ residual_nm))

    def _statistics(self, mean: npt.NDArray[np.float64]) -> dict[str, Any]:
        """Statistics from the means over frames of the values that `add` sums."""
        flat, added, squares = mean[0], mean[1 : 1 + len(self._noll)], mean[1 + len(self._noll) :]
        divisors = np.array([1, 1, *[self._tilts.stop * self._nm_per_mas**2] * 2])
        rms = np.sqrt(squares.reshape(-1, 4) / divisors).ravel().tolist()
        statistics = dict(zip((*_RMS, *(f"continuous_{name}" for name in _RMS)), rms, strict=False))
        statistics |= {
            "instants": self._instants,
            "added_contrast_flat": float(flat),
            "added_contrast": float(added.sum()),
        }
        modes, share = costliest(by_group(self._noll, added)) if added.any() else ("", 0.0)
        return statistics | {"costliest_modes": modes, "costliest_share": share}
