"""H, I0, delay, dark and R from made-up frames of which everything is known."""

import numpy as np
import pytest
from toy import calibration

from lowfc.control.adapted import with_dark, with_reference
from lowfc.control.calibration import normalise_flux, reconstructor
from lowfc.control.dark_frames import dark_of, light_in
from lowfc.control.delay_fit import measure_delay
from lowfc.control.poke_plan import cycle, dither, hadamard_patterns, ladder, poke_patterns
from lowfc.control.regularised import advice, reconstruct
from lowfc.control.response_fit import (
    Measured,
    Sums,
    cross_talk,
    cross_talk_error,
    cycle_response,
    linear_range,
    measured,
    normalised,
)
from lowfc.control.stability import delay_weights

PIXELS, MODES = 300, 4
FLUX_E = 1e5


def truth(seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """I0 and H, normalised."""
    rng = np.random.default_rng(seed)
    light = rng.gamma(1.0, 1.0, PIXELS)
    slopes = light[:, None] * rng.standard_normal((PIXELS, MODES)) * 0.01
    return normalise_flux(light, slopes, np.ones(PIXELS))


def exposed(seen: np.ndarray, seed: int, I0: np.ndarray, H: np.ndarray) -> np.ndarray:
    """Frames (frames, pixels) in electrons with photon noise."""
    rng = np.random.default_rng(seed)
    return rng.poisson(np.maximum(I0 + seen @ H.T, 0) * FLUX_E).astype(np.float64)


def calibrated(patterns: np.ndarray, cycles: int, drift: float = 0.0) -> Measured:
    I0, H = truth()
    sums = Sums.none(PIXELS, MODES)
    for number in range(cycles):
        plan = cycle(patterns, hold=4, settle=1, rest=16, backwards=number % 2 == 1)
        time = np.arange(len(plan))[:, None] / len(plan)
        wander = drift * (time - 0.7 * time**2) * np.arange(1, MODES + 1)
        frames = exposed(plan.table + wander, 100 + number, I0, H)
        fractions, flux = normalised(frames, np.zeros(PIXELS), np.ones(PIXELS))
        sums = sums.plus(cycle_response(fractions, flux, plan.table, plan.table, plan.used.astype(float)))
    return measured(sums)


@pytest.mark.parametrize("patterns", [poke_patterns(MODES, 8.0), hadamard_patterns(MODES, 3.0)])
def test_h_is_found_within_its_standard_error(patterns: np.ndarray) -> None:
    I0, H = truth()
    found = calibrated(patterns, 20)
    assert found.error is not None
    assert found.reference is not None
    deviation = (found.response - H) / found.error
    assert 0.9 < np.sqrt(np.median(deviation**2) / 0.455) < 1.15  # 0.455: the median of chi square
    assert found.flux_dn == pytest.approx(FLUX_E, rel=1e-3)
    made = reconstruct(I0, found.response, found.error, np.ones(PIXELS), FLUX_E, 0.0)
    assert np.all(np.abs(cross_talk(made.matrix, H)) < 5 * cross_talk_error(made.matrix, found.error))
    assert np.abs(made.matrix @ (found.reference - I0)).max() < 0.5


def test_a_drift_does_not_get_into_h() -> None:
    still, drifting = (calibrated(hadamard_patterns(MODES, 3.0), 4, drift) for drift in (0.0, 20.0))
    made = reconstruct(truth()[0], still.response, still.error, np.ones(PIXELS), FLUX_E, 0.0)
    assert still.error is not None
    error = cross_talk_error(made.matrix, still.error).max()
    # Same photon noise but for the drifting light: a drift of 80 nm that got in would be of the order of one.
    assert np.abs(cross_talk(made.matrix, drifting.response - still.response + truth()[1])).max() < 8 * error + 0.02


def test_the_noise_of_h_does_not_make_modes_small() -> None:
    I0, H = truth()
    found = calibrated(poke_patterns(MODES, 0.6), 10)
    good = np.ones(PIXELS)
    plain = reconstruct(I0, found.response, None, good, FLUX_E, 0.0)
    made = reconstruct(I0, found.response, found.error, good, FLUX_E, 0.0)
    assert found.error is not None
    error = np.diag(cross_talk_error(made.matrix, found.error)).max()
    assert np.diag(cross_talk(plain.matrix, H)).mean() < -0.1
    assert abs(np.diag(cross_talk(made.matrix, H)).mean()) < 4 * error


def test_the_loops_reaction_does_not_bias_h() -> None:
    I0, H = truth()
    R = reconstructor(I0, H, np.ones(PIXELS), FLUX_E, 0.0)
    sums, biased = (Sums.none(PIXELS, MODES) for _ in range(2))
    rng = np.random.default_rng(7)
    for piece in range(6):
        plan = dither(MODES, 2.0, 1000, 2, piece)
        command, wander = np.zeros(MODES), np.zeros(MODES)
        frames, moved = [], []
        before = np.zeros(MODES)
        for row in plan.table:
            wander = 0.99 * wander + 0.5 * rng.standard_normal(MODES)
            seen = before + command  # one frame of delay
            frame = exposed((seen + wander)[None], int(rng.integers(1 << 31)), I0, H)[0]
            frames.append(frame)
            moved.append(seen)
            command = command - 0.5 * (R @ (frame / frame.sum() - I0))
            before = row
        poked = np.vstack([np.zeros(MODES), plan.table[:-1]])
        fractions, flux = normalised(np.array(frames), np.zeros(PIXELS), np.ones(PIXELS))
        used = np.ones(len(frames))
        sums = sums.plus(cycle_response(fractions, flux, np.array(moved), poked, used))
        biased = biased.plus(cycle_response(fractions, flux, np.array(moved), np.array(moved), used))
    found = measured(sums)
    talk, naive = cross_talk(R, found.response), cross_talk(R, measured(biased).response)
    assert np.abs(np.diag(talk)).max() < 0.1
    assert np.diag(naive).mean() < -0.15
    assert abs(np.diag(talk).mean()) < 0.05


@pytest.mark.parametrize("delay", [1.0, 1.3, 1.5, 2.0, 2.75])
def test_the_delay_is_found(delay: float) -> None:
    I0, H = truth()
    poke = dither(1, 8.0, 600, 1, 3).table[:, 0]
    weights = np.concatenate([[0.0], delay_weights(delay)])
    seen = np.convolve(poke, weights)[: len(poke)]
    frames = exposed(np.outer(seen, [0, 1, 0, 0]), 5, I0, H)
    fractions, _ = normalised(frames, np.zeros(PIXELS), np.ones(PIXELS))
    found = measure_delay(fractions, I0, poke)
    assert abs(found.delay_frames - delay) < min(0.05, 5 * found.error_frames + 1e-3)
    assert found.picture @ H[:, 1] > 0.9 * np.linalg.norm(found.picture) * np.linalg.norm(H[:, 1])
    assert np.linalg.norm(found.picture) == pytest.approx(np.linalg.norm(H[:, 1]), rel=0.2)
    backwards = measure_delay(fractions, I0, -poke)
    assert backwards.delay_frames == pytest.approx(found.delay_frames)
    assert backwards.picture @ H[:, 1] < 0


@pytest.mark.parametrize("seed", range(5))
def test_pokes_that_are_not_there_are_not_seen(seed: int) -> None:
    I0, H = truth()
    poke = dither(1, 8.0, 600, 1, seed).table[:, 0]
    fractions, _ = normalised(exposed(np.zeros((600, MODES)), seed, I0, H), np.zeros(PIXELS), np.ones(PIXELS))
    with pytest.raises(ValueError, match="pokes are not seen"):
        measure_delay(fractions, I0, poke)
    with pytest.raises(ValueError, match="at least 240 frames"):
        measure_delay(fractions[:100], I0, poke[:100])


def test_an_answer_that_comes_too_late_is_said() -> None:
    I0, H = truth()
    poke = dither(1, 8.0, 600, 1, 3).table[:, 0]
    fractions, _ = normalised(
        exposed(np.outer(np.roll(poke, 5), [0, 1, 0, 0]), 5, I0, H), np.zeros(PIXELS), np.ones(PIXELS)
    )
    with pytest.raises(ValueError, match="not over after"):
        measure_delay(fractions, I0, poke)


def test_the_linear_range_is_where_the_gain_leaves_the_tolerance() -> None:
    amplitudes = np.outer([10.0, 20.0, 40.0], [1.0, 2.0])
    plan = ladder(amplitudes, hold=1, settle=0)
    answers = plan.table - np.array([1e-4, 0.0]) * plan.table**3
    found = linear_range(answers, plan.table, plan.block)
    assert found.gain[:, 0] == pytest.approx([0.99, 0.96, 0.84])
    assert found.range_nm == pytest.approx([30.0, 80.0])
    with pytest.raises(ValueError, match="pushed and pulled"):
        linear_range(answers[:2], plan.table[:2], plan.block[:2])


def test_bad_pixels_are_found_and_good_ones_are_not() -> None:
    rng = np.random.default_rng(2)
    frames = np.rint(100 + 2 * rng.standard_normal((200, 6400)))
    frames[:, 10] += 40
    frames[:, 20] += np.rint(20 * rng.standard_normal(200))
    frames[:, 30] = 97
    found = dark_of(frames)
    assert np.flatnonzero(found.hot).tolist() == [10]
    assert np.flatnonzero(found.noisy).tolist() == [20]
    assert np.flatnonzero(found.dead).tolist() == [30]
    assert np.flatnonzero(found.good == 0).tolist() == [10, 20, 30]
    assert np.median(found.dark_dn) == pytest.approx(100, abs=0.1)
    light = np.zeros(6400)
    light[1000:1200] = 1 / 200
    assert light_in(found, light) == pytest.approx(0, abs=30)
    lit = dark_of(frames + 5e3 * light)
    assert light_in(lit, light) == pytest.approx(5e3, abs=100)
    with pytest.raises(ValueError, match="at least 16 frames"):
        dark_of(frames[:5])
    frames[:, 2000:3000] += 50
    with pytest.raises(ValueError, match="not dark"):
        dark_of(frames)


def test_a_computed_h_gives_the_reconstructor_that_it_always_gave() -> None:
    I0, H = truth()
    good = np.ones(PIXELS)
    for estimator in ("weighted", "pinv"):
        made = reconstruct(I0, H, None, good, FLUX_E, 2.0, estimator)
        assert np.allclose(made.matrix, reconstructor(I0, H, good, FLUX_E, 2.0, estimator), rtol=1e-6, atol=1e-9)
    background = normalise_flux(I0, np.ones((PIXELS, 1)), good)[1]
    made = reconstruct(I0, H, None, good, FLUX_E, 2.0, nuisance=background)
    assert np.allclose(made.matrix, reconstructor(I0, H, good, FLUX_E, 2.0, "weighted", background), atol=1e-9)
    assert np.abs(made.matrix @ background).max() < 1e-9


def test_combinations_that_are_hardly_measured_can_be_left_out_or_damped() -> None:
    I0, H = truth()
    H[:, 3] = H[:, 2] + 0.01 * H[:, 3]
    good = np.ones(PIXELS)
    whole = reconstruct(I0, H, None, good, FLUX_E, 0.0)
    assert whole.condition_number > 50
    assert "Z4 and Z5" in advice(whole, (2, 3, 4, 5), 1.0) or "Z5 and Z4" in advice(whole, (2, 3, 4, 5), 1.0)
    assert "no regularisation" in advice(whole, (2, 3, 4, 5), 1e6)
    cut = reconstruct(I0, H, None, good, FLUX_E, 0.0, truncate=0.05)
    assert np.count_nonzero(cut.kept) == 3
    assert np.linalg.matrix_rank(cut.matrix) == 3
    assert "1 of 4 combinations" in advice(cut, (2, 3, 4, 5), 1.0)
    damped = reconstruct(I0, H, None, good, FLUX_E, 0.0, tikhonov=0.05)
    assert np.linalg.norm(cut.matrix) < np.linalg.norm(damped.matrix) < np.linalg.norm(whole.matrix)
    with pytest.raises(ValueError, match="0 or more and below 1"):
        reconstruct(I0, H, None, good, FLUX_E, 0.0, truncate=1.0)
    with pytest.raises(ValueError, match="weighted"):
        reconstruct(I0, H, None, good, FLUX_E, 0.0, "best")
    noise = np.full(H.shape, 0.1)
    with pytest.raises(ValueError, match="not above its own noise"):
        reconstruct(I0, H, noise, good, FLUX_E, 0.0)


def test_too_few_usable_frames_are_said() -> None:
    plan = cycle(poke_patterns(MODES, 8.0), hold=1, settle=0, rest=0)
    frames = exposed(plan.table, 1, *truth())
    fractions, flux = normalised(frames, np.zeros(PIXELS), np.ones(PIXELS))
    with pytest.raises(ValueError, match="do not tell the 4 modes apart"):
        cycle_response(fractions, flux, plan.table, plan.table, (plan.block < 2).astype(float))
    with pytest.raises(ValueError, match="no frame with a poke"):
        cycle_response(fractions, flux, plan.table, plan.table, np.zeros(len(plan)))
    with pytest.raises(ValueError, match="no light"):
        normalised(np.zeros((3, PIXELS)), np.zeros(PIXELS), np.ones(PIXELS))


def test_another_dark_mask_or_reference_gives_a_calibration_that_reads_the_same_modes() -> None:
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
