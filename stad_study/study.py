"""Runs a study of docs/protocol.md: whole pipelines, seed by seed, each added to the tables.

A pipeline is named by its seed, its variant and what C sees, for example `seed0/frame/z`. In the
folder of a study::

    seed0/dataset/              of the random driver, for all pipelines of the seed
    seed0/frame/                V and M, for both controllers
    seed0/frame/z/              C that sees z, with the log of CMA-ES and the episodes of the score
    networks/seed0/frame/...    what is kept of them, see `stad_study.networks`

Whatever is there is not done again. A variant of a seed whose pipelines are in the tables is not
run, unless one is asked for by its name: then it is compared with what the tables say.
"""

import contextlib
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, Protocol, TypeVar

import numpy as np
import pandas
import torch
from threadpoolctl import threadpool_limits

from stad_lab.agent import Agent
from stad_lab.config import STUDY_TRACKS, VARIANTS, Config, flatten
from stad_lab.evaluation.evaluate import report
from stad_lab.io.files import (
    checksum,
    checksum_of_arrays,
    copy_file,
    load_json,
    locked,
    save_json,
)
from stad_lab.io.weights import load_world_model
from stad_lab.io.workers import run_in_order, worker_threads
from stad_lab.training.dataset import MANIFEST, dataset_checksum, load_manifest
from stad_lab.training.evolution import LOG, drive_group, hand_out, read_log, resume
from stad_lab.training.pipeline import STAGES, train
from stad_lab.training.record import RECORD
from stad_study import tables
from stad_study.networks import (
    NETWORKS,
    WORLD_MODEL_FILE,
    how_to_get,
    keep_controller,
    keep_world_model,
    load_kept_agent,
)
from stad_study.run import share_world_model
from stad_study.tables import PIPELINE

SCORE = "score.json"
CARS = 16  # cars that drive in one batch
THREADS = 1  # that train V and M, on every machine: last bits depend on their number
WAIT = 120.0  # seconds to wait for another process that writes the tables
COLLECTING = 3600.0  # seconds to wait for another process that collects the dataset
TIMED = (*STAGES, "score")
MADE_WITH = ("commit", "processor", "threads", "torch", "trained_on")  # that is noted of V and M


@dataclass(frozen=True)
class Study:
    """What is run, and how each pipeline is scored."""

    seeds: Sequence[int]
    variants: tuple[str, ...] = VARIANTS
    features: tuple[str, ...] = ("z", "z, h")  # what C sees
    config: Config = field(default_factory=lambda: Config.preset("laptop"))
    tracks: range = STUDY_TRACKS
    max_frames: int = 1000  # of an episode of the score, which has no patience
    keeps_networks: bool = True  # beside the tables, so that anyone can drive them again


PAIRS = range(200, 206), ("frame", "input_output"), ("z, h",)  # seeds, variants, features
STUDIES = {
    "study1": Study(range(12)),
    "pilot": Study((100,), ("frame", "input_output"), keeps_networks=False),
    "study6_laptop": Study(*PAIRS, keeps_networks=False),
    "study6_fast": Study(*PAIRS, config=Config.preset("fast"), keeps_networks=False),
}


class Pipeline(NamedTuple):
    """One whole training of V, M and C; its name is also its folder."""

    study: str
    variant: str
    features: str
    seed: int

    @property
    def name(self) -> str:
        """For example "seed0/frame/z_h"."""
        return f"seed{self.seed}/{self.variant}/{self.features.replace(', ', '_')}"

    @property
    def config(self) -> Config:
        """Its configuration. Dataset, tracks and candidates depend on the seed alone."""
        evolution = {"seed": self.seed, "features": self.features}
        own = {"variant": self.variant, "seed": self.seed, "evolution": evolution}
        return STUDIES[self.study].config.replace(**own)


def find_pipelines(
    study: str, seeds: Sequence[int] | None = None, only: Sequence[str] | None = None
) -> list[Pipeline]:
    """The pipelines of a study in the order of running: all, of some seeds, or some by name.

    ValueError for an unknown study, seed or name.
    """
    if study not in STUDIES:
        raise ValueError(f"unknown study {study!r}: choose one of {', '.join(STUDIES)}")
    asked = STUDIES[study]
    arms = [(variant, features) for variant in asked.variants for features in asked.features]
    found = [Pipeline(study, *arm, seed) for seed in asked.seeds for arm in arms]
    return select(study, found, seeds, only)


class Run(Protocol):
    """What a study runs and counts."""

    @property
    def seed(self) -> int:
        """That of its world."""

    @property
    def name(self) -> str:
        """Its folder, below that of the study."""


AnyRun = TypeVar("AnyRun", bound=Run)


def select(
    study: str, runs: list[AnyRun], seeds: Sequence[int] | None, only: Sequence[str] | None
) -> list[AnyRun]:
    """Those of some seeds, or some by name. ValueError for an unknown seed or name."""
    planned = {run.seed for run in runs}
    if other := set(seeds or ()) - planned:
        known = f"{min(planned)} to {max(planned)}"
        raise ValueError(f"study {study!r} has no seed {min(other)}: it has {known}")
    chosen = [run for run in runs if not seeds or run.seed in seeds]
    names = [run.name for run in chosen]
    if unknown := [name for name in only or [] if name not in names]:
        example = f"expected a name such as {names[0]!r}"
        raise ValueError(f"study {study!r} has no run {unknown[0]!r}: {example}")
    return [run for run in chosen if not only or run.name in only]


def run_study(
    study: str,
    folder: str | Path,
    executor: Executor | None = None,
    seeds: Sequence[int] | None = None,
    only: Sequence[str] | None = None,
    to: Path = tables.DATA,
) -> None:
    """Run the missing pipelines of a study in `folder/study`, and add each to the tables in `to`.

    After an interruption the same call continues. A variant of a seed that another process runs is
    left to it, so several processes may run a study in the same folder. With `only`, pipelines that
    the tables have are run, too, and compared with the tables instead of added.

    Raises ValueError as `find_pipelines`, and if the folder already has all that `only` names, and
    the tables, too; and what `train` raises.
    """
    wanted, root = find_pipelines(study, seeds, only), Path(folder) / study
    if only:
        wanted = without_finished(root, wanted, lambda one: recorded(one, to))
    for seed, variant in dict.fromkeys((one.seed, one.variant) for one in wanted):
        own = [one for one in wanted if (one.seed, one.variant) == (seed, variant)]
        if not only and not unfinished(own, to):
            continue
        with claimed(root / f"seed{seed}" / variant) as ours:
            if not ours:
                continue
            # Asked again, because another process may have finished them just before.
            for pipeline in own if only else unfinished(own, to):
                print(f"{pipeline.name}: {describe_progress(study, wanted, to)}", flush=True)
                run_pipeline(pipeline, root, executor)
                if only and recorded(pipeline, to):
                    found = compare_pipeline(pipeline, root, to)
                else:
                    add_pipeline(pipeline, root, to)
                    found = describe_score(pipeline, root)
                print(f"{pipeline.name}: {found}", flush=True)
    print(f"{study}: {describe_progress(study, wanted, to)}")


@contextlib.contextmanager
def claimed(folder: Path) -> Iterator[bool]:
    """Own the folder of a run for a `with` block; False if another process has it."""
    with contextlib.ExitStack() as stack:
        try:
            stack.enter_context(locked(folder))
            ours = True
        except BlockingIOError:
            ours = False
            print(f"{folder}: is run by another process", flush=True)
        yield ours


def without_finished(
    root: Path, runs: list[AnyRun], known: Callable[[AnyRun], dict | None]
) -> list[AnyRun]:
    """Runs that are asked for by name, but for those in the tables that `root` has, too.

    `known` is the line of a run in the tables, or None. ValueError if none is left: a finished run
    would be compared with itself.
    """
    left = [run for run in runs if not ((root / run.name / SCORE).exists() and known(run))]
    if not left:
        remedy = "give an empty folder with --out to repeat it"
        raise ValueError(f"{root / runs[0].name} has the recorded run: {remedy}")
    return left


def unfinished(pipelines: list[Pipeline], to: Path) -> list[Pipeline]:
    """The pipelines of one variant and seed that are to be run: all, if one is not in the tables.

    They share V and M, which come out otherwise on another kind of processor. Those whose score is
    in the folder are only added again.
    """
    lacking = any(recorded(one, to) is None for one in pipelines)
    return pipelines if lacking else []


def run_pipeline(pipeline: Pipeline, root: Path, executor: Executor | None) -> None:
    """Do what is missing of a pipeline: dataset, V, M, C, what is kept of them, and the score."""
    config, run = pipeline.config, root / pipeline.name
    seed, world = root / f"seed{pipeline.seed}", run.parent
    if (run / SCORE).exists():
        return
    with fixed_threads():
        usual = STUDIES[pipeline.study].config
        shared = config.replace(evolution={"features": usual.evolution.features})
        with locked(seed, COLLECTING):
            train(shared.replace(variant=usual.variant), seed, until="dataset", executor=executor)
        train(shared, world, seed / "dataset", until="mdn_rnn", executor=executor)
        share_world_model(config, run, world)
        train(config, run, seed / "dataset", executor=executor)
        kept = keep(pipeline, root)
        begin, tracks = time.perf_counter(), STUDIES[pipeline.study].tracks
        limits = {"max_frames": STUDIES[pipeline.study].max_frames}
        agent = load_kept_agent(kept)
        score = drive_tracks(agent, tracks, config.processes, executor, pipeline.name, limits)
        controller = checksum_of_arrays(parameters=agent.parameters)
        found = {"kind": "score", "variant": pipeline.variant, "controller": controller} | score
        save_json(run / SCORE, found | {"seconds": time.perf_counter() - begin})


@contextlib.contextmanager
def fixed_threads() -> Iterator[None]:
    """Let PyTorch and BLAS compute on THREADS threads, whatever the number of cores."""
    before = torch.get_num_threads()
    with threadpool_limits(THREADS):
        torch.set_num_threads(THREADS)
        try:
            yield
        finally:
            torch.set_num_threads(before)


def keep(pipeline: Pipeline, root: Path) -> Path:
    """Write what is kept of a finished pipeline; returns the file of its controller."""
    run, config = root / pipeline.name, pipeline.config
    path = kept_file(pipeline, root / "networks")
    keep_world_model(config, run, path.with_name(WORLD_MODEL_FILE))
    trained = load_world_model(run).checksums
    keep_controller(path, final_controller(config, run), pipeline.variant, trained)
    return path


def kept_file(pipeline: Pipeline, networks: Path) -> Path:
    """The file of a kept controller."""
    return networks / f"{pipeline.name}.safetensors"


def final_controller(config: Config, run: Path) -> np.ndarray:
    """The averaged CMA mean after the last generation, float64 (parameters,).

    It is the outcome of a study. The C that `train` writes is the averaged CMA mean of the
    generation with the best validation, whose score has the noise of that choice.
    """
    world_model = load_world_model(run)
    log = read_log(config, run, world_model)
    if len(log["generations"]) < config.evolution.generations:
        raise ValueError(f"{run} has {len(log['generations'])} generations: run it to the end")
    return resume(config, run, world_model, log).controller()


def groups_of(tracks: Sequence[int]) -> list[Sequence[int]]:
    """Tracks in the groups that drive as one batch."""
    return [tracks[start : start + CARS] for start in range(0, len(tracks), CARS)]


def drive_tracks(
    agent: Agent,
    tracks: Sequence[int],
    processes: int = 2,
    executor: Executor | None = None,
    label: str = "",
    limits: dict | None = None,
) -> dict:
    """Drive an agent on tracks in groups of CARS, with the fast renderer; as `report` returns it.

    Groups begin with the first track, so the same first track gives bit-identical returns.
    """
    tracks = list(tracks)
    groups = groups_of(tracks)
    with worker_threads(processes, executor) as executor:
        source = hand_out(executor, agent.world_model)
        tasks = [(source, agent.parameters, group, True, limits) for group in groups]
        found = run_in_order(executor, drive_group, tasks, f"score {label}", "group")
    returns, lengths = (np.concatenate(part) for part in zip(*found, strict=True))
    return report(tracks, returns, lengths)


def recorded(pipeline: Pipeline, to: Path = tables.DATA) -> dict | None:
    """The line of a pipeline in the table of runs; None if it is not there."""
    return tables.line_of("study_runs", pipeline, to)


def check_settings(study: str, runs: pandas.DataFrame) -> None:
    """ValueError if a run in the table of runs has another value than its recipe sets."""
    for line in runs[runs["study"] == study].to_dict("records"):
        one = Pipeline(*(line[key] for key in PIPELINE))
        for name, value in flatten({"config": one.config.as_dict()}).items():
            found = line.get(name)
            if pandas.notna(found) and found != value:  # older runs lack a later setting
                raise ValueError(f"{study}/{one.name} has {name} {found}, not {value}")


def add_pipeline(pipeline: Pipeline, root: Path, to: Path = tables.DATA) -> None:
    """Add a finished pipeline to the tables in `to`, and its networks to the folder beside them.

    The line of runs comes last: a pipeline that has one is complete. Processes take turns.
    """
    run, key = root / pipeline.name, pipeline._asdict()
    networks = to.parent / NETWORKS.name / pipeline.study
    log, score = load_json(run / LOG), load_json(run / SCORE, kind="score")
    kept = kept_file(pipeline, root / "networks")
    with locked(to, WAIT):  # studies share tables
        if STUDIES[pipeline.study].keeps_networks:
            for file in (kept.with_name(WORLD_MODEL_FILE), kept):
                copy_file(file, kept_file(pipeline, networks).parent)
        driven = pandas.DataFrame(score["episodes"]).rename(columns={"frames": "length"})
        generations = describe_generations(log["generations"], load_json(seed_record(run)))
        line = pandas.DataFrame([describe_run(pipeline, root)])
        for name, lines in (("episodes", driven), ("generations", generations), ("runs", line)):
            tables.replace_lines(f"study_{name}", lines.assign(**key), to)


def seed_record(run: Path) -> Path:
    """The record of the dataset of a pipeline."""
    return run.parent.parent / RECORD


def describe_generations(generations: list[dict], seed: dict) -> pandas.DataFrame:
    """The lines of a CMA-ES run: fitness, validation, and all that was driven so far.

    "episodes" and "frames" count the dataset, the candidates and the validations.
    """
    lines, driven = [], dict(seed["budget"]["random"])
    for entry in generations:
        fitness, validation = np.mean(entry["returns"], axis=1), entry.get("validation", {})
        driven["episodes"] += np.size(entry["returns"]) + len(validation.get("returns", ()))
        driven["frames"] += entry["frames"] + validation.get("frames", 0)
        line = {"worst": fitness.min(), "mean": fitness.mean(), "best": fitness.max()}
        line |= {"sigma": entry["sigma"], "validation": validation.get("mean"), **driven}
        lines.append({"generation": entry["generation"], **line})
    return pandas.DataFrame(lines)


def describe_run(pipeline: Pipeline, root: Path) -> dict:
    """The line of runs: settings, machine, seconds of each stage, budget and checksums.

    The seconds of the dataset are those of the seed, and those of V and M of the variant: other
    pipelines share them, and repeat them in their own lines.
    """
    run = root / pipeline.name
    shared = {"vae": run.parent / RECORD, "mdn_rnn": run.parent / RECORD}
    shared["dataset"], kept = seed_record(run), kept_file(pipeline, root / "networks")
    line = tables.describe_record(load_json(run / RECORD))
    for stage, file in shared.items():
        line[f"seconds.{stage}"] = load_json(file)["seconds"].get(stage, 0.0)
    made_with = load_json(run.parent / RECORD)["made_with"]
    line |= {f"world_model.{name}": made_with[name] for name in MADE_WITH}
    score = load_json(run / SCORE, kind="score")
    frames = sum(episode["frames"] for episode in score["episodes"])
    line |= {"seconds.score": score["seconds"], "budget.score.frames": frames}
    line |= {"budget.score.episodes": len(score["episodes"])}
    manifest = load_manifest(root / f"seed{pipeline.seed}" / "dataset" / MANIFEST)
    line |= {"dataset": dataset_checksum(manifest), **load_world_model(run).checksums}
    line["log"] = checksum((run / LOG).read_bytes())
    line["kept_world_model"] = checksum(kept.with_name(WORLD_MODEL_FILE).read_bytes())
    return line | {"kept_controller": checksum(kept.read_bytes())} | pipeline._asdict()


CHECKSUMS = ("dataset", "vae", "mdn_rnn", "log", "kept_world_model", "kept_controller")


def compare_pipeline(pipeline: Pipeline, root: Path, to: Path = tables.DATA) -> str:
    """Whether a pipeline that was run again is, bit by bit, the one in the tables."""
    was, now = recorded(pipeline, to) or {}, describe_run(pipeline, root)
    table = tables.read_study("episodes", to)
    before = table[(table[PIPELINE] == list(pipeline)).all(axis=1)].set_index("track")["return"]
    score = load_json(root / pipeline.name / SCORE, kind="score")
    again = {episode["track"]: episode["return"] for episode in score["episodes"]}
    other = sum(before[track] != value for track, value in again.items())
    differs = [name for name in CHECKSUMS if was[name] != now[name]]
    differs += [f"{other} of {len(again)} returns"] * bool(other)
    if not differs:
        return f"bit-identical to the recorded one, all {len(again)} returns, too"
    made = [
        f"{line['processor']}, V and M on {line['world_model.trained_on']} with PyTorch"
        f" {line['world_model.torch']}"
        for line in (was, now)
    ]
    return f"differs in {', '.join(differs)}; recorded on {made[0]}, here {made[1]}"


def describe_score(pipeline: Pipeline, root: Path) -> str:
    """One line on a finished pipeline."""
    score = load_json(root / pipeline.name / SCORE, kind="score")
    return f"mean return {score['mean']:.1f} on {len(score['episodes'])} tracks"


def describe_progress(study: str, wanted: list[Pipeline], to: Path = tables.DATA) -> str:
    """How many pipelines are in the tables, and about how long the others will take."""
    table = tables.read_study("runs", to)
    done = {Pipeline(*line) for line in table[PIPELINE].itertuples(index=False)}
    missing = [pipeline for pipeline in wanted if pipeline not in done]
    text = f"{len(wanted) - len(missing)} of {len(wanted)} pipelines are done"
    if not missing or table.empty:
        return text
    own = table[table["study"] == study]
    seconds = (own if len(own) else table)[[f"seconds.{stage}" for stage in TIMED]].mean()
    trained = {(one.seed, one.variant) for one in done if one.study == study}
    worlds = {(one.seed, one.variant) for one in missing} - trained
    datasets = {seed for seed, _ in worlds} - {seed for seed, _ in trained}
    counts = [len(datasets), len(worlds), len(worlds), len(missing), len(missing)]
    return f"{text}, about {np.dot(counts, seconds) / 3600:.1f} hours are left"


def check_kept(study: str) -> None:
    """ValueError if the agents of a study are not kept."""
    if not STUDIES[study].keeps_networks:
        raise ValueError(f"study {study!r} keeps no agents: its returns are in the tables")


def read_driven(file: Path, study: str, tracks: Sequence[int]) -> dict[str, dict]:
    """Name -> what `evaluate_kept` gave for it before; empty if the file is not there.

    ValueError if it holds another study, or other tracks.
    """
    if not file.exists():
        return {}
    known = load_json(file, kind="study")
    driven = [[one["track"] for one in own["episodes"]] for own in known["agents"].values()]
    if known["study"] != study or any(own != list(tracks) for own in driven):
        remedy = "give another file with --json"
        raise ValueError(f"{file} holds another study, or other tracks: {remedy}")
    return known["agents"]


def evaluate_kept(
    study: str,
    tracks: Sequence[int],
    seeds: Sequence[int] | None = None,
    only: Sequence[str] | None = None,
    networks: Path = NETWORKS,
    executor: Executor | None = None,
    driven: Collection[str] = (),
) -> Iterator[tuple[Pipeline, dict]]:
    """Drive the kept agents of a study on any tracks, at least 0; yields what `report` returns.

    Those of the names in `driven` are left out. ValueError for a study that keeps no agents;
    FileNotFoundError if an agent that is asked for by name is not there, or if none is.
    """
    wanted, folder = find_pipelines(study, seeds, only), networks / study
    check_kept(study)
    there = [one for one in wanted if kept_file(one, folder).exists()]
    if not there or (only and len(there) < len(wanted)):
        raise FileNotFoundError(f"{folder} has no agents of these names: {how_to_get(study)}")
    if others := len(wanted) - len(there):
        print(f"{others} agents are not there: {how_to_get(study)}", flush=True)
    for pipeline in (one for one in there if one.name not in driven):
        agent = load_kept_agent(kept_file(pipeline, folder))
        yield pipeline, drive_tracks(agent, tracks, 2, executor, pipeline.name)
