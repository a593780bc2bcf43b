"""`advance`: refused frames, frame timeouts, requests, and a command without jumps and wind-up."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from lowfc.arrays import Pixels
from lowfc.control.laws.stability import limiting_gain
from lowfc.control.loop.inputs import Frame, Load, MirrorShape, Outputs, Request, Tick
from lowfc.control.loop.safety import Limit, LoopMode, Reason, Rejection
from lowfc.control.loop.state import State
from tests.support.safety_checks import violations
from tests.support.toy import (
    DARK_DN,
    FLUX_DN,
    GRID,
    NOLL,
    SATURATION_DN,
    SHAPE,
    START,
    TOY,
    WAVE_NM,
    calibration,
    check_reply,
    feed,
    frame,
    frame_sequence,
    loaded,
    names,
    running,
    settings,
)

DEFAULTS = settings()


def ask(name: str, *values: float, modes: tuple[int, ...] = ()) -> Request:
    return Request(0, name, modes, values)


def image_with_saturated(count: int) -> Pixels:
    """An image with this number of pixels at full well."""
    image = TOY.pixels(WAVE_NM)
    image.flat[:count] = SATURATION_DN
    return image


BAD_FRAMES: dict[Reason, Callable[[int], Frame]] = {
    Rejection.WRONG_SIZE: lambda count: frame(count, pixels=np.full((7, 6), 5000, np.uint16)),
    Rejection.LATE: lambda count: frame(count, WAVE_NM, age_ns=DEFAULTS.max_frame_age_ns + 1),
    Rejection.SATURATED: lambda count: frame(count, pixels=np.full(SHAPE, SATURATION_DN, np.uint16)),
    Rejection.DARK: lambda count: frame(count, pixels=np.full(SHAPE, DARK_DN + 10, np.uint16)),
    Rejection.OUT_OF_ORDER: lambda count: frame(count, WAVE_NM, sequence=frame_sequence(3)),
    Rejection.REPEATED: lambda count: frame(count, WAVE_NM, sequence=frame_sequence(5)),
}


@pytest.mark.parametrize("reason", BAD_FRAMES)
def test_a_bad_frame_is_refused_with_an_event_and_the_command_holds(reason: Reason) -> None:
    before = running()
    state, all_outputs = feed(DEFAULTS, before, *(BAD_FRAMES[reason](count) for count in range(6, 9)))
    held = before.loop
    for outputs in all_outputs:
        assert outputs.step.reasons == (reason,)
        assert outputs.step.error_nm is None
        assert outputs.step.pol_nm is None
        assert np.array_equal(outputs.step.command_nm, held.history_nm[0])
        assert np.array_equal(outputs.command.actuators_nm, held.actuators_nm)
    assert state.counts == {reason: 3}
    assert state.frames_used == before.frames_used
    next_count = 6 if reason in (Rejection.OUT_OF_ORDER, Rejection.REPEATED) else 9
    state, later_outputs = feed(DEFAULTS, state, frame(next_count, WAVE_NM), frame(next_count + 1, WAVE_NM))
    assert names(all_outputs + later_outputs) == ["FRAMES_REFUSED", "FRAMES_ACCEPTED"]
    assert all_outputs[0].events[0].details == {"reason": reason.name}
    assert later_outputs[0].events[0].details == {"refused": 3, "reason": reason.name}
    assert state.frames_used == before.frames_used + 2


def test_frames_of_a_stuck_camera_are_refused_until_the_image_changes() -> None:
    setup = settings(max_identical_frames=3)
    state, all_outputs = feed(setup, loaded(setup), *(frame(count, WAVE_NM) for count in range(1, 8)))
    reasons = [outputs.step.reasons for outputs in all_outputs]
    assert reasons == [()] * 4 + [(Rejection.STUCK,)] * 3
    used = running(setup, 4).loop
    assert np.array_equal(state.loop.actuators_nm, used.actuators_nm)
    pixels = frame(8, WAVE_NM).pixels.copy()
    pixels.flat[0] += 1
    state, later_outputs = feed(setup, state, frame(8, pixels=pixels), frame(9, WAVE_NM))
    assert names(all_outputs + later_outputs) == ["FRAMES_REFUSED", "FRAMES_ACCEPTED"]
    assert state.counts == {Rejection.STUCK: 3}
    assert state.frames_used == 6


def test_without_a_calibration_a_frame_gives_a_step_and_no_command() -> None:
    state, all_outputs = feed(DEFAULTS, State(), frame(1), frame(2))
    for outputs in all_outputs:
        assert outputs.command is None
        assert outputs.step.reasons == (Rejection.NO_CALIBRATION,)
        assert outputs.step.command_nm.size == 0
    assert names(all_outputs) == ["FRAMES_REFUSED"]
    state, all_outputs = feed(DEFAULTS, state, Load(0, calibration(), "test"), frame(3))
    assert names(all_outputs) == ["CALIBRATION_LOADED", "MODE_CHANGED", "FRAMES_ACCEPTED"]
    assert state.counts == {Rejection.NO_CALIBRATION: 2}


@pytest.mark.parametrize(
    ("changes", "reasons"),
    [
        ({"age_ns": DEFAULTS.max_frame_age_ns}, ()),
        ({"age_ns": DEFAULTS.max_frame_age_ns + 1}, (Rejection.LATE,)),
        ({"age_ns": -(10**12)}, ()),
        ({"pixels": None}, (Rejection.WRONG_SIZE,)),
        ({"pixels": image_with_saturated(8)}, ()),
        ({"pixels": image_with_saturated(9)}, (Rejection.SATURATED,)),
    ],
)
def test_a_frame_is_refused_only_beyond_a_limit_or_with_a_wrong_size(
    changes: dict[str, object], reasons: tuple[Reason, ...]
) -> None:
    _, (outputs,) = feed(DEFAULTS, running(), frame(6, WAVE_NM, **changes))
    assert outputs.step.reasons == reasons
    assert (outputs.step.error_nm is None) is bool(reasons)


def test_consecutive_frames_refused_for_one_reason_raise_one_event() -> None:
    reasons = Rejection.LATE, Rejection.LATE, Rejection.DARK
    inputs = [BAD_FRAMES[reason](count) for count, reason in enumerate(reasons, start=6)]
    state, all_outputs = feed(DEFAULTS, running(), *inputs, frame(9, WAVE_NM))
    assert names(all_outputs) == ["FRAMES_REFUSED", "FRAMES_REFUSED", "FRAMES_ACCEPTED"]
    assert state.counts == {Rejection.LATE: 2, Rejection.DARK: 1}


@pytest.mark.parametrize("delay", [1.0, 2.0, 2.5])
def test_missing_and_refused_frames_advance_the_command_history(delay: float) -> None:
    """After a gap, pseudo-open-loop modes use the command that the exposure saw: the held one."""
    setup = settings(delay_frames=delay)
    before = running(setup)
    held = before.loop.history_nm[0]
    missing, all_outputs = feed(setup, before, frame(12, WAVE_NM))
    assert names(all_outputs) == ["FRAMES_MISSING"]
    assert all_outputs[0].events[0].details == {"count": 6, "number": 12}
    assert np.array_equal(all_outputs[0].step.pol_nm, all_outputs[0].step.error_nm - held)
    refused, _ = feed(setup, before, *(BAD_FRAMES[Rejection.LATE](count) for count in range(6, 12)))
    assert all(np.array_equal(command, held) for command in refused.loop.history_nm)
    assert missing.loop.history_nm[0] is not held


def test_one_missing_frame_advances_the_history_by_one() -> None:
    setup = settings(delay_frames=3.0)
    before = running(setup)
    newest, middle, _ = before.loop.history_nm
    _, (outputs,) = feed(setup, before, frame(7, WAVE_NM))  # frame 6 is missing: exposure 7 sees the command of frame 4
    assert np.array_equal(outputs.step.pol_nm, outputs.step.error_nm - middle)
    assert not np.array_equal(newest, middle)


def test_frames_of_a_restarted_camera_are_used_and_raise_an_event() -> None:
    before = running()
    restarted = frame(0, WAVE_NM, sequence=frame_sequence(0, START + 60), time_ns=(START + 60) * 10**9)
    state, all_outputs = feed(DEFAULTS, before, restarted)
    assert names(all_outputs) == ["CAMERA_RESTARTED"]
    assert state.frames_used == before.frames_used + 1
    _, all_outputs = feed(DEFAULTS, state, frame(6, WAVE_NM))
    assert all_outputs[0].step.reasons == (Rejection.OUT_OF_ORDER,)


def test_a_frame_timeout_raises_an_event_at_its_start_and_at_its_end() -> None:
    before = running()
    short = Tick(0, DEFAULTS.frame_timeout_ns)
    long = Tick(0, DEFAULTS.frame_timeout_ns + 1)
    longest, repeated = Tick(0, 10 * DEFAULTS.frame_timeout_ns), BAD_FRAMES[Rejection.REPEATED](5)
    state, all_outputs = feed(DEFAULTS, before, short, long, longest, repeated, short, long)
    assert [name for name in names(all_outputs) if name != "FRAMES_REFUSED"] == ["NO_FRAMES"]
    for outputs in all_outputs:
        assert np.array_equal(outputs.command.actuators_nm, before.loop.actuators_nm)
        assert outputs.command.frame_sequence == before.frame_sequence
    state, later_outputs = feed(DEFAULTS, state, frame(500, WAVE_NM), frame(501, WAVE_NM))
    assert names(later_outputs) == ["FRAMES_BACK", "FRAMES_MISSING", "FRAMES_ACCEPTED"]
    assert state.counts[Rejection.NO_FRAME] == 1


def test_a_frame_timeout_relaxes_the_mirror_if_configured() -> None:
    setup = settings(on_frame_timeout="flat")
    state = running(setup)
    for _ in range(20):
        before = state.loop.actuators_nm
        state, (outputs,) = feed(setup, state, Tick(0, setup.frame_timeout_ns + 1))
        assert violations(setup.limits, before, outputs.command.actuators_nm) == []
    assert not state.loop.actuators_nm.any()
    assert not any(command.any() for command in state.loop.history_nm)
    state, (outputs,) = feed(setup, state, frame(400, WAVE_NM))
    assert outputs.command.actuators_nm.any()


def test_before_the_first_command_a_tick_does_nothing_except_in_safe_mode() -> None:
    state = loaded(DEFAULTS)
    after, (outputs,) = feed(DEFAULTS, state, Tick(0, 10**12))
    assert after == state._replace(frame_timeout=True, input_number=after.input_number)
    assert outputs == Outputs()
    in_safe_mode, (_, outputs) = feed(DEFAULTS, state, Request(7, "safe"), Tick(7, 0))
    assert not outputs.command.actuators_nm.any()
    assert outputs.command.clear_id == 7, (
        "the time of the request: with a new `clear_id` a mirror accepts any frame sequence"
    )
    shape = MirrorShape(0, np.ones(GRID, np.float32), np.zeros(3, np.float32))
    assert feed(DEFAULTS, in_safe_mode, shape)[0] is in_safe_mode, "the shape is not adopted"


@pytest.mark.parametrize("mode", list(LoopMode))
def test_safe_latches_from_every_mode(mode: LoopMode) -> None:
    state = running()._replace(mode=mode)
    if mode is LoopMode.IDLE:
        state = State()
    state, all_outputs = feed(DEFAULTS, state, ask("safe"), ask("close"), ask("open"), Load(0, calibration(), "test"))
    assert state.mode is LoopMode.SAFE
    assert [outputs.reply.accepted for outputs in all_outputs if outputs.reply] == [True, False, False]
    expected = [] if mode is LoopMode.SAFE else ["MODE_CHANGED", "SAFED"]
    assert [name for name in names(all_outputs) if name != "CALIBRATION_LOADED"] == expected
    state, _ = feed(DEFAULTS, state, ask("clear"))
    assert state.mode is LoopMode.OPEN


def test_safe_mode_relaxes_the_mirror_frame_by_frame_within_the_limits() -> None:
    setup = settings(limits=replace(DEFAULTS.limits, slew_nm=1.0))
    state, _ = feed(setup, running(setup, 30), ask("safe"))
    largest = np.abs(state.loop.actuators_nm).max()
    for count in range(31, 70):
        before = state.loop.actuators_nm
        input_ = BAD_FRAMES[Rejection.DARK](count) if count % 3 == 0 else frame(count, WAVE_NM)
        state, (outputs,) = feed(setup, state, input_)
        assert violations(setup.limits, before, outputs.command.actuators_nm) == []
        assert np.abs(outputs.command.actuators_nm).max() <= np.abs(before).max()
    assert largest > 2
    assert not state.loop.actuators_nm.any()


@pytest.mark.parametrize("reason", [Rejection.OUT_OF_ORDER, Rejection.REPEATED])
def test_safe_mode_flattens_the_mirror_while_frames_are_refused(reason: Reason) -> None:
    """The frames are refused; commands have the newest frame sequence, so that the mirror accepts them."""
    state, _ = feed(DEFAULTS, running(), ask("safe"))
    newest = state.frame_sequence
    for _ in range(200):
        state, (outputs,) = feed(DEFAULTS, state, BAD_FRAMES[reason](6))
        assert outputs.command.frame_sequence == newest
    assert not state.loop.actuators_nm.any()


@pytest.mark.parametrize("name", ["gain", "leak"])
def test_gain_and_leak_are_set_for_all_some_or_each_mode(name: str) -> None:
    def now(state: State) -> list[float]:
        return getattr(state.loop.integrator, name).tolist()

    state, _ = feed(DEFAULTS, running(), ask(name, 0.25))
    assert now(state) == [0.25, 0.25, 0.25]
    state, _ = feed(DEFAULTS, state, ask(name, 0.5, modes=(3,)))
    assert now(state) == [0.25, 0.5, 0.25]
    state, (outputs,) = feed(DEFAULTS, state, ask(name, 0.125, 0.75, modes=(4, 2)))
    assert now(state) == [0.75, 0.5, 0.125]
    assert outputs.changed
    assert outputs.reply.text == f"{name} is now 0.75 0.5 0.125"


@pytest.mark.parametrize(
    ("request_", "message"),
    [
        (ask("gain"), "give one value"),
        (ask("gain", 0.1, 0.2), "give one value"),
        (ask("gain", 0.1, modes=(7,)), "[7] are not controlled"),
        (Request(0, "gain", (3, 99), text="auto"), "[99] are not controlled; there are 2, 3, 4"),
        (ask("gain", float("nan")), "finite, got nan"),
        (ask("step", 0.0), "from 1 to 4294967296; got 0"),
        (ask("gain", float("inf")), "finite"),
        (ask("gain", -0.1), "at least 0"),
        (ask("gain", 2.0), "unstable"),
        (ask("gain", 0.1, 0.1, 2.5), "unstable"),
        (ask("leak", 1.5), "between 0 and 1"),
        (ask("leak", 0.5, -0.1, 0.2), "between 0 and 1, got -0.1"),
        (ask("leak", float("nan")), "finite"),
        (ask("limit", 2e9), "between 0 and 1e+09 nm, got 2e+09"),
    ],
)
def test_a_bad_value_is_refused_and_changes_nothing(request_: Request, message: str) -> None:
    state = running()
    after, (outputs,) = feed(DEFAULTS, state, request_)
    check_reply(outputs, False, message)
    assert not outputs.changed
    assert after.loop.integrator is state.loop.integrator


@pytest.mark.parametrize("delay", [1.0, 1.5, 2.0, 3.0])
def test_an_unstable_gain_is_refused_for_the_configured_delay(delay: float) -> None:
    setup, highest = settings(delay_frames=delay, gain=(0.1, 0.1)), limiting_gain(delay)
    requests = (ask("gain", factor * highest) for factor in (0.999, 1, 1.001))
    _, all_outputs = feed(setup, loaded(setup), *requests)
    assert [outputs.reply.accepted for outputs in all_outputs if outputs.reply] == [True, False, False]


def test_gain_and_leak_are_refused_if_unstable_together() -> None:
    """With a delay of 1 frame the pole is 1 - leak - gain."""
    setup = settings(gain=(0.5, 0.1))
    above, below, leaky = ask("gain", 1.9, modes=(2,)), ask("gain", 1.7, modes=(2,)), ask("leak", 0.2)
    for requests in ([above, leaky], [leaky, above]):
        _, (first, second) = feed(setup, loaded(setup), *requests)
        assert first.reply.accepted
        check_reply(second, False, "below 1.8", "a delay of 1 frame and a leak of 0.2 becomes unstable; got 1.9")
    for requests in ([below, leaky], [leaky, below], [above, ask("leak", 0.2, modes=(3, 4))]):
        _, all_outputs = feed(setup, loaded(setup), *requests)
        assert all(outputs.reply.accepted for outputs in all_outputs)


def test_a_request_with_more_leaks_than_modes_is_refused_before_limiting_gains_are_computed() -> None:
    before = limiting_gain.cache_info().misses
    _, outputs = feed(DEFAULTS, loaded(DEFAULTS), ask("leak", *np.linspace(0.01, 0.9, 900).tolist()))
    check_reply(outputs[0], False, "give one value, or one per mode (3 modes); got 900")
    assert limiting_gain.cache_info().misses == before


def test_a_mode_that_a_request_names_twice_takes_one_value() -> None:
    for name in ("gain", "limit", "offset"):
        requests = ask(name, 0.1, modes=(2, 2)), ask(name, 0.1, 0.2, modes=(2, 2))
        _, (one_value, two_values) = feed(DEFAULTS, loaded(DEFAULTS), *requests)
        assert one_value.reply.accepted
        check_reply(two_values, False, "got 2")


def test_the_first_step_after_closing_is_gain_times_error() -> None:
    state, _ = feed(DEFAULTS, running(), ask("open"), *(frame(count, WAVE_NM) for count in range(6, 20)), ask("close"))
    before = state.loop.history_nm[0]
    _, (outputs,) = feed(DEFAULTS, state, frame(20, (1.0, 0, 0)))
    assert outputs.step.command_nm - before == pytest.approx([-0.5, 0, 0], abs=0.02)


def test_in_open_loop_the_command_holds() -> None:
    state, _ = feed(DEFAULTS, running(), ask("open"))
    after, all_outputs = feed(DEFAULTS, state, *(frame(count, WAVE_NM) for count in range(6, 12)))
    assert after.loop.actuators_nm is state.loop.actuators_nm
    assert all(outputs.step.error_nm is not None for outputs in all_outputs)


@pytest.mark.parametrize("noll", [NOLL, (2, 3)])
def test_a_loaded_calibration_does_not_make_the_mirror_jump(noll: tuple[int, ...]) -> None:
    before = running()
    state, (outputs,) = feed(DEFAULTS, before, Load(0, calibration(noll, scale=2.0), "another"))
    # The part of the shape outside the new modes becomes a channel.
    adoption = [] if noll == NOLL else ["SHAPE_ADOPTED"]
    assert names([outputs]) == ["CALIBRATION_LOADED", *adoption]
    assert np.array_equal(state.loop.actuators_nm, before.loop.actuators_nm)
    _, (outputs,) = feed(DEFAULTS, state, Tick(0, 0))
    assert np.array_equal(outputs.command.actuators_nm, before.loop.actuators_nm)
    if noll == NOLL:
        assert state.loop.history_nm[0] == pytest.approx(before.loop.history_nm[0], abs=1e-3)
        _, (outputs,) = feed(DEFAULTS, state, frame(6))
        assert np.abs(outputs.command.actuators_nm - before.loop.actuators_nm).max() < 0.01


@pytest.mark.parametrize("with_modes", [True, False])
def test_a_restarted_controller_continues_from_the_mirrors_shape(with_modes: bool) -> None:
    before = running().loop
    modes = before.history_nm[0] if with_modes else np.zeros(0, np.float32)
    shape = MirrorShape(0, before.actuators_nm, modes)
    state, (outputs,) = feed(DEFAULTS, loaded(DEFAULTS), shape)
    assert names([outputs]) == ["MIRROR_ADOPTED"]
    state, (outputs,) = feed(DEFAULTS, state, frame(1))
    assert np.abs(outputs.command.actuators_nm - before.actuators_nm).max() < 0.01
    assert outputs.step.pol_nm == pytest.approx(-before.history_nm[0], abs=0.02)
    later, (outputs,) = feed(DEFAULTS, state, MirrorShape(0, np.zeros(GRID, np.float32), np.zeros(3, np.float32)))
    assert later is state


@pytest.mark.parametrize("reported_nm", [np.nan, np.inf, 1e30, -200.0])
def test_an_implausible_modal_command_is_not_adopted(reported_nm: float) -> None:
    before = running().loop
    shape = MirrorShape(0, before.actuators_nm, np.full(3, reported_nm, np.float32))
    state, _ = feed(DEFAULTS, loaded(DEFAULTS), shape)
    assert state.loop.history_nm[0] == pytest.approx(before.history_nm[0], abs=1e-3)


@pytest.mark.parametrize(
    ("shape", "why"),
    [
        (np.zeros((5, 4), np.float32), "the mirror has a grid of (5, 4), the calibration (4, 5)"),
        (np.full(GRID, np.nan, np.float32), "20 of its 20 actuators have no finite position"),
    ],
)
def test_a_shape_of_another_grid_or_with_values_not_finite_is_not_adopted(shape: np.ndarray, why: str) -> None:
    state = loaded(DEFAULTS)
    after, (outputs,) = feed(DEFAULTS, state, MirrorShape(0, shape, np.zeros(3, np.float32)))
    assert names([outputs]) == ["MIRROR_REFUSED"]
    assert outputs.events[0].details["why"] == why
    assert after.loop is state.loop


def test_each_modal_limit_is_kept_and_causes_no_wind_up() -> None:
    setup = settings(limit_nm=(20.0, 5.0))
    state = loaded(setup)
    for count in range(1, 101):  # a hundred frames of an error far beyond the limits
        state, (outputs,) = feed(setup, state, frame(count, (60, -60, 60)))
        assert (np.abs(outputs.step.command_nm) <= [20, 20, 5]).all()
    assert outputs.step.reasons == (Limit.MODAL_LIMIT,)
    assert outputs.step.command_nm.tolist() == [-20, 20, -5]
    state, (outputs,) = feed(setup, state, frame(101, (-10, 10, -10)))
    assert outputs.step.command_nm == pytest.approx([-15, 15, -2], abs=0.1)
    assert names([outputs]) == ["LIMIT_CLEARED"]


def test_when_the_stroke_limit_acts_the_stored_modal_command_is_the_limited_one() -> None:
    setup = settings(limits=replace(DEFAULTS.limits, stroke_nm=5.0), limit_nm=(150.0, 150.0))
    state, events = loaded(setup), []
    for count in range(1, 61):
        state, (outputs,) = feed(setup, state, frame(count, (60, 0, 0)))
        events += names([outputs])
    loop = state.loop
    assert state.limits_hit == (Limit.STROKE,)
    assert events.count("LIMIT_HIT") == 1
    assert np.abs(loop.actuators_nm).max() <= 5
    fitted = np.linalg.lstsq(loop.calibration.modes_to_actuators, loop.actuators_nm.reshape(-1), rcond=None)[0]
    assert loop.history_nm[0] == pytest.approx(fitted, abs=1e-3)
    assert np.abs(loop.history_nm[0]).max() < 15
    # One frame of the opposite error is enough to leave the limit: there is no wind-up.
    state, (outputs,) = feed(setup, state, frame(61, (-10, 0, 0)))
    assert np.abs(outputs.command.actuators_nm).max() < 4
    assert names([outputs]) == ["LIMIT_CLEARED"]


def test_saturated_pixels_hardly_affect_the_estimate() -> None:
    """The star is 1.3 times as bright as expected."""
    plain = TOY.pixels(WAVE_NM, 1.3 * FLUX_DN)
    saturated = plain.copy()
    saturated.flat[[3, 17]] = SATURATION_DN
    errors = []
    for pixels in (plain, saturated):
        _, (outputs,) = feed(DEFAULTS, loaded(DEFAULTS), frame(1, pixels=pixels))
        errors.append(outputs.step.error_nm)
        assert outputs.step.saturated_pixels == 2 * (pixels is saturated)
    difference_nm = np.abs(errors[1] - errors[0]).max()
    assert 0 < difference_nm < np.abs(errors[0]).max() / 2
