"""The outcome of study 4 that docs/protocol.md fixes: one agent of each variant, no inference.

It is reported once all runs are in the tables.
"""

from pathlib import Path

import numpy as np

from stad_lab.evaluation.statistics import FAILED
from stad_study import tables
from stad_study.study4 import TRACKS, find_runs

GOAL = 930.0  # points in the mean, and no return below FAILED


def describe_study4(folder: Path = tables.DATA) -> dict:
    """Progress; and after the last run "agents": variant -> its agent with the best validation.

    ValueError if a run has no return of each track.
    """
    runs = tables.read_or_empty("study4_runs", folder).set_index(tables.AGENT)
    found: dict = {"runs": len(runs), "planned": len(find_runs())}
    if found["runs"] < found["planned"]:
        return found
    returns = tables.returns_of_runs("study4", TRACKS, folder)
    found["agents"] = {}
    for variant, own in runs.groupby(level="variant", sort=False):
        chosen = own["validation"].idxmax()
        found["agents"][variant] = describe_agent(returns.loc[chosen].to_numpy()) | {
            "seed": int(chosen[0]),
            "scores": own.sort_index()["mean"].tolist(),
        }
    return found


def describe_agent(returns: np.ndarray) -> dict:
    """Mean, minimum, failures and whether the goal is reached, from returns (tracks,)."""
    mean, lowest = float(returns.mean()), float(returns.min())
    return {
        "mean": mean,
        "minimum": lowest,
        "failures": int((returns < FAILED).sum()),
        "reached": mean >= GOAL and lowest >= FAILED,
    }
