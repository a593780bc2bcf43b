"""A mirror that does not follow commands: the loop raises an event, and holds until the mirror follows again."""

import numpy as np
import pytest

from lowfc.control.laws.linear_law import integrator
from lowfc.control.loop.inputs import Command, Frame, MirrorReport, MirrorShape, Request, Tick
from lowfc.control.loop.safety import LoopMode, Rejection
from lowfc.control.loop.state import LawRunner
from tests.support.toy import GRID, NOLL, WAVE_NM, check_reply, feed, frame, loaded, names, running, settings

DEFAULTS = settings()
LOST, BACK = MirrorReport(0, "does not answer"), MirrorReport(0, "")


def frames(*counts: int) -> list[Frame]:
    return [frame(count, WAVE_NM) for count in counts]


def test_a_lost_mirror_moves_the_command_back_to_its_last_shape() -> None:
    """While the mirror does not follow, the error persists: without the move back the integrator would wind up."""
    last_seen = running()
    wound_up = feed(DEFAULTS, last_seen, *frames(*range(6, 30)))[0]
    assert np.abs(wound_up.loop.history_nm[0] - last_seen.loop.history_nm[0]).max() > 20
    lost = MirrorReport(0, LOST.fault, MirrorShape(0, last_seen.loop.actuators_nm, last_seen.loop.history_nm[0]))
    moved_nm = np.abs(wound_up.loop.actuators_nm - last_seen.loop.actuators_nm).max()
    assert moved_nm > DEFAULTS.limits.slew_nm, "moving back takes more than one step"
    state, all_outputs = feed(DEFAULTS, wound_up, lost, lost)
    assert names(all_outputs) == ["MIRROR_LOST"]
    assert feed(DEFAULTS, state, lost)[0] is state
    state, all_outputs = feed(DEFAULTS, state, *frames(*range(30, 60)))
    assert names(all_outputs) == ["FRAMES_REFUSED"]
    assert state.counts == {Rejection.NO_MIRROR: 30}
    for outputs in all_outputs:
        assert outputs.step.reasons == (Rejection.NO_MIRROR,)
        np.testing.assert_allclose(outputs.command.actuators_nm, last_seen.loop.actuators_nm, atol=1e-3)
    state, all_outputs = feed(DEFAULTS, state, BACK, *frames(60))
    assert names(all_outputs) == ["MIRROR_BACK", "FRAMES_ACCEPTED"]
    expected_nm = feed(DEFAULTS, last_seen, *frames(6))[0].loop.history_nm[0]
    np.testing.assert_allclose(state.loop.history_nm[0], expected_nm, atol=1e-3)


def test_the_move_back_to_the_mirrors_last_shape_keeps_the_slew_limit() -> None:
    state = running(frames=30)
    far = MirrorShape(0, np.full(GRID, -600, np.float32), np.zeros(len(NOLL), np.float32))
    after, (_, outputs) = feed(DEFAULTS, state, MirrorReport(0, LOST.fault, far), *frames(31))
    moved_nm = np.abs(outputs.command.actuators_nm - state.loop.actuators_nm).max()
    assert 0 < moved_nm < DEFAULTS.limits.slew_nm
    np.testing.assert_array_equal(after.loop.actuators_nm, outputs.command.actuators_nm)
    far = MirrorShape(0, np.zeros((2, 2), np.float32), np.zeros(0, np.float32))  # a shape of another grid
    after, _ = feed(DEFAULTS, state, MirrorReport(0, LOST.fault, far))
    np.testing.assert_array_equal(after.loop.actuators_nm, state.loop.actuators_nm)


def test_a_lost_mirror_restarts_the_law() -> None:
    law = integrator(np.full(3, 0.3), np.zeros(3), NOLL, DEFAULTS.delay_frames, 1000.0)
    state = feed(DEFAULTS, running(), Request(0, "law", law=law), *frames(*range(6, 300)))[0]
    assert state.loop.law_runner.weight == 1
    state, _ = feed(DEFAULTS, state, LOST)
    assert state.loop.law_runner.weight == 0
    np.testing.assert_array_equal(state.loop.law_runner.x, LawRunner.at_rest(law, guarded=False).x)


def test_without_a_mirror_an_open_loop_measures_and_is_not_closed() -> None:
    state, all_outputs = feed(DEFAULTS, running(), Request(0, "open"), LOST, *frames(6), Request(0, "close"))
    assert all_outputs[2].step.error_nm is not None
    check_reply(all_outputs[-1], False, "the mirror does not answer", "would only hold")
    check_reply(feed(DEFAULTS, state, Request(0, "step", values=(3.0,)))[1][0], False, "does not answer")
    check_reply(feed(DEFAULTS, state, BACK, *frames(7), Request(0, "close"))[1][-1], True)


def test_a_lost_mirror_ends_the_probe_sequence_and_another_one_is_refused() -> None:
    probe = Request(0, "play", text="offset", table=np.zeros((50, 3), np.float32))
    _, all_outputs = feed(DEFAULTS, running(), probe, *frames(6), LOST, probe)
    check_reply(all_outputs[0], True)
    assert names(all_outputs[2:3]) == ["MIRROR_LOST", "PLAY_ENDED"]
    check_reply(all_outputs[-1], False, "does not answer")


def test_safe_mode_commands_flat_to_a_lost_mirror() -> None:
    state, all_outputs = feed(DEFAULTS, running(frames=30), LOST, Request(0, "safe"), *frames(*range(31, 60)))
    check_reply(all_outputs[1], True)
    assert not all_outputs[-1].command.actuators_nm.any()
    assert state.mode is LoopMode.SAFE


def test_before_its_first_report_a_mirror_gets_commands_only_in_safe_mode_and_it_does_not_jump_at_the_first() -> None:
    shape = MirrorShape(0, np.full(GRID, 20, np.float32), np.zeros(0, np.float32))
    absent, timeout = MirrorReport(0, "has not reported yet"), Tick(0, DEFAULTS.frame_timeout_ns + 1)
    state, all_outputs = feed(DEFAULTS, loaded(DEFAULTS), absent, *frames(1, 2), timeout)
    assert [outputs.command for outputs in all_outputs] == [None] * 4
    state, all_outputs = feed(DEFAULTS, state, shape, BACK, *frames(3))
    command = all_outputs[-1].command
    assert isinstance(command, Command)
    assert 0 < np.abs(command.actuators_nm - 20).max() < 15, "one step from its shape"
    channel = Request(0, "channel", text="flat", actuators_nm=np.full(20, 10, np.float32))
    early = feed(
        DEFAULTS, loaded(DEFAULTS), Request(0, "open"), absent, channel, *frames(1, 2), shape, BACK, *frames(3)
    )
    np.testing.assert_allclose(early[1][-1].command.actuators_nm, 30)
    in_safe_mode = feed(DEFAULTS, loaded(DEFAULTS), LOST, Request(0, "safe"), *frames(1))[1][-1]
    assert in_safe_mode.command.safe


@pytest.mark.parametrize("first_frames", [(), frames(1)], ids=["no frame yet", "frames have stopped"])
def test_without_a_camera_the_loop_is_not_closed(first_frames: list[Frame]) -> None:
    setup = settings(start_mode=LoopMode.OPEN)
    state, _ = feed(setup, loaded(setup), *first_frames, Tick(0, DEFAULTS.frame_timeout_ns + 1))
    for request in (Request(0, "close"), Request(0, "step", values=(2.0,))):
        check_reply(feed(setup, state, request)[1][0], False, "no frame comes")
    check_reply(feed(setup, state, *frames(2), Request(0, "close"))[1][-1], True)
