"""Gains chosen by a bank of virtual integrators, and R for the corrected modes."""

import numpy as np
import pytest

from lowfc.arrays import Array, single
from lowfc.control.calibration.calibration import Calibration
from lowfc.control.calibration.map_reconstructor import map_rows, noise_covariance_nm2
from lowfc.control.calibration.regularised import pixel_variance, reconstruct
from lowfc.control.laws.automatic_gain import CERTAIN_SIGMAS, GainBank, TiltCrossTalk, Verdict, uncorrected_prior_nm2
from lowfc.control.laws.stability import delay_weights, highest_gain
from lowfc.control.loop.camera import CameraSettings

MODES = 30
ONES = np.ones(MODES, np.float32)
ZEROS = 0 * ONES


def bank(
    delay_frames: float = 1.0, windows: tuple[int, int] = (1000, 500), modes: int = MODES, leak: float = 0.0
) -> GainBank:
    weights = tuple(
        (lag, weight) for lag, weight in enumerate(delay_weights(delay_frames).astype(np.float32)) if weight
    )
    return GainBank(leak * ONES[:modes], 1e6 * ONES[:modes], weights, delay_frames, windows)


def verdicts(
    bank_: GainBank,
    open_nm: Array,
    gain: Array,
    noise_nm2: float | None,
    tilt_nm: Array | None = None,
    *,
    closed: bool = False,
) -> list[Verdict]:
    """Verdicts of a bank whose loop applies the gains of each verdict."""
    all_verdicts = []
    for index, modes_nm in enumerate(open_nm.astype(np.float32)):
        tilt_of_frame = None if tilt_nm is None else single(tilt_nm[index])
        if bank_.add_frame(modes_nm, modes_nm, tilt_of_frame, closed=closed) and bank_.complete:
            noise = None if noise_nm2 is None else noise_nm2 * np.ones(modes_nm.size)
            all_verdicts.append(bank_.verdict(gain, noise))
            gain = all_verdicts[-1].gain
    return all_verdicts


def drift(frames: int, step_nm: float, noise_nm: float, seed: int) -> Array:
    """Random walks of all modes, with white noise (frames, modes), nm."""
    rng = np.random.default_rng(seed)
    return np.cumsum(rng.normal(0, step_nm, (frames, MODES)), axis=0) + rng.normal(0, noise_nm, (frames, MODES))


def test_white_noise_gets_no_gain() -> None:
    """The noise of 40 first windows has long tails, as from few photons, and often exceeds two standard errors."""
    rng, nonzero_gains = np.random.default_rng(1), 0
    for _ in range(40):
        noise = rng.normal(0, 10, (300, MODES)) * (1 + 4 * (rng.random((300, 1)) < 0.02))
        nonzero_gains += np.count_nonzero(verdicts(bank(windows=(300, 1000)), noise, ZEROS, 100.0)[0].gain)
    assert nonzero_gains <= 1


@pytest.mark.parametrize("leak", [0.0, 0.3])
def test_the_highest_gain_of_a_bank_is_the_highest_within_the_margins_at_its_leak(leak: float) -> None:
    assert bank(leak=leak).rows[-1] == pytest.approx(highest_gain(1.0, leak))


def test_the_leak_of_one_mode_limits_its_own_gain_only() -> None:
    """All modes have the same large drift, so that each gets the highest gain within the margins at its leak."""
    leak = np.where(np.arange(MODES) == 4, single(0.9), single(0))
    bank_ = GainBank(leak, 1e6 * ONES, ((0, single(1)),), 1.0, (500, 500))
    gain = verdicts(bank_, drift(4000, 50.0, 1.0, 7), ZEROS, 1.0)[-1].gain
    limits = [highest_gain(1.0, mode_leak) for mode_leak in leak.tolist()]
    assert limits[4] < limits[0]
    assert gain == pytest.approx(limits)


@pytest.mark.parametrize(("step_nm", "delay_frames"), [(0.1, 1.0), (1.0, 1.0), (1.0, 2.0), (20.0, 1.0)])
def test_a_drift_gets_nearly_the_gain_with_the_least_residual(step_nm: float, delay_frames: float) -> None:
    """For a delay of one frame, the residual rms is within 12 % of the least.

    For a gain g, its square is s^2 / (g (2 - g)) from drift steps of s nm rms, plus n^2 g / (2 - g) from n nm of noise.
    """
    bank_ = bank(delay_frames, (1000, 2500))
    all_verdicts = verdicts(bank_, drift(8500, step_nm, 10.0, 2), ZEROS, 100.0)
    assert len(all_verdicts) >= 3
    gains = np.linspace(0.001, highest_gain(delay_frames), 2000)
    if delay_frames == 1.0:
        residual_nm2 = (step_nm**2 / gains + 100.0 * gains) / (2 - gains)
        chosen = np.interp(all_verdicts[-1].gain, gains, residual_nm2)
        assert np.sqrt(chosen.mean() / residual_nm2.min()) < 1.12
    else:
        assert (all_verdicts[-1].gain > 0).all()
        assert (all_verdicts[-1].gain <= highest_gain(2.0) * 1.001).all()


def test_modes_with_the_same_disturbance_get_similar_gains() -> None:
    """Gains of 30 modes with the same drift differ less than if they were judged in pairs, and none stays at 0."""
    wander = drift(1000, 0.2, 10.0, 11)
    together = verdicts(bank(), wander, ZEROS, 100.0)[0].gain
    in_pairs = np.concatenate(
        [
            verdicts(bank(modes=2), wander[:, [mode, mode + 1]], np.zeros(2, np.float32), 100.0)[0].gain
            for mode in range(0, MODES, 2)
        ]
    )
    assert not in_pairs.all()
    assert together.all()
    assert np.ptp(np.log2(together)) < np.ptp(np.log2(in_pairs[in_pairs > 0]))


def test_a_gain_changes_by_at_most_a_factor_of_two_unless_open_loop_is_better() -> None:
    bank_ = bank()
    verdicts(bank_, drift(1000, 1.0, 10.0, 3), ZEROS, 100.0)
    low, high = bank_.rows[3], bank_.rows[-1]
    up = verdicts(bank_, drift(500, 5.0, 10.0, 4), low, 100.0)[0]
    assert set(np.unique(up.gain)) <= set(bank_.rows[3:5].ravel())
    assert (up.gain > low).mean() > 0.8
    down = verdicts(bank_, drift(500, 0.0, 10.0, 5), high, 100.0)[0]
    assert (down.change_nm2 > 2 * down.change_error_nm2).mean() > 0.9  # the current gain is worse than the open loop
    assert (down.gain < high / 8).mean() > 0.9


def test_a_static_aberration_and_a_jump_across_lost_frames_are_not_noise() -> None:
    bank_ = bank(windows=(500, 500))
    verdicts(bank_, 100 + drift(220, 0.0, 1.0, 13), ZEROS, 0.0)
    bank_.held(3)
    [verdict] = verdicts(bank_, 300 + drift(280, 0.0, 1.0, 14), ZEROS, 0.0)
    np.testing.assert_allclose(verdict.noise_nm2, 1, rtol=0.3)


def test_the_window_grows_after_a_verdict_that_changes_no_gain() -> None:
    noise = np.random.default_rng(6).normal(0, 1, (2000, MODES))
    lengths = [verdict.frames for verdict in verdicts(bank(windows=(100, 100)), noise, ZEROS, None, closed=True)]
    assert lengths[0] == 100
    assert max(lengths) >= 200


def test_a_mode_that_begins_to_drift_gets_a_gain_before_the_window_ends() -> None:
    bank_, early = bank(windows=(500, 5000)), ZEROS
    verdicts(bank_, drift(500, 0.0, 1.0, 8), ZEROS, 1.0)
    for count, modes_nm in enumerate(drift(3000, 0.5, 1.0, 9).astype(np.float32)):
        if bank_.add_frame(modes_nm, modes_nm, closed=False):
            assert not bank_.complete
            early = bank_.early_gains(early)
            assert count >= 2499 or not early.any()  # before five blocks of 500 frames are complete
    assert (early > 0.01).mean() > 0.9


def vibrating_tilt(frames: int, seed: int) -> tuple[Array, Array]:
    """Tilts (frames, 2) of 20 nm rms, and modes (frames, 30) with 1 nm of noise; mode 4 has cross-talk from tilt^2."""
    rng = np.random.default_rng(seed)
    time = np.arange(frames)[:, None]
    tilt_nm = 28 * np.sin(time * np.array([0.7, 0.41]) + np.array([0.2, 1.1])) + rng.normal(0, 1, (frames, 2))
    modes_nm = rng.normal(0, 1, (frames, MODES))
    modes_nm[:, 4] += 0.01 * tilt_nm[:, 0] ** 2 - 0.003 * tilt_nm[:, 1] ** 2
    return tilt_nm.astype(np.float32), modes_nm.astype(np.float32)


@pytest.mark.parametrize("closed", [False, True])
def test_a_mode_with_only_tilt_cross_talk_gets_no_gain(closed: bool) -> None:
    """With a gain, the loop would put the mean of the cross-talk, 2.7 nm, on the mirror."""
    tilt_nm, modes_nm = vibrating_tilt(1000, 12)
    assert verdicts(bank(), modes_nm, ZEROS, 1.0, tilt_nm, closed=closed)[0].gain[4] == 0
    assert verdicts(bank(), modes_nm, ZEROS, 1.0, closed=closed)[0].gain[4] > 0


def test_the_reported_change_excludes_the_cross_talk_margin() -> None:
    """Mode 4 has an aberration of 20 nm and 2.7 nm of cross-talk: a loop would leave a true residual of 2.7 nm."""
    tilt_nm, modes_nm = vibrating_tilt(1000, 19)
    modes_nm[:, 4] += 20
    [verdict] = verdicts(bank(), modes_nm, np.full(MODES, 0.1, np.float32), 1.0, tilt_nm)
    assert verdict.change_nm2[4] == pytest.approx(2.7**2 - 20**2, rel=0.05)


def test_tilt_cross_talk_before_a_window_does_not_affect_its_verdict() -> None:
    """The squares of tilt are averaged over the blocks of the window, like the modes."""
    tilt_nm, modes_nm = vibrating_tilt(200, 20)
    rng = np.random.default_rng(21)
    bank_ = bank(windows=(100, 10))
    gain = verdicts(bank_, modes_nm, ZEROS, 1.0, tilt_nm)[-1].gain
    last_verdict = verdicts(bank_, rng.normal(0, 1, (2000, MODES)), gain, 1.0, rng.normal(0, 1, (2000, 2)))[-1]
    assert last_verdict.power_nm2[4] == pytest.approx(1, abs=0.3)


def test_a_gain_due_to_tilt_cross_talk_is_removed_before_the_window_ends() -> None:
    tilt_nm, modes_nm = vibrating_tilt(4000, 17)
    bank_ = bank(windows=(100, 5000))
    gain = verdicts(bank_, drift(100, 1.0, 1.0, 18), ZEROS, 1.0)[0].gain
    assert gain.all()
    for tilt_of_frame, modes_of_frame in zip(tilt_nm, modes_nm, strict=True):
        if bank_.add_frame(modes_of_frame, modes_of_frame, tilt_of_frame, closed=True):
            gain = bank_.early_gains(gain)
    assert gain[4] == 0


def test_tilt_cross_talk_does_not_favour_a_gain() -> None:
    """A true aberration of -2.72 nm and 2.7 nm of cross-talk cancel in the measurement: a gain corrects nothing."""
    tilt_nm, modes_nm = vibrating_tilt(1000, 23)
    modes_nm[:, 4] -= 2.72
    assert verdicts(bank(), modes_nm, ZEROS, 1.0, tilt_nm)[0].gain[4] == 0


def test_tilt_cross_talk_follows_a_change_of_the_reconstructor() -> None:
    """Another R adds minus twice mode 4 to mode 7, and with it the cross-talk of tilt, which mode 7 lacked before."""
    tilt_nm, modes_nm = vibrating_tilt(5200, 22)
    mixing = np.eye(MODES)
    mixing[7, 4] = -2
    mixed = (modes_nm @ mixing.T).astype(np.float32)
    gains = []
    for updated in (True, False):
        bank_ = bank(windows=(200, 1000))
        verdicts(bank_, modes_nm[:5000], ZEROS, 1.0, tilt_nm[:5000], closed=True)
        bank_.begin_first_window()
        if updated:
            bank_.use_reconstructor(mixing)
        gains.append(verdicts(bank_, mixed[5000:], ZEROS, 1.0, tilt_nm[5000:], closed=True)[0].gain[7])
    assert gains[0] == 0
    assert gains[1] > 0


def test_a_drift_is_corrected_in_spite_of_tilt_cross_talk() -> None:
    tilt_nm, modes_nm = vibrating_tilt(1000, 13)
    modes_nm += drift(1000, 0.3, 0.0, 14).astype(np.float32)
    assert (verdicts(bank(), modes_nm, ZEROS, 1.0, tilt_nm)[0].gain > 0.01).mean() > 0.9


def test_drifts_and_common_noise_are_not_tilt_cross_talk() -> None:
    rng = np.random.default_rng(15)
    noise = rng.normal(0, 1, (2000, MODES + 2))
    noise[:, 2:] += 0.8 * noise[:, :1]
    modes = drift(2000, 0.3, 0.0, 16)
    tilt_nm = 40 + modes[:, :2] + noise[:, :2]
    cross_talk = TiltCrossTalk(MODES)
    mean_nm, error_nm = cross_talk.mean_nm(cross_talk.add_frames(single(tilt_nm), single(modes + noise[:, 2:])) / 2000)
    assert np.count_nonzero(np.abs(mean_nm) > CERTAIN_SIGMAS * error_nm) <= 1


def _calibration() -> tuple[Calibration, CameraSettings]:
    rng = np.random.default_rng(7)
    pixels, modes = 400, 5
    reference = rng.random(pixels)
    reference /= reference.sum()
    response = rng.normal(0, 1e-4, (pixels, modes))
    response[:, 3] += response[:, 0]  # two similar modes
    response -= reference[:, None] * response.sum(axis=0)
    good = np.ones(pixels)
    R = reconstruct(reference, response, None, good, 1e5, 2.0).matrix
    camera = CameraSettings(0, (20, 20), 0.0, 65535.0, 2.0, 1.0, 2.0)
    arrays = [array.astype(np.float32) for array in (reference, response, R, good, np.zeros(pixels))]
    other_fields = np.zeros((4, modes), np.float32), (20, 20), (2, 2), 5e4, 65535.0, "weighted", 550.0, "", "id"
    return Calibration((2, 3, 4, 5, 6), *arrays, *other_fields), camera


def test_rows_of_corrected_modes_are_the_map_estimate() -> None:
    """Rows of (H'WH + P^-1)^-1 H'W without a prior for corrected modes; the other rows are unchanged."""
    calibration, camera = _calibration()
    prior = np.array([0, 0, 1e-3, 1e-4, 0])
    (rows,) = map_rows(calibration, prior, 5e4, camera, calibration.reconstructor)
    H, I0 = calibration.response.astype(float), calibration.reference.astype(float)
    W = 1 / pixel_variance(I0, 1e5, 2.0)
    inverse = np.diag(np.where(prior > 0, 1 / np.maximum(prior, 1e-12), 0))
    expected = np.linalg.inv(H.T @ (W[:, None] * H) + inverse) @ (H.T * W)
    np.testing.assert_allclose(rows[[0, 1, 4]], expected[[0, 1, 4]], rtol=2e-4, atol=2e-4 * np.abs(expected).max())
    np.testing.assert_array_equal(rows[[2, 3]], calibration.reconstructor[[2, 3]])
    np.testing.assert_allclose((rows @ calibration.response)[np.ix_([0, 1, 4], [0, 1, 4])], np.eye(3), atol=1e-3)
    before = np.diag(noise_covariance_nm2(calibration, 5e4, camera))
    assert (np.einsum("mp,p,mp->m", rows, 1 / W, rows)[[0, 1, 4]] <= 1.001 * before[[0, 1, 4]]).all()
    assert np.einsum("p,p,p", rows[0], 1 / W, rows[0]) < 0.7 * before[0]  # the mode that resembles an uncorrected one


def test_r_is_unchanged_if_all_modes_or_no_modes_are_corrected_or_the_camera_is_unknown() -> None:
    calibration, camera = _calibration()
    for prior, settings in ((np.zeros(5), camera), (np.ones(5), camera), (np.array([1.0, 0, 0, 0, 0]), None)):
        assert map_rows(calibration, prior, 5e4, settings, calibration.reconstructor)[0] is calibration.reconstructor


def test_the_prior_of_uncorrected_modes_is_their_power_less_noise_plus_two_standard_errors_of_the_noise() -> None:
    power, zero_gain = np.array([2.0, 1.0, 5.0]), np.zeros(3)
    prior_nm2 = uncorrected_prior_nm2(
        Verdict(zero_gain, power, np.ones(3), zero_gain, zero_gain, None, zero_gain, 5000),
        np.array([True, True, False]),
        np.ones(3),
    )
    np.testing.assert_allclose(prior_nm2, [1.04, 0.04, 0], rtol=1e-5)
