"""The bets of notebook 05: dealt fairly, counted rightly, readable without a kernel."""

import numpy as np
import pytest

from stad_course.bets import ANSWERS, TwoRuns, best_rule, deal

SCORES = np.array([np.arange(12.0), 30 + np.arange(12.0)])


def test_a_round_deals_four_runs_and_their_level_betrays_no_variant():
    rng, far, others = np.random.default_rng(1), SCORES + np.array([[0], [1000]]), []
    for _ in range(200):
        runs, other = deal(far, rng)
        assert runs.sum() == pytest.approx(0) and len(set(runs.ravel())) == 4
        assert (abs(np.subtract(*runs.mean(axis=1))) > 500) == bool(other)
        others.append(other * (1 if runs[1, 0] > 0 else -1))
    assert 80 < np.count_nonzero(others) < 120
    assert abs(sum(others)) < 40  # B is as often the better one


def test_a_bet_is_compared_with_the_truth_and_the_next_round_is_dealt():
    game = TwoRuns(SCORES)
    buttons = game.children[1].children
    for number, right in enumerate((True, False), 1):
        dealt, other, seen = game.runs, game.other, game.picture.value
        buttons[other if right else 1 - other].click()
        word = "Right" if right else "Wrong"
        assert f"{word}: {ANSWERS[other]}." in game.told.value
        assert f"1 of {number} bets won" in game.told.value
        assert game.picture.value != seen and not np.array_equal(game.runs, dealt)
    assert "Run the notebook" in game._repr_mimebundle_()["text/html"]


def test_the_best_rule_wins_always_if_variants_do_not_overlap_and_half_if_they_are_one():
    limit, share = best_rule(SCORES, rounds=500)
    assert 8 <= limit <= 20 and share == pytest.approx(1.0)
    assert best_rule(SCORES[[0, 0]], rounds=2000)[1] == pytest.approx(0.5, abs=0.04)
