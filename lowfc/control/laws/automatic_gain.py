"""Automatic gains: a bank of virtual integrators shows the residual of each gain, and whether closing does harm."""

from typing import NamedTuple

import numpy as np

from lowfc.arrays import Array, Integers, Mask, Single
from lowfc.control.laws.integrator import injected_fraction
from lowfc.control.laws.stability import highest_gain
from lowfc.control.laws.virtual import VirtualIntegrators, Weights

MIN_GAIN = 1e-3
"""Lower limit of a bank's gains above 0, which are the highest gain within the margins, halved repeatedly."""
BLOCKS = 10
"""Blocks of a window, for the standard errors of its means."""
CONFIDENCE = 2.0
"""Standard errors by which one gain must beat another. A gain that is better in `WINNING_BLOCKS` blocks wins as well,
since one block may outweigh all others when the open loop wanders."""
WINNING_BLOCKS = 9
GRANT_SIGMAS = 3.0
"""Standard errors of white noise by which a gain must beat the open loop, in a first window and later for a mode with a
gain of 0. On a faint star, a single gain granted because of noise may add as much contrast as the dark zone has."""
EARLY_BLOCKS = 5
"""Number of blocks after which a mode may get another gain before its window ends: instead of 0, a gain that is better
by `GRANT_SIGMAS`; instead of the least gain, a gain that was better in this many blocks in a row."""
MAX_GROWTH = 16
"""Largest factor by which a window grows while it decides nothing."""
MIN_MAJORITY_MODES = 3
"""Least number of modes with which the majority is evidence for each; with fewer, each is judged by itself."""
MAX_INJECTED = 0.1
"""Ratio of injected noise to correctable power below which a first window chooses the least gain instead of 0."""
CERTAIN_SIGMAS = 4.0
"""Standard errors above which the cross-talk of tip and tilt into another mode counts as certain."""
SUSPECTED_SIGMAS = 2.0
"""Standard errors above which cross-talk counts as suspected, so that a gain must tolerate it: on a faint star, even
uncertain cross-talk may add ten times what the gain removes."""
MARGIN = 5.0
"""Multiple of the measured cross-talk that a gain must tolerate: a sensor underestimates tilt beyond its range."""
FRAMES_PER_SUM = 16
"""Frames that are added to the sums at once: for a single frame, the calls of numpy take longer than the arithmetic."""
_REGRESSORS = 5
"""Tip, tilt, their squares and their product."""


class Verdict(NamedTuple):
    """Result of a window of frames; arrays are (modes,), powers nm^2 of wavefront.

    Attributes:
        gain: the gain of each mode from now on.
        power_nm2: mean square of the open loop, with the noise of a frame and without the cross-talk of tip and tilt.
        noise_nm2: noise in `power_nm2`: as computed, or half the mean square of the change between frames if that is
            larger; None if it was not computed.
        change_nm2: mean square with the current gain minus that of the open loop; above 0, closing does harm.
        change_error_nm2: standard error of `change_nm2`.
        loop_nm2: as `change_nm2`, for the real loop with any law; None if it was not closed in the whole window.
        loop_error_nm2: standard error of `loop_nm2`.
        frames: number of frames in the window.
    """

    gain: Single
    power_nm2: Array
    noise_nm2: Array | None
    change_nm2: Array
    change_error_nm2: Array
    loop_nm2: Array | None
    loop_error_nm2: Array
    frames: int


class GainBank:
    """Virtual integrators of a group of modes, compared over windows of frames.

    The first window after `restart` may choose any gain. Later windows move a gain by at most a factor of two, unless
    the open loop is better than the current gain, or the current gain is 0 or the least gain.
    """

    def __init__(
        self, leak: Single, limit_nm: Single, weights: Weights, delay_frames: float, windows: tuple[int, int]
    ) -> None:
        """Make a bank with a mode for each element of `leak`.

        Args:
            leak: (modes,) of the integrators.
            limit_nm: (modes,) largest command.
            weights: Which commands an exposure sees.
            delay_frames: The loop's delay.
            windows: Frames of the first window, and of each later window before it grows.
        """
        highest = np.array([highest_gain(delay_frames, mode_leak) for mode_leak in leak.tolist()])
        rows = highest.max() * 0.5 ** np.arange(int(np.log2(highest.max() / MIN_GAIN)), -1.0, -1)
        self.rows = np.minimum(np.append(0, rows)[:, None], highest).astype(np.float32)  # (rows, modes)
        self._distinct = np.diff(self.rows, axis=0, prepend=-1) > 0
        self._at_rest = VirtualIntegrators.at_rest(self.rows, 1 - leak, limit_nm, weights)
        self._windows = windows
        self._closed = self._closed_throughout = self._tilt_known = False
        self._waiting = 0  # frames in the arrays below that have not been summed
        self._errors_nm = np.zeros((FRAMES_PER_SUM, len(self.rows) + 1, leak.size), np.float32)  # last row: real loop
        self._tilts_nm = np.zeros((FRAMES_PER_SUM, 2), np.float32)
        self.use_reconstructor(np.eye(leak.size))
        self.restart()

    def restart(self) -> None:
        """Forget all frames, as for another star."""
        self._loops = self._at_rest
        self._cross_talk = TiltCrossTalk(self._at_rest.kept.size)
        self._before_nm: Single | None = None
        self.begin_first_window()

    def use_reconstructor(self, from_own: Array | Single) -> None:
        """Expect modes of another R from now on: `from_own` (modes, modes) times the modes of the calibration's own R.

        The cross-talk of tilt is fitted in the modes of the calibration's own R: another R mixes it into other modes.
        """
        self._add_up()
        self._from_own, self._to_own = from_own, np.linalg.inv(from_own)

    def begin_first_window(self) -> None:
        """Make the next window a first one."""
        self.first = True
        self._clear(self._windows[0])

    def add_frame(self, open_nm: Single, error_nm: Single, tilt_nm: Single | None = None, *, closed: bool) -> bool:
        """Add one frame: open-loop modes and the real loop's errors (modes,); return whether a block is complete.

        A bank of modes other than tip and tilt also needs `tilt_nm`: tip and tilt (2,) as the sensor saw them. A window
        that is not a first one begins anew when the loop opens or closes.
        """
        if closed is not self._closed and not self.first:
            self._add_up()
            self._clear(self._windows[1])
        self._closed_throughout = self._closed_throughout and closed
        self._closed = closed
        errors_nm = self._errors_nm[self._waiting]
        self._loops, errors_nm[:-1] = self._loops.advanced(open_nm)
        errors_nm[-1] = error_nm
        if tilt_nm is not None:
            self._tilts_nm[self._waiting], self._tilt_known = tilt_nm, True
        self._waiting += 1
        self._frames += 1
        if self._frames < self._block:
            if self._waiting == FRAMES_PER_SUM:
                self._add_up()
            return False
        self._add_up()
        self._excesses.append(self._excess / self._frames)
        self._powers.append(self._power / self._frames)
        self._noises.append(self._changes / max(self._changes_counted, 1))
        self._means.append(self._mean / self._frames)
        self._tilts.append(self._tilt / self._frames)
        self._spreads.append(self._spread / self._frames)
        self._begin_block()
        return True

    @property
    def complete(self) -> bool:
        """Whether the window is complete, so that there is a verdict."""
        return len(self._excesses) == BLOCKS

    def early_gains(self, gain: Single) -> Single:
        """Gains (modes,) to use before the window is complete, from the gains in use.

        A mode with a gain of 0 or the least gain gets a better gain if there is one (see `EARLY_BLOCKS`). A mode whose
        signal proves to be cross-talk gets 0. All others keep their gains.
        """
        if self.first or len(self._excesses) < EARLY_BLOCKS:
            return gain
        current = self._row_of(gain)
        cross_talk_nm, suspected_nm = self._cross_talk_nm(self._tilts[-EARLY_BLOCKS:])
        if (current > 1).all() and not cross_talk_nm.any():
            return gain  # no mode can change: in most cases the rest is not computed
        blocks = self._with_cross_talk_margin(suspected_nm)[:, :-1]
        own = blocks[:, current, np.arange(current.size)]
        difference = blocks - own[:, None]
        mean = np.where(current == 0, difference.mean(axis=0), difference[-EARLY_BLOCKS:].mean(axis=0))
        proven = np.where(current == 0, self._significantly_lower(mean), (difference[-EARLY_BLOCKS:] < 0).all(axis=0))
        proven_mean = np.where(proven, mean, np.inf)
        changed = (current <= 1) & proven.any(axis=0)
        only_cross_talk = (cross_talk_nm != 0) & (own[-EARLY_BLOCKS:] > 0).all(axis=0)
        gain = np.where(changed, self.rows[np.argmin(proven_mean, axis=0), np.arange(current.size)], gain)
        return np.where(only_cross_talk, 0, gain).astype(np.float32)

    def held(self, frames: int) -> None:
        """Advance by frames without measurements: changes across them are not used."""
        self._add_up()
        self._loops, self._before_nm = self._loops.held(frames), None
        self._cross_talk.held()

    def verdict(self, gain: Single, noise_nm2: Array | None) -> Verdict:
        """Result of the window, for gains in use and a frame's noise (modes,); then clear or lengthen the window."""
        means, power = (np.mean(values, axis=0, dtype=float) for values in (self._means, self._powers))
        cross_talk_nm, suspected_nm = self._cross_talk_nm(self._tilts)
        power -= (2 * means - cross_talk_nm) * cross_talk_nm
        current = self._row_of(gain)
        modes = np.arange(gain.size)
        frames = self._block * BLOCKS
        mean, error = _mean(self._without_cross_talk(cross_talk_nm))
        chosen = self._chosen(self._with_cross_talk_margin(suspected_nm), current)
        if noise_nm2 is not None:
            noise_nm2 = np.maximum(noise_nm2, np.mean(self._noises, axis=0))
        if self.first and noise_nm2 is not None:
            scatter = _mean(np.subtract(self._powers, self._noises))[1]  # noise of a faint star has long tails
            certain_power = power - noise_nm2 - GRANT_SIGMAS * np.maximum(noise_nm2 * np.sqrt(2 / frames), scatter)
            injects_little = injected_fraction(self.rows[1]) * noise_nm2 < MAX_INJECTED * certain_power
            chosen = np.where((chosen == 0) & injects_little & (suspected_nm == 0), 1, chosen)
        verdict = Verdict(
            self.rows[chosen, modes],
            power,
            noise_nm2,
            mean[current, modes],
            error[current, modes],
            mean[-1] if self._closed_throughout else None,
            error[-1],
            frames,
        )
        if self.first or (chosen != current).any():
            self.first = False
            self._clear(self._windows[1])
        else:
            self._lengthen()
        return verdict

    def _cross_talk_nm(self, tilts: list[Array]) -> list[Array]:
        """Certain and suspected cross-talk (modes,) of tip and tilt over these blocks, nm; 0 where there is none."""
        mean_nm, error_nm = self._cross_talk.mean_nm(np.mean(tilts, axis=0))
        accepted: list[Array] = [
            np.where(np.abs(mean_nm) > errors * error_nm, mean_nm, 0) for errors in (CERTAIN_SIGMAS, SUSPECTED_SIGMAS)
        ]
        return [self._from_own @ cross_talk_nm for cross_talk_nm in accepted]

    def _without_cross_talk(self, cross_talk_nm: Array) -> Array:
        """Mean squares of the true modes minus those in open loop (blocks, rows and the real loop, modes), nm^2.

        Cross-talk (modes,) is measured but not real: a loop with a gain above 0 puts it on the mirror, and then no
        longer measures it.
        """
        blocks = np.array(self._excesses, float)
        blocks[:, 1:] += (2 * np.array(self._means, float) * cross_talk_nm)[:, None]
        return blocks

    def _with_cross_talk_margin(self, cross_talk_nm: Array) -> Array:
        """As `_without_cross_talk`, with cross-talk (modes,) times `MARGIN` where it is against a gain, else with 0."""
        against = np.mean(self._means, axis=0) * cross_talk_nm > 0
        return self._without_cross_talk(np.where(against, MARGIN * cross_talk_nm, 0))

    def _chosen(self, blocks: Array, current: Integers) -> Integers:
        """Best row (modes,) of each mode; `current` is the row in use."""
        virtual, modes = blocks[:, :-1], np.arange(current.size)
        rows, helps = virtual + self._median_of_modes(virtual), (virtual.mean(axis=0) < 0) & self._distinct
        if self.first:
            from_open = rows.mean(axis=0)
            better = helps & self._significantly_lower(from_open)
            return np.where(better.any(axis=0), np.argmin(np.where(better, from_open, np.inf), axis=0), 0)
        from_current, better = _better(rows - rows[:, current, modes][:, None])
        better = helps & np.where(current == 0, self._significantly_lower(from_current), better)
        better[0] = _better(-virtual)[1][current, modes]
        best = np.argmin(np.where(better, from_current, np.inf), axis=0)
        best = np.where(better.any(axis=0), best, current)
        near = np.clip(best, np.maximum(current - 1, 0), current + 1)
        return np.where((current <= 1) | better[0], best, near)

    def _significantly_lower(self, mean: Array) -> Mask:
        """Whether a mean over the blocks minus that of gain 0 (rows, modes) is lower than white noise explains.

        Commands do not depend on the noise of later frames, so the differences of frames are independent.
        """
        return np.asarray(
            mean < -GRANT_SIGMAS * np.sqrt(np.mean(self._spreads, axis=0)[:-1] / (len(self._spreads) * self._block))
        )

    def _median_of_modes(self, blocks: Array) -> Array:
        """Median over the modes of value / noise, times each mode's noise; 0 below `MIN_MAJORITY_MODES` modes."""
        if blocks.shape[-1] < MIN_MAJORITY_MODES:
            return np.zeros_like(blocks)
        noise_nm2 = np.maximum(np.mean(self._noises, axis=0), 1e-12)
        return np.asarray(np.median(blocks / noise_nm2, axis=-1, keepdims=True) * noise_nm2)

    def _row_of(self, gain: Single) -> Integers:
        """Row (modes,) nearest to each gain."""
        nearest = np.argmin(np.abs(np.log(np.maximum(gain, 1e-9)) - np.log(self.rows[1:])), axis=0) + 1
        return np.where(gain < self.rows[1] / 2, 0, nearest)

    def _add_up(self) -> None:
        """Add the waiting frames to the sums of the block."""
        if not self._waiting:
            return
        errors_nm = self._errors_nm[: self._waiting]
        open_nm = errors_nm[:, 0]
        if self._tilt_known:
            self._tilt += self._cross_talk.add_frames(self._tilts_nm[: self._waiting], open_nm @ self._to_own.T)
        self._changes += np.square(_changes(open_nm, self._before_nm)).sum(axis=0) / 2
        self._changes_counted += len(open_nm) - (self._before_nm is None)
        self._before_nm = open_nm[-1:].copy()
        squares = np.square(errors_nm)
        power = squares[:, 0].copy()
        squares -= power[:, None]
        self._power += power.sum(axis=0)
        self._mean += open_nm.sum(axis=0)
        self._excess += squares.sum(axis=0)
        self._spread += np.square(squares).sum(axis=0)
        self._waiting = 0

    def _clear(self, window: int) -> None:
        self._block = max(window // BLOCKS, 1)
        self._longest = self._block * MAX_GROWTH
        self._lists = tuple(list[Array]() for _ in range(6))
        self._excesses, self._powers, self._noises, self._means, self._tilts, self._spreads = self._lists
        self._closed_throughout = True
        self._begin_block()

    def _begin_block(self) -> None:
        self._frames = self._changes_counted = self._waiting = 0
        self._excess, self._spread = np.zeros((2, *self._errors_nm.shape[1:]))
        self._power, self._changes, self._mean = np.zeros((3, self._at_rest.kept.size))
        self._tilt = np.zeros(_REGRESSORS)

    def _lengthen(self) -> None:
        """Continue with blocks of twice the length; the longest window drops its older half."""
        if 2 * self._block > self._longest:
            for values in self._lists:
                del values[: BLOCKS // 2]
            return
        self._block *= 2
        for values in self._lists:
            values[:] = list(np.array(values).reshape(BLOCKS // 2, 2, *values[0].shape).mean(axis=1))


class TiltCrossTalk:
    """Cross-talk of the squares of tip and tilt into other modes, beyond the sensor's linear range.

    Changes from frame to frame are fitted, so that a common drift does not count; tip and tilt themselves are also
    regressors, since the noise of a frame is common to all modes. The coefficients belong to the sensor, and their
    estimate improves with time.
    """

    def __init__(self, modes: int) -> None:
        """Start without frames; `modes` is the number of other modes."""
        self._products = np.zeros((_REGRESSORS, _REGRESSORS + modes))
        self._powers = np.zeros(modes)
        self._changes = 0
        self._before: Array | None = None

    def add_frames(self, tilt_nm: Single, open_nm: Array | Single) -> Array:
        """Add consecutive frames: tip and tilt (frames, 2) as the sensor saw them, the others (frames, modes), nm.

        Returns:
            (regressors,) sums over the frames; `mean_nm` needs their means.
        """
        rows = np.empty((len(open_nm), _REGRESSORS + open_nm.shape[1]))
        rows[:, :2], rows[:, _REGRESSORS:] = tilt_nm, open_nm
        rows[:, 2:_REGRESSORS] = rows[:, [0, 0, 1]] * rows[:, [0, 1, 1]]
        changes = _changes(rows, self._before)
        self._products += changes[:, :_REGRESSORS].T @ changes
        self._powers += np.square(changes[:, _REGRESSORS:]).sum(axis=0)
        self._changes += len(changes) - (self._before is None)
        self._before = rows[-1:]
        return np.asarray(rows[:, :_REGRESSORS].sum(axis=0))

    def held(self) -> None:
        """Skip frames without measurements: changes across them are not used."""
        self._before = None

    def mean_nm(self, regressors: Array) -> tuple[Array, Array]:
        """Mean cross-talk and its standard error (modes,), nm, at these means of the regressors; 0 if unknown."""
        normal, right = self._products[:, :_REGRESSORS], self._products[:, _REGRESSORS:]
        if self._changes < 4 * _REGRESSORS or not np.all(np.diag(normal) > 0):
            return np.zeros(right.shape[1]), np.zeros(right.shape[1])
        scale = np.sqrt(np.diag(normal))
        inverse = np.linalg.pinv(normal / np.outer(scale, scale), rcond=1e-9) / np.outer(scale, scale)
        slopes = inverse @ right
        unexplained = np.maximum(self._powers - np.sum(slopes * right, axis=0), 0) / (self._changes - _REGRESSORS)
        squares = np.where(np.arange(_REGRESSORS) < 2, 0, regressors)
        return squares @ slopes, np.sqrt((squares @ inverse @ squares) * unexplained)


def _changes(rows: Array | Single, before: Array | Single | None) -> Array:
    """Changes (rows, columns) of each row from the one before it: of the first from `before`, 0 if that is None."""
    return np.asarray(rows - np.concatenate([rows[:1] if before is None else before, rows[:-1]]))


def _mean(blocks: Array) -> tuple[Array, Array]:
    """Mean over the blocks (the first axis), and its standard error."""
    return blocks.mean(axis=0), blocks.std(axis=0, ddof=1) / np.sqrt(len(blocks))


def _better(blocks: Array) -> tuple[Array, Mask]:
    """Mean over the blocks, and whether it is below 0 by `CONFIDENCE` or in `WINNING_BLOCKS` blocks."""
    mean, error = _mean(blocks)
    return mean, (mean < -CONFIDENCE * error) | ((mean < 0) & (np.sum(blocks < 0, axis=0) >= WINNING_BLOCKS))


def uncorrected_prior_nm2(verdict: Verdict, uncorrected: Mask, noise_nm2: Array) -> Single:
    """Mean square (modes,) of the uncorrected modes (modes,), nm^2, as `Weighting.prior_nm2`: 0 for the others.

    The mean square is the measured power less the noise, plus two standard errors of that noise.
    """
    if verdict.noise_nm2 is not None:
        noise_nm2 = np.maximum(noise_nm2, verdict.noise_nm2)
    uncertain = CONFIDENCE * noise_nm2 * np.sqrt(2 / verdict.frames)
    prior = np.maximum(verdict.power_nm2 - noise_nm2, 0) + uncertain
    return np.where(uncorrected, prior, 0).astype(np.float32)
