"""The command line, `python -m stad_lab COMMAND`.

Each function below is a command: its arguments are the options, and their descriptions the help.
What a command needs is imported when it is called, so that `check` runs where PyTorch does not.
"""

import contextlib
import functools
import io
import itertools
import re
import sys
from collections.abc import Callable
from concurrent.futures import Executor
from pathlib import Path
from typing import Annotated, Literal

import tyro

from stad_lab.compete.limits import Limits
from stad_lab.config import PRESETS, REPORTED_TRACKS, STUDY_TRACKS, Config

CONTINUES = (
    "train",
    "fine-tune",
    "evaluate",
    "replicate",
    "latents",
    "probe-study",
    "compete",
)  # after an interrupt
PROGRAM = "python -m stad_lab"
# Packages that a few commands need, and the extras that bring them.
EXTRAS = {"matplotlib": "lab", "PIL": "lab", "distributed": "cluster", "envpool": "benchmark"}


def main(arguments: list[str] | None = None) -> int:
    """Run one command; returns the exit status. A user's error ends in one line."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    if hasattr(sys.stdout, "reconfigure"):  # the console may lack letters of a folder's name
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        return parse(arguments)() or 0
    except KeyboardInterrupt:
        continues = arguments and arguments[0] in CONTINUES
        again = "; the same command continues from there" if continues else ""
        print(f"\nstopped{again}", file=sys.stderr)
        return 130
    except BrokenPipeError:  # the reader of our output has gone, as with `| head`
        return 141
    except Exception as error:
        if (message := explain(error)) is None:
            raise
        print(f"error: {message}", file=sys.stderr)
        return 2


def parse(arguments: list[str]) -> Callable[[], int | None]:
    """The command that the arguments ask for, ready to be called.

    tyro calls a command as soon as it has parsed it; this defers it, so that only what the parser
    writes is caught. Wrong usage raises ValueError with one line.
    """
    command, commands = arguments[0] if arguments else "", COMMANDS
    if command and not command.startswith("-") and command not in COMMANDS:
        raise ValueError(f"unknown command {command!r}: choose one of {', '.join(COMMANDS)}")
    if command == "train":
        preset, arguments = take_preset(arguments)
        commands = COMMANDS | {"train": training_command(Config.preset(preset))}
    told = io.StringIO()
    try:
        with contextlib.redirect_stderr(told):
            return tyro.extras.subcommand_cli_from_dict(
                {name: deferred(command) for name, command in commands.items()},
                prog=PROGRAM,
                description="Teach a car to drive with a model of its world.",
                args=arguments,
                sort_subcommands=False,
            )
    except SystemExit as ended:
        if not ended.code:
            raise
        raise ValueError(f"{one_line(told.getvalue())}; see {PROGRAM} --help") from None


def take_preset(arguments: list[str]) -> tuple[str | None, list[str]]:
    """The preset that the arguments of `train` name, and the others: "train --out RUN quick", too.

    Whatever follows `train` is one, so that a misspelt preset is refused as such.
    """
    for place, (before, one) in enumerate(itertools.pairwise(arguments), 1):
        first = place == 1 and not one.startswith("-")
        if first or (one in PRESETS and not before.startswith("-")):
            return one, [*arguments[:place], *arguments[place + 1 :]]
    return None, arguments


def deferred(command: Callable) -> Callable:
    """The command with the same options, which returns a call instead of making it."""

    @functools.wraps(command)
    def later(*arguments, **named) -> Callable[[], int | None]:
        return functools.partial(command, *arguments, **named)

    return later


def one_line(message: str) -> str:
    """The parser's message without its frame, and without its advice on --help."""
    lines = [re.sub(r"[─│╭╮╰╯]+|-{9,}", "", line).strip() for line in message.splitlines()]
    kept = [line for line in lines if line and line.lower() != "error"]
    text = re.split("Argument helptext|For full helptext", " ".join(kept))[0]
    title = "^(Value error|Parsing error|Unrecognized options|Required options|Invalid choice) "
    text = re.sub(title, "", text).replace("subcommand Expected", "subcommand: expected")
    return text.strip().rstrip(".")


def explain(error: Exception) -> str | None:
    """One line for an error of the user or of the machine; None for a fault of ours."""
    short = re.search("out of memory|allocate memory|could not create a primitive", str(error))
    torch_is_short = isinstance(error, RuntimeError) and short  # PyTorch has no error of its own
    if isinstance(error, MemoryError | OverflowError) or torch_is_short:
        return f"too large for this machine: {error or type(error).__name__}"
    if isinstance(error, ModuleNotFoundError) and "pip install" not in str(error):
        return f"{error}: pip install 'stad_lab[{EXTRAS.get(error.name or '', 'train')}]'"
    known = ValueError, OSError, FloatingPointError, ImportError
    if isinstance(error, known) or type(error).__name__ == "TaskError":
        return str(error)
    return None


def cluster_of(scheduler: str | None) -> contextlib.AbstractContextManager[Executor | None]:
    """The executor of a Dask cluster, or None for this machine's own processes."""
    if scheduler is None:
        return contextlib.nullcontext()
    from stad_lab.io.dask_cluster import cluster

    return cluster(scheduler)


def output(path: str) -> Path:
    """A folder or file to write to. ValueError if it is empty, which would mean this folder."""
    if not path.strip():
        raise ValueError("--out is empty: give the name of a folder or file, such as runs/input")
    return Path(path)


def result_file(file: Path | None, source: str, kind: str, details: str = "") -> Path:
    """Where a result of an agent goes: by default into its run, or here for a shipped one.

    Raises an OSError or ValueError, before any work, if it cannot or must not be written.
    """
    from stad_lab.agent import PRETRAINED, run_folder
    from stad_lab.evaluation.evaluate import check_output

    run = run_folder(source)
    name = f"{kind}-{run.name}{details}.json"
    file = file or (Path(name) if run.parent == PRETRAINED else run / name)
    check_output(file)
    return file


def check() -> int:
    """Say whether everything is installed, and what to do about what is not."""
    from stad_lab.doctor import tell_environment

    return tell_environment()


def training_command(config: Config) -> Callable:
    """The command `train`, with the defaults of a preset."""

    def train(
        out: str,
        config: Annotated[Config, tyro.conf.arg(name="")] = config,
        dataset: str | None = None,
        earlier: str | None = None,
        until: Literal["dataset", "vae", "mdn_rnn", "controller"] = "controller",
        scheduler: str | None = None,
        tensorboard: bool = False,
    ) -> None:
        """Collect a dataset, train V, train M, evolve C: `train [quick|laptop|paper] --out RUN`.

        Stop it when you like; the same command continues. The preset is that of $STAD_LAB_PRESET,
        or else laptop, if none is named.

        Args:
            out: Folder of the run, for example runs/input.
            config: The configuration.
            dataset: Folder of the dataset, for runs that share one; OUT/dataset if not given.
            earlier: For a second iteration: the run whose agent drives and whose C is carried over.
            until: The last stage to run.
            scheduler: Address of a Dask scheduler, to drive on a cluster.
            tensorboard: Write losses, returns, latents and a film to OUT/tensorboard as well.
        """
        from stad_lab.training.pipeline import train

        folder, board = output(out), None
        if tensorboard:
            from stad_lab.viz.tensorboard import TensorBoard

            board = TensorBoard(folder / "tensorboard")
        with cluster_of(scheduler) as executor:
            if not train(config, folder, dataset, until, executor, earlier, board):
                print(f"everything up to {until} is there in {folder}: nothing to do")
        if board:
            board.add_agent(folder)

    return train


def fine_tune(
    run: str,
    out: str,
    generations: int | None = None,
    sigma: float | None = None,
    seed: int | None = None,
    processes: int = 2,
    scheduler: str | None = None,
) -> None:
    """Continue CMA-ES from a run's C, with more tracks for each candidate, against rare failures.

    Stop it when you like; the same command continues.

    Args:
        run: A shipped agent, or the folder of a finished run.
        out: Folder of the fine-tuned run.
        generations: Of CMA-ES, a multiple of 5; 15 if not given.
        sigma: Initial step size; 0.02 if not given.
        seed: Of the candidates and tracks; the run's own if not given.
        processes: Worker processes.
        scheduler: Address of a Dask scheduler, to drive on a cluster.
    """
    from stad_lab.agent import run_folder
    from stad_lab.training.fine_tuning import fine_tune, fine_tuning_config

    asked = {"generations": generations, "sigma": sigma, "seed": seed}
    changes = {name: value for name, value in asked.items() if value is not None}
    earlier, folder = run_folder(run), output(out)
    config = fine_tuning_config(earlier, evolution=changes, processes=processes)
    with cluster_of(scheduler) as executor:
        if not fine_tune(config, earlier, folder, executor):
            print(f"the fine-tuned run is there in {folder}: nothing to do")


def evaluate(
    agent: str,
    episodes: int = len(REPORTED_TRACKS),
    first_track: int = REPORTED_TRACKS.start,
    fast: bool = False,
    processes: int = 2,
    json: Path | None = None,
    scheduler: str | None = None,
) -> None:
    """Drive an agent on test tracks; prints mean, deviation, interval and share above 900.

    Stop it when you like; the same command continues.

    Args:
        agent: A shipped agent (frame, input, output, input_output), or the folder of a run.
        episodes: Number of tracks.
        first_track: Seed of the first track.
        fast: Render with the fast renderer instead of Gymnasium's own (not for reports).
        processes: Worker processes.
        json: Where to write every episode; by default into the run, or here for a shipped agent.
        scheduler: Address of a Dask scheduler, to drive on a cluster.
    """
    from stad_lab.agent import load_agent
    from stad_lab.evaluation.evaluate import describe, evaluate
    from stad_lab.io.files import save_json

    load_agent(agent)
    other = "-fast" * fast + f"-from-{first_track}" * (first_track != REPORTED_TRACKS.start)
    other += f"-{episodes}-tracks" * (episodes != len(REPORTED_TRACKS))
    file = result_file(json, agent, "evaluation", other)
    unfinished = file.with_name(f"unfinished-{file.name}")
    with cluster_of(scheduler) as executor:
        result = evaluate(agent, episodes, first_track, fast, processes, executor, unfinished)
    try:
        print(describe(result), flush=True)  # first, since the disk may have filled meanwhile
    finally:  # or the pipe may have been closed, by `head`
        save_json(file, result)
        unfinished.unlink(missing_ok=True)
    print(f"  every episode: {file}")


def verify(run: tyro.conf.Positional[str]) -> int:
    """Check a run's files, and drive three of its recorded episodes again.

    The exit status is 1 if a file has changed, or an episode differs on the machine of the record.

    Args:
        run: A shipped agent, or the folder of a run.
    """
    from stad_lab.agent import run_folder
    from stad_lab.evaluation.verify import verify

    found = verify(run_folder(run))
    print("\n".join(f"{name:<14} {outcome}" for name, outcome in found.items()))
    return int(any(outcome.startswith("FAILED") for outcome in found.values()))


def replicate(
    experiment: tyro.conf.Positional[str],
    out: str,
    seeds: list[int] | None = None,
    only: list[str] | None = None,
    keep: bool = False,
    scheduler: str | None = None,
) -> None:
    """Run a study of the protocol, such as study1, or an earlier experiment, with all its seeds.

    It says first how long it will take. Stop it when you like; the same command continues. The
    pipelines of a study are added to the tables of stad_lab/replication/data as they finish.

    Args:
        experiment: Its name: study1, study5, pilot, or one of docs/experiments.md.
        out: Folder of all experiments, for example runs/replication.
        seeds: Some of its seeds; all if not given.
        only: Some pipelines of a study, such as seed0/frame/z, or runs of study5, such as
            seed0/frame/z/1. Known ones are compared.
        keep: Only add the finished seeds of an earlier experiment to the tables.
        scheduler: Address of a Dask scheduler, to drive on a cluster.
    """
    from stad_lab.replication import run, study, study5

    folder = output(out)
    if experiment == study5.STUDY:
        if keep or scheduler:
            raise ValueError("study5 takes neither --keep nor --scheduler")
        study5.run_study5(folder, seeds, only)
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
        kept = run.keep(experiment, folder, seeds)
        print("\n".join(f"kept {name}" for name in kept) or "no seed is finished")
        return
    with cluster_of(scheduler) as executor:
        print(run.describe_time(experiment, seeds), flush=True)
        print(run.describe(experiment, run.replicate(experiment, folder, executor, seeds)))


def evaluate_study(
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
    processor.

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
    from stad_lab.replication.study import evaluate_kept

    check_tracks(episodes, first_track)
    if json:
        check_output(json)
    found, tracks = {}, range(first_track, first_track + episodes)
    with cluster_of(scheduler) as executor:
        for pipeline, result in evaluate_kept(study, tracks, seeds, only, executor=executor):
            low, high = result["interval"]
            text = f"mean return {result['mean']:.1f}, 95% interval {low:.1f} to {high:.1f}"
            print(f"{pipeline.name}: {text}", flush=True)
            found[pipeline.name] = result
            if json:
                save_json(json, {"kind": "study", "study": study, "agents": found})


def probe_study(
    study: tyro.conf.Positional[str], seeds: list[int] | None = None, processes: int = 2
) -> None:
    """Probe the kept V and M of a study's complete seeds, and add the results to the tables.

    Stop it when you like; the same command continues.

    Args:
        study: Its name, such as study1.
        seeds: Some of its seeds; all complete ones if not given.
        processes: Worker processes.
    """
    from stad_lab.replication.study_probe import probe_study

    probed = probe_study(study, seeds, processes=processes)
    print(f"probed the seeds {probed}" if probed else "no further seed is complete: nothing to do")


def claims() -> None:
    """Compute every statistic of the replication from its tables, and write claims.json."""
    from stad_lab.replication.claims import write_claims

    print(f"written to {write_claims()}")


def probe(run: str, episodes: int = 180, processes: int = 2, json: Path | None = None) -> None:
    """Measure what the latents of a run carry of the car's motion, with a linear probe.

    It needs V and M alone, and takes a few minutes.

    Args:
        run: A shipped agent, or the folder of a run.
        episodes: Of the random driver; an agent drives a third as many.
        processes: Worker processes.
        json: Where to write the result; by default into the run, or here for a shipped agent.
    """
    from stad_lab.agent import run_folder
    from stad_lab.io.files import save_json
    from stad_lab.io.weights import load_world_model
    from stad_lab.replication.latents import describe_probe, probe_run

    load_world_model(run_folder(run))
    file = result_file(json, run, "probe")
    found = probe_run(run, episodes, processes)
    print(describe_probe(found), flush=True)
    save_json(file, found)
    print(f"  with intervals: {file}")


def latents(
    out: str,
    preset: Literal["quick", "laptop", "paper"] = "laptop",
    parts: tuple[Literal["probe", "vae", "mdn_rnn"], ...] = (),
    dataset: Path | None = None,
) -> None:
    """Measure the shipped V and M, and what they are compared with, on unseen episodes.

    What they are compared with is trained first, which takes an hour or two. Stop it when you like;
    the same command continues.

    Args:
        out: Folder for what is trained, and for latents.json.
        preset: Of what is trained.
        parts: What to measure; all if not given.
        dataset: Folder of the dataset; OUT/dataset if not given.
    """
    from stad_lab.replication.latents import PARTS, measure

    folder = output(out)
    measure(
        Config.preset(preset), dataset or folder / "dataset", folder, list(parts) or list(PARTS)
    )
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
    from stad_lab.benchmark import PARTS, benchmark
    from stad_lab.evaluation.evaluate import check_output
    from stad_lab.replication.tables import add_speed

    check_output(json)
    benchmark(list(parts) or list(PARTS), rounds, json)
    print(f"\nevery measurement: {json}")
    if add:
        add_speed(json)


def ship(run: str, name: str) -> None:
    """Copy a run's weights and records to stad_lab/pretrained/NAME.

    Args:
        run: Folder of the run.
        name: Of the shipped agent.
    """
    from stad_lab.training.pipeline import ship

    print(f"shipped to {ship(run, name)}")


def report(run: str, out: Path | None = None) -> None:
    """Write a page about a run, finished or not: scores, film, curves, and what made it.

    Args:
        run: A shipped agent, or the folder of a run.
        out: The .html to write; by default report.html in the run, or here for a shipped agent.
    """
    from stad_lab.agent import PRETRAINED, run_folder
    from stad_lab.io.files import check_writable, write_bytes
    from stad_lab.viz.report import report

    folder = run_folder(run)
    shipped = folder.parent == PRETRAINED
    file = out or (Path(f"report-{folder.name}.html") if shipped else folder / "report.html")
    if file.suffix.lower() != ".html":
        raise ValueError(f"--out {file}: expected a .html")
    check_writable(file)
    write_bytes(file, report(folder).encode())
    print(f"written to {file}")


def film(agent: str, out: str, track: int = 5, first: int = 60, frames: int = 240) -> None:
    """Make a film of an agent driving: observation, difference image, reconstruction and dream.

    Args:
        agent: A shipped agent, or the folder of a run.
        out: The .gif to write.
        track: Seed of the track.
        first: First frame shown; 60 is after the opening zoom.
        frames: Frames covered; every third is shown.
    """
    file = output(out)
    if file.suffix.lower() != ".gif":
        raise ValueError(f"--out {file}: expected a .gif")
    from stad_lab.agent import load_agent
    from stad_lab.io.files import check_writable, write_bytes
    from stad_lab.viz.video import film_agent

    loaded = load_agent(agent)
    check_writable(file)
    write_bytes(file, film_agent(loaded, track, first, frames))
    print(f"filmed to {file}")


def compete(
    submissions: tyro.conf.Positional[Path | None] = None,
    out: str = "competition",
    secret: Path | None = None,
    commit: Path | None = None,
    tracks: int = 50,
    check: Path | None = None,
    kit: Path | None = None,
    reveal: bool = False,
    baselines: bool = True,
    processes: int = 2,
    limits: Limits = Limits(),  # noqa: B008
) -> int | None:
    """Rank the agents of a class on hidden tracks, each in a process of its own.

    Stop it when you like; the same command continues.

    Args:
        submissions: Folder with one Python file with make_agent(), or one folder, for each agent.
        out: Folder of the results and of leaderboard.html.
        secret: The file of hidden tracks, made by --commit.
        commit: Draw hidden tracks, write them to this file, and print the hash to publish; of a
            file that exists only the hash is printed.
        tracks: How many to draw.
        check: Try one submission on three public tracks, as its author would.
        kit: Write a first agent to this file, to begin from.
        reveal: Print seeds and salt on the leaderboard.
        baselines: Whether the random driver, straight on, and the shipped agents stand beside.
        processes: Submissions that drive at once.
        limits: What a submission may use.
    """
    from stad_lab.compete import run

    if kit:
        print(run.write_kit(kit))
        return None
    if commit:
        print(run.hide_tracks(commit, tracks))
        return None
    if check:
        said = run.check_submission(check, limits)
        print(said)
        return int(said.startswith("FAILED"))
    if not submissions or not secret:
        raise ValueError("expected a folder of submissions and --secret FILE, made by --commit")
    folder = output(out)
    page = run.run(submissions, secret, folder, limits, processes, reveal, baselines)
    print(f"written to {page}")
    return None


COMMANDS: dict[str, Callable] = {
    "check": check,
    "train": training_command(PRESETS["laptop"]),
    "fine-tune": fine_tune,
    "evaluate": evaluate,
    "verify": verify,
    "replicate": replicate,
    "evaluate-study": evaluate_study,
    "probe-study": probe_study,
    "claims": claims,
    "probe": probe,
    "latents": latents,
    "benchmark": benchmark,
    "ship": ship,
    "report": report,
    "film": film,
    "compete": compete,
}
