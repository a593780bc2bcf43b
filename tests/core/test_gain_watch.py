"""Automatic gains and harm detection with diffraction images and photon noise, in one process."""

from dataclasses import replace
from functools import cache
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

from lowfc.adapters.files import factory
from lowfc.arrays import Array, Single
from lowfc.contract.codecs.state_codec import calibration_in_use, controller_state, decode_state
from lowfc.contract.configuration import FIXED_GAINS, Configuration, load
from lowfc.control.calibration.calibration import Calibration
from lowfc.control.calibration.map_reconstructor import map_rows, noise_covariance_nm2
from lowfc.control.laws.automatic_gain import FRAMES_PER_SUM, GainBank, TiltCrossTalk
from lowfc.control.laws.integrator import MAX_KEPT_UNCORRECTED, TIP_TILT
from lowfc.control.laws.linear_law import integrator
from lowfc.control.loop.advance import advance
from lowfc.control.loop.inputs import Input, Load, Request
from lowfc.control.loop.safety import LoopMode
from lowfc.control.loop.state import State
from lowfc.programs.core.gain_watch import MIN_FRAMES, GainWatch
from sim_camera.driver import scene
from tests.support.in_process_loop import SMALL_MIRROR
from tests.support.toy import CAMERA, FLUX_DN, feed, frame, frame_sequence, loaded, settings
from tests.support.toy import calibration as toy_calibration
from tools.law_bench import Bench, calibrated, configured
from tools.modal_bench import ModalBench

AUTO = {"control.tilt_gain": "auto", "control.gain": "auto"}


@cache
def calibration(magnitude: float, sensor: str) -> Calibration:
    return calibrated(configured(sensor, **{"camera.rate_hz": 250.0, "star.magnitude": magnitude}, **SMALL_MIRROR))


def configuration(magnitude: float, preset: str = "bench", sensor: str = "sam", **changed: Any) -> Configuration:
    star = {
        "camera.rate_hz": 250.0,
        "star.magnitude": magnitude,
        "disturbance.preset": preset,
        "control.start_mode": "closed",
    }
    return configured(sensor, **AUTO | star | SMALL_MIRROR | changed)


def bench(magnitude: float, preset: str = "bench", sensor: str = "sam", **changed: Any) -> Bench:
    return Bench(configuration(magnitude, preset, sensor, **changed), calibration(magnitude, sensor))


def modal_bench() -> ModalBench:
    """A loop simulated in modes, without images but with their noise, for tests of requests."""
    config = configuration(2.0)
    return ModalBench(config, factory.frame_noise_nm2(config, calibration(2.0, "sam")))


def details_of(loop: Bench, name: str) -> list[dict[str, object]]:
    """Details of all events of this name."""
    return [event.details for _, event in loop.events if event.name == name]


def mean_squares_nm2(loop: Bench, name: str, frames: int) -> Array:
    """Mean square (modes,), nm2, of the true `residual_nm` or `disturbance_nm` over the last frames."""
    return np.mean(np.square([getattr(truth.continuous, name) for truth in loop.truths[-frames:]]), axis=0)


def rms_nm(loop: Bench, frames: int) -> tuple[float, ...]:
    """True residual and disturbance over the last frames, nm rms."""
    names = ("residual_nm", "disturbance_nm")
    return tuple(float(np.sqrt(mean_squares_nm2(loop, name, frames).sum())) for name in names)


def gains(loop: Bench) -> Single:
    return loop.state.loop.integrator.gain


@pytest.fixture(scope="module")
def gain_bank_responses() -> list[Array | Single]:
    """Arguments of GainBank.use_reconstructor in the loop of the faint star."""
    return []


@pytest.fixture(scope="module")
def faint(gain_bank_responses: list[Array | Single]) -> Bench:
    """A loop on a faint star, after the frames in which it measured its gains and closed."""
    with patch.object(GainBank, "use_reconstructor", autospec=True, side_effect=GainBank.use_reconstructor) as used:
        loop = bench(6.5)
        loop.run(1200)
    gain_bank_responses += [call.args[1] for call in used.call_args_list]
    return loop


def test_gains_are_measured_in_open_loop_before_the_loop_is_closed(faint: Bench) -> None:
    modes = [step.mode for step in faint.steps]
    closed = modes.index(LoopMode.CLOSED)
    assert closed == 500  # first window: FIRST_S at 250 Hz
    assert set(modes[closed:]) == {LoopMode.CLOSED}
    assert details_of(faint, "MODE_CHANGED")[-1]["why"] == "auto: the gains were measured"
    assert len(details_of(faint, "GAINS_CHANGED")) >= 1


def test_closing_reduces_the_residual_on_a_faint_star(faint: Bench) -> None:
    """At V = 6.5 and 250 Hz, fixed gains of 0.5 and 0.05 would raise 18 nm rms of disturbance to some 47 nm rms."""
    residual_nm, open_nm = rms_nm(faint, 500)
    assert residual_nm < open_nm


@pytest.mark.parametrize("images", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_automatic_gains_leave_at_most_ten_percent_more_residual_than_fixed_gains(*, images: bool) -> None:
    """The loop is that of `make sim-loop`, with its default star and disturbance; the fixed gains are 0.5 and 0.05."""
    residual_nm, computed = [], calibrated(load(None))
    for keys in ({}, FIXED_GAINS):
        config = load(None, {"control.start_mode": "closed"} | keys)
        noise_nm2 = factory.frame_noise_nm2(config, computed)
        loop = Bench(config, computed) if images else ModalBench(config, noise_nm2)
        frames = round(20 * config.camera.rate_hz)
        loop.run(frames - frames // 3, record=False)
        loop.run(frames // 3)
        assert loop.steps[0].mode is LoopMode.CLOSED
        residual_nm.append(np.sqrt(np.square(loop.residual_nm()).sum(axis=1).mean()))
    assert residual_nm[0] < 1.1 * residual_nm[1]


def test_the_noise_of_tip_falls_to_a_quarter_if_only_tip_and_tilt_are_corrected() -> None:
    """Default sensor, V = 5, 1 kHz; each uncorrected mode has 1 nm rms."""
    config = load(None, {"star.magnitude": 5.0, "camera.rate_hz": 1000.0})
    computed = calibrated(config)
    prior_nm2 = 1.0 - np.isin(config.noll, TIP_TILT)
    (rows,) = map_rows(computed, prior_nm2, computed.flux_dn, computed.camera, computed.reconstructor)
    noise_nm = [
        float(np.sqrt(noise_covariance_nm2(calibration_, computed.flux_dn, computed.camera)[0, 0]))
        for calibration_ in (computed, replace(computed, reconstructor=rows))
    ]
    assert len(config.noll) == 14
    assert noise_nm == pytest.approx([42, 10], rel=0.02)


def test_leaving_modes_uncorrected_reduces_the_noise_of_the_other_modes(faint: Bench) -> None:
    active_loop = faint.state.loop
    uncorrected = active_loop.weighting.prior_nm2 > 0
    assert 0 < uncorrected.sum() < uncorrected.size
    np.testing.assert_array_equal(uncorrected, active_loop.integrator.gain == 0)
    state = controller_state(faint.state, faint.settings, 0)
    in_use = calibration_in_use(state, active_loop.calibration).reconstructor
    np.testing.assert_array_equal(in_use, active_loop.estimator.rows[:-1])
    # Modes (modes, modes) that the loop measures for the shape of each mode, nm per nm.
    measured_modes = active_loop.to_modes @ active_loop.calibration.modes_to_actuators
    np.testing.assert_allclose(measured_modes, in_use @ active_loop.calibration.response, atol=0.02)
    assert np.abs(measured_modes - np.eye(len(measured_modes))).max() > 0.1
    flux_dn, camera = faint.steps[-1].flux_dn, active_loop.camera
    original, reweighted = (
        np.diag(noise_covariance_nm2(replace(active_loop.calibration, reconstructor=rows), flux_dn, camera))
        for rows in (active_loop.calibration.reconstructor, active_loop.estimator.rows[:-1])
    )
    np.testing.assert_array_equal(reweighted[uncorrected], original[uncorrected])
    assert (reweighted[~uncorrected] < 1.0001 * original[~uncorrected]).all()
    assert (reweighted[~uncorrected] < 0.9 * original[~uncorrected]).any()


def test_the_gain_bank_receives_the_response_of_the_reweighted_reconstructor(
    faint: Bench, gain_bank_responses: list[Array | Single]
) -> None:
    active_loop = faint.state.loop
    response = active_loop.estimator.rows[:-1] @ active_loop.calibration.response
    np.testing.assert_allclose(gain_bank_responses[-1], response[2:, 2:], atol=1e-4)
    assert np.abs(response - np.eye(len(response))).max() > 0.1


def test_the_command_of_a_mode_with_automatic_gain_zero_relaxes_to_zero() -> None:
    """With a manual gain of 0, the command stays."""
    loop = modal_bench()
    loop.run(560)
    loop.ask("gain", modes=(4,), values=(0.0,))
    gain = gains(loop).copy()
    gain[5:] = 0
    loop.ask("gain", values=tuple(gain.tolist()), text="auto")
    before_nm = loop.steps[-1].command_nm
    loop.run(99)
    after_nm = loop.steps[-1].command_nm
    assert np.abs(before_nm[5:]).max() > 0.1
    np.testing.assert_allclose(after_nm[5:], before_nm[5:] * MAX_KEPT_UNCORRECTED**99, atol=1e-3)
    assert after_nm[2] == before_nm[2] != 0


def _contrast_relative_to_open_loop(magnitude: float, seed: int, frames: int) -> float:
    """Contrast of the residual / that of the reaction wheels, in the second half of a run with a Zernike sensor."""
    loop = bench(magnitude, "reaction-wheel", "zwfs", seed=seed)
    form = np.diag(factory.contrast_of(loop.config).form)
    loop.run(frames - frames // 2, record=False)
    loop.run(frames // 2)
    residual, disturbance = (
        form @ mean_squares_nm2(loop, name, frames // 2) for name in ("residual_nm", "disturbance_nm")
    )
    return float(residual / disturbance)


def test_closing_reduces_the_added_contrast_on_a_zernike_sensor_beyond_its_linear_range() -> None:
    """The square of the residual tilt looks like focus, astigmatism and spherical aberration to a Zernike sensor."""
    assert _contrast_relative_to_open_loop(2.0, 1, 1250) < 1


@pytest.mark.slow
def test_closing_seldom_adds_contrast_on_a_faint_star_with_a_zernike_sensor() -> None:
    """The cross-talk is close to the noise: whether it is detected depends on the host's rounding."""
    assert sum(_contrast_relative_to_open_loop(8.0, seed, 2500) > 1 for seed in range(1, 7)) <= 1


def test_a_decoded_state_has_the_same_reconstructor(faint: Bench) -> None:
    active_loop = faint.state.loop
    message = controller_state(faint.state, faint.settings, 1)
    settings, decoded = decode_state(message, active_loop.calibration)
    assert settings == faint.settings
    np.testing.assert_array_equal(decoded.loop.estimator.rows, active_loop.estimator.rows)
    np.testing.assert_array_equal(decoded.loop.automatic, active_loop.automatic)
    np.testing.assert_array_equal(decoded.loop.integrator.kept, active_loop.integrator.kept)
    assert controller_state(decoded, settings, 1) == message


def test_a_state_decoded_before_gains_are_measured_has_the_same_law() -> None:
    """An operator may close the loop before the gains are measured; a replay must then give the same commands."""
    loop = bench(2.0)
    active_loop, message = loop.state.loop, controller_state(loop.state, loop.settings, 1)
    decoded_loop = decode_state(message, active_loop.calibration)[1].loop
    np.testing.assert_array_equal(decoded_loop.integrator.rows, active_loop.integrator.rows)


def test_tilt_cross_talk_uses_the_tilt_on_the_sensor_including_the_offset() -> None:
    """The image has the cross-talk of the whole tilt, but the loop's error excludes the offset."""
    with patch.object(TiltCrossTalk, "add_frames", autospec=True, side_effect=TiltCrossTalk.add_frames) as added:
        loop = bench(2.0)
        loop.ask("offset", modes=(2,), values=(40.0,))
        loop.run(2 * FRAMES_PER_SUM)
    _, tilt_nm, _ = added.call_args.args
    np.testing.assert_allclose(tilt_nm[-1], loop.steps[-1].error_nm[:2] + np.float32([40, 0]), atol=1e-3)


def test_added_contrast_is_measured_in_open_and_closed_loop() -> None:
    # A bright star: at V = 2 the noise of a frame is some ten times the residual, so the estimate varies by 4.
    loop = bench(-1.0)
    form = np.diag(factory.contrast_of(loop.config).form)

    def true_contrast(name: str, frames: int) -> float:
        return float(form @ mean_squares_nm2(loop, name, frames))

    assert loop.watch.added_contrast() is None
    loop.run(333, record=False)
    loop.run(667)
    uncorrected, by_mode = loop.watch.added_contrast()
    assert uncorrected == pytest.approx(true_contrast("disturbance_nm", 667), rel=0.3)
    assert 0.5 < by_mode.sum() / true_contrast("residual_nm", 500) < 2
    loop.ask("open")
    loop.run(1)
    _, opened_by_mode = loop.watch.added_contrast()
    assert opened_by_mode.sum() == pytest.approx(uncorrected)


def test_manual_gains_are_kept_and_harm_is_reported_before_and_after_closing() -> None:
    loop = bench(6.5, **FIXED_GAINS | {"control.start_mode": "open"})
    loop.run(500, record=False)
    assert "closing adds" in loop.watch.closing_harm
    loop.ask("close")
    loop.run(250, record=False)
    loop.run(600)
    assert details_of(loop, "CLOSING_HARMS")[0]["harm"].startswith("closing adds")
    assert details_of(loop, "LOOP_HARMS")[0]["action"] == "nothing is done"
    active_loop = loop.state.loop
    assert set(active_loop.integrator.gain.tolist()) == {np.float32(0.5), np.float32(0.05)}
    assert not details_of(loop, "GAINS_CHANGED")
    residual_nm, open_nm = rms_nm(loop, 600)
    assert residual_nm > open_nm


def harmful_loop(on_harm: str) -> ModalBench:
    """A closed loop that increases the residual; harm is reported after its third window, at frame 1000."""
    config = configuration(6.5, **FIXED_GAINS | {"control.on_harm": on_harm})
    return ModalBench(config, factory.frame_noise_nm2(config, calibration(6.5, "sam")))


@pytest.mark.parametrize("on_harm", ["open", "integrator"])
def test_a_harmful_loop_without_a_law_opens_if_configured(on_harm: str) -> None:
    loop = harmful_loop(on_harm)
    loop.run(1150)
    assert [event["action"] for event in details_of(loop, "LOOP_HARMS")] == ["the loop opens"]
    assert loop.state.mode is LoopMode.OPEN
    assert details_of(loop, "MODE_CHANGED")[-1]["why"] == "auto: the loop increased the residual"


def test_the_integrator_takes_over_from_a_harmful_law_once_the_loop_is_not_reserved() -> None:
    loop = harmful_loop("integrator")
    law = loop.settings.integrator(loop.config.noll)
    loop.ask("law", law=integrator(law.gain, law.leak, loop.config.noll, loop.settings.delay_frames, 250.0))
    loop.run(100)
    loop.process_input(Request(loop.steps[-1].time_ns, "lease", (), (60.0,), "another client", lease_id=1))
    loop.run(1000)
    assert [event["action"] for event in details_of(loop, "LOOP_HARMS")] == ["the integrator takes over"]
    assert loop.state.loop.law_runner is not None, "the lease lets no request of the gain watch pass"
    loop.ask("release", lease_id=1)
    loop.run(700)
    assert loop.state.loop.law_runner is None
    assert loop.state.mode is LoopMode.CLOSED


@pytest.mark.parametrize("request_name", ["open", "pause"])
def test_a_loop_opened_by_an_operator_while_gains_are_measured_stays_open(request_name: str) -> None:
    loop = modal_bench()
    loop.run(100)
    loop.ask(request_name)
    loop.run(500)
    assert {step.mode for step in loop.steps} == {LoopMode.OPEN}
    assert gains(loop).any()  # the gains were measured nevertheless


def test_a_mode_can_have_a_manual_gain_and_return_to_automatic() -> None:
    loop = modal_bench()
    loop.run(510)
    loop.ask("gain", values=(0.3,), modes=(4,))
    loop.run(300)
    active_loop = loop.state.loop
    assert active_loop.integrator.gain[2] == np.float32(0.3)
    assert not active_loop.automatic[2]
    loop.ask("gain", text="auto", modes=(4,))
    assert loop.state.loop.automatic.all()


def test_a_truncated_reconstructor_with_a_singular_R_H_is_weighted() -> None:
    setup, R = settings(auto_gain=(True, True)), toy_calibration().reconstructor * np.array([[1], [1], [0]], np.float32)
    load = Load(0, replace(toy_calibration(), reconstructor=R), "test")
    request = Request(0, "gain", (), (0.0, 0.4, 0.1), "auto", prior_nm2=(4.0, 0.0, 0.0), flux_dn=FLUX_DN)
    state, all_outputs = feed(setup, State(), CAMERA, load, request, frame(1))
    assert state.loop.weighting is not None
    assert GainWatch(setup, "warn").observe(all_outputs[-1].step, state).requests == ()


def requests_of_watch(*inputs: Input) -> list[str]:
    """Names of the requests of the gain watch for these inputs to a toy loop with automatic gains."""
    setup = settings(auto_gain=(True, True), start_mode=LoopMode.OPEN)
    watch, state, requested = GainWatch(setup, "warn"), loaded(setup), []
    for input_ in inputs:
        state, outputs = advance(setup, state, input_)
        if outputs.step is not None:
            requested += [request.name for request in watch.observe(outputs.step, state).requests]
    return requested


@pytest.mark.parametrize(
    "between",
    [
        [frame(1 << 30, ahead=True)],
        [frame(5)],
        [frame(0, sequence=2 * frame_sequence(0)), Request(0, "safe"), Request(1, "clear"), Request(2, "open")],
    ],
    ids=["ahead", "out of order", "a clear, then a camera with lower sequences"],
)
def test_frames_out_of_sequence_do_not_prevent_the_measurement_of_gains(between: list[Input]) -> None:
    first = [frame(count) for count in range(1, 11)]
    later = [frame(count) for count in range(11, 11 + MIN_FRAMES)]
    assert "gain" in requests_of_watch(*first, *between, *later)


def test_a_fainter_star_lowers_the_gains_and_restarts_their_measurement() -> None:
    loop = bench(2.0)
    loop.run(560, record=False)
    gains_before = gains(loop)
    loop.scene = scene(configuration(3.5))
    loop.run(150, record=False)
    assert details_of(loop, "STAR_CHANGED")[0]["ratio"] == pytest.approx(0.25, rel=0.1)
    assert (gains(loop) <= 0.5 * gains_before).all()
    changes = len(details_of(loop, "GAINS_CHANGED"))
    loop.run(550, record=False)
    assert len(details_of(loop, "GAINS_CHANGED")) > changes
