import numpy as np
import pytest

from lowfc.optics.detector import Detector, expose, saturation_dn
from lowfc.optics.photometry import Photometry, electrons, tilt_nm_per_mas

QUIET = Detector(read_noise_e=0.0, bias_dn=0.0)


def flat(mean_e, side=400):
    return np.full((side, side), mean_e, np.float32)


def rng():
    return np.random.default_rng(5)


@pytest.mark.parametrize("mean_e", [0.3, 4.0, 40.0])
def test_electrons_follow_the_poisson_law(mean_e):
    frame = expose(QUIET, flat(mean_e), rng()).astype(float)
    spread = np.sqrt(mean_e / frame.size)
    assert frame.mean() == pytest.approx(mean_e, abs=5 * spread)
    assert frame.var() == pytest.approx(mean_e, rel=0.03)
    assert np.mean(frame == 0) == pytest.approx(np.exp(-mean_e), abs=5e-3)


def test_gain_bias_and_read_noise():
    camera = Detector(gain_e_per_dn=2.0, read_noise_e=6.0, bias_dn=200.0)
    frame = expose(camera, flat(100.0), rng()).astype(float)
    assert frame.dtype == float
    assert frame.mean() == pytest.approx(250.0, abs=0.1)
    assert frame.var() == pytest.approx((100 + 36) / 4 + 1 / 12, rel=0.03)
    dark = expose(camera, flat(0.0), rng()).astype(float)
    assert dark.std() == pytest.approx(np.sqrt(9 + 1 / 12), rel=0.02)


def test_multiplication_has_the_excess_noise_of_a_long_register():
    camera = Detector(gain_e_per_dn=10.0, read_noise_e=0.0, bias_dn=0.0, full_well_e=6e5, em_gain=100.0)
    frame = expose(camera, flat(20.0), rng()).astype(float) / 10.0  # in input electrons
    assert frame.mean() == pytest.approx(20.0, rel=0.01)
    assert frame.var() == pytest.approx(2 * 20.0, rel=0.03)


def test_clock_induced_charge_is_multiplied_like_light():
    camera = Detector(read_noise_e=0.0, bias_dn=0.0, em_gain=100.0, clock_induced_charge_e=0.05)
    assert expose(camera, flat(0.0), rng()).mean() == pytest.approx(5.0, rel=0.05)
    assert expose(Detector(read_noise_e=0.0, bias_dn=0.0), flat(0.0), rng()).max() == 0


@pytest.mark.parametrize(
    ("camera", "limit"),
    [
        (Detector(full_well_e=1000.0, gain_e_per_dn=2.0, bias_dn=50.0), 550),
        (Detector(bit_depth=12, bias_dn=50.0), 4095),
        (Detector(full_well_e=1e9, bias_dn=0.0), 65535),
        (Detector(full_well_e=5000.0, em_gain=1000.0, bias_dn=0.0), 5000),
    ],
)
def test_saturation_is_full_well_or_the_converter(camera, limit):
    assert saturation_dn(camera) == limit
    frame = expose(camera, flat(1e8, 8), rng())
    assert frame.dtype == np.uint16
    assert frame.max() == limit
    assert frame.min() >= limit - 5 * max(1.0, camera.read_noise_e)


def test_the_same_seed_gives_the_same_frame_and_the_input_is_kept():
    mean_e = np.linspace(0, 50, 6400, dtype=np.float32).reshape(80, 80)
    kept = mean_e.copy()
    first, second = (expose(Detector(), mean_e, np.random.default_rng(7)) for _ in range(2))
    np.testing.assert_array_equal(first, second)
    np.testing.assert_array_equal(mean_e, kept)
    assert (expose(Detector(), mean_e, np.random.default_rng(8)) != first).any()


def test_rounding_below_zero_is_no_light_but_nan_is_an_error():
    assert expose(QUIET, flat(-1e-9, 4), rng()).max() == 0
    with pytest.raises(ValueError, match="lam"):
        expose(QUIET, flat(np.nan, 4), rng())


@pytest.mark.parametrize(
    "bad",
    [
        {"bit_depth": 17},
        {"gain_e_per_dn": 0.0},
        {"em_gain": 0.5},
        {"full_well_e": -1.0},
        {"read_noise_e": -1.0},
        {"clock_induced_charge_e": -0.1},
        {"bias_dn": 300.0, "bit_depth": 8},
    ],
)
def test_impossible_detectors_are_refused(bad):
    with pytest.raises(ValueError, match="got"):
        Detector(**bad)


def test_photometry_of_section_3_3():
    assert electrons(Photometry(), 0.05) == pytest.approx(8.12e6, rel=1e-3)
    assert electrons(Photometry(magnitude=2.33), 0.05) == pytest.approx(10 * electrons(Photometry(), 0.05))
    assert electrons(Photometry(), 0.1) == pytest.approx(2 * electrons(Photometry(), 0.05))


def test_a_milliarcsecond_of_tilt():
    assert tilt_nm_per_mas(2.0) == pytest.approx(2.424, abs=1e-3)
    assert 4 * tilt_nm_per_mas(2.0) / 550 == pytest.approx(0.0176, abs=1e-4)  # waves peak to valley, Sect. 3.3


@pytest.mark.parametrize(
    "bad", [{"diameter_m": 0.0}, {"bandwidth_nm": -1.0}, {"throughput": 1.5}, {"quantum_efficiency": 0.0}]
)
def test_impossible_photometry_is_refused(bad):
    with pytest.raises(ValueError, match="got"):
        Photometry(**bad)
