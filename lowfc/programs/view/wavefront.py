"""The wavefront against time: every mode, tip and tilt in mas, and what is left in all and by group."""

import numpy as np
import numpy.typing as npt
import rerun as rr
import rerun.blueprint as rrb

from lowfc.optics.zernike import mode_name, noll_to_nm
from lowfc.programs.view.colours import BLUE, GREEN, GREY, ORANGE, PINK, RED, YELLOW, distinct
from lowfc.programs.view.marks import curves, name_curves
from lowfc.programs.view.moment import Moment
from lowfc.programs.view.panel import Panel

ERROR, POL, COMMAND, TRUTH = "modes/error", "modes/pseudo_open_loop", "modes/command", "modes/truth"
RMS, GROUPS, TILT = "residual/rms", "residual/groups", "pointing/tilt"
TIP_TILT = (2, 3)

_GROUPS = {1: "tip and tilt", 2: "focus, astigmatism", 3: "coma, trefoil", 4: "spherical to tetrafoil"}
_GROUP_COLOURS = (YELLOW, BLUE, PINK, GREEN, RED)

Values = npt.NDArray[np.floating]


class Wavefront(Panel):
    """Every step and, in a simulation, every truth."""

    def __init__(self, nm_per_mas: float) -> None:
        self._nm_per_mas = nm_per_mas
        self._named: tuple[tuple[int, ...], bool] | None = None
        self._groups: list[npt.NDArray[np.intp]] = []
        self._tilts: list[int] = []

    def draw(self, stream: rr.RecordingStream, moment: Moment) -> None:
        """Add what is new."""
        steps, truths = moment.steps, moment.truths
        if moment.calibration is None:
            return
        noll = moment.calibration.noll
        true = truths.sequence.size > 0 and truths.residual_nm.shape[1] == len(noll)
        if (true or steps.sequence.size) and self._named != (noll, true or self._was_true):
            self._name(stream, noll, true)
        if steps.command_nm.shape[1] == len(noll):
            curves(stream, ERROR, steps.time_ns, steps.error_nm)
            curves(stream, POL, steps.time_ns, steps.pol_nm)
            curves(stream, COMMAND, steps.time_ns, steps.command_nm)
        if true:
            curves(stream, TRUTH, truths.time_ns, truths.residual_nm)
            rms_nm = np.stack([truths.disturbance_rms_nm, truths.residual_rms_nm], axis=1)
            self._sum_up(stream, truths.time_ns, truths.residual_nm, rms_nm)
        elif steps.sequence.size and not self._was_true and steps.command_nm.shape[1] == len(noll):
            rms_nm = np.stack([_rss(steps.pol_nm), _rss(steps.error_nm)], axis=1)
            self._sum_up(stream, steps.time_ns, steps.error_nm, rms_nm)

    @property
    def _was_true(self) -> bool:
        return self._named is not None and self._named[1]

    def _sum_up(
        self, stream: rr.RecordingStream, times_ns: npt.NDArray[np.int64], modes_nm: Values, rms_nm: Values
    ) -> None:
        curves(stream, RMS, times_ns, rms_nm)
        curves(stream, GROUPS, times_ns, np.stack([_rss(modes_nm[:, group]) for group in self._groups], axis=1))
        if self._tilts:
            curves(stream, TILT, times_ns, modes_nm[:, self._tilts] / self._nm_per_mas)

    def _name(self, stream: rr.RecordingStream, noll: tuple[int, ...], true: bool) -> None:
        self._named = (noll, true)
        names, colours = [mode_name(index) for index in noll], distinct(len(noll))
        for path in (ERROR, POL, COMMAND, TRUTH):
            name_curves(stream, path, names, colours)
        what = "true" if true else "measured"
        with_loop = [f"with a flat mirror, {what if true else 'pseudo-open-loop'}", f"residual, {what}"]
        name_curves(stream, RMS, with_loop, [GREY, GREEN], 1.6)  # the last one lies on top
        degrees = np.array([noll_to_nm(index)[0] for index in noll])
        found = sorted(set(degrees.tolist()))
        self._groups = [np.flatnonzero(degrees == degree) for degree in found]
        group_names = [_GROUPS.get(degree, f"radial degree {degree}") for degree in found]
        name_curves(stream, GROUPS, group_names, [_GROUP_COLOURS[n % len(_GROUP_COLOURS)] for n in range(len(found))])
        self._tilts = [noll.index(index) for index in TIP_TILT if index in noll]
        tilt_names = [f"{mode_name(noll[place])}, {what}" for place in self._tilts]
        name_curves(stream, TILT, tilt_names, [BLUE, ORANGE][: len(self._tilts)])


def rms_view() -> rrb.View:
    """Rms, with the loop and without."""
    return rrb.TimeSeriesView(origin=RMS, name="Residual wavefront, nm rms", plot_legend=rrb.Corner2D.LeftTop)


def groups_view() -> rrb.View:
    """Rms by group."""
    return rrb.TimeSeriesView(
        origin=GROUPS, name="Residual by group of modes, nm rms", plot_legend=rrb.Corner2D.LeftTop
    )


def tilt_view() -> rrb.View:
    """Tip and tilt."""
    return rrb.TimeSeriesView(origin=TILT, name="Residual tip and tilt, mas", plot_legend=rrb.Corner2D.LeftTop)


def mode_views() -> list[rrb.View]:
    """Every mode, four times."""
    titles = {
        ERROR: "Measured error, nm rms",
        POL: "Pseudo-open-loop: the disturbance as measured, nm rms",
        COMMAND: "Modal command, nm rms of wavefront",
        TRUTH: "True residual (simulation), nm rms",
    }
    return [
        rrb.TimeSeriesView(
            origin=path, name=title, plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop, visible=path == ERROR)
        )
        for path, title in titles.items()
    ]


def _rss(values: Values) -> Values:
    return np.asarray(np.sqrt(np.sum(values**2, axis=1)))
