"""The command line of the studies, `python -m stad_study COMMAND`."""

from collections.abc import Callable
from pathlib import Path
from typing import Literal

import tyro

from stad_lab import command_line
from stad_lab.command_line import cluster_of, given, output
from stad_lab.config import STUDY_TRACKS, Config


def main(arguments: list[str] | None = None) -> int:
    """Run one command; returns the exit status. A user's error ends in one line."""
    return command_line.run(PROGRAM, arguments)


def replicate(
    experiment: tyro.conf.Positional[str],
    out: str,
    seeds: list[int] | None = None,
    only: list[str] | None = None,
    keep: bool = False,
    scheduler: str | None = None,
) -> None:
    """Run a study of the protocol, such as study1, or an earlier experiment, with all its seeds.

    Stop it when you like; the same command continues. The pipelines of a study are added to the
    tables of stad_study/data as they finish.

    Args:
        experiment: Its name: study1, study2, study4, study5, study6_laptop, study6_fast, pilot,
            or one of docs/experiments.md.
        out: Folder of all experiments, for example runs/replication.
        seeds: Some of its seeds; all if not given.
        only: Some pipelines of a study, such as seed0/frame/z, or runs of study5, study2 or
            study4, such as seed0/frame/z/1, seed300/frame/4 or seed400/frame. Known ones are
            compared.
        keep: Only add the finished seeds of an earlier experiment to the tables.
        scheduler: Address of a Dask scheduler, to drive on a cluster.
    """
    from stad_study import evolved, run, study, study4
    from stad_study.study2 import STUDY2
    from stad_study.study5 import STUDY5

    folder, own = output(out), {one.name: one for one in (STUDY2, STUDY5)}
    if experiment in (*own, study4.NAME):
        if keep or scheduler:
            raise ValueError(f"{experiment} takes neither --keep nor --scheduler")
        if experiment == study4.NAME:
            study4.run_study4(folder, seeds, only)
        else:
            evolved.run_evolved(own[experiment], folder, seeds, only)
        return
    if experiment in study.STUDIES:
        if keep:
            raise ValueError("--keep is for earlier experiments: a study adds its own pipelines")
        with cluster_of(scheduler) as executor:
            study.run_study(experiment, folder, executor, seeds, only)
        return
    if only:
        raise ValueError(f"--only {only[0]}: {experiment!r} is no study, and has seeds alone")
    if keep:
        if scheduler:
            raise ValueError("--keep drives nothing: leave --scheduler out")
        kept = run.keep(experiment, folder, seeds)
        print("\n".join(f"kept {name}" for name in kept) or "no seed is finished")
        return
    with cluster_of(scheduler) as executor:
        print(run.describe_time(experiment, seeds), flush=True)
        print(run.describe(experiment, run.replicate(experiment, folder, executor, seeds)))


def evaluate(
    study: tyro.conf.Positional[str],
    first_track: int = STUDY_TRACKS.start,
    episodes: int = len(STUDY_TRACKS),
    seeds: list[int] | None = None,
    only: list[str] | None = None,
    json: Path | None = None,
    scheduler: str | None = None,
) -> None:
    """Drive the kept agents of a study on any tracks, with the fast renderer.

    The tracks of the study's own score give its returns again, bit-identical on the same kind of
    processor. Stop it when you like: with --json the same command continues.

    Args:
        study: Its name, such as study1.
        first_track: Seed of the first track.
        episodes: Number of tracks.
        seeds: Some seeds; all that are kept if not given.
        only: Some pipelines, such as seed0/frame/z.
        json: Where to write every episode.
        scheduler: Address of a Dask scheduler, to drive on a cluster.
    """
    from stad_lab.evaluation.evaluate import check_output, check_tracks
    from stad_lab.io.files import save_json
    from stad_study.study import evaluate_kept, read_driven

    check_tracks(episodes, first_track)
    found: dict[str, dict] = {}
    tracks = range(first_track, first_track + episodes)
    if json:
        check_output(json, "study")
        found = read_driven(json, study, tracks)
    with cluster_of(scheduler) as executor:
        agents = evaluate_kept(study, tracks, seeds, only, executor=executor, driven=list(found))
        for pipeline, result in agents:
            low, high = result["interval"]
            text = f"mean return {result['mean']:.1f}, 95% interval {low:.1f} to {high:.1f}"
            print(f"{pipeline.name}: {text}", flush=True)
            found[pipeline.name] = result
            if json:
                save_json(json, {"kind": "study", "study": study, "agents": found})


def probe(
    study: tyro.conf.Positional[str], seeds: list[int] | None = None, processes: int = 2
) -> None:
    """Probe the kept V and M of a study's complete seeds, and add the results to the tables.

    Stop it when you like; the same command continues.

    Args:
        study: Its name, such as study1.
        seeds: Some of its seeds; all complete ones if not given.
        processes: Workers that drive.
    """
    from stad_study.study_probe import probe_study

    probed = probe_study(study, seeds, processes=processes)
    print(f"probed the seeds {probed}" if probed else "no further seed is complete: nothing to do")


def erasure(run: tyro.conf.Positional[str], processes: int = 2) -> None:
    """Pilot of study 5: erase the motion from z, and measure what is left.

    Args:
        run: Folder of a run's V and M, or a shipped agent.
        processes: Workers that drive.
    """
    from stad_lab.agent import run_folder
    from stad_lab.io.weights import load_world_model
    from stad_study.world_facts import describe_erasure, measure_erasure

    print(describe_erasure(measure_erasure(load_world_model(run_folder(run)), processes=processes)))


def claims() -> None:
    """Compute every statistic of the replication from its tables, and write claims.json."""
    from stad_study.claims import write_claims

    print(f"written to {write_claims()}")


def latents(
    out: str,
    preset: Literal["quick", "fast", "laptop", "paper"] = "laptop",
    parts: tuple[Literal["probe", "vae", "mdn_rnn"], ...] = (),
    dataset: str | None = None,
) -> None:
    """Measure the shipped V and M, and what they are compared with, on unseen episodes.

    What they are compared with is trained first, which takes an hour or two. Stop it when you like;
    the same command continues.

    Args:
        out: Folder for what is trained, and for latents.json.
        preset: Preset of what is trained.
        parts: What to measure; all if not given.
        dataset: Folder of the dataset; OUT/dataset if not given.
    """
    from stad_study.latents import PARTS, measure

    folder = output(out)
    data = folder / "dataset" if dataset is None else given(dataset, "--dataset")
    measure(Config.preset(preset), data, folder, list(parts) or list(PARTS))
    print(f"every measurement: {folder / 'latents.json'}")


def benchmark(
    parts: tuple[str, ...] = (),
    rounds: int = 5,
    json: Path = Path("benchmark.json"),
    add: bool = False,
) -> None:
    """Measure speeds side by side with Gymnasium and EnvPool, on a machine that does nothing else.

    Args:
        parts: Some of parity, renderer, loop, training, run; all if not given.
        rounds: How often the contenders take turns.
        json: Where to write every measurement.
        add: Put them into the tables, too, in place of the same parts.
    """
    from stad_lab.evaluation.evaluate import check_output
    from stad_study.benchmark import PARTS, benchmark
    from stad_study.tables import add_speed

    check_output(json, "benchmark")
    benchmark(list(parts) or list(PARTS), rounds, json)
    print(f"\nevery measurement: {json}")
    if add:
        add_speed(json)


def ship(run: str, name: str) -> None:
    """Copy a run's weights and records to stad_lab/pretrained/NAME.

    Args:
        run: Folder of the run.
        name: Name of the shipped agent.
    """
    from stad_study.ship import ship

    print(f"shipped to {ship(run, name)}")


COMMANDS: dict[str, Callable] = {
    "replicate": replicate,
    "evaluate": evaluate,
    "probe": probe,
    "erasure": erasure,
    "claims": claims,
    "latents": latents,
    "benchmark": benchmark,
    "ship": ship,
}
CONTINUES = ("replicate", "probe", "latents")
PROGRAM = command_line.Program(
    "python -m stad_study", "Repeat what the replication ran.", COMMANDS, CONTINUES
)
