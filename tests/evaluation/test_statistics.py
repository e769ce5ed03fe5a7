"""Statistics: known answers."""

import numpy as np

from stad_lab.evaluation import statistics


def test_equal_returns_have_an_interval_without_width_and_the_tail_counts_failures():
    same = np.full((3, 10), 910.0)
    found = statistics.summarise(same)
    assert found["interval"] == [910, 910] and found["above_900"] == 1
    found = statistics.describe_tail(np.array([[799.9, 800.0, 850.0, 900.0, 950.0]]))
    assert (found["minimum"], found["failed"]) == (799.9, 1)
    assert found["below_800"] == 0.2
