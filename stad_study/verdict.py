"""The verdict of study 1 in words, for the pages and notebook 05.

Every sentence follows from the comparisons of `stad_study.study_claims`.
"""

from stad_study.claims import PAPER
from stad_study.study_claims import LEVEL

PAPER_GAIN = PAPER["input_output"] - PAPER["frame"]
SEES = {"z, h": "z and h, as we read the paper", "z": "z alone"}  # the claim, and a diagnostic


def describe_verdict(study: dict) -> list[str]:
    """Four sentences: both verdicts, whether the effects differ, and the paper's gain.

    Args:
        study: what `describe_study1` returns after the last pipeline.
    """
    primary = {features: study["comparisons"][f"{features}: input_output"] for features in SEES}
    told = [describe_comparison(features, one) for features, one in primary.items()]
    told.append(describe_interaction(study["afterwards"]["interaction"]))
    return [*told, describe_paper_gain(primary)]


def describe_comparison(features: str, one: dict) -> str:
    """The verdict of one primary comparison, with its interval."""
    points, (low, high) = one["difference"], one["interval"]
    leads = f"{'trails' if points < 0 else 'leads'} `frame` by {abs(points):.1f} points"
    text = f"If C sees {SEES[features]}, the verdict is *{one['verdict']}*: `input_output` {leads}"
    text += f" (95% interval {low:.1f} to {high:.1f})"
    if one["verdict"] == "undecided":
        text += f"; {one['seeds_that_decide']} seeds would decide"
    return text + "."


def describe_interaction(one: dict) -> str:
    """Whether the two effects differ; the protocol has no such test."""
    significant = "significant" if one["p"] < LEVEL else "not significant"
    text = f"Computed afterwards: the effects differ by {one['difference']:.1f} points,"
    return f"{text} {significant} (p = {one['p']:.3f})."


def describe_paper_gain(primary: dict[str, dict]) -> str:
    """Where the paper's gain lies, and that its conditions were others."""
    places = []
    for one in primary.values():
        low, high = one["interval"]
        places.append("below" if low > PAPER_GAIN else "above" if high < PAPER_GAIN else "within")
    where = f"{places[0]} both intervals"
    if places[0] != places[1]:
        where = f"{places[0]} the first interval and {places[1]} the second"
    text = f"The {PAPER_GAIN:.0f} points that the paper reports for `input_output` lie {where};"
    return f"{text} they were measured on CarRacing-v0 with another recipe."
