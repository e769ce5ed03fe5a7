"""Study 5 of docs/protocol.md: is it the motion? C is evolved again on the worlds of study 1.

A world is the V and M of one seed and variant, as study 1 keeps them. A run evolves one C in it and
scores it; the three runs of an arm differ in their evolution seed. In the folder of the study::

    seed0/frame/world.safetensors   what the arms of a world need, from the seed's dataset
    seed0/frame/z_+_motion/1/       a run: components, the log of CMA-ES, and the score

Whatever is there is not done again. A finished run is added to the tables.
"""

import contextlib
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas
import torch

from stad_lab.config import Config
from stad_lab.evaluation.statistics import FAILED
from stad_lab.io.files import (
    checksum,
    checksum_of_arrays,
    load_json,
    load_tensors,
    locked,
    save_json,
    save_tensors,
)
from stad_lab.training.evolution import LOG, evolve, read_log, resume
from stad_lab.training.record import provenance
from stad_lab.training.subspace import COMPONENTS_FILE, save_components
from stad_study import tables
from stad_study.networks import NETWORKS, WORLD_MODEL_FILE, load_kept_world_model
from stad_study.senses import Sense
from stad_study.study import CARS, SCORE, STUDIES, WAIT, fixed_threads
from stad_study.world_facts import WORLD_FILE, load_sense, prepare_seed

STUDY = "study5"
REPEATS = (1, 2, 3)
FIRST_EVOLUTION_SEED = 100  # study 1 has 0 to 11
ARMS = {  # part -> variant and what C sees
    "5a": [(one, sees) for one in ("frame", "input", "input_output") for sees in ("z", "z, h")],
    "5b": [("input_output", "z - motion"), ("input_output", "z - placebo")],
    "5c": [("frame", f"z + {what}") for what in ("motion", "placebo", "action")]
    + [("input_output", "z + motion")],
}
CHECKSUMS = ("log", "controller", "returns")


class Run(NamedTuple):
    """One C; its name is also its folder."""

    seed: int
    variant: str
    sees: str
    repeat: int

    @property
    def name(self) -> str:
        """For example "seed0/frame/z_h/1" or "seed0/frame/z_+_motion/1"."""
        sees = self.sees.replace(", ", "_").replace(" ", "_")
        return f"seed{self.seed}/{self.variant}/{sees}/{self.repeat}"

    @property
    def config(self) -> Config:
        """Its configuration. Candidates and tracks depend on the seed and the repeat alone."""
        features = "z, h" if self.sees == "z, h" else "z"
        evolution = {"seed": FIRST_EVOLUTION_SEED + self.repeat, "features": features}
        own = {"variant": self.variant, "seed": self.seed, "processes": 1, "evolution": evolution}
        return STUDIES["study1"].config.replace(**own)


def find_runs(
    seeds: Sequence[int] | None = None,
    only: Sequence[str] | None = None,
    parts: Sequence[str] = tuple(ARMS),
) -> list[Run]:
    """The runs, part by part and seed by seed. ValueError for an unknown seed or name."""
    planned = STUDIES["study1"].seeds
    if other := set(seeds or ()) - set(planned):
        known = f"{min(planned)} to {max(planned)}"
        raise ValueError(f"study 5 has no seed {min(other)}: it has {known}")
    found = [
        Run(seed, *arm, repeat)
        for part in parts
        for seed in planned
        for repeat in REPEATS
        for arm in ARMS[part]
        if not seeds or seed in seeds
    ]
    names = [run.name for run in found]
    if unknown := [name for name in only or [] if name not in names]:
        raise ValueError(f"study 5 has no run {unknown[0]!r}: expected a name such as {names[0]!r}")
    return [run for run in found if not only or run.name in only]


def run_study5(
    folder: str | Path,
    seeds: Sequence[int] | None = None,
    only: Sequence[str] | None = None,
    to: Path = tables.DATA,
    networks: Path = NETWORKS,
) -> None:
    """Run what is missing, in `folder/study5`, and add each run to the tables in `to`.

    After an interruption the same call continues. A run that another process does is left to it, so
    several processes may share a folder; each computes on one thread. With `only`, runs that the
    tables have are run, too, and compared. ValueError as `find_runs`.
    """
    root = Path(folder) / STUDY
    for run in find_runs(seeds, only):
        if not only and recorded(run, to):
            continue
        with contextlib.ExitStack() as stack:
            try:
                stack.enter_context(locked(root / run.name))
            except BlockingIOError:
                continue
            if not only and recorded(run, to):  # another process has just finished it
                continue
            print(f"{run.name}: {describe_progress(to)}", flush=True)
            score = run_one(run, root, networks)
            if only and (was := recorded(run, to)):
                print(f"{run.name}: {compare(run, was, root)}", flush=True)
                continue
            add_run(run, root, to)
            print(f"{run.name}: mean return {score['mean']:.1f}", flush=True)
    print(describe_progress(to))


def run_one(run: Run, root: Path, networks: Path = NETWORKS) -> dict:
    """Do what is missing of a run; returns its score."""
    folder = root / run.name
    if (folder / SCORE).exists():
        return load_json(folder / SCORE, kind="score")
    begin = time.perf_counter()
    with fixed_threads():
        world = root / f"seed{run.seed}" / run.variant / WORLD_FILE
        if not world.exists():
            with locked(root / f"seed{run.seed}", 3600.0):
                prepare_seed(run.seed, root / f"seed{run.seed}", networks / "study1")
        model = load_kept_world_model(kept_file(run, networks))
        sense, components = load_sense(world, model, run.sees)
        if not (folder / COMPONENTS_FILE).exists():
            depends_on = {"variant": run.variant, "features": run.config.evolution.features}
            count = run.config.evolution.components
            metadata = {**depends_on, "count": count, **sense.checksums}
            save_components(folder / COMPONENTS_FILE, *components, metadata)
        evolve(run.config, folder, drives=sense)  # type: ignore[arg-type]  # only read
        log = read_log(run.config, folder, sense)  # type: ignore[arg-type]
        controller = resume(run.config, folder, sense, log).controller().astype(np.float16)
        score = score_controller(sense, controller)
    seconds = time.perf_counter() - begin
    made_with = provenance(f"python -m stad_study replicate study5 --only {run.name} --out ...")
    save_json(
        folder / SCORE, {"kind": "score", "made_with": made_with, **score, "seconds": seconds}
    )
    return score


def kept_file(run: Run, networks: Path) -> Path:
    """The kept V and M that a run drives with."""
    return networks / "study1" / f"seed{run.seed}" / run.variant / WORLD_MODEL_FILE


def score_controller(sense: Sense, controller: np.ndarray) -> dict:
    """Drive C, float16 (parameters,), on the tracks of study 1's score, in groups as there."""
    tracks, limits = list(STUDIES["study1"].tracks), {"max_frames": STUDIES["study1"].max_frames}
    parameters = controller.astype(np.float64)
    groups = [tracks[start : start + CARS] for start in range(0, len(tracks), CARS)]
    returns = np.concatenate([sense.drive(parameters, own, **limits).returns for own in groups])
    return {
        "mean": float(returns.mean()),
        "returns": returns.tolist(),
        "controller": controller.astype(float).tolist(),
    }


def add_run(run: Run, root: Path, to: Path) -> None:
    """Add a finished run to the tables: its line of runs, and its returns rounded to cents."""
    score, key = load_json(root / run.name / SCORE, kind="score"), run._asdict()
    tracks = STUDIES["study1"].tracks
    returns = {str(t): round(one, 2) for t, one in zip(tracks, score["returns"], strict=True)}
    line = pandas.DataFrame([key | describe_run(run, root)])
    with locked(to.parent / NETWORKS.name / STUDY, WAIT):
        keep_controller(run, np.array(score["controller"]), to.parent / NETWORKS.name / STUDY)
        tables.replace_lines("study5_returns", pandas.DataFrame([key | returns]), to)
        tables.replace_lines("study5_runs", line, to)


def describe_run(run: Run, root: Path) -> dict:
    """The line of runs: score, learning curve, machine, seconds and checksums."""
    score = load_json(root / run.name / SCORE, kind="score")
    log = load_json(root / run.name / LOG)
    returns = np.array(score["returns"])
    line = {"mean": score["mean"], "below_800": float((returns < FAILED).mean())}
    for entry in log["generations"]:
        if "validation" in entry:
            line[f"validation.{entry['generation']}"] = round(entry["validation"]["mean"], 2)
    made = score["made_with"]
    line |= {name: made[name] for name in ("commit", "processor", "numpy", "numba")}
    line |= {"seconds": round(score["seconds"], 1)}
    line["frames"] = sum(entry["frames"] for entry in log["generations"])
    line["log"] = checksum((root / run.name / LOG).read_bytes())
    line["controller"] = checksum_of_arrays(parameters=np.array(score["controller"], np.float16))
    return line | {"returns": checksum_of_arrays(returns=returns)}


def keep_controller(run: Run, controller: np.ndarray, folder: Path) -> None:
    """Add a C to the file of its seed: float16 (parameters,) under the name of the run."""
    path = folder / f"seed{run.seed}.safetensors"
    tensors = load_tensors(path)[0] if path.exists() else {}
    tensors[run.name] = torch.from_numpy(controller.astype(np.float16))
    save_tensors(path, dict(sorted(tensors.items())), kind="controllers", study=STUDY)


def recorded(run: Run, to: Path = tables.DATA) -> dict | None:
    """The line of a run in the table of runs; None if it is not there."""
    table = tables.read_or_empty("study5_runs", to)
    own = table[(table[tables.SENSED] == list(run)).all(axis=1)]
    return own.iloc[0].to_dict() if len(own) else None


def compare(run: Run, was: dict, root: Path) -> str:
    """Whether a run that was repeated is, bit by bit, the one in the tables."""
    now = describe_run(run, root)
    differs = [name for name in CHECKSUMS if was[name] != now[name]]
    if not differs:
        return "bit-identical to the recorded one, all returns, too"
    where = f"recorded on {was['processor']}, here {now['processor']}"
    return (
        f"differs in {', '.join(differs)}: mean {was['mean']:.1f}, here {now['mean']:.1f}; {where}"
    )


def describe_progress(to: Path = tables.DATA) -> str:
    """How many runs of each part are in the tables."""
    table, told = tables.read_or_empty("study5_runs", to), []
    done = set(table[tables.SENSED].itertuples(index=False, name=None))
    for part in ARMS:
        planned = find_runs(parts=[part])
        told.append(f"{part} {sum(tuple(run) in done for run in planned)} of {len(planned)}")
    return f"study 5: {', '.join(told)} runs are done"
