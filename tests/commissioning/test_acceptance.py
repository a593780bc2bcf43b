"""The acceptance tests on the simulated optics without a bus: what passes, what does not, and what is said of it."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from lowfc.adapters.files import factory
from lowfc.adapters.files.drawing import figure_class, png
from lowfc.arrays import Single
from lowfc.contract.configuration import Acceptance, Configuration, load
from lowfc.contract.errors import ConfigurationError
from lowfc.contract.messages import wire
from lowfc.control.calibration.calibration import Calibration
from lowfc.control.calibration.excitation import climb, led_in, lines, multisine
from lowfc.control.calibration.linearity import levels
from lowfc.control.laws.stability import delay_weights
from lowfc.control.loop.advance import advance
from lowfc.control.loop.inputs import Frame, Load, Request
from lowfc.control.loop.safety import Limit, LoopMode
from lowfc.control.loop.state import State
from lowfc.programs.commissioning.acceptance import capture as acceptance_capture
from lowfc.programs.commissioning.acceptance import linearity as acceptance_linearity
from lowfc.programs.commissioning.acceptance import noise as acceptance_noise
from lowfc.programs.commissioning.acceptance import rejection as acceptance_rejection
from lowfc.programs.commissioning.acceptance.played import (
    AcceptanceError,
    AcceptanceResult,
    Loop,
    Played,
    _announced,
    chosen,
)
from sim_camera.bench import Bench
from sim_camera.process import bench
from tests.support.loops import lowfc
from tools.law_bench import calibrated

REQUIRED = Acceptance(lowest_hz=2.0)
RATE_HZ = 250.0
GRID = (34, 34)
LEAD, PERIOD = 60, 750


def configured(**changes: object) -> Configuration:
    usual = {"disturbance.preset": "quiet", "sensor.modes": 3, "star.magnitude": -1.0, "control.gain": 0.3}
    return load(None, usual | {key.replace("__", "."): value for key, value in changes.items()})


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return calibrated(configured())


def played(
    config: Configuration,
    calibration: Calibration,
    mode: LoopMode,
    what: dict[str, Any],
    table: Single,
    basis: Single | None = None,
) -> Played:
    """What the simulated loop did while a table was played, on the offset or with the shapes in `basis`."""
    settings = replace(factory.settings(config), start_mode=mode)
    state, _ = advance(settings, State(), Load(0, calibration, "test"))
    scene: Bench = bench(config)
    weights = delay_weights(settings.delay_frames).astype(np.float32)
    shapes = [np.zeros(GRID, np.float32)] * len(weights)
    start, first = 1_700_000_000 << 32, 2
    found = []
    for count in range(1, first + len(table)):
        if count == first:
            shape = np.zeros(0, np.float32) if basis is None else basis.reshape(-1)
            target = "offset" if basis is None else "mirror"
            asked = Request(0, "play", text=target, table=table, actuators_nm=shape)
            state, outputs = advance(settings, state, asked)
            assert outputs.reply.accepted, outputs.reply.text
        seen = np.zeros(GRID, np.float32)
        for weight, shape in zip(weights, shapes, strict=True):
            seen += weight * shape
        pixels, _ = scene.expose(count, seen)
        state, outputs = advance(settings, state, Frame(start | count, count * config.period_ns, 0, pixels))
        shapes = [outputs.command.actuators_nm, *shapes[:-1]]
        if count >= first:
            found.append(outputs.step)
    steps = [step for step in found if step is not None]
    loop = Loop(settings.law(calibration.noll), calibration.noll, settings.delay_frames, RATE_HZ)
    error_nm, pol_nm, command_nm = (
        np.array([getattr(step, name) for step in steps], float) for name in ("error_nm", "pol_nm", "command_nm")
    )
    return Played(
        what,
        loop,
        "offset" if basis is None else "mirror",
        table,
        np.zeros((0, 0), np.float32) if basis is None else basis,
        error_nm,
        pol_nm,
        command_nm,
        np.array([step.mode for step in steps], np.uint8),
        np.array([sum(1 << reason for reason in step.reasons) for step in steps], np.int64),
    )


def rejection_of(config: Configuration, calibration: Calibration, basis: Single | None = None) -> Played:
    places = lines(PERIOD, 3, 8, REQUIRED.lowest_hz / RATE_HZ, REQUIRED.highest_of_rate)
    table = led_in(multisine(PERIOD, places, 3.0, 1), LEAD)
    return played(config, calibration, LoopMode.CLOSED, {"period_frames": PERIOD}, table, basis)


def drawn(module: Any, result: AcceptanceResult) -> bytes:
    figure = figure_class()(figsize=(4, 3))
    module.draw(result.figures(), figure)
    return png(figure)


@pytest.mark.parametrize("delay_frames", [1.0, 1.5, 2.0])
def test_the_rejection_of_the_simulated_bench_is_the_theorys(calibration: Calibration, delay_frames: float) -> None:
    config = configured(camera__delay_frames=delay_frames)
    one = rejection_of(config, calibration)
    found = acceptance_rejection.judge([one], REQUIRED)
    assert found.passed, found.text()
    assert found.largest_departure_db < 1.0
    assert found.lines_judged > 0.7 * found.lines == 0.7 * 24
    assert found.lowest_hz >= 2.0
    assert found.highest_hz == pytest.approx(75, rel=0.05)
    wrong = replace(one, loop=replace(one.loop, delay_frames=delay_frames + 1))
    failed = acceptance_rejection.judge([wrong], REQUIRED)
    assert not failed.passed
    assert "FAILED" in failed.text()
    strict = acceptance_rejection.judge([one], Acceptance(rejection_db=1e-4))
    assert not strict.passed
    assert "too noisy" in strict.text()


def test_a_multisine_on_the_mirror_measures_the_same(calibration: Calibration) -> None:
    basis = np.ascontiguousarray(calibration.modes_to_actuators.T)
    found = acceptance_rejection.judge([rejection_of(configured(), calibration, basis)], REQUIRED)
    assert found.injected == "mirror"
    assert found.passed, found.text()
    assert drawn(acceptance_rejection, found).startswith(b"\x89PNG")


def test_what_was_disturbed_is_not_judged(calibration: Calibration) -> None:
    one = rejection_of(configured(), calibration)
    other = one.mode.copy()
    other[50] = LoopMode.OPEN
    limited = one.reasons.copy()
    limited[70] = 1 << Limit.SLEW
    missing = one.error_nm.copy()
    missing[100:110] = np.nan
    for changed, why in (
        (replace(one, mode=other), "became open"),
        (replace(one, reasons=limited), "SLEW"),
        (replace(one, error_nm=missing), "10 of 810"),
    ):
        with pytest.raises(AcceptanceError, match=why):
            acceptance_rejection.judge([changed], REQUIRED)
    few = one.error_nm.copy()
    few[400] = np.nan
    found = acceptance_rejection.judge([replace(one, error_nm=few)], REQUIRED)
    assert found.frames_missing == 1
    assert "interpolated" in found.text()


def staircase(calibration: Calibration, **changes: object) -> Played:
    levels_nm = levels(np.array(acceptance_linearity.AMPLITUDES) * REQUIRED.linear_nm, 3)
    stairs, starts = climb(levels_nm, 7, 60.0)
    what = {"noll": 2, "levels_nm": levels_nm.tolist(), "starts": (starts + 3).tolist(), "averaged": 4}
    basis = np.ascontiguousarray(calibration.modes_to_actuators[:, :1].T)
    table = stairs.astype(np.float32)[:, None]
    return played(configured(**changes), calibration, LoopMode.OPEN, what, table, basis)


def test_the_sensor_is_linear_where_it_is(calibration: Calibration) -> None:
    one = staircase(calibration)
    found = acceptance_linearity.judge([one], REQUIRED)
    assert found.passed, found.text()
    (mode,) = found.modes
    assert mode.levels[1].gain == pytest.approx(1.0, abs=0.03)
    assert [row.amplitude_nm for row in mode.levels] == pytest.approx([6, 12, 24])
    noise_nm = np.random.default_rng(8).normal(0.0, 50.0, one.error_nm.shape)
    assert acceptance_linearity.judge([replace(one, error_nm=one.error_nm + noise_nm)], REQUIRED).modes[0].too_noisy
    halved = acceptance_linearity.judge([replace(one, error_nm=0.5 * one.error_nm)], REQUIRED)
    assert not halved.passed
    assert "FAILED" in halved.text()
    assert drawn(acceptance_linearity, found).startswith(b"\x89PNG")


def trial(calibration: Calibration, level_nm: float, **changes: object) -> Played:
    stairs, starts = climb([0.0, level_nm], 40, 300.0)
    there = int(starts[1])
    what = {"noll": 2, "level_nm": level_nm, "before": [20, 40], "after": [there + 30, there + 40]}
    basis = np.ascontiguousarray(calibration.modes_to_actuators[:, :1].T)
    table = stairs.astype(np.float32)[:, None]
    return played(configured(**changes), calibration, LoopMode.CLOSED, what, table, basis)


def test_the_loop_captures_what_it_can(calibration: Calibration) -> None:
    good = [trial(calibration, sign * 34.0) for sign in (1, -1)]
    far = trial(calibration, 250.0, control__tilt_limit_nm=1000.0, safety__slew_nm=300.0)
    limited = trial(calibration, 51.0, control__tilt_limit_nm=20.0)
    found = acceptance_capture.judge(good, REQUIRED)
    assert found.passed
    assert found.modes[0].captured_nm == 34.0
    assert not acceptance_capture.closed(far)
    lost = acceptance_capture.judge([*good, limited], REQUIRED)
    assert lost.modes[0].lost_nm == 51.0
    assert lost.modes[0].limits == ["MODAL_LIMIT"]
    assert "MODAL_LIMIT" in lost.text()
    assert not acceptance_capture.judge(good[:1], REQUIRED).passed
    assert drawn(acceptance_capture, found).startswith(b"\x89PNG")
    with pytest.raises(AcceptanceError, match="gain"):
        acceptance_capture.judge([], REQUIRED)


def test_the_noise_floor_is_that_of_photons_and_read_out(calibration: Calibration) -> None:
    config = configured(disturbance__preset="bench")
    nothing = np.zeros((1000, 3), np.float32)
    every = [
        played(config, calibration, mode, {"loop": name}, nothing)
        for name, mode in (("open", LoopMode.OPEN), ("closed", LoopMode.CLOSED))
    ]
    found = acceptance_noise.judge(every, REQUIRED, config, calibration)
    assert found.passed, found.text()
    for mode in found.modes:
        assert mode.open_nm == pytest.approx(mode.expected_nm, rel=0.2)
        assert mode.closed_nm == pytest.approx(mode.expected_nm, rel=0.2)
        assert 0 < mode.residual_floor_nm < mode.closed_nm
    fainter = configured(star__magnitude=-2.0)
    failed = acceptance_noise.judge(every, REQUIRED, fainter, replace(calibration, flux_dn=4 * calibration.flux_dn))
    assert not failed.passed
    assert "FAILED" in failed.text()
    assert drawn(acceptance_noise, found).startswith(b"\x89PNG")
    with pytest.raises(AcceptanceError, match="closed stretch"):
        acceptance_noise.judge(every[:1], REQUIRED, config, calibration)


def test_a_test_is_found_by_its_note() -> None:
    def asked(name: str, text: str, accepted: bool = True) -> wire.Request:
        return wire.Request(name=name, text=text, accepted=accepted, frame_sequence=5)

    requests = [
        asked("note", "acceptance is due"),
        asked("play", "offset"),
        asked("note", 'acceptance {"test": "rejection", "period_frames": 10, "frames": 12}'),
        asked("play", "mirror", accepted=False),
        asked("play", "offset"),
        asked("play", "offset"),
        asked("note", 'acceptance {"test": "noise-floor", "loop": "open", "frames": 9}'),
    ]
    assert [(what, request.text) for what, request in _announced(requests, "rejection")] == [
        ({"period_frames": 10, "frames": 12}, "offset")
    ]
    assert [what for what, _ in _announced(requests, "noise-floor")] == [{"loop": "open", "frames": 9}]
    assert _announced(requests, "linearity") == []


def test_modes_are_chosen_by_their_noll_indices() -> None:
    assert chosen((), (2, 3)) == (2, 3)
    with pytest.raises(AcceptanceError, match="99"):
        chosen((99,), (2, 3))


@pytest.mark.parametrize("test", ["rejection", "linearity", "capture-range"])
def test_modes_that_are_none_are_refused_and_are_not_all(test: str) -> None:
    done = lowfc("acceptance", test, "--modes", "11-4")
    assert isinstance(done.exception, ConfigurationError)
    assert str(done.exception) == "--modes takes Noll indices, as in 2,3 or 4-11; got '11-4'"
