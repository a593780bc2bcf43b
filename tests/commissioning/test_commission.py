"""`lowfc commission` on a loop in one process, and the checks that camera and configuration agree."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from lowfc.adapters.files import calibration_file
from lowfc.arrays import single
from lowfc.contract.codecs.calibration_codec import camera_settings, with_identity
from lowfc.contract.configuration import Configuration, Control
from lowfc.contract.errors import BusError, CalibrationError, DataFileError, RequestRefusedError
from lowfc.contract.messages import wire
from lowfc.contract.sections import Camera
from lowfc.control.calibration.alignment import Geometry, onto
from lowfc.control.calibration.delay_fit import Delay
from lowfc.device.driver import CameraSettings, camera_state
from lowfc.programs.commissioning.calibrate import pokes
from lowfc.programs.commissioning.calibrate.run import partial_path
from lowfc.programs.commissioning.checks import Status
from lowfc.programs.commissioning.commission import commissioning
from lowfc.programs.commissioning.commission.commissioning import Commissioning, CommissionOptions, provisional_path
from lowfc.programs.commissioning.commission.first_calibration import aligned_calibration, linear_amplitude_nm
from lowfc.programs.commissioning.commission.first_light import Sensor, calibration_with_reference
from lowfc.programs.commissioning.conformance.settings import AGREEMENTS, Agreement, agreement_checks
from tests.support.in_process_loop import SMALL_MIRROR, InProcessLoop, calibration_of, configuration
from tests.support.loops import refusal
from tests.support.theory import LAWS

KEYS = {"star.magnitude": 0.0, "camera.rate_hz": 100, "camera.instants": 1, "camera.bit_depth": 14, "control.gain": 0.2}
configured = partial(configuration, SMALL_MIRROR | KEYS)
CONFIG = configured()
DISTURBED = configured(sensor__modes=3)
"""Few modes, so that a cycle is short; default disturbance."""
QUIET = configured(sensor__modes=3, disturbance__preset="quiet")
NOISELESS = configured(sensor__modes=3, disturbance__preset="quiet", camera__noise=False)
"""For tests that do not depend on noise: without noise, computing a frame takes half the time."""


class Bench:
    """A loop without a calibration, and the results, reports and questions of its commissioning."""

    def __init__(self, folder: Path, config: Configuration = QUIET) -> None:
        self.config, self.out = config, folder / "calibration.fits"
        self.loop = InProcessLoop(config, cut=8)
        self.loop.run(5)
        self.results: dict[str, Any] = {}
        self.reports: list[str] = []
        self.frames_before: dict[str, int] = {}
        self.questions: list[str] = []
        self.actions: dict[str, Callable[[], None]] = {}

    def report(self, text: str) -> None:
        """Store a report and the number of frames exposed before it; run each action whose key begins the report."""
        self.reports.append(text)
        self.frames_before.setdefault(text, len(self.loop.surfaces_nm))
        for start, action in self.actions.items():
            if text.startswith(start):
                action()

    def commissioning(self, *, model: Configuration | None = None, **options: Any) -> Commissioning:
        defaults = {"dark": None, "no_dark": True, "frames": 100, "snr": None, "cycles": 4, "resume": False}
        return Commissioning(
            self.loop,
            self.config,
            calibration_of((model or self.config).to_toml()),
            CommissionOptions(self.out, **{**defaults, "close": True, **options}),
            self.report,
            lambda what, done, total: None,
            self.questions.append,
        )

    def commission(self, **options: Any) -> dict[str, Any]:
        with self.loop.reserved("a test"):
            results, _ = self.commissioning(**options).run()
        return results

    @property
    def report_text(self) -> str:
        return "\n".join(self.reports)


@pytest.fixture(scope="module", autouse=True)
def _few_frames() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(commissioning, "MIN_RESIDUAL_FRAMES", 200)
        patch.setattr(pokes, "DELAY_FRAMES", 240)
        yield


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    """A commissioned bench with the results of its commissioning."""
    bench = Bench(tmp_path_factory.mktemp("bench"), DISTURBED)
    bench.results = bench.commission(cycles=6)
    return bench


def test_commissioning_closes_a_loop_whose_frames_have_another_size_than_the_model(bench: Bench) -> None:
    assert bench.results["recommended"]
    assert bench.results["measured_error_nm"] == pytest.approx(bench.results["predicted_error_nm"], rel=0.15)
    state = bench.loop.status().state
    assert state.mode == wire.LOOP_MODE_CLOSED
    assert list(state.gain) == pytest.approx([0.1, 0.1, 0.2])
    assert list(state.automatic) == [True, True, False]
    calibration = calibration_file.load(bench.out)
    assert calibration.shape == (64, 64)
    # Measured and computed matrix agree for every mirror shape, not only for the shapes of the modes.
    modelled = calibration_of(DISTURBED.to_toml()).actuators_to_modes
    assert np.linalg.norm(calibration.actuators_to_modes - modelled) < 0.2 * np.linalg.norm(modelled)
    assert calibration.saturation_dn == 2**14 - 1
    assert not provisional_path(bench.out).exists()
    assert not partial_path(bench.out).exists()


@pytest.mark.parametrize(("scatter", "chosen_nm"), [(0.0, 1.5), (0.2, 3.0)])
def test_a_scatter_of_the_gains_is_not_mistaken_for_nonlinearity(scatter: float, chosen_nm: float) -> None:
    """The mean gain of Z3 is 20 % lower for the larger poke; whether that is significant depends on the scatter."""
    first, gains = calibration_of(CONFIG.to_toml()), np.ones((4, 14))
    gains[:, 1] = 0.8 + scatter / 2, 0.8 - scatter / 2, 1 + scatter / 2, 1 - scatter / 2
    gains_of_cycles = iter(gains)

    def cycle(*played: object) -> SimpleNamespace:
        return SimpleNamespace(response=first.response * next(gains_of_cycles))

    player: Any = SimpleNamespace(in_use=first, cycle=cycle, report=lambda text: None)
    delay: Any = SimpleNamespace(delay_frames=1.0)
    assert linear_amplitude_nm(player, CONFIG, delay, 3.0) == chosen_nm


def test_the_loop_holds_the_wavefront_of_the_reference_image(bench: Bench) -> None:
    bench.loop.run(200)
    closed_nm = bench.loop.residual_nm(-200)
    begin, end = bench.frames_before["[7/10] response"], bench.frames_before["[8/10] verdict"]
    reference_nm = bench.loop.residual_nm(begin, end).mean(axis=0)
    assert np.abs(reference_nm).max() > 5, "the reference is far from flat"
    assert closed_nm.mean(axis=0) == pytest.approx(reference_nm, abs=1.0)  # the tilts scatter by 3 nm
    true_error_nm = np.sqrt(closed_nm.var(axis=0).sum())
    assert true_error_nm < bench.results["measured_error_nm"], "the measured error includes noise"


def test_without_close_the_residual_is_only_predicted(bench: Bench) -> None:
    bench.loop.open_loop()
    before = bench.loop.status().state
    text = bench.commissioning(close=False)._predict_and_close(1.0)
    assert "predicted error with noise in closed loop, at a gain of 0.1 in place of automatic gains: " in text
    assert "`lowfc ctl close` closes the loop" in text
    after = bench.loop.status().state
    assert (after.mode, after.gain, after.automatic) == (wire.LOOP_MODE_OPEN, before.gain, before.automatic)
    open_nm = np.array([step.pol_nm for step in bench.loop.steps(300)])
    assert bench.results["predicted_error_nm"] < 0.7 * np.sqrt(np.square(open_nm).sum(axis=1).mean())
    bench.actions = {"observing": bench.loop.open_loop}
    with pytest.raises(CalibrationError, match="the loop went from closed to open"):
        bench.commissioning()._measured_nm(10, 1, 1.0)
    bench.actions.clear()
    errors_nm = np.where(np.arange(2000) == 1500, np.nan, 1.0)[:, None]
    assert commissioning._rms_nm(errors_nm, 1000) == 1.0, "one refused frame is left out"


@pytest.mark.parametrize("reversed_modes", [[0], [0, 1, 2]])
def test_modes_of_wrong_sign_fail_the_check_of_the_closed_loop(bench: Bench, reversed_modes: list[int]) -> None:
    bench.loop.open_loop()
    good = bench.loop.calibration()
    R = good.reconstructor.copy()
    R[reversed_modes] *= -1
    bench.loop.load(with_identity(replace(good, reconstructor=R)))
    attempt = bench.commissioning()
    with bench.loop.reserved("a test"), pytest.raises(CalibrationError, match=r"nm rms, but .* was predicted"):
        attempt._predict_and_close(1.0)
    advice = attempt._how_to_continue(None)
    assert "is saved in" in advice
    assert "the closed loop did not behave as predicted: check the sign" in advice
    assert "`lowfc ctl reset` removes the loop's command from the mirror" in advice
    state = bench.loop.status().state
    assert (state.mode, list(state.automatic)) == (wire.LOOP_MODE_OPEN, [True, True, False])
    bench.loop.load(good)
    bench.loop.reset()
    bench.loop.run(20)


def test_the_residual_of_a_loaded_linear_law_is_predicted(bench: Bench) -> None:
    bench.loop.open_loop()
    law = replace(LAWS["pi"], rate_hz=100.0)
    bench.loop.law(law)
    before = bench.loop.status().state
    attempt = bench.commissioning()
    with bench.loop.reserved("a test"):
        attempt._predict_and_close(1.0)
    assert attempt._results["measured_error_nm"] == pytest.approx(attempt._results["predicted_error_nm"], rel=0.15)
    assert attempt._results["predicted_error_nm"] < 0.9 * bench.results["predicted_error_nm"]
    after = bench.loop.status().state
    assert (after.law.id, after.gain, after.automatic) == (law.id, before.gain, before.automatic)
    bench.loop.open_loop()
    bench.loop.law(None)


@pytest.mark.parametrize(
    ("snr", "cycles", "required_snr"), [(None, None, 50.0), (None, 6, 20.0), (40.0, None, 40.0), (40.0, 6, 40.0)]
)
def test_the_default_signal_to_noise_ratio_is_lower_if_the_number_of_cycles_is_set(
    bench: Bench, snr: float | None, cycles: int | None, required_snr: float
) -> None:
    request = bench.commissioning(snr=snr, cycles=cycles)._request()
    assert (request.snr, request.cycles) == (required_snr, cycles)


@pytest.mark.parametrize(("noise", "poked"), [(0.0, [1]), (0.3, [])], ids=["the configured sensor", "another sensor"])
def test_z3_is_poked_to_find_a_reflection_if_the_image_is_like_the_model(noise: float, poked: list[int]) -> None:
    """With noise that differs from pixel to pixel, the image is like that of another sensor."""
    config = configured(sensor__kind="clowfs", sensor__modes=3)
    first, geometry = calibration_of(config.to_toml()), Geometry(1.0, 40.2, 39.5, 12.0, -1)
    H = onto(first.response.astype(float).reshape(80, 80, 3), geometry, (80, 80)).reshape(-1, 3)
    image = onto(first.reference.astype(float).reshape(80, 80), geometry, (80, 80)).reshape(-1)
    image *= 1 + noise * np.random.default_rng(1).standard_normal(image.size)
    first_poke = Mock(side_effect=lambda mode, plan: Delay(1.0, 0.1, H[:, mode]))
    before = replace(first, reference=single(image))
    player: Any = SimpleNamespace(in_use=before, report=lambda text: None, first_poke=first_poke)
    results: dict[str, Any] = {}
    aligned_calibration(player, config, first, Delay(1.0, 0.1, H[:, 0]), results)
    assert [call.args[0] for call in first_poke.call_args_list] == poked
    assert results.get("parity") == (-1 if poked else None)


@pytest.mark.slow
def test_a_sensor_unlike_the_configured_one_is_measured_without_the_model(tmp_path: Path) -> None:
    """The optical model of another sensor provides only the modes and the mirror's commands."""
    bench = Bench(tmp_path, CONFIG)
    results = bench.commission(model=configured(sensor__kind="clowfs"), close=False, snr=30.0, cycles=None)
    assert "without the optical model" in bench.report_text or "cannot be compared" in bench.report_text
    assert results["recommended"]


def test_a_resumed_commissioning_continues_and_reports_an_operator_who_opens_the_loop(tmp_path: Path) -> None:
    bench = Bench(tmp_path, NOISELESS)
    bench.loop.ask("stop")
    ask = bench.loop.ask

    def interrupted(name: str, **fields: Any) -> Any:
        if "[7/10] response" in bench.reports and partial_path(bench.out).exists():
            raise KeyboardInterrupt
        return ask(name, **fields)

    bench.loop.ask = interrupted
    with pytest.raises(KeyboardInterrupt):
        bench.commission()
    bench.loop.ask = ask
    bench.loop.ask("release", lease_id=1)
    assert provisional_path(bench.out).exists()
    assert "without a verdict" in bench.report_text
    assert "has no verdict" in bench.loop.ask("close", lease_id=0).reply
    bench.loop.ask("open", lease_id=0)
    bench.reports.clear()

    def somebody_opens() -> None:
        if "[10/10] closed loop" in bench.reports:
            bench.loop.run(20)
            bench.loop.ask("open", lease_id=0)

    bench.actions = {"observing": somebody_opens}
    with pytest.raises(CalibrationError, match="the lease ended: operator asked to open"):
        bench.commission(resume=True)
    assert "[1/10]" not in bench.report_text
    assert "continuing after" in bench.report_text
    assert "the calibration is good" in bench.report_text
    assert "`lowfc ctl gain auto --modes 2,3` makes them automatic again" in bench.report_text
    state = bench.loop.status().state
    assert (state.mode, state.calibration_id) == (wire.LOOP_MODE_OPEN, calibration_file.load(bench.out).id)


def test_a_commissioning_is_not_resumed_with_other_modes_or_commands(tmp_path: Path) -> None:
    bench, same = Bench(tmp_path, NOISELESS), calibration_of(NOISELESS.to_toml())
    for other in (
        calibration_of(CONFIG.to_toml()),
        with_identity(replace(same, modes_to_actuators=-same.modes_to_actuators)),
    ):
        calibration_file.save(other, provisional_path(bench.out))
        with pytest.raises(CalibrationError, match="other modes or mirror commands than the configuration"):
            bench.commission(resume=True)


def test_a_failed_commissioning_restores_the_previous_calibration(bench: Bench) -> None:
    before = bench.loop.calibration().id
    partial_path(bench.out).touch()
    for step, why in ("[6/10] poke", "the previous calibration is in use again"), ("[3/10]", "no calibration was"):
        bench.actions = {step: Mock(side_effect=KeyboardInterrupt)}
        with pytest.raises(KeyboardInterrupt):
            bench.commission()
        assert bench.loop.calibration().id == before
        assert why in bench.reports[-1]
    bench.actions.clear()
    assert not partial_path(bench.out).exists(), "a new commissioning removes the cycles of a former one"


def test_a_finished_commissioning_cannot_be_resumed(bench: Bench) -> None:
    provisional_path(bench.out).unlink(missing_ok=True)
    with pytest.raises(CalibrationError, match="nothing to resume"):
        bench.commission(resume=True)


@pytest.mark.parametrize("options", [(), ("--resume",)])
def test_without_a_terminal_nobody_is_asked_to_block_the_star(options: tuple[str, ...], tmp_path: Path) -> None:
    refused = refusal("commission", "--out", tmp_path / "calibration.fits", *options)
    assert "without a terminal nobody can be asked" in refused


def test_the_operator_is_asked_to_block_and_unblock_the_star(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    with pytest.raises(CalibrationError, match="was it not blocked for the dark"):
        bench.commission(no_dark=False)
    assert bench.questions == ["block the star; is it dark?", "unblock the star; is it visible?"]


def test_a_hot_pixel_at_full_well_is_not_mistaken_for_the_star() -> None:
    camera, frames = camera_settings(configured_camera(CONFIG)), np.full((16, 80, 80), 200)
    frames[:, 0, 0] = camera.saturation_dn
    sensor = Sensor(camera, np.full(6400, 100.0), (np.arange(6400) > 0).astype(float), measured=False)
    assert calibration_with_reference(sensor, frames, calibration_of(CONFIG.to_toml()), str).flux_dn == 6399 * 100
    with pytest.raises(CalibrationError, match="the brightest good pixel is at 16383 of 16383 DN"):
        calibration_with_reference(sensor._replace(good=np.ones(6400)), frames, calibration_of(CONFIG.to_toml()), str)


def test_a_camera_that_differs_from_the_configuration_is_refused(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.config = configured(camera__rate_hz=250.0, camera__gain_e_per_dn=3.0, control__frame_timeout_ms=12.0)
    with pytest.raises(CalibrationError) as caught:
        bench.commission()
    for key in ("camera.rate_hz", "camera.gain_e_per_dn", "control.frame_timeout_ms"):
        assert f"{key}: the camera has" in str(caught.value)
    assert not bench.out.exists()


def test_commissioning_is_refused_in_safe_mode(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.loop.ask("safe")
    with pytest.raises(RequestRefusedError, match="safe mode"):
        bench.commission()


def configured_camera(config: Configuration) -> wire.CameraState:
    return camera_state(CameraSettings.configured(config, 80, 80), 1)


def faults(config: Configuration, state: wire.CameraState) -> dict[str, Status]:
    """Statuses of the checks that are not OK, by field of the camera's state or key of the configuration."""
    checks = agreement_checks(config, state)
    return {check.name.split(" ")[0]: check.status for check in checks if check.status is not Status.OK}


@pytest.mark.parametrize("em_gain", [1.0, 300.0])
@pytest.mark.parametrize("bits", [12, 16])
def test_the_simulated_camera_agrees_with_its_configuration(em_gain: float, bits: int) -> None:
    config = Configuration(camera=Camera(em_gain=em_gain, bit_depth=bits, full_well_e=2_000.0))
    assert faults(config, configured_camera(config)) == {}


@pytest.mark.parametrize("agreement", AGREEMENTS, ids=lambda agreement: agreement.field)
def test_a_difference_between_camera_and_configuration_is_found(agreement: Agreement) -> None:
    state = configured_camera(Configuration())
    setattr(state, agreement.field, 2 * getattr(state, agreement.field))
    status = faults(Configuration(), state)[agreement.field]
    assert status is (Status.WRONG if agreement.disturbs_loop else Status.WARNING)


def test_an_existing_calibration_is_replaced_only_with_force(own_runtime: Path) -> None:
    out = own_runtime / "calibration.fits"
    out.write_text("mine")
    assert "already exists" in refusal("commission", "--no-dark", "--out", out, kind=DataFileError)
    for option in ("--force", "--resume"):
        refusal("commission", "--no-dark", "--out", out, option, kind=BusError)  # there is no loop to join
    assert out.read_text() == "mine"


@pytest.mark.parametrize(
    ("rate_hz", "age_ms", "timeout_ms"),
    [(1000, 20, 50), (250, 20, 50), (100, 20, 50), (50, 40, 100), (5, 400, 1000)],
)
def test_the_default_frame_age_and_timeout_depend_on_the_rate(rate_hz: float, age_ms: float, timeout_ms: float) -> None:
    config = Configuration(camera=Camera(rate_hz=rate_hz))
    assert (config.max_frame_age_ns, config.frame_timeout_ns) == (age_ms * 1e6, timeout_ms * 1e6)
    assert "control.frame_timeout_ms" not in faults(config, configured_camera(config))


def test_a_configured_frame_age_and_frame_timeout_apply_and_are_checked() -> None:
    config = Configuration(camera=Camera(rate_hz=20.0), control=Control(max_frame_age_ms=7.0, frame_timeout_ms=50.0))
    assert (config.max_frame_age_ns, config.frame_timeout_ns) == (7_000_000, 50_000_000)
    assert faults(config, configured_camera(config)) == {"control.frame_timeout_ms": Status.WRONG}
