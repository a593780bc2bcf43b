"""Percentiles from a histogram of durations."""

import numpy as np
import pytest

from lowfc.control.durations import BIN_RATIO, Durations


def test_percentiles_agree_with_numpys_to_one_bin() -> None:
    rng = np.random.default_rng(6)
    values_ns = (rng.gamma(2.0, 100_000, 5000)).astype(int)
    durations = Durations()
    for value_ns in values_ns:
        durations.add(int(value_ns))
    fractions = (0.5, 0.99, 0.999, 1.0)
    exact = np.quantile(values_ns, fractions, method="inverted_cdf")
    found = durations.percentiles_ns(*fractions)  # rounded up to the edge of a bin
    assert all(true_ns <= found_ns <= 1 + true_ns * BIN_RATIO for found_ns, true_ns in zip(found, exact, strict=True))
    assert (durations.count, durations.max_ns) == (5000, values_ns.max())


@pytest.mark.parametrize(("duration_ns", "expected_ns"), [(-5, 0), (0, 0), (10**13, 10**13)])
def test_durations_beyond_the_bins_are_counted_in_the_outermost_ones(duration_ns: int, expected_ns: int) -> None:
    durations = Durations()
    durations.add(duration_ns)
    assert durations.count == 1
    assert durations.max_ns == expected_ns
    assert durations.percentiles_ns(0.5) == [expected_ns]


def test_percentiles_without_durations_are_zero() -> None:
    assert Durations().percentiles_ns(0.5, 0.99) == [0, 0]
