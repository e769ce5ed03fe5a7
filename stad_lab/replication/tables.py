"""The measurements of the replication as tidy tables: one CSV file each, which pandas opens.

A run is named by `experiment`, `role` and `seed`. The role is "run" (CMA-ES for C, evaluated),
"first_iteration" (of a recipe with two) or "world_model" (only V and M); the last two serve the run
of the same seed and those after it, up to the next. C of each run is in `data/controllers`.
"""

import hashlib
import json
import shutil
from pathlib import Path

import numpy as np
import pandas

from stad_lab.config import VARIANTS, Config
from stad_lab.replication.experiments import BASELINE_DRIVERS, EXPERIMENTS

DATA = Path(__file__).parent / "data"
TRACKS = 100  # each run is evaluated on the tracks 0 to 99, with Gymnasium's renderer
KEYS = {  # table -> the columns that name a line, all others are values
    "episodes": ("experiment", "seed", "track"),
    "fast_episodes": ("agent", "processor", "track"),
    "generations": ("experiment", "role", "seed", "generation"),
    "runs": ("experiment", "role", "seed"),
    "histories": ("experiment", "role", "seed", "network", "step", "data"),
    "probe": ("world_model", "seed", "driver", "features", "quantity"),
    "model_metrics": ("model", "world_model", "metric", "index"),
    "speed": ("part", "measure", "condition", "round"),
    "provenance": ("table", "source"),
}
VALUES = {  # table -> the columns that it must have besides, and that are never empty
    "episodes": ("return", "frames"),
    "fast_episodes": ("return", "frames"),
    "generations": ("worst", "mean", "best", "sigma", "frames"),
    "runs": ("variant", "commit"),
    "histories": ("total",),
    "probe": ("variant", "trained", "indicator_bar", "r2", "low", "high"),
    "model_metrics": ("value",),
    "speed": ("value",),
    "provenance": ("commit",),
}
FLOATS = ("return", "worst", "mean", "best", "value")  # although all may be whole numbers
UNITS = ("agents", "episodes", "frames")


def read(name: str, folder: Path = DATA) -> pandas.DataFrame:
    """Read a table, exact to the last bit of each number.

    Raises:
        ValueError: a column is missing or has gaps, or a line is there twice.
    """
    path = folder / f"{name}.csv"
    table = pandas.read_csv(path, float_precision="round_trip", low_memory=False)
    needed = [*KEYS[name], *VALUES[name]]
    if missing := [column for column in needed if column not in table]:
        raise ValueError(f"{path} has no column {', '.join(missing)}")
    if gaps := [column for column in needed if table[column].isna().any()]:
        raise ValueError(f"{path} has empty cells in {', '.join(gaps)}")
    if (twice := table.duplicated(list(KEYS[name]))).any():
        line = ", ".join(map(str, table.loc[twice, list(KEYS[name])].iloc[0]))
        raise ValueError(f"{path} has two lines for {line}")
    return table


def episodes(folder: Path = DATA) -> pandas.DataFrame:
    """The evaluation of each run: `return` and `frames` on every official track.

    Raises:
        ValueError: as `read`, or a run that was not evaluated on just the tracks 0 to 99.
    """
    table = read("episodes", folder)
    for (experiment, seed), run in table.groupby(["experiment", "seed"]):
        if sorted(run["track"]) != list(range(TRACKS)):
            raise ValueError(f"{experiment}, seed {seed}: expected the tracks 0 to {TRACKS - 1}")
    return table


def returns_of(table: pandas.DataFrame, column: str = "return") -> dict[str, np.ndarray]:
    """Experiment -> its returns, or another column of `episodes`: (seeds, tracks)."""
    wide = table.pivot(index=["experiment", "seed"], columns="track", values=column)
    return {name: wide.loc[name].to_numpy() for name in table["experiment"].unique()}


def fitness(run: str, folder: Path = DATA) -> dict[str, np.ndarray]:
    """All returns of a CMA-ES run, named as by `key`.

    Returns:
        "returns" float64 (generations, agents, tracks), "tracks" int (generations, tracks) and
        "validation" float64 (validations, tracks).
    """
    with np.load(folder / "fitness.npz") as file:
        return {part: file[f"{run}/{part}"] for part in ("returns", "tracks", "validation")}


def key(experiment: str, seed: int, role: str = "run") -> str:
    """The name of a run in file names: "paper_frame-0", "two_iterations_frame-0-first_iteration"."""
    return f"{experiment}-{seed}" + f"-{role}" * (role != "run")


def add_run(
    folder: Path, experiment: str, seed: int, to: Path = DATA, role: str = "run"
) -> None:
    """Add the records of a finished run to the tables, in place of those that it has there.

    Raises:
        ValueError: the evaluation is of another variant, renderer, controller or other tracks.
    """
    run = {"experiment": experiment, "role": role, "seed": seed}
    record = load(folder / "record.json")
    line = run | describe_record(record)
    if (log_file := folder / "evolution.json").exists():
        log = load(log_file)
        line |= {"vae": log["vae"], "mdn_rnn": log["mdn_rnn"]} | flatten(log["best"], "best")
        add_log(run, log, to)
    for network in ("vae", "mdn_rnn"):
        if (weights := folder / f"{network}.safetensors").exists() and role != "run":
            metadata = read_metadata(weights)
            line[network] = metadata["weights"]
            add_history(run | {"network": network}, metadata["history"], to)
    if (controller := folder / "controller.safetensors").exists():
        line["controller"] = hashlib.sha256(controller.read_bytes()).hexdigest()
        copy = to / "controllers" / f"{key(experiment, seed, role)}.safetensors"
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(controller, copy)
    if (evaluation_file := folder / "evaluation.json").exists():
        evaluation = load(evaluation_file)
        check_evaluation(evaluation_file, evaluation, experiment, line.get("controller"))
        line["seconds.evaluation"] = evaluation["seconds"]
        driven = pandas.DataFrame(evaluation["episodes"])
        replace_lines("episodes", driven.assign(experiment=experiment, seed=seed), to)
    replace_lines("runs", pandas.DataFrame([line]), to)


def check_evaluation(path: Path, found: dict, experiment: str, controller: str | None) -> None:
    """Raise ValueError unless an evaluation is the official one of this experiment's agent."""
    driver = experiment in BASELINE_DRIVERS
    variant = experiment if driver else EXPERIMENTS[experiment].variant
    tracks = [episode["track"] for episode in found["episodes"]]
    for name, value, wanted in (
        ("variant", found["variant"], variant),
        ("renderer", found["renderer"], found["renderer"] if driver else "gymnasium"),
        ("controller", found.get("controller"), controller),
        ("tracks", sorted(tracks), list(range(TRACKS))),
    ):
        if value != wanted:
            raise ValueError(f"{path}: {name} is {value}, expected {wanted}")


def describe_record(record: dict) -> dict:
    """The line of `runs` for a record: settings, machine, times and budget, with dotted names."""
    line = {"variant": record["variant"], **flatten(record.get("config", {}), "config")}
    line.pop("config.variant", None)
    line |= record["made_with"]
    line["continued_with"] = " ".join(one["commit"] for one in record.get("continued_with", []))
    line |= flatten(record.get("seconds", {}), "seconds") | flatten(record["budget"], "budget")
    for stage, starts in record.get("peak_memory", {}).items():
        for process in starts[0]:
            line[f"megabytes.{stage}.{process}"] = max(start[process] for start in starts)
    return line | flatten(total_budget(record), "total")


def total_budget(record: dict) -> dict[str, int]:
    """Agents, episodes and frames of a run and of the runs before it that it continues.

    A second iteration drives the random episodes of the first once more; they count once.
    """
    parts = [part for part in record["budget"].values() if isinstance(part, dict)]
    total = {unit: sum(part[unit] for part in parts) for unit in ("episodes", "frames")}
    total["agents"] = record["budget"].get("agents", 0)
    if "earlier" in record:
        same = same_random_episodes(record["config"], record["earlier"]["config"])
        again = record["budget"]["random"] if same else {}
        before = total_budget(record["earlier"])
        total = {unit: total[unit] + before[unit] - again.get(unit, 0) for unit in UNITS}
    return total


def same_random_episodes(one: dict, other: dict) -> bool:
    """Whether two configurations collect the same episodes with the random driver."""
    names = ("episodes", "episode_frames", "random_starts", "crop_bar")
    return one["seed"] == other["seed"] and all(one["data"][n] == other["data"][n] for n in names)


def add_log(run: dict, log: dict, to: Path) -> None:
    """Add the log of a CMA-ES run to `generations` and to the compact file of all returns."""
    lines, entries = [], log["generations"]
    for entry in entries:
        means = np.mean(entry["returns"], axis=1)
        validation = entry.get("validation", {})
        lines.append(
            run
            | {name: entry[name] for name in ("generation", "frames", "sigma", "mean_checksum")}
            | {"worst": means.min(), "mean": means.mean(), "best": means.max()}
            | {"validation": validation.get("mean")}
            | {f"validation_{name}": validation.get(name) for name in ("frames", "controller_checksum")}
        )
    replace_lines("generations", pandas.DataFrame(lines), to)
    path, name = to / "fitness.npz", key(**run)
    kept = dict(np.load(path)) if path.exists() else {}
    validated = [entry["validation"]["returns"] for entry in entries if "validation" in entry]
    kept |= {
        f"{name}/returns": np.array([entry["returns"] for entry in entries]),
        f"{name}/tracks": np.array([entry["tracks"] for entry in entries]),
        f"{name}/validation": np.array(validated),
    }
    np.savez_compressed(path, **{name: kept[name] for name in sorted(kept)})


def read_metadata(path: Path) -> dict:
    """What a file of weights says about itself."""
    content = path.read_bytes()
    header = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])
    return json.loads(header["__metadata__"]["stad_lab"])


def add_history(network: dict, history: list[dict], to: Path) -> None:
    """Add the losses of a network's training to `histories`."""
    lines = [
        network | {"step": entry["step"], "data": data} | entry[data]
        for entry in history
        for data in ("train", "heldout")
    ]
    replace_lines("histories", pandas.DataFrame(lines), to)


def replace_lines(name: str, lines: pandas.DataFrame, folder: Path) -> None:
    """Write a table with new lines in the place of those of the same run."""
    path = folder / f"{name}.csv"
    run = [column for column in ("experiment", "role", "seed", "network") if column in lines]
    table = lines
    if path.exists():
        old = read(name, folder)
        runs = set(lines[run].itertuples(index=False, name=None))
        kept = [row not in runs for row in old[run].itertuples(index=False, name=None)]
        table = pandas.concat([old[kept], lines])
    save(name, table, folder)


def save(name: str, table: pandas.DataFrame, folder: Path = DATA) -> None:
    """Write a table in the order of its keys; floats with all digits, whole numbers without."""
    keys = list(KEYS[name])
    table = table[keys + [column for column in table if column not in keys]]
    for column in table.select_dtypes("float"):
        if (table[column].dropna() % 1 == 0).all() and column not in FLOATS:
            table[column] = table[column].astype("Int64")
    folder.mkdir(parents=True, exist_ok=True)
    table.sort_values(keys).to_csv(folder / f"{name}.csv", index=False, lineterminator="\n")


def flatten(values: dict, prefix: str) -> dict:
    """{"a": {"b": 1}} -> {"prefix.a.b": 1}."""
    found = {}
    for name, value in values.items():
        dotted = f"{prefix}.{name}"
        found |= flatten(value, dotted) if isinstance(value, dict) else {dotted: value}
    return found


def load(path: Path) -> dict:
    """Read a JSON file."""
    return json.loads(path.read_text(encoding="utf-8"))
