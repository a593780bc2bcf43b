"""Cache warm-up: schedule of the one warm-up before each frame."""

import pytest

from lowfc.control.cache_warmup import LEAD_NS, MIN_LEAD_NS, MIN_PERIOD_NS, CacheWarmup

PERIOD_NS = 1_000_000
START_NS = 5_000_000_000


def warmup_after(*arrivals_ns: int, period_ns: int = PERIOD_NS) -> CacheWarmup:
    warmup = CacheWarmup(period_ns)
    for arrival_ns in arrivals_ns:
        warmup.frame_received(START_NS + arrival_ns)
    return warmup


def due_ns(warmup: CacheWarmup, now_ns: int) -> int:
    """Time of the next warm-up, ns after START_NS, like `now_ns`."""
    return now_ns + warmup.wait_ns(START_NS + now_ns)


def test_there_is_one_warm_up_before_each_frame_after_the_first() -> None:
    warmup = CacheWarmup(PERIOD_NS)
    assert warmup.wait_ns(START_NS) is None
    assert not warmup.due(START_NS)
    warmup.frame_received(START_NS)
    start_ns = START_NS + PERIOD_NS - LEAD_NS
    assert warmup.wait_ns(START_NS) == PERIOD_NS - LEAD_NS
    assert not warmup.due(start_ns - 1)
    assert warmup.due(start_ns)
    assert not warmup.due(start_ns)
    assert warmup.wait_ns(start_ns) is None


def test_a_warm_up_too_close_to_the_next_frame_is_omitted() -> None:
    late_ns = START_NS + PERIOD_NS - MIN_LEAD_NS + 1
    warmup = warmup_after(0)
    assert not warmup.due(late_ns)
    assert warmup.wait_ns(late_ns) is None


def test_a_slightly_late_frame_hardly_moves_the_schedule() -> None:
    late = warmup_after(0, PERIOD_NS + LEAD_NS // 4)
    assert due_ns(late, 2 * PERIOD_NS - 900_000) == pytest.approx(2 * PERIOD_NS - LEAD_NS, abs=3_000)


@pytest.mark.parametrize("shift_ns", [-1, -300_000, LEAD_NS + 1, 40 * PERIOD_NS])
def test_a_frame_that_is_early_or_far_off_resets_the_schedule(shift_ns: int) -> None:
    arrival_ns = PERIOD_NS + shift_ns
    assert due_ns(warmup_after(0, arrival_ns), arrival_ns) == arrival_ns + PERIOD_NS - LEAD_NS


@pytest.mark.parametrize("scale", [0.9995, 1.0005])
def test_the_schedule_follows_a_camera_whose_clock_is_faster_or_slower(scale: float) -> None:
    arrivals_ns = [round(frame * PERIOD_NS * scale) for frame in range(3000)]
    next_ns = due_ns(warmup_after(*arrivals_ns), arrivals_ns[-1])
    assert next_ns == pytest.approx(arrivals_ns[-1] + PERIOD_NS * scale - LEAD_NS, abs=30_000)


def test_there_is_no_warm_up_at_short_frame_periods() -> None:
    assert warmup_after(0, period_ns=MIN_PERIOD_NS).wait_ns(START_NS) is None
