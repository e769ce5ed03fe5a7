"""The probe finds a planted linear signal, finds nothing in noise, and never splits a drive."""

import itertools

import numpy as np
import pytest

from stad_lab.evaluation.probe import probe


def planted(drives=40, length=50, noise=0.5, seed=0):
    """Features with a linear signal in them: one target of known R2, one target of pure noise."""
    rng = np.random.default_rng(seed)
    features = rng.standard_normal((drives * length, 32))
    signal = features @ rng.standard_normal(32)
    signal /= signal.std()
    target = signal + noise * rng.standard_normal(len(signal))
    return (
        features,
        np.stack([target, rng.standard_normal(len(signal))], axis=1),
        np.repeat(np.arange(drives), length),
    )


def test_a_planted_linear_signal_is_found_with_its_own_r2():
    found = probe(*planted(noise=0.5))
    assert found["r2"][0] == pytest.approx(1 / (1 + 0.25), abs=0.04)
    assert found["low"][0] < found["r2"][0] < found["high"][0]
    assert found["high"][0] - found["low"][0] < 0.1


def test_noise_and_shuffled_targets_are_not_found():
    features, targets, drives = planted(noise=0.1)
    assert probe(features, targets, drives)["r2"][0] > 0.95
    assert abs(probe(features, targets, drives)["r2"][1]) < 0.1
    shuffled = np.random.default_rng(1).permutation(targets)
    assert np.abs(probe(features, shuffled, drives)["r2"]).max() < 0.1


def test_what_identifies_a_drive_is_not_mistaken_for_a_signal():
    # Each drive has its own feature and its own target: rows split at random would be predicted perfectly.
    rng = np.random.default_rng(0)
    drives = np.repeat(np.arange(30), 40)
    features = np.eye(30)[drives] + 0.01 * rng.standard_normal((1200, 30))
    targets = rng.standard_normal(30)[drives][:, None]
    assert probe(features, targets, drives)["r2"][0] < 0.1


def test_an_interval_is_over_drives_and_does_not_narrow_if_their_rows_are_repeated():
    rng, (features, targets, drives) = np.random.default_rng(0), planted(drives=20, length=10)
    targets = targets + rng.standard_normal(20)[drives][:, None]  # drives differ
    once, often = (
        probe(*(np.repeat(part, n, axis=0) for part in (features, targets, drives)))
        for n in (1, 30)
    )
    widths = [found["high"] - found["low"] for found in (once, often)]
    assert widths[1] == pytest.approx(widths[0], rel=0.3)


def test_the_penalty_is_chosen_on_drives_that_the_r2_is_not_measured_on(monkeypatch):
    asked = []
    monkeypatch.setattr(
        "stad_lab.evaluation.probe.choose_penalties",
        lambda *given: asked.append(given[2:]) or np.ones(2),
    )
    features, targets, drives = planted()
    found = probe(features, targets, drives)["r2"]
    ((fit, trial),) = asked
    assert (
        not set(drives[fit]) & set(drives[trial]) and len(set(drives[fit | trial])) == 24
    )  # of forty
    targets[fit | trial] = 0.0  # what is measured are the others: nothing that was fitted is left
    assert (
        found[0] > 0.7 and probe(features, targets + 1e-9 * features[:, :2], drives)["r2"][0] < 0.1
    )


def test_the_same_seed_gives_the_same_numbers():
    first, second = probe(*planted(), seed=4), probe(*planted(), seed=4)
    assert all(np.array_equal(first[name], second[name]) for name in first)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda f, t, d: (f[1:], t, d), "1999 rows of features, 2000 of targets"),
        (lambda f, t, d: (f * np.nan, t, d), "not finite"),
        (lambda f, t, d: (f, t, d % 9), "9 drives: expected at least 10"),
        (lambda f, t, d: (f, 0 * t + 1, d), "one value throughout"),
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
