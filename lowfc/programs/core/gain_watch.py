"""Automatic gains: request optimal gains from measurements; report a closed loop that does harm, and react to it."""

from functools import partial
from typing import NamedTuple

import numpy as np

from lowfc.arrays import Array, Mask, Single
from lowfc.control.calibration.map_reconstructor import map_rows, noise_covariance_nm2, unit_covariances_nm2
from lowfc.control.laws.automatic_gain import BLOCKS, CONFIDENCE, GainBank, Verdict, uncorrected_prior_nm2
from lowfc.control.laws.integrator import TIP_TILT, injected_fraction
from lowfc.control.loop.inputs import COUNT_BITS, PendingEvent, Request, Step
from lowfc.control.loop.safety import LoopMode
from lowfc.control.loop.state import ActiveLoop, Settings, State, Weighting
from lowfc.control.loop.wording import AUTO

FIRST_S = 2.0
"""Length of the first window of frames from which gains are computed: all modes."""
TILT_S, OTHERS_S = 1.0, 10.0
"""Length of later windows: tip and tilt, other modes."""
FLUX_S = 0.25
"""Averaging time of the flux."""
STAR_STEP = 0.2
"""Relative change of the flux, in two consecutive averages, above which the star counts as another one."""
HARMFUL_WINDOWS = 3
"""Number of windows in a row in which an open loop would have had a smaller residual, after which harm is reported."""
CAUTIOUS_GAIN = 0.05
"""Highest gain of modes other than tip and tilt after their first window, in which tip and tilt may be uncorrected.

The second-order response of the sensor to tip and tilt resembles these modes.
"""
MIN_FRAMES = 50
"""Smallest number of frames in a window."""
REQUESTER = "automatic gains"
_REACTIONS = {"": "nothing is done", "open": "the loop opens", "law": "the integrator takes over"}
"""Reaction to harm in words, by the name of its request."""


class Actions(NamedTuple):
    """Requests to the controller, and events to publish."""

    requests: tuple[Request, ...] = ()
    events: tuple[PendingEvent, ...] = ()


NO_ACTIONS = Actions()


class _Group:
    """Modes that are evaluated together: tip and tilt, or the other modes."""

    def __init__(self, mask: Mask, tilt: Mask | None, settings: Settings, loop: ActiveLoop, window_s: float) -> None:
        """Evaluate the modes in `mask` (modes,).

        `tilt` (modes,) selects tip and tilt if their cross-talk into these modes is measured, and is None otherwise.
        """
        rate_hz = settings.rate_hz or 1.0
        frames = [max(round(seconds * rate_hz), MIN_FRAMES) for seconds in (FIRST_S, window_s)]
        self.mask, self.tilt = mask, tilt
        leak, limit_nm = loop.integrator.leak[mask], loop.integrator.limit_nm[mask]
        new_bank = partial(GainBank, leak, limit_nm, loop.delay_weights, settings.delay_frames)
        self.bank = new_bank((frames[0], frames[1]))
        self.verdict: Verdict | None = None
        self.gain = loop.integrator.gain[mask]
        self.harmful_windows = 0
        self.cautious = window_s == OTHERS_S  # until the first verdict, see CAUTIOUS_GAIN
        self._rehearse(new_bank((BLOCKS, BLOCKS)))

    def _rehearse(self, bank: GainBank) -> None:
        """Give a verdict with a bank that is then discarded: the first one takes twice as long, and numpy imports."""
        nothing = np.zeros(self.gain.size, np.float32)
        while not bank.complete:
            bank.add_frame(nothing, nothing, None if self.tilt is None else np.zeros(2, np.float32), closed=False)
        bank.verdict(nothing, np.ones(nothing.size))


class GainWatch:
    """Observes the steps of one controller; it acts on the loop by requests only.

    `closing_harm` is a sentence on the harm of closing at the present gains; empty without harm, or once closed.
    """

    def __init__(self, settings: Settings, on_harm: str, contrast: Array | None = None) -> None:
        """Watch a loop; `contrast` (modes, modes) is the quadratic form of added contrast, per nm^2, if known."""
        self._settings, self._on_harm, self._contrast = settings, on_harm, contrast
        self._groups: list[_Group] = []
        self._identity: tuple[object, ...] = ()
        self._weighting: Weighting | None = None
        self._newest = 0
        self._flux_sum_dn = self._flux_frames = 0.0
        self._former_flux_dn = 0.0
        self._changed_in_a_row = 0
        self._mode = LoopMode.IDLE
        self.closing_harm = ""

    def observe(self, step: Step, state: State) -> Actions:
        """Process a step and the state after it."""
        loop = state.loop
        if loop is None or not loop.calibration.noll:
            return NO_ACTIONS
        self.prepare(loop)
        if loop.weighting is not self._weighting:
            self._weighting = weighting = loop.weighting
            from_own_modes = np.eye(len(loop.calibration.noll), dtype=np.float32)
            if weighting is not None:
                (from_own_modes,) = map_rows(loop.calibration, *weighting, loop.camera, from_own_modes)
            for group in self._groups:
                group.bank.use_reconstructor(from_own_modes[np.ix_(group.mask, group.mask)])
        newest, before = state.frame_sequence, self._newest
        if step.frame_sequence != newest or newest == before:  # not a new exposure
            return NO_ACTIONS
        self._newest = newest
        same_camera = newest >> COUNT_BITS == before >> COUNT_BITS
        missing = newest - before - 1 if same_camera and newest > before else 1  # `clear` may lower the sequence
        channels = loop.command_channels
        playing = channels is not None and channels.play is not None
        if (
            step.error_nm is None
            or step.pol_nm is None
            or state.estimate is None
            or playing
            or state.mode not in (LoopMode.OPEN, LoopMode.CLOSED)
        ):
            self._hold(missing + 1)
            return NO_ACTIONS
        if missing:
            self._hold(missing)
        open_nm = step.pol_nm if channels is None else step.pol_nm - channels.offset_nm
        closed = step.mode is LoopMode.CLOSED and not state.returning_to_zero
        flux_ratio = self._flux_change(step.flux_dn)
        if flux_ratio:
            return self._star_changed(step, loop, flux_ratio)
        closing = step.mode is LoopMode.CLOSED and self._mode is LoopMode.OPEN and self.closing_harm
        events = (PendingEvent("CLOSING_HARMS", {"harm": self.closing_harm}),) if closing else ()
        self._mode = step.mode
        if closed:
            self.closing_harm = ""
        judged = [
            group
            for group in self._groups
            if group.bank.add_frame(
                open_nm[group.mask],
                step.error_nm[group.mask],
                None if group.tilt is None else state.estimate.error_nm[group.tilt],
                closed=closed,
            )
        ]
        if not judged:
            return Actions(events=events) if events else NO_ACTIONS
        actions = self._judge(judged, step, state, loop)
        return actions._replace(events=(*events, *actions.events))

    def _hold(self, frames: int) -> None:
        """Advance the groups by frames without measurements."""
        for group in self._groups:
            group.bank.held(frames)

    def added_contrast(self) -> tuple[float, Array] | None:
        """Added contrast in open loop, and of each mode now (modes,); None until measured."""
        if self._contrast is None or not self._groups:
            return None
        open_nm2, now_nm2 = np.zeros((2, len(self._contrast)))
        for group in self._groups:
            verdict, mask, closed = group.verdict, group.mask, self._mode is LoopMode.CLOSED
            if verdict is None or verdict.noise_nm2 is None or mask.size != now_nm2.size:
                return None
            open_nm2[mask] = now_nm2[mask] = np.maximum(verdict.power_nm2 - verdict.noise_nm2, 0)
            if closed:
                if verdict.loop_nm2 is None:
                    return None
                now_nm2[mask] = np.maximum(
                    open_nm2[mask] + verdict.loop_nm2, injected_fraction(group.gain) * verdict.noise_nm2
                )
        per_nm2 = np.diag(self._contrast)
        return float(per_nm2 @ open_nm2), per_nm2 * now_nm2

    def prepare(self, loop: ActiveLoop) -> None:
        """Set up the groups anew if calibration, leaks or limits changed; slow, so call it before the first frame."""
        identity = loop.calibration.id, loop.integrator.leak.tobytes(), loop.integrator.limit_nm.tobytes()
        if identity == self._identity:
            return
        self._identity, self._weighting = identity, None
        unit_covariances_nm2(loop.calibration)  # computed now, not between two frames
        tilt = np.isin(loop.calibration.noll, TIP_TILT)
        tilt_of_others = tilt if tilt.sum() == len(TIP_TILT) else None
        self._groups = [
            _Group(mask, cross_talk, self._settings, loop, window_s)
            for mask, cross_talk, window_s in ((tilt, None, TILT_S), (~tilt, tilt_of_others, OTHERS_S))
            if mask.any()
        ]
        self._former_flux_dn, self.closing_harm = 0.0, ""

    def _flux_change(self, flux_dn: float) -> float:
        """Ratio of the flux to the former flux if it has changed in two consecutive averages; else 0."""
        self._flux_sum_dn += flux_dn
        self._flux_frames += 1
        if self._flux_frames < max(FLUX_S * self._settings.rate_hz, 10):
            return 0.0
        mean = float(np.float32(self._flux_sum_dn / self._flux_frames))  # the precision of a request for gains
        self._flux_sum_dn = self._flux_frames = 0.0
        if not self._former_flux_dn:
            self._former_flux_dn = mean
        ratio = mean / self._former_flux_dn
        self._changed_in_a_row = self._changed_in_a_row + 1 if abs(ratio - 1) > STAR_STEP else 0
        if self._changed_in_a_row < 2:
            return 0.0
        self._changed_in_a_row, self._former_flux_dn = 0, mean
        return ratio

    def _star_changed(self, step: Step, loop: ActiveLoop, ratio: float) -> Actions:
        """Multiply automatic gains by 0.5, or by the flux ratio if that is smaller, until they are measured again."""
        for group in self._groups:
            group.bank.restart()
        events = (PendingEvent("STAR_CHANGED", {"ratio": ratio}),)
        if not loop.automatic.any():
            return Actions(events=events)
        lowered = loop.integrator.gain * np.float32(min(ratio, 0.5))
        request = self._gain_request(step, loop, np.where(loop.automatic, lowered, loop.integrator.gain))
        return Actions((request,), events)

    def _judge(self, judged: list[_Group], step: Step, state: State, loop: ActiveLoop) -> Actions:
        """Requests and events when a block of frames of these groups is full; a full window gives a verdict."""
        noise_nm2 = self._noise_nm2(loop) if any(group.bank.complete for group in judged) else None
        gain, first_window, events = loop.integrator.gain.copy(), False, []
        for group in judged:
            if not group.bank.complete:
                early = group.bank.early_gains(loop.integrator.gain[group.mask])
                gain[group.mask] = np.where(loop.automatic[group.mask], early, gain[group.mask])
                continue
            first_window |= group.bank.first
            noise = None if noise_nm2 is None else noise_nm2[group.mask]
            group.gain = loop.integrator.gain[group.mask]
            group.verdict = verdict = group.bank.verdict(loop.integrator.gain[group.mask], noise)
            best = np.minimum(verdict.gain, CAUTIOUS_GAIN) if group.cautious else verdict.gain
            gain[group.mask] = np.where(loop.automatic[group.mask], best, gain[group.mask])
            if group.cautious:
                group.cautious = False
                group.bank.begin_first_window()
            events += self._harm_events(group, verdict, loop)
        requests, request = [], partial(Request, step.time_ns, requester=REQUESTER)
        if loop.automatic.any() and (first_window or not np.array_equal(gain, loop.integrator.gain)):
            requests.append(self._gain_request(step, loop, gain))
        self.closing_harm = "" if state.mode is LoopMode.CLOSED else self._closing_harm(gain, loop)
        if state.waits_for_gains and all(group.verdict is not None for group in self._groups):
            requests.append(request("close", text=f"{AUTO}: the gains were measured"))
        if events and (reaction := self._reaction(loop)):
            requests.append(request(reaction, text=f"{AUTO}: the loop increased the residual"))
        return Actions(tuple(requests), tuple(events))

    def _closing_harm(self, gain: Single, loop: ActiveLoop) -> str:
        """Sentence on the wavefront that closing would add, from modes evaluated at their present gains."""
        noll, harm_nm2 = np.array(loop.calibration.noll), np.zeros(len(loop.calibration.noll))
        for group in self._groups:
            verdict = group.verdict
            if verdict is None or not np.array_equal(gain[group.mask], loop.integrator.gain[group.mask]):
                continue
            harmful = verdict.change_nm2 > CONFIDENCE * verdict.change_error_nm2
            harm_nm2[group.mask] = np.where(harmful, verdict.change_nm2, 0)
        harmful_modes = noll[harm_nm2 > 0].tolist()
        if not harmful_modes:
            return ""
        added = ""
        if self._contrast is not None and len(self._contrast) == noll.size:
            added = f"{np.diag(self._contrast) @ harm_nm2:.1e} of contrast, "
        names, indices = ", ".join(f"Z{index}" for index in harmful_modes), ",".join(map(str, harmful_modes))
        return (
            f"closing adds {added}{harm_nm2.sum() ** 0.5:.3g} nm rms in {names}, with this star and these gains: "
            f"`lowfc ctl gain auto --modes {indices}` chooses their gains, `lowfc ctl gain 0 --modes {indices}` leaves "
            "them uncorrected"
        )

    def _noise_nm2(self, loop: ActiveLoop) -> Array | None:
        """Noise variance of one frame (modes,) at this star's flux; None if the camera's gain is unknown."""
        flux_dn = self._former_flux_dn or loop.calibration.flux_dn
        covariance = noise_covariance_nm2(loop.calibration, flux_dn, loop.camera)
        return None if covariance is None else np.diag(covariance)

    def _gain_request(self, step: Step, loop: ActiveLoop, gain: Single) -> Request:
        """The request for gains (modes,), with the prior variances of the uncorrected modes for the reconstructor."""
        noise_nm2, uncorrected = self._noise_nm2(loop), loop.automatic & (gain == 0)
        prior_nm2: tuple[float, ...] = ()
        if noise_nm2 is not None and all(group.verdict is not None for group in self._groups):
            prior = np.zeros(gain.size, np.float32)
            for group in self._groups:
                assert group.verdict is not None  # noqa: S101  # checked above
                prior[group.mask] = uncorrected_prior_nm2(group.verdict, uncorrected[group.mask], noise_nm2[group.mask])
            prior_nm2 = tuple(prior.tolist())
        values = tuple(gain.astype(np.float32).tolist())
        return Request(
            step.time_ns,
            "gain",
            (),
            values,
            AUTO,
            requester=REQUESTER,
            prior_nm2=prior_nm2,
            flux_dn=self._former_flux_dn,
        )

    def _harm_events(self, group: _Group, verdict: Verdict, loop: ActiveLoop) -> list[PendingEvent]:
        """The event if an open loop would have had a smaller residual in `HARMFUL_WINDOWS` windows in a row."""
        if verdict.loop_nm2 is None:
            group.harmful_windows = 0
            return []
        added_nm2, error_nm2 = verdict.loop_nm2.sum(), np.sqrt(np.square(verdict.loop_error_nm2).sum())
        group.harmful_windows = group.harmful_windows + 1 if added_nm2 > 3 * error_nm2 else 0
        if group.harmful_windows != HARMFUL_WINDOWS:
            return []
        reaction = self._reaction(loop)
        if reaction == "law":  # count anew for the integrator, or for the law if the request is refused
            for each in self._groups:
                each.harmful_windows = 0
        noise_nm2 = self._noise_nm2(loop)
        total_noise_nm2 = 0.0 if noise_nm2 is None else float(noise_nm2[group.mask].sum())
        open_nm2 = max(float(verdict.power_nm2.sum()) - total_noise_nm2, 0.0)
        harmful = (verdict.loop_nm2 > 2 * verdict.loop_error_nm2) | (verdict.loop_nm2 == verdict.loop_nm2.max())
        noll = np.array(loop.calibration.noll)[group.mask]
        details: dict[str, object] = {
            "modes": ", ".join(f"Z{index}" for index in noll[harmful]),
            "closed_nm": float(np.sqrt(open_nm2 + added_nm2)),
            "open_nm": float(np.sqrt(open_nm2)),
            "action": _REACTIONS[reaction],
        }
        return [PendingEvent("LOOP_HARMS", details)]

    def _reaction(self, loop: ActiveLoop) -> str:
        """Name of the request that reacts to harm by the loop; empty for none."""
        if self._on_harm == "integrator" and loop.law_runner is not None:
            return "law"
        return "" if self._on_harm == "warn" else "open"
