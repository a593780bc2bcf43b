"""Cache warm-up: once before each frame, by the schedule of the frames."""

import pytest

from lowfc.programs.core.cache_warmup import LATEST_NS, LEAD_NS, SHORTEST_PERIOD_NS, CacheWarmup

PERIOD_NS = 1_000_000
START_NS = 5_000_000_000


def after(*arrivals_ns: int, period_ns: int = PERIOD_NS) -> CacheWarmup:
    warmup = CacheWarmup(period_ns)
    for arrival_ns in arrivals_ns:
        warmup.came(START_NS + arrival_ns)
    return warmup


def begins_after(warmup: CacheWarmup, now_ns: int) -> int:
    rest_ns = warmup.rest_ns(START_NS + now_ns)
    return now_ns + rest_ns


def test_once_before_each_frame_and_not_before_there_was_one() -> None:
    warmup = CacheWarmup(PERIOD_NS)
    assert warmup.rest_ns(START_NS) is None
    assert not warmup.begins(START_NS)
    warmup.came(START_NS)
    begin_ns = START_NS + PERIOD_NS - LEAD_NS
    assert warmup.rest_ns(START_NS) == PERIOD_NS - LEAD_NS
    assert not warmup.begins(begin_ns - 1)
    assert warmup.begins(begin_ns)
    assert not warmup.begins(begin_ns)
    assert warmup.rest_ns(begin_ns) is None


def test_not_where_the_frame_would_have_to_wait_for_it() -> None:
    late_ns = START_NS + PERIOD_NS - LATEST_NS + 1
    warmup = after(0)
    assert not warmup.begins(late_ns)
    assert warmup.rest_ns(late_ns) is None


def test_a_late_frame_hardly_moves_the_schedule() -> None:
    late = after(0, PERIOD_NS + LEAD_NS // 4)
    assert begins_after(late, 2 * PERIOD_NS - 900_000) == pytest.approx(2 * PERIOD_NS - LEAD_NS, abs=3_000)


@pytest.mark.parametrize("shift_ns", [-1, -300_000, LEAD_NS + 1, 40 * PERIOD_NS])
def test_a_frame_that_is_early_or_from_another_schedule_sets_it(shift_ns: int) -> None:
    arrival_ns = PERIOD_NS + shift_ns
    assert begins_after(after(0, arrival_ns), arrival_ns) == arrival_ns + PERIOD_NS - LEAD_NS


@pytest.mark.parametrize("scale", [0.9995, 1.0005])
def test_it_keeps_up_with_a_camera_whose_clock_is_another(scale: float) -> None:
    arrivals_ns = [round(frame * PERIOD_NS * scale) for frame in range(3000)]
    begin_ns = begins_after(after(*arrivals_ns), arrivals_ns[-1])
    assert begin_ns == pytest.approx(arrivals_ns[-1] + PERIOD_NS * scale - LEAD_NS, abs=30_000)


def test_no_time_for_it_where_frames_come_faster() -> None:
    assert after(0, period_ns=SHORTEST_PERIOD_NS).rest_ns(START_NS) is None
