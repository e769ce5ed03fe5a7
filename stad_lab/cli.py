"""The command line, `python -m stad_lab COMMAND`.

Each function below is a command: its arguments are the options, and their descriptions the help.
What a command needs is imported when it is called, so that the help does not wait for PyTorch.
"""

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

import tyro

from stad_lab import command_line
from stad_lab.command_line import cluster_of, given, output
from stad_lab.config import PRESETS, REPORTED_TRACKS, Config


def main(arguments: list[str] | None = None) -> int:
    """Run one command; returns the exit status. A user's error ends in one line."""
    return command_line.run(PROGRAM, arguments, with_preset)


def parse(arguments: list[str]) -> Callable[[], int | None]:
    """The command that the arguments ask for, ready to be called; see `command_line.parse`."""
    return command_line.parse(PROGRAM, arguments, with_preset)


def with_preset(arguments: list[str]) -> tuple[dict[str, Callable], list[str]]:
    """The commands, with the defaults of the preset that `train` names, and the other arguments."""
    if arguments[:1] != ["train"]:
        return COMMANDS, arguments
    preset, others = take_preset(arguments)
    return COMMANDS | {"train": training_command(Config.preset(preset))}, others


FLAGS = (  # options without a value
    "-h", "--help", "--tensorboard", "--no-tensorboard", "--data.crop-bar", "--data.no-crop-bar",
)  # fmt: skip


def take_preset(arguments: list[str]) -> tuple[str | None, list[str]]:
    """The preset that the arguments of `train` name, and the others: "train --out RUN quick", too.

    Whatever follows `train` is one, so that a misspelt preset is refused as such.
    """
    for place, (before, one) in enumerate(itertools.pairwise(arguments), 1):
        first = place == 1 and not one.startswith("-")
        option = before.startswith("-") and "=" not in before
        takes_value = option and before.replace("_", "-") not in FLAGS
        if first or (one in PRESETS and not takes_value):
            return one, [*arguments[:place], *arguments[place + 1 :]]
    return None, arguments


def result_file(file: Path | None, source: str, kind: str, details: str = "") -> Path:
    """Where a result of an agent goes: by default into its run, or here for a shipped one.

    Raises an OSError or ValueError, before any work, if it cannot or must not be written.
    """
    from stad_lab.agent import run_folder
    from stad_lab.evaluation.evaluate import check_output

    run = run_folder(source)
    name = f"{kind}-{run.resolve().name}{details}.json"
    file = file or (Path(name) if is_shipped(run) else run / name)
    check_output(file, kind)
    return file


def is_shipped(run: Path) -> bool:
    """Whether a folder is that of a shipped agent, in the package: no result goes there."""
    from stad_lab.agent import PRETRAINED

    return run.resolve().parent == PRETRAINED.resolve()


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
        """Collect a dataset, train V, train M, evolve C: `train [PRESET] --out RUN`.

        Stop it when you like; the same command continues. The preset is quick, fast, laptop or
        paper; if none is named, that of $STAD_LAB_PRESET, or else laptop.

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
        for option, path in (("--dataset", dataset), ("--earlier", earlier)):
            if path is not None:
                given(path, option)
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
    validation_tracks: int | None = None,
    processes: int = 2,
    scheduler: str | None = None,
) -> None:
    """Continue CMA-ES from a run's C, with more tracks for each candidate, against rare failures.

    Stop it when you like; the same command continues.

    Args:
        run: A shipped agent, or the folder of a finished run.
        out: Folder of the fine-tuned run.
        generations: Generations of CMA-ES, a multiple of 5; 15 if not given.
        sigma: Initial step size; 0.02 if not given.
        seed: Seed of the candidates and tracks; the run's own if not given.
        validation_tracks: Tracks of a validation; as many as in the run if not given.
        processes: Workers that drive.
        scheduler: Address of a Dask scheduler, to drive on a cluster.
    """
    from stad_lab.agent import run_folder
    from stad_lab.training.fine_tuning import fine_tune, fine_tuning_config

    asked = {"generations": generations, "sigma": sigma, "seed": seed}
    asked["validation_tracks"] = validation_tracks
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
        agent: A shipped agent, or the folder of a run.
        episodes: Number of episodes, one on each track.
        first_track: Seed of the first track.
        fast: Drive in our engine, not in Gymnasium (do not compare with the scores in README.md).
        processes: Workers that drive.
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


def verify(run: str) -> int:
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


def probe(run: str, episodes: int = 180, processes: int = 2, json: Path | None = None) -> None:
    """Measure what the latents of a run carry of the car's motion, with a linear probe.

    It needs only V and M, and takes a few minutes.

    Args:
        run: A shipped agent, or the folder of a run.
        episodes: Episodes of the random driver; an agent drives a third as many, at least 12.
        processes: Workers that drive.
        json: Where to write the result; by default into the run, or here for a shipped agent.
    """
    from stad_lab.agent import run_folder
    from stad_lab.evaluation.probe_run import describe_probe, probe_run
    from stad_lab.io.files import save_json
    from stad_lab.io.weights import load_world_model

    load_world_model(run_folder(run))
    file = result_file(json, run, "probe")
    found = probe_run(run, episodes, processes)
    print(describe_probe(found), flush=True)
    save_json(file, found)
    print(f"  with intervals: {file}")


def report(run: str, out: Path | None = None) -> None:
    """Write a page about a run, finished or not: scores, film, curves, settings, versions.

    Args:
        run: A shipped agent, or the folder of a run.
        out: The .html to write; by default report.html in the run, or here for a shipped agent.
    """
    from stad_lab.agent import run_folder
    from stad_lab.io.files import check_writable, write_bytes
    from stad_lab.training.record import read_record
    from stad_lab.viz.report import report

    folder = run_folder(run)
    read_record(folder)
    here = Path(f"report-{folder.resolve().name}.html")
    file = out or (here if is_shipped(folder) else folder / "report.html")
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
        first: First frame shown, from 1 on; 60 is after the opening zoom.
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


COMMANDS: dict[str, Callable] = {
    "train": training_command(PRESETS["laptop"]),
    "fine-tune": fine_tune,
    "evaluate": evaluate,
    "verify": verify,
    "probe": probe,
    "report": report,
    "film": film,
}
CONTINUES = ("train", "fine-tune", "evaluate")
PROGRAM = command_line.Program(
    "python -m stad_lab", "Teach a car to drive with a model of its world.", COMMANDS, CONTINUES
)
