"""Statistics: known answers."""

import numpy as np
import pytest
from scipy.stats import t as student

from stad_lab.evaluation import statistics


def test_equal_returns_have_an_interval_without_width_and_the_tail_counts_failures():
    same = np.full((3, 10), 910.0)
    found = statistics.summarise(same)
    assert found["interval"] == [910, 910] and found["above_900"] == 1
    found = statistics.describe_tail(np.array([[799.9, 800.0, 850.0, 900.0, 950.0]]))
    assert (found["minimum"], found["failed"]) == (799.9, 1)
    assert found["below_800"] == 0.2


def test_a_difference_on_the_same_tracks_ignores_how_hard_the_tracks_are():
    tracks = np.random.default_rng(0).normal(900, 100, (1, 100))
    low, high = statistics.bootstrap(tracks)
    assert high - low > 30
    assert statistics.bootstrap_difference(tracks, tracks + 7) == pytest.approx([7, 7])


def test_tests_of_run_means_are_those_computed_by_hand():
    # Means 1 and 4, variances 1 and 9 of 3 runs each: t = 3 / sqrt(10 / 3), 100 / 41 degrees.
    expected = 2 * student.sf(3 / (10 / 3) ** 0.5, 100 / 41)
    assert statistics.welch_p([0, 1, 2], [1, 4, 7]) == pytest.approx(expected)
    # Sums of squares 2, 2 and 0 with 3 degrees of freedom in all: error^2 = 4 / 3, t = 3.182.
    half = 3.182446 * (4 / 3) ** 0.5
    interval = statistics.pooled_interval([[0, 2], [10, 12], [5, 5]], 0, 1)
    assert interval == pytest.approx([10 - half, 10 + half])
