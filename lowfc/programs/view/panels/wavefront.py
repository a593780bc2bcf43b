"""Panel of the wavefront against time: each mode, tip and tilt in mas, total residual, residual by group of modes."""

import numpy as np
import numpy.typing as npt
import rerun as rr
import rerun.blueprint as rrb

from lowfc.arrays import Integers, Long
from lowfc.control.laws.integrator import TIP_TILT
from lowfc.optics.chain.zernike import mode_name, noll_to_orders
from lowfc.programs.view.draw.colours import BLUE, GREEN, GREY, ORANGE, PINK, RED, YELLOW, distinct
from lowfc.programs.view.draw.plots import Plot
from lowfc.programs.view.panels.panel import Panel
from lowfc.programs.view.snapshot import Snapshot

_HIDDEN = rrb.PlotLegend(rrb.Corner2D.LeftTop, visible=False)
ERROR = Plot("modes/error", "Measured error, nm rms", legend=rrb.PlotLegend(rrb.Corner2D.LeftTop, visible=True))
POL = Plot("modes/pseudo_open_loop", "Pseudo-open-loop: the disturbance as measured, nm rms", legend=_HIDDEN)
COMMAND = Plot("modes/command", "Modal command, nm rms of wavefront", legend=_HIDDEN)
TRUTH = Plot("modes/truth", "True residual (simulation), nm rms", legend=_HIDDEN)
MODES = (ERROR, POL, COMMAND, TRUTH)
RMS = Plot("residual/rms", "Residual wavefront, nm rms", width=1.6)
GROUPS = Plot("residual/groups", "Residual by group of modes, nm rms")
TILT = Plot("pointing/tilt", "Residual tip and tilt, mas")

_GROUPS = {1: "tip and tilt", 2: "focus, astigmatism", 3: "coma, trefoil", 4: "spherical to tetrafoil"}
_GROUP_COLOURS = (YELLOW, BLUE, PINK, GREEN, RED)

Values = npt.NDArray[np.floating]


class Wavefront(Panel):
    """Curves of every step and, in a simulation, of every true wavefront."""

    def __init__(self, nm_per_mas: float) -> None:
        self._nm_per_mas = nm_per_mas
        self._noll: tuple[int, ...] = ()
        self._true = False
        self._groups: list[Integers] = []
        self._tilts: list[int] = []

    def draw(self, stream: rr.RecordingStream, snapshot: Snapshot) -> None:
        """Add the new data."""
        steps, truths = snapshot.steps.at(snapshot.new_exposures), snapshot.truths
        if snapshot.calibration is None:
            return
        noll = snapshot.calibration.noll
        true = truths.sequence.size > 0 and truths.residual_nm.shape[1] == len(noll)
        if (true or steps.sequence.size) and (noll != self._noll or (true and not self._true)):
            self._name(stream, noll, true)
        if steps.command_nm.shape[1] == len(noll):
            for plot, values in ((ERROR, steps.error_nm), (POL, steps.pol_nm), (COMMAND, steps.command_nm)):
                plot.add(stream, steps.time_ns, values)
            if steps.sequence.size and not self._true:
                rms_nm = np.stack([_rss(steps.pol_nm), _rss(steps.error_nm)], axis=1)
                self._add_sums(stream, steps.time_ns, steps.error_nm, rms_nm, steps.error_nm)
        if true:
            TRUTH.add(stream, truths.time_ns, truths.residual_nm)
            rms_nm = np.stack([truths.disturbance_rms_nm, truths.residual_rms_nm], axis=1)
            self._add_sums(stream, truths.time_ns, truths.modes_residual_rms_nm, rms_nm, truths.residual_nm)

    def _add_sums(
        self, stream: rr.RecordingStream, times_ns: Long, modes_nm: Values, rms_nm: Values, signed_nm: Values
    ) -> None:
        RMS.add(stream, times_ns, rms_nm)
        GROUPS.add(stream, times_ns, np.stack([_rss(modes_nm[:, group]) for group in self._groups], axis=1))
        if self._tilts:
            TILT.add(stream, times_ns, signed_nm[:, self._tilts] / self._nm_per_mas)

    def _name(self, stream: rr.RecordingStream, noll: tuple[int, ...], true: bool) -> None:
        self._noll, self._true = noll, true
        names = [mode_name(index) for index in noll]
        for plot in MODES:
            plot.name(stream, dict(zip(names, distinct(len(noll)), strict=True)))
        kind = "true" if true else "measured"
        flat = f"with a flat mirror, {'true' if true else 'pseudo-open-loop'}"
        RMS.name(stream, {flat: GREY, f"residual, {kind}": GREEN})
        degrees = np.array([noll_to_orders(index)[0] for index in noll])
        distinct_degrees = sorted(set(degrees.tolist()))
        self._groups = [np.flatnonzero(degrees == degree) for degree in distinct_degrees]
        group_names = [_GROUPS.get(degree, f"radial degree {degree}") for degree in distinct_degrees]
        colours = [_GROUP_COLOURS[number % len(_GROUP_COLOURS)] for number in range(len(distinct_degrees))]
        GROUPS.name(stream, dict(zip(group_names, colours, strict=True)))
        self._tilts = [noll.index(index) for index in TIP_TILT if index in noll]
        TILT.name(stream, {f"{names[row]}, {kind}": (BLUE, ORANGE)[n] for n, row in enumerate(self._tilts)})


def _rss(values: Values) -> Values:
    """Root sum square (rows,) of values (rows, columns)."""
    return np.asarray(np.sqrt(np.sum(values**2, axis=1)))
