"""Interlocks on values of the bench, and permits: they only ever make the loop safer."""

import numpy as np
import pytest

from lowfc.contract.codecs import codec
from lowfc.contract.messages import wire
from lowfc.control.loop.advance import advance
from lowfc.control.loop.command_channels import MIRROR
from lowfc.control.loop.inputs import Outputs, Request
from lowfc.control.loop.interlocks import Action, BenchReport, Interlock, Value
from lowfc.control.loop.safety import LoopMode, Rejection
from lowfc.control.loop.state import Settings, State
from tests.support.toy import GRID, SOME, answered, feed, frame, loaded, names, settings

S = 1_000_000_000
MOVER = 7


def under(action: Action, test: str = "equal", value: Value = True, *, acts_when_old: bool = True) -> Settings:
    """Settings with one interlock, on the value `mask`."""
    return settings(rate_hz=1000.0, interlocks=(Interlock("mask", test, value, action, 2 * S, acts_when_old),))


def mask(value: Value | None, age_ns: int = 0) -> BenchReport:
    return BenchReport(5, "mask", value, age_ns)


def running(what: Settings, frames: int = 5) -> State:
    """A closed loop on which no interlock acts."""
    quiet = next(one for one in (False, 0.0, "still") if type(one) is type(what.interlocks[0].value))
    return feed(what, loaded(what), mask(quiet), *(frame(count, SOME) for count in range(1, frames + 1)))[0]


def asked(what: Settings, state: State, name: str, **fields: object) -> tuple[State, Outputs]:
    return advance(what, state, Request(0, name, **fields))


@pytest.mark.parametrize(
    ("test", "value", "taken", "why"),
    [
        ("equal", True, True, "mask is true"),
        ("equal", True, False, ""),
        ("different", "parked", "moving", "mask is 'moving', not 'parked'"),
        ("different", "parked", "parked", ""),
        ("above", 3.0, 3.5, "mask is 3.5, above 3"),
        ("above", 3.0, 3.0, ""),
        ("below", 3.0, 2.5, "mask is 2.5, below 3"),
        ("below", 3.0, 4.0, ""),
        ("above", 0.5, True, "mask is true, no number"),
        ("equal", True, "true", "mask is 'true', no truth"),
        ("equal", 1.0, None, "no value of mask has been received"),
    ],
)
def test_what_a_condition_is(test: str, value: Value, taken: Value | None, why: str) -> None:
    interlock = Interlock("mask", test, value, Action.HOLD, 2 * S)
    assert interlock.acts(taken, 2 * S) == why
    assert (interlock._replace(acts_when_old=False).acts(taken, 0) == why) is (not why or type(taken) is type(value))
    assert interlock.acts(taken, 2 * S + 1)
    assert not interlock._replace(acts_when_old=False).acts(taken, 2 * S + 1)


def test_a_hundred_flips_hold_the_command_at_the_next_frame_and_let_go_again() -> None:
    """At random moments; everything that came in goes through the log's form, and its fold is the same to the byte."""
    what, rng = under(Action.HOLD), np.random.default_rng(5)
    state = running(what)
    count, acts, flips, logged = 5, False, 0, []
    begin = state
    while flips < 100:
        taken = frame(count := count + 1, rng.normal(0, 10, 3))
        if rng.random() < 0.3:
            acts, flips, taken = not acts, flips + 1, mask(not acts)
            count -= 1
        before, (state, outputs) = state, advance(what, state, taken)
        logged.append((taken, outputs))
        if outputs.step is not None:
            assert outputs.step.mode is LoopMode.CLOSED
            assert outputs.step.reasons == ((Rejection.HELD,) if acts else ())
            if acts:
                np.testing.assert_array_equal(outputs.command.actuators_nm, before.drive.actuators_nm)
        else:
            assert [event.name for event in outputs.events] == ["INTERLOCK_ACTS" if acts else "INTERLOCK_CLEARED"]
    again = begin
    for taken, outputs in logged:
        if isinstance(taken, BenchReport):
            taken = codec.decode_input(wire.ControlInput.FromString(codec.encode_input(taken, 3)), {})
        again, replayed = advance(what, again, taken)
        if outputs.step is not None:
            assert codec.encode_step(replayed.step, again.input_number) == codec.encode_step(
                outputs.step, again.input_number
            )
    assert again.input_number == state.input_number


@pytest.mark.parametrize(
    ("action", "mode"),
    [
        (Action.WARN, LoopMode.CLOSED),
        (Action.REFUSE_CLOSE, LoopMode.CLOSED),
        (Action.HOLD, LoopMode.CLOSED),
        (Action.OPEN, LoopMode.OPEN),
        (Action.SAFE, LoopMode.SAFE),
    ],
)
def test_what_follows_and_that_nothing_is_undone_when_it_acts_no_more(action: Action, mode: LoopMode) -> None:
    what = under(action)
    state, every = feed(what, running(what), mask(True), mask(True))
    assert state.mode is mode
    changed = ["MODE_CHANGED"] if mode is not LoopMode.CLOSED else []
    assert names(every) == ["INTERLOCK_ACTS", *changed, *(["SAFED"] if mode is LoopMode.SAFE else [])]
    state, _ = asked(what, state, "open") if mode is LoopMode.CLOSED else (state, None)
    refused, clears = action is not Action.WARN, mode is LoopMode.SAFE
    for name, values in (("close", ()), ("step", (3.0,))):
        _, outputs = asked(what, state, name, values=values)
        answered(outputs, not refused, *(["mask is true"] if refused and not clears else []))
    if clears:
        _, outputs = asked(what, state, "clear")
        answered(outputs, False, "an interlock acts: mask is true")
    after, every = feed(what, state, mask(False))
    assert names(every) == ["INTERLOCK_CLEARED"]
    assert after.mode is state.mode
    after, outputs = asked(what, after, "clear" if clears else "close")
    answered(outputs, True)


@pytest.mark.parametrize("action", [Action.REFUSE_CLOSE, Action.OPEN, Action.SAFE])
def test_a_loop_that_starts_closed_is_opened_by_what_refuses_to_close_it(action: Action) -> None:
    what = under(action)
    for value in (None, True):
        state, _ = feed(what, loaded(what), mask(value))
        assert state.mode is (LoopMode.SAFE if action is Action.SAFE else LoopMode.OPEN)


def test_only_a_change_of_side_is_an_input_that_is_logged() -> None:
    what = under(Action.HOLD, "above", 3.0)
    state = running(what)
    acting, _ = advance(what, state, mask(4.0))
    assert acting.input_number == state.input_number + 1
    for value, before in ((2.0, state), (5.0, acting)):
        after, outputs = advance(what, before, mask(value))
        assert after is before
        assert outputs == Outputs()
    assert advance(what, state, BenchReport(5, "another", True))[0] is state


def test_a_publisher_that_died_counts_as_configured() -> None:
    for acts in (True, False):
        what = under(Action.HOLD, acts_when_old=acts)
        state, every = feed(what, running(what), mask(False, 2 * S + 1), frame(6, SOME))
        assert bool(state.conditions.acting) is acts
        assert every[-1].step.reasons == ((Rejection.HELD,) if acts else ())
        what = under(Action.HOLD, acts_when_old=acts)
        state, every = feed(what, running(what), mask(True), mask(True, 2 * S + 1))
        assert [one.why for one in state.conditions.acting] == ["no value of mask for more than 2 s"] * acts
        assert names(every) == ["INTERLOCK_ACTS", "INTERLOCK_ACTS" if acts else "INTERLOCK_CLEARED"]


def test_in_an_open_loop_a_hold_measures_on() -> None:
    what = under(Action.HOLD)
    state, _ = asked(what, running(what), "open")
    _, every = feed(what, state, mask(True), frame(6, SOME))
    assert every[-1].step.error_nm is not None


# Permits.


def permit(what: Settings, state: State, seconds: float = 0.0, **fields: object) -> tuple[State, Outputs]:
    values = (seconds,) if seconds else ()
    return asked(what, state, "permit", text="moving the mask", values=values, lease_id=MOVER, **fields)


def test_a_closed_loop_is_held_for_a_bounded_time_and_goes_on_by_itself() -> None:
    what = under(Action.WARN)
    state = running(what)
    _, outputs = permit(what, state)
    answered(outputs, False, "the loop is closed")
    state, outputs = permit(what, state, 0.01)
    answered(outputs, True, "granted for 0.01 s: the loop holds its command")
    state, every = feed(what, state, *(frame(count, SOME) for count in range(6, 18)))
    assert [one.step.reasons for one in every] == [(Rejection.HELD,)] * 10 + [()] * 2
    assert names(every) == ["FRAMES_REFUSED", "LEASE_ENDED", "FRAMES_ACCEPTED"]
    assert state.conditions.lease.ended == "its time is over"
    assert state.mode is LoopMode.CLOSED


def test_it_is_released_and_anybody_may_open_the_loop_meanwhile() -> None:
    what = under(Action.WARN)
    held, _ = permit(what, running(what), 5.0)
    _, outputs = asked(what, held, "gain", values=(0.1,))
    answered(outputs, False, "reserved for moving the mask")
    state, outputs = asked(what, held, "release", lease_id=MOVER)
    _, every = feed(what, state, frame(6, SOME))
    assert every[-1].step.reasons == ()
    state, outputs = asked(what, held, "open")
    answered(outputs, True, "this ended the reservation for moving the mask")


def test_it_is_granted_where_nothing_follows_what_moves() -> None:
    what = under(Action.WARN)
    for name in ("open", "safe"):
        state, _ = asked(what, running(what), name)
        for seconds in (0.0, 5.0):
            after, outputs = permit(what, state, seconds)
            answered(outputs, True, f"the loop is {state.mode.in_words}")
        _, outputs = asked(what, after, "close" if name == "open" else "clear")
        answered(outputs, False, "reserved for moving the mask")


def test_it_is_refused_while_the_loop_is_reserved_or_measures() -> None:
    what = under(Action.WARN)
    reserved, _ = asked(what, running(what), "lease", text="a calibration", values=(10.0,), lease_id=3)
    shape, table = np.full(GRID, 3, np.float32).reshape(-1), np.ones((50, 1), np.float32)
    played, outputs = asked(what, running(what), "play", text=MIRROR, actuators_nm=shape, table=table)
    answered(outputs, True)
    for state, why in ((reserved, "a calibration"), (played, "a probe sequence is being played")):
        for seconds in (0.0, 5.0):
            after, outputs = permit(what, state, seconds)
            answered(outputs, False, why)
            assert after.conditions.lease == state.conditions.lease
    _, outputs = permit(what, running(what), 61.0)
    answered(outputs, False, "at most 60 s")


def test_a_renewed_permit_holds_on() -> None:
    what = under(Action.WARN)
    state, _ = permit(what, running(what), 5.0)
    state, outputs = asked(what, state, "renew", text="moving the mask", values=(5.0,), lease_id=MOVER)
    answered(outputs, True)
    assert feed(what, state, frame(6, SOME))[1][-1].step.reasons == (Rejection.HELD,)
