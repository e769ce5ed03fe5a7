"""The verdict in words: each outcome of the study has its sentences, and they are short."""

import itertools

import pytest

from stad_lab.replication.study_claims import FEATURES, find_verdict
from stad_lab.replication.verdict import describe_verdict

OUTCOMES = {  # interval and Holm's p of each verdict
    "gain": ([12.3, 80.1], 0.0004),
    "harm": ([-50.2, -4.0], 0.012),
    "no relevant gain": ([-29.6, 11.0], 0.3),
    "undecided": ([-20.0, 41.0], 0.2),
}


def study_with(words):
    """A finished study with these verdicts for z, and for z and h."""
    comparisons = {}
    for features, word in zip(FEATURES, words, strict=True):
        interval, p = OUTCOMES[word]
        found = {"difference": sum(interval) / 2, "interval": interval, "holm_p": p}
        found |= {"verdict": find_verdict(interval, p), "seeds_that_decide": 21}
        comparisons[f"{features}: input_output"] = found
    return {"comparisons": comparisons}


@pytest.mark.parametrize("words", itertools.product(OUTCOMES, repeat=2))
def test_every_pair_of_verdicts_has_a_meaning_for_the_claim(words):
    alone, both, meaning, *_ = told = describe_verdict(study_with(words))
    for sentence, word in ((alone, words[0]), (both, words[1])):
        (low, high), p = OUTCOMES[word]
        assert f"*{word}*" in sentence and f"{low:.1f} to {high:.1f}" in sentence
        assert ("21 seeds would decide" in sentence) == (word == "undecided")
        assert ("< 0.001" if word == "gain" else f"= {p:.3f}") in sentence
    parts = {
        "gain": "raise the score here",
        "harm": "lower the score",
        "no relevant gain": "a gain of 30 points is excluded",
        "undecided": "stays open",
    }
    assert all(parts[word] in meaning for word in words)
    assert not any(parts[word] in meaning for word in set(OUTCOMES) - set(words))
    assert len(" ".join(told[:3]).split()) <= 85  # the overview has these


def test_the_gain_of_the_paper_is_placed_by_each_interval():
    *_, gain, _ = describe_verdict(study_with(("gain", "harm")))
    assert "within the interval for z alone and above that for z and h" in gain
    *_, gain, _ = describe_verdict(study_with(("harm", "harm")))
    assert "above both intervals" in gain


def test_a_running_study_has_its_progress_alone():
    progress = {"complete_seeds": 3, "planned_seeds": 12, "pipelines": 29, "planned_pipelines": 96}
    (told,) = describe_verdict(progress)
    assert "running: 3 of 12 seeds are complete, 29 of 96 pipelines" in told
