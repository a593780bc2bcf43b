"""A camera that is known to be wrong is not closed on; one that restarted is waited for; clear begins anew."""

from dataclasses import replace

import pytest

from lowfc.contract.codecs.calibration_codec import decode_calibration, encode_calibration, identified
from lowfc.contract.messages import wire
from lowfc.control.loop.advance import advance
from lowfc.control.loop.camera import CameraSettings, changes
from lowfc.control.loop.inputs import Input, Load, MirrorShape, Reply, Request
from lowfc.control.loop.safety import LoopMode, Reason
from lowfc.control.loop.state import State
from tests.support.theory import linear
from tests.support.toy import CAMERA, DARK_DN, START, calibration, feed, frame, frame_sequence, loaded, settings

USUAL = settings(rate_hz=1000.0)
WRONG = replace(CAMERA, bias_dn=DARK_DN + 60)


def answer(state: State, name: str, **fields: object) -> tuple[State, Reply]:
    state, outputs = advance(USUAL, state, Request(5, name, **fields))  # type: ignore[arg-type]
    assert outputs.reply is not None
    return state, outputs.reply


def opened(*inputs: Input) -> State:
    state, _ = answer(loaded(USUAL), "open")
    return feed(USUAL, state, *inputs)[0]


def test_a_bias_below_the_dark_is_no_reason_not_to_close() -> None:
    state, reply = answer(opened(CAMERA, frame(1)), "close")
    assert reply.accepted
    state, _ = feed(USUAL, state, replace(CAMERA, time_ns=9), frame(2))
    assert state.mode is LoopMode.CLOSED


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
    assert [outputs.step.reasons for outputs in every if outputs.step] == [(Reason.CAMERA_UNKNOWN,)] * 4
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
    assert "the last 3 frames were refused as DARK" in reply.text
    assert answer(feed(USUAL, state, frame(9))[0], "close")[1].accepted


def test_clear_forgets_the_newest_frame() -> None:
    state, _ = feed(
        USUAL, loaded(USUAL), CAMERA, frame(1), frame(1, sequence=frame_sequence(1, START + 86_000)), CAMERA
    )
    state, (late,) = feed(USUAL, state, frame(2))
    assert late.step.reasons == (Reason.OUT_OF_ORDER,)
    state, _ = answer(state, "safe")
    state, reply = answer(state, "clear")
    assert reply.accepted
    state, (outputs,) = feed(USUAL, state, frame(3))
    assert outputs.step.reasons == ()
    assert outputs.command.clear_id == 5


def test_a_frame_from_far_ahead_changes_no_number() -> None:
    state, _ = feed(USUAL, loaded(USUAL), CAMERA, frame(1))
    state, (outputs, after) = feed(USUAL, state, frame(1, sequence=(1 << 64) - (1 << 40), ahead=True), frame(2))
    assert outputs.step.reasons == (Reason.AHEAD,)
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
    assert outputs.step.reasons == (Reason.CAMERA_UNKNOWN,)
