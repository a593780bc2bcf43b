"""Models of drift, lines and noise, identified from the simulator's presets and from processes whose truth is known."""

import numpy as np
import numpy.typing as npt
import pytest

from lowfc.control.laws.kalman import lqg
from lowfc.control.laws.margins import check_stable
from lowfc.control.laws.spectra import Pieces
from lowfc.control.laws.vibration import FEWEST, Line, Model, identify, resolution_hz
from lowfc.optics.detector.photometry import tilt_nm_per_mas
from sim_camera.disturbance import LINES_HZ, disturbance, modes_nm
from tests.support.theory import realised

Array = npt.NDArray[np.float64]
RATE_HZ = 1000.0
NM_PER_MAS = tilt_nm_per_mas(2.0)


def preset(name: str, frames: int, seed: int = 1, noise_nm: float = 0.8) -> Pieces:
    """Tip of a preset as a sensor with white noise sees it."""
    shaken = disturbance(name, (2, 3, 4), seed, NM_PER_MAS, 550.0)
    noise = noise_nm * np.random.default_rng(seed).standard_normal((frames, 1))
    return Pieces((modes_nm(shaken, 0, frames, RATE_HZ)[:, :1] + noise,), 0)


def test_the_lines_of_the_reaction_wheel_are_found() -> None:
    model = identify(preset("reaction-wheel", 12_000), RATE_HZ)
    assert [line.frequency_hz for line in model.lines] == pytest.approx(LINES_HZ, abs=0.02)
    rms_mas = [np.sqrt(line.variance_nm2) / NM_PER_MAS for line in model.lines]
    assert rms_mas == pytest.approx([9.0, 8.3, 5.0, 3.0, 2.0], rel=0.06)
    assert np.sqrt(model.noise_nm2) == pytest.approx(0.8, rel=0.03)
    assert all(line.width_hz < RATE_HZ / 12_000 for line in model.lines)


def test_damped_lines_have_their_width_and_power() -> None:
    truth = Model(1e-4, np.inf, (Line(20, 0.8, 25.0), Line(60, 2.5, 9.0)), 0.5, RATE_HZ)
    model = identify(Pieces((realised(truth, 40_000),), 0), RATE_HZ)
    assert [line.frequency_hz for line in model.lines] == pytest.approx([20, 60], rel=0.01)
    assert [line.width_hz for line in model.lines] == pytest.approx([0.8, 2.5], rel=0.35)
    assert [line.variance_nm2 for line in model.lines] == pytest.approx([25, 9], rel=0.35)
    assert model.noise_nm2 == pytest.approx(0.5, rel=0.05)


def test_nothing_is_made_of_noise() -> None:
    """Runs of noise alone: not one line."""
    for seed in range(10):
        noise = np.random.default_rng(seed).standard_normal((4096, 1))
        model = identify(Pieces((noise,), 0), RATE_HZ)
        assert model.lines == ()
        assert model.noise_nm2 == pytest.approx(1, rel=0.1)


def test_a_spectrum_is_that_of_the_states() -> None:
    """By the states' own transfer function, which shares no code with the spectrum."""
    model = Model(0.01, 5.0, (Line(20, 0.8, 25.0), Line(60, 2.5, 9.0)), 0.5, RATE_HZ)
    F, Q, C = model.states()
    omega = np.array([0.01, 0.1257, 0.3, 0.377, 2.0])
    found = []
    for z in np.exp(1j * omega):
        passed = C @ np.linalg.inv(np.eye(len(F)) - F / z)
        found.append(float((passed @ Q @ passed.conj()).real))
    np.testing.assert_allclose(model.spectrum_nm2(omega), found, rtol=1e-6)


def test_pieces_count_like_one_run_and_too_short_ones_give_nothing() -> None:
    whole = preset("reaction-wheel", 12_000).values[0]
    model = identify(Pieces((whole[:6000], whole[6000:]), 0), RATE_HZ)
    assert [round(line.frequency_hz) for line in model.lines] == [6, 18, 37, 71, 117]
    assert identify(Pieces((whole[: FEWEST - 1],), 0), RATE_HZ) is None
    assert resolution_hz(Pieces((whole,), 0), RATE_HZ) == RATE_HZ / 12_000
    assert resolution_hz(Pieces((), 0), RATE_HZ) == 0


def test_a_slow_mode_is_drift() -> None:
    shaken = disturbance("thermal", (4,), 3, NM_PER_MAS, 550.0)
    run = modes_nm(shaken, 0, 20_000, RATE_HZ) + 0.5 * np.random.default_rng(3).standard_normal((20_000, 1))
    model = identify(Pieces((run,), 0), RATE_HZ)
    assert all(line.frequency_hz < 1 for line in model.lines)
    assert model.drift_nm2 > 0
    assert model.noise_nm2 == pytest.approx(0.25, rel=0.05)


@pytest.mark.parametrize(("lines", "seed"), [((), 1), (LINES_HZ, 3)])
def test_where_drift_explains_all_there_is_some_noise_and_a_filter(lines: tuple[float, ...], seed: int) -> None:
    truth = Model(1.0, 50.0, tuple(Line(hz, 1e-3, 100.0) for hz in lines), 1e-12, RATE_HZ)
    model = identify(Pieces((realised(truth, 4096, seed),), 0), RATE_HZ)
    assert model.noise_nm2 > 1e-8
    check_stable(lqg([model], (2,), 1.0), 1.0)
