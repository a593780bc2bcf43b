"""Wavefront and light of a whole run, averaged in at most `MAX_SPANS` spans of equal length."""

import numpy as np
import numpy.typing as npt

from lowfc.arrays import Array, Long, Single
from lowfc.programs.view.snapshot import Snapshot

MAX_SPANS = 600
"""Largest number of spans; beyond it, two spans become one, so that a night needs no more memory than ten minutes."""
_FIRST_NS = 1_000_000_000
_FARTHEST_NS = 7 * 86_400 * 10**9  # a longer jump is an error of the camera's clock
_TRUE, _MEASURED, _LIGHT = slice(0, 3), slice(3, 6), slice(6, 8)  # columns: a count, then sums
_COLUMNS = 8


class SpanMeans:
    """Means over consecutive spans of `span_ns`, at first one second. The first begins at `begin_ns`, None if empty.

    The wavefront is the `true` one of a simulation, otherwise the measured one.
    """

    def __init__(self) -> None:
        self.begin_ns: int | None = None
        self.span_ns = _FIRST_NS
        self.true = False
        self._last_ns = 0  # newest time, ns after `begin_ns`
        self._sums = np.zeros((0, _COLUMNS))

    def feed(self, snapshot: Snapshot) -> None:
        """Add the steps and truths of a snapshot."""
        for true in (True, False):
            new = snapshot.wavefronts(true=true)
            self.add_wavefronts(new.time_ns, new.rms_nm, true=true)
        if snapshot.calibration is not None:
            steps, used = snapshot.steps, snapshot.used
            self.add(steps.time_ns[used], _LIGHT, steps.flux_dn[used, None] / snapshot.calibration.flux_dn)

    def add_wavefronts(self, time_ns: Long, rms_nm: Single, *, true: bool) -> None:
        """Add true or measured wavefronts: rms (frames, 2) of the residual and with a flat mirror."""
        self.true |= true and time_ns.size > 0
        self.add(time_ns, _TRUE if true else _MEASURED, rms_nm.astype(float) ** 2)

    def wavefront(self) -> tuple[Array, Array]:
        """Middle of each span (spans,), ns after `begin_ns`; rms (spans, 2) of the residual and with a flat mirror, nm.

        A span without a frame that was used is NaN.
        """
        sums = self._wavefront
        return np.asarray((np.arange(len(sums)) + 0.5) * self.span_ns, np.float64), np.asarray(np.sqrt(_means(sums)))

    def rms_nm(self) -> tuple[float, float]:
        """Rms of all wavefronts, nm: of the residual, and with a flat mirror; NaN if there are none."""
        residual_nm, flat_nm = np.sqrt(_means(self._wavefront.sum(axis=0, keepdims=True)))[0].tolist()
        return residual_nm, flat_nm

    def light(self) -> Array:
        """Light (spans,) of used frames as a fraction of the calibration's; NaN in a span without a used frame."""
        return _means(self._sums[:, _LIGHT])[:, 0]

    def add(self, time_ns: Long, columns: slice, values: npt.NDArray[np.floating]) -> None:
        """Add `values` (rows, values) at their times to the sums in these columns; the first column counts the rows."""
        if self.begin_ns is None and time_ns.size:
            self.begin_ns = int(time_ns.min())
        after_ns = time_ns - (self.begin_ns or 0)
        valid = (after_ns >= 0) & (after_ns < self._last_ns + _FARTHEST_NS)
        after_ns, values = after_ns[valid], values[valid]
        if not after_ns.size:
            return
        self._last_ns = max(self._last_ns, int(after_ns.max()))
        while (last := self._last_ns // self.span_ns) >= MAX_SPANS:
            self.span_ns *= 2
            self._sums = np.pad(self._sums, ((0, len(self._sums) % 2), (0, 0)))
            self._sums = self._sums[0::2] + self._sums[1::2]
        if last >= len(self._sums):
            self._sums = np.pad(self._sums, ((0, last + 1 - len(self._sums)), (0, 0)))
        np.add.at(self._sums[:, columns], after_ns // self.span_ns, np.pad(values, ((0, 0), (1, 0)), constant_values=1))

    @property
    def _wavefront(self) -> Array:
        return self._sums[:, _TRUE if self.true else _MEASURED]


def _means(sums: Array) -> Array:
    """Sums (spans, columns) divided by the counts in the first column."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(sums[:, 1:] / sums[:, :1])
