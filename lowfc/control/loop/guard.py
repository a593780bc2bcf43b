"""The guard of a linear law: an integrator takes over if the law has larger errors or amplifies the disturbance.

Tip and tilt are judged apart from the other modes, as the larger group would hide the smaller. While the law drives a
group, the integrator is virtual there (only computed, from the same frames), and vice versa.

Squared errors are compared in blocks of frames, and several blocks in a row decide: a step of the disturbance, from
which a law may recover more slowly than the integrator, affects one or two blocks; shifted vibration lines affect all.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from lowfc.arrays import Array, Mask, Single
from lowfc.control.laws import linear_law
from lowfc.control.laws.integrator import TIP_TILT, Integrator, integrate
from lowfc.control.laws.linear_law import LinearLaw
from lowfc.control.loop.inputs import PendingEvent

BLOCK_S, MIN_BLOCK_FRAMES = 0.1, 100
"""Duration of a block, and its least number of frames."""
WORSE_BLOCKS = 4
"""Number of blocks in a row with a worse law or an amplifying loop after which the integrator takes over."""
CROSS_FADE_S = 0.1
"""Duration of the cross-fade."""
BETTER_S = 10.0
"""Time for which the law must be better in every block before it drives again; doubles with each takeover."""
MAX_TAKEOVERS = 4
"""Number of takeovers after which only an operator can let the law drive again."""
WORSE_RATIO, BETTER_RATIO = 1.2, 0.25
"""The law is worse if its mean squared error is above `WORSE_RATIO` times the integrator's, and better if it is below
`BETTER_RATIO` times the integrator's."""
LONG_TERM_S = 10.0
"""Time constant of the long-term mean square of the pseudo-open-loop modes."""
AMPLIFIED = 2.5
"""The loop amplifies if its mean squared error is above this multiple of the long-term mean square of the
pseudo-open-loop modes. If it is below `BETTER_RATIO` times their mean square in this block, however, the loop still
corrects: the disturbance has grown."""

NAMES = ("tip and tilt", "the other modes")  # names of the groups
LAW_RETURNS = "law returns"


class Spans(NamedTuple):
    """Durations at a frame rate: block and cross-fade in frames, the others in blocks."""

    block: int
    cross_fade: int
    waiting: int
    long_term: int

    @classmethod
    def at(cls, rate_hz: float) -> "Spans":
        """The durations at a frame rate."""
        block = max(MIN_BLOCK_FRAMES, round(BLOCK_S * rate_hz))
        waiting, long_term = (max(1, round(seconds * rate_hz / block)) for seconds in (BETTER_S, LONG_TERM_S))
        return cls(block, max(1, round(CROSS_FADE_S * rate_hz)), waiting, long_term)


class Group(NamedTuple):
    """The guard's state for a group of modes.

    Attributes:
        overruled: whether the integrator drives the group.
        faded: frames of the cross-fade to the integrator so far.
        takeovers: number of takeovers by the integrator; `MAX_TAKEOVERS` after one from an amplifying loop.
        blocks: blocks in a row in favour of a change.
        usual_nm2: long-term sum of the mean squares of the group's pseudo-open-loop modes.
    """

    overruled: bool = False
    faded: int = 0
    takeovers: int = 0
    blocks: int = 0
    usual_nm2: float = 0.0

    @property
    def final(self) -> bool:
        """Whether only an operator can let the law drive the group again."""
        return self.takeovers >= MAX_TAKEOVERS

    def judged(self, means_nm2: Sequence[float], spans: Spans, *, void: bool) -> tuple["Group", str]:
        """The group after a block, and why the law is overruled, or `LAW_RETURNS`, or nothing if nothing changes.

        Args:
            means_nm2: means over the block of the squares of errors, virtual errors and pseudo-open-loop modes.
            spans: durations.
            void: whether the comparison with the integrator is invalid. An amplifying loop is detected without that
                comparison, and so even if a wrong delay falsifies the pseudo-open-loop modes used in it.
        """
        error_nm2, virtual_nm2, pol_nm2 = means_nm2
        after = self._replace(usual_nm2=self.usual_nm2 + (pol_nm2 - self.usual_nm2) / spans.long_term)
        if self.overruled:
            better = not void and virtual_nm2 < BETTER_RATIO * error_nm2
            after = after._replace(blocks=self.blocks + 1 if better else 0)
            if self.final or after.blocks < spans.waiting * 2 ** (self.takeovers - 1):
                return after, ""
            return after._replace(overruled=False, blocks=0), LAW_RETURNS
        worse = not void and error_nm2 > WORSE_RATIO * virtual_nm2
        amplified = error_nm2 > max(AMPLIFIED * self.usual_nm2, BETTER_RATIO * pol_nm2)
        after = after._replace(blocks=self.blocks + 1 if worse or amplified else 0)
        if after.blocks < WORSE_BLOCKS:
            return after, ""
        takeovers, rival_nm2 = self.takeovers + 1, virtual_nm2
        what = "the integrator would leave"
        if not worse:  # the loop amplifies: the takeover is final
            takeovers, rival_nm2, what = MAX_TAKEOVERS, self.usual_nm2, "without correction there would be"
        after = after._replace(overruled=True, takeovers=takeovers, blocks=0)
        return after, f"it leaves {error_nm2**0.5:.3g} nm rms, {what} {rival_nm2**0.5:.3g}"


class LawGuard(NamedTuple):
    """The guard's state, from one frame to the next.

    Attributes:
        spans: durations at the law's frame rate.
        members: (modes, groups) 1 where a mode belongs to the group.
        groups: in the order of `members`.
        frames: number of frames in the current block so far.
        sums_nm2: (3, groups) sums of squares: errors, virtual errors, pseudo-open-loop modes.
        void: whether the virtual loop was interrupted during the block.
        virtual_nm: virtual commands (modes,), newest first, of the controller that does not drive the mode; empty until
            the virtual loop starts from the loop's commands.
        x: state (states,) of a virtual law that drives the overruled modes too; None while no mode is overruled.
    """

    spans: Spans
    members: Single
    groups: tuple[Group, ...]
    frames: int
    sums_nm2: Array
    void: bool = False
    virtual_nm: tuple[Single, ...] = ()
    x: Single | None = None

    @classmethod
    def of(cls, law: LinearLaw, groups: Sequence[Group] = ()) -> "LawGuard":
        """The guard of a law, with these groups or new ones."""
        tilt = np.isin(law.noll, TIP_TILT)
        members = np.array([tilt, ~tilt], np.float32).T
        return cls(Spans.at(law.rate_hz), members, tuple(groups) or (Group(),) * len(NAMES), 0, np.zeros((3, 2)))

    @property
    def overruled(self) -> bool:
        """Whether the integrator has part of the command or is taking it over."""
        return any(group.faded or group.overruled for group in self.groups)

    @property
    def weight(self) -> Single:
        """The law's share (modes,) of the command."""
        shares = np.array([1 - group.faded / self.spans.cross_fade for group in self.groups], np.float32)
        return self.members @ shares

    def with_groups(self, groups: Sequence[Group]) -> "LawGuard":
        """A copy at rest, as at the beginning of a block, with these groups."""
        return LawGuard(self.spans, self.members, tuple(groups), 0, np.zeros_like(self.sums_nm2))

    def reset(self) -> "LawGuard":
        """A copy for a law that begins to take over from the integrator: only the long-term mean squares are kept."""
        return self.with_groups([Group(usual_nm2=group.usual_nm2) for group in self.groups])

    def at_rest(self) -> "LawGuard":
        """A copy with a new block, while there is nothing to judge."""
        return self.with_groups([group._replace(blocks=0) for group in self.groups])

    def observed(self, pol_nm: Single, frames: int) -> "LawGuard":
        """A copy at rest, its long-term mean squares updated with a frame in which the law did not drive.

        `frames` is the number of frames that the law has processed.
        """
        weight = 1 / min(frames, self.spans.long_term * self.spans.block)
        squares = np.square(pol_nm).dot(self.members).tolist()
        return self.with_groups(
            [
                group._replace(blocks=0, usual_nm2=group.usual_nm2 + weight * (pol_nm2 - group.usual_nm2))
                for group, pol_nm2 in zip(self.groups, squares, strict=True)
            ]
        )

    def held(self, frames: int, law: LinearLaw) -> "LawGuard":
        """A copy advanced by frames without measurements: commands are held, as in the loop."""
        if not self.virtual_nm:
            return self
        x = self.x
        if x is not None:
            for _ in range(frames):
                x = linear_law.predict(law, x, self.virtual_nm[0])
        held = self.virtual_nm[:1] * min(frames, len(self.virtual_nm))
        return self._replace(virtual_nm=(held + self.virtual_nm)[: len(self.virtual_nm)], x=x)

    def judged(
        self,
        law: LinearLaw,
        x: Single,
        integrator: Integrator,
        weights: tuple[tuple[int, np.float32], ...],
        history_nm: tuple[Single, ...],
        error_nm: Single,
        pol_nm: Single,
        *,
        limited: bool,
    ) -> tuple["LawGuard", list[PendingEvent]]:
        """A copy advanced by one frame of a closed loop, and the resulting events.

        Args:
            law: the guarded law.
            x: (states,) state of the law after this frame, in the real loop.
            integrator: the integrator with which the law is compared.
            weights: lag and weight of each command that an exposure sees.
            history_nm: the loop's commands (modes,) before this frame's, newest first.
            error_nm: (modes,) error of this frame, relative to the loop's target.
            pol_nm: (modes,) pseudo-open-loop modes of this frame, also relative to the target.
            limited: whether a limit of the mirror acted on the last command; virtual commands ignore these limits.
        """
        spans, groups = self.spans, self.groups
        overruled = self.overruled
        if overruled and any(group.faded != (spans.cross_fade if group.overruled else 0) for group in groups):
            return self.with_groups([_faded(group, spans) for group in groups]), []
        squares = np.empty((3, pol_nm.size), np.float32)
        squares[0], squares[1], squares[2] = error_nm, error_nm, pol_nm
        virtual_nm: tuple[Single, ...] = ()
        virtual_x: Single | None = None
        if not limited:
            virtual_nm = self.virtual_nm or history_nm
            virtual_error_nm = pol_nm
            for lag, weight in weights:
                seen_nm = virtual_nm[lag] if weight == 1 else weight * virtual_nm[lag]
                virtual_error_nm = virtual_error_nm + seen_nm
            command_nm, _ = integrate(integrator, virtual_nm[0], virtual_error_nm)
            if overruled:
                integrated: Mask = self.weight < 1  # modes that the integrator drives
                virtual_x = x
                if self.x is not None:
                    y = pol_nm if law.signal == "pol" else np.where(integrated, virtual_error_nm, error_nm)
                    last_nm = np.where(integrated, virtual_nm[0], history_nm[0])
                    virtual_x = linear_law.predict_and_update(law, self.x, y, last_nm)
                law_nm = np.clip(linear_law.respond(law, virtual_x), -integrator.limit_nm, integrator.limit_nm)
                command_nm = np.where(integrated, law_nm, command_nm)
            virtual_nm, squares[1] = (command_nm, *virtual_nm[:-1]), virtual_error_nm
        np.square(squares, out=squares)
        frames, sums_nm2, void = self.frames + 1, self.sums_nm2 + squares.dot(self.members), self.void or limited
        if frames < spans.block:
            return LawGuard(spans, self.members, groups, frames, sums_nm2, void, virtual_nm, virtual_x), []
        means_nm2 = (sums_nm2 / frames).T.tolist()
        judged = [group.judged(means, spans, void=void) for group, means in zip(groups, means_nm2, strict=True)]
        after, events = self.with_groups([group for group, _ in judged]), _events(law, spans, judged)
        if events:  # the comparison restarts once the new controller drives alone
            return after.at_rest(), events
        return after._replace(virtual_nm=virtual_nm, x=virtual_x), []


def _faded(group: Group, spans: Spans) -> Group:
    """Advance by one frame the cross-fade to the controller that drives the group."""
    faded = min(group.faded + 1, spans.cross_fade) if group.overruled else max(group.faded - 1, 0)
    return group._replace(faded=faded, blocks=0)


def _events(law: LinearLaw, spans: Spans, judged: Sequence[tuple[Group, str]]) -> list[PendingEvent]:
    events = []
    for modes, (group, why) in zip(NAMES, judged, strict=True):
        if why == LAW_RETURNS:
            events.append(PendingEvent("LAW_BACK", {"law": law.name, "modes": modes}))
        elif why:
            wait_s = spans.waiting * spans.block / law.rate_hz * 2 ** (group.takeovers - 1)
            until = (
                "until the law is loaded again or the loop is closed again"
                if group.final
                else f"until the law would be far better for {wait_s:.3g} s"
            )
            events.append(PendingEvent("LAW_OVERRULED", {"law": law.name, "modes": modes, "why": why, "until": until}))
    return events
