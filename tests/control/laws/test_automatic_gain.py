"""Gains chosen by a bank of virtual integrators, and R for the modes that are corrected."""

import numpy as np
import pytest

from lowfc.arrays import Array, single
from lowfc.control.calibration.calibration import Calibration
from lowfc.control.calibration.granted import granted_rows, noise_covariance_nm2
from lowfc.control.calibration.regularised import pixel_variance, reconstruct
from lowfc.control.laws.automatic_gain import SURE, GainBank, TiltCrossTalk, Verdict, left_alone_nm2
from lowfc.control.laws.stability import delay_weights, highest_gain
from lowfc.control.loop.camera import CameraSettings

MODES = 30
ONES = np.ones(MODES, np.float32)


def bank(delay_frames: float = 1.0, windows: tuple[int, int] = (1000, 500), modes: int = MODES) -> GainBank:
    weights = tuple(
        (lag, weight) for lag, weight in enumerate(delay_weights(delay_frames).astype(np.float32)) if weight
    )
    return GainBank(ONES[:modes], 1e6 * ONES[:modes], weights, delay_frames, windows)


def verdicts(made: GainBank, open_nm: Array, gain: Array, noise_nm2: float) -> list[Verdict]:
    """Of a loop that is open, whose gains follow the verdicts."""
    found = []
    for one in open_nm.astype(np.float32):
        if made.followed(one, one, closed=False) and made.complete:
            found.append(made.verdict(gain, noise_nm2 * np.ones(one.size)))
            gain = found[-1].gain
    return found


def drift(frames: int, step_nm: float, noise_nm: float, seed: int) -> Array:
    rng = np.random.default_rng(seed)
    return np.cumsum(rng.normal(0, step_nm, (frames, MODES)), axis=0) + rng.normal(0, noise_nm, (frames, MODES))


def test_noise_alone_is_left_alone() -> None:
    """Of 1200 modes in a first window, with long tails as of few photons; two standard errors let several through."""
    rng, none = np.random.default_rng(1), np.zeros(MODES, np.float32)
    granted = 0
    for _ in range(40):
        noise = rng.normal(0, 10, (300, MODES)) * (1 + 4 * (rng.random((300, 1)) < 0.02))
        granted += np.count_nonzero(verdicts(bank(windows=(300, 1000)), noise, none, 100.0)[0].gain)
    assert granted <= 1


@pytest.mark.parametrize(("step_nm", "delay_frames"), [(0.1, 1.0), (1.0, 1.0), (1.0, 2.0), (20.0, 1.0)])
def test_a_drift_gets_the_gain_that_leaves_least(step_nm: float, delay_frames: float) -> None:
    """Within 12 % rms of the best gain, in closed form for d = 1: drift s^2 / (g (2 - g)) and noise n^2 g / (2 - g)."""
    made = bank(delay_frames, (1000, 2500))
    found = verdicts(made, drift(8500, step_nm, 10.0, 2), np.zeros(MODES, np.float32), 100.0)
    assert len(found) >= 3
    gains = np.linspace(0.001, highest_gain(delay_frames), 2000)
    if delay_frames == 1.0:
        left = (step_nm**2 / gains + 100.0 * gains) / (2 - gains)
        mine = np.interp(found[-1].gain, gains, left)
        assert np.sqrt(mine.mean() / left.min()) < 1.12
    else:
        assert (found[-1].gain > 0).all()
        assert (found[-1].gain <= highest_gain(2.0) * 1.001).all()


def test_a_mode_that_happens_to_stay_calm_is_taken_to_be_as_most_are() -> None:
    """Gains of 30 modes that wander alike differ less than each by itself would have them, and none stays at 0."""
    wander = drift(1000, 0.2, 10.0, 11)
    together = verdicts(bank(), wander, np.zeros(MODES, np.float32), 100.0)[0].gain
    alone = np.concatenate(
        [
            verdicts(bank(modes=2), wander[:, [one, one + 1]], np.zeros(2, np.float32), 100.0)[0].gain
            for one in range(0, MODES, 2)
        ]
    )
    assert not alone.all()
    assert together.all()
    assert np.ptp(np.log2(together)) < np.ptp(np.log2(alone[alone > 0]))


def test_a_gain_moves_by_a_factor_of_two_and_falls_at_once_where_open_is_better() -> None:
    made = bank()
    verdicts(made, drift(1000, 1.0, 10.0, 3), np.zeros(MODES, np.float32), 100.0)
    low, high = np.full(MODES, made.rows[3]), np.full(MODES, made.rows[-1])
    up = verdicts(made, drift(500, 5.0, 10.0, 4), low, 100.0)[0]
    assert set(np.unique(up.gain)) <= {made.rows[3], made.rows[4]}
    assert (up.gain > low).mean() > 0.8
    down = verdicts(made, drift(500, 0.0, 10.0, 5), high, 100.0)[0]
    assert (down.change_nm2 > 2 * down.change_error_nm2).mean() > 0.9  # the gain of now adds to the open loop
    assert (down.gain < high / 8).mean() > 0.9


def test_a_window_that_decides_nothing_grows() -> None:
    made, rng = bank(windows=(100, 100)), np.random.default_rng(6)
    gain = np.zeros(MODES, np.float32)
    lengths = []
    for _ in range(2000):
        one = rng.normal(0, 1, MODES).astype(np.float32)
        if made.followed(one, one, closed=True) and made.complete:
            lengths.append(made.verdict(gain, None).frames)  # its wishes are not followed
    assert lengths[0] == 100
    assert max(lengths) >= 200


def test_a_mode_that_begins_to_wander_need_not_wait_for_the_end_of_the_window() -> None:
    made, none = bank(windows=(500, 5000)), np.zeros(MODES, np.float32)
    verdicts(made, drift(500, 0.0, 1.0, 8), none, 1.0)
    early = none
    for count, one in enumerate(drift(3000, 0.5, 1.0, 9).astype(np.float32)):
        if made.followed(one, one, closed=False):
            assert not made.complete
            early = made.early(early)
            assert count >= 2499 or not early.any()
    assert (early > 0.01).mean() > 0.9


def _vibrating(frames: int, seed: int) -> tuple[Array, Array]:
    """Tip and tilt of 20 nm rms, (frames, 2), and 30 modes of 1 nm noise of which one shows their squares."""
    rng = np.random.default_rng(seed)
    time = np.arange(frames)[:, None]
    tilt_nm = 28 * np.sin(time * np.array([0.7, 0.41]) + np.array([0.2, 1.1])) + rng.normal(0, 1, (frames, 2))
    shown = rng.normal(0, 1, (frames, MODES))
    shown[:, 4] += 0.01 * tilt_nm[:, 0] ** 2 - 0.003 * tilt_nm[:, 1] ** 2
    return tilt_nm.astype(np.float32), shown.astype(np.float32)


@pytest.mark.parametrize("closed", [False, True])
def test_a_mode_that_shows_the_squares_of_tilt_is_left_alone(closed: bool) -> None:
    """A loop would put their mean, 2.7 nm, on the mirror for a mode that is not there at all."""
    tilt_nm, shown = _vibrating(1000, 12)
    gains = []
    for seen in (tilt_nm, None):
        made, gain = bank(), np.zeros(MODES, np.float32)
        for index, one in enumerate(shown):
            if made.followed(one, one, None if seen is None else seen[index], closed=closed) and made.complete:
                gains.append(made.verdict(gain, ONES.astype(float)).gain[4])
    assert gains[0] == 0
    assert gains[1] > 0


def test_the_harm_of_a_loop_is_told_without_the_margin_of_the_choice() -> None:
    """Of 20 nm that are there and 2.7 nm of cross-talk, a loop leaves the latter."""
    tilt_nm, shown = _vibrating(1000, 19)
    shown[:, 4] += 20
    made, gain = bank(), np.full(MODES, 0.1, np.float32)
    for one, seen in zip(shown, tilt_nm, strict=True):
        made.followed(one, one, seen, closed=False)
    found = made.verdict(gain, ONES.astype(float))
    assert found.change_nm2[4] == pytest.approx(2.7**2 - 20**2, rel=0.05)


def test_the_cross_talk_of_tilt_that_is_gone_is_forgotten() -> None:
    """The longest window is of its ten blocks, and so are the squares."""
    tilt_nm, shown = _vibrating(200, 20)
    rng = np.random.default_rng(21)
    made, gain = bank(windows=(100, 10)), np.zeros(MODES, np.float32)
    for one, seen in zip(shown, tilt_nm, strict=True):
        if made.followed(one, one, seen, closed=False) and made.complete:
            gain = made.verdict(gain, ONES.astype(float)).gain
    for one, seen in zip(rng.normal(0, 1, (2000, MODES)), rng.normal(0, 1, (2000, 2)), strict=True):
        made.followed(single(one), single(one), single(seen), closed=False)
        if made.complete:
            found = made.verdict(gain, ONES.astype(float))
    assert found.power_nm2[4] == pytest.approx(1, abs=0.3)


def test_a_gain_for_the_cross_talk_of_tilt_is_taken_back_before_the_window_ends() -> None:
    tilt_nm, shown = _vibrating(4000, 17)
    made = bank(windows=(100, 5000))
    gain = verdicts(made, drift(100, 1.0, 1.0, 18), np.zeros(MODES, np.float32), 1.0)[0].gain
    assert gain.all()
    for seen, one in zip(tilt_nm, shown, strict=True):
        if made.followed(one, one, seen, closed=True):
            gain = made.early(gain)
    assert gain[4] == 0


def test_cross_talk_of_tilt_does_not_speak_for_a_gain() -> None:
    """What is there hides behind it, 2.72 nm behind 2.7 nm: no loop sees it."""
    tilt_nm, shown = _vibrating(1000, 23)
    shown[:, 4] -= 2.72
    made = bank()
    for one, seen in zip(shown, tilt_nm, strict=True):
        made.followed(one, one, seen, closed=False)
    assert made.verdict(np.zeros(MODES, np.float32), ONES.astype(float)).gain[4] == 0


def test_cross_talk_of_tilt_that_another_r_mixes_into_a_mode_is_known_at_once() -> None:
    """R for fewer modes takes twice of the mode that shows the squares from another one, which was free of them."""
    tilt_nm, shown = _vibrating(5200, 22)
    of_own = np.eye(MODES)
    of_own[7, 4] = -2
    mixed = (shown @ of_own.T).astype(np.float32)
    gains = []
    for told in (True, False):
        made, gain = bank(windows=(200, 1000)), np.zeros(MODES, np.float32)
        for one, seen in zip(shown[:5000], tilt_nm[:5000], strict=True):
            if made.followed(one, one, seen, closed=True) and made.complete:
                made.verdict(gain, ONES.astype(float))
        made.begin_again()
        if told:
            made.remade(of_own)
        for one, seen in zip(mixed[5000:], tilt_nm[5000:], strict=True):
            made.followed(one, one, seen, closed=True)
        gains.append(made.verdict(gain, ONES.astype(float)).gain[7])
    assert gains[0] == 0
    assert gains[1] > 0


def test_what_is_there_is_corrected_beside_the_cross_talk_of_tilt() -> None:
    tilt_nm, shown = _vibrating(1000, 13)
    shown += drift(1000, 0.3, 0.0, 14).astype(np.float32)
    made = bank()
    for one, seen in zip(shown, tilt_nm, strict=True):
        made.followed(one, one, seen, closed=False)
    assert (made.verdict(np.zeros(MODES, np.float32), ONES.astype(float)).gain > 0.01).mean() > 0.9


def test_drifts_and_common_noise_of_tilt_and_other_modes_are_no_cross_talk() -> None:
    rng = np.random.default_rng(15)
    noise = rng.normal(0, 1, (2000, MODES + 2))
    noise[:, 2:] += 0.8 * noise[:, :1]
    modes = drift(2000, 0.3, 0.0, 16)
    tilt_nm = 40 + modes[:, :2] + noise[:, :2]
    made = TiltCrossTalk(MODES)
    rows = [made.followed(single(one), single(other)) for one, other in zip(tilt_nm, modes + noise[:, 2:], strict=True)]
    found, error = made.mean_nm(np.mean(rows, axis=0))
    assert np.count_nonzero(np.abs(found) > SURE * error) <= 1


def _calibration(measured: bool) -> tuple[Calibration, CameraSettings]:
    rng = np.random.default_rng(7)
    pixels, modes = 400, 5
    reference = rng.random(pixels)
    reference /= reference.sum()
    response = rng.normal(0, 1e-4, (pixels, modes))
    response[:, 3] += response[:, 0]  # two that look alike
    response -= reference[:, None] * response.sum(axis=0)
    good = np.ones(pixels)
    R = reconstruct(reference, response, None, good, 1e5, 2.0).matrix
    camera = CameraSettings(0, (20, 20), 0.0, 65535.0, 2.0, 1.0, 2.0)
    single = [one.astype(np.float32) for one in (reference, response, R, good, np.zeros(pixels))]
    shapes = np.zeros((4, modes), np.float32)
    name = "poke" if measured else "weighted"
    rest = (shapes, (20, 20), (2, 2), 5e4, 65535.0, name, 550.0, "", "id")
    return Calibration((2, 3, 4, 5, 6), *single, *rest), camera


def test_rows_of_the_modes_that_are_corrected_are_the_estimate_that_knows_the_others_to_be_small() -> None:
    """R_g of (H'WH + P^-1)^-1 H'W with no prior for those that are corrected; the other rows stay."""
    calibration, camera = _calibration(measured=False)
    prior = np.array([0, 0, 1e-3, 1e-4, 0])
    rows = granted_rows(calibration, prior, 5e4, camera)
    H, I0 = calibration.response.astype(float), calibration.reference.astype(float)
    W = 1 / pixel_variance(I0, 1e5, 2.0)
    inverse = np.diag(np.where(prior > 0, 1 / np.maximum(prior, 1e-12), 0))
    expected = np.linalg.inv(H.T @ (W[:, None] * H) + inverse) @ (H.T * W)
    np.testing.assert_allclose(rows[[0, 1, 4]], expected[[0, 1, 4]], rtol=2e-4, atol=2e-4 * np.abs(expected).max())
    np.testing.assert_array_equal(rows[[2, 3]], calibration.reconstructor[[2, 3]])
    np.testing.assert_allclose((rows @ calibration.response)[np.ix_([0, 1, 4], [0, 1, 4])], np.eye(3), atol=1e-3)
    before = np.diag(noise_covariance_nm2(calibration, 5e4, camera))
    assert (np.einsum("mp,p,mp->m", rows, 1 / W, rows)[[0, 1, 4]] <= 1.001 * before[[0, 1, 4]]).all()
    assert np.einsum("p,p,p", rows[0], 1 / W, rows[0]) < 0.7 * before[0]  # of the one that another looks like


def test_without_modes_to_leave_or_a_known_camera_the_reconstructor_stays() -> None:
    calibration, camera = _calibration(measured=True)
    for prior, seen_by in ((np.zeros(5), camera), (np.ones(5), camera), (np.array([1.0, 0, 0, 0, 0]), None)):
        assert granted_rows(calibration, prior, 5e4, seen_by) is calibration.reconstructor


def test_what_is_known_of_modes_that_are_left_is_what_is_measured_less_the_noise() -> None:
    power, none = np.array([2.0, 1.0, 5.0]), np.zeros(3)
    found = left_alone_nm2(
        Verdict(none, power, np.ones(3), none, none, None, none, 5000), np.array([True, True, False]), np.ones(3)
    )
    np.testing.assert_allclose(found, [1.04, 0.04, 0], rtol=1e-5)
