"""The table of the replication: what the records of its rows say, and how sure that is.

The records that we report lie in `stad_lab/records/table`, a folder for each row as `stad_lab.replication.run` has it.
"""

import itertools
from collections import Counter
from pathlib import Path

import numpy as np

from stad_lab.evaluation.evaluate import (
    RESAMPLES,
    SOLVED,
    bootstrap,
    draw_tracks,
    middle_95,
    resampled_means,
    summarise,
)
from stad_lab.io.files import load_json
from stad_lab.replication.experiments import FLOORS, ROWS
from stad_lab.training.evolution import LOG
from stad_lab.training.pipeline import total_budget

RECORDS = Path(__file__).parents[1] / "records" / "table"
# World Models' own log, in generations of 64 agents with 16 episodes each: episodes -> score.
WORLD_MODELS = {
    25 * 64 * 16: 823.0,
    50 * 64 * 16: 867.0,
    200 * 64 * 16: 880.0,
    1800 * 64 * 16: 900.5,
}
PAPER = {
    "frame": 827.0,
    "input": 905.0,
    "output": 906.0,
    "input_output": 902.0,
}  # its table, on CarRacing-v0
OTHERS = {  # the rest of that table
    "Task-aware AE": 200.0,
    "DQN": 343.0,
    "DDPG": 100.0,
    "A3C, continuous": 591.0,
    "A3C, discrete": 652.0,
    "OpenAI": 838.0,
    "World Models": 906.0,
}
RECIPES = {  # rows RECIPE_VARIANT, and what the picture of the replication calls them
    "paper": "the paper's recipe here, v3",
    "two_rounds": "our recipe, v3",
    "finished": "ours, finished",
}
PAPER_BEST = {"best agent": 929.82, "best generation": 911.73}  # the highest points of its figures
TOP = 90  # the paper also quotes the mean of the best 90 of its 100 episodes


def kept_rows(records: Path = RECORDS) -> dict[str, list[Path]]:
    """The rows that have been made: name -> folders of its finished seeds, in the order of FLOORS and ROWS."""
    found = {
        name: [seed for seed in seed_folders(records / name) if (seed / "evaluation.json").exists()]
        for name in [*FLOORS, *ROWS]
    }
    return {name: folders for name, folders in found.items() if folders}


def seed_folders(row: Path) -> list[Path]:
    """The folders `seed0`, `seed1` and so on of a row; not a `seed0_old` beside them, which would count twice."""
    return sorted(path for path in row.glob("seed*") if path.name.removeprefix("seed").isdecimal())


def describe_table(rows: dict[str, list[Path]]) -> str:
    """The table of the replication, in Markdown: a line for each of the rows of `kept_rows`."""
    lines = [
        "| row | seeds | V, M | mean of 100 tracks | 95% interval | above 900 | agents | episodes | frames |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for name, folders in rows.items():
        found, planned = summarise_row(folders), len(ROWS[name].seeds) if name in ROWS else 1
        seeds = f"{len(folders)} of {planned}" if len(folders) < planned else f"{len(folders)}"
        low, high = found["interval"]
        lines.append(
            f"| `{name}` | {seeds} | {found['worlds']} | {found['mean']:.1f} | {low:.1f} to {high:.1f}"
            f" | {found['above_900']:.0%} | {found['agents']:,.0f} | {found['episodes']:,.0f}"
            f" | {found['frames'] / 1e6:.2f} M |"
        )
    return "\n".join(lines)


def claims_and_outcomes(
    rows: dict[str, list[Path]],
) -> dict[str, dict[str, tuple[float, list[float], list[float]]]]:
    """What the paper reports of each variant, and what came out here.

    Returns:
        variant -> "the paper, v0" or a name of RECIPES -> (mean return, its 95% interval, the mean of each search), for
        the rows that are made. The paper gives neither interval nor searches.
    """
    scores = {
        variant: {"the paper, v0": (claim, [claim, claim], [])} for variant, claim in PAPER.items()
    }
    for variant, (recipe, told) in itertools.product(PAPER, RECIPES.items()):
        if f"{recipe}_{variant}" in rows:
            returns = official_returns(rows[f"{recipe}_{variant}"])
            scores[variant][told] = (
                float(returns.mean()),
                bootstrap(returns),
                returns.mean(axis=1).tolist(),
            )
    return scores


def stage_times(row: Path) -> dict[str, float]:
    """How long the stages of a row took, from nothing to the evaluated agent of seed 0, in seconds.

    Args:
        row: folder of a row that has a world of its own. The stages of a first round count too.

    Returns:
        "rollouts", "autoencoder", "mdn_rnn", "controller" and "evaluation" -> seconds.
    """
    times: Counter[str] = Counter()
    for part in ("first", "world", "seed0") if (row / "first").exists() else ("world", "seed0"):
        times.update(load_json(row / part / "record.json")["seconds"])
    return dict(times) | {"evaluation": load_json(row / "seed0" / "evaluation.json")["seconds"]}


def lost_points(folders: list[Path]) -> dict[str, float]:
    """Where the points up to 1,000 went, mean of all episodes: 1,000 less the sum of the parts is the mean return.

    Returns:
        "speed": 0.1 for each frame of a lap, had every episode been a complete lap at the mean time of those that were.
        "waiting": 0.1 for each frame more. A lap ends when all tiles are visited, so that one missed tile prolongs the
        episode to its last frame; only leaving the field shortens it. "tiles": those not visited, and the 100 points
        for leaving the field.
    """
    episodes = [
        episode
        for folder in folders
        for episode in load_json(folder / "evaluation.json")["episodes"]
    ]
    returns, frames = (
        np.array([episode[name] for episode in episodes]) for name in ("return", "frames")
    )
    laps = frames[
        returns >= SOLVED
    ]  # 1,000 frames at most, so 900 points at least; and with a tile missing, fewer
    speed = laps.mean() if len(laps) else frames.mean()
    return {
        "speed": float(0.1 * speed),
        "waiting": float(0.1 * (frames.mean() - speed)),
        "tiles": float((1000 - returns - 0.1 * frames).mean()),
    }


def learning_curve(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """The scores on the validation tracks of one seed, and how many episodes had been driven for each: two (looks,).

    All episodes count: the random driver's, those of a first round and of its agent, and the validation itself.
    """
    log, record = load_json(folder / LOG)["generations"], load_json(folder / "record.json")
    own = sum(record["budget"][part]["episodes"] for part in ("evolution", "validation"))
    driven, episodes, scores = total_budget(record)["episodes"] - own, [], []
    for entry in log:
        driven += sum(len(returns) for returns in entry["returns"])
        if "validation" in entry:
            driven += len(entry["validation"]["returns"])
            episodes.append(driven)
            scores.append(entry["validation"]["mean"])
    return np.array(episodes), np.array(scores)


def summarise_row(folders: list[Path]) -> dict:
    """What the table shows of a row, from the folders of its seeds.

    Returns:
        "mean", "standard_deviation" (over all episodes), "interval" (95%, of the mean, over seeds and tracks), "seeds"
        (the mean of each), "worlds" (how many trainings of V and M are behind them), "above_900" (share of episodes),
        "top_90" (mean of each seed's best 90 episodes), and the budget of one seed: "agents", "episodes", "frames"
        (means over the seeds), with all that was driven before it.
    """
    returns = official_returns(folders)
    budgets = [total_budget(load_json(folder / "record.json")) for folder in folders]
    return {
        **summarise(returns),
        "seeds": returns.mean(axis=1).tolist(),
        "worlds": len(worlds(folders)),
        "top_90": float(np.sort(returns, axis=1)[:, -TOP:].mean()),
        **{
            unit: float(np.mean([spent[unit] for spent in budgets]))
            for unit in ("agents", "episodes", "frames")
        },
    }


def worlds(folders: list[Path]) -> set[tuple[str, str]]:
    """The identities of the V's and M's that the searches in some folders had; none of a driver of FLOORS."""
    logs = [load_json(folder / LOG) for folder in folders if (folder / LOG).exists()]
    return {(log["autoencoder"], log["mdn_rnn"]) for log in logs}


def official_returns(folders: list[Path]) -> np.ndarray:
    """The returns of a row's seeds on the official tracks, float64 (seeds, tracks), from their folders."""
    evaluations = [load_json(folder / "evaluation.json", "evaluate again") for folder in folders]
    return np.array([[episode["return"] for episode in found["episodes"]] for found in evaluations])


def bootstrap_gain(
    before: np.ndarray, after: np.ndarray, resamples: int = RESAMPLES
) -> list[float]:
    """95% interval of the mean of `after` less the mean of `before`, both returns (seeds, tracks) on the same tracks.

    Seeds are drawn anew for each of the two, tracks once for both: a long track costs both of them time. Of a row with
    one seed the luck of its search is left out, so that the interval is too narrow.
    """
    rng, tracks = draw_tracks(before, resamples)
    gains = resampled_means(after, rng, tracks) - resampled_means(before, rng, tracks)
    return middle_95(gains)
