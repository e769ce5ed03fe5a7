"""The probe finds a planted linear signal, finds nothing in noise, and never splits an episode."""

import itertools

import numpy as np
import pytest

from stad_lab.evaluation.probe import probe


def planted(episodes=40, length=50, noise=0.5):
    """Features that carry the first target with a known R2; the second target is noise."""
    rng = np.random.default_rng(0)
    features = rng.standard_normal((episodes * length, 32))
    signal = features @ rng.standard_normal(32)
    target = signal / signal.std() + noise * rng.standard_normal(len(signal))
    targets = np.stack([target, rng.standard_normal(len(signal))], axis=1)
    return features, targets, np.repeat(np.arange(episodes), length)


def test_a_planted_linear_signal_is_found_with_its_own_r2():
    found = probe(*planted(noise=0.5))
    assert found["r2"][0] == pytest.approx(1 / (1 + 0.25), abs=0.04)
    assert found["low"][0] < found["r2"][0] < found["high"][0]
    assert found["high"][0] - found["low"][0] < 0.1


def test_noise_and_shuffled_targets_are_not_found():
    features, targets, episodes = planted(noise=0.1)
    found = probe(features, targets, episodes)["r2"]
    assert found[0] > 0.95 and abs(found[1]) < 0.1
    shuffled = np.random.default_rng(1).permutation(targets)
    assert np.abs(probe(features, shuffled, episodes)["r2"]).max() < 0.1


def test_what_identifies_an_episode_is_not_mistaken_for_a_signal():
    # Each episode has a feature and a target of its own, which rows split at random would share.
    rng = np.random.default_rng(0)
    episodes = np.repeat(np.arange(30), 40)
    features = np.eye(30)[episodes] + 0.01 * rng.standard_normal((1200, 30))
    targets = rng.standard_normal(30)[episodes][:, None]
    assert probe(features, targets, episodes)["r2"][0] < 0.1


def test_an_interval_is_over_episodes_and_does_not_narrow_if_their_rows_are_repeated():
    features, targets, episodes = planted(episodes=20, length=10)
    rng = np.random.default_rng(0)
    targets = targets + rng.standard_normal(20)[episodes][:, None]  # episodes differ
    widths = []
    for count in (1, 30):
        rows = (np.repeat(part, count, axis=0) for part in (features, targets, episodes))
        found = probe(*rows)
        widths.append(found["high"] - found["low"])
    assert widths[1] == pytest.approx(widths[0], rel=0.3)


def test_the_penalty_is_chosen_on_episodes_that_r2_is_not_measured_on(monkeypatch):
    asked = []

    def noting(features, targets, fit, trial):
        asked.append((fit, trial))
        return np.ones(2)

    monkeypatch.setattr("stad_lab.evaluation.probe.choose_penalties", noting)
    features, targets, episodes = planted()
    assert probe(features, targets, episodes)["r2"][0] > 0.7
    ((fit, trial),) = asked
    assert not set(episodes[fit]) & set(episodes[trial])
    assert len(set(episodes[fit | trial])) == 24  # of forty
    targets[fit | trial] = 0.0  # nothing that was fitted on is left
    assert probe(features, targets + 1e-9 * features[:, :2], episodes)["r2"][0] < 0.1


def test_the_same_seed_gives_the_same_numbers():
    first, second = probe(*planted(), seed=4), probe(*planted(), seed=4)
    assert all(np.array_equal(first[name], second[name]) for name in first)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda f, t, e: (f[1:], t, e), "1999 rows of features, 2000 of targets"),
        (lambda f, t, e: (f * np.nan, t, e), "not finite"),
        (lambda f, t, e: (f, t, e % 9), "9 episodes: expected at least 10"),
        (lambda f, t, e: (f, 0 * t + 1, e), r"targets \[0, 1\] are constant"),
    ],
)
def test_rows_that_cannot_be_probed_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        probe(*change(*planted()))


def test_an_interval_holds_the_middle_95_percent_of_the_resamples(monkeypatch):
    count = itertools.count()
    monkeypatch.setattr(
        "stad_lab.evaluation.probe.r2_of_sums", lambda sums: np.full(2, float(next(count)))
    )
    found = probe(*planted(), resamples=1001)
    assert found["low"] == pytest.approx([25, 25]) and found["high"] == pytest.approx([975, 975])
