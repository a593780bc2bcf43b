"""A mirror that does not follow: the loop holds, says so, and goes on when it follows again."""

import numpy as np
import pytest

from lowfc.control.laws.linear_law import integrator
from lowfc.control.loop.inputs import Command, Frame, MirrorReport, MirrorShape, Request, Tick
from lowfc.control.loop.safety import LoopMode, Rejection
from lowfc.control.loop.state import LawRunner, State
from tests.support.toy import GRID, NOLL, SOME, answered, feed, frame, loaded, names, settings

USUAL = settings()
LOST, BACK = MirrorReport(0, "does not answer"), MirrorReport(0, "")


def frames(*counts: int) -> list[Frame]:
    return [frame(count, SOME) for count in counts]


def running(count: int = 5) -> State:
    return feed(USUAL, loaded(USUAL), *frames(*range(1, count + 1)))[0]


def shape_of(state: State) -> MirrorShape:
    return MirrorShape(0, state.drive.actuators_nm, state.drive.history_nm[0])


def test_the_loop_goes_back_to_where_the_mirror_was_and_holds_there() -> None:
    """The error stays, for nobody corrects it: without this the integrator goes on to its limits."""
    seen = running(5)
    wound_up = feed(USUAL, seen, *frames(*range(6, 30)))[0]
    assert np.abs(wound_up.drive.history_nm[0] - seen.drive.history_nm[0]).max() > 20
    lost = MirrorReport(0, LOST.fault, shape_of(seen))
    moved_nm = np.abs(wound_up.drive.actuators_nm - seen.drive.actuators_nm).max()
    assert moved_nm > USUAL.limits.slew_nm, "it takes more than one step"
    state, every = feed(USUAL, wound_up, lost, lost)
    assert names(every) == ["MIRROR_LOST"]
    assert feed(USUAL, state, lost)[0] is state
    state, every = feed(USUAL, state, *frames(*range(30, 60)))
    assert names(every) == ["FRAMES_REFUSED"]
    assert state.counts == {Rejection.NO_MIRROR: 30}
    for outputs in every:
        assert outputs.step.reasons == (Rejection.NO_MIRROR,)
        np.testing.assert_allclose(outputs.command.actuators_nm, seen.drive.actuators_nm, atol=1e-3)
    state, every = feed(USUAL, state, BACK, *frames(60))
    assert names(every) == ["MIRROR_BACK", "FRAMES_ACCEPTED"]
    np.testing.assert_allclose(
        state.drive.history_nm[0], feed(USUAL, seen, *frames(6))[0].drive.history_nm[0], atol=1e-3
    )


def test_going_back_keeps_the_slew_limit() -> None:
    state = running(30)
    far = MirrorShape(0, np.full(GRID, -600, np.float32), np.zeros(len(NOLL), np.float32))
    after, (_, outputs) = feed(USUAL, state, MirrorReport(0, LOST.fault, far), *frames(31))
    moved_nm = np.abs(outputs.command.actuators_nm - state.drive.actuators_nm).max()
    assert 0 < moved_nm < USUAL.limits.slew_nm
    np.testing.assert_array_equal(after.drive.actuators_nm, outputs.command.actuators_nm)


def test_a_shape_of_another_grid_moves_nothing() -> None:
    state = running()
    other = MirrorShape(0, np.zeros((2, 2), np.float32), np.zeros(0, np.float32))
    after, _ = feed(USUAL, state, MirrorReport(0, LOST.fault, other))
    np.testing.assert_array_equal(after.drive.actuators_nm, state.drive.actuators_nm)


def test_a_law_begins_anew() -> None:
    law = integrator(np.full(3, 0.3), np.zeros(3), NOLL, USUAL.delay_frames, 1000.0)
    state = feed(USUAL, running(), Request(0, "law", law=law), *frames(*range(6, 300)))[0]
    assert state.drive.following.weight == 1
    state, _ = feed(USUAL, state, LOST)
    assert state.drive.following.weight == 0
    np.testing.assert_array_equal(state.drive.following.x, LawRunner.at_rest(law, guarded=False).x)


def test_an_open_loop_measures_without_a_mirror_and_is_not_closed() -> None:
    state, every = feed(USUAL, running(), Request(0, "open"), LOST, *frames(6), Request(0, "close"))
    assert every[2].step.error_nm is not None
    answered(every[-1], False, "the mirror does not answer", "would only hold")
    answered(feed(USUAL, state, Request(0, "step", values=(3.0,)))[1][0], False, "does not answer")
    answered(feed(USUAL, state, BACK, *frames(7), Request(0, "close"))[1][-1], True)


def test_a_probe_ends_and_none_begins() -> None:
    probe = Request(0, "play", text="offset", table=np.zeros((50, 3), np.float32))
    _, every = feed(USUAL, running(), probe, *frames(6), LOST, probe)
    answered(every[0], True)
    assert names(every[2:3]) == ["MIRROR_LOST", "PLAY_ENDED"]
    answered(every[-1], False, "does not answer")


def test_safe_is_granted_and_flattens() -> None:
    state, every = feed(USUAL, running(30), LOST, Request(0, "safe"), *frames(*range(31, 60)))
    answered(every[1], True)
    assert not every[-1].command.actuators_nm.any()
    assert state.mode is LoopMode.SAFE


def test_a_mirror_that_has_not_reported_gets_no_command_and_then_does_not_jump() -> None:
    there = MirrorShape(0, np.full(GRID, 20, np.float32), np.zeros(0, np.float32))
    silent = Tick(0, USUAL.frame_timeout_ns + 1)
    state, every = feed(USUAL, loaded(USUAL), MirrorReport(0, "has not reported yet"), *frames(1, 2), silent)
    assert [outputs.command for outputs in every] == [None] * 4
    state, every = feed(USUAL, state, there, BACK, *frames(3))
    command = every[-1].command
    assert isinstance(command, Command)
    assert 0 < np.abs(command.actuators_nm - 20).max() < 15, "one step from where it was"
    safed = feed(USUAL, loaded(USUAL), LOST, Request(0, "safe"), *frames(1))[1][-1]
    assert safed.command.safe


@pytest.mark.parametrize("taken", [(), frames(1)], ids=["never", "no more"])
def test_without_a_camera_the_loop_is_not_closed(taken: list[Frame]) -> None:
    opened = settings(start_mode=LoopMode.OPEN)
    state, _ = feed(opened, loaded(opened), *taken, Tick(0, USUAL.frame_timeout_ns + 1))
    for request in (Request(0, "close"), Request(0, "step", values=(2.0,))):
        answered(feed(opened, state, request)[1][0], False, "no frame comes")
    answered(feed(opened, state, *frames(2), Request(0, "close"))[1][-1], True)
