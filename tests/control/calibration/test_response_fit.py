"""H, I0, delay, dark and R measured on synthetic frames, and the probe sequences for these measurements."""

from dataclasses import replace

import numpy as np
import pytest

from lowfc.arrays import single
from lowfc.control.calibration.adapted import with_dark, with_reference
from lowfc.control.calibration.calibration import normalise_flux, reconstructor
from lowfc.control.calibration.dark_frames import measure_dark, starlight_dn
from lowfc.control.calibration.delay_fit import measure_delay
from lowfc.control.calibration.poke_plan import (
    SIGNS,
    cycle,
    dither,
    frames_for_snr,
    hadamard_patterns,
    poke_patterns,
    seen_rows,
    usable_exposures,
)
from lowfc.control.calibration.regularised import advice, reconstruct
from lowfc.control.calibration.response_fit import (
    Initial,
    Measured,
    Sums,
    best_initial,
    check,
    cross_talk,
    cycle_response,
    fit_response,
    normalised,
    row_error,
    without_outliers,
)
from lowfc.control.laws.stability import delay_weights
from tests.support.toy import calibration

COLUMNS = 5


@pytest.mark.parametrize("patterns", [poke_patterns(COLUMNS, 8.0), hadamard_patterns(COLUMNS, 3.0)])
@pytest.mark.parametrize("backwards", [False, True])
def test_a_cycle_separates_the_modes_and_cancels_quadratic_drift(patterns: np.ndarray, backwards: bool) -> None:
    plan = cycle(patterns, hold=3, settle=2, rest=4, backwards=backwards)
    used = plan.table[plan.used]
    normal = used.T @ used
    assert np.array_equal(normal, np.diag(np.diag(normal)))
    assert np.all(np.diag(normal) == plan.per_column * np.abs(patterns).max() ** 2)
    time = np.flatnonzero(plan.used) / len(plan)
    for power in (0, 1, 2):
        assert np.abs(used.T @ time**power).max() < 1e-9
    assert np.abs(used.T @ time**3).max() > 1e-6  # a cubic drift does not cancel


def test_a_cycle_has_rest_frames_and_settling_after_each_change() -> None:
    plan = cycle(poke_patterns(2, 8.0), hold=3, settle=2, rest=4)
    assert len(plan) == 4 + 2 + 2 * SIGNS.size * 5
    assert np.count_nonzero(plan.used[:6]) == 4
    assert not plan.table[:6].any()
    changed = np.flatnonzero(np.diff(plan.table, axis=0).any(axis=1)) + 1
    for frames_after in (0, 1):
        assert not plan.used[changed + frames_after].any()
    with pytest.raises(ValueError, match="hold must be 1 frame or more"):
        cycle(poke_patterns(2, 8.0), hold=0, settle=2, rest=4)


def test_hadamard_patterns_poke_every_mode() -> None:
    assert np.all(np.abs(hadamard_patterns(14, 3.0)) == 3.0)
    assert hadamard_patterns(14, 3.0).shape == (16, 14)
    assert hadamard_patterns(16, 3.0).shape == (16, 16)


def test_a_dither_depends_on_its_seed() -> None:
    first, second = dither(3, 2.0, 100, 4, 1), dither(3, 2.0, 100, 4, 2)
    assert np.array_equal(first.table, dither(3, 2.0, 100, 4, 1).table)
    assert not np.array_equal(first.table, second.table)
    assert np.all(np.abs(first.table) == 2.0)
    assert first.per_column == 100


def test_the_number_of_frames_grows_with_the_square_of_the_signal_to_noise_ratio() -> None:
    assert frames_for_snr(100, 2.0, 4.0) == 2500
    assert frames_for_snr(200, 2.0, 4.0) == 10_000


def test_an_exposure_sees_the_rows_played_one_delay_earlier() -> None:
    table = np.arange(1.0, 6.0)[:, None]
    commanded = np.ones(8, np.bool_)
    one_frame = seen_rows(table, np.array([0.0, 1.0]), np.arange(8), commanded)
    assert one_frame[:, 0].tolist() == [0, 1, 2, 3, 4, 5, 0, 0]
    one_and_a_half = seen_rows(table, np.array([0.0, 0.5, 0.5]), np.arange(8), commanded)
    assert one_and_a_half[:, 0].tolist() == [0, 0.5, 1.5, 2.5, 3.5, 4.5, 2.5, 0]


def test_without_a_command_the_mirror_keeps_the_previous_row() -> None:
    table = np.arange(1.0, 6.0)[:, None]
    weights = np.array([0.0, 1.0])
    commanded = np.array([True, True, False, True, True, True, True])
    assert seen_rows(table, weights, np.arange(7), commanded)[:, 0].tolist() == [0, 1, 2, 2, 4, 5, 0]
    without_frame_2 = np.array([0, 1, 3, 4, 5, 6])
    assert seen_rows(table, weights, without_frame_2, np.ones(6, np.bool_))[:, 0].tolist() == [0, 1, 2, 4, 5, 0]


def test_only_exposures_affected_by_a_missing_frame_are_unusable() -> None:
    plan = cycle(poke_patterns(2, 8.0), hold=3, settle=0, rest=0)
    sequence = np.arange(len(plan) + 3)
    with_all = usable_exposures(plan, sequence, np.ones(sequence.size, np.bool_), 1)
    assert np.flatnonzero(with_all).tolist() == list(range(1, len(plan) + 1))
    with_gap = np.delete(sequence, 20)
    usable_with_gap = usable_exposures(plan, with_gap, np.ones(with_gap.size, np.bool_), 1)
    assert sorted(set(np.flatnonzero(with_all)) - set(with_gap[usable_with_gap])) == [20, 21, 22]


PIXELS, MODES = 300, 4
FLUX_E = 1e5


def truth(seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Normalised I0 and H of a random sensor."""
    rng = np.random.default_rng(seed)
    light = rng.gamma(1.0, 1.0, PIXELS)
    slopes = light[:, None] * rng.standard_normal((PIXELS, MODES)) * 0.01
    return normalise_flux(light, slopes, np.ones(PIXELS))


I0, H = truth()
GOOD = np.ones(PIXELS)


def exposed(modes_nm: np.ndarray, seed: int) -> np.ndarray:
    """Frames (frames, pixels) of these modes (frames, modes), in electrons, with photon noise."""
    rng = np.random.default_rng(seed)
    return rng.poisson(np.maximum(I0 + modes_nm @ H.T, 0) * FLUX_E).astype(np.float64)


def fractions_of(frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return normalised(frames, np.zeros(PIXELS), GOOD)


def initial_of_sensor(seed: int = 1) -> Initial:
    return Initial(reconstructor(*truth(seed), GOOD, FLUX_E, 0.0), "weighted")


def measured(patterns: np.ndarray, cycles: int) -> Measured:
    """H and its error from cycles of simulated frames."""
    sums = Sums.none(initial_of_sensor())
    for number in range(cycles):
        plan = cycle(patterns, hold=4, settle=1, rest=16, backwards=number % 2 == 1)
        fractions, flux = fractions_of(exposed(plan.table, 100 + number))
        sums = sums.plus(cycle_response(fractions, flux, plan.table, plan.table, plan.used))
    return fit_response(sums)


@pytest.mark.parametrize("patterns", [poke_patterns(MODES, 8.0), hadamard_patterns(MODES, 3.0)])
def test_r_is_correct_within_its_standard_error(patterns: np.ndarray) -> None:
    fit = measured(patterns, 20)
    assert fit.flux_dn == pytest.approx(FLUX_E, rel=1e-3)
    inverse = reconstruct(I0, fit.response, fit.initial.matrix, GOOD, FLUX_E, 0.0)
    deviation = cross_talk(inverse.matrix, H) / fit.error[:, None]
    assert 0.75 < np.sqrt((deviation**2).mean()) < 1.25
    assert np.abs(deviation).max() < 4
    assert np.abs(inverse.matrix @ (fit.reference - I0)).max() < 0.5


def test_the_noise_of_a_measured_h_neither_biases_r_nor_adds_noise_to_it() -> None:
    """H is measured so briefly that the noise of its pixels is as strong as the response to the modes."""
    fit = measured(poke_patterns(MODES, 0.3), 10)
    variance = I0 / FLUX_E
    from_noisy_h = reconstruct(I0, fit.response, None, GOOD, FLUX_E, 0.0)
    inverse = reconstruct(I0, fit.response, fit.initial.matrix, GOOD, FLUX_E, 0.0)
    least = np.sqrt(fit.initial.matrix**2 @ variance)
    assert np.diag(cross_talk(from_noisy_h.matrix, H)).mean() < -0.3
    assert abs(np.diag(cross_talk(inverse.matrix, H)).mean()) < 3 * fit.error.max() / np.sqrt(MODES)
    assert (np.sqrt(inverse.matrix**2 @ variance) / least).max() < 1 + 3 * fit.error.max()
    # an initial reconstructor with wrong weights and mixed modes is unbiased too, with its own noise
    mixed = np.random.default_rng(0).standard_normal((MODES, MODES)) @ reconstructor(I0, H, GOOD, FLUX_E, 0.0, "pinv")
    other = reconstruct(I0, fit.response, mixed, GOOD, FLUX_E, 0.0)
    assert np.abs(cross_talk(other.matrix, H)).max() < 6 * fit.error.max()


def test_r_inverts_the_measured_h_and_one_cycle_has_no_standard_error() -> None:
    assert measured(hadamard_patterns(MODES, 3.0), 1).error.tolist() == [np.inf] * MODES
    fit = measured(hadamard_patterns(MODES, 3.0), 4)
    inverse = reconstruct(I0, fit.response, fit.initial.matrix, GOOD, FLUX_E, 0.0)
    assert np.allclose(inverse.matrix @ fit.response, np.eye(MODES), atol=1e-9)
    with pytest.raises(ValueError, match="does not tell the modes apart"):
        reconstruct(I0, fit.response, np.zeros((MODES, PIXELS)), GOOD, FLUX_E, 0.0)


def test_r_ignores_what_the_initial_reconstructor_ignores() -> None:
    background = normalise_flux(I0, np.ones((PIXELS, 1)), GOOD)[1]
    blind = reconstructor(I0, H, GOOD, FLUX_E, 2.0, "weighted", background)
    fit = measured(hadamard_patterns(MODES, 3.0), 4)
    assert np.abs(reconstruct(I0, fit.response, blind, GOOD, FLUX_E, 2.0).matrix @ background).max() < 1e-9


def test_the_initial_reconstructor_with_the_least_noise_is_chosen() -> None:
    own = initial_of_sensor()
    blind = Initial(np.zeros_like(own.matrix), "blind")
    other = Initial(initial_of_sensor(2).matrix, "of another sensor")
    scaled = Initial(own.matrix * 3.0, "again")
    for candidates, best in (
        ([own, blind], own),
        ([other, own], own),
        ([blind, own, scaled], own),
        ([scaled, own], scaled),
    ):
        assert best_initial(candidates, -0.8 * H[:, 1], 1, I0 / FLUX_E) is best


def test_an_outlying_cycle_hardly_affects_the_mean() -> None:
    rng = np.random.default_rng(9)
    error = np.linspace(0.01, 0.04, 8)
    products = np.eye(8) + rng.standard_normal((400, 8, 8, 8)) * error[:, None]
    without_outlier = [without_outliers(each).mean(axis=0) - np.eye(8) for each in products]
    assert np.std(without_outlier) / np.sqrt((error**2).mean() / 8) < 1.03
    products[:, 3, 1, 5] += 2.0
    with_outlier = [without_outliers(each).mean(axis=0) - np.eye(8) for each in products]
    assert np.sqrt(np.mean([each[1, 5] ** 2 for each in with_outlier])) < 2.5 * error[1] / np.sqrt(8)
    errors = np.mean([row_error(without_outliers(each)) for each in products], axis=0)
    assert errors == pytest.approx(error / np.sqrt(8), rel=0.25)


def test_cycles_not_used_for_a_reconstructor_reveal_whether_it_is_wrong() -> None:
    rng = np.random.default_rng(4)
    error = np.linspace(0.01, 0.04, 8)
    products = np.eye(8) + rng.standard_normal((400, 4, 8, 8)) * error[:, None]
    right_checks = [check(each, np.eye(8), error) for each in products]
    assert np.mean([each.within(0.012, 0.04) for each in right_checks]) > 0.99
    assert np.sqrt(np.mean([each.rms**2 for each in right_checks])) < 0.01
    largest = max(right_checks, key=lambda each: each.largest)
    assert largest.bound(0.04) > largest.largest > 0.04, "the noise of these frames is allowed for"
    wrong = np.eye(8)
    wrong[2, 5] = 0.3
    for expected in (wrong, np.eye(8) * 1.1):
        assert not any(check(each, expected, error).within(0.012, 0.04) for each in products)


@pytest.mark.parametrize("delay", [1.0, 1.3, 1.5, 2.0, 2.75])
def test_the_delay_and_the_response_to_a_poke_are_measured(delay: float) -> None:
    poke = dither(1, 8.0, 600, 1, 3).table[:, 0]
    weights = np.concatenate([[0.0], delay_weights(delay)])
    seen_nm = np.convolve(poke, weights)[: len(poke)]
    fractions, _ = fractions_of(exposed(np.outer(seen_nm, [0, 1, 0, 0]), 5))
    measured_delay = measure_delay(fractions, I0, poke)
    assert abs(measured_delay.delay_frames - delay) < min(0.05, 5 * measured_delay.error_frames + 1e-3)
    assert measured_delay.response @ H[:, 1] > 0.9 * np.linalg.norm(measured_delay.response) * np.linalg.norm(H[:, 1])
    assert np.linalg.norm(measured_delay.response) == pytest.approx(np.linalg.norm(H[:, 1]), rel=0.2)
    backwards = measure_delay(fractions, I0, -poke)
    assert backwards.delay_frames == pytest.approx(measured_delay.delay_frames)
    assert backwards.response @ H[:, 1] < 0


@pytest.mark.parametrize("seed", range(2))
def test_a_delay_is_not_measured_without_pokes_or_in_too_few_frames(seed: int) -> None:
    poke = dither(1, 8.0, 600, 1, seed).table[:, 0]
    fractions, _ = fractions_of(exposed(np.zeros((600, MODES)), seed))
    with pytest.raises(ValueError, match="pokes are not seen"):
        measure_delay(fractions, I0, poke)
    with pytest.raises(ValueError, match="at least 240 frames"):
        measure_delay(fractions[:100], I0, poke[:100])


def test_a_response_later_than_the_longest_lag_is_an_error() -> None:
    poke = dither(1, 8.0, 600, 1, 3).table[:, 0]
    fractions, _ = fractions_of(exposed(np.outer(np.roll(poke, 5), [0, 1, 0, 0]), 5))
    with pytest.raises(ValueError, match=r"spread over several frames, or later than 4\.5 frames"):
        measure_delay(fractions, I0, poke)


def test_a_dark_shows_hot_noisy_and_dead_pixels_and_light_of_the_star() -> None:
    rng = np.random.default_rng(2)
    frames = np.rint(100 + 2 * rng.standard_normal((200, 6400)))
    frames[:, 10] += 40
    frames[:, 20] += np.rint(20 * rng.standard_normal(200))
    frames[:, 30] = 97
    dark = measure_dark(frames)
    assert np.flatnonzero(dark.hot).tolist() == [10]
    assert np.flatnonzero(dark.noisy).tolist() == [20]
    assert np.flatnonzero(dark.dead).tolist() == [30]
    assert np.flatnonzero(dark.good == 0).tolist() == [10, 20, 30]
    assert np.median(dark.dark_dn) == pytest.approx(100, abs=0.1)
    light = np.zeros(6400)
    light[:200] = 1 / 200
    assert starlight_dn(dark.dark_dn, light) == pytest.approx(0, abs=30)
    with_light = measure_dark(frames + 5e3 * light)
    assert starlight_dn(with_light.dark_dn, light) == pytest.approx(5e3, abs=100)
    with pytest.raises(ValueError, match="at least 16 frames"):
        measure_dark(frames[:5])
    for value in (np.nan, np.inf):  # numpy would warn of infinity
        with pytest.raises(ValueError, match="1 pixel of the dark frames has values that are not finite"):
            measure_dark(np.where(np.arange(frames.shape[1]) == 7, value, frames))
    frames[:, 2000:3000] += 50
    with pytest.raises(ValueError, match="not dark"):
        measure_dark(frames)


@pytest.mark.parametrize("frames", [16, 400])
@pytest.mark.parametrize("noise_dn", [0.0, 0.1, 0.15, 0.17, 0.2, 0.25, 0.35, 0.5])
@pytest.mark.parametrize("pattern_dn", [0.0, 0.5])
def test_pixels_whose_noise_is_lost_in_rounding_are_not_bad(noise_dn: float, pattern_dn: float, frames: int) -> None:
    rng = np.random.default_rng(1)
    level_dn = 100 + pattern_dn * rng.uniform(-1, 1, 1600)
    dark = measure_dark(np.rint(level_dn + noise_dn * rng.standard_normal((frames, 1600))))
    assert np.count_nonzero(dark.good == 0) == 0


def test_reconstruct_gives_the_r_of_reconstructor_for_a_computed_h() -> None:
    for estimator in ("weighted", "pinv"):
        inverse = reconstruct(I0, H, None, GOOD, FLUX_E, 2.0, estimator)
        assert np.allclose(inverse.matrix, reconstructor(I0, H, GOOD, FLUX_E, 2.0, estimator), rtol=1e-6, atol=1e-9)


def test_poorly_measured_combinations_can_be_truncated_or_damped() -> None:
    faint = np.column_stack([H[:, :3], H[:, 2] + 0.01 * H[:, 3]])
    whole = reconstruct(I0, faint, None, GOOD, FLUX_E, 0.0)
    assert whole.condition_number > 50
    one_nm, noll = np.ones(4, np.float32), (2, 3, 4, 5)
    assert "Z4 and Z5" in advice(whole, noll, one_nm) or "Z5 and Z4" in advice(whole, noll, one_nm)
    assert "no regularisation" in advice(whole, noll, 1e6 * one_nm)
    assert "no regularisation" in advice(whole, noll, np.array([1, 1, 1e6, 1e6]))  # Z2 and Z3 with small limits
    assert "--truncate" not in advice(whole, noll, 1e-9 * one_nm)  # truncation would leave no combination
    for cut in np.linspace(0.01, 0.02, 20):
        with_smallest = whole._replace(singular_values=np.array([1, 0.5, 0.3, cut]))
        advised = float(advice(with_smallest, noll, 0.9 / cut * one_nm).split()[-1])
        assert advised > cut
    truncated = reconstruct(I0, faint, None, GOOD, FLUX_E, 0.0, truncate=0.05)
    assert np.count_nonzero(truncated.kept) == 3
    assert np.linalg.matrix_rank(truncated.matrix) == 3
    assert "1 of 4 combinations" in advice(truncated, noll, one_nm)
    damped = reconstruct(I0, faint, None, GOOD, FLUX_E, 0.0, tikhonov=0.05)
    assert np.linalg.norm(truncated.matrix) < np.linalg.norm(damped.matrix) < np.linalg.norm(whole.matrix)
    slightly = reconstruct(I0, faint, None, GOOD, FLUX_E, 0.0, tikhonov=0.002)
    assert "is damped to 79.7%" in advice(slightly, noll, one_nm)
    with pytest.raises(ValueError, match="at least 0 and below 1"):
        reconstruct(I0, faint, None, GOOD, FLUX_E, 0.0, truncate=1.0)
    with pytest.raises(ValueError, match="weighted"):
        reconstruct(I0, faint, None, GOOD, FLUX_E, 0.0, "best")
    from_measured = reconstruct(I0, faint, whole.matrix, GOOD, FLUX_E, 0.0, truncate=0.05)
    assert np.allclose(from_measured.matrix, truncated.matrix, rtol=1e-6, atol=1e-6)


def test_a_cycle_with_too_few_usable_frames_is_refused() -> None:
    plan = cycle(poke_patterns(MODES, 8.0), hold=1, settle=0, rest=0)
    fractions, flux = fractions_of(exposed(plan.table, 1))
    with pytest.raises(ValueError, match="do not tell the 4 modes apart"):
        cycle_response(fractions, flux, plan.table, plan.table, np.arange(len(plan)) < 2 * SIGNS.size)
    with pytest.raises(ValueError, match="no frame with a poke"):
        cycle_response(fractions, flux, plan.table, plan.table, np.zeros(len(plan), bool))
    with pytest.raises(ValueError, match="no light"):
        fractions_of(np.zeros((3, PIXELS)))


def test_a_new_dark_or_mask_or_reference_keeps_the_response_to_the_modes() -> None:
    before = calibration()
    good = np.ones(before.good.size)
    good[3] = 0
    masked = with_dark(before, np.full(good.size, 7.0), good, 1.0, 1.0)
    kept = masked.reconstructor.astype(float) @ masked.response
    assert np.allclose(kept, np.eye(len(before.noll)), atol=1e-4)
    assert not masked.reconstructor[:, 3].any()
    assert float(masked.reference @ masked.good) == pytest.approx(1.0)
    assert masked.flux_dn == pytest.approx(before.flux_dn * (1 - before.reference[3]), rel=1e-5)
    moved = with_reference(before, before.reference + 0.5 * before.response[:, 0], 2 * before.flux_dn, 1.0, 1.0)
    assert moved.flux_dn == 2 * before.flux_dn
    assert (before.reconstructor @ (moved.reference - before.reference))[0] == pytest.approx(0.5, abs=0.02)
    assert moved.response is before.response


def test_a_new_dark_or_reference_keeps_a_fitted_background_and_a_truncation() -> None:
    before = calibration()
    I0, H, good = (getattr(before, name).astype(float) for name in ("reference", "response", "good"))
    background = normalise_flux(I0, np.ones((I0.size, 1)), good)[1]
    rows = single(reconstructor(I0, H, good, 1e5, 1.0, nuisance=background))
    fitted = replace(before, reconstructor=rows, estimator="weighted+background")
    truncated = replace(
        before, reconstructor=before.reconstructor * single([[1], [1], [0]]), estimator="pinv+regularised"
    )
    for original in (fitted, truncated):
        dark = with_dark(original, np.full(good.size, 7.0), good, 1.0, 1.0)
        moved = with_reference(original, I0, 2 * before.flux_dn, 1.0, 1.0)
        for changed in (dark, moved):
            np.testing.assert_allclose(changed.reconstructor, original.reconstructor, atol=1e-3)
    good[3] = 0
    masked, plain = (with_dark(original, np.zeros(good.size), good, 1.0, 1.0) for original in (fitted, before))
    background = normalise_flux(masked.reference.astype(float), np.ones((I0.size, 1)), good)[1]
    errors_nm = [np.abs(original.reconstructor @ background).max() for original in (masked, plain)]
    assert errors_nm[0] < 0.3 * errors_nm[1]  # with one pixel of 42 masked


def test_r_of_a_measured_calibration_is_not_recomputed_from_noisy_h() -> None:
    before = calibration()
    noise = 0.2 * np.abs(before.response).max() * np.random.default_rng(3).standard_normal(before.response.shape)
    response = (before.response + noise * before.good[:, None]).astype(np.float32)
    matrix = np.linalg.solve(before.reconstructor @ response, before.reconstructor).astype(np.float32)
    noisy = replace(before, response=response, reconstructor=matrix, estimator="weighted+hadamard")
    reference, true_response = before.reference.astype(float), before.response.astype(float)
    assert np.array_equal(with_reference(noisy, reference, before.flux_dn, 1.0, 1.0).reconstructor, matrix)
    good = np.ones(reference.size)
    good[3] = 0
    masked = with_dark(noisy, np.zeros(good.size), good, 1.0, 1.0)
    best = with_dark(before, np.zeros(good.size), good, 1.0, 1.0)
    assert not masked.reconstructor[:, 3].any()
    _, H_masked = normalise_flux(reference, true_response, good)
    before_mask, after_mask = (
        cross_talk(R, true_H) for R, true_H in ((matrix, true_response), (masked.reconstructor, H_masked))
    )
    # One pixel holds 2 % of this sensor's flux.
    assert np.abs(after_mask - before_mask).max() < np.abs(before_mask).max()
    noise_power = [(each.reconstructor.astype(float) ** 2 @ (reference + 1e-6)) for each in (masked, best)]
    assert (noise_power[0] / noise_power[1]).max() < 1.5
    with pytest.raises(ValueError, match="do not tell the modes apart"):
        with_dark(noisy, np.zeros(good.size), np.arange(good.size) < 1, 1.0, 1.0)
