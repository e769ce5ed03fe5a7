"""The verdict of study 1 in words, for the pages and notebook 05.

Every sentence follows from the comparisons of `stad_study.study_claims`.
"""

from stad_study.claims import PAPER
from stad_study.study_claims import FAMILIES, LEVEL, MARGIN

PAPER_GAIN = PAPER["input_output"] - PAPER["frame"]
SEES = {"z, h": "z and h", "z": "z alone"}  # our reading of the paper, and a diagnostic


def describe_verdict(study: dict) -> list[str]:
    """Six sentences: both verdicts, what they mean, the secondary ones, and the paper's gain.

    Args:
        study: what `describe_study1` returns after the last pipeline.
    """
    primary = {features: study["comparisons"][f"{features}: input_output"] for features in SEES}
    told = [describe_comparison(features, one) for features, one in primary.items()]
    told += [describe_interaction(study["afterwards"]["interaction"]), describe_meaning(primary)]
    return [*told, describe_secondary(study["comparisons"]), describe_paper_gain(primary)]


def describe_comparison(features: str, one: dict) -> str:
    """The verdict of one primary comparison, with its interval."""
    points, (low, high) = one["difference"], one["interval"]
    leads = f"{'trails' if points < 0 else 'leads'} `frame` by {abs(points):.1f} points"
    text = f"With {SEES[features]}, the verdict is *{one['verdict']}*: `input_output` {leads}"
    text += f" (95% interval {low:.1f} to {high:.1f})"
    if one["verdict"] == "undecided":
        text += f"; {one['seeds_that_decide']} seeds would decide"
    return text + "."


def describe_interaction(one: dict) -> str:
    """Whether the two effects differ; the protocol has no such test."""
    differ = "differ" if one["p"] < LEVEL else "do not differ significantly"
    text = f"Computed afterwards: the two effects {differ}"
    return f"{text} (by {one['difference']:.1f} points, p = {one['p']:.3f})."


def describe_meaning(primary: dict[str, dict]) -> str:
    """What the verdicts mean for a C that sees z and h, and for one that sees z alone."""
    both, alone = (describe_effect(primary[features]) for features in SEES)
    if both == alone:
        return f"Whatever C sees, {both}."
    return f"If C sees z and h, as we read the paper, {both}. If it sees z alone, {alone}."


def describe_effect(one: dict) -> str:
    """What one comparison says about the effect of `input_output`."""
    (low, high), change = one["interval"], abs(one["difference"])
    if one["verdict"] == "gain":
        return "`input_output` raises the score by " + describe_size(change, low, high)
    if one["verdict"] == "harm":
        return "`input_output` lowers the score by " + describe_size(change, -high, -low)
    if one["verdict"] == "no relevant gain":
        return f"`input_output` gains at most about {max(high, 0):.0f} points"
    below = f", but is below {MARGIN} points"
    return "the effect of `input_output` stays open" + below * (high < MARGIN)


def describe_size(change: float, least: float, most: float) -> str:
    """An effect with its bounds, all above 0, beside the limit of relevance."""
    return f"{change:.0f} points (95% interval {least:.0f} to {most:.0f}; relevant from {MARGIN})"


def describe_secondary(comparisons: dict[str, dict]) -> str:
    """The verdicts of the secondary comparisons."""
    told = []
    for features, name in SEES.items():
        verdicts = [
            f"`{variant}` *{comparisons[f'{features}: {variant}']['verdict']}*"
            for variant in FAMILIES["secondary"]
        ]
        told.append(f"with {name}, {', '.join(verdicts)}")
    return f"The secondary verdicts are: {'; '.join(told)}."


def describe_paper_gain(primary: dict[str, dict]) -> str:
    """Where the paper's gain lies, and that its conditions were others."""
    places = []
    for one in primary.values():
        low, high = one["interval"]
        places.append("below" if low > PAPER_GAIN else "above" if high < PAPER_GAIN else "within")
    where, (first, second) = f"{places[0]} both intervals", SEES.values()
    if places[0] != places[1]:
        where = f"{places[0]} the interval for {first} and {places[1]} that for {second}"
    text = f"The {PAPER_GAIN:.0f} points that the paper reports for `input_output` lie {where};"
    return f"{text} they were measured on CarRacing-v0 with another recipe."
