"""The verdict of study 1 in words, for the pages.

Every sentence follows from the comparisons of `stad_study.study_claims`.
"""

from stad_study.claims import PAPER_GAINS
from stad_study.study_claims import LEVEL, MARGIN

PAPER_GAIN = PAPER_GAINS["input_output"]
SEES = {"z, h": "z and h, as we read the paper", "z": "z alone"}  # the claim, and a diagnostic


def describe_verdict(study: dict) -> list[str]:
    """Four sentences: both verdicts, whether the effects differ, and the paper's gains.

    Args:
        study: what `describe_study1` returns after the last pipeline.
    """
    primary = {features: study["comparisons"][f"{features}: input_output"] for features in SEES}
    told = [describe_comparison(features, one) for features, one in primary.items()]
    told.append(describe_interaction(study["afterwards"]["interaction"]))
    return [*told, describe_paper_gain(study["comparisons"])]


def describe_comparison(features: str, one: dict) -> str:
    """The verdict of one primary comparison, with its interval."""
    points, (low, high) = one["difference"], one["interval"]
    leads = f"{'trails' if points < 0 else 'leads'} `frame` by {abs(points):.1f} points"
    text = f"If C sees {SEES[features]}, the verdict is *{one['verdict']}*: `input_output` {leads}"
    text += f" (95% interval {low:.1f} to {high:.1f})"
    if one["verdict"] == "gain" and low < MARGIN:
        text += ", perhaps too few to matter"
    if one["verdict"] == "undecided":
        text += f"; {one['seeds_that_decide']} seeds would decide"
    return text + "."


def describe_interaction(one: dict) -> str:
    """Whether the two effects differ; the protocol has no such test."""
    significant = "significant" if one["p"] < LEVEL else "not significant"
    text = f"Computed afterwards: the effects differ by {one['difference']:.1f} points,"
    return f"{text} {significant} (p = {one['p']:.3f})."


def describe_paper_gain(comparisons: dict[str, dict]) -> str:
    """How many intervals and single pairs lie below the paper's gain of their variant."""
    below, reached = [], []
    for name, one in comparisons.items():
        gain = PAPER_GAINS[name.partition(": ")[2]]
        below.append(one["interval"][1] < gain)
        reached += [points >= gain for points in one["by_seed"]]
    count = f"all {len(below)}" if all(below) else f"{sum(below)} of the {len(below)}"
    low, high = min(PAPER_GAINS.values()), max(PAPER_GAINS.values())
    text = f"The paper reports gains of {low:.0f} to {high:.0f} points, above {count} intervals of"
    text += f" means; {sum(reached)} of {len(reached)} single pairs reach them."
    return f"{text} It used CarRacing-v0 and another recipe."
