"""The statistics of the studies that docs/protocol.md fixes, computed from their tables.

Study 1 compares variants with `frame`, once where C sees z, and once where it sees z and h. Before
its last pipeline is in the tables, only the progress is reported: nothing is tested earlier.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pandas

from stad_lab.config import VARIANTS
from stad_lab.evaluation import statistics
from stad_lab.evaluation.trajectories import MOTION
from stad_study import tables
from stad_study.study import STUDIES, Study

FEATURES = ("z", "z, h")
FAMILIES = {"primary": ("input_output",), "secondary": ("input", "output")}
MARGIN = 30  # points of equivalence
LEVEL = 0.05  # of Holm's p


def describe_study1(folder: Path = tables.DATA) -> dict:
    """Progress; and once all seeds are complete arms, comparisons, curves, and "afterwards".

    An arm or comparison is named by features and variant: "z: input_output".
    """
    planned, runs = STUDIES["study1"], tables.read_study("runs", folder)
    found = describe_progress(planned, runs[runs["study"] == "study1"])
    if found["complete_seeds"] < found["planned_seeds"]:
        return found
    returns = returns_of_study("study1", folder)
    curves = learning_curves(folder)
    areas = {arm: area_under(*curve) for arm, curve in curves.items()}
    comparisons: dict[str, dict] = {}
    for variants in FAMILIES.values():
        comparisons |= compare_family(returns, areas, variants)
    arms = {arm: describe_arm(own, areas[arm]) for arm, own in returns.items()}
    found |= {"arms": arms, "comparisons": comparisons}
    found |= {"afterwards": compare_afterwards(returns)}
    found |= {"verdicts_without_a_seed": leave_one_out(returns)}
    found |= {"equivalence": describe_equivalence(returns), "ceiling": find_ceiling(returns)}
    return found | {"curve_differences": curve_differences(curves)}


def describe_progress(planned: Study, runs: pandas.DataFrame) -> dict:
    """How many seeds and pipelines of a study are in its table of runs, of how many.

    "trained_on" counts the V networks by the machine that trained them.
    """
    arms = len(planned.variants) * len(planned.features)
    by_seed = runs.groupby("seed").size()
    world_models = runs.drop_duplicates(["variant", "seed"])
    return {
        "complete_seeds": int((by_seed == arms).sum()),
        "planned_seeds": len(planned.seeds),
        "pipelines": len(runs),
        "planned_pipelines": arms * len(planned.seeds),
        "trained_on": world_models["world_model.trained_on"].value_counts().to_dict(),
    }


def returns_of_study(study: str, folder: Path = tables.DATA) -> dict[str, np.ndarray]:
    """Arm -> returns (seeds, tracks). ValueError unless each pipeline drove all tracks."""
    planned, table = STUDIES[study], tables.read_study("episodes", folder)
    wide = table[table["study"] == study].pivot(
        index=["features", "variant", "seed"], columns="track", values="return"
    )
    arms = [(features, variant) for features in planned.features for variant in planned.variants]
    complete = {(*arm, seed) for arm in arms for seed in planned.seeds} == set(wide.index)
    if list(wide.columns) != list(planned.tracks) or wide.isna().any(axis=None) or not complete:
        tracks = f"{planned.tracks[0]} to {planned.tracks[-1]}"
        raise ValueError(f"{study}: expected one episode of each pipeline on the tracks {tracks}")
    return {
        f"{features}: {variant}": wide.loc[features, variant].to_numpy()
        for features, variant in arms
    }


def compare_family(
    returns: dict[str, np.ndarray], areas: dict[str, np.ndarray], variants: tuple[str, ...]
) -> dict[str, dict]:
    """Variants against `frame` with both features, paired by seed; Holm's p over all of them."""
    found = {}
    for features in FEATURES:
        for variant in variants:
            arms = f"{features}: frame", f"{features}: {variant}"
            found[arms[1]] = compare_arms(*(returns[arm] for arm in arms))
            faster = areas[arms[1]] - areas[arms[0]]
            found[arms[1]]["area_difference"] = float(faster.mean())
            found[arms[1]]["area_interval"] = statistics.bootstrap(faster[:, None])
    judge(found)
    return found


def judge(comparisons: dict[str, dict]) -> None:
    """Give each comparison of a family Holm's p, a verdict, and the seeds that would decide."""
    adjusted = statistics.holm([one["p"] for one in comparisons.values()])
    for one, p in zip(comparisons.values(), adjusted, strict=True):
        one["holm_p"] = p
        one["verdict"] = find_verdict(one["interval"], p)
        deviation = float(np.std(one["by_seed"], ddof=1))
        more = len(one["by_seed"]) + 1  # reported only if undecided, so more than were run
        seeds = max(more, statistics.pairs_that_decide(deviation, MARGIN, len(comparisons)))
        one |= {"deviation": deviation, "seeds_that_decide": seeds}


def compare_arms(frame: np.ndarray, variant: np.ndarray) -> dict:
    """The difference of two arms (seeds, tracks) on the same seeds and tracks.

    "interval" is of the bootstrap, "t_interval" Student's over seeds.
    """
    differences = variant - frame
    by_seed = differences.mean(axis=1)
    return {
        "difference": float(differences.mean()),
        "interval": statistics.bootstrap(differences),
        "t_interval": statistics.mean_interval(by_seed),
        "by_seed": by_seed.tolist(),
        "p": statistics.paired_p(by_seed),
    }


def compare_afterwards(returns: dict[str, np.ndarray]) -> dict[str, dict]:
    """Comparisons that the protocol of study 1 does not have, computed after its results."""
    gain = {one: returns[f"{one}: input_output"] - returns[f"{one}: frame"] for one in FEATURES}
    found = {"interaction": compare_arms(gain["z, h"], gain["z"])}
    for features in FEATURES:
        pair = (returns[f"{features}: {variant}"] for variant in ("input", "input_output"))
        found[f"{features}: input_output less input"] = compare_arms(*pair)
    both = (
        np.mean([returns[f"{one}: {variant}"] for one in FEATURES], axis=0)
        for variant in ("input", "input_output")
    )
    return found | {"input_output less input": compare_arms(*both)}


def primary_gains(returns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Features -> the score of `input_output` less that of `frame`, by seed: (seeds,)."""
    return {
        features: (returns[f"{features}: input_output"] - returns[f"{features}: frame"]).mean(
            axis=1
        )
        for features in FEATURES
    }


def leave_one_out(returns: dict[str, np.ndarray]) -> dict[str, list[str]]:
    """Features -> the primary verdicts that all seeds but one would give, for each seed left out.

    The protocol does not have it: it shows how much a verdict depends on single seeds. Intervals
    are Student's, because the bootstrap's end close to the margin changes with the resamples.
    """
    found: dict[str, list[str]] = {features: [] for features in FEATURES}
    by_seed = primary_gains(returns)
    for seed in range(len(by_seed["z"])):
        others = [np.delete(own, seed) for own in by_seed.values()]
        adjusted = statistics.holm([statistics.paired_p(own) for own in others])
        for features, own, p in zip(FEATURES, others, adjusted, strict=True):
            found[features].append(find_verdict(statistics.mean_interval(own), p))
    return found


def describe_equivalence(returns: dict[str, np.ndarray]) -> dict[str, dict]:
    """Features -> two one-sided t-tests of `input_output` - `frame` against the margin.

    The protocol asks for a 95% interval within the margin; these tests, as is usual, for one of
    90%. "stays" counts the seeds without which they still reject.
    """
    found = {}
    for features, by_seed in primary_gains(returns).items():
        without = [np.delete(by_seed, seed) for seed in range(len(by_seed))]
        stays = sum(statistics.equivalence_p(own, MARGIN) < LEVEL for own in without)
        found[features] = {"p": statistics.equivalence_p(by_seed, MARGIN), "stays": stays}
    return found


def find_ceiling(returns: dict[str, np.ndarray]) -> float:
    """Mean over tracks of the best return that any pipeline of any arm has there.

    The protocol does not have it: it shows how much a variant could gain over `frame`.
    """
    return float(np.max([own.max(axis=0) for own in returns.values()], axis=0).mean())


def find_verdict(interval: list[float], holm_p: float) -> str:
    """The protocol's word for a difference; "gain" and "harm" come before "no relevant gain"."""
    low, high = interval
    if holm_p < LEVEL and (low > 0 or high < 0):
        return "gain" if low > 0 else "harm"
    return "no relevant gain" if low > -MARGIN and high < MARGIN else "undecided"


def describe_arm(returns: np.ndarray, areas: np.ndarray) -> dict:
    """Outcomes of an arm over all episodes of returns (seeds, tracks)."""
    tail = statistics.describe_tail(returns)
    return {
        "mean": float(returns.mean()),
        "by_seed": returns.mean(axis=1).tolist(),
        **{name: tail[name] for name in ("below_800", "tenth_percentile", "minimum")},
        "interquartile_mean": statistics.interquartile_mean(returns),
        "area": float(areas.mean()),
    }


def learning_curves(folder: Path = tables.DATA) -> dict[str, tuple]:
    """Arm of study 1 -> episodes driven so far, validation mean there: (seeds, validations) each.

    Episodes count all that a pipeline drives: dataset, candidates and validations.
    """
    table, planned = tables.read_study("generations", folder), STUDIES["study1"]
    table = table[(table["study"] == "study1") & table["validation"].notna()]
    wide = table.pivot(
        index=["features", "variant", "seed"],
        columns="generation",
        values=["episodes", "validation"],
    )
    if wide.isna().any(axis=None):
        raise ValueError("study1: expected validations of every pipeline in the same generations")
    return {
        f"{features}: {variant}": tuple(
            wide[part].loc[features, variant].to_numpy(np.float64)
            for part in ("episodes", "validation")
        )
        for features in planned.features
        for variant in planned.variants
    }


def area_under(episodes: np.ndarray, scores: np.ndarray) -> np.ndarray:
    """Mean height of each learning curve, over episodes: (seeds, validations) -> (seeds,)."""
    return np.trapezoid(scores, episodes, axis=1) / np.ptp(episodes, axis=1)


def mean_curve(scores: np.ndarray) -> dict[str, list[float]]:
    """The mean over seeds at each validation, and its 95% interval, from (seeds, validations)."""
    low, high = np.array([statistics.mean_interval(own) for own in scores.T]).T
    found = {"mean": scores.mean(axis=0), "low": low, "high": high}
    return {name: np.round(values, 1).tolist() for name, values in found.items()}


def over_episodes(episodes: np.ndarray, scores: np.ndarray) -> dict[str, list[float]]:
    """The mean curve, with the mean of the episodes driven so far: both (seeds, validations)."""
    return {"episodes": np.round(episodes.mean(axis=0), 1).tolist()} | mean_curve(scores)


def curve_differences(curves: dict[str, tuple]) -> dict[str, dict[str, list[float]]]:
    """Learning curves less that of `frame` of the same seed: as `over_episodes`, by arm."""
    found = {}
    for arm, (episodes, scores) in curves.items():
        baseline = curves[f"{arm.partition(': ')[0]}: frame"][1]
        if not arm.endswith(": frame"):
            found[arm] = over_episodes(episodes, scores - baseline)
    return found


def describe_study3(folder: Path = tables.DATA) -> dict:
    """R2 of the probe over the seeds so far: "DRIVER: VARIANT" -> features -> quantity.

    "values" has a number for each seed, and "interval" is of their mean. Untrained networks have
    names such as "frame, untrained".
    """
    table = tables.read_study("probe", folder)
    table = table[table["study"] == "study1"]
    found: dict[str, Any] = {
        "seeds": int(table["seed"].nunique()),
        "planned_seeds": len(STUDIES["study1"].seeds),
    }
    probed = table[table["trained"].astype(bool)]
    found["networks"] = len(probed[["variant", "seed"]].drop_duplicates())
    if found["seeds"] < 2:
        return found
    groups = dict(list(table.groupby(["driver", "trained", "variant"])))
    for key in sorted(groups, key=lambda key: (key[0], not key[1], VARIANTS.index(key[2]))):
        (driver, trained, variant), own = key, groups[key]
        name = f"{driver}: {variant}" + ", untrained" * (not trained)
        wide = own.pivot(index="seed", columns=["features", "quantity"], values="r2")
        found[name] = {
            features: {quantity: describe_r2(wide[features][quantity]) for quantity in MOTION}
            for features in FEATURES
        }
    return found


def describe_r2(values: pandas.Series) -> dict:
    """Mean of R2 over seeds, its 95% interval, and the value of each seed."""
    return {
        "mean": float(values.mean()),
        "interval": statistics.mean_interval(values),
        "values": values.tolist(),
    }
