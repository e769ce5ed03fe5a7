"""The verdict of study 1 in words, for the pages and notebook 05.

Every sentence follows from the comparisons of `stad_lab.replication.study_claims`.
"""

from stad_lab.replication.claims import PAPER
from stad_lab.replication.study_claims import FAMILIES, FEATURES, MARGIN

PAPER_GAIN = PAPER["input_output"] - PAPER["frame"]
SEES = {"z": "z alone", "z, h": "z and h"}
ORDER = ("gain", "harm", "no relevant gain", "undecided")  # which verdict the sentence names first


def describe_verdict(study: dict) -> list[str]:
    """Five sentences: the verdict for both C, what it means, the secondary ones, the paper's gain.

    Args:
        study: what `describe_study1` returns after the last pipeline.
    """
    primary = {features: study["comparisons"][f"{features}: input_output"] for features in FEATURES}
    told = [describe_comparison(features, one) for features, one in primary.items()]
    told += [describe_meaning(primary), describe_secondary(study["comparisons"])]
    return [*told, describe_paper_gain(primary)]


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
    """What the verdicts for z, and for z and h, say of `input_output`."""
    first, second = sorted(FEATURES, key=lambda one: ORDER.index(primary[one]["verdict"]))
    effects = describe_effect(primary[first]), describe_effect(primary[second])
    if effects[0] == effects[1]:
        return f"So {effects[0]}, whatever C sees."
    return f"So if C sees {SEES[first]}, {effects[0]}; if it sees {SEES[second]}, {effects[1]}."


def describe_effect(one: dict) -> str:
    """What one comparison says about the effect of `input_output`."""
    low, high = one["interval"]
    if one["verdict"] == "gain":
        return "`input_output` raises the score" + describe_size(low, high)
    if one["verdict"] == "harm":
        return "`input_output` lowers the score" + describe_size(-high, -low)
    if one["verdict"] == "no relevant gain":
        return f"the interval excludes a gain of {MARGIN} points"
    below = f", but is below {MARGIN} points"
    return "the effect of `input_output` stays open" + below * (high < MARGIN)


def describe_size(least: float, most: float) -> str:
    """Whether an effect between these bounds, above 0, is relevant."""
    if least >= MARGIN:
        return ""
    return f", {'' if most < MARGIN else 'perhaps '}by less than {MARGIN} points"


def describe_secondary(comparisons: dict[str, dict]) -> str:
    """The verdicts of the secondary comparisons."""
    told = []
    for features in FEATURES:
        verdicts = [
            f"`{variant}` *{comparisons[f'{features}: {variant}']['verdict']}*"
            for variant in FAMILIES["secondary"]
        ]
        told.append(f"with {SEES[features]}, {', '.join(verdicts)}")
    return f"The secondary verdicts are: {'; '.join(told)}."


def describe_paper_gain(primary: dict[str, dict]) -> str:
    """Where the paper's gain lies, and that its conditions were others."""
    places = []
    for features in FEATURES:
        low, high = primary[features]["interval"]
        places.append("below" if low > PAPER_GAIN else "above" if high < PAPER_GAIN else "within")
    where = f"{places[0]} both intervals"
    if places[0] != places[1]:
        where = f"{places[0]} the interval for z alone and {places[1]} that for z and h"
    text = f"The {PAPER_GAIN:.0f} points that the paper reports for `input_output` lie {where};"
    return f"{text} they were measured on CarRacing-v0 with another recipe."
