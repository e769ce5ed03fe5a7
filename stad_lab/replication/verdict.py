"""The verdict of study 1 in words, for the pages and notebook 05.

Every sentence follows from the comparisons of `stad_lab.replication.study_claims`; the pages hold
none of their own about the outcome.
"""

from stad_lab.replication.study_claims import FEATURES, MARGIN

PAPER_GAIN = 75  # points of `input_output` in the paper, the smallest of its three gains
SEES = {"z": "z alone", "z, h": "z and h"}


def describe_verdict(study: dict) -> list[str]:
    """The verdict for both C, what it means for the claim, and two remarks on the paper's gain.

    While the study is running, a single sentence with its progress.

    Args:
        study: what `describe_study1` returns.
    """
    if "comparisons" not in study:
        return [describe_progress(study)]
    primary = {features: study["comparisons"][f"{features}: input_output"] for features in FEATURES}
    told = [describe_comparison(features, one) for features, one in primary.items()]
    verdicts = {features: one["verdict"] for features, one in primary.items()}
    return [*told, describe_meaning(verdicts), *describe_paper_gain(primary)]


def describe_progress(study: dict) -> str:
    """How much of the study is done."""
    text = "The study is running: {complete_seeds} of {planned_seeds} seeds are complete,"
    text += " {pipelines} of {planned_pipelines} pipelines; nothing is tested before the last."
    return text.format(**study)


def describe_comparison(features: str, one: dict) -> str:
    """The verdict of one primary comparison, with its numbers."""
    points, (low, high) = round(one["difference"]), one["interval"]
    more = f"{abs(points)} points {'less' if points < 0 else 'more'} than `frame`"
    text = (
        f"If C sees {SEES[features]}, the verdict is *{one['verdict']}*: `input_output` has {more}"
    )
    text += f" (95% interval {low:.1f} to {high:.1f}, Holm's p {format_p(one['holm_p'])})"
    decides = f"; {one['seeds_that_decide']} seeds would decide"
    return text + decides * (one["verdict"] == "undecided") + "."


def format_p(p: float) -> str:
    """Three decimals, or that it is smaller."""
    return f"= {p:.3f}" if p >= 0.001 else "< 0.001"


SAME = {  # what it means if both verdicts are alike
    "gain": "So difference images raise the score here, as the paper claims.",
    "harm": "So the claim does not replicate here: difference images lower the score.",
    "no relevant gain": "So the claim does not replicate here:"
    f" a gain of {MARGIN} points is excluded.",
    "undecided": "So whether difference images raise the score stays open.",
}
PART = {  # and if they differ, in the order of telling
    "gain": "difference images raise the score",
    "harm": "difference images lower the score",
    "no relevant gain": f"a gain of {MARGIN} points is excluded",
    "undecided": "the question stays open",
}


def describe_meaning(verdicts: dict[str, str]) -> str:
    """What the verdicts for z, and for z and h, mean for the claim."""
    first, second = sorted(FEATURES, key=lambda features: list(PART).index(verdicts[features]))
    if verdicts[first] == verdicts[second]:
        return SAME[verdicts[first]]
    told = f"So {PART[verdicts[first]]} here if C sees {SEES[first]}"
    return f"{told}; if it sees {SEES[second]}, {PART[verdicts[second]]}."


def describe_paper_gain(primary: dict[str, dict]) -> list[str]:
    """Where the paper's gain lies, and why no result here refutes the paper's own numbers."""
    places = {
        features: "below" if low > PAPER_GAIN else "above" if high < PAPER_GAIN else "within"
        for features, (low, high) in ((name, one["interval"]) for name, one in primary.items())
    }
    first, second = (places[features] for features in FEATURES)
    where = f"{first} both intervals"
    if first != second:
        where = f"{first} the interval for z alone and {second} that for z and h"
    return [
        f"The {PAPER_GAIN} points of the paper lie {where}.",
        "They were measured on CarRacing-v0 with another recipe, so they are not refuted.",
    ]
