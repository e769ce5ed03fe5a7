"""The verdict in words: each outcome of the study has its sentences, and they are short."""

import itertools
import sys
from pathlib import Path

import pytest

from stad_study.study_claims import FEATURES, find_verdict
from stad_study.verdict import describe_verdict

sys.path.insert(0, str(Path(__file__).parents[2] / "docs"))
import blocks

OUTCOMES = {  # interval and Holm's p, and the effect that the meaning names
    "gain": (
        [12.3, 80.1],
        0.0004,
        "raises the score by 46 points (95% interval 12 to 80",
    ),
    "large gain": ([31.0, 80.0], 0.0004, "raises the score by 56 points (95% interval 31 to 80"),
    "small gain": ([4.0, 25.0], 0.01, "raises the score by 14 points (95% interval 4 to 25"),
    "harm": (
        [-50.2, -4.0],
        0.012,
        "lowers the score by 27 points (95% interval 4 to 50",
    ),
    "small harm": ([-25.5, -4.0], 0.012, "lowers the score by 15 points (95% interval 4 to 26"),
    "no relevant gain": ([-29.6, 11.0], 0.3, "gains at most about 11 points"),
    "undecided": ([-20.0, 41.0], 0.2, "the effect of `input_output` stays open"),
    "undecided, no gain": ([-45.0, 20.0], 0.2, "stays open, but is below 30 points"),
}
PAIRS = list(itertools.product(OUTCOMES, repeat=2))


def study_with(words):
    """A finished study with these verdicts for z, and for z and h."""
    comparisons = {}
    for features, word in zip(FEATURES, words, strict=True):
        interval, p, _ = OUTCOMES[word]
        found = {"difference": sum(interval) / 2, "interval": interval, "holm_p": p}
        found |= {"verdict": find_verdict(interval, p), "seeds_that_decide": 121}
        comparisons[f"{features}: input_output"] = found
        for variant in ("input", "output"):
            comparisons[f"{features}: {variant}"] = {"verdict": "undecided"}
    interaction = {"difference": 32.9, "p": 0.075}
    return {"comparisons": comparisons, "afterwards": {"interaction": interaction}}


@pytest.mark.parametrize("words", PAIRS)
def test_every_pair_of_verdicts_has_a_meaning_for_the_claim(words):
    both, alone, interaction, meaning, *_ = describe_verdict(study_with(words))
    assert "p = 0.075" in interaction and "do not differ significantly" in interaction
    for sentence, word in ((alone, words[0]), (both, words[1])):
        (low, high), _, effect = OUTCOMES[word]
        verdict = word.removeprefix("small ").removeprefix("large ").partition(",")[0]
        assert f"*{verdict}*" in sentence and f"{low:.1f} to {high:.1f}" in sentence
        assert ("trails" in sentence) == (low + high < 0)
        assert ("121 seeds would decide" in sentence) == (verdict == "undecided")
        assert effect in meaning
    assert ("Whatever C sees" in meaning) == (words[0] == words[1])


def test_the_finding_of_the_overview_has_at_most_80_words_for_every_pair():
    page = (Path(__file__).parents[2] / "README.md").read_text(encoding="utf-8")
    before = page.partition("## Do difference images help?")[2].partition("<!-- claims:")[0]
    for words in PAIRS:
        found = blocks.finding({"study1": study_with(words)})
        assert len((before + found).split()) <= 80, words


def test_the_gain_of_the_paper_is_placed_by_each_interval():
    gain = describe_verdict(study_with(("gain", "harm")))[-1]
    assert "above the interval for z and h and within that for z alone" in gain
    harm = describe_verdict(study_with(["harm"] * 2))[-1]
    assert "75 points that the paper reports for `input_output` lie above both intervals" in harm
