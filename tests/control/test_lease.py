"""Leases of the loop, remarks on unwise values, and the texts of replies and events."""

from dataclasses import replace

import numpy as np
import pytest

from lowfc.contract.events import EVENTS
from lowfc.control.laws.stability import highest_gain
from lowfc.control.loop.advance import advance
from lowfc.control.loop.command_channels import MIRROR
from lowfc.control.loop.inputs import Outputs, Reply, Request, Tick
from lowfc.control.loop.lease import MAX_S
from lowfc.control.loop.requests import REQUESTS
from lowfc.control.loop.safety import LoopMode
from lowfc.control.loop.state import State
from tests.support.toy import GRID, NOLL, WAVE_NM, check_reply, feed, frame, frame_sequence, loaded, names, settings

DEFAULTS = settings(rate_hz=1000.0)
HOLDER = "lowfc calibrate (anna, pid 7)"
LEASE_ID = 11
"""Identity of the holder's lease."""
SECOND_NS = 1_000_000_000


def reserved_loop(seconds: float = 10.0, frames: int = 3) -> State:
    """A closed loop that is reserved from time 0."""
    state, _ = feed(DEFAULTS, loaded(DEFAULTS), *(frame(count, WAVE_NM) for count in range(1, frames + 1)))
    state, outputs = applied(state, Request(0, "lease", values=(seconds,), text=HOLDER, lease_id=LEASE_ID))
    check_reply(outputs, True)
    assert names([outputs]) == ["LEASE_TAKEN"]
    return state


def applied(state: State, request: Request) -> tuple[State, Outputs]:
    return advance(DEFAULTS, state, request)


def played(state: State, frames: int = 500) -> State:
    """The state with a probe sequence in progress."""
    shape = np.full(GRID, 3, np.float32).reshape(-1)
    table = np.ones((frames, 1), np.float32)
    request = Request(0, "play", text=MIRROR, actuators_nm=shape, table=table, lease_id=LEASE_ID)
    state, outputs = applied(state, request)
    check_reply(outputs, True)
    return state


def remaining_rows(state: State) -> int:
    """Number of rows of the probe sequence that are still to be played."""
    channels = state.loop.command_channels
    return 0 if channels is None or channels.play is None else channels.play.remaining(state.frame_sequence + 1)


EXEMPT = {"safe", "open", "pause", "stop", "status", "note", "lease", "renew", "release", "permit", "configuration"}
"""Requests that a lease does not reserve for its holder; a second `lease` or `permit` is refused by its own rule."""


@pytest.mark.parametrize("name", sorted({*REQUESTS} - EXEMPT))
def test_requests_of_other_clients_are_refused_with_the_holders_name(name: str) -> None:
    state = reserved_loop()
    after, outputs = applied(state, Request(4 * SECOND_NS, name))
    check_reply(outputs, False, HOLDER, "6 s", "lowfc ctl stop")
    assert all(new is old for new, old in zip(after[:-1], state[:-1], strict=True))


def test_the_holders_requests_are_granted() -> None:
    state, outputs = applied(reserved_loop(), Request(SECOND_NS, "gain", values=(0.3,), lease_id=LEASE_ID))
    check_reply(outputs, True)
    state, outputs = applied(state, Request(SECOND_NS, "open", lease_id=LEASE_ID))
    assert state.mode is LoopMode.OPEN
    state, outputs = applied(state, Request(2 * SECOND_NS, "renew", values=(10.0,), text=HOLDER, lease_id=LEASE_ID))
    check_reply(outputs, True)


@pytest.mark.parametrize("name", ["safe", "open", "pause", "stop"])
def test_safe_open_pause_and_stop_of_another_client_end_a_lease_and_its_probe_sequence(name: str) -> None:
    state, outputs = applied(played(reserved_loop()), Request(SECOND_NS, name))
    check_reply(outputs, True)
    assert "LEASE_ENDED" in names([outputs])
    assert not remaining_rows(state)
    state, outputs = applied(state, Request(2 * SECOND_NS, "renew", values=(10.0,), text=HOLDER, lease_id=LEASE_ID))
    assert outputs.reply.text == f"the lease ended: operator asked to {name}"


def test_the_end_of_a_lease_names_its_holder_without_the_remaining_time() -> None:
    request = Request(0, "lease", values=(10.0,), text=f"{HOLDER}, about 33 s to go", lease_id=LEASE_ID)
    state, _ = applied(loaded(DEFAULTS), request)
    _, outputs = applied(state, Request(SECOND_NS, "stop"))
    assert [event.details["holder"] for event in outputs.events if event.name == "LEASE_ENDED"] == [HOLDER]
    assert outputs.reply.text.endswith(f"; this ended the reservation for {HOLDER}")


def test_close_reports_whether_the_loop_was_closed_already() -> None:
    state, outputs = applied(loaded(DEFAULTS), Request(0, "close"))
    assert outputs.reply.text == "the loop stays closed"
    state, _ = applied(state, Request(1, "step", values=(5.0,)))
    assert applied(state, Request(2, "close"))[1].reply.text == "loop closed"


@pytest.mark.parametrize("name", ["close", "gain", "play", "load"])
@pytest.mark.parametrize("ended", [True, False])
def test_requests_of_a_former_holder_are_refused_with_the_reason(name: str, ended: bool) -> None:
    state = applied(reserved_loop(), Request(SECOND_NS, "pause"))[0] if ended else loaded(DEFAULTS)
    _, outputs = applied(state, Request(2 * SECOND_NS, name, values=(0.1,), lease_id=LEASE_ID))
    check_reply(outputs, False, ("operator asked to pause" if ended else "did the controller restart"))


def test_safe_mode_ends_and_refuses_a_lease() -> None:
    state, outputs = applied(reserved_loop(), Request(SECOND_NS, "safe", lease_id=LEASE_ID))
    assert outputs.reply.text == f"loop in safe mode; this ended the reservation for {HOLDER}"
    _, outputs = applied(state, Request(SECOND_NS, "lease", values=(5.0,), text=HOLDER, lease_id=12))
    assert "safe mode" in outputs.reply.text
    _, outputs = applied(state, Request(SECOND_NS, "clear"))
    check_reply(outputs, True)


@pytest.mark.parametrize("name", ["status", "note"])
def test_status_and_note_do_not_end_a_lease(name: str) -> None:
    state, outputs = applied(reserved_loop(), Request(SECOND_NS, name, text="cloud"))
    check_reply(outputs, True)
    assert not state.conditions.lease.ended


def test_a_lease_has_one_holder_and_only_the_holder_can_release_it() -> None:
    state = reserved_loop()
    after, outputs = applied(state, Request(SECOND_NS, "lease", values=(5.0,), text="somebody", lease_id=12))
    check_reply(outputs, False)
    after, outputs = applied(after, Request(SECOND_NS, "release", lease_id=12))
    assert after.conditions == state.conditions
    after, outputs = applied(after, Request(SECOND_NS, "release", lease_id=LEASE_ID))
    assert names([outputs]) == ["LEASE_RELEASED"]
    after, outputs = applied(after, Request(SECOND_NS, "gain", values=(0.2,)))
    check_reply(outputs, True)


@pytest.mark.parametrize(
    ("fields", "why"),
    [
        ({"values": (0.0,)}, "above 0"),
        ({"values": (MAX_S + 1,)}, "at most 60 s"),
        ({"values": (float("nan"),)}, "above 0"),
        ({"values": ()}, "one duration"),
        ({"text": " "}, "characters"),
        ({"text": "x" * 201}, "characters"),
        ({"text": "\x1b[31mred"}, "printable"),
        ({"lease_id": 0}, "identity"),
    ],
)
def test_an_invalid_lease_is_refused(fields: dict[str, object], why: str) -> None:
    request = Request(0, "lease", values=(5.0,), text=HOLDER, lease_id=LEASE_ID)
    _, outputs = applied(loaded(DEFAULTS), replace(request, **fields))
    check_reply(outputs, False, why)


def test_a_lease_ends_after_the_frames_of_its_duration() -> None:
    """A lease of 1 s is in force for 1000 frames at 1 kHz."""
    state = played(reserved_loop(1.0), 5000)
    state, all_outputs = feed(DEFAULTS, state, *(frame(count) for count in range(4, 1004)))
    assert names(all_outputs) == []
    assert remaining_rows(state) == 4000
    state, all_outputs = feed(DEFAULTS, state, frame(1004))
    assert names(all_outputs) == ["LEASE_ENDED"]
    assert not remaining_rows(state)


@pytest.mark.parametrize("period_ns", [250_000, 500_000, 999_999, 2_000_000, 15_000_000])
@pytest.mark.parametrize("ahead_ns", [0, 3600 * SECOND_NS])
def test_a_lease_lasts_its_seconds_at_any_frame_rate(period_ns: int, ahead_ns: int) -> None:
    """The configured rate is 1 kHz; the camera's clock may differ from the controller's."""
    first, _ = feed(DEFAULTS, loaded(DEFAULTS), frame(1, WAVE_NM, time_ns=ahead_ns + period_ns))
    state, _ = applied(first, Request(0, "lease", values=(1.0,), text=HOLDER, lease_id=LEASE_ID))
    count = 1
    while not state.conditions.lease.ended:
        count += 1
        state, _ = applied(state, frame(count, WAVE_NM, time_ns=ahead_ns + count * period_ns))
    assert abs((count - 1) * period_ns - SECOND_NS) <= period_ns + 1_000_000


@pytest.mark.parametrize("time_ns", [0, frame(3).time_ns + 10 * SECOND_NS])
def test_each_frame_counts_as_one_period_after_a_silence_and_if_frame_times_do_not_increase(time_ns: int) -> None:
    *lasting, last = (frame(count, WAVE_NM, time_ns=time_ns) for count in range(4, 1005))
    state, all_outputs = feed(DEFAULTS, reserved_loop(1.0), *lasting)
    assert "LEASE_ENDED" not in names(all_outputs)
    assert "LEASE_ENDED" in names(feed(DEFAULTS, state, last)[1])


def test_without_frames_a_lease_ends_by_the_clock_and_before_the_next_request() -> None:
    state, all_outputs = feed(DEFAULTS, played(reserved_loop(1.0)), Tick(SECOND_NS, 0), Tick(SECOND_NS + 1, 0))
    assert names(all_outputs) == ["LEASE_ENDED"]
    assert not remaining_rows(state)
    _, outputs = applied(reserved_loop(1.0), Request(SECOND_NS + 1, "gain", values=(0.3,)))
    check_reply(outputs, True)
    assert names([outputs]) == ["LEASE_ENDED"]


@pytest.mark.parametrize("frames", [0, 3])
def test_a_lease_keeps_its_number_of_frames_when_the_camera_starts(frames: int) -> None:
    start = 1_800_000_000
    *lasting, last = (frame(count, WAVE_NM, sequence=frame_sequence(count, start)) for count in range(1, 1003))
    state, all_outputs = feed(DEFAULTS, reserved_loop(1.0, frames), *lasting)
    assert "LEASE_ENDED" not in names(all_outputs)
    assert "LEASE_ENDED" in names(feed(DEFAULTS, state, last)[1])


def answer(state: State, name: str, *values: float, modes: tuple[int, ...] = (), text: str = "") -> tuple[State, Reply]:
    after, outputs = applied(state, Request(1, name, modes, values, text))
    return after, outputs.reply


@pytest.mark.parametrize(
    ("name", "value", "remark"),
    [
        ("gain", 0.5, ""),
        ("gain", 1.2, "a margin is below the 1.8 in gain or 45 degrees in phase that `lowfc tune` keeps"),
        ("gain", 0.0, "a mode with a gain of 0 is not corrected"),
        ("gain", float(np.float32(0.01)), ""),  # values of a request are float32
        ("gain", 0.001, "below 0.01, the least that `lowfc tune` chooses"),
        ("limit", 100.0, ""),
        ("limit", 0.0, "a mode with a limit of 0 nm is not corrected"),
        ("limit", 1e9, "nm the stroke of 700 nm limits mode 3 first"),
        ("leak", 0.0, ""),
    ],
)
def test_an_unwise_value_is_granted_with_a_remark(name: str, value: float, remark: str) -> None:
    after, reply = answer(loaded(DEFAULTS), name, value, modes=(3,))
    assert reply.accepted
    attribute = {"gain": "gain", "limit": "limit_nm", "leak": "leak"}[name]
    assert getattr(after.loop.integrator, attribute)[NOLL.index(3)] == np.float32(value)
    assert reply.text.startswith(f"{name} is now ")
    assert remark in reply.text
    assert (":" in reply.text) == bool(remark)


def test_the_remark_on_limits_names_the_mode_that_the_stroke_limits_first() -> None:
    state = loaded(DEFAULTS)
    to_actuators = state.loop.to_actuators * np.float32([1, 2, 1])
    reach_nm = DEFAULTS.limits.stroke_nm / np.abs(to_actuators[:, 1]).max()
    _, reply = answer(state._replace(loop=state.loop._replace(to_actuators=to_actuators)), "limit", 1e9)
    assert reply.text.endswith(f": above {reach_nm:.3g} nm the stroke of 700 nm limits mode 3 first")


def test_an_offset_of_a_mode_without_gain_has_a_remark() -> None:
    state, _ = answer(loaded(DEFAULTS), "gain", 0.0, modes=(3,))
    automatic, _ = answer(state, "gain", text="auto")
    for before, mode, remark in ((state, 3, "Z3 would not follow at a gain of 0"), (state, 4, ""), (automatic, 3, "")):
        _, reply = answer(before, "offset", 5.0, modes=(mode,))
        assert reply.accepted
        assert remark in reply.text
        assert (":" in reply.text) == bool(remark)


def test_a_gain_has_a_remark_if_it_is_above_the_highest_gain_within_the_margins() -> None:
    highest = highest_gain(DEFAULTS.delay_frames)
    texts = [answer(loaded(DEFAULTS), "gain", factor * highest)[1].text for factor in (0.999, 1.001)]
    assert ["lowfc tune" in text for text in texts] == [False, True]


def test_the_reply_to_the_removal_of_a_channel_names_it_or_the_existing_channels() -> None:
    state = loaded(DEFAULTS)
    after, reply = answer(state, "channel", text="dark-hole")
    assert (reply.accepted, reply.text) == (False, "there is no channel 'dark-hole' to remove; there are none")
    assert after.loop.command_channels is None
    shape = Request(1, "channel", text="dark-hole", actuators_nm=np.full(GRID, 2.0, np.float32).reshape(-1))
    state, _ = advance(DEFAULTS, state, shape)
    assert answer(state, "channel", text="hole")[1].text == "there is no channel 'hole' to remove; there are dark-hole"
    assert answer(state, "channel", text="dark-hole")[1].text == "channel dark-hole: 0 nm rms of surface"
    assert "letter first" in answer(state, "channel", text="Dark Hole")[1].text


def test_the_refusal_of_an_offset_names_its_mode() -> None:
    _, reply = answer(loaded(DEFAULTS), "offset", 80.0, modes=(4,))
    assert (reply.accepted, reply.text) == (False, "offset of mode 4: at most its limit, 50 nm; asked for 80 nm")
    complete = loaded(DEFAULTS).loop.calibration
    truncated = replace(complete, actuators_to_modes=np.zeros_like(complete.modes_to_actuators.T))
    load, offset = Request(1, "load", calibration=truncated), Request(1, "offset", (4,), (5.0,))
    for order in ((load, offset), (offset, load)):  # the later one is refused
        *_, outputs = feed(DEFAULTS, loaded(DEFAULTS), Request(0, "open"), *order)[1]
        assert "offset of mode 4: R measures it only in part" in outputs.reply.text


def test_events_use_singular_and_plural() -> None:
    event = EVENTS["FRAMES_MISSING"]
    assert "1 frame missing" in event.log("controller", 0, count=1, number=7).message
    assert "2 frames missing" in event.log("controller", 0, count=np.int64(2), number=7).message
