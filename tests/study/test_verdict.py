"""The verdict in words: each outcome of the study has its sentences, and they are short."""

import itertools
import sys
from pathlib import Path

import pytest

from stad_study.claims import read_claims
from stad_study.study_claims import FEATURES, find_verdict
from stad_study.verdict import describe_cause, describe_changes, describe_others, describe_verdict

sys.path.insert(0, str(Path(__file__).parents[2] / "docs"))
import blocks

OUTCOMES = {  # interval and Holm's p
    "gain": ([12.3, 80.1], 0.0004),
    "harm": ([-50.2, -4.0], 0.012),
    "no relevant gain": ([-29.6, 11.0], 0.3),
    "undecided": ([-20.0, 41.0], 0.2),
}
PAIRS = list(itertools.product(OUTCOMES, repeat=2))


def study_with(words):
    """A finished study with these verdicts for z, and for z and h."""
    comparisons = {}
    for features, word in zip(FEATURES, words, strict=True):
        other = {"difference": 3.0, "interval": [-9.0, 15.0], "by_seed": [15.0], "verdict": word}
        comparisons[f"{features}: input"] = other
        interval, p = OUTCOMES[word]
        found = {"difference": sum(interval) / 2, "interval": interval, "holm_p": p}
        found |= {"verdict": find_verdict(interval, p), "seeds_that_decide": 121}
        found["by_seed"] = [interval[1]] * 3
        comparisons[f"{features}: input_output"] = found
    interaction = {"difference": 32.9, "p": 0.075}
    arms = {"z, h: frame": {"mean": 855.0}, "z: frame": {"mean": 803.0}}
    found = {"comparisons": comparisons, "afterwards": {"interaction": interaction}}
    return found | {"arms": arms, "ceiling": 922.0}


@pytest.mark.parametrize("words", PAIRS)
def test_every_pair_of_verdicts_is_told_with_its_intervals(words):
    both, alone, interaction, *_ = describe_verdict(study_with(words))
    assert "p = 0.075" in interaction and "not significant" in interaction
    for sentence, word in ((alone, words[0]), (both, words[1])):
        (low, high), _ = OUTCOMES[word]
        assert f"*{word}*" in sentence and f"{low:.1f} to {high:.1f}" in sentence
        assert f"is {(low + high) / 2:+.1f} points" in sentence
        assert ("121 seeds would decide" in sentence) == (word == "undecided")


def test_the_finding_of_the_overview_has_at_most_80_words():
    page = (Path(__file__).parents[2] / "README.md").read_text(encoding="utf-8")
    before = page.partition("## Do difference images help?")[2].partition("<!-- claims:")[0]
    assert len((before + blocks.finding(read_claims())).split()) <= 80


def test_the_gains_of_the_paper_are_compared_where_they_were_in_reach():
    gain = describe_verdict(study_with(("gain", "harm")))[-1]
    assert "75 to 79 points" in gain and "1 of the 2 intervals with z alone end below them" in gain
    first, second = describe_verdict(study_with(("gain", "harm")))[:2]
    assert "perhaps too small to matter" in second and "perhaps" not in first
    harm = describe_verdict(study_with(["harm"] * 2))[-1]
    assert "all 2 intervals with z alone end below" in harm


def test_where_the_best_pipelines_do_not_reach_the_gain_of_the_paper_the_page_says_so():
    study = study_with(["undecided"] * 2)
    told = describe_verdict(study)[-1]
    assert "With z and h `frame` plus such gains would exceed our best runs" in told
    assert "it has 855 points, 75 more are 930" in told
    assert "on each track has 922 on average" in told and "With z `frame`" not in told
    assert "With z and h `frame` plus 75 would exceed our" in blocks.finding({"study1": study})
    study["ceiling"] = 931.0
    assert "exceed our" not in describe_verdict(study)[-1]
    assert "exceed our" not in blocks.finding({"study1": study})
    assert "4 intervals end below" in describe_verdict(study)[-1]


def test_the_overview_says_that_no_other_variant_gains_only_if_none_does():
    told = describe_others(study_with(("undecided", "no relevant gain")))
    assert "no gain" in told and "(1 of 2 undecided)" in told
    assert describe_others(study_with(("gain", "undecided"))) == ""


def cause_with(changed=()):
    """Study 5 after its last run, where all holds that the protocol asks for, but `changed`."""
    intervals = {"interaction": [5.0, 60.0], "input_output less input": [3.0, 40.0]}
    intervals |= {"adding motion": [9.0, 50.0], "erasing motion": [-70.0, -20.0]}
    intervals |= {"both with motion": [-20.0, 25.0]} | dict(changed)
    comparisons = {}
    for name, (low, high) in intervals.items():
        p = 0.01 if low > 0 or high < 0 else 0.3
        found = {"difference": (low + high) / 2, "interval": [low, high], "holm_p": p}
        comparisons[name] = found | {"verdict": find_verdict([low, high], p)}
    return {"comparisons": comparisons}


def test_the_motion_explains_the_gain_only_if_all_holds_that_the_protocol_asks_for():
    assert "by its rule the motion explains the gain" in describe_cause(cause_with())[-1]
    for name, missing in (
        ("interaction", "difference images are worth more with z alone"),
        ("adding motion", "adding the motion is a gain"),
        ("erasing motion", "erasing the motion is a harm"),
        (
            "both with motion",
            "with the motion the variants are within 30 points (no test)",
        ),
    ):
        reading = describe_cause(cause_with({name: [-31.0, 29.0]}))[-1]
        shown, _, not_shown = reading.partition("That do not: ")
        assert "is not shown" in shown and missing not in shown and not_shown == f"{missing}."
    reading = describe_cause(cause_with({"adding motion": [-60.0, -5.0]}))[-1]
    assert "adding the motion is a gain (it is a harm)" in reading
    reading = describe_cause(cause_with({"erasing motion": [5.0, 60.0]}))[-1]
    assert "erasing the motion is a harm (it is a gain)" in reading
    names = ("interaction", "adding motion", "erasing motion", "both with motion")
    reading = describe_cause(cause_with({name: [-40.0, 40.0] for name in names}))[-1]
    assert "Conditions that hold: nothing." in reading


@pytest.mark.parametrize(
    ("interval", "words"),
    [
        ([5.0, 60.0], ": 32.5 points (5.0 to 60.0;"),
        ([-60.0, 9.0], ": -25.5 points (-60.0 to 9.0;"),
    ],
)
def test_whether_the_two_effects_differ_is_told_from_both_studies(interval, words):
    claims = {"study1": study_with(("no relevant gain", "gain"))}
    claims["study5"] = cause_with({"interaction": interval})
    assert words in blocks.verdict(claims) and "p = 0.075" in blocks.verdict(claims)


def test_what_adding_and_erasing_the_motion_did_is_told_with_its_verdicts():
    told = describe_changes(cause_with({"erasing motion": [-40.0, 5.0]})["comparisons"])
    assert "`frame`, against a placebo: *gain* (+29.5, 9.0 to 50.0)" in told
    assert "`input_output`: *undecided* (-17.5)" in told


@pytest.mark.parametrize(
    ("interval", "words"),
    [([5.0, 60.0], "more if C does not see h"), ([-60.0, -5.0], "the opposite"),
     ([-9.0, 60.0], "is not shown"), ([-9.0, 9.0], "is not shown")],
)  # fmt: skip
def test_the_interaction_of_study_5_is_read_as_the_log_fixed_it(interval, words):
    told = describe_cause(cause_with({"interaction": interval}))
    assert words in told[-2]
