"""The acceptance tests on a loop in one process: verdicts, results and messages."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lowfc.adapters.files.drawing import figure_class, png
from lowfc.adapters.logs.history import read_history
from lowfc.adapters.logs.reader import LogReader
from lowfc.contract.codecs.calibration_codec import with_identity
from lowfc.contract.configuration import FIXED_GAINS
from lowfc.contract.errors import ConfigurationError, DataFileError
from lowfc.contract.messages import REQUEST, wire
from lowfc.control.calibration.linearity import Gains
from lowfc.control.laws.linear_law import integrator_block, law_from_blocks
from lowfc.control.loop.safety import Limit, LoopMode
from lowfc.programs.commissioning.acceptance import capture, linearity, noise, rejection
from lowfc.programs.commissioning.acceptance.live import Live
from lowfc.programs.commissioning.acceptance.probe import (
    AcceptanceError,
    AcceptanceResult,
    ProbeResponse,
    _announced,
    logged_responses,
)
from lowfc.programs.commissioning.calibrate import recording
from tests.support.in_process_loop import SMALL_MIRROR, InProcessLoop, configuration
from tests.support.loops import refusal
from tests.support.report_log import TOY_CALIBRATION, SyntheticLog

MULTISINE = {"duration_s": 3.0, "rms_nm": 3.0, "lines_per_mode": 8, "modes": (), "seed": 1}
THREE_MODES = {
    "disturbance.preset": "quiet",
    "camera.instants": 1,  # in a period; one suffices, as the wavefront changes only with the mirror
    "sensor.modes": 3,
    "star.magnitude": -1.0,
    "control.gain": 0.3,
    "acceptance.lowest_hz": 2.0,
}
configured = partial(configuration, FIXED_GAINS | SMALL_MIRROR | THREE_MODES)
noiseless = partial(configured, camera__noise=False)


def responses_of(loop: InProcessLoop, test: Any, **options: Any) -> list[ProbeResponse]:
    """Run an acceptance test; check that the loop's mode is restored; return the responses to its probe sequences."""
    loop.run(5)
    live = Live(loop, lambda *_: None, print)
    mode_before = loop.status().state.mode
    with loop.reserved("a test"), live.restored():
        responses = test.play(live, **options)
    assert loop.status().state.mode == mode_before
    return responses


def drawn(module: Any, result: AcceptanceResult) -> bytes:
    """The plot of a test's result, as a PNG file."""
    figure = figure_class()(figsize=(4, 3))
    module.draw(result.json_object(), figure)
    return png(figure)


@pytest.fixture(scope="module", params=[1.0, 1.5])
def multisine(request: pytest.FixtureRequest) -> tuple[InProcessLoop, ProbeResponse]:
    loop = InProcessLoop(configured(camera__delay_frames=request.param))
    (response,) = responses_of(loop, rejection, **MULTISINE)
    return loop, response


def test_the_rejection_of_the_simulated_bench_matches_theory(multisine: tuple[InProcessLoop, ProbeResponse]) -> None:
    loop, response = multisine
    result = rejection.judge([response], loop.config)
    assert result.passed, result.text()
    assert result.injected == "offset"
    assert result.largest_departure_db < 1.0
    assert result.lines == 3 * MULTISINE["lines_per_mode"]
    assert result.lines_judged > 0.7 * result.lines
    assert result.lowest_hz >= 2.0
    assert result.highest_hz == pytest.approx(75, rel=0.05)  # 0.3 times the rate of 250 Hz
    wrong_delay = replace(response, loop=replace(response.loop, delay_frames=response.loop.delay_frames + 1))
    failed = rejection.judge([wrong_delay], loop.config)
    assert not failed.passed
    assert "FAILED" in failed.text()
    strict = rejection.judge([response], configured(acceptance__rejection_db=1e-4))
    assert not strict.passed
    assert "too noisy" in strict.text()


def test_with_a_pseudo_open_loop_law_the_multisine_is_added_to_the_mirror() -> None:
    loop = InProcessLoop(noiseless())
    loop.law(law_from_blocks([integrator_block(0.3, 0.001, "pol", 1.0)] * 3, "pol", "leaky", (2, 3, 4), 1.0, 250.0))
    result = rejection.judge(responses_of(loop, rejection, **MULTISINE), loop.config)
    assert (result.injected, result.law) == ("mirror", "leaky")
    assert result.passed, result.text()
    assert drawn(rejection, result).startswith(b"\x89PNG")


@pytest.mark.parametrize("multisine", [1.0], indirect=True)
def test_an_unsuitable_or_disturbed_measurement_is_refused(multisine: tuple[InProcessLoop, ProbeResponse]) -> None:
    loop, response = multisine
    with pytest.raises(AcceptanceError, match="3 modes, from 2 Hz up"):
        responses_of(loop, rejection, **MULTISINE | {"duration_s": 0.1})
    with pytest.raises(AcceptanceError, match="of 3 columns is too long: shorten it to 5333 s"):
        responses_of(loop, rejection, **MULTISINE | {"duration_s": 6000.0})
    with pytest.raises(AcceptanceError, match=r"\[99\] are not controlled; the loop controls 2, 3, 4"):
        responses_of(loop, rejection, **MULTISINE | {"modes": (2, 99)})
    opened = response.mode.copy()
    opened[50] = LoopMode.OPEN
    limited = response.reasons.copy()
    limited[70] = 1 << Limit.SLEW
    missing = response.error_nm.copy()
    missing[100:110] = np.nan
    for disturbed, why in (
        (replace(response, mode=opened), "became open"),
        (replace(response, reasons=limited), r"SLEW\) and ended the probe: use a smaller amplitude"),
        (replace(response, reasons=limited, target=""), r"SLEW\): measure when"),
        (replace(response, reasons=response.reasons | 1 << Limit.LAW_OVERRULED), "in place of the law"),
        (replace(response, error_nm=missing), f"10 of {len(response.table)}"),
    ):
        with pytest.raises(AcceptanceError, match=why):
            rejection.judge([disturbed], loop.config)
    one_missing = response.error_nm.copy()
    one_missing[400] = np.nan
    result = rejection.judge([replace(response, error_nm=one_missing)], loop.config)
    assert result.frames_missing == 1
    assert "interpolated" in result.text()
    loop.ask("safe")
    with pytest.raises(AcceptanceError, match="it must be open or closed for a test"):
        Live(loop, lambda *_: None, print)


def test_an_interrupted_probe_sequence_is_repeated_in_the_same_mode(capsys: pytest.CaptureFixture[str]) -> None:
    once_silent = InProcessLoop(noiseless(), lose=lambda index: index == 60 and once_silent.silence_camera())
    (response,) = responses_of(once_silent, linearity, hold_frames=7, cycles=3, modes=(2,))
    assert linearity.judge([response], once_silent.config).passed
    assert capsys.readouterr().out.count("NO_FRAMES no frame for 60 ms; holding the command) during a probe") == 1
    often_silent = InProcessLoop(
        noiseless(), lose=lambda index: index > 20 and not index % 30 and often_silent.silence_camera()
    )
    with pytest.raises(AcceptanceError, match=r"in 3 attempts no probe sequence was undisturbed; .*NO_FRAMES"):
        responses_of(often_silent, linearity, hold_frames=7, cycles=3, modes=(2,))


def test_a_probe_sequence_waits_for_a_mirror_that_has_just_restarted(monkeypatch: pytest.MonkeyPatch) -> None:
    loop = InProcessLoop(noiseless())
    loop.run(5)
    loop.report_mirror("does not answer")
    monkeypatch.setattr(recording, "sleep", lambda _: loop.report_mirror(""))
    (response,) = responses_of(loop, linearity, hold_frames=7, cycles=3, modes=(2,))
    assert linearity.judge([response], loop.config).passed


def test_the_linearity_test_passes_the_simulated_sensor_and_fails_noise_or_a_halved_gain() -> None:
    loop = InProcessLoop(configured())
    with pytest.raises(AcceptanceError, match="2 frames at each level are too few: the first 3"):
        responses_of(loop, linearity, hold_frames=2, cycles=3, modes=(2,))
    (response,) = responses_of(loop, linearity, hold_frames=7, cycles=3, modes=(2,))
    result = linearity.judge([response], loop.config)
    assert result.passed, result.text()
    assert len(str(response.parameters)) < 100, "more cycles do not make the announcing note longer"
    (mode,) = result.modes
    assert mode.levels[1].gain == pytest.approx(1.0, abs=0.03)
    assert [row.amplitude_nm for row in mode.levels] == pytest.approx([6, 12, 24])
    noise_nm = np.random.default_rng(8).normal(0.0, 50.0, response.error_nm.shape)
    assert linearity.judge([replace(response, error_nm=response.error_nm + noise_nm)], loop.config).modes[0].too_noisy
    one_cycle = Gains(np.array([6.0]), np.array([[1.0, 0.0]]), np.full((1, 2), np.nan), mode=0)
    assert one_cycle.within(0.1, 0.1) == [None], "without a standard error, nobody can tell"
    # Of repeated tests, the last one counts.
    halved = linearity.judge([response, replace(response, error_nm=0.5 * response.error_nm)], loop.config)
    assert [mode.passed for mode in halved.modes] == [False]
    assert "FAILED" in halved.text()
    assert drawn(linearity, result).startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("changes", "tilt_nm", "captured_nm", "lost_nm", "limits"),
    [
        ({}, 34.0, 51.0, None, []),
        ({"control__tilt_limit_nm": 1e3, "control__limit_nm": 1e3, "safety__slew_nm": 300.0}, 250.0, 250.0, 375.0, []),
        ({"control__tilt_limit_nm": 20.0}, 34.0, 17.0, 34.0, ["MODAL_LIMIT"]),
    ],
    ids=["default limits", "wide limits", "low modal limit"],
)
def test_the_capture_range_ends_at_the_modal_limit_or_the_sensor_range(
    changes: dict[str, Any], tilt_nm: float, captured_nm: float, lost_nm: float | None, limits: list[str]
) -> None:
    config = noiseless(**changes, acceptance__capture_tilt_nm=tilt_nm)
    trials = responses_of(InProcessLoop(config), capture, modes=(2,))  # Z2, tip
    result = capture.judge(trials, config)
    (mode,) = result.modes
    assert (mode.captured_nm, mode.lost_nm, mode.limits) == (captured_nm, lost_nm, limits)
    assert result.passed == (captured_nm >= tilt_nm)
    assert all(name in result.text() for name in limits)
    if lost_nm is None:
        assert drawn(capture, result).startswith(b"\x89PNG")
    assert not capture.judge(trials[:1], config).passed


def test_a_capture_range_test_with_gains_of_zero_is_refused() -> None:
    loop = InProcessLoop(configured(control__gain=0.0))
    with pytest.raises(AcceptanceError, match="the gains of the tested modes are zero"):
        capture.judge(responses_of(loop, capture, modes=(4,)), loop.config)


def test_the_noise_floor_matches_photon_and_read_noise() -> None:
    config = configured(disturbance__preset="bench", camera__instants=8)
    loop = InProcessLoop(config)
    responses, calibration = responses_of(loop, noise, duration_s=1.5), loop.calibration()
    result = noise.judge(responses, config)
    assert result.passed, result.text()
    for mode in result.modes:
        assert mode.open_nm == pytest.approx(mode.expected_nm, rel=0.2)
        assert mode.closed_nm == pytest.approx(mode.expected_nm, rel=0.2)
        assert 0 < mode.residual_floor_nm < mode.closed_nm
    brighter = configured(star__magnitude=-2.0)
    four_times_flux = replace(calibration, flux_dn=4 * calibration.flux_dn)
    responses_to_brighter_star = [
        replace(response, loop=replace(response.loop, calibration=four_times_flux)) for response in responses
    ]
    failed = noise.judge(responses_to_brighter_star, brighter)
    assert not failed.passed
    assert "FAILED" in failed.text()
    assert drawn(noise, result).startswith(b"\x89PNG")
    figure = figure_class()()
    noise.draw(result.json_object(), figure)
    [axes] = figure.axes
    assert "per frame" not in axes.get_ylabel()  # the residual is not a value per frame
    labels = [text.get_text() for text in axes.get_legend().get_texts()]
    assert labels == ["expected per frame", "open per frame", "closed per frame", "residual from noise"]
    with pytest.raises(AcceptanceError, match="found open; the test was ended, or the log begins or ends within it"):
        noise.judge(responses[:1], config)


def test_a_note_announces_the_probe_sequences_of_a_test_in_a_log() -> None:
    def recorded(name: str, text: str, accepted: bool = True) -> wire.Request:
        return wire.Request(name=name, text=text, accepted=accepted, frame_sequence=5)

    requests = [
        recorded("note", "acceptance is due"),
        recorded("play", "offset"),
        recorded("note", 'acceptance {"test": "rejection", "period_frames": 10, "frames": 12}'),
        recorded("play", "mirror", accepted=False),
        recorded("play", "mirror"),
        recorded("note", 'acceptance {"test": "rejection", "period_frames": 10, "frames": 12}'),
        recorded("play", "offset"),
        recorded("play", "mirror"),
        recorded("note", 'acceptance {"test": "noise-floor", "loop": "open", "frames": 9}'),
        recorded("play", "mirror"),
    ]
    for incomplete in (
        '"noise-floor", "frames": 9',
        '"noise-floor", "loop": "open", "frames": 0',
        '"linearity", "noll": 4, "frames": 9',
        '"capture-range", "noll": 4, "level_nm": 5.0, "before": [0, 1], "after": [1], "frames": 9',
    ):
        requests += recorded("note", f'acceptance {{"test": {incomplete}}}'), recorded("play", "mirror")
    assert [(parameters, request.text) for parameters, request in _announced(requests, "rejection")] == [
        ({"period_frames": 10, "frames": 12}, "offset")
    ]
    assert [parameters for parameters, _ in _announced(requests, "noise-floor")] == [{"loop": "open", "frames": 9}]
    assert _announced(requests, "linearity") == _announced(requests, "capture-range") == []


OPEN_NOTE, CLOSED_NOTE = (
    f'acceptance {{"test": "noise-floor", "loop": "{loop}", "frames": 50}}' for loop in ("open", "closed")
)
"""Notes that announce a noise-floor test in a log."""


def responses_in(log: Path) -> list[ProbeResponse]:
    """Responses of the noise-floor tests in a log."""
    return logged_responses(read_history(LogReader(log)), noise.KIND)


@pytest.mark.parametrize("name", ["reset", "stop"])
def test_a_request_disturbs_a_measurement_unless_a_limit_ended_it_before(name: str, tmp_path: Path) -> None:
    def logged(limit_nm: float) -> list[ProbeResponse]:
        night = SyntheticLog(limit_nm=(limit_nm, limit_nm)).request("close").frames(20)
        night.request("note", text=CLOSED_NOTE).frames(20).request(name).frames(50)
        return responses_in(night.write(tmp_path / f"{limit_nm:g}.mcap"))

    with pytest.raises(DataFileError, match=f"request '{name}' disturbed the measurement"):
        logged(1e3)
    (response,) = logged(1.0)
    assert response.limits_hit == ["MODAL_LIMIT"]


def test_a_disturbed_test_that_was_repeated_does_not_count(tmp_path: Path) -> None:
    night = SyntheticLog().frames(20).request("note", text=OPEN_NOTE).frames(20).request("reset")
    log = night.request("note", text=OPEN_NOTE).frames(60).write(tmp_path / "night.mcap")
    assert len(responses_in(log)) == 1


def test_a_log_that_ends_within_a_test_is_refused_and_the_error_says_what_is_missing(tmp_path: Path) -> None:
    log = SyntheticLog().frames(20).request("note", text=CLOSED_NOTE).frames(40).write(tmp_path / "night.mcap")
    error = r"ends 10 of 50 frames before the end of a measurement \(noise-floor, loop closed\): give all files"
    with pytest.raises(DataFileError, match=error):
        responses_in(log)


def test_a_log_without_the_law_or_the_table_of_a_probe_sequence_is_refused(tmp_path: Path) -> None:
    night = SyntheticLog()
    night.law(0.3, logged=False)
    with pytest.raises(DataFileError, match=r"lawless\.mcap: the law \w+ is missing"):
        responses_in(night.frames(20).request("note", text=OPEN_NOTE).frames(60).write(tmp_path / "lawless.mcap"))
    note = 'acceptance {"test": "rejection", "period_frames": 10, "frames": 50}'
    night = SyntheticLog().request("close").frames(20).request("note", text=note)
    night.request("play", text="offset", table=np.zeros((50, 3), np.float32)).frames(60)
    night.change(REQUEST, -1, lambda request: setattr(request, "play_id", "lost"))
    with pytest.raises(DataFileError, match=r"night\.mcap: the table lost of a probe sequence is missing"):
        logged_responses(read_history(LogReader(night.write(tmp_path / "night.mcap"))), rejection.KIND)


def test_a_test_in_a_log_is_evaluated_with_the_gains_and_the_calibration_in_use_during_it(tmp_path: Path) -> None:
    night = SyntheticLog().frames(20).request("note", text=OPEN_NOTE).frames(60)
    night.request("gain", (0.1,)).request("safe").request("clear")
    night.load(with_identity(replace(TOY_CALIBRATION, flux_dn=1.0)))
    (response,) = responses_in(night.frames(5).write(tmp_path / "night.mcap"))
    assert (response.loop.law.gain[0], response.loop.calibration.id) == (np.float32(0.4), TOY_CALIBRATION.id)


def test_malformed_modes_and_options_without_effect_on_a_log_are_refused() -> None:
    for test in ("rejection", "linearity", "capture-range"):
        for given, why in (
            (("--modes", "11-4"), "takes Noll indices"),
            (("x.mcap", "--modes", "4"), "--modes has no effect"),
        ):
            assert why in refusal("acceptance", test, *given, kind=ConfigurationError)
