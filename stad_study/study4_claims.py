"""The outcome of study 4 that docs/protocol.md fixes: one agent of each variant, no inference.

It is reported once all runs, and the agents shipped before, are in the tables.
"""

from pathlib import Path

import numpy as np
import pandas

from stad_lab.config import VARIANTS
from stad_lab.evaluation.statistics import FAILED
from stad_study import tables
from stad_study.study4 import FAILURES, SHIPPED, TRACKS, find_runs

SHARP = 90.0  # degrees within 20 tiles, from which on a bend is a sharp one
GOAL = 930.0  # points in the mean, and no return below FAILED


def describe_study4(folder: Path = tables.DATA) -> dict:
    """Progress; and after the last run "agents": variant -> its agent with the best validation.

    Then also "places": variant -> where that agent fails; "shipped": the means of the four agents
    that were shipped before; and "replaced": whether these score less.
    ValueError if a run has no return of each track.
    """
    runs = tables.read_or_empty("study4_runs", folder).set_index(tables.AGENT)
    found: dict = {"runs": len(runs), "planned": len(find_runs())}
    shipped = tables.read_or_empty(SHIPPED, folder).set_index("variant")
    if found["runs"] < found["planned"] or len(shipped) < len(VARIANTS):
        return found
    returns = tables.returns_of_runs("study4", TRACKS, folder)
    found["agents"] = {}
    for variant, own in runs.groupby(level="variant", sort=False):
        chosen = own["validation"].idxmax()
        found["agents"][variant] = describe_agent(returns.loc[chosen].to_numpy()) | {
            "seed": int(chosen[0]),
            "scores": own.sort_index()["mean"].tolist(),
        }
    found["shipped"] = shipped[[str(track) for track in TRACKS]].mean(axis=1).to_dict()
    found["places"] = describe_places(found["agents"], tables.read_or_empty(FAILURES, folder))
    means = [one["mean"] for one in found["agents"].values()]
    found["replaced"] = bool(np.mean(means) > np.mean(list(found["shipped"].values())))
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


def describe_places(agents: dict[str, dict], listed: pandas.DataFrame) -> dict[str, dict]:
    """Variant -> where its chosen agent fails, of those that do; empty until all are listed."""
    places = {}
    for variant, agent in agents.items():
        own = listed[(listed["variant"] == variant) & (listed["seed"] == agent["seed"])]
        if len(own) != agent["failures"]:
            return {}
        if len(own):
            places[variant] = describe_place(own)
    return places


def describe_place(failures: pandas.DataFrame) -> dict:
    """How many failures, how many at a sharp bend, the median speed there, and what followed."""
    return {
        "failures": len(failures),
        "at a sharp bend": int((failures["bend"].abs() >= SHARP).sum()),
        "speed": float(failures["speed"].median()),
        "then": failures["then"].value_counts().to_dict(),
    }
