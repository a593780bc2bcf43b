"""The detector: noise compared with its probability distributions, and saturation; the photometry of the paper."""

import numpy as np
import pytest
import scipy

from lowfc.optics.detector.detector import Detector, expose, noise_table_of, saturation_dn
from lowfc.optics.detector.detector_noise_table import FAINT_E, STEP_E
from lowfc.optics.detector.photometry import Photometry, electrons, tilt_nm_per_mas

NO_READ_NOISE = Detector(read_noise_e=0.0, bias_dn=0.0)


def uniform(mean_e, side=400):
    return np.full((side, side), mean_e, np.float32)


def rng():
    return np.random.default_rng(5)


def probabilities(camera, mean_e, numbers):
    """Probability of each of these digital numbers, from the Poisson and normal distributions."""
    electrons_e = np.arange(400)
    edges = (np.append(numbers, numbers[-1] + 1) - 0.5 - camera.bias_dn) * camera.gain_e_per_dn
    read = np.diff(scipy.stats.norm.cdf((edges - electrons_e[:, None]) / camera.read_noise_e), axis=1)
    return scipy.stats.poisson.pmf(electrons_e, mean_e) @ read


CAMERAS = [Detector(), Detector(gain_e_per_dn=0.7, read_noise_e=0.4, bias_dn=90.3)]


@pytest.mark.parametrize("camera", [*CAMERAS, Detector(gain_e_per_dn=2.0, read_noise_e=0.12, bias_dn=100.5)])
def test_noise_table_has_the_exact_distribution_at_its_levels(camera):
    """The table's entries and its remainder together have the distribution of Poisson and read noise and rounding."""
    table = noise_table_of(camera)
    numbers = np.arange(table.first_dn, table.first_dn + table.remainder.shape[1])
    for level in (0, 1, 2, 17, 64, 500, len(table.entries) - 1):
        entries = table.entries[level].astype(int)
        from_remainder = (entries > numbers[-1]).sum()  # draws whose number `table.remainder` gives
        found = np.bincount(entries[entries <= numbers[-1]] - numbers[0], minlength=len(numbers)).astype(float)
        found += from_remainder * np.diff(table.remainder[level].astype(float), prepend=0.0)
        assert 0.5 * np.abs(found / len(entries) - probabilities(camera, level * STEP_E, numbers)).sum() < 1e-7


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("mean_e", [0.0, 0.5 * STEP_E, 0.05, 1.3, 5.03, 13.0, FAINT_E - 0.01, FAINT_E, 60.0])
def test_a_million_pixels_pass_the_chi_square_test(camera, mean_e):
    """Means at levels of the table, between its levels, and above the table."""
    count, min_expected = 1_000_000, 10
    frame = expose(camera, uniform(mean_e, 1000), rng())
    numbers = np.arange(400)
    expected = count * probabilities(camera, float(np.float32(mean_e)), numbers)
    found = np.bincount(frame.ravel(), minlength=400)
    frequent = expected > min_expected  # all other numbers form one class
    expected = np.append(expected[frequent], max(count - expected[frequent].sum(), min_expected))
    found = np.append(found[frequent], found[~frequent].sum())
    assert scipy.stats.chi2.sf(np.sum((found - expected)[:-1] ** 2 / expected[:-1]), frequent.sum() - 1) > 1e-3
    assert found[-1] < 10 * min_expected


def test_an_exact_camera_has_no_noise_table_but_the_same_mean_and_variance():
    camera = Detector(exact=True)
    assert noise_table_of(camera) is None
    exact, from_table = (expose(one, uniform(2.3), rng()).astype(float) for one in (camera, Detector()))
    assert exact.mean() == pytest.approx(from_table.mean(), abs=0.03)
    assert exact.var() == pytest.approx(from_table.var(), rel=0.03)


def test_faint_and_bright_pixels_of_one_frame_are_independent():
    mean_e = np.tile(np.array([0.0, 5.0, 23.0, 25.0, 900.0], np.float32), (10_000, 1))
    frame = expose(Detector(), mean_e, rng()).astype(float)
    assert frame.mean(axis=0) - 100 == pytest.approx(mean_e[0], abs=1.5)
    assert np.abs(np.corrcoef(frame.T) - np.eye(5)).max() < 0.05


def test_electron_multiplication_doubles_the_variance_as_a_long_register_does():
    camera = Detector(gain_e_per_dn=10.0, read_noise_e=0.0, bias_dn=0.0, full_well_e=6e5, em_gain=100.0)
    frame = expose(camera, uniform(20.0), rng()).astype(float) / 10.0  # electrons before multiplication
    assert frame.mean() == pytest.approx(20.0, rel=0.01)
    assert frame.var() == pytest.approx(2 * 20.0, rel=0.03)


def test_clock_induced_charge_is_multiplied_like_photoelectrons():
    camera = Detector(read_noise_e=0.0, bias_dn=0.0, em_gain=100.0, clock_induced_charge_e=0.05)
    assert expose(camera, uniform(0.0), rng()).mean() == pytest.approx(5.0, rel=0.05)
    assert expose(Detector(read_noise_e=0.0, bias_dn=0.0), uniform(0.0), rng()).max() == 0


@pytest.mark.parametrize(
    ("camera", "expected_dn"),
    [
        (Detector(full_well_e=1000.0, gain_e_per_dn=2.0, bias_dn=50.0), 550),
        (Detector(bit_depth=12, bias_dn=50.0), 4095),
        (Detector(full_well_e=1e9, bias_dn=0.0), 65535),
        (Detector(full_well_e=5000.0, em_gain=1000.0, bias_dn=0.0), 5000),
    ],
)
def test_saturation_is_at_the_full_well_or_at_the_limit_of_the_converter(camera, expected_dn):
    assert saturation_dn(camera) == expected_dn
    frame = expose(camera, uniform(1e8, 8), rng())
    assert frame.dtype == np.uint16
    assert frame.max() == expected_dn
    assert frame.min() >= expected_dn - 5 * max(1.0, camera.read_noise_e)


def test_same_seed_gives_the_same_frame_and_input_is_unchanged():
    mean_e = np.linspace(0, 50, 6400, dtype=np.float32).reshape(80, 80)
    before = mean_e.copy()
    first, second = (expose(Detector(), mean_e, np.random.default_rng(7)) for _ in range(2))
    np.testing.assert_array_equal(first, second)
    np.testing.assert_array_equal(mean_e, before)
    assert (expose(Detector(), mean_e, np.random.default_rng(8)) != first).any()


def test_negative_electrons_count_as_zero_and_nan_is_an_error():
    assert expose(NO_READ_NOISE, uniform(-1e-9, 4), rng()).max() == 0
    assert expose(Detector(), uniform(-1.0), rng()).mean() == pytest.approx(100, abs=0.02)  # drawn from the table
    with pytest.raises(ValueError, match="finite number, got nan"):
        expose(NO_READ_NOISE, uniform(np.nan, 4), rng())


@pytest.mark.parametrize(
    ("kind", "bad"),
    [
        (Detector, {"bit_depth": 17}),
        (Detector, {"gain_e_per_dn": 0.0}),
        (Detector, {"em_gain": 0.5}),
        (Detector, {"full_well_e": -1.0}),
        (Detector, {"read_noise_e": -1.0}),
        (Detector, {"clock_induced_charge_e": -0.1}),
        (Detector, {"bias_dn": 300.0, "bit_depth": 8}),
        (Photometry, {"diameter_m": 0.0}),
        (Photometry, {"bandwidth_nm": -1.0}),
        (Photometry, {"throughput": 1.5}),
        (Photometry, {"quantum_efficiency": 0.0}),
    ],
)
def test_invalid_detectors_and_photometry_are_refused(kind, bad):
    with pytest.raises(ValueError, match="got"):
        kind(**bad)


def test_photometry_agrees_with_section_3_3_of_the_paper():
    assert electrons(Photometry(), 0.05) == pytest.approx(8.12e6, rel=1e-3)
    assert electrons(Photometry(magnitude=2.33), 0.05) == pytest.approx(10 * electrons(Photometry(), 0.05))
    assert electrons(Photometry(), 0.1) == pytest.approx(2 * electrons(Photometry(), 0.05))


def test_a_milliarcsecond_of_tilt_is_2_4_nm_rms_with_a_telescope_of_2_m():
    assert tilt_nm_per_mas(2.0) == pytest.approx(2.424, abs=1e-3)
    assert 4 * tilt_nm_per_mas(2.0) / 550 == pytest.approx(0.0176, abs=1e-4)  # waves P-V, Sect. 3.3 of the paper
