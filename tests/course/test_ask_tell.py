"""The reader's own evolution strategy: it is used if it is right, and diagnosed if it is not."""

import numpy as np
import pytest

from stad_course import ask_tell


def test_two_functions_climb_a_hill():
    rng, mean = np.random.default_rng(0), np.full(5, 3.0)
    for generation in range(40):
        candidates = ask_tell.ask(mean, 0.9**generation, 20, rng)
        mean = ask_tell.tell(candidates, -(candidates**2).sum(axis=1))
    assert np.abs(mean).max() < 0.1


def test_right_functions_are_used(capsys):
    def own_ask(mean, sigma, count, rng):
        return np.array([mean + sigma * rng.normal(size=len(mean)) for _ in range(count)])

    def own_tell(candidates, returns):
        ranked = candidates[np.argsort(returns)]
        return ranked[-(len(returns) // 4) :].mean(axis=0)

    assert ask_tell.yours_or_ours(own_ask, own_tell) == (own_ask, own_tell)
    assert "are right" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("own_ask", "own_tell", "said"),
    [
        (lambda mean, sigma, count, rng: ..., None, "ask is not written yet"),
        (lambda mean, sigma, count, rng: 1 / 0, None, "ask ends in an error (ZeroDivisionError"),
        (lambda mean, sigma, count, rng: mean, None, "ask returns an array of shape (3,)"),
        (lambda m, s, n, rng: s * rng.standard_normal((n, len(m))), None, "add the mean"),
        (lambda m, s, n, rng: m + rng.standard_normal((n, len(m))), None, "multiply"),
        (lambda m, s, n, rng: m + rng.standard_normal((n, len(m))) ** s, None, "not finite"),
        (lambda m, s, n, rng: m + s * rng.standard_normal((n, 1)), None, "one for each"),
        (None, lambda candidates, returns: None, "tell is not written yet"),
        (None, lambda candidates, returns: candidates.mean(axis=0), "keep the best quarter"),
        (None, lambda candidates, returns: candidates[returns.argmax()], "keeps one candidate"),
        (None, lambda candidates, returns: candidates[:3].mean(axis=0), "sort them"),
        (None, lambda c, returns: c[np.argsort(returns)[:3]].mean(axis=0), "the worst"),
    ],
)
@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning")  # a root of a negative number
def test_a_wrong_function_is_diagnosed_and_ours_is_used(own_ask, own_tell, said, capsys):
    chosen = ask_tell.yours_or_ours(own_ask or ask_tell.ask, own_tell or ask_tell.tell)
    assert chosen == (ask_tell.ask, ask_tell.tell)
    assert said in capsys.readouterr().out
