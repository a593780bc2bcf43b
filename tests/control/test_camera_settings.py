"""When the loop may close: not on a wrong or restarted camera, not without a calibration."""

from dataclasses import replace

import numpy as np
import pytest

from lowfc.arrays import Single
from lowfc.contract.codecs.calibration_codec import decode_calibration, encode_calibration, identified
from lowfc.contract.codecs.state_codec import controller_state, decode_state
from lowfc.contract.messages import wire
from lowfc.control.loop.advance import advance
from lowfc.control.loop.camera import CameraSettings, changes
from lowfc.control.loop.command_channels import MIRROR
from lowfc.control.loop.inputs import Frame, Input, Load, MirrorShape, Outputs, Reply, Request, Tick
from lowfc.control.loop.safety import Limit, LoopMode, Rejection
from lowfc.control.loop.state import State
from tests.support.safety_checks import violations
from tests.support.theory import linear
from tests.support.toy import (
    CAMERA,
    DARK_DN,
    GRID,
    SHAPE,
    SOME,
    START,
    answered,
    calibration,
    feed,
    frame,
    frame_sequence,
    loaded,
    names,
    settings,
)

USUAL = settings(rate_hz=1000.0)
WRONG = replace(CAMERA, bias_dn=DARK_DN + 60)


def answer(state: State, name: str, **fields: object) -> tuple[State, Reply]:
    state, outputs = advance(USUAL, state, Request(5, name, **fields))  # type: ignore[arg-type]
    assert outputs.reply is not None
    return state, outputs.reply


def opened(*inputs: Input) -> State:
    state, _ = answer(loaded(USUAL), "open")
    return feed(USUAL, state, *inputs)[0]


def test_a_camera_that_no_longer_fits_opens_the_loop() -> None:
    """A bias below the dark is no reason: clock-induced charge and dark current lie between them."""
    state, every = feed(USUAL, loaded(USUAL), frame(1), CAMERA)
    assert (state.mode, names(every)) == (LoopMode.CLOSED, [])
    assert feed(USUAL, state, replace(CAMERA, time_ns=9)) == (state, [Outputs()])
    state, every = feed(USUAL, state, WRONG)
    assert (state.mode, names(every)) == (LoopMode.OPEN, ["CAMERA_CHANGED", "MODE_CHANGED"])
    assert "bias_dn" in str(every[0].events[0].details["what"])
    assert state.conditions.mode_cause.startswith("the camera does not fit the calibration")


@pytest.mark.parametrize("name", ["close", "step", "law"])
def test_a_camera_that_changed_is_not_closed_on(name: str) -> None:
    law = linear(USUAL.law((2, 3, 4)))
    fields: dict[str, object] = {"close": {}, "step": {"values": (9.0,)}, "law": {"law": law}}[name]
    state = opened(CAMERA, frame(1), WRONG)
    after, reply = answer(state, name, **fields)
    assert not reply.accepted
    assert "bias_dn is 160, calibrated 60" in reply.text
    assert (after.mode, after.steps_left) == (LoopMode.OPEN, 0)
    state, _ = feed(USUAL, state, CAMERA)
    assert answer(state, name, **fields)[1].accepted


def test_a_calibration_with_settings_is_compared_with_those() -> None:
    measured = identified(replace(calibration(), camera=CAMERA))
    state, _ = feed(USUAL, State(), Load(0, measured, "test"), WRONG)
    assert state.mode is LoopMode.OPEN
    state, _ = feed(USUAL, State(), WRONG, Load(0, measured, "test"))
    assert state.mode is LoopMode.OPEN
    assert "bias_dn" in state.conditions.mode_cause


def test_settings_of_a_calibration_belong_to_its_identity_only_where_there_are_some() -> None:
    plain, measured = identified(calibration()), identified(replace(calibration(), camera=CAMERA))
    assert plain.id != measured.id
    again = decode_calibration(wire.Calibration.FromString(encode_calibration(measured, 7)))
    assert again.camera == replace(CAMERA, time_ns=again.camera.time_ns if again.camera else 0)
    assert identified(replace(measured, camera=replace(CAMERA, time_ns=77, start_s=8))).id == measured.id


@pytest.mark.parametrize(
    ("now", "different"),
    [
        (replace(CAMERA, bias_dn=CAMERA.bias_dn + 2.9), []),
        (replace(CAMERA, bias_dn=CAMERA.bias_dn + 3.1), ["bias_dn"]),
        (replace(CAMERA, shape=(7, 8)), ["rows", "columns"]),
        (replace(CAMERA, saturation_dn=4095.0), ["saturation_dn"]),
        (replace(CAMERA, em_gain=300.0), ["em_gain"]),
        (replace(CAMERA, gain_e_per_dn=1.005), []),
        (replace(CAMERA, gain_e_per_dn=2.0), ["gain_e_per_dn"]),
        (replace(CAMERA, region=(4, 0)), ["region_row"]),
        (replace(CAMERA, start_s=START + 5), []),
        (replace(CAMERA, bias_dn=float("nan")), ["bias_dn"]),
    ],
)
def test_settings_differ_beyond_the_noise(now: CameraSettings, different: list[str]) -> None:
    assert [line.split()[0] for line in changes(now, CAMERA)] == different


def test_after_a_restart_nothing_is_integrated_before_the_cameras_settings_came() -> None:
    state, _ = feed(USUAL, loaded(USUAL), CAMERA, *(frame(count, (20, 0, 0)) for count in range(1, 6)))
    anew = [frame(1, (20, 0, 0), sequence=frame_sequence(count, START + 9)) for count in range(4)]
    before_nm = state.drive.history_nm[0] if state.drive is not None else None
    state, every = feed(USUAL, state, *anew)
    assert [outputs.step.reasons for outputs in every if outputs.step] == [(Rejection.CAMERA_UNKNOWN,)] * 4
    assert (state.drive.history_nm[0] == before_nm).all()
    assert not answer(answer(state, "open")[0], "close")[1].accepted
    state, every = feed(
        USUAL, state, replace(CAMERA, start_s=START + 9), frame(1, sequence=frame_sequence(9, START + 9))
    )
    assert every[-1].step.reasons == ()


def test_settings_that_came_before_the_first_frame_of_a_restarted_camera_are_its_own() -> None:
    state, _ = feed(USUAL, loaded(USUAL), CAMERA, frame(1), replace(CAMERA, start_s=START + 9))
    state, (outputs,) = feed(USUAL, state, frame(1, sequence=frame_sequence(0, START + 9)))
    assert outputs.step.reasons == ()


def test_the_loop_is_not_closed_while_frames_are_refused() -> None:
    dark = [frame(count, pixels=frame(1).pixels * 0) for count in range(2, 5)]  # type: ignore[operator]
    state = opened(CAMERA, frame(1), *dark[:2])
    assert answer(state, "close")[1].accepted, "two may be a hiccup"
    state, _ = feed(USUAL, state, dark[2])
    _, reply = answer(state, "close")
    assert not reply.accepted
    assert "frames are refused as DARK" in reply.text
    assert answer(feed(USUAL, state, frame(9))[0], "close")[1].accepted


def test_clear_forgets_the_newest_frame() -> None:
    state, _ = feed(
        USUAL, loaded(USUAL), CAMERA, frame(1), frame(1, sequence=frame_sequence(1, START + 86_000)), CAMERA
    )
    state, (late,) = feed(USUAL, state, frame(2))
    assert late.step.reasons == (Rejection.OUT_OF_ORDER,)
    state, _ = answer(state, "safe")
    state, reply = answer(state, "clear")
    assert reply.accepted
    state, (outputs,) = feed(USUAL, state, frame(3))
    assert outputs.step.reasons == ()
    assert outputs.command.clear_id == 5


def test_a_frame_from_far_ahead_changes_no_number() -> None:
    state, _ = feed(USUAL, loaded(USUAL), CAMERA, frame(1))
    state, (outputs, after) = feed(USUAL, state, frame(1, sequence=(1 << 64) - (1 << 40), ahead=True), frame(2))
    assert outputs.step.reasons == (Rejection.AHEAD,)
    assert after.step.reasons == ()


def test_commands_say_that_the_loop_is_safe_and_the_mirror_is_a_witness_of_it() -> None:
    state, _ = answer(loaded(USUAL), "safe")
    _, (outputs,) = feed(USUAL, state, frame(1))
    assert outputs.command.safe
    shape = outputs.command.actuators_nm
    restarted, (seen,) = feed(USUAL, loaded(USUAL), MirrorShape(0, shape, outputs.command.command_nm, safe=True))
    assert restarted.mode is LoopMode.SAFE
    assert [event.name for event in seen.events][:2] == ["MODE_CHANGED", "SAFED"]
    restarted, _ = feed(USUAL, loaded(USUAL), MirrorShape(0, shape, outputs.command.command_nm))
    assert restarted.mode is LoopMode.CLOSED


def test_after_a_clear_another_start_of_the_camera_is_waited_for_too() -> None:
    state, _ = feed(USUAL, loaded(USUAL), CAMERA, frame(1))
    for name in ("safe", "clear"):
        state, _ = answer(state, name)
    state, (outputs,) = feed(USUAL, state, frame(1, sequence=frame_sequence(0, START + 9)))
    assert outputs.step.reasons == (Rejection.CAMERA_UNKNOWN,)


ODD = np.full((8, 9), 5000, np.uint16)
BASIS = np.arange(GRID[0] * GRID[1], dtype=np.float32)


def odd(count: int) -> Frame:
    """A frame of another size."""
    return frame(count, pixels=ODD)


def idle(frames: int = 3, shape_nm: float = 0.0) -> State:
    """A controller without a calibration, whose mirror has reported its shape."""
    actuators = np.full(GRID, shape_nm, np.float32)
    state, _ = feed(USUAL, State(), MirrorShape(0, actuators, np.zeros(0, np.float32)))
    return feed(USUAL, state, *(odd(count) for count in range(1, frames + 1)))[0]


def play(state: State, table: Single, basis: Single = BASIS) -> State:
    state, outputs = advance(USUAL, state, Request(0, "play", text=MIRROR, actuators_nm=basis, table=table))
    answered(outputs, True)
    return state


def surfaces(every: list[Outputs]) -> Single:
    """(frames, actuators) of the commands."""
    return np.array([one.command.actuators_nm.reshape(-1) for one in every if one.command is not None])


def other_size() -> State:
    """The model's calibration, and a camera of another size."""
    computed = replace(calibration(), operator_hash="model")
    state, _ = feed(USUAL, State(), Load(0, computed, "the configuration"), replace(CAMERA, shape=ODD.shape))
    return feed(USUAL, state, *(odd(count) for count in range(1, 4)))[0]


@pytest.mark.parametrize("begin", [idle, other_size])
def test_a_probe_sequence_is_on_the_mirror_frame_by_frame(begin: object) -> None:
    state = begin()  # type: ignore[operator]
    assert state.mode is LoopMode.IDLE
    table = np.array([[1], [-2], [3]], np.float32)
    state, every = feed(USUAL, play(state, table), *(odd(count) for count in range(4, 9)))
    assert np.allclose(surfaces(every), np.vstack([table * BASIS, 0 * BASIS, 0 * BASIS]))
    for outputs in every:
        assert outputs.step.error_nm is None
        assert outputs.step.reasons[0] in (Rejection.NO_CALIBRATION, Rejection.WRONG_SIZE)


def test_a_limit_ends_it() -> None:
    steep = np.zeros(GRID, np.float32)
    steep[0, 0] = USUAL.limits.stroke_nm - 1
    table = np.ones((50, 1), np.float32)
    state = play(idle(), table, steep.reshape(-1))
    before = surfaces([advance(USUAL, state, Tick(0, 0))[1]])[0].reshape(GRID)
    for count in range(4, 30):
        state, outputs = advance(USUAL, state, odd(count))
        now = outputs.command.actuators_nm
        assert violations(USUAL.limits, before, now) == []
        before = now
    assert state.limits_hit == ()
    assert not before.any()
    state = play(state, table, steep.reshape(-1))
    _, every = feed(USUAL, state, odd(40))
    assert "PLAY_ENDED" in names(every)
    assert Limit.SLEW in every[0].step.reasons


def test_the_mirror_stays_where_it_was_and_safe_relaxes_it() -> None:
    state, every = feed(USUAL, idle(shape_nm=30.0), odd(4))
    assert np.allclose(surfaces(every), 30)
    state, outputs = advance(USUAL, state, Request(0, "safe"))
    answered(outputs, True)
    state, every = feed(USUAL, state, odd(5), odd(6))
    assert not surfaces(every)[-1].any()
    state, _ = advance(USUAL, state, Request(0, "clear"))
    assert state.mode is LoopMode.IDLE


def test_what_was_made_safe_before_the_controller_started_stays_so() -> None:
    safe = settings(start_mode=LoopMode.SAFE)
    state, every = feed(safe, State(), MirrorShape(0, np.full(GRID, 30, np.float32), np.zeros(0, np.float32)))
    assert names(every) == ["NOT_CALIBRATED", "MODE_CHANGED", "SAFED"]
    _, every = feed(safe, state, odd(1))
    assert not surfaces(every).any()


@pytest.mark.parametrize("begin", [idle, other_size])
@pytest.mark.parametrize("name", ["close", "step"])
def test_it_is_not_closed_and_says_what_is_missing(begin: object, name: str) -> None:
    _, outputs = advance(USUAL, begin(), Request(0, name, values=(3.0,) if name == "step" else ()))  # type: ignore[operator]
    answered(outputs, False, "lowfc commission")


def test_a_calibration_ends_it_and_leaves_the_mirror_where_it_is() -> None:
    state = idle(shape_nm=30.0)
    request = Request(0, "load", calibration=calibration())
    state, _ = advance(USUAL, state, request)
    assert USUAL.start_mode is LoopMode.CLOSED
    assert state.mode is LoopMode.OPEN, "what may be a first try closes nothing"
    state, every = feed(USUAL, state, frame(4, SOME))
    assert np.allclose(surfaces(every), 30, atol=1e-3)
    assert every[0].step.error_nm is not None


def test_the_right_camera_ends_it() -> None:
    state, every = feed(USUAL, other_size(), CAMERA)
    assert state.mode is LoopMode.OPEN
    assert names(every) == ["MODE_CHANGED"]


def test_a_calibration_from_a_file_is_not_the_models() -> None:
    """The loop opens, as for any other camera that does not fit."""
    state, _ = feed(USUAL, State(), Load(0, calibration(), "a file"), replace(CAMERA, shape=ODD.shape))
    assert state.mode is LoopMode.OPEN


def test_a_sequence_whose_frames_are_refused_ends_with_its_frames() -> None:
    closed, _ = feed(USUAL, State(), Load(0, calibration(), "test"), *(frame(count) for count in range(1, 4)))
    state = play(closed, np.ones((5, 1), np.float32), 0.1 * BASIS)
    dark = np.zeros(SHAPE, np.uint16)
    state, _ = feed(USUAL, state, frame(4, pixels=dark))
    stopped = advance(USUAL, state, Request(0, "stop"))[1]
    assert stopped.reply.text == "stopped on the mirror: 4 of 5 frames were left"
    state, _ = feed(USUAL, state, *(frame(count, pixels=dark) for count in range(5, 10)))
    state, outputs = advance(USUAL, state, Request(0, "stop"))
    assert outputs.reply.text == "nothing is being played"
    play(state, np.ones((5, 1), np.float32), 0.1 * BASIS)


def test_a_sequence_ends_when_the_camera_falls_silent() -> None:
    state = play(idle(), np.ones((5, 1), np.float32))
    state, every = feed(USUAL, state, odd(4), Tick(0, USUAL.frame_timeout_ns + 1))
    assert "PLAY_ENDED" in names(every)
    play(state, np.ones((5, 1), np.float32))


def test_a_state_in_the_log_goes_on_alike() -> None:
    state = play(idle(shape_nm=30.0), np.ones((5, 1), np.float32))
    table = state.drive.command_channels.play.table
    message = controller_state(state, USUAL, 0)
    _, again = decode_state(message, None, {}, {table.id: table})
    rest = [odd(count) for count in range(4, 12)]
    assert np.array_equal(surfaces(feed(USUAL, state, *rest)[1]), surfaces(feed(USUAL, again, *rest)[1]))


def test_without_a_mirror_nothing_is_played() -> None:
    _, outputs = advance(USUAL, State(), Request(0, "play", text=MIRROR, actuators_nm=BASIS, table=BASIS[:1, None]))
    assert "no mirror" in outputs.reply.text
