"""Loops with a wrong or restarted camera or without a calibration: when they may close, and what they do until then."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from lowfc.arrays import Single
from lowfc.contract.codecs.state_codec import controller_state, decode_state
from lowfc.control.loop.advance import advance
from lowfc.control.loop.camera import CameraSettings, changes
from lowfc.control.loop.command_channels import MIRROR
from lowfc.control.loop.inputs import Frame, Input, Load, MirrorReport, MirrorShape, Outputs, Reply, Request, Tick
from lowfc.control.loop.loading import LATCHED
from lowfc.control.loop.safety import Limit, LoopMode, Rejection
from lowfc.control.loop.state import State
from lowfc.control.loop.wording import CAMERA_MISFIT
from tests.support.safety_checks import violations
from tests.support.theory import linear
from tests.support.toy import (
    CAMERA,
    DARK_DN,
    GRID,
    SHAPE,
    START,
    WAVE_NM,
    calibration,
    check_reply,
    feed,
    frame,
    frame_sequence,
    loaded,
    names,
    settings,
)

DEFAULTS = settings(rate_hz=1000.0)
WRONG_BIAS = replace(CAMERA, bias_dn=DARK_DN + 60)


def ask(state: State, name: str, **fields: object) -> tuple[State, Reply]:
    state, outputs = advance(DEFAULTS, state, Request(5, name, **fields))
    return state, outputs.reply


def open_loop_after(*inputs: Input) -> State:
    """An open loop after these inputs."""
    state, _ = ask(loaded(DEFAULTS), "open")
    return feed(DEFAULTS, state, *inputs)[0]


def test_camera_settings_that_differ_from_the_calibrations_open_the_loop() -> None:
    """A bias below the dark is no difference: the dark also contains clock-induced charge and dark current."""
    state, all_outputs = feed(DEFAULTS, loaded(DEFAULTS), frame(1), CAMERA)
    assert (state.mode, names(all_outputs)) == (LoopMode.CLOSED, [])
    assert feed(DEFAULTS, state, replace(CAMERA, time_ns=9)) == (state, [Outputs()])
    state, all_outputs = feed(DEFAULTS, state, WRONG_BIAS)
    assert (state.mode, names(all_outputs)) == (LoopMode.OPEN, ["CAMERA_CHANGED", "MODE_CHANGED"])
    assert "bias_dn" in str(all_outputs[0].events[0].details["what"])
    measuring = replace(DEFAULTS, auto_gain=(True, True))
    for not_closed in (state, feed(measuring, loaded(measuring), CAMERA, WRONG_BIAS)[0]):
        assert not_closed.conditions.mode_cause.startswith(f"{CAMERA_MISFIT}: ")


@pytest.mark.parametrize("name", ["close", "step", "law"])
def test_the_loop_is_not_closed_with_changed_camera_settings(name: str) -> None:
    law = linear(DEFAULTS.integrator((2, 3, 4)))
    fields: dict[str, object] = {"close": {}, "step": {"values": (9.0,)}, "law": {"law": law}}[name]
    state = open_loop_after(CAMERA, frame(1), WRONG_BIAS)
    after, reply = ask(state, name, **fields)
    assert not reply.accepted
    assert "bias_dn is 160, was 60 at the calibration" in reply.text
    assert (after.mode, after.steps_left) == (LoopMode.OPEN, 0)
    state, _ = feed(DEFAULTS, state, CAMERA)
    assert ask(state, name, **fields)[1].accepted


def test_the_camera_is_compared_with_the_calibrations_settings() -> None:
    measured = replace(calibration(), camera=CAMERA)
    state, _ = feed(DEFAULTS, State(), Load(0, measured, "test"), WRONG_BIAS)
    assert state.mode is LoopMode.OPEN
    state, _ = feed(DEFAULTS, State(), WRONG_BIAS, Load(0, measured, "test"))
    assert state.mode is LoopMode.OPEN
    assert "bias_dn" in state.conditions.mode_cause


@pytest.mark.parametrize(
    ("now", "different"),
    [
        (replace(CAMERA, bias_dn=CAMERA.bias_dn + 2.9), []),
        (replace(CAMERA, bias_dn=CAMERA.bias_dn + 3.1), ["bias_dn"]),
        (replace(CAMERA, shape=(7, 8)), ["rows", "columns"]),
        (replace(CAMERA, saturation_dn=4095.0), ["saturation_dn"]),
        (replace(CAMERA, em_gain=300.0), ["em_gain"]),
        (replace(CAMERA, gain_e_per_dn=1.005), []),
        (replace(CAMERA, gain_e_per_dn=1.015), ["gain_e_per_dn"]),
        (replace(CAMERA, region=(4, 0)), ["region_row"]),
        (replace(CAMERA, start_s=START + 5), []),
        (replace(CAMERA, bias_dn=float("nan")), ["bias_dn"]),
    ],
)
def test_only_differences_beyond_the_tolerances_count_as_changes(now: CameraSettings, different: list[str]) -> None:
    assert [line.split()[0] for line in changes(now, CAMERA)] == different


def test_after_a_camera_restart_frames_are_refused_until_its_settings_arrive() -> None:
    state, _ = feed(DEFAULTS, loaded(DEFAULTS), CAMERA, *(frame(count, (20, 0, 0)) for count in range(1, 6)))
    restarted = [frame(1, (20, 0, 0), sequence=frame_sequence(count, START + 9)) for count in range(4)]
    before_nm = state.loop.history_nm[0]
    state, all_outputs = feed(DEFAULTS, state, *restarted)
    assert [outputs.step.reasons for outputs in all_outputs] == [(Rejection.CAMERA_UNKNOWN,)] * 4
    assert (state.loop.history_nm[0] == before_nm).all()
    assert not ask(ask(state, "open")[0], "close")[1].accepted
    new_settings = replace(CAMERA, start_s=START + 9)
    state, all_outputs = feed(DEFAULTS, state, new_settings, frame(1, sequence=frame_sequence(9, START + 9)))
    assert all_outputs[-1].step.reasons == ()


def test_settings_received_before_the_first_frame_of_a_restarted_camera_are_accepted() -> None:
    state, _ = feed(DEFAULTS, loaded(DEFAULTS), CAMERA, frame(1), replace(CAMERA, start_s=START + 9))
    state, (outputs,) = feed(DEFAULTS, state, frame(1, sequence=frame_sequence(0, START + 9)))
    assert outputs.step.reasons == ()


def test_the_loop_is_not_closed_while_frames_are_refused() -> None:
    dark = [frame(count, pixels=frame(1).pixels * 0) for count in range(2, 5)]
    state = open_loop_after(CAMERA, frame(1), *dark[:2])
    assert ask(state, "close")[1].accepted, "two refused frames are ignored"
    state, _ = feed(DEFAULTS, state, dark[2])
    _, reply = ask(state, "close")
    assert not reply.accepted
    assert "frames are refused as DARK" in reply.text
    assert ask(feed(DEFAULTS, state, frame(9))[0], "close")[1].accepted


def test_after_a_clear_frames_older_than_the_newest_frame_are_used() -> None:
    newer = frame(1, sequence=frame_sequence(1, START + 86_000))
    state, _ = feed(DEFAULTS, loaded(DEFAULTS), CAMERA, frame(1), newer, CAMERA)
    state, (outputs,) = feed(DEFAULTS, state, frame(2))
    assert outputs.step.reasons == (Rejection.OUT_OF_ORDER,)
    state, _ = ask(state, "safe")
    state, reply = ask(state, "clear")
    assert reply.accepted
    state, (outputs,) = feed(DEFAULTS, state, frame(3))
    assert outputs.step.reasons == ()
    assert outputs.command.clear_id == 5


def test_a_frame_from_the_future_does_not_change_the_newest_sequence() -> None:
    state, _ = feed(DEFAULTS, loaded(DEFAULTS), CAMERA, frame(1))
    state, (outputs, after) = feed(DEFAULTS, state, frame(1, sequence=(1 << 64) - (1 << 40), ahead=True), frame(2))
    assert outputs.step.reasons == (Rejection.AHEAD,)
    assert after.step.reasons == ()


def test_commands_carry_safe_mode_to_the_mirror_and_a_restarted_controller_adopts_it_from_there() -> None:
    state, _ = ask(loaded(DEFAULTS), "safe")
    _, (outputs,) = feed(DEFAULTS, state, frame(1))
    assert outputs.command.safe
    shape = MirrorShape(0, outputs.command.actuators_nm, outputs.command.command_nm, safe=True)
    restarted, (adopted,) = feed(DEFAULTS, loaded(DEFAULTS), shape)
    assert restarted.mode is LoopMode.SAFE
    assert [event.name for event in adopted.events][:2] == ["MODE_CHANGED", "SAFED"]
    restarted, _ = feed(DEFAULTS, loaded(DEFAULTS), replace(shape, safe=False))
    assert restarted.mode is LoopMode.CLOSED


def test_after_a_clear_the_settings_of_a_restarted_camera_are_awaited() -> None:
    state, _ = feed(DEFAULTS, loaded(DEFAULTS), CAMERA, frame(1))
    for name in ("safe", "clear"):
        state, _ = ask(state, name)
    state, (outputs,) = feed(DEFAULTS, state, frame(1, sequence=frame_sequence(0, START + 9)))
    assert outputs.step.reasons == (Rejection.CAMERA_UNKNOWN,)


MISFIT_IMAGE = np.full((8, 9), 5000, np.uint16)
BASIS = np.arange(GRID[0] * GRID[1], dtype=np.float32)


def misfit_frame(count: int) -> Frame:
    """A frame of a size that is not the calibration's."""
    return frame(count, pixels=MISFIT_IMAGE)


def idle(shape_nm: float = 0.0) -> State:
    """A controller without a calibration, after the first report of the mirror's shape and three frames."""
    actuators = np.full(GRID, shape_nm, np.float32)
    state, _ = feed(DEFAULTS, State(), MirrorShape(0, actuators, np.zeros(0, np.float32)))
    return feed(DEFAULTS, state, *(misfit_frame(count) for count in range(1, 4)))[0]


def play(state: State, table: Single, basis: Single = BASIS) -> State:
    state, outputs = advance(DEFAULTS, state, Request(0, "play", text=MIRROR, actuators_nm=basis, table=table))
    check_reply(outputs, True)
    return state


def surfaces(all_outputs: list[Outputs]) -> Single:
    """Actuators (frames, actuators) of the commands, nm of surface."""
    return np.array([outputs.command.actuators_nm.reshape(-1) for outputs in all_outputs])


def misfit_camera() -> State:
    """A controller with a calibration computed from the model, and a camera of another frame size."""
    computed = replace(calibration(), operator_hash="model")
    state, _ = feed(
        DEFAULTS, State(), Load(0, computed, "the configuration"), replace(CAMERA, shape=MISFIT_IMAGE.shape)
    )
    return feed(DEFAULTS, state, *(misfit_frame(count) for count in range(1, 4)))[0]


@pytest.mark.parametrize("begin", [idle, misfit_camera])
def test_a_probe_sequence_plays_without_a_calibration(begin: Callable[[], State]) -> None:
    state = begin()
    assert state.mode is LoopMode.IDLE
    table = np.array([[1], [-2], [3]], np.float32)
    state, all_outputs = feed(DEFAULTS, play(state, table), *(misfit_frame(count) for count in range(4, 9)))
    assert np.allclose(surfaces(all_outputs), np.vstack([table * BASIS, 0 * BASIS, 0 * BASIS]))
    for outputs in all_outputs:
        assert outputs.step.error_nm is None
        assert outputs.step.reasons[0] in (Rejection.NO_CALIBRATION, Rejection.WRONG_SIZE)


def test_a_limit_ends_the_probe_sequence() -> None:
    steep = np.zeros(GRID, np.float32)
    steep[0, 0] = DEFAULTS.limits.stroke_nm - 1
    table = np.ones((50, 1), np.float32)
    state = play(idle(), table, steep.reshape(-1))
    before = surfaces([advance(DEFAULTS, state, Tick(0, 0))[1]])[0].reshape(GRID)
    for count in range(4, 30):
        state, outputs = advance(DEFAULTS, state, misfit_frame(count))
        now = outputs.command.actuators_nm
        assert violations(DEFAULTS.limits, before, now) == []
        before = now
    assert state.limits_hit == ()
    assert not before.any()
    state = play(state, table, steep.reshape(-1))
    _, all_outputs = feed(DEFAULTS, state, misfit_frame(40))
    assert "PLAY_ENDED" in names(all_outputs)
    assert Limit.SLEW in all_outputs[0].step.reasons


def test_an_idle_loop_holds_the_mirror_and_safe_relaxes_it() -> None:
    state, all_outputs = feed(DEFAULTS, idle(shape_nm=30.0), misfit_frame(4))
    assert np.allclose(surfaces(all_outputs), 30)
    state, outputs = advance(DEFAULTS, state, Request(0, "safe"))
    check_reply(outputs, True)
    state, all_outputs = feed(DEFAULTS, state, misfit_frame(5), misfit_frame(6))
    assert not surfaces(all_outputs)[-1].any()
    state, _ = advance(DEFAULTS, state, Request(0, "clear"))
    assert state.mode is LoopMode.IDLE


def test_safe_mode_latched_before_the_controller_started_remains() -> None:
    safe = settings(start_mode=LoopMode.SAFE)
    state, all_outputs = feed(safe, State(), MirrorShape(0, np.full(GRID, 30, np.float32), np.zeros(0, np.float32)))
    assert names(all_outputs) == ["NOT_CALIBRATED", "MODE_CHANGED", "SAFED"]
    _, all_outputs = feed(safe, state, misfit_frame(1))
    assert not surfaces(all_outputs).any()
    for load in (Load(0, calibration(), "a file"), Request(0, "load", calibration=calibration())):
        state, (outputs,) = feed(safe, State(), load)
        assert sorted(names([outputs])) == ["CALIBRATION_LOADED", "MODE_CHANGED", "SAFED"]
        causes = {event.details["why"] for event in outputs.events if "why" in event.details}
        assert causes == {state.conditions.mode_cause} == {LATCHED}


@pytest.mark.parametrize("begin", [idle, misfit_camera])
@pytest.mark.parametrize("name", ["close", "step"])
def test_closing_an_idle_loop_is_refused_with_advice(begin: Callable[[], State], name: str) -> None:
    _, outputs = advance(DEFAULTS, begin(), Request(0, name, values=(3.0,) if name == "step" else ()))
    check_reply(outputs, False, "lowfc commission")


def test_a_calibration_ends_the_idle_mode_and_the_mirror_keeps_its_shape() -> None:
    state, _ = advance(DEFAULTS, idle(shape_nm=30.0), Request(0, "load", calibration=calibration()))
    assert DEFAULTS.start_mode is LoopMode.CLOSED
    assert state.mode is LoopMode.OPEN, "a loaded calibration does not close the loop"
    state, all_outputs = feed(DEFAULTS, state, frame(4, WAVE_NM))
    assert np.allclose(surfaces(all_outputs), 30, atol=1e-3)
    assert all_outputs[0].step.error_nm is not None


def test_a_matching_camera_ends_the_idle_mode() -> None:
    state, all_outputs = feed(DEFAULTS, misfit_camera(), CAMERA)
    assert state.mode is LoopMode.OPEN
    assert names(all_outputs) == ["MODE_CHANGED"]


def test_a_camera_that_does_not_fit_a_measured_calibration_opens_the_loop() -> None:
    """Here the frames have another size: with a computed calibration the loop would be idle."""
    state, _ = feed(DEFAULTS, State(), Load(0, calibration(), "a file"), replace(CAMERA, shape=MISFIT_IMAGE.shape))
    assert state.mode is LoopMode.OPEN


def test_a_probe_sequence_advances_also_with_refused_frames() -> None:
    closed, _ = feed(DEFAULTS, State(), Load(0, calibration(), "test"), *(frame(count) for count in range(1, 4)))
    state = play(closed, np.ones((5, 1), np.float32), 0.1 * BASIS)
    dark = np.zeros(SHAPE, np.uint16)
    state, _ = feed(DEFAULTS, state, frame(4, pixels=dark))
    stopped = advance(DEFAULTS, state, Request(0, "stop"))[1]
    assert stopped.reply.text == "probe sequence stopped on the mirror: 4 of 5 frames were left"
    state, _ = feed(DEFAULTS, state, *(frame(count, pixels=dark) for count in range(5, 10)))
    state, outputs = advance(DEFAULTS, state, Request(0, "stop"))
    assert outputs.reply.text == "no probe sequence is being played"
    play(state, np.ones((5, 1), np.float32), 0.1 * BASIS)


def test_a_frame_timeout_ends_the_probe_sequence() -> None:
    state = play(idle(), np.ones((5, 1), np.float32))
    state, all_outputs = feed(DEFAULTS, state, misfit_frame(4), Tick(0, DEFAULTS.frame_timeout_ns + 1))
    assert "PLAY_ENDED" in names(all_outputs)
    state = play(state, np.ones((5, 1), np.float32))
    tick = Tick(0, DEFAULTS.frame_timeout_ns + 2)
    assert names(feed(replace(DEFAULTS, on_frame_timeout="flat"), state, tick)[1]) == ["PLAY_ENDED"]
    assert names(feed(replace(DEFAULTS, on_frame_timeout="hold"), state, tick)[1]) == []


@pytest.mark.parametrize(("rows", "request_name", "events"), [(5, "status", 1), (5, "stop", 0), (1, "status", 0)])
def test_a_probe_sequence_raises_one_event_only_if_it_ends_early_and_without_a_request(
    rows: int, request_name: str, events: int
) -> None:
    restarted = frame(0, pixels=MISFIT_IMAGE, sequence=frame_sequence(0, START + 60))
    causes_of_end = Tick(0, DEFAULTS.frame_timeout_ns + 1), MirrorReport(0, "does not answer"), restarted
    state = play(idle(), np.ones((rows, 1), np.float32))
    _, all_outputs = feed(DEFAULTS, state, misfit_frame(4), Request(0, request_name), *causes_of_end)
    assert "CAMERA_RESTARTED" in names(all_outputs)
    assert names(all_outputs).count("PLAY_ENDED") == events


def test_a_decoded_state_continues_identically() -> None:
    state = play(idle(shape_nm=30.0), np.ones((5, 1), np.float32))
    table = state.loop.command_channels.play.table
    message = controller_state(state, DEFAULTS, 0)
    _, decoded = decode_state(message, None, {}, {table.id: table})
    later_frames = [misfit_frame(count) for count in range(4, 12)]
    assert np.array_equal(
        surfaces(feed(DEFAULTS, state, *later_frames)[1]), surfaces(feed(DEFAULTS, decoded, *later_frames)[1])
    )


def test_a_probe_sequence_is_refused_without_a_mirror() -> None:
    _, outputs = advance(DEFAULTS, State(), Request(0, "play", text=MIRROR, actuators_nm=BASIS, table=BASIS[:1, None]))
    assert "no mirror" in outputs.reply.text
