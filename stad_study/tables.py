"""The measurements of the replication as tidy tables: one CSV file each, which pandas opens.

A run is named by `experiment`, `role` and `seed`. The role is "run" (CMA-ES for C, evaluated),
"first_iteration" (of a recipe with two) or "world_model" (only V and M); the last two serve the run
of the same seed and those after it, up to the next.

A pipeline of a study (docs/protocol.md) is named by `study`, `variant`, `features` and `seed`, and
has lines in the tables `study_runs`, `study_generations` and `study_episodes`. What its V carries
is in `study_probe`.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas

from stad_lab.config import REPORTED_TRACKS, flatten
from stad_lab.evaluation.evaluate import load_evaluation
from stad_lab.io.files import checksum_of_tensors, load_json, load_tensors, write_bytes
from stad_lab.training.evolution import fitness_curves
from stad_lab.training.record import total_budget
from stad_study.experiments import BASELINE_DRIVERS, EXPERIMENTS

DATA = Path(__file__).parent / "data"
TRACKS = len(REPORTED_TRACKS)  # of each run, with Gymnasium's renderer
UNITS = ("agents", "episodes", "frames")
RUN = ["experiment", "role", "seed"]
PIPELINE = ["study", "variant", "features", "seed"]
SENSED = ["seed", "variant", "sees", "repeat"]  # names a run of study 5
BUDGET = ["seed", "variant", "episodes"]  # names a run of study 2
AGENT = ["seed", "variant"]  # names a run of study 4
TABLES = {  # name -> columns that name a line, and others that each line must have
    "episodes": (["experiment", "seed", "track"], ["return", "frames"]),
    "fast_episodes": (["agent", "processor", "track"], ["return", "frames"]),
    "generations": ([*RUN, "generation"], ["worst", "mean", "best", "sigma", "frames"]),
    "runs": (RUN, ["variant", "commit"]),
    "probe": (["world_model", "seed", "driver", "features", "quantity"], ["variant", "r2"]),
    "model_metrics": (["model", "world_model", "metric", "index"], ["value"]),
    "speed": (["part", "measure", "condition", "round"], ["value"]),
    "provenance": (["table", "source"], ["commit"]),
    "study_episodes": ([*PIPELINE, "track"], ["return", "length"]),
    "study_generations": (
        [*PIPELINE, "generation"], ["worst", "mean", "best", "sigma", "episodes", "frames"],
    ),
    "study_runs": (
        PIPELINE, ["processor", "world_model.trained_on", "dataset", "kept_controller"],
    ),
    "study2_runs": (BUDGET, ["mean", "processor", "controller"]),
    "study2_returns": (BUDGET, ["1000"]),
    "study4_runs": (AGENT, ["mean", "validation", "processor", "controller"]),
    "study4_returns": (AGENT, ["6000"]),
    "study4_shipped": (["variant"], ["processor", "controller", "6000"]),
    "study4_failures": ([*AGENT, "track"], ["points", "tile", "bend", "speed", "then"]),
    "study5_runs": (SENSED, ["mean", "processor", "controller"]),
    "study5_returns": (SENSED, ["1000"]),
    "study_probe": ([*PIPELINE, "trained", "driver", "quantity"], ["r2"]),
}  # fmt: skip


def read(name: str, folder: Path = DATA) -> pandas.DataFrame:
    """Read a table; ValueError if a column is missing or has gaps, or a line is there twice."""
    path = folder / f"{name}.csv"
    table = pandas.read_csv(path, low_memory=False)
    check_table(path, table)
    return table


def check_table(path: Path, table: pandas.DataFrame) -> None:
    """ValueError if a column is missing or has gaps, or a line is there twice."""
    keys, values = TABLES[path.stem]
    for column in keys + values:
        if column not in table or table[column].isna().any():
            raise ValueError(f"{path}: column {column!r} is missing or has empty cells")
    if (twice := table.duplicated(keys)).any():
        raise ValueError(f"{path}: more than one line for {table.loc[twice, keys].values[0]}")


def read_study(name: str, folder: Path = DATA) -> pandas.DataFrame:
    """The table "episodes", "generations", "runs" or "probe" of the studies, empty if not there."""
    return read_or_empty(f"study_{name}", folder)


def read_or_empty(name: str, folder: Path = DATA) -> pandas.DataFrame:
    """Read a table, which is empty if its file is not there."""
    if not (folder / f"{name}.csv").exists():
        keys, values = TABLES[name]
        return pandas.DataFrame(columns=[*keys, *values])
    return read(name, folder)


def line_of(name: str, key: Sequence, folder: Path = DATA) -> dict | None:
    """The line with the values `key` in the columns that name lines; None if it is not there."""
    table = read_or_empty(name, folder)
    own = table[(table[TABLES[name][0]] == list(key)).all(axis=1)]
    return own.iloc[0].to_dict() if len(own) else None


def returns_of_runs(study: str, tracks: Sequence[int], folder: Path = DATA) -> pandas.DataFrame:
    """The returns of study 2, 4 or 5: a line for each of its runs, a column for each track.

    ValueError if a run has no return on one of the tracks, or another mean in the table of runs.
    """
    keys = TABLES[f"{study}_runs"][0]
    runs, table = (read_or_empty(f"{study}_{part}", folder) for part in ("runs", "returns"))
    runs = runs.set_index(keys)
    wanted = {"index": runs.index, "columns": [str(track) for track in tracks]}
    table = table.set_index(keys).reindex(**wanted)
    if table.isna().any(axis=None):
        where = f"the tracks {tracks[0]} to {tracks[-1]}"
        raise ValueError(f"{study}_returns: expected a return of each run on {where}")
    apart = (table.mean(axis=1) - runs["mean"]).abs() > 0.01  # returns are kept to a cent
    if apart.any():
        raise ValueError(f"{study}: mean and returns differ: {apart[apart].index.tolist()}")
    return table


def episodes(folder: Path = DATA) -> pandas.DataFrame:
    """The evaluation of each run: `return` and `frames` on every test track."""
    table = read("episodes", folder)
    for (experiment, seed), run in table.groupby(["experiment", "seed"]):
        check_tracks(f"{experiment}, seed {seed}", run["track"])
    return table


def check_tracks(name: str, tracks) -> None:
    """Raise ValueError unless an evaluation drives every test track once."""
    if sorted(tracks) != list(range(TRACKS)):
        raise ValueError(f"{name}: expected one episode on each of the tracks 0 to {TRACKS - 1}")


def returns_of(table: pandas.DataFrame, column: str = "return") -> dict[str, np.ndarray]:
    """Experiment -> its returns, or another column of `episodes`: (seeds, tracks)."""
    wide = table.pivot(index=["experiment", "seed"], columns="track", values=column)
    return {name: wide.loc[name].to_numpy() for name in table["experiment"].unique()}


def key(experiment: str, seed: int) -> str:
    """The name of a run, for example "paper_frame-0"."""
    return f"{experiment}-{seed}"


def add_run(folder: Path, experiment: str, seed: int, to: Path = DATA, role: str = "run") -> None:
    """Add the records of a finished run to the tables, in place of those that it has there.

    Raises ValueError for an evaluation of another variant, renderer, controller or tracks.
    """
    run = dict(zip(RUN, (experiment, role, seed), strict=True))
    line = run | describe_record(load_json(folder / "record.json"))
    if (file := folder / "controller.safetensors").exists():
        line["controller"] = checksum_of_tensors(load_tensors(file)[0])
    if (path := folder / "evaluation.json").exists():  # checked before anything is written
        evaluation = load_evaluation(path)
        check_evaluation(path, evaluation, experiment, line.get("controller"))
        line["seconds.evaluation"] = evaluation["seconds"]
        driven = pandas.DataFrame(evaluation["episodes"])
        replace_lines("episodes", driven.assign(experiment=experiment, seed=seed), to)
    if (path := folder / "evolution.json").exists():
        log = load_json(path)
        line |= {"vae": log["vae"], "mdn_rnn": log["mdn_rnn"]} | flatten(log["best"], "best.")
        add_log(run, log["generations"], to)
    for network in ("vae", "mdn_rnn"):
        if (path := folder / f"{network}.safetensors").exists() and role != "run":
            line[network] = load_tensors(path)[1]["weights"]
    replace_lines("runs", pandas.DataFrame([line]), to)


def add_speed(file: Path, to: Path = DATA) -> None:
    """Add what `python -m stad_study benchmark` wrote to the tables, in place of the same parts."""
    result = load_json(file, kind="benchmark")
    made_with, parts = result.pop("made_with"), result.keys() - {"kind", "rounds"}
    made_with["commit"] = made_with["commit"] or "unknown"
    lines = []
    for part in parts:
        for measure, table in result[part].items():
            for condition, value in table.items():
                line = {"part": part, "measure": measure, "condition": condition}
                rounds = value["rounds"] if isinstance(value, dict) else [float(value)]
                lines += [line | {"round": n, "value": one} for n, one in enumerate(rounds)]
    old = read("speed", to)
    save("speed", pandas.concat([old[~old.part.isin(parts)], pandas.DataFrame(lines)]), to)
    old = read("provenance", to)
    same = (old.table == "speed") & old.source.isin(parts)
    lines = [{"table": "speed", "source": part} | made_with for part in parts]
    save("provenance", pandas.concat([old[~same], pandas.DataFrame(lines)]), to)


def check_evaluation(path: Path, found: dict, experiment: str, controller: str | None) -> None:
    """Raise ValueError unless an evaluation is of this experiment's agent, on the test tracks."""
    # A driver without V sees no picture, of whatever renderer.
    wanted: dict[str, str | None] = {"variant": experiment}
    if experiment not in BASELINE_DRIVERS:
        variant = EXPERIMENTS[experiment].config.variant
        wanted = {"variant": variant, "renderer": "gymnasium", "controller": controller}
    for name, value in wanted.items():
        if found[name] != value:
            raise ValueError(f"{path}: {name} is {found[name]!r}, expected {value!r}")
    check_tracks(str(path), [episode["track"] for episode in found["episodes"]])


def describe_record(record: dict) -> dict:
    """The line of `runs` for a record: settings, machine, times and budget, with dotted names."""
    line = flatten({"config": record.get("config", {})}) | record["made_with"]
    line |= {"variant": record["variant"], "config.variant": None}
    line["commit"] = line["commit"] or "unknown"
    later = record.get("continued_with", [])
    line["continued_with"] = " ".join(one["commit"] or "unknown" for one in later)
    line |= flatten({name: record.get(name, {}) for name in ("seconds", "budget")})
    line |= flatten(total_budget(record), "total.")
    return {name: value for name, value in line.items() if value is not None}


def add_log(run: dict, log: list[dict], to: Path) -> None:
    """Add the generations of a CMA-ES run to `generations`."""
    lines = pandas.DataFrame([run | flatten(entry) for entry in log])
    lines["worst"], lines["mean"], lines["best"] = fitness_curves(log)
    arrays = ["returns", "tracks", "validation.returns"]
    replace_lines("generations", lines.drop(columns=arrays), to)


def replace_lines(name: str, lines: pandas.DataFrame, folder: Path) -> None:
    """Write a table with new lines in the place of those of the same run or pipeline."""
    naming = {*RUN, *PIPELINE, *SENSED, *BUDGET, *AGENT}
    run = [column for column in TABLES[name][0] if column in naming]
    if (folder / f"{name}.csv").exists():
        old = read(name, folder)
        new = pandas.MultiIndex.from_frame(lines[run])
        lines = pandas.concat([old[~pandas.MultiIndex.from_frame(old[run]).isin(new)], lines])
    save(name, lines, folder)


def save(name: str, table: pandas.DataFrame, folder: Path = DATA) -> None:
    """Write a table in the order of its keys: floats with all digits, whole numbers without.

    ValueError, before anything is written, for a table that `read` would refuse.
    """
    keys, path = TABLES[name][0], folder / f"{name}.csv"
    check_table(path, table)
    table = table[keys + [column for column in table if column not in keys]].sort_values(keys)
    for column in table.select_dtypes("float"):  # gaps make floats of whole numbers
        if (table[column].dropna() % 1 == 0).all():
            table[column] = table[column].astype("Int64")
    text = table.to_csv(index=False, lineterminator="\n")
    write_bytes(path, text.encode())
