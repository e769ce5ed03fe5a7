"""The outcome of study 2 that docs/protocol.md fixes, computed from its tables.

The gate at a number of episodes is reported once all its runs are in the tables, and the comparison
after the last run.
"""

from pathlib import Path
from typing import Any

import numpy as np

from stad_study import tables
from stad_study.evolved import describe_counts
from stad_study.study import STUDIES
from stad_study.study2 import GATE, SEEDS, STUDY2, has_passed
from stad_study.study_claims import compare_arms


def describe_study2(folder: Path = tables.DATA) -> dict:
    """Progress by part, "gate": episodes -> scores and whether it passed.

    After the last run "scores" has those of each arm by seed, and "comparison" the test, if there
    are pairs enough.
    """
    counts = describe_counts(STUDY2, folder)
    gates = {episodes: has_passed(episodes, folder) for episodes in GATE}
    found: dict[str, Any] = {
        **counts,
        "gate": {
            str(episodes): {"scores": gate_scores(episodes, folder), "passed": passed}
            for episodes, passed in gates.items()
            if passed is not None
        },
    }
    part = "after the gate"
    if part not in counts["runs"] or counts["runs"][part] < counts["planned"][part]:
        return found
    runs = tables.read("study2_runs", folder).sort_values("seed")
    found["scores"] = {
        f"{variant}, {episodes} each": own["mean"].tolist()
        for (variant, episodes), own in runs.groupby(["variant", "episodes"])
    }
    if passed := [episodes for episodes in (1, 4) if gates[episodes]]:
        pair = [returns_of(variant, passed[0], folder) for variant in ("frame", "input_output")]
        found["comparison"] = compare_arms(*pair) | {"episodes": passed[0]}
    return found


def gate_scores(episodes: int, folder: Path) -> list[float]:
    """The scores of the gate's runs, which are of `frame`, seed by seed."""
    table = tables.read("study2_runs", folder).set_index(tables.BUDGET)["mean"]
    return [float(table.loc[(seed, "frame", episodes)]) for seed in GATE[episodes]]


def returns_of(variant: str, episodes: int, folder: Path) -> np.ndarray:
    """Returns (seeds, tracks) of the runs of a variant."""
    table = tables.returns_of_runs("study2", STUDIES["study1"].tracks, folder)
    return np.array([table.loc[(seed, variant, episodes)] for seed in SEEDS])
