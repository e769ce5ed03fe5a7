"""The verdict of study 1 in words, for the pages and notebook 05.

Every sentence follows from the comparisons of `stad_lab.replication.study_claims`; the pages hold
none of their own about the outcome.
"""

from stad_lab.config import VARIANTS
from stad_lab.replication.claims import PAPER
from stad_lab.replication.study_claims import FEATURES, MARGIN

PAPER_GAIN = min(PAPER[name] for name in VARIANTS[1:]) - PAPER["frame"]  # the smallest
SEES = {"z": "z alone", "z, h": "z and h"}
ORDER = ("gain", "harm", "no relevant gain", "undecided")  # which verdict the sentence names first


def describe_verdict(study: dict) -> list[str]:
    """Four sentences: the verdict for both C, what it means, and the paper's gain beside it.

    Args:
        study: what `describe_study1` returns after the last pipeline.
    """
    primary = {features: study["comparisons"][f"{features}: input_output"] for features in FEATURES}
    told = [describe_comparison(features, one) for features, one in primary.items()]
    return [*told, describe_meaning(primary), describe_paper_gain(primary)]


def describe_comparison(features: str, one: dict) -> str:
    """The verdict of one primary comparison, with its interval."""
    points, (low, high) = one["difference"], one["interval"]
    leads = f"{'trails' if points < 0 else 'leads'} `frame` by {abs(points):.1f} points"
    text = f"With {SEES[features]}, the verdict is *{one['verdict']}*: `input_output` {leads}"
    text += f" (95% interval {low:.1f} to {high:.1f})"
    if one["verdict"] == "undecided":
        text += f"; {one['seeds_that_decide']} seeds would decide"
    return text + "."


def describe_meaning(primary: dict[str, dict]) -> str:
    """What the verdicts for z, and for z and h, mean for the claim."""
    first, second = sorted(FEATURES, key=lambda one: ORDER.index(primary[one]["verdict"]))
    effects = describe_effect(primary[first]), describe_effect(primary[second])
    if effects[0] == effects[1]:
        return f"So {effects[0]}, whatever C sees."
    return f"So {effects[0]} if C sees {SEES[first]}; if it sees {SEES[second]}, {effects[1]}."


def describe_effect(one: dict) -> str:
    """What one comparison says about difference images."""
    (low, high), small = one["interval"], f" by less than {MARGIN} points"
    if one["verdict"] == "gain":
        return "difference images raise the score" + small * (high < MARGIN)
    if one["verdict"] == "harm":
        return "difference images lower the score" + small * (low > -MARGIN)
    if one["verdict"] == "no relevant gain":
        return f"the interval excludes a gain of {MARGIN} points"
    below = f", but is below {MARGIN} points"
    return "the effect of difference images stays open" + below * (high < MARGIN)


def describe_paper_gain(primary: dict[str, dict]) -> str:
    """Where the paper's gain lies, and why no result here tests the paper's own numbers."""
    places = []
    for features in FEATURES:
        low, high = primary[features]["interval"]
        places.append("below" if low > PAPER_GAIN else "above" if high < PAPER_GAIN else "within")
    where = f"{places[0]} both intervals"
    if places[0] != places[1]:
        where = f"{places[0]} the interval for z alone and {places[1]} that for z and h"
    text = f"The {PAPER_GAIN:.0f} points of the paper lie {where}; they were measured on"
    return text + " CarRacing-v0 with another recipe, so our intervals do not test them."
