"""The verdicts of studies 1 and 5 in words, for the pages.

Every sentence follows from the comparisons of `study_claims` and `study5_claims`.
"""

from stad_study.claims import PAPER_GAINS
from stad_study.study_claims import LEVEL, MARGIN

PAPER_GAIN = PAPER_GAINS["input_output"]
SEES = {
    "z, h": "z and h, as in World Models",  # the claim
    "z": "z alone",  # a diagnostic
}


def describe_verdict(study: dict) -> list[str]:
    """Four points: both verdicts, whether they differ, and the paper's gains.

    Args:
        study: what `describe_study1` returns after the last pipeline.
    """
    primary = {features: study["comparisons"][f"{features}: input_output"] for features in SEES}
    told = [describe_comparison(features, one) for features, one in primary.items()]
    told.append(describe_interaction(study["afterwards"]["interaction"]))
    return [*told, describe_paper_gain(study)]


def describe_comparison(features: str, one: dict) -> str:
    """The verdict of one primary comparison, with its interval."""
    points, (low, high) = one["difference"], one["interval"]
    text = f"If C sees {SEES[features]}: {name_verdict(one)} (`input_output` minus `frame` is"
    text += f" {points:+.1f} points, 95% interval {low:.1f} to {high:.1f}"
    if one["verdict"] == "undecided":
        text += f"; {one['seeds_that_decide']} seeds would decide"
    return text + ")."


def name_verdict(one: dict) -> str:
    """The verdict of a comparison, and whether a gain may be smaller than the margin."""
    small = one["verdict"] == "gain" and one["interval"][0] < MARGIN
    return f"*{one['verdict']}*{', perhaps too small to matter' if small else ''}"


def describe_interaction(one: dict) -> str:
    """How far the two effects are apart; the protocol has no such test."""
    significant = "significant" if one["p"] < LEVEL else "not significant"
    apart = f"The two differences are {one['difference']:.1f} points apart"
    return f"{apart}: {significant} (p = {one['p']:.3f}, computed afterwards)."


def describe_repetition(one: dict) -> str:
    """How far they are apart in part 5a of study 5, whose interaction this is."""
    low, high = one["interval"]
    text = "[Study 5a](#is-it-the-motion), planned later, with three new controllers for each of"
    text += f" the same V and M: {one['difference']:.1f} points"
    return f"{text} ({low:.1f} to {high:.1f}; Holm's p = {one['holm_p']:.3f})."


def describe_changes(comparisons: dict[str, dict]) -> str:
    """What adding and erasing the motion did in parts 5b and 5c of study 5."""
    adding, erasing = (comparisons[name] for name in ("adding motion", "erasing motion"))
    low, high = adding["interval"]
    text = f"Why? Motion added to z of `frame`, against a placebo: *{adding['verdict']}*"
    text += f" ({adding['difference']:+.1f}, {low:.1f} to {high:.1f}). Erased from z of"
    return f"{text} `input_output`: *{erasing['verdict']}* ({erasing['difference']:+.1f})."


def describe_ceiling(study: dict) -> str:
    """Where the gain of the paper was out of reach, for the overview; else nothing."""
    seen = " or ".join(name.replace(", ", " and ") for name in SEES if out_of_reach(study, name))
    least = min(PAPER_GAINS.values())
    return f"With {seen} `frame` plus {least:.0f} would exceed our best runs." if seen else ""


def describe_others(study: dict) -> str:
    """That no other variant has a gain, for the overview; else nothing."""
    others = [one for name, one in study["comparisons"].items() if "input_output" not in name]
    verdicts = [one["verdict"] for one in others]
    if "gain" in verdicts:
        return ""
    undecided = f"{verdicts.count('undecided')} of {len(verdicts)} undecided"
    return f"`input`, `output`: no gain shown ({undecided})."


def out_of_reach(study: dict, features: str) -> bool:
    """Whether `frame` with the smallest gain of the paper is above the best run of each track."""
    baseline = study["arms"][f"{features}: frame"]["mean"]
    return baseline + min(PAPER_GAINS.values()) > study["ceiling"]


def describe_paper_gain(study: dict) -> str:
    """How many intervals end below the gain of the paper, where it was in reach, and where not."""
    reached = [features for features in SEES if not out_of_reach(study, features)]
    below = [
        one["interval"][1] < PAPER_GAINS[name.partition(": ")[2]]
        for name, one in study["comparisons"].items()
        if name.partition(": ")[0] in reached
    ]
    count = f"all {len(below)}" if all(below) else f"{sum(below)} of the {len(below)}"
    count += " intervals with z alone" if reached == ["z"] else " intervals"
    low, high = min(PAPER_GAINS.values()), max(PAPER_GAINS.values())
    text = f"The paper reports gains of {low:.0f} to {high:.0f} points, on CarRacing-v0 and with"
    text += " another recipe."
    text += f" Here, on v3, {count} end below them." if reached else ""
    for features in SEES:
        if features not in reached:
            baseline = study["arms"][f"{features}: frame"]["mean"]
            seen, best = features.replace(", ", " and "), f"{study['ceiling']:.0f}"
            text += f" With {seen} `frame` plus such gains would exceed our best runs: it has"
            text += f" {baseline:.0f} points, {low:.0f} more are {baseline + low:.0f}, and the"
            text += f" best of all pipelines on each track has {best} on average (computed"
            text += " afterwards)."
    return text


def describe_cause(study: dict) -> list[str]:
    """What study 5 means: its part 5a, and all parts together.

    Args:
        study: what `describe_study5` returns.
    """
    comparisons = study["comparisons"]
    return [read_repetition(comparisons["interaction"]["verdict"]), read_cause(comparisons)]


def read_repetition(verdict: str) -> str:
    """What the interaction of part 5a means, by words that were fixed before its last run."""
    if verdict == "gain":
        text = "Difference images are worth more if C does not see h, as the account by motion"
        return f"{text} predicts. Other accounts predict it, too."
    if verdict == "harm":
        text = "Difference images are worth less if C does not see h: the account by motion"
        return f"{text} predicts the opposite."
    return "That difference images are worth more without h, as motion predicts, is not shown."


def read_cause(comparisons: dict[str, dict]) -> str:
    """Whether the motion explains the gain, by the rule that the protocol fixed for study 5."""
    low, high = comparisons["both with motion"]["interval"]
    alike = low > -MARGIN and high < MARGIN
    tested = ("interaction", "adding motion", "erasing motion")
    more, adding, erasing = (comparisons[name]["verdict"] for name in tested)
    holds = {
        "difference images are worth more with z alone": more == "gain",
        f"adding the motion is a gain{opposite(adding, 'harm')}": adding == "gain",
        f"erasing the motion is a harm{opposite(erasing, 'gain')}": erasing == "harm",
        f"with the motion the variants are within {MARGIN} points (no test)": alike,
    }
    if all(holds.values()):
        left = comparisons["both with motion"]["difference"]
        return (
            "All four conditions of the protocol hold: by its rule the motion explains the gain."
            f" With the motion `input_output` minus `frame` is {left:+.1f} points ({low:.1f} to"
            f" {high:.1f})."
        )
    missing = "; ".join(name for name, found in holds.items() if not found)
    shown = "; ".join(name for name, found in holds.items() if found) or "nothing"
    text = f"That the motion explains the gain is not shown. Conditions that hold: {shown}."
    return f"{text} That do not: {missing}."


def opposite(verdict: str, other: str) -> str:
    """That a comparison has the verdict opposite to what motion predicts, in brackets."""
    return f" (it is a {verdict})" if verdict == other else ""
