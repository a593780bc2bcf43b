"""Automatic gains and the watch over what the loop is worth, on real diffraction and photons, folded in one process."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from lowfc.adapters.files import factory
from lowfc.arrays import Array, Single
from lowfc.contract.codecs.state_codec import controller_state, decode_state
from lowfc.contract.configuration import FIXED_GAINS, load
from lowfc.control.calibration.calibration import Calibration
from lowfc.control.calibration.granted import noise_covariance_nm2
from lowfc.control.laws.automatic_gain import GainBank, TiltCrossTalk
from lowfc.control.laws.law import RELAXING
from lowfc.control.loop.safety import LoopMode
from tools.law_bench import Bench, calibrated, configured

AUTO = {"control.tilt_gain": "auto", "control.gain": "auto"}


@cache
def calibration(magnitude: float, sensor: str) -> Calibration:
    return calibrated(configured(sensor, **{"camera.rate_hz": 250.0, "star.magnitude": magnitude}))


def bench(magnitude: float, preset: str = "bench", sensor: str = "sam", **changed: Any) -> Bench:
    star = {
        "camera.rate_hz": 250.0,
        "star.magnitude": magnitude,
        "disturbance.preset": preset,
        "control.start_mode": "closed",
    }
    return Bench(configured(sensor, **AUTO | star | changed), calibration(magnitude, sensor))


def named(loop: Bench, name: str) -> list[dict[str, object]]:
    return [event.details for _, event in loop.events if event.name == name]


def rms_nm(loop: Bench, frames: int) -> tuple[float, float]:
    """True wavefront over the last frames: what is left, and what there would be without the loop."""
    truths = [truth.continuous for truth in loop.truths[-frames:]]
    return tuple(
        float(np.sqrt(np.mean([np.sum(np.square(one)) for one in values])))
        for values in ([truth.residual_nm for truth in truths], [truth.disturbance_nm for truth in truths])
    )


def gains(loop: Bench) -> Single:
    return loop.state.drive.law.gain


@pytest.fixture(scope="module")
def of_own() -> list[Array | Single]:
    """What the banks of the faint star's loop were told of the rows of R."""
    return []


@pytest.fixture(scope="module")
def faint(of_own: list[Array | Single]) -> Bench:
    remade = GainBank.remade

    def noted(self: GainBank, rows: Array | Single) -> None:
        of_own.append(rows)
        remade(self, rows)

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(GainBank, "remade", noted)
        loop = bench(6.5)
        loop.run(1200)
    return loop


def test_it_is_measured_first_and_closed_then(faint: Bench) -> None:
    modes = [step.mode for step in faint.steps]
    closed = modes.index(LoopMode.CLOSED)
    assert closed == 500
    assert set(modes[closed:]) == {LoopMode.CLOSED}
    assert named(faint, "MODE_CHANGED")[-1]["why"] == "auto: the gains were measured"
    assert len(named(faint, "GAINS_CHANGED")) >= 1


def test_a_faint_star_is_better_closed_than_open(faint: Bench) -> None:
    """Of a star of V = 6.5 at 250 Hz, gains of 0.5 and 0.05 leave 19 nm of 7."""
    left_nm, open_nm = rms_nm(faint, 500)
    assert left_nm < open_nm


@pytest.mark.parametrize("duration_s", [7, pytest.param(20, marks=pytest.mark.slow)])
def test_the_first_minute_is_not_the_price_of_automatic_gains(duration_s: float) -> None:
    """`make sim-loop`: the default star and disturbance, beside gains of 0.5 and 0.05."""
    left_nm, known = [], calibrated(load(None))
    for keys in ({}, FIXED_GAINS):
        config = load(None, {"control.start_mode": "closed"} | keys)
        loop = Bench(config, known)
        loop.run(round(duration_s * config.camera.rate_hz))
        assert loop.steps[round(3 * config.camera.rate_hz)].mode is LoopMode.CLOSED
        left_nm.append(rms_nm(loop, len(loop.truths) // 3)[0])
    assert left_nm[0] < 1.1 * left_nm[1]


def test_modes_that_are_left_alone_bring_less_noise_to_the_others(faint: Bench) -> None:
    drive = faint.state.drive
    left = drive.weighting.prior_nm2 > 0
    assert 0 < left.sum() < left.size
    np.testing.assert_array_equal(left, drive.law.gain == 0)
    own, made = (
        np.diag(
            noise_covariance_nm2(replace(drive.calibration, reconstructor=rows), faint.steps[-1].flux_dn, drive.camera)
        )
        for rows in (drive.calibration.reconstructor, drive.estimator.rows[:-1])
    )
    np.testing.assert_array_equal(made[left], own[left])
    assert (made[~left] < 1.0001 * own[~left]).all()
    assert (made[~left] < 0.9 * own[~left]).any()


def test_the_bank_knows_what_r_for_fewer_modes_shows_of_the_others(faint: Bench, of_own: list[Array | Single]) -> None:
    drive = faint.state.drive
    shown = drive.estimator.rows[:-1] @ drive.calibration.response
    np.testing.assert_array_equal(of_own[-1], shown[2:, 2:])
    assert np.abs(shown - np.eye(len(shown))).max() > 0.1


def test_the_command_of_a_mode_that_is_left_alone_relaxes_to_zero() -> None:
    """What an earlier gain put on the mirror does not stay there; at a gain of 0 that a person gave, it does."""
    loop = bench(0.0)
    loop.run(560)
    loop.ask("gain", modes=(4,), values=(0.0,))
    gain = gains(loop).copy()
    gain[5:] = 0
    loop.ask("gain", values=tuple(gain.tolist()), text="auto")
    before_nm = loop.steps[-1].command_nm
    loop.run(99)
    after_nm = loop.steps[-1].command_nm
    assert np.abs(before_nm[5:]).max() > 0.1
    np.testing.assert_allclose(after_nm[5:], before_nm[5:] * RELAXING**99, atol=1e-3)
    assert after_nm[2] == before_nm[2] != 0


def _contrast_of_open(magnitude: float, seed: int, frames: int) -> float:
    """What the loop leaves over what there is without it, in contrast, of a Zernike sensor under the wheel; late."""
    loop = bench(magnitude, "reaction-wheel", "zwfs", seed=seed)
    form = np.diag(factory.contrast_of(loop.config).form)
    loop.run(frames)
    truths = [truth.continuous for truth in loop.truths[-frames // 2 :]]
    left, open_ = (
        form @ np.mean(np.square(values), axis=0)
        for values in ([one.residual_nm for one in truths], [one.disturbance_nm for one in truths])
    )
    return float(left / open_)


def test_the_cross_talk_of_a_sensor_beyond_its_range_is_not_corrected() -> None:
    """The squares of the tilt that the wheel leaves look like focus, astigmatism and spherical to a Zernike sensor."""
    assert _contrast_of_open(2.0, 1, 1250) < 1


@pytest.mark.slow
def test_on_a_faint_star_its_cross_talk_is_seldom_corrected() -> None:
    """There it is hardly to be told from noise: which frames show it depends on how the host rounds."""
    assert sum(_contrast_of_open(8.0, seed, 2500) > 1 for seed in range(1, 7)) <= 1


def test_whoever_reads_the_state_goes_on_with_the_same_reconstructor(faint: Bench) -> None:
    drive = faint.state.drive
    message = controller_state(faint.state, faint.settings, 1)
    settings, again = decode_state(message, drive.calibration)
    assert settings == faint.settings
    np.testing.assert_array_equal(again.drive.estimator.rows, drive.estimator.rows)
    np.testing.assert_array_equal(again.drive.automatic, drive.automatic)
    np.testing.assert_array_equal(again.drive.law.kept, drive.law.kept)
    assert controller_state(again, settings, 1) == message


def test_whoever_reads_the_state_before_gains_are_measured_goes_on_with_the_same_law() -> None:
    """A loop may be closed by hand before that: what the mirror had before must go on as it does in a replay."""
    loop = bench(2.0)
    drive, message = loop.state.drive, controller_state(loop.state, loop.settings, 1)
    again = decode_state(message, drive.calibration)[1].drive
    np.testing.assert_array_equal(again.law.rows, drive.law.rows)


def test_tilt_is_compared_with_other_modes_as_the_sensor_saw_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """The square of an offset of tilt is in the image, though the loop's error is without it."""
    seen: list[Single] = []
    followed = TiltCrossTalk.followed

    def noted(self: TiltCrossTalk, tilt_nm: Single, open_nm: Array | Single) -> Array:
        seen.append(tilt_nm)
        return followed(self, tilt_nm, open_nm)

    monkeypatch.setattr(TiltCrossTalk, "followed", noted)
    loop = bench(2.0)
    loop.ask("offset", modes=(2,), values=(40.0,))
    loop.run(20)
    error_nm = loop.steps[-1].error_nm
    np.testing.assert_allclose(seen[-1], error_nm[:2] + np.float32([40, 0]), atol=1e-3)


def test_what_the_wavefront_adds_to_the_contrast_is_measured_open_and_closed() -> None:
    loop = bench(2.0)
    form = np.diag(factory.contrast_of(loop.config).form)

    def true(name: str, frames: int) -> float:
        truths = [getattr(truth.continuous, name) for truth in loop.truths[-frames:]]
        return float(form @ np.mean(np.square(truths), axis=0))

    assert loop.added_contrast() is None
    loop.run(1000)
    found = loop.added_contrast()
    flat, each = found
    assert flat == pytest.approx(true("disturbance_nm", 667), rel=0.3)
    assert 0.5 < each.sum() / true("residual_nm", 500) < 2  # a frame's noise is some ten times what is left
    loop.ask("open")
    loop.run(1)
    opened = loop.added_contrast()
    assert opened[1].sum() == pytest.approx(flat)


def test_gains_of_a_person_are_not_touched_and_harm_is_said_before_and_after() -> None:
    loop = bench(6.5, **FIXED_GAINS | {"control.start_mode": "open"})
    loop.run(500)
    assert "closing adds" in loop.closing_harm
    loop.ask("close")
    loop.run(850)
    assert named(loop, "CLOSING_HARMS")[0]["harm"].startswith("closing adds")
    assert named(loop, "LOOP_HARMS")[0]["action"] == "nothing is done"
    drive = loop.state.drive
    assert set(drive.law.gain.tolist()) == {np.float32(0.5), np.float32(0.05)}
    assert not named(loop, "GAINS_CHANGED")
    left_nm, open_nm = rms_nm(loop, 600)
    assert left_nm > open_nm


def test_a_loop_that_harms_opens_where_that_is_configured() -> None:
    loop = bench(6.5, **FIXED_GAINS | {"control.on_harm": "open"})
    loop.run(1150)
    assert loop.steps[-1].mode is LoopMode.OPEN
    assert named(loop, "MODE_CHANGED")[-1]["why"] == "auto: the loop made it worse"


@pytest.mark.parametrize("request_name", ["open", "pause"])
def test_what_an_operator_opens_while_gains_are_measured_stays_open(request_name: str) -> None:
    loop = bench(3.5)
    loop.run(100)
    loop.ask(request_name)
    loop.run(500)
    assert {step.mode for step in loop.steps} == {LoopMode.OPEN}
    assert gains(loop).any()  # measured all the same


def test_a_mode_can_be_given_a_gain_and_be_made_automatic_again() -> None:
    loop = bench(2.0)
    loop.run(510)
    loop.ask("gain", values=(0.3,), modes=(4,))
    loop.run(300)
    drive = loop.state.drive
    assert drive.law.gain[2] == np.float32(0.3)
    assert not drive.automatic[2]
    loop.ask("gain", text="auto", modes=(4,))
    assert loop.state.drive.automatic.all()


def test_another_star_lowers_the_gains_and_measures_them_anew() -> None:
    loop = bench(1.5)
    loop.run(560)
    bright = gains(loop)
    loop.star(3.0)
    loop.run(150)
    assert named(loop, "STAR_CHANGED")[0]["ratio"] == pytest.approx(0.25, rel=0.1)
    assert (gains(loop) <= 0.5 * bright).all()
    changed = len(named(loop, "GAINS_CHANGED"))
    loop.run(550)
    assert len(named(loop, "GAINS_CHANGED")) > changed
