"""A sequence whose start lies far ahead of this host's clock is refused, and both clocks are named."""

import pytest

from lowfc.adapters.bus.start_check import StartCheck
from lowfc.adapters.process.clock import SIMULATED_START_NS
from lowfc.contract.envelope import sequence_of
from lowfc.testing.clock import FakeClock

pytestmark = pytest.mark.exclusive

NOW_S = SIMULATED_START_NS // 10**9
DAY_S = 86_400


def test_starts_far_ahead_are_refused_with_both_clocks() -> None:
    named: list[tuple[str, str]] = []
    check = StartCheck(FakeClock(), 24.0, lambda start, here: named.append((start, here)))
    assert not check.ahead(sequence_of(NOW_S, 5))
    assert not check.ahead(sequence_of(NOW_S + DAY_S - 5, 0))
    year = sequence_of(NOW_S + 365 * DAY_S, 0)
    assert check.ahead(year)
    assert check.ahead(year + 7)
    assert named == [("2027-01-01T00:00:00Z", "2026-01-01T00:00:00Z")], "named once"
    assert check.ahead((1 << 64) - (1 << 33) - 1)


def test_what_is_ahead_today_is_not_tomorrow() -> None:
    clock = FakeClock()
    check = StartCheck(clock, 24.0, lambda start, here: None)
    later = sequence_of(NOW_S + DAY_S + 60, 0)
    assert check.ahead(later)
    clock.advance(120 * 10**9)
    assert not check.ahead(later)


def test_a_key_and_simulated_time_lift_it() -> None:
    far = sequence_of(NOW_S + 400 * DAY_S, 0)
    assert not StartCheck(FakeClock(), 0.0, lambda start, here: None).ahead(far)
    assert not StartCheck(FakeClock(lockstep=True), 24.0, lambda start, here: None).ahead(far)
    woken_in_1970 = FakeClock(5 * 10**9)
    assert StartCheck(woken_in_1970, 24.0, lambda start, here: None).ahead(sequence_of(NOW_S, 0))


def test_it_works_in_2039_and_2100() -> None:
    for now_s in (2_177_452_800, 4_102_444_800):
        check = StartCheck(FakeClock(now_s * 10**9), 24.0, lambda start, here: None)
        assert not check.ahead(sequence_of(now_s, 1 << 20))
        assert check.ahead(sequence_of(now_s + 2 * DAY_S, 0))
