"""Interlocks on bench values, and permits: when they act, and that they only make the loop safer."""

import numpy as np
import pytest

from lowfc.contract.codecs import codec
from lowfc.contract.messages import wire
from lowfc.control.loop.advance import advance
from lowfc.control.loop.command_channels import MIRROR
from lowfc.control.loop.inputs import Load, Outputs, Request
from lowfc.control.loop.interlocks import Action, BenchReport, Interlock, Value
from lowfc.control.loop.loading import holding_cause
from lowfc.control.loop.safety import LoopMode, Rejection
from lowfc.control.loop.state import Settings, State
from lowfc.control.loop.wording import MEASURED_FIRST
from tests.support.toy import GRID, WAVE_NM, calibration, check_reply, feed, frame, loaded, names, settings

SECOND_NS = 1_000_000_000
MOVER = 7
"""Identity of the lease of the client that moves the mask."""


def settings_under(action: Action, test: str = "equal", value: Value = True, *, acts_when_old: bool = True) -> Settings:
    """Settings with one interlock, on the value `mask`."""
    return settings(rate_hz=1000.0, interlocks=(Interlock("mask", test, value, action, 2 * SECOND_NS, acts_when_old),))


def mask(value: Value | None, age_ns: int = 0) -> BenchReport:
    return BenchReport(5, "mask", value, age_ns)


def running(setup: Settings) -> State:
    """A closed loop without an acting interlock."""
    quiet = mask(type(setup.interlocks[0].value)())  # False, or 0
    return feed(setup, loaded(setup), quiet, *(frame(count, WAVE_NM) for count in range(1, 6)))[0]


def applied(setup: Settings, state: State, name: str, **fields: object) -> tuple[State, Outputs]:
    return advance(setup, state, Request(0, name, **fields))


@pytest.mark.parametrize(
    ("test", "value", "received", "why"),
    [
        ("equal", True, True, "mask is true"),
        ("equal", True, False, ""),
        ("different", "parked", "moving", "mask is 'moving', not 'parked'"),
        ("different", "parked", "parked", ""),
        ("above", 3.0, 3.5, "mask is 3.5, above 3"),
        ("above", 3.0, 3.0, ""),
        ("below", 3.0, 2.5, "mask is 2.5, below 3"),
        ("below", 3.0, 3.0, ""),
        ("above", 0.5, True, "mask is true, not a number"),
        ("equal", True, "true", "mask is 'true', not true or false"),
        ("equal", 1.0, None, "no value of mask has been received"),
    ],
)
def test_an_interlock_acts_on_its_condition_and_if_configured_on_a_missing_unsuitable_or_old_value(
    test: str, value: Value, received: Value | None, why: str
) -> None:
    interlock = Interlock("mask", test, value, Action.HOLD, 2 * SECOND_NS)
    not_when_old = interlock._replace(acts_when_old=False)
    assert interlock.cause(received, 2 * SECOND_NS) == why
    assert not_when_old.cause(received, 2 * SECOND_NS) == (why if type(received) is type(value) else "")
    assert interlock.cause(received, 2 * SECOND_NS + 1)
    assert not not_when_old.cause(received, 2 * SECOND_NS + 1)


def test_an_interlock_holds_and_releases_the_command_at_the_next_frame() -> None:
    """It acts at random times. A replay of the inputs, with bench reports encoded as in a log, gives the same steps."""
    setup, rng = settings_under(Action.HOLD), np.random.default_rng(5)
    state = replayed_state = running(setup)
    count, acting, flips, logged = 5, False, 0, []
    while flips < 100:
        if rng.random() < 0.3:
            acting, flips, input_ = not acting, flips + 1, mask(not acting)
        else:
            count += 1
            input_ = frame(count, rng.normal(0, 10, 3))
        before, (state, outputs) = state, advance(setup, state, input_)
        logged.append((input_, outputs))
        if outputs.step is not None:
            assert outputs.step.mode is LoopMode.CLOSED
            assert outputs.step.reasons == ((Rejection.HELD,) if acting else ())
            if acting:
                np.testing.assert_array_equal(outputs.command.actuators_nm, before.loop.actuators_nm)
        else:
            assert [event.name for event in outputs.events] == ["INTERLOCK_ACTS" if acting else "INTERLOCK_CLEARED"]
    for input_, outputs in logged:
        if isinstance(input_, BenchReport):
            input_ = codec.decode_input(wire.ControlInput.FromString(codec.encode_input(input_, 3)), {})
        replayed_state, replayed = advance(setup, replayed_state, input_)
        if outputs.step is not None:
            assert codec.encode_step(replayed.step, replayed_state.input_number) == codec.encode_step(
                outputs.step, replayed_state.input_number
            )
    assert replayed_state.input_number == state.input_number


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
def test_each_action_takes_effect_and_is_not_undone_when_the_interlock_clears(action: Action, mode: LoopMode) -> None:
    setup = settings_under(action)
    state, all_outputs = feed(setup, running(setup), mask(True), mask(True))
    assert state.mode is mode
    changed = ["MODE_CHANGED"] if mode is not LoopMode.CLOSED else []
    assert names(all_outputs) == ["INTERLOCK_ACTS", *changed, *(["SAFED"] if mode is LoopMode.SAFE else [])]
    if mode is LoopMode.CLOSED:
        state, _ = applied(setup, state, "open")
    refused, clears = action is not Action.WARN, mode is LoopMode.SAFE
    for name, values in (("close", ()), ("step", (3.0,))):
        _, outputs = applied(setup, state, name, values=values)
        check_reply(outputs, not refused, *(["mask is true"] if refused and not clears else []))
    if clears:
        _, outputs = applied(setup, state, "clear")
        check_reply(outputs, False, "an interlock acts: mask is true")
    after, all_outputs = feed(setup, state, mask(False))
    assert names(all_outputs) == ["INTERLOCK_CLEARED"]
    assert after.mode is state.mode
    after, outputs = applied(setup, after, "clear" if clears else "close")
    check_reply(outputs, True)


@pytest.mark.parametrize("action", [Action.REFUSE_CLOSE, Action.OPEN, Action.SAFE])
def test_an_interlock_that_refuses_to_close_opens_a_loop_that_starts_closed(action: Action) -> None:
    setup = settings_under(action)
    for value in (None, True):
        state, _ = feed(setup, loaded(setup), mask(value))
        assert state.mode is (LoopMode.SAFE if action is Action.SAFE else LoopMode.OPEN)
    measuring = settings(interlocks=setup.interlocks, auto_gain=(True, True))
    close = Request(9, "close", text="auto: the gains were measured")
    for value, mode in ((False, LoopMode.CLOSED), (True, state.mode)):
        after, _ = feed(measuring, loaded(measuring), mask(value), mask(False), frame(1), close)
        assert after.mode is mode


def test_a_loop_that_starts_closed_is_held_if_an_interlock_acts_before_or_after_its_calibration_is_loaded() -> None:
    setup = settings_under(Action.HOLD)
    before, _ = feed(setup, State(), mask(True), Load(0, calibration(), "test"))
    after, _ = feed(setup, loaded(setup), mask(True))
    for state in (before, after):
        assert state.mode is LoopMode.CLOSED
        assert holding_cause(state) == "an interlock acts: mask is true"
    _, all_outputs = feed(setup, after, Request(0, "open"), frame(6, WAVE_NM))
    assert all_outputs[-1].step.error_nm is not None


def test_a_bench_report_is_a_logged_input_only_if_an_interlock_begins_or_ceases_to_act() -> None:
    setup = settings_under(Action.HOLD, "above", 3.0)
    state = running(setup)
    acting, _ = advance(setup, state, mask(4.0))
    assert acting.input_number == state.input_number + 1
    for value, before in ((2.0, state), (5.0, acting)):
        after, outputs = advance(setup, before, mask(value))
        assert after is before
        assert outputs == Outputs()
    assert advance(setup, state, BenchReport(5, "another", True))[0] is state


def test_a_value_that_is_too_old_acts_as_configured() -> None:
    for acting in (True, False):
        setup = settings_under(Action.HOLD, acts_when_old=acting)
        state, all_outputs = feed(setup, running(setup), mask(False, 2 * SECOND_NS + 1), frame(6, WAVE_NM))
        assert bool(state.conditions.acting) is acting
        assert all_outputs[-1].step.reasons == ((Rejection.HELD,) if acting else ())
        state, all_outputs = feed(setup, running(setup), mask(True), mask(True, 2 * SECOND_NS + 1))
        assert [each.why for each in state.conditions.acting] == ["no value of mask for more than 2 s"] * acting
        assert names(all_outputs) == ["INTERLOCK_ACTS", "INTERLOCK_ACTS" if acting else "INTERLOCK_CLEARED"]


# Permits.


def permit(setup: Settings, state: State, seconds: float = 0.0, **fields: object) -> tuple[State, Outputs]:
    values = (seconds,) if seconds else ()
    return applied(setup, state, "permit", text="moving the mask", values=values, lease_id=MOVER, **fields)


def test_a_permit_holds_a_closed_loop_for_its_duration() -> None:
    setup = settings_under(Action.WARN)
    state = running(setup)
    _, outputs = permit(setup, state)
    check_reply(outputs, False, "the loop is closed", "with `--hold 5`")
    waiting = state.conditions._replace(mode_cause=MEASURED_FIRST)
    check_reply(permit(setup, state._replace(mode=LoopMode.OPEN, conditions=waiting))[1], False, "closes once")
    state, outputs = permit(setup, state, 0.01)
    check_reply(outputs, True, "granted for 0.01 s: the loop holds its command")
    state, all_outputs = feed(setup, state, *(frame(count, WAVE_NM) for count in range(6, 18)))
    assert [outputs.step.reasons for outputs in all_outputs] == [(Rejection.HELD,)] * 10 + [()] * 2
    assert names(all_outputs) == ["FRAMES_REFUSED", "LEASE_ENDED", "FRAMES_ACCEPTED"]
    assert state.conditions.lease.ended == "its time is over"
    assert state.mode is LoopMode.CLOSED


def test_a_permit_can_be_released_and_ended_by_open() -> None:
    setup = settings_under(Action.WARN)
    held, _ = permit(setup, running(setup), 5.0)
    _, outputs = applied(setup, held, "gain", values=(0.1,))
    check_reply(outputs, False, "reserved for moving the mask (for at most 5 s more)")
    state, outputs = applied(setup, held, "release", lease_id=MOVER)
    _, all_outputs = feed(setup, state, frame(6, WAVE_NM))
    assert all_outputs[-1].step.reasons == ()
    state, outputs = applied(setup, held, "open")
    check_reply(outputs, True, "this ended the reservation for moving the mask")


def test_a_permit_is_granted_while_the_loop_is_not_closed() -> None:
    setup = settings_under(Action.WARN)
    for name in ("open", "safe"):
        state, _ = applied(setup, running(setup), name)
        for seconds in (0.0, 5.0):
            after, outputs = permit(setup, state, seconds)
            check_reply(outputs, True, f"the loop is {state.mode.in_words}")
        _, outputs = applied(setup, after, "close" if name == "open" else "clear")
        check_reply(outputs, False, "reserved for moving the mask")
    # `stop` ends it in every mode, while `open` is refused in safe mode.
    check_reply(outputs, False, "`lowfc ctl stop` ends that")
    state, _ = applied(setup, after, "stop")
    check_reply(applied(setup, state, "clear")[1], True)


def test_a_permit_is_refused_during_a_lease_or_a_probe_sequence() -> None:
    setup = settings_under(Action.WARN)
    reserved, _ = applied(setup, running(setup), "lease", text="a calibration", values=(10.0,), lease_id=3)
    shape, table = np.full(GRID, 3, np.float32).reshape(-1), np.ones((50, 1), np.float32)
    played, outputs = applied(setup, running(setup), "play", text=MIRROR, actuators_nm=shape, table=table)
    check_reply(outputs, True)
    for state, why in ((reserved, "a calibration"), (played, "a probe sequence is being played")):
        for seconds in (0.0, 5.0):
            after, outputs = permit(setup, state, seconds)
            check_reply(outputs, False, why)
            check_reply(outputs, False, "`lowfc ctl stop` ends that")
            assert after.conditions.lease == state.conditions.lease
    _, outputs = permit(setup, running(setup), 61.0)
    check_reply(outputs, False, "at most 60 s")


def test_a_renewed_permit_still_holds_the_command() -> None:
    setup = settings_under(Action.WARN)
    state, _ = permit(setup, running(setup), 5.0)
    state, outputs = applied(setup, state, "renew", text="moving the mask", values=(5.0,), lease_id=MOVER)
    check_reply(outputs, True)
    assert feed(setup, state, frame(6, WAVE_NM))[1][-1].step.reasons == (Rejection.HELD,)
