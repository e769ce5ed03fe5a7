"""Every statistic that a page shows, computed from the tables and written to one file.

`python -m stad_lab claims` renews `data/claims.json` after a run was added; pages and figures take
their numbers from it. Points are returns of CarRacing; an interval is [low, high], of 95%.
"""

import json
from pathlib import Path

import numpy as np
import pandas

from stad_lab.config import VARIANTS
from stad_lab.evaluation.statistics import (
    SOLVED,
    bootstrap,
    bootstrap_difference,
    describe_tail,
    lost_points,
    pooled_interval,
    summarise,
    welch_p,
)
from stad_lab.replication import tables
from stad_lab.replication.experiments import BASELINE_DRIVERS, CHANGES, EXPERIMENTS, RECIPES

CLAIMS = tables.DATA / "claims.json"
PRETRAINED = Path(__file__).parent.parent / "pretrained"
PAPER = {"frame": 827.0, "input": 905.0, "output": 906.0, "input_output": 902.0}  # on CarRacing-v0
PAPER_OTHERS = {  # the rest of the paper's table
    "Task-aware AE": 200.0,
    "DQN": 343.0,
    "DDPG": 100.0,
    "A3C, continuous": 591.0,
    "A3C, discrete": 652.0,
    "OpenAI": 838.0,
    "World Models": 906.0,
}
PAPER_BEST = {"agent": 929.82, "generation": 911.73}  # the highest points of its figures
WORLD_MODELS = {25600: 823.0, 51200: 867.0, 204800: 880.0, 1843200: 900.5}  # its log, by episodes
COMPARED = ("paper", "two_iterations", "fine_tuned", "no_bar")  # recipes with several runs
BASELINE_PASSES = 780  # points of `frame` from which a recipe can test the claim (see PROTOCOL)
BEST = 90  # the paper also quotes the mean of the best 90 of its 100 episodes
REFERENCES = {  # condition of `speed` to which the others of its measure are compared
    "Gymnasium",
    "Gymnasium alone, no agent, 2 processes",
    "1 car",
    "plain",
    "own processes, 1",
}


def compute_claims() -> dict:
    """All statistics, as nested dicts of plain numbers: section -> name -> statistics."""
    episodes, runs, generations = tables.episodes(), tables.read("runs"), tables.read("generations")
    returns = tables.returns_of(episodes)
    recipes = {name: compare_recipe(returns, name) for name in COMPARED}
    probe = tables.read("probe")
    yaw_rate = yaw_rate_of_z(probe)
    return {
        "verdict": find_verdict(recipes, float(episodes["return"].max()), yaw_rate),
        "paper": {"table": PAPER, "others": PAPER_OTHERS, "best": PAPER_BEST},
        "world_models": {f"{count}_episodes": score for count, score in WORLD_MODELS.items()},
        "agents": describe_agents(),
        "recipes": recipes,
        "experiments": {
            name: describe_experiment(name, episodes, runs) for name in order(returns)
        },
        "changes": compare_changes(returns),
        "fine_tuning": {variant: compare_fine_tuning(returns, variant) for variant in VARIANTS},
        "paper_runs": describe_paper_runs(returns, runs, generations),
        "final_sigma": final_sigma(generations),
        "fast_renderer": describe_fast(tables.read("fast_episodes")),
        "yaw_rate_of_z": yaw_rate,
        "probe": describe_probe(probe),
        "models": describe_models(tables.read("model_metrics")),
        "stage_minutes": {name: stage_minutes(runs, name) for name in order(returns, runs)},
        "speed": describe_speed(tables.read("speed")),
    }


def order(returns: dict, runs: pandas.DataFrame | None = None) -> list[str]:
    """Names of the experiments that were run, in their order; with `runs`, those with V and M."""
    made = [name for name in (*BASELINE_DRIVERS, *EXPERIMENTS) if name in returns]
    if runs is None:
        return made
    return [name for name in made if ((runs.experiment == name) & (runs.role == "world_model")).any()]


def describe_experiment(name: str, episodes: pandas.DataFrame, runs: pandas.DataFrame) -> dict:
    """Scores, failures and the budget of one seed, with all that was driven before it."""
    own = episodes[episodes.experiment == name]
    returns = tables.returns_of(own)[name]
    run = runs[(runs.experiment == name) & (runs.role == "run")]
    experiment = EXPERIMENTS.get(name)
    return {
        "about": experiment.about if experiment else BASELINE_DRIVERS[name],
        "variant": experiment.variant if experiment else None,
        "seeds": len(returns),
        "planned_seeds": len(experiment.seeds) if experiment else 1,
        "world_models": len(run[["vae", "mdn_rnn"]].dropna().drop_duplicates()),
        **summarise(returns),
        **describe_tail(returns),
        "failed": int((returns < 800).sum()),
        "best_90": float(np.sort(returns, axis=1)[:, -BEST:].mean()),
        "runs": returns.mean(axis=1).tolist(),
        **{unit: float(run[f"total.{unit}"].mean()) for unit in tables.UNITS},
        "lost": lost_points(own["return"].to_numpy(), own["frames"].to_numpy()),
    }


def compare_recipe(returns: dict[str, np.ndarray], recipe: str) -> dict:
    """The four variants of a recipe, and the difference of three of them to `frame`.

    "bootstrap_interval" resamples seeds and tracks; "interval" is Student's t of the run means with
    the variance pooled over all four variants.
    """
    found = {variant: returns[f"{recipe}_{variant}"] for variant in VARIANTS}
    means = [scores.mean(axis=1) for scores in found.values()]
    frame = found["frame"]
    return {"about": RECIPES[recipe]} | {
        variant: {"mean": float(scores.mean()), "runs": runs.tolist()}
        | {"bootstrap_interval_of_mean": bootstrap(scores)}
        | (
            {
                "difference": float(scores.mean() - frame.mean()),
                "interval": pooled_interval(means, 0, place),
                "bootstrap_interval": bootstrap_difference(frame, scores),
                "welch_p": welch_p(means[0], runs),
                "difference_by_seed": (runs - means[0]).tolist(),
            }
            if variant != "frame"
            else {}
        )
        for place, ((variant, scores), runs) in enumerate(zip(found.items(), means, strict=True))
    }


def find_verdict(recipes: dict, best_episode: float, yaw_rate: dict) -> dict:
    """Whether `input_output` beats `frame` as the paper says, with the reasons.

    A recipe tests the claim if `frame` reaches BASELINE_PASSES and leaves room below our best
    episode for the paper's gain. It supports the claim if the interval of the difference is above
    0, contradicts it if the interval is below the paper's gain, and else leaves it open.
    """
    gain, reasons, outcomes = PAPER["input_output"] - PAPER["frame"], {}, set()
    for name, recipe in recipes.items():
        frame, (low, high) = recipe["frame"]["mean"], recipe["input_output"]["interval"]
        room = best_episode - frame
        passes, has_room = frame >= BASELINE_PASSES, room >= gain
        outcome = "supported" if low > 0 else "contradicted" if high < gain else "open"
        reasons[name] = {
            "frame": frame,
            "paper_frame": PAPER["frame"],
            "baseline_passes": passes,
            "room": room,
            "has_room": has_room,
            "difference": recipe["input_output"]["difference"],
            "interval": [low, high],
            "outcome": outcome if passes and has_room else "cannot test",
        }
        outcomes.add(reasons[name]["outcome"])
    outcomes.discard("cannot test")
    word = outcomes.pop() if len(outcomes) == 1 else "open"
    return {
        "word": word,
        "claimed_gain": gain,
        "best_episode": best_episode,
        **reasons,
        "yaw_rate_in_latents": yaw_rate["input_output"]["lowest"] > yaw_rate["others"]["highest"],
    }


def describe_agents(folder: Path = PRETRAINED) -> dict:
    """The shipped agents on the tracks 0 to 99, with Gymnasium's renderer."""
    found = {}
    for path in sorted(folder.glob("*/evaluation.json")):
        record, episodes = (tables.load(path.parent / "record.json"), tables.load(path)["episodes"])
        returns = np.array([episode["return"] for episode in episodes])
        ordered = np.sort(returns)
        found[path.parent.name] = {
            **summarise(returns),
            **describe_tail(returns),
            "failed": int((returns < 800).sum()),
            "without_worst_5": float(ordered[5:].mean()),
            "without_best_5": float(ordered[:-5].mean()),
            "gymnasium": record["made_with"]["gymnasium"],
            **tables.total_budget(record),
        }
    return found


def compare_changes(returns: dict[str, np.ndarray]) -> dict:
    """The difference of single changes of the recipe to what they change, mostly one run each.

    The interval holds the variance between tracks, not that between single runs.
    """
    bases = {name: shared or "one_iteration" for name, (_, _, shared) in CHANGES.items()}
    bases |= {name: "one_iteration" for name in ("no_bar_input", "two_iterations_input", "no_replay")}
    return {
        name: {
            "about": EXPERIMENTS[name].about,
            "base": base,
            "difference": float(returns[name].mean() - returns[base].mean()),
            "interval": bootstrap_difference(returns[base], returns[name]),
            "difference_of_medians": float(np.median(returns[name]) - np.median(returns[base])),
            "complete_laps": float((returns[name] >= SOLVED).mean()),
        }
        for name, base in bases.items()
        if name in returns
    }


def compare_fine_tuning(returns: dict[str, np.ndarray], variant: str) -> dict:
    """What fine-tuning gained, run by run on the same tracks."""
    before, after = (returns[f"{recipe}_{variant}"] for recipe in ("two_iterations", "fine_tuned"))
    return {
        "gain": float((after - before).mean()),
        "interval": bootstrap(after - before),
        "failed_before": (before < 800).sum(axis=1).tolist(),
        "failed_after": (after < 800).sum(axis=1).tolist(),
    }


def describe_paper_runs(returns: dict, runs: pandas.DataFrame, generations: pandas.DataFrame) -> dict:
    """Each run of the paper's recipe; `vae` tells which V it had."""
    found = {}
    for variant in VARIANTS:
        name = f"paper_{variant}"
        for seed, scores in enumerate(returns[name]):
            run = runs[(runs.experiment == name) & (runs.role == "run") & (runs.seed == seed)].iloc[0]
            validations = learning_curve(runs, generations, name, seed)[1]
            found[tables.key(name, seed)] = {
                "vae": run["vae"][:4],
                "mean": float(scores.mean()),
                "complete_laps": int((scores >= SOLVED).sum()),
                "failed": int((scores < 800).sum()),
                "last_5_validations": float(validations[-5:].mean()),
            }
    return found


def learning_curve(
    runs: pandas.DataFrame, generations: pandas.DataFrame, experiment: str, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Episodes driven so far, and score, at each validation of a run: two arrays (validations,).

    All episodes count: the dataset, the first iteration, and the validations.
    """
    same = {"experiment": experiment, "role": "run", "seed": seed}
    run, log = (t[(t[list(same)] == list(same.values())).all(axis=1)] for t in (runs, generations))
    run, evolution = run.iloc[0], "config.evolution."
    validated = log["validation"].notna()
    before = run["total.episodes"] - run["budget.evolution.episodes"]
    before -= run["budget.validation.episodes"]
    each = run[f"{evolution}population"] * run[f"{evolution}tracks"]
    episodes = before + each * log["generation"]
    episodes += run[f"{evolution}validation_tracks"] * validated.cumsum()
    return episodes[validated].to_numpy(np.int64), log["validation"][validated].to_numpy()


def final_sigma(generations: pandas.DataFrame) -> dict:
    """CMA-ES's step size at the end of each run of the paper's recipe, and the geometric mean."""
    paper = generations[generations.experiment.str.startswith("paper_")]
    last = paper.groupby(["experiment", "seed"])["sigma"].last()
    each = {tables.key(*run): float(sigma) for run, sigma in last.items()}
    return {"geometric_mean": float(np.exp(np.log(last).mean())), **each}


def describe_fast(episodes: pandas.DataFrame) -> dict:
    """Agents with the fast renderer on tracks 0 to 199; two processors drive the shipped ones."""
    found = {}
    for (agent, processor), own in episodes.groupby(["agent", "processor"]):
        scores = own["return"]
        found.setdefault(agent, {})[processor] = {"mean": float(scores.mean())} | {
            "failed": int((scores < 800).sum())
        }
    wide = episodes.pivot(index=["agent", "track"], columns="processor", values="return").dropna()
    one, other = wide.to_numpy().T
    return found | {"equal_returns": int((one == other).sum()), "compared_episodes": len(wide)}


def yaw_rate_of_z(probe: pandas.DataFrame) -> dict:
    """R2 of the yaw rate from z under the agent, of every V that is trained without the bar."""
    kept = probe[(probe.driver == "agent") & (probe.features == "z") & probe.trained]
    kept = kept[(kept.quantity == "yaw rate") & ~kept.indicator_bar]
    kept = kept[~kept.world_model.str.startswith("shorter_")]
    groups = {variant: kept[kept.variant == variant] for variant in VARIANTS}
    groups["others"] = kept[kept.variant != "input_output"]
    return {
        name: {"trainings": len(own), "lowest": float(own.r2.min()), "highest": float(own.r2.max())}
        | {"values": sorted(own.r2.tolist())}
        for name, own in groups.items()
    }


def describe_probe(probe: pandas.DataFrame) -> dict:
    """R2 by driver, world model (and its seed), features and quantity."""
    found = {}
    for line in probe.itertuples():
        name = f"{line.driver}: {tables.key(line.world_model, line.seed)}"
        found.setdefault(name, {}).setdefault(line.features, {})[line.quantity] = line.r2
    return found


def describe_models(metrics: pandas.DataFrame) -> dict:
    """Quality of V and M by model and world model: metric, or metric and index -> value."""
    found = {}
    for (model, world_model, metric), own in metrics.groupby(["model", "world_model", "metric"]):
        values = dict(zip(own["index"], own["value"].tolist(), strict=True))
        name = f"{model}: {world_model}"
        found.setdefault(name, {})[metric] = values.get("all", values)
    return found


def stage_minutes(runs: pandas.DataFrame, name: str) -> dict:
    """Minutes of each stage, from an empty folder to the evaluated agent of seed 0."""
    own = runs[(runs.experiment == name) & (runs.seed == 0)].filter(like="seconds.")
    stages = {column.removeprefix("seconds."): own[column].sum() / 60 for column in own}
    return {stage: float(minutes) for stage, minutes in stages.items()} | {
        "all": float(sum(stages.values()))
    }


def describe_speed(speed: pandas.DataFrame) -> dict:
    """Median over the rounds, and its ratio to the reference condition of the same measure."""
    found = {}
    for (part, measure), own in speed.groupby(["part", "measure"]):
        medians = own.groupby("condition")["value"].median()
        reference = [condition for condition in medians.index if condition in REFERENCES]
        found[f"{part}: {measure}"] = {
            condition: {"median": float(median), "ratio": float(median / medians[reference[0]])}
            if reference
            else float(median)
            for condition, median in medians.items()
        }
    return found


def write_claims(path: Path = CLAIMS) -> None:
    """Compute all statistics and write them, one line for each name in each section."""
    sections = []
    for section, entries in compute_claims().items():
        lines = [f"  {json.dumps(name)}: {json.dumps(entry)}" for name, entry in entries.items()]
        sections.append(f" {json.dumps(section)}: {{\n" + ",\n".join(lines) + "\n }")
    path.write_text("{\n" + ",\n".join(sections) + "\n}\n", encoding="utf-8")


def read_claims(path: Path = CLAIMS) -> dict:
    """What `write_claims` wrote."""
    return json.loads(path.read_text(encoding="utf-8"))


def forest(claims: dict) -> list[dict]:
    """Data of a forest plot: a line for each recipe and variant but `frame`, a dot for each run."""
    return [
        {"recipe": recipe, "variant": variant, "about": found["about"], "frame": found["frame"]["runs"]}
        | {name: found[variant][name] for name in ("runs", "difference", "interval", "welch_p")}
        for recipe, found in claims["recipes"].items()
        for variant in VARIANTS
        if variant != "frame"
    ]
