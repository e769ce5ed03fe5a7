"""The test of study 6 that docs/protocol.md fixes: is the faster recipe not worse?

It is computed once all pairs are in the tables.
"""

from pathlib import Path

import numpy as np
import pandas

from stad_lab.evaluation.statistics import mean_interval
from stad_lab.training.pipeline import STAGES
from stad_study import tables
from stad_study.study import STUDIES, check_settings
from stad_study.study_claims import MARGIN, compare_arms, describe_progress, returns_of_study

RECIPES = "study6_laptop", "study6_fast"


def describe_study6(folder: Path = tables.DATA) -> dict:
    """Progress by recipe; and after the last pipeline scores, difference, standard deviation, bound
    and "not_worse".

    "lower_bound_of_seeds" takes the mean of both variants of a seed as one value; it is described.
    ValueError if a run has other settings than its recipe, or a pair two datasets.
    """
    runs = tables.read_study("runs", folder)
    for name in RECIPES:
        check_settings(name, runs)
    check_datasets(runs[runs["study"].isin(RECIPES)])
    progress = {
        name: describe_progress(STUDIES[name], runs[runs["study"] == name]) for name in RECIPES
    }
    found: dict = {
        "pipelines": {name: one["pipelines"] for name, one in progress.items()},
        "planned": {name: one["planned_pipelines"] for name, one in progress.items()},
    }
    if found["pipelines"] != found["planned"]:
        return found
    scores = {name: scores_of(name, folder) for name in RECIPES}
    differences = scores["study6_fast"] - scores["study6_laptop"]
    bound, _ = mean_interval(differences, outside=0.1)  # one-sided: 5% lie below
    by_seed = differences.reshape(len(STUDIES[RECIPES[0]].variants), -1).mean(axis=0)
    return found | {
        "scores": {name: own.tolist() for name, own in scores.items()},
        "difference": float(differences.mean()),
        "deviation": float(differences.std(ddof=1)),
        "lower_bound": bound,
        "lower_bound_of_seeds": mean_interval(by_seed, outside=0.1)[0],
        "not_worse": bound > -MARGIN,
        "minutes": {name: minutes_of(runs[runs["study"] == name]) for name in RECIPES},
    }


def compare_with_study1(folder: Path = tables.DATA) -> dict:
    """`input_output` against `frame` over the seeds of study 1 and of `laptop`: one recipe.

    C sees z and h. The protocol does not have it.
    """
    both = [returns_of_study(name, folder) for name in ("study1", RECIPES[0])]
    arms = ("z, h: frame", "z, h: input_output")
    return compare_arms(*(np.concatenate([returns[arm] for returns in both]) for arm in arms))


def minutes_of(runs: pandas.DataFrame) -> float:
    """The median of the minutes from an empty folder to C."""
    stages = [f"seconds.{stage}" for stage in STAGES]
    return float(runs[stages].sum(axis=1).median() / 60)


def check_datasets(runs: pandas.DataFrame) -> None:
    """ValueError if the runs of a seed saw more than one dataset."""
    seen = runs.groupby("seed")["dataset"].nunique()
    if (seen > 1).any():
        raise ValueError(f"seed {seen.idxmax()} of study 6 has {seen.max()} datasets: run it again")


def scores_of(study: str, folder: Path) -> np.ndarray:
    """The mean return of each pipeline, variant by variant, float64 (pairs,)."""
    arms = returns_of_study(study, folder)
    return np.concatenate([returns.mean(axis=1) for returns in arms.values()])
