"""Statistics: known answers."""

import numpy as np
import pytest

from stad_lab.evaluation import statistics


def test_equal_returns_have_an_interval_without_width_and_the_tail_counts_failures():
    same = np.full((3, 10), 910.0)
    found = statistics.summarise(same)
    assert found["interval"] == [910, 910] and found["above_900"] == 1
    found = statistics.describe_tail(np.array([[799.9, 800.0, 850.0, 900.0, 950.0]]))
    assert (found["minimum"], found["failed"]) == (799.9, 1)
    assert found["below_800"] == 0.2


def test_paired_differences_ignore_how_hard_the_tracks_are():
    tracks = np.random.default_rng(0).normal(900, 100, (1, 100))
    low, high = statistics.bootstrap(tracks)
    assert high - low > 30
    assert statistics.bootstrap((tracks + 7) - tracks) == pytest.approx([7, 7])
