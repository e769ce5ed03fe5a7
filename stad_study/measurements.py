"""What pages and notebooks show beside mean scores: lost points, the probe, V and M, speeds.

Each function gives nested dicts of plain numbers.
"""

from collections import defaultdict

import numpy as np
import pandas

from stad_lab.evaluation.statistics import SOLVED
from stad_study.tables import key

# Conditions of `speed` with which the others of their measure are compared.
REFERENCES = ("Gymnasium", "V + M + C, 1 thread", "stad_lab")


def describe_probe(probe: pandas.DataFrame) -> dict:
    """R2 by "DRIVER: WORLD_MODEL-SEED", features and quantity."""
    found: dict = defaultdict(lambda: defaultdict(dict))
    for one in probe.itertuples():
        name = f"{one.driver}: {key(one.world_model, one.seed)}"
        found[name][one.features][one.quantity] = one.r2
    return found


def describe_models(metrics: pandas.DataFrame) -> dict:
    """Values by "MODEL: WORLD_MODEL" and metric, and by index where a metric has several."""
    found: dict = defaultdict(dict)
    for (model, world_model, metric), own in metrics.groupby(["model", "world_model", "metric"]):
        values = dict(zip(own["index"], own["value"].tolist(), strict=True))
        found[f"{model}: {world_model}"][metric] = values.get("all", values)
    return found


def describe_speed(speed: pandas.DataFrame) -> dict:
    """By "PART: MEASURE" and condition "median" over the rounds and "ratio" to the reference.

    Where a measure has no reference, the median alone.
    """
    found = {}
    for (part, measure), own in speed.groupby(["part", "measure"]):
        medians = own.groupby("condition")["value"].median().to_dict()
        unit = next((medians[name] for name in REFERENCES if name in medians), None)
        if unit:
            medians = {name: {"median": m, "ratio": m / unit} for name, m in medians.items()}
        found[f"{part}: {measure}"] = medians
    return found


def lost_points(returns: np.ndarray, frames: np.ndarray) -> dict:
    """Where the points up to 1,000 were lost, means over episodes; the parts sum to 1000 - mean.

    "speed": 0.1 for each frame of a mean complete lap; "waiting": 0.1 for each further frame, due
    to a missed tile; "tiles": those not visited, and 100 points for leaving the field.
    """
    laps = frames[returns >= SOLVED]  # a lap of 1,000 frames has 900 points
    speed = laps.mean() if len(laps) else frames.mean()
    return {
        "speed": float(0.1 * speed),
        "waiting": float(0.1 * (frames.mean() - speed)),
        "tiles": float((1000 - returns - 0.1 * frames).mean()),
    }
