"""The statistics of study 5 that docs/protocol.md fixes, computed from its tables.

The score of a seed is the mean of its three runs. Before the last run of a family of parts is in
the tables, only the progress is reported: nothing is tested or shown earlier.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pandas

from stad_study import tables
from stad_study.evolved import describe_counts
from stad_study.study import STUDIES
from stad_study.study5 import ARMS, REPEATS, STUDY5
from stad_study.study_claims import compare_arms, judge, mean_curve

RELEVANT = "relevant difference"  # some arms lead, others trail
Families = dict[tuple[str, ...], dict[str, tuple[dict[str, float], ...]]]

FAMILIES: Families = {  # the parts that must be complete -> comparison -> arms added and subtracted
    ("5a",): {
        "interaction": (
            {"input_output: z": 1, "frame: z, h": 1},
            {"frame: z": 1, "input_output: z, h": 1},
        ),
        "input_output less input": (
            {"input_output: z": 0.5, "input_output: z, h": 0.5},
            {"input: z": 0.5, "input: z, h": 0.5},
        ),
    },
    ("5b", "5c"): {
        "adding motion": ({"frame: z + motion": 1}, {"frame: z + placebo": 1}),
        "erasing motion": ({"input_output: z - motion": 1}, {"input_output: z - placebo": 1}),
    },
}
DESCRIBED: Families = {  # without a test
    ("5a",): {
        "effect with z": ({"input_output: z": 1}, {"frame: z": 1}),
        "effect with z and h": ({"input_output: z, h": 1}, {"frame: z, h": 1}),
    },
    ("5b", "5c"): {
        "both with motion": ({"input_output: z + motion": 1}, {"frame: z + motion": 1}),
        "remembering the action": ({"frame: z + action": 1}, {"frame: z + placebo": 1}),
    },
}


def describe_study5(folder: Path = tables.DATA) -> dict:
    """Progress by part; and for complete families of parts "arms" and "comparisons".

    An arm is named by variant and what C sees: "frame: z + motion".
    """
    counts = describe_counts(STUDY5, folder)
    planned = counts["planned"].items()
    complete = {part for part, runs in planned if counts["runs"][part] == runs}
    shown = [part for family in FAMILIES if set(family) <= complete for part in family]
    scores, curves = scores_of(shown, folder), curves_of(shown, folder)
    arms = {arm: describe_arm(scores[arm], curves[arm]) for arm in scores}
    for arm, used in processors_of(shown, folder).items():
        arms[arm]["processors"] = used
    found: dict[str, Any] = {**counts, "arms": arms, "comparisons": {}}
    for families, tested in ((FAMILIES, True), (DESCRIBED, False)):
        for parts, comparisons in families.items():
            if set(parts) <= complete:
                found["comparisons"] |= compare_family(scores, comparisons, tested)
    return found


def scores_of(parts: list[str], folder: Path = tables.DATA) -> dict[str, np.ndarray]:
    """Arm -> returns (seeds, tracks), averaged over the runs of each seed."""
    table = tables.read_or_empty("study5_returns", folder).set_index(tables.SENSED)
    table = table[[column for column in table if column.isdigit()]]
    tracks = STUDIES["study1"].tracks
    if parts and (list(map(int, table)) != list(tracks) or table.isna().any(axis=None)):
        where = f"the tracks {tracks[0]} to {tracks[-1]}"
        raise ValueError(f"study5_returns: expected a return of each run on {where}")
    means = tables.read_or_empty("study5_runs", folder).set_index(tables.SENSED)["mean"]
    apart = (table.mean(axis=1) - means).abs() > 0.01  # returns are kept to a cent
    if parts and apart.any():
        raise ValueError(f"study 5: mean and returns differ: {apart[apart].index.tolist()}")
    return by_arm(table, parts)


def processors_of(parts: list[str], folder: Path = tables.DATA) -> dict[str, dict[str, int]]:
    """Arm -> processor -> how many of its runs were driven on it."""
    table = tables.read_or_empty("study5_runs", folder)
    if not parts:
        return {}
    counts = table.groupby(["variant", "sees"])["processor"].value_counts()
    arms = [arm for part in parts for arm in ARMS[part]]
    return {f"{variant}: {sees}": counts[variant, sees].to_dict() for variant, sees in arms}


def curves_of(parts: list[str], folder: Path = tables.DATA) -> dict[str, np.ndarray]:
    """Arm -> validation means (seeds, validations), averaged over the runs of each seed."""
    table = tables.read_or_empty("study5_runs", folder).set_index(tables.SENSED)
    table = table.filter(like="validation.")
    if parts and table.isna().any(axis=None):
        raise ValueError("study5_runs: expected every validation of each run")
    return by_arm(table, parts)


def by_arm(table: pandas.DataFrame, parts: list[str]) -> dict[str, np.ndarray]:
    """Arm -> lines of a table of runs (seeds, columns), averaged over the runs of each seed."""
    found = {}
    for variant, sees in (arm for part in parts for arm in ARMS[part]):
        seeds = STUDIES["study1"].seeds
        names = [[(seed, variant, sees, n) for n in REPEATS] for seed in seeds]
        for name in (name for own in names for name in own):
            if name not in table.index:
                raise ValueError(f"study 5: the run {name} is not in both tables: run it again")
        found[f"{variant}: {sees}"] = np.mean(
            [[table.loc[name] for name in own] for own in names], axis=1
        )
    return found


def describe_arm(returns: np.ndarray, curves: np.ndarray) -> dict:
    """Score of an arm and of each seed, and its learning curve; each from (seeds, ...)."""
    score = {"mean": float(returns.mean()), "by_seed": returns.mean(axis=1).tolist()}
    return score | {"curve": mean_curve(curves)}


def compare_family(scores: dict[str, np.ndarray], comparisons: dict, tested: bool) -> dict:
    """Comparison -> difference with interval; where `tested` Holm's p over all, and a verdict."""
    found = {}
    for name, sides in comparisons.items():
        added, subtracted = (
            sum(weight * scores[arm] for arm, weight in side.items()) for side in sides
        )
        found[name] = compare_arms(subtracted, added)
        if not tested:
            del found[name]["p"]
    if tested:
        judge(found)
        for one in found.values():
            one["verdict"] = one["verdict"].replace("relevant gain", RELEVANT)
    return found
