import numpy as np

from lowfc.adapters.logs.sequence_gaps import REMEMBERED, Gaps


def test_a_gap_is_closed_by_a_late_message_and_by_no_repeated_one() -> None:
    gaps = Gaps(5)
    told = [(count, gaps.came(count), gaps.missing) for count in (5, 8, 8, 6, 6, 9, 7, 4)]
    assert told == [
        (5, True, 0),
        (8, True, 2),
        (8, False, 2),
        (6, True, 1),
        (6, False, 1),
        (9, True, 1),
        (7, True, 0),
        (4, False, 0),
    ]
    assert (gaps.first, gaps.next) == (5, 10)


def test_whatever_the_order_only_what_never_came_is_missing() -> None:
    rng = np.random.default_rng(5)
    there = [0, *rng.permutation(rng.choice(np.arange(1, 1000), 800, replace=False)).tolist()]
    gaps, seen = Gaps(0), set()
    for count in [*there, *there[:50]]:
        assert gaps.came(count) == (count not in seen)
        seen.add(count)
        assert gaps.missing == max(seen) + 1 - len(seen)


def test_a_gap_of_any_size_takes_no_room() -> None:
    gaps = Gaps(0)
    far = 1 << 31
    for count in (0, far, far + 3 * REMEMBERED, far + 6 * REMEMBERED):
        gaps.came(count)
    assert gaps.missing == far + 6 * REMEMBERED - 3
    assert len(gaps._open) <= 2 * REMEMBERED
    assert gaps.came(far + 6 * REMEMBERED - 1)
    assert not gaps.came(7), "too long ago to be known"
