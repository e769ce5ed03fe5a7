"""The statistics of pages and notebooks, computed from the tables and written to claims.json.

`python -m stad_study claims` renews that file after a run was added. Scores are returns of
CarRacing; intervals are [low, high], of 95%.
"""

import json
from pathlib import Path

import numpy as np
import pandas

from stad_lab.agent import PRETRAINED
from stad_lab.evaluation import statistics
from stad_lab.io.files import load_json, write_bytes
from stad_lab.training.record import total_budget
from stad_study import (
    measurements,
    study2_claims,
    study4_claims,
    study5_claims,
    study6_claims,
    study_claims,
    tables,
)
from stad_study.experiments import BASELINE_DRIVERS, EXPERIMENTS

CLAIMS = tables.DATA / "claims.json"
PAPER = {"frame": 827.0, "input": 905.0, "output": 906.0, "input_output": 902.0}  # on CarRacing-v0
PAPER_GAINS = {variant: PAPER[variant] - PAPER["frame"] for variant in list(PAPER)[1:]}


def compute_claims() -> dict[str, dict]:
    """All statistics as plain numbers: section -> name -> statistics."""
    episodes, runs = tables.episodes(), tables.read("runs")
    made = [name for name in (*BASELINE_DRIVERS, *EXPERIMENTS) if name in set(episodes.experiment)]
    return {
        "study1": study_claims.describe_study1(),
        "study2": study2_claims.describe_study2(),
        "study3": study_claims.describe_study3(),
        "study4": study4_claims.describe_study4(),
        "study5": study5_claims.describe_study5(),
        "study6": study6_claims.describe_study6(),
        "studies1_and_6": study6_claims.compare_with_study1(),
        "agents": describe_agents(),
        "experiments": {name: describe_experiment(name, episodes, runs) for name in made},
        "probe": measurements.describe_probe(tables.read("probe")),
        "models": measurements.describe_models(tables.read("model_metrics")),
        "speed": measurements.describe_speed(tables.read("speed")),
    }


def describe_experiment(name: str, episodes: pandas.DataFrame, runs: pandas.DataFrame) -> dict:
    """Scores, and the budget of one seed with all that was driven before it."""
    returns = tables.returns_of(episodes[episodes.experiment == name])[name]
    run = runs[(runs.experiment == name) & (runs.role == "run")]
    planned = EXPERIMENTS.get(name)
    return {
        "about": planned.about if planned else BASELINE_DRIVERS[name],
        "world_models": len(run[["vae", "mdn_rnn"]].dropna().drop_duplicates()),
        "mean": float(returns.mean()),
        "best_episode": float(returns.max()),
        "below_800": float((returns < statistics.FAILED).mean()),
        "above_900": float((returns > statistics.SOLVED).mean()),
        "runs": returns.mean(axis=1).tolist(),
        **{unit: float(run[f"total.{unit}"].mean()) for unit in tables.UNITS},
    }


def describe_agents() -> dict:
    """The shipped agents on the tracks 0 to 99, with Gymnasium's renderer."""
    found = {}
    for path in sorted(PRETRAINED.glob("*/evaluation.json")):
        record, evaluation = load_json(path.with_name("record.json")), load_json(path)
        returns = np.array([episode["return"] for episode in evaluation["episodes"]])
        found[path.parent.name] = {
            **statistics.summarise(returns),
            **statistics.describe_tail(returns),
            "gymnasium": record["made_with"]["gymnasium"],
            **total_budget(record),
        }
    return found


def write_claims(path: Path = CLAIMS) -> Path:
    """Compute all statistics and write them, a line for each name; returns the file."""
    sections = []
    for section, entries in compute_claims().items():
        lines = [f"  {json.dumps(name)}: {json.dumps(entry)}" for name, entry in entries.items()]
        sections.append(f" {json.dumps(section)}: {{\n" + ",\n".join(lines) + "\n }")
    write_bytes(path, ("{\n" + ",\n".join(sections) + "\n}\n").encode())
    return path


def read_claims(path: Path = CLAIMS) -> dict:
    """What `write_claims` wrote."""
    return json.loads(path.read_text(encoding="utf-8"))
