"""The mirror's own protection, with the simulated mirror: limits, command timeout, and checks of commands."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from lowfc.arrays import Single
from lowfc.contract.configuration import load
from lowfc.control.loop.safety import Limit, Limits, Reason, Rejection, neighbour_difference_nm
from lowfc.device.mirror_protection import MAX_VALID_NS, Command, MirrorProtection, Status
from tests.support.safety_checks import Simulated, violations

GRID = (4, 5)
LIMITS = Limits(750.0, 150.0, 500.0)
STEP_NM = 1500 / 2**16
START_NS = 1_700_000_000_000_000_000
MS_NS = 1_000_000


def mirror(**keys: object) -> Simulated:
    """A mirror without settling time; `keys` are further keys of section [mirror]."""
    keys = {"rows": GRID[0], "columns": GRID[1], "settling_us": 0.0} | keys
    return Simulated(load(None, {f"mirror.{key}": value for key, value in keys.items()}))


def command(actuators_nm: Single | None, index: int = 1, **changes: object) -> Command:
    valid = Command("lowfc", index, START_NS + index * MS_NS, 200 * MS_NS, actuators_nm, np.array([1, 2], np.float32))
    return valid._replace(**changes)


def uniform(height_nm: float) -> Single:
    """Shape with all actuators at one height."""
    return np.full(GRID, height_nm, np.float32)


def follow(device: Simulated, status: Status, *heights_nm: float) -> Status:
    """Status after commands to these heights, which must be accepted."""
    for height_nm in heights_nm:
        index = status.frame_sequence + 1
        status, refused = device.apply_command(status, command(uniform(height_nm), index), START_NS + index * MS_NS)
        assert refused is None
    return status


def test_clear_id_resets_the_newest_sequence_of_the_mirror() -> None:
    device = mirror()
    status, _ = device.apply_command(device.initial, command(uniform(5.0), (1 << 63)), START_NS)
    unchanged, refused = device.apply_command(status, command(uniform(9.0), 3), START_NS)
    assert (refused, unchanged) == (Rejection.OUT_OF_ORDER, status)
    status, refused = device.apply_command(status, command(uniform(9.0), 3, clear_id=77), START_NS)
    assert (refused, status.frame_sequence) == (None, 3)
    _, refused = device.apply_command(status, command(uniform(9.0), 2, clear_id=77), START_NS)
    assert refused is Rejection.OUT_OF_ORDER, "the same clear_id resets the sequence only once"
    assert device.apply_command(status, command(uniform(9.0), 2, clear_id=78), START_NS)[1] is None


def test_mirror_accepts_sixteen_channels() -> None:
    device = mirror()
    status = device.initial
    for number in range(16):
        status, refused = device.apply_command(status, command(uniform(1.0), channel=f"c{number}"), START_NS)
        assert refused is None
    assert device.apply_command(status, command(uniform(1.0), channel="another"), START_NS) == (status, Limit.CHANNEL)
    assert device.apply_command(status, command(uniform(1.0), channel="c3"), START_NS)[1] is None
    assert device.apply_command(device.initial, command(uniform(1.0), channel="x" * 33), START_NS)[1] is Limit.CHANNEL


def test_safe_mode_is_stored_for_each_channel() -> None:
    device = mirror()
    status, _ = device.apply_command(device.initial, command(uniform(1.0), safe=True), START_NS)
    status, _ = device.apply_command(status, command(uniform(1.0), channel="other"), START_NS)
    assert status.safe == {"lowfc"}
    assert device.tick(status, START_NS + 10 * MAX_VALID_NS).safe == {"lowfc"}
    assert device.apply_command(status, command(uniform(1.0), 2), START_NS)[0].safe == frozenset()


def test_command_with_a_time_in_the_far_future_still_times_out_to_flat() -> None:
    device = mirror(settling_us=50.0)
    ahead = command(uniform(100.0), time_ns=1 << 62)
    status, _ = device.apply_command(device.initial, ahead, START_NS)
    for number in range(1, 5):
        status = device.tick(status, START_NS + MAX_VALID_NS + number * 10 * MS_NS)
    assert not status.following
    assert not status.surface_nm.any()


values = st.one_of(
    st.floats(-1000, 1000, width=32),
    st.sampled_from([750.0, -750.0, 749.98, 150.0, 149.98, 250.0, -250.0, 3e38, -3e38, np.nan, np.inf, 1e-40]),
)
commands = st.lists(
    st.one_of(
        hnp.arrays(np.float32, GRID, elements=values.map(np.float32)),
        hnp.arrays(np.float32, st.sampled_from([(5, 4), (1, 1), (20,)]), elements=values.map(np.float32)),
        st.none(),
        st.integers(1, 3_000).map(lambda ms: ms * MS_NS),  # time without commands
    ),
    max_size=12,
)


@settings(max_examples=200, deadline=None, derandomize=True)
@given(script=commands, bits=st.sampled_from([8, 10, 16, 24]))
def test_surface_stays_within_the_limits_for_any_commands(script: list[object], bits: int) -> None:
    """The limits hold also after rounding to the driver's steps, and when the command has expired."""
    device = mirror(driver_bits=bits)
    status, now_ns = device.initial, START_NS
    for index, entry in enumerate(script):
        now_ns += MS_NS
        if isinstance(entry, int):
            now_ns += entry
            after = device.tick(status, now_ns)
        else:
            after, _ = device.apply_command(status, command(entry, index + 1), now_ns)
        assert violations(LIMITS, status.surface_nm, after.surface_nm) == []
        status = after


@pytest.mark.parametrize("bits", [8, 16])
def test_a_command_is_rounded_to_the_drivers_steps(bits: int) -> None:
    device = mirror(driver_bits=bits)
    shape_nm = np.linspace(-100, 100, 20, dtype=np.float32).reshape(GRID)
    status, _ = device.apply_command(device.initial, command(shape_nm), START_NS)
    step_nm = 1500 / 2**bits
    steps = status.surface_nm / step_nm
    assert np.abs(steps - np.round(steps)).max() < 1e-3
    assert np.abs(status.surface_nm - shape_nm).max() <= step_nm * 0.501
    assert len(np.unique(status.surface_nm)) > 10


def test_mirror_at_the_neighbour_limit_does_not_oscillate() -> None:
    """Rounding to the driver's steps must not exceed the limit; the mirror would then fall back towards flat."""
    device = mirror(driver_bits=8)
    shape_nm = uniform(0)
    shape_nm[:2] = 740
    shape_nm[2:] = -740
    status = device.initial
    for index in range(1, 60):
        status, _ = device.apply_command(status, command(shape_nm, index), START_NS + index * MS_NS)
        if index == 30:
            settled = status.surface_nm
    assert neighbour_difference_nm(status.surface_nm) > LIMITS.neighbour_nm - 3 * 1500 / 2**8
    assert np.array_equal(status.surface_nm, settled)


def test_limits_of_the_mirror_are_reported_and_its_modal_command_is_then_empty() -> None:
    device = mirror()
    status, _ = device.apply_command(device.initial, command(uniform(100)), START_NS)
    assert status.limits_hit == ()
    assert status.command_nm.tolist() == [1, 2]
    status, _ = device.apply_command(status, command(uniform(900), 2), START_NS + MS_NS)
    assert status.limits_hit == (Limit.STROKE, Limit.SLEW)
    assert status.command_nm.size == 0
    status, _ = device.apply_command(status, command(uniform(300), 3), START_NS + 2 * MS_NS)
    assert status.limits_hit == ()


@pytest.mark.parametrize(
    ("invalid", "reason"),
    [
        (command(None, 6), Limit.WRONG_GRID),
        (command(np.zeros((5, 4), np.float32), 6), Limit.WRONG_GRID),
        (command(uniform(np.nan), 6), Limit.NOT_FINITE),
        (command(uniform(-np.inf), 6), Limit.NOT_FINITE),
        (command(uniform(5), 6, command_nm=np.array([np.nan], np.float32)), Limit.NOT_FINITE),
        (command(uniform(5), 4), Rejection.OUT_OF_ORDER),
    ],
)
def test_invalid_command_changes_nothing_and_does_not_restart_the_timeout(invalid: Command, reason: Reason) -> None:
    device = mirror()
    before = follow(device, device.initial, 10, 20, 30, 40, 50)
    after, refused = device.apply_command(before, invalid, START_NS + 100 * MS_NS)
    assert refused is reason
    assert after is before


def test_repeated_command_renews_the_timeout() -> None:
    device = mirror()
    status = follow(device, device.initial, 10)
    after, refused = device.apply_command(status, command(uniform(10), 1), START_NS + 150 * MS_NS)
    assert refused is None
    assert after.received_ns == START_NS + 150 * MS_NS
    assert np.array_equal(after.surface_nm, status.surface_nm)


@pytest.mark.parametrize(
    ("valid_ns", "held_ns"),
    [(200 * MS_NS, 200 * MS_NS), (2**64 - 1, MAX_VALID_NS), (0, 0)],
    ids=["200 ms", "longest", "zero"],
)
def test_command_expires_just_after_its_validity(valid_ns: int, held_ns: int) -> None:
    device = mirror()
    status, _ = device.apply_command(device.initial, command(uniform(50), valid_for_ns=valid_ns), START_NS)
    held = device.tick(status, START_NS + held_ns)
    assert held.following
    assert np.array_equal(held.surface_nm, status.surface_nm)
    expired = device.tick(held, START_NS + held_ns + 1)
    assert not expired.following
    assert not expired.surface_nm.any()


def test_command_expires_if_the_clock_goes_back() -> None:
    device = mirror()
    status, _ = device.apply_command(device.initial, command(uniform(50)), START_NS)
    gone_back = device.tick(status, START_NS - 1)
    assert not gone_back.following
    assert gone_back.time_ns >= status.time_ns


def test_expired_mirror_relaxes_to_flat_within_the_slew_limit_and_follows_again() -> None:
    device = mirror()
    status = follow(device, device.initial, 100, 200, 300, 400, 500)
    now_ns = START_NS + 1_000 * MS_NS
    heights = []
    for _ in range(6):
        status = device.tick(status, now_ns)
        now_ns += 10 * MS_NS
        heights.append(float(status.surface_nm.max()))
    assert heights[0] == pytest.approx(350, abs=0.1)
    assert heights[3:] == [0, 0, 0]
    assert status.channels == {}
    status, refused = device.apply_command(status, command(uniform(100), 700), now_ns)
    assert refused is None
    assert status.following
    assert status.surface_nm.max() == pytest.approx(100, abs=STEP_NM)


def test_expired_mirror_holds_its_shape_if_configured() -> None:
    device = mirror(on_command_timeout="hold")
    status = follow(device, device.initial, 50)
    expired = device.tick(status, START_NS + 1_000 * MS_NS)
    assert not expired.following
    assert np.array_equal(expired.surface_nm, status.surface_nm)


def test_mirror_is_flat_before_the_first_command() -> None:
    device = mirror()
    status = device.tick(device.initial, START_NS)
    assert (status.following, status.surface_nm.any()) == (False, False)


def test_channels_are_summed_and_the_sum_is_limited() -> None:
    device = mirror()
    status = device.initial
    for index, (channel, height_nm) in enumerate((("lowfc", 60), ("offset", -20), ("lowfc", 80)), start=1):
        sent = command(uniform(height_nm), index, channel=channel)
        status, _ = device.apply_command(status, sent, START_NS + index * MS_NS)
    assert status.surface_nm.max() == pytest.approx(60, abs=STEP_NM)
    assert sorted(status.channels) == ["lowfc", "offset"]
    status, _ = device.apply_command(status, command(uniform(3e38), 4, channel="lowfc"), START_NS + 4 * MS_NS)
    status, _ = device.apply_command(status, command(uniform(3e38), 5, channel="offset"), START_NS + 5 * MS_NS)
    assert status.limits_hit == (Limit.NOT_FINITE,)
    assert np.abs(status.surface_nm).max() <= LIMITS.stroke_nm


def test_dead_and_stuck_actuators_stay_where_they_are() -> None:
    device = mirror(dead=[0], stuck_nm={"6": 123.0})
    status = device.initial
    assert status.surface_nm[1, 1] == 123
    status = follow(device, status, 100)
    assert status.surface_nm[0, 0] == 0
    assert status.surface_nm[1, 1] == 123
    assert status.surface_nm[2, 2] == pytest.approx(100, abs=STEP_NM)
    for _ in range(5):
        status = device.tick(status, START_NS + 1_000 * MS_NS)
    assert np.count_nonzero(status.surface_nm) == 1
    assert status.surface_nm[1, 1] == 123


def test_settling_is_a_first_order_response() -> None:
    """One time constant after a command the surface has moved by 1 - 1/e."""
    device = mirror(settling_us=1000.0)
    status, _ = device.apply_command(device.initial, command(uniform(0), 1), START_NS)
    status, _ = device.apply_command(status, command(uniform(100), 2), START_NS)
    assert status.surface_nm.max() == pytest.approx(100 * (1 - np.exp(-1)), abs=STEP_NM)
    status = device.tick(status, status.time_ns + 2 * MS_NS)
    assert status.surface_nm.max() == pytest.approx(100 * (1 - np.exp(-3)), abs=STEP_NM)
    status = device.tick(status, status.time_ns + 21 * MS_NS)
    assert status.surface_nm.max() == pytest.approx(100, abs=STEP_NM)


def test_command_with_an_older_time_does_not_move_the_surface_back() -> None:
    device = mirror(settling_us=1000.0)
    status = follow(device, device.initial, 0, 100)
    unmoved, _ = device.apply_command(status, command(uniform(100), 2, time_ns=0), START_NS)
    assert np.array_equal(unmoved.surface_nm, status.surface_nm)


def test_commands_of_the_same_frame_move_the_surface_within_the_slew_limit() -> None:
    """After a frame timeout, the controller relaxes the mirror with commands that all have the last frame's time."""
    device = mirror(settling_us=1000.0)
    status = follow(device, device.initial, 100, 200, 300)
    for number, height_nm in enumerate((200, 100, 0), start=1):
        before = status.surface_nm
        now_ns = status.received_ns + 10 * MS_NS
        status, _ = device.apply_command(status, command(uniform(height_nm), 3, time_ns=status.commanded_ns), now_ns)
        assert status.surface_nm.max() == pytest.approx(height_nm, abs=1), number
        assert np.abs(status.surface_nm - before).max() <= LIMITS.slew_nm


def test_apply_command_does_not_modify_its_arguments() -> None:
    device = mirror()
    status = follow(device, device.initial, 10)
    driven, surface = status.driven_nm.copy(), status.surface_nm.copy()
    channels = {name: shape_nm.copy() for name, shape_nm in status.channels.items()}
    sent = command(uniform(700), 2, channel="other")
    device.apply_command(status, sent, START_NS)
    device.tick(status, START_NS + 10_000 * MS_NS)
    assert np.array_equal(status.driven_nm, driven)
    assert np.array_equal(status.surface_nm, surface)
    np.testing.assert_equal(dict(status.channels), channels)
    assert np.array_equal(sent.actuators_nm, uniform(700))


def test_driver_step_too_coarse_for_the_slew_limit_is_refused() -> None:
    with pytest.raises(ValueError, match="slew_nm"):
        _ = MirrorProtection(GRID, Limits(750.0, 5.0, 500.0), 1500 / 2**8, flatten=True).tightened_limits


def test_the_configuration_gives_the_mirrors_limits_and_faulty_actuators() -> None:
    keys = {"mirror.dead": [0, 35], "mirror.stuck_nm": {"35": 9.0, "40": -70.0}, "mirror.on_command_timeout": "hold"}
    simulated = Simulated(load(None, keys))
    assert simulated.protection == MirrorProtection((34, 34), LIMITS, STEP_NM, flatten=False)
    assert np.argwhere(simulated.initial.surface_nm).tolist() == [[1, 1], [1, 6]]
    assert simulated.initial.surface_nm[1, [1, 6]].tolist() == [9, -70]
