"""The wavefront and the light of a whole run, in at most some hundreds of spans of even length."""

from math import floor, isfinite, log10

import numpy as np
import numpy.typing as npt

from lowfc.arrays import Array, Long
from lowfc.programs.view.snapshot import Snapshot

MOST = 600
"""Spans kept: at one more, two and two become one, so that a night is kept in as much memory as ten minutes."""
_FIRST_NS = 1_000_000_000
_FARTHEST_NS = 7 * 86_400 * 10**9  # a camera's clock that jumps farther is wrong
_TRUE, _MEASURED, _LIGHT = slice(0, 3), slice(3, 6), slice(6, 8)  # columns: a count, then sums
_COLUMNS = 8


class Course:
    """Means of each span, one second long at first.

    Attributes:
        begin_ns: beginning of the first span; None before the first step or truth.
        span_ns: length of each.
        true: whether the wavefront is the true one of a simulation, else the measured one.
    """

    def __init__(self) -> None:
        self.begin_ns: int | None = None
        self.span_ns = _FIRST_NS
        self.true = False
        self._sums = np.zeros((0, _COLUMNS))

    def feed(self, snapshot: Snapshot) -> None:
        """Add the steps and truths of a snapshot."""
        steps, truths = snapshot.steps, snapshot.truths
        self.true |= truths.time_ns.size > 0
        self._add(truths.time_ns, _TRUE, truths.residual_rms_nm**2.0, truths.disturbance_rms_nm**2.0)
        used = np.isfinite(steps.error_nm).all(axis=1) & (steps.error_nm.shape[1] > 0)
        error_nm, pol_nm = (values[used].astype(np.float64) for values in (steps.error_nm, steps.pol_nm))
        self._add(steps.time_ns[used], _MEASURED, np.sum(error_nm**2, axis=1), np.sum(pol_nm**2, axis=1))
        if snapshot.calibration is not None:
            self._add(steps.time_ns[used], _LIGHT, steps.flux_dn[used] / snapshot.calibration.flux_dn)

    def wavefront(self) -> tuple[Array, Array]:
        """Middle of each span (spans,), ns after `begin_ns`, and rms nm (spans, 2): residual, with a flat mirror.

        A span without a frame that was used is NaN.
        """
        sums = self._sums[:, _TRUE if self.true else _MEASURED]
        return np.asarray((np.arange(len(sums)) + 0.5) * self.span_ns, np.float64), np.asarray(np.sqrt(_means(sums)))

    def light(self) -> Array:
        """Light (spans,) on used frames, of what the calibration expects; NaN in a span without one."""
        return _means(self._sums[:, _LIGHT])[:, 0]

    def _add(self, time_ns: Long, where: slice, *values: npt.NDArray[np.floating]) -> None:
        if not time_ns.size:
            return
        if self.begin_ns is None:
            self.begin_ns = int(time_ns.min())
        after_ns = time_ns - self.begin_ns
        right = (after_ns >= 0) & (after_ns < _FARTHEST_NS)
        after_ns, values = after_ns[right], tuple(column[right] for column in values)
        if not after_ns.size:
            return
        while (last := int(after_ns.max()) // self.span_ns) >= MOST:
            self._halve()
        if last >= len(self._sums):
            self._sums = np.concatenate([self._sums, np.zeros((last + 1 - len(self._sums), _COLUMNS))])
        rows = np.stack([np.ones(len(after_ns)), *values], axis=1)
        np.add.at(self._sums[:, where], after_ns // self.span_ns, rows)

    def _halve(self) -> None:
        self.span_ns *= 2
        if len(self._sums) % 2:
            self._sums = np.concatenate([self._sums, np.zeros((1, _COLUMNS))])
        self._sums = self._sums[0::2] + self._sums[1::2]


def round_125(value: float, *, up: bool) -> float:
    """The next 1, 2 or 5 times a power of ten, above or below a positive value."""
    if not (isfinite(value) and value > 0):
        return 1.0
    decade = 10.0 ** floor(log10(value))
    steps = [step * decade for step in (1.0, 2.0, 5.0, 10.0)]
    if up:
        return next(step for step in steps if step >= value * (1 - 1e-9))
    return next(step for step in reversed(steps) if step <= value * (1 + 1e-9))


def _means(sums: Array) -> Array:
    """Sums (spans, columns) over counts, the first column."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(sums[:, 1:] / sums[:, :1])
