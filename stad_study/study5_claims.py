"""The statistics of study 5 that docs/protocol.md fixes, computed from its tables.

The score of a seed is the mean of its three runs.
"""

from pathlib import Path

import numpy as np
import pandas

from stad_study import tables
from stad_study.study import STUDIES
from stad_study.study5 import ARMS, REPEATS
from stad_study.study_claims import compare_arms, judge, mean_curve

RELEVANT = "relevant difference"  # some arms lead, others trail
Comparisons = dict[str, tuple[dict[str, float], dict[str, float]]]  # arms added and subtracted

TESTED: list[Comparisons] = [  # Holm's correction is over each of these families
    {  # part 5a
        "interaction": (
            {"input_output: z": 1, "frame: z, h": 1},
            {"frame: z": 1, "input_output: z, h": 1},
        ),
        "input_output less input": (
            {"input_output: z": 0.5, "input_output: z, h": 0.5},
            {"input: z": 0.5, "input: z, h": 0.5},
        ),
    },
    {  # parts 5b and 5c
        "adding motion": ({"frame: z + motion": 1}, {"frame: z + placebo": 1}),
        "erasing motion": ({"input_output: z - motion": 1}, {"input_output: z - placebo": 1}),
    },
]
DESCRIBED: Comparisons = {  # without a test
    "effect with z": ({"input_output: z": 1}, {"frame: z": 1}),
    "effect with z and h": ({"input_output: z, h": 1}, {"frame: z, h": 1}),
    "both with motion": ({"input_output: z + motion": 1}, {"frame: z + motion": 1}),
    "remembering the action": ({"frame: z + action": 1}, {"frame: z + placebo": 1}),
}


def describe_study5(folder: Path = tables.DATA) -> dict:
    """Its arms and comparisons, from the tables of all runs: "arms" and "comparisons".

    An arm is named by variant and what C sees: "frame: z + motion".
    """
    runs = tables.read("study5_runs", folder).set_index(tables.SENSED)
    returns = tables.returns_of_runs("study5", STUDIES["study1"].tracks, folder)
    scores, curves = by_arm(returns), by_arm(curves_of(runs))
    arms = {arm: describe_arm(scores[arm], curves[arm]) for arm in scores}
    for (variant, sees), used in runs.groupby(["variant", "sees"])["processor"]:
        arms[f"{variant}: {sees}"]["processors"] = used.value_counts().to_dict()
    comparisons = compare(scores, DESCRIBED)
    for one in comparisons.values():
        del one["p"]
    for family in TESTED:
        comparisons |= judge_family(compare(scores, family))
    return {"arms": arms, "comparisons": comparisons}


def curves_of(runs: pandas.DataFrame) -> pandas.DataFrame:
    """The validation means of each run, a column each."""
    table = runs.filter(like="validation.")
    if table.isna().any(axis=None):
        raise ValueError("study5_runs: expected every validation of each run")
    return table


def by_arm(table: pandas.DataFrame) -> dict[str, np.ndarray]:
    """Arm -> lines of a table of runs (seeds, columns), averaged over the runs of each seed."""
    found = {}
    for variant, sees in (arm for arms in ARMS.values() for arm in arms):
        seeds = STUDIES["study1"].seeds
        names = [[(seed, variant, sees, n) for n in REPEATS] for seed in seeds]
        for name in (name for own in names for name in own):
            if name not in table.index:
                raise ValueError(f"study 5: the run {name} is not in the tables: run it again")
        found[f"{variant}: {sees}"] = np.mean(
            [[table.loc[name] for name in own] for own in names], axis=1
        )
    return found


def describe_arm(returns: np.ndarray, curves: np.ndarray) -> dict:
    """Score of an arm and of each seed, and its learning curve; each from (seeds, ...)."""
    score = {"mean": float(returns.mean()), "by_seed": returns.mean(axis=1).tolist()}
    return score | {"curve": mean_curve(curves)}


def compare(scores: dict[str, np.ndarray], comparisons: Comparisons) -> dict[str, dict]:
    """Comparison -> difference with interval and p."""
    found = {}
    for name, sides in comparisons.items():
        added, subtracted = (
            np.sum([weight * scores[arm] for arm, weight in side.items()], axis=0) for side in sides
        )
        found[name] = compare_arms(subtracted, added)
    return found


def judge_family(found: dict[str, dict]) -> dict[str, dict]:
    """The comparisons of a family with Holm's p over all of them, and a verdict each."""
    judge(found)
    for one in found.values():
        one["verdict"] = one["verdict"].replace("relevant gain", RELEVANT)
    return found
