"""What-ifs of logs: comparison with runs that had the same gains, warnings, and errors in options."""

import json
import re
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from lowfc.adapters.files import calibration_file, factory
from lowfc.adapters.logs.columns import Steps
from lowfc.adapters.logs.history import History, read_history
from lowfc.adapters.logs.reader import LogReader
from lowfc.adapters.logs.records import Damage
from lowfc.contract.codecs.calibration_codec import wire_camera, with_identity
from lowfc.contract.codecs.state_codec import calibration_in_use
from lowfc.contract.configuration import Configuration, load
from lowfc.contract.errors import CalibrationError, ConfigurationError, DataFileError
from lowfc.contract.messages import wire
from lowfc.control.calibration.calibration import reconstructor
from lowfc.control.laws.stability import delay_weights, limiting_gain
from lowfc.control.laws.what_if import counterfactual, limited_integrator, rms
from lowfc.control.loop.inputs import Outputs
from lowfc.control.loop.safety import Limit, LoopMode, Rejection
from lowfc.control.loop.state import State
from lowfc.optics.chain.added_contrast import contrast_form
from lowfc.optics.chain.coronagraph import Coronagraph
from lowfc.optics.detector.photometry import tilt_nm_per_mas
from lowfc.programs.cli.contrast import added_contrast, added_contrast_in_words
from lowfc.programs.logs.what_if.compare import LINEAR_WAVES, render, what_if
from lowfc.programs.logs.what_if.options import WhatIf, requested_changes, user_controller
from lowfc.programs.logs.what_if.run import LoggedRun
from tests.support import toy
from tests.support.in_process_loop import SMALL_MIRROR, configuration, run_loop
from tests.support.report_log import SyntheticLog
from tools.law_bench import calibrated

RATE_HZ = 250
Gains = tuple[float, float, float]
"""Gain of both tilts and gain of the other modes, as fractions of the highest stable gain; leak of all modes."""

HIGH_TILT_GAIN, LOW_TILT_GAIN, LEAKY = (0.45, 0.03, 0.0), (0.1, 0.35, 0.0), (0.5, 0.02, 0.03)


def configured(gains: Gains, delay: float, **overrides: object) -> Configuration:
    tilt_gain, gain, leak = gains
    highest = limiting_gain(np.ceil(delay))
    keys = {
        "camera.rate_hz": RATE_HZ,
        "camera.delay_frames": delay,
        "disturbance.preset": "reaction-wheel",
        "disturbance.scale": 0.3,
        "control.start_mode": "closed",
        "control.tilt_gain": tilt_gain * highest,
        "control.gain": gain * highest,
        "control.tilt_leak": leak,
        "control.leak": leak,
    }
    return configuration(SMALL_MIRROR | keys, **overrides)


def settled_rms(values: np.ndarray) -> np.ndarray:
    return rms(values, np.arange(len(values)) >= RATE_HZ)


def predicted_errors(run: SimpleNamespace, config: Configuration) -> np.ndarray:
    """Modal errors (frames, modes), nm, that the run would have had with the gains and leaks of a configuration."""
    settings = factory.settings(config)
    weights = delay_weights(settings.delay_frames).astype(np.float32)
    pol_nm = run.pol_nm.astype(np.float32)
    law = settings.integrator(config.noll)
    return counterfactual(limited_integrator(law), weights, pol_nm, np.zeros(len(pol_nm), np.int64))[0]


BENCH = {"disturbance__preset": "bench", "disturbance__scale": 0.7}


@pytest.mark.parametrize(
    ("frames", "pair", "delay", "tolerance_nm", "overrides"),
    [
        # By noise alone, the rms of a mode differs by 2.4 % between two such runs, by up to 8 % in twelve comparisons.
        (2000, (LOW_TILT_GAIN, LEAKY), 2, 0.0, {}),
        *(
            pytest.param(4000, pair, delay, 0.0, overrides, marks=pytest.mark.slow)
            for pair in ((HIGH_TILT_GAIN, LOW_TILT_GAIN), (LOW_TILT_GAIN, LEAKY))
            for delay in (1, 1.4, 2, 3)
            for overrides in ({}, BENCH)
        ),
        # Without noise, the only error of some modes is 0.1 nm of cross-talk from a tilt near 5 mas.
        *(
            pytest.param(2000, pair, 1, 0.1, {"camera__noise": False}, marks=pytest.mark.slow)
            for pair in ((HIGH_TILT_GAIN, LOW_TILT_GAIN), (LOW_TILT_GAIN, LEAKY))
        ),
    ],
)
def test_in_the_linear_range_a_what_if_agrees_with_a_run_with_the_same_gains(
    frames: int, pair: tuple[Gains, Gains], delay: float, tolerance_nm: float, overrides: dict[str, Any]
) -> None:
    """A what-if with the run's own law reproduces its errors; with another run's law, it predicts their rms to 10 %."""
    configs = [configured(gains, delay, **overrides) for gains in pair]
    calibration = calibrated(configs[0])  # independent of the gains
    runs = [run_loop(config, frames, calibration) for config in configs]
    for run, config in zip(runs, configs, strict=True):
        tilt_mas = settled_rms(run.disturbance_nm)[:2] / tilt_nm_per_mas(config.star.diameter_m)
        assert tilt_mas.max() < 5
        np.testing.assert_allclose(predicted_errors(run, config), run.error_nm, atol=2e-5, rtol=0)
    for run, other, config in ((runs[0], runs[1], configs[1]), (runs[1], runs[0], configs[0])):
        expected = settled_rms(other.error_nm)
        np.testing.assert_allclose(settled_rms(predicted_errors(run, config)), expected, rtol=0.1, atol=tolerance_nm)
        # The two runs differ.
        assert np.abs(settled_rms(run.error_nm) / expected - 1).max() > 0.08


FRAMES = 1200
SETTLING = 599  # frames left out at the start: the settling time, limited to half of the log
OTHER = "gain=0.3,tilt_gain=0.2,leak=0.01"


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, LoggedRun]:
    """Logs of a closed loop, and of a loop with the gains `OTHER` whose controller assumes a wrong delay."""
    folder, runs = tmp_path_factory.mktemp("logs"), {}
    other = {"gain": (0.2, 0.3), "leak": (0.01, 0.01), "delay_frames": 2.0}
    toml = load(None, {"sensor.modes": 10}).to_toml()  # with 10 modes the contrast, which is slow, is not computed
    for name, changes in (("default", {}), ("other", other)):
        log = SyntheticLog(**changes).frames(FRAMES)
        runs[name] = LoggedRun(read_history(LogReader(log.write(folder / f"{name}.mcap", toml=toml))))
    return runs


def results_of(run: LoggedRun, changes: WhatIf | None = None) -> dict[str, Any]:
    found = what_if(run, changes or WhatIf())
    assert found == json.loads(json.dumps(found))
    return found


def column(results: dict[str, Any], name: str) -> np.ndarray:
    return np.array([mode[f"{name}_nm"] for mode in results["modes"]])


def test_the_logged_gains_reproduce_the_logged_run(runs: dict[str, LoggedRun]) -> None:
    results = results_of(runs["default"])
    np.testing.assert_allclose(column(results, "what_if"), column(results, "was"), atol=1e-5)
    for kind in ("true", "continuous"):
        np.testing.assert_allclose(column(results, f"{kind}_what_if"), column(results, f"{kind}_was"), atol=1e-5)
    assert (results["frames"], results["frames_compared"]) == (FRAMES, FRAMES - SETTLING)
    assert results["delay_frames"] == 1
    assert results["delay_measured_frames"] == pytest.approx(1, abs=0.01)
    assert results["warnings"] == []


def test_added_contrast_is_computed_for_shaped_pupil_and_lyot_coronagraph() -> None:
    """A tenth of a nm of spherical in one run, none in the other."""
    spherical = np.diag(0.01 * np.eye(14)[9])

    def contrast_with(**keys: object) -> dict[str, Any] | None:
        config = configuration({}, **keys)
        return added_contrast(factory.contrast_of(config), {"was": 0 * spherical, "what if": spherical, "other": None})

    assert factory.contrast_or_none(load(None, {"sensor.pupil": "elsewhere.npz"})) is None
    contrast = contrast_with()
    assert contrast is not None
    expected = 0.01 * contrast_form(Coronagraph(factory.sensor(Configuration(), print).pupil), (11,), 550.0).item()
    assert (contrast["was"], contrast["what if"], contrast["other"]) == (0, pytest.approx(expected), None)
    assert contrast["by_group"]["what if"]["spherical"] == pytest.approx(expected)
    assert added_contrast_in_words(contrast) == (
        f"added to the dark zone's contrast: was +0.0e+00, what if +{expected:.1e}; spherical contributes most (100 %)"
    )
    assert contrast_with(sensor__modes=10) is None
    behind_lyot = contrast_with(sensor__pupil="circle")
    assert behind_lyot is not None
    assert behind_lyot["what if"] > 0


class MidExposureLog(SyntheticLog):
    """A log with a delay of 1.5 frames: the mirror moves in the middle of each exposure."""

    def _publish(self, advanced: tuple[State, Outputs], late_ns: int = 0) -> None:
        before_nm = self._to_modes @ np.ravel(self._state.loop.actuators_nm) if self._frames else self._mirror_nm
        super()._publish(advanced, late_ns)
        self._mirror_nm = (before_nm + self._mirror_nm) / 2


def test_with_a_fractional_delay_the_continuous_residual_includes_the_motion_of_the_mirror(tmp_path: Path) -> None:
    """Expected: true disturbance plus commands, which move the mirror amid the exposure of half a period."""
    toml = load(None, {"sensor.modes": 10, "camera.delay_frames": 1.5}).to_toml()
    log = MidExposureLog(delay_frames=1.5, gain=(0.6, 0.6)).frames(FRAMES)
    run = LoggedRun(read_history(LogReader(log.write(tmp_path / "x.mcap", toml=toml))))
    results = results_of(run)
    assert results["delay_frames"] == 1.5
    assert run.true_nm is not None
    disturbance_nm, command_nm = run.true_nm[0][:, 0].astype(float), run.steps.command_nm[:, 0].astype(float)
    squares = []
    for moment in (np.arange(8) + 0.5) / 8:
        between_nm = np.interp(np.arange(FRAMES) + moment, np.arange(FRAMES), disturbance_nm)
        squares.append((between_nm + np.roll(command_nm, 2 if moment < 0.25 else 1)) ** 2)
    expected_nm = np.sqrt(np.mean(np.array(squares)[:, SETTLING:-50]))
    assert column(results, "continuous_was")[0] == pytest.approx(expected_nm, rel=0.02)
    np.testing.assert_allclose(column(results, "continuous_what_if"), column(results, "continuous_was"), rtol=1e-4)


def test_a_what_if_predicts_the_residual_of_a_run_with_other_gains(runs: dict[str, LoggedRun]) -> None:
    """The residuals predicted from one run are compared with those measured in the other, mode by mode."""
    predicted, run = results_of(runs["default"], requested_changes(OTHER)), results_of(runs["other"])
    np.testing.assert_allclose(column(predicted, "what_if"), column(run, "was"), rtol=0.1)
    np.testing.assert_allclose(column(predicted, "open"), column(run, "open"), rtol=0.1)
    assert np.abs(column(predicted, "was") / column(run, "was") - 1).max() > 0.1
    assert predicted["what_if_nm"] == pytest.approx(run["was_nm"], rel=0.05)
    assert predicted["true_what_if_nm"] == pytest.approx(run["true_was_nm"], rel=0.05)
    assert predicted["tilt_what_if_mas"] == pytest.approx(run["tilt_was_mas"], rel=0.05)
    tilt_nm = np.sqrt(np.mean(column(predicted, "was")[:2] ** 2))
    assert predicted["tilt_was_mas"] == pytest.approx(tilt_nm / tilt_nm_per_mas(2.0), rel=1e-6)
    laws = {key: predicted["modes"][2][key] for key in ("name", "gain_was", "gain", "leak_was", "leak")}
    assert laws == {"name": "focus", "gain_was": 0.2, "gain": 0.3, "leak_was": 0.0, "leak": 0.01}


def test_a_wrong_delay_of_the_controller_is_found_and_corrected(runs: dict[str, LoggedRun]) -> None:
    results = results_of(runs["other"])
    assert (results["delay_controller_frames"], results["delay_frames"]) == (2, 1)
    assert "assumed a delay of 2 frames" in results["warnings"][0]
    np.testing.assert_allclose(column(results, "what_if"), column(results, "was"), atol=1e-5)


def test_the_clock_of_the_cameras_host_does_not_change_the_measured_delay(tmp_path: Path) -> None:
    log = SyntheticLog(truth=False).frames(100).health("camera", router_offset_ns=2 * toy.PERIOD_NS)
    log.samples = [one._replace(publish_time_ns=one.publish_time_ns + 2 * toy.PERIOD_NS) for one in log.samples]
    run = LoggedRun(read_history(LogReader(log.write(tmp_path / "x.mcap"))))
    assert (run.measured_delay, run.timing.applied) == (2.0, pytest.approx(1.0, abs=0.1))


def test_a_configuration_file_gives_the_same_as_the_options(runs: dict[str, LoggedRun], tmp_path: Path) -> None:
    path = tmp_path / "other.toml"
    path.write_text("[control]\ntilt_gain=0.2\ngain=0.9\nleak=0.01\ntilt_leak=0.01\n")
    by_file = results_of(
        runs["default"], requested_changes("gain=0.3,tilt_gain=0.2,limit_nm=150,tilt_limit_nm=150", path)
    )
    assert by_file == results_of(runs["default"], requested_changes(OTHER + ",limit_nm=150"))
    table = render(by_file).splitlines()
    titles = re.split(r"\s{2,}", next(line for line in table if line.startswith("residual, nm rms")).strip())
    assert len(set(titles)) == len(titles) == 9  # no two columns have the same title
    assert sum(" -> " in line for line in table) == len(by_file["modes"])
    assert any("0.4 -> 0.2" in line and "tilt x" in line for line in table)
    assert any(f"{by_file['tilt_what_if_mas']:.2f}" in line and "mas" in line for line in table)


def test_automatic_gains_of_a_configuration_file_stand_for_the_logged_gains(
    runs: dict[str, LoggedRun], tmp_path: Path
) -> None:
    path = tmp_path / "automatic.toml"
    path.write_text('[control]\ntilt_gain="auto"\ngain="auto"\nleak=0.02\n')
    for options, gains, remark in (
        (None, [0.4, 0.4, 0.2], "tilt x, tilt y, focus keep the logged gains"),
        ("tilt_gain=0.3", [0.3, 0.3, 0.2], "focus keep the logged gains"),
        ("gain=0.3", [0.3, 0.3, 0.3], ""),
    ):
        found = results_of(runs["default"], requested_changes(options, path))
        assert [mode["gain"] for mode in found["modes"]] == pytest.approx(gains)
        warnings = [one for one in found["warnings"] if "automatic" in one]
        assert len(warnings) == bool(remark)
        assert remark in "".join(warnings)
    with pytest.raises(DataFileError, match="its gains are unknown: they are automatic"):
        LoggedRun(replace(history(), controllers=[], configuration=Configuration()))


def test_another_reconstructor_measures_the_same_frames(runs: dict[str, LoggedRun], tmp_path: Path) -> None:
    """pinv computed by name and pinv read from a file agree; `weighted` for that file is the logged reconstructor."""
    by_name = results_of(runs["default"], requested_changes("estimator=pinv"))
    assert by_name["estimator"] == "pinv"
    assert by_name["what_if_nm"] != pytest.approx(by_name["was_nm"], rel=1e-3)
    np.testing.assert_allclose(column(by_name, "open")[:2], column(results_of(runs["default"]), "open")[:2], rtol=0.1)

    calibration = toy.calibration()
    I0, H, good = (array.astype(float) for array in (calibration.reference, calibration.response, calibration.good))
    R = reconstructor(I0, H, good, 1.0, 0.0, "pinv").astype(np.float32)
    path = tmp_path / "pinv.fits"
    calibration_file.save(with_identity(replace(calibration, reconstructor=R, estimator="pinv")), path)
    by_file = results_of(runs["default"], requested_changes(calibration=path))
    np.testing.assert_allclose(column(by_file, "what_if"), column(by_name, "what_if"), rtol=1e-4)
    weighted = results_of(runs["default"], requested_changes("estimator=weighted", calibration=path))
    np.testing.assert_allclose(column(weighted, "what_if"), column(weighted, "was"), rtol=1e-2)


def test_another_reconstructor_is_weighted_like_the_logged_one(
    runs: dict[str, LoggedRun], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The logged reconstructor has a prior of 4 nm rms in focus, which automatic gains left uncorrected."""
    run = runs["default"]
    state = deepcopy(run.history.controllers[-1])
    state.prior_nm2[:], state.weighting_flux_dn = [0, 0, 16], toy.FLUX_DN
    state.camera_expected.CopyFrom(wire_camera(toy.CAMERA))
    expected = run.measured_again(calibration_in_use(state, run.calibration))
    assert np.abs(expected - run.steps.error_nm).max() > 0.1
    monkeypatch.setattr(run.history, "controllers", [state])
    np.testing.assert_array_equal(run.measured_again(run.calibration), expected)
    for change, warned in (("estimator=pinv", True), ("gain=0.3", True), ("gain=0,tilt_gain=0.2", False)):
        warnings = " ".join(results_of(run, requested_changes(change))["warnings"])
        assert ("a prior for the modes that automatic gains did not correct (focus)" in warnings) == warned


def test_used_frames_that_the_log_lacks_are_counted(
    runs: dict[str, LoggedRun], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another reconstructor cannot measure frames that the log lacks; the what-if holds its command at these frames."""
    run = runs["default"]
    found = run.measured_again(run.calibration)
    np.testing.assert_allclose(found, run.steps.error_nm, atol=1e-4)
    found[1107::20] = np.nan
    monkeypatch.setattr(run, "measured_again", lambda *_: found)
    results = what_if(run, requested_changes("estimator=pinv"))
    assert results["frames_compared"] == FRAMES - SETTLING - 5
    assert "the log lacks 5 used frames" in results["warnings"][0]


def test_commands_are_converted_to_modes_of_another_scale(runs: dict[str, LoggedRun], tmp_path: Path) -> None:
    """A calibration in which every mode is twice as large measures half of each modal error."""
    calibration = toy.calibration()
    twice = replace(
        calibration,
        response=calibration.response * 2,
        reconstructor=calibration.reconstructor / 2,
        modes_to_actuators=calibration.modes_to_actuators * 2,
    )
    calibration_file.save(with_identity(twice), tmp_path / "twice.fits")
    results = results_of(runs["default"], requested_changes(calibration=tmp_path / "twice.fits"))
    np.testing.assert_allclose(column(results, "what_if"), column(results, "was") / 2, rtol=1e-4)


def test_calibrations_that_do_not_fit_are_refused(runs: dict[str, LoggedRun], tmp_path: Path) -> None:
    path = tmp_path / "other.fits"
    calibration_file.save(with_identity(replace(toy.calibration(), noll=(2, 3, 11))), path)
    with pytest.raises(CalibrationError, match=r"its noll is \(2, 3, 11\), in the log it is \(2, 3, 4\)"):
        results_of(runs["default"], requested_changes(calibration=path))
    (tmp_path / "shear.toml").write_text('[control]\nnuisance = ["shear"]\n')
    with pytest.raises(ConfigurationError, match=r"weighted\+shear: .* --calibration"):
        results_of(runs["default"], requested_changes(config=tmp_path / "shear.toml"))


INTEGRATOR = """
from __future__ import annotations
from dataclasses import dataclass
import numpy as np

GAIN = np.array([0.2, 0.2, 0.3])
print("loaded")

@dataclass
class State:
    command_nm: np.ndarray

def step(state: State | None, error_nm: np.ndarray) -> tuple[State, np.ndarray]:
    print("called")
    state = state or State(np.zeros(3))
    state.command_nm *= 0.99
    state.command_nm -= GAIN * error_nm
    return state, state.command_nm
"""


def test_a_users_controller_is_run_like_the_integrator(
    runs: dict[str, LoggedRun], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine.py").write_text(INTEGRATOR)
    controller = f"{tmp_path / 'mine.py'}:step"
    users, integrator = (
        results_of(runs["default"], one) for one in (requested_changes(controller=controller), requested_changes(OTHER))
    )
    np.testing.assert_allclose(column(users, "what_if"), column(integrator, "what_if"), rtol=1e-4)
    assert users["controller"] == controller
    assert "gain" not in users["modes"][0]
    assert controller in render(users)
    assert "->" not in render(users)
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith("loaded\ncalled\n")


def history(frames: int = 40, **columns: Any) -> History:
    """History of a closed loop that measures 4 nm of each mode in every frame, and commands zero."""
    values = np.full((frames, 3), 4.0, np.float32)
    default: dict[str, Any] = {
        "sequence": np.array([toy.frame_sequence(count) for count in range(frames)], np.uint64),
        "time_ns": 10**18 + toy.PERIOD_NS * np.arange(frames),
        "mode": np.full(frames, LoopMode.CLOSED, np.uint8),
        "reasons": np.zeros(frames, np.int64),
        "error_nm": values,
        "pol_nm": values.copy(),
        "command_nm": np.zeros((frames, 3), np.float32),
        "flux_dn": np.ones(frames, np.float32),
        "saturated_pixels": np.zeros(frames, np.int64),
    }
    last = wire.ControllerState(gain=[0.5] * 3, leak=[0] * 3, limit_nm=[100] * 3, delay_frames=1)
    log = LogReader(Path("toy.mcap"))
    log.finished = True
    return History(
        log=log,
        calibration=toy.calibration(),
        controllers=[last],
        camera=wire.CameraState(period_ns=toy.PERIOD_NS * 200, exposure_ns=toy.PERIOD_NS),
        frame_sequence=default["sequence"],
        steps=Steps(**(default | columns)),
    )


def rows_compared(run: LoggedRun) -> list[int]:
    return np.flatnonzero(run.rows_to_compare([run.law], run.used)[0]).tolist()


def test_an_offset_is_not_reported_as_a_missing_command() -> None:
    """The logged states contain the offset, the loop's target: it reduces the error without a command."""
    logged = history(error_nm=np.r_[np.full((20, 3), 4, np.float32), np.full((20, 3), 1, np.float32)])
    [last] = logged.controllers
    states = [wire.ControllerState(), wire.ControllerState(), wire.ControllerState(offset_nm=[3] * 3), last]
    states[0].frame_sequence, states[1].frame_sequence = toy.frame_sequence(0), toy.frame_sequence(19)
    states[1].offset_nm[:] = last.offset_nm[:] = [3] * 3
    last.frame_sequence = toy.frame_sequence(39)
    logged.controllers = states
    run = LoggedRun(logged)
    assert not run.command_lost.any()
    np.testing.assert_array_equal(run.seen_nm, 0)


def test_a_command_from_before_the_log_is_not_reported_as_a_missing_command() -> None:
    """With a delay of 2 frames the second frame saw the last command before the log; the log has all later ones."""
    command_nm = np.repeat(np.arange(40, dtype=np.float32)[:, None], 3, axis=1)
    logged = history(command_nm=command_nm, pol_nm=4 - (command_nm - 2))
    logged.controllers[0].delay_frames = 2
    run = LoggedRun(logged)
    assert not run.command_lost.any()
    np.testing.assert_array_equal(run.seen_nm, command_nm - 2)


def test_a_probe_sequence_added_to_the_offset_is_not_reported_as_a_missing_command() -> None:
    """With 3 nm added to the target in 10 frames, the error is smaller by 3 nm; these frames are compared."""
    error_nm = np.full((40, 3), 4, np.float32)
    error_nm[20:30] -= 3
    play = wire.Request(name="play", accepted=True, text="offset", columns=3, frame_sequence=toy.frame_sequence(20))
    play.table = np.full((10, 3), 3, "<f4").tobytes()
    run = LoggedRun(replace(history(error_nm=error_nm), requests=[play]))
    assert not run.command_lost.any()
    np.testing.assert_array_equal(run.seen_nm, 0)
    assert rows_compared(run) == list(range(10, 40))


def test_frames_after_a_frame_from_the_future_or_of_an_earlier_camera_start_after_clear_are_kept() -> None:
    sequence, reasons = history().steps.sequence, np.zeros(40, np.int64)
    sequence[10], reasons[10] = toy.frame_sequence(0, 2 * toy.START), 1 << Rejection.AHEAD
    sequence[30:] -= np.uint64(1 << 32)
    run = LoggedRun(history(sequence=sequence, reasons=reasons))
    assert len(run.steps.sequence) == 39
    assert run.missing.tolist() == [0] * 10 + [1] + [0] * 28


def test_rows_of_settling_open_loop_and_refused_or_saturated_frames_are_not_compared() -> None:
    """With a gain of 0.5 the loop settles in 10 frames, which are five time constants."""
    error, saturated = np.full((40, 3), 4, np.float32), np.zeros(40, np.int64)
    error[[10, 11]], saturated[[20, 21]] = np.nan, 3
    run = LoggedRun(history(error_nm=error, pol_nm=error.copy(), saturated_pixels=saturated))
    assert rows_compared(run) == [row for row in range(10, 40) if row not in (10, 11, 20, 21)]

    mode = np.full(40, LoopMode.OPEN, np.uint8)
    mode[15:] = LoopMode.CLOSED
    assert rows_compared(LoggedRun(history(mode=mode))) == list(range(25, 40))

    pol = np.full((60, 3), 4, np.float32)
    pol[20] -= 1  # exposed with a command missing from the log: settling restarts
    run = LoggedRun(history(60, pol_nm=pol))
    assert np.flatnonzero(run.command_lost).tolist() == [20]
    assert rows_compared(run) == [*range(10, 20), *range(30, 60)]

    error[:6] = np.nan  # the run begins with the first used frame
    assert len(LoggedRun(history(error_nm=error, pol_nm=error.copy())).steps.sequence) == 34


def test_steps_under_another_calibration_give_a_warning() -> None:
    logged = history()
    [last] = logged.controllers
    first, loaded = wire.ControllerState(calibration_id="another"), wire.ControllerState()
    loaded.frame_sequence = toy.frame_sequence(14)
    logged.controllers = [first, loaded, last]
    warnings = "\n".join(what_if(LoggedRun(logged), WhatIf())["warnings"])
    assert "another calibration or camera setting was in use for 15 steps" in warnings


def test_too_few_frames_to_compare_are_an_error() -> None:
    with pytest.raises(DataFileError, match="of 40 frames, 0 were refused, 40 have saturated pixels and 10 are within"):
        rows_compared(LoggedRun(history(saturated_pixels=np.ones(40, np.int64))))
    nothing = np.full((40, 3), np.nan, np.float32)
    for unusable, reason in (
        (history(error_nm=nothing), "its controller used no frame"),
        (replace(history(), calibration=None), "it has no calibration"),
    ):
        with pytest.raises(DataFileError, match=reason):
            LoggedRun(unusable)
    with pytest.raises(DataFileError, match="gains and delay are unknown"):
        LoggedRun(replace(history(), controllers=[]))


def test_warnings_name_what_makes_the_results_doubtful() -> None:
    reasons = np.zeros(40, np.int64)
    reasons[3:7] = 1 << Limit.STROKE | 1 << Limit.SLEW
    pol = np.full((40, 3), 4, np.float32)
    pol[20] -= 1
    logged = replace(history(reasons=reasons, pol_nm=pol), requests=[wire.Request(name="gain", accepted=True)])
    logged.mirror.limits = np.array([0, 1, 1])
    logged.controllers[0].law.name = "lqg"
    logged.controllers[0].channels.add(name="dark-hole")
    logged.log.finished = False
    logged.log.damage.append(Damage(77, 5, "the checksum of a chunk is wrong"))
    warnings = "\n".join(what_if(LoggedRun(logged), WhatIf())["warnings"])
    for expected in (
        "stroke at 4 frames, slew at 4 frames",
        "the mirror's own limits acted on 2 commands",
        "changed 1 time ",
        "could not be measured",
        "left out: byte 77, the checksum of a chunk is wrong",
        "the log has no end",
        "lacks some commands: 1 frame exposed with a missing",
        "a linear law (lqg) was in use",
        "an offset or channels were in force",
    ):
        assert expected in warnings


def test_a_loop_closed_only_on_refused_frames_is_not_reported_as_never_closed() -> None:
    modes = np.repeat(np.array([LoopMode.OPEN, LoopMode.CLOSED], np.uint8), 20)
    run = LoggedRun(history(error_nm=np.repeat(np.float32([[4] * 3, [np.nan] * 3]), 20, axis=0), mode=modes))
    assert run.rows_to_compare([run.law], run.used)[2] == "no usable frame in closed loop"


def test_an_open_loop_beyond_the_linear_range_gives_warnings() -> None:
    far = np.full((40, 3), [20.0, -30.0, 12.0], np.float32)
    run = LoggedRun(history(error_nm=far, pol_nm=far.copy(), mode=np.full(40, LoopMode.OPEN, np.uint8)))
    results = what_if(run, requested_changes("tilt_gain=2.5"))
    assert results["compared"] == "the loop was never closed"
    assert column(results, "was").tolist() == column(results, "open").tolist() == [20, 30, 12]
    _, linear, unstable, limits = results["warnings"]
    assert pytest.approx(5 * 2.424, abs=0.01) == LINEAR_WAVES * 550  # nm: 5 mas of 2.424 nm each
    assert "12.1 nm rms" in linear
    assert "tilt x with " in linear
    assert "focus" not in linear
    tilts = ", ".join(f"tilt {axis} from a gain of 2.00 on" for axis in "xy")
    assert unstable.endswith(f"unstable with a delay of 1 frame: {tilts}")
    assert "tilt x at" in limits


@pytest.mark.parametrize(
    ("body", "message"),
    [
        (None, "FILE.py:NAME of an existing file"),
        ("def step(state, error_nm):\n    return error_nm[0]\n", "TypeError: .* must return"),
        ("def step(state, error_nm):\n    return state, error_nm[:1]\n", "must be 3 finite numbers"),
        ("def step(state, error_nm):\n    return state, [1, 2, float('nan')]\n", "must be 3 finite numbers"),
        ("def step(state, error_nm):\n    exit(3)\n", "SystemExit: 3"),
        ("def stop(state, error_nm):\n    pass\n", "has no function 'step'"),
        ("def step(:\n", "cannot be run: SyntaxError"),
        ("raise SystemExit(0)\n", "cannot be run: SystemExit: 0"),
    ],
)
def test_errors_of_a_users_controller_are_reported(tmp_path: Path, body: str | None, message: str) -> None:
    path = tmp_path / "mine.py"
    if body is not None:
        path.write_text(body)

    with pytest.raises(ConfigurationError, match=message):
        user_controller(f"{path}:step")(None, np.ones(3, np.float32), np.ones(3, np.float32))


def test_options_are_parsed() -> None:
    parsed = requested_changes(" gain=0.6, leak=0.01,tilt_limit_nm=80,estimator=pinv", controller=None)
    assert parsed == WhatIf({"gain": 0.6, "leak": 0.01, "tilt_limit_nm": 80.0}, "pinv")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("gian=0.6", r"unknown key 'gian' \(did you mean 'gain'\?\); the keys are gain, leak,"),
        ("gain", "gain requires one value"),
        ("gain=high", "gain must be a number, got 'high'"),
        ("gain=1,gain=2", "gain requires one value"),
        ("", "nothing to change: give --set KEY=VALUE"),
        ("estimator=best", "estimator must be weighted or pinv, got 'best'"),
        *((text, "every .* must be between") for text in ("gain=5", "leak=2", "gain=nan")),
        ("limit_nm=-1", "every limit_nm must be finite and at least 0"),
        *((f"limit_nm={text}", f"at most 1e.09 in magnitude, got {text}") for text in ("inf", "3e38", "-3e38")),
    ],
)
def test_invalid_options_are_refused(text: str, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        what_if(LoggedRun(history()), requested_changes(text))
    with pytest.raises(ConfigurationError, match="gain: only for the integrator"):
        requested_changes("gain=0.3", controller="mine.py:step")
