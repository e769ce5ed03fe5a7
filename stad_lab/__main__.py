"""The command line, `python -m stad_lab`.

Commands: check, train, finish, evaluate, verify, replicate, table, probe, study, benchmark, ship, film.
"""

import argparse
import contextlib
import dataclasses
import json
import sys
from collections.abc import Iterable, Iterator
from concurrent.futures import Executor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

from stad_lab.doctor import escape_foreign_letters, tell_environment

if __name__ == "__main__" and sys.argv[1:] == [
    "check"
]:  # before the imports that a broken installation would fail
    escape_foreign_letters()
    sys.exit(tell_environment())

import torch

from stad_lab.agent import load_agent, load_world_model, run_folder
from stad_lab.benchmark import PARTS, benchmark
from stad_lab.config import PRESETS, Settings
from stad_lab.evaluation.evaluate import describe, evaluate
from stad_lab.evaluation.verify import verify
from stad_lab.io.files import check_writable, save_json, write_bytes
from stad_lab.io.workers import TaskError
from stad_lab.models.vae import VARIANTS, check_variant
from stad_lab.replication.experiments import FLOORS, ROWS
from stad_lab.replication.run import describe_row, describe_time, keep, replicate, time_needed
from stad_lab.replication.study import PARTS as STUDY_PARTS
from stad_lab.replication.study import PROBE_DRIVES, describe_probe, probe_run, study
from stad_lab.replication.tables import RECORDS, claims_and_outcomes, describe_table, kept_rows
from stad_lab.training.fine_tuning import FINISH, OPEN, finish, finish_settings
from stad_lab.training.pipeline import STAGES, ship, train


def build_parser() -> argparse.ArgumentParser:
    """The whole command line with its help."""
    parser = argparse.ArgumentParser(
        prog="python -m stad_lab",
        description="Teach a car to drive with a model of its world (STAD).",
    )
    parser.set_defaults(resumes=False)
    commands = parser.add_subparsers(dest="command", required=True)
    for add in (
        add_check,
        add_train,
        add_finish,
        add_evaluate,
        add_verify,
        add_replicate,
        add_table,
        add_probe,
        add_study,
        add_benchmark,
        add_ship,
        add_film,
    ):
        add(commands)
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Run one command; returns the exit status. Errors of the user's making end in one line, not in a traceback."""
    options = build_parser().parse_args(arguments)
    escape_foreign_letters()
    try:
        return options.do(options) or 0
    except (ValueError, OSError, FloatingPointError, TaskError, BrokenProcessPool) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except (MemoryError, OverflowError, RuntimeError) as error:
        if not is_too_large(error):
            raise
        print(
            f"error: too large for this machine: {error or type(error).__name__}", file=sys.stderr
        )
        return 2
    except KeyboardInterrupt:
        again = "; the same command goes on from the last checkpoint" if options.resumes else ""
        print(f"\nstopped{again}", file=sys.stderr)
        return 130


def is_too_large(error: Exception) -> bool:
    """Whether an error says that memory is lacking: PyTorch's allocator for the CPU has no kind of error of its own."""
    kinds = MemoryError, OverflowError, torch.OutOfMemoryError
    return isinstance(error, kinds) or "allocate memory" in str(error)


# What several commands share


def add_variant(command: argparse.ArgumentParser) -> None:
    """The option --variant."""
    command.add_argument(
        "--variant",
        required=True,
        help=f"which pictures V sees and redraws: {', '.join(VARIANTS)} (frame is World Models; input adds the"
        " difference image to what V sees, output to what it redraws)",
    )


def add_path(command: argparse.ArgumentParser) -> None:
    """The option --path, of a run or of the agent that comes with stad_lab."""
    command.add_argument(
        "--path", type=Path, help="folder of a run; default: the agent that comes with stad_lab"
    )


def add_scheduler(command: argparse.ArgumentParser) -> None:
    """The option --scheduler."""
    command.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="drive on a Dask cluster, for example tcp://10.0.0.1:8786; default: processes of this machine",
    )


def add_processes(command: argparse.ArgumentParser) -> None:
    """The option --processes."""
    command.add_argument("--processes", type=int, default=2, help="worker processes, default 2")


def add_changes(command: argparse.ArgumentParser, what: str) -> None:
    """The option --set."""
    command.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help=what)


def add_parts(command: argparse.ArgumentParser, parts: Iterable[str]) -> None:
    """The option --part."""
    command.add_argument(
        "--part",
        action="append",
        choices=list(parts),
        help="only this part; may be repeated; default all",
    )


def read_changes(changes: list[str]) -> dict:
    """NAME=VALUE changes of settings as a dict. Raises ValueError for one that cannot be read."""
    kinds = {field.name: field.type for field in dataclasses.fields(Settings)}
    readers = {str: str, float: float, bool: lambda text: json.loads(text.lower())}
    values = {}
    for change in changes:
        name, equals, text = change.partition("=")
        if not equals:
            raise ValueError(f"--set {change!r}: expected NAME=VALUE, for example stride=2")
        try:
            values[name] = readers.get(kinds.get(name, str), json.loads)(text)
        except ValueError:
            hint = " (true or false)" if kinds.get(name) is bool else ""
            raise ValueError(
                f"--set {change!r}: expected {name} as {kinds[name].__name__}{hint}"
            ) from None
    return values


@contextlib.contextmanager
def drivers(scheduler: str | None) -> Iterator[Executor | None]:
    """The executor of a Dask cluster, or None for this machine's own processes."""
    if scheduler is None:
        yield None
    else:
        from stad_lab.io.dask_cluster import (
            cluster,
        )  # Dask takes a second to import, and few need it

        with cluster(scheduler) as executor:
            yield executor


# The commands


def add_check(commands: argparse._SubParsersAction) -> None:
    """The command check."""
    command = commands.add_parser(
        "check", help="is everything installed, and what to do about what is not"
    )
    command.set_defaults(do=lambda _: tell_environment())


def add_train(commands: argparse._SubParsersAction) -> None:
    """The command train."""
    command = commands.add_parser(
        "train",
        help="collect, train V, train M, evolve C",
        description="Run all four stages. Stop it when you like; the same command goes on where it stopped.",
    )
    add_variant(command)
    add_scheduler(command)
    command.add_argument(
        "--settings",
        help=f"preset: {', '.join(PRESETS)}; default: $STAD_LAB_SETTINGS, or else laptop",
    )
    command.add_argument(
        "--out", required=True, type=Path, help="folder of the run, for example runs/input"
    )
    command.add_argument(
        "--rollouts", type=Path, help="folder of the rollouts, to share them; default OUT/rollouts"
    )
    command.add_argument(
        "--earlier",
        type=Path,
        metavar="RUN",
        help="a second round: this run's agent drives agent_episodes for the rollouts, and C goes on from its C",
    )
    command.add_argument(
        "--until", default=STAGES[-1], help=f"last stage to run: {', '.join(STAGES)}; default all"
    )
    add_changes(
        command,
        "change one setting of the preset, for example --set stride=2; may be repeated."
        f" The settings: {', '.join(field.name for field in dataclasses.fields(Settings))}",
    )
    command.set_defaults(do=do_train, resumes=True)


def do_train(options: argparse.Namespace) -> None:
    """Run the stages."""
    settings = Settings.preset(options.settings, **read_changes(options.set))
    with drivers(options.scheduler) as executor:
        chosen = (options.variant, settings, options.out, options.rollouts, options.until)
        worked = train(*chosen, executor, options.earlier)
    if not worked:
        print(f"everything up to {options.until} is there in {options.out}: nothing to do")


def add_finish(commands: argparse._SubParsersAction) -> None:
    """The command finish."""
    command = commands.add_parser(
        "finish",
        help="search on from a run's C, with several tracks for every agent",
        description="Search on from the C of a finished run, with its V and M and with several tracks for every agent,"
        " so that failures grow rare. Stop it when you like; the same command goes on where it stopped.",
    )
    add_variant(command)
    add_scheduler(command)
    add_path(command)
    command.add_argument(
        "--out", required=True, type=Path, help="folder of the finish, for example runs/finished"
    )
    add_changes(
        command,
        "change one setting of the finish; may be repeated. It is the run's, but for"
        f" {', '.join(f'{name}={value}' for name, value in FINISH.items())}. These may change: {', '.join(OPEN)}",
    )
    command.set_defaults(do=do_finish, resumes=True)


def do_finish(options: argparse.Namespace) -> None:
    """Search on."""
    check_variant(options.variant)
    earlier = run_folder(options.variant, options.path)
    settings = finish_settings(earlier, **read_changes(options.set))
    with drivers(options.scheduler) as executor:
        if not finish(options.variant, settings, earlier, options.out, executor):
            print(f"the finish is there in {options.out}: nothing to do")


def add_evaluate(commands: argparse._SubParsersAction) -> None:
    """The command evaluate."""
    command = commands.add_parser(
        "evaluate",
        help="drive an agent on official, unseen tracks",
        description="Drive an agent on Gymnasium's own CarRacing-v3 and print mean, deviation, interval and share"
        " above 900; every episode goes into a JSON file. Stop it when you like; the same command goes on.",
    )
    add_variant(command)
    add_scheduler(command)
    add_path(command)
    command.add_argument("--episodes", type=int, default=100, help="number of tracks, default 100")
    command.add_argument(
        "--first-track", type=int, default=0, help="seed of the first track, default 0"
    )
    command.add_argument(
        "--fast", action="store_true", help="draw with the fast renderer (not for reports)"
    )
    add_processes(command)
    command.add_argument(
        "--json",
        type=Path,
        help="where to write the result; default evaluation-VARIANT.json in the run, or here; -fast, -from-TRACK"
        " or -N-tracks is added to the name if it is not the official evaluation",
    )
    command.set_defaults(do=do_evaluate, resumes=True)


def do_evaluate(options: argparse.Namespace) -> None:
    """Drive the tracks, and write every episode."""
    other = "-fast" * options.fast + f"-from-{options.first_track}" * (options.first_track != 0)
    other += f"-{options.episodes}-tracks" * (options.episodes != 100)
    file = options.json or (options.path or Path()) / f"evaluation-{options.variant}{other}.json"
    chosen = (options.variant, options.path, options.episodes, options.first_track, options.fast)
    load_agent(*chosen[:2])
    check_writable(file)
    unfinished = file.with_name(f"unfinished-{file.name}")
    with drivers(options.scheduler) as executor:
        result = evaluate(*chosen, options.processes, executor, unfinished)
    try:
        print(describe(result), flush=True)  # first, since the disk may have filled meanwhile
    finally:  # or the pipe may have been closed, by `head`
        save_json(file, result)
        unfinished.unlink(missing_ok=True)
    print(f"  every episode: {file}")


def add_verify(commands: argparse._SubParsersAction) -> None:
    """The command verify."""
    command = commands.add_parser(
        "verify",
        help="check a run's files, and drive three of its recorded episodes again",
        description="Check that the files of a run are what they were and belong together, and that recorded episodes"
        " can be driven again to the same return. The exit status is 1 if a file has changed, or if a drive differs"
        " on the kind of machine that the record names.",
    )
    command.add_argument("run", type=Path, help="folder of the run")
    command.set_defaults(do=do_verify)


def do_verify(options: argparse.Namespace) -> int:
    """Say of every file what was found."""
    found = verify(options.run)
    print("\n".join(f"{name:<14} {outcome}" for name, outcome in found.items()))
    return int(any(outcome.startswith("FAILED") for outcome in found.values()))


def add_replicate(commands: argparse._SubParsersAction) -> None:
    """The command replicate."""
    command = commands.add_parser(
        "replicate",
        help="make a row of the replication's table",
        description="Make one row of the table: V and M, a search for C for every seed, 100 official tracks for each C"
        " found. It says first how long it will take; stop it when you like, the same command goes on.",
    )
    add_scheduler(command)
    command.add_argument("--row", required=True, help=f"one of {', '.join([*ROWS, *FLOORS])}")
    command.add_argument(
        "--out", required=True, type=Path, help="folder of all rows, for example runs/table"
    )
    command.add_argument(
        "--seeds", type=int, nargs="+", help="of the searches for C; all of the row's without it"
    )
    command.add_argument(
        "--keep",
        action="store_true",
        help="only copy the records of the finished seeds to stad_lab/records/table",
    )
    command.set_defaults(do=do_replicate, resumes=True)


def do_replicate(options: argparse.Namespace) -> None:
    """Make the row, or keep what is made of it."""
    if options.keep:
        kept = keep(options.row, options.out, seeds=options.seeds)
        print("\n".join(f"kept in {folder}" for folder in kept) or "no seed is finished")
        return
    with drivers(options.scheduler) as executor:
        print(describe_time(options.row, time_needed(options.row, options.seeds)), flush=True)
        print(
            describe_row(options.row, replicate(options.row, options.out, executor, options.seeds))
        )


def add_table(commands: argparse._SubParsersAction) -> None:
    """The command table."""
    command = commands.add_parser(
        "table",
        help="print the replication's table, and draw the claim beside the outcome",
        description="Print a line of Markdown for each row that is made, from its records. With --picture, draw what"
        " the paper reports of the four variants beside what came out here.",
    )
    command.add_argument(
        "--records",
        type=Path,
        default=RECORDS,
        help="folder of rows, for example runs/table; default: ours",
    )
    command.add_argument("--picture", type=Path, help="the PNG to write, for example claims.png")
    command.set_defaults(do=do_table)


def do_table(options: argparse.Namespace) -> None:
    """Print the table, and draw the picture."""
    rows = kept_rows(options.records)
    if not rows:
        raise ValueError(
            f"--records {options.records}: expected a folder in which `python -m stad_lab replicate` has finished a row"
        )
    if options.picture:
        if options.picture.suffix.lower() != ".png":
            raise ValueError(f"--picture {options.picture}: expected a file that ends in .png")
        check_writable(options.picture)
    print(describe_table(rows))
    if options.picture:
        from stad_lab.viz.plots import (
            plot_claims,
            to_png,
        )  # matplotlib takes a second, and workers import this file

        figure = plot_claims(claims_and_outcomes(rows))
        write_bytes(options.picture, to_png(figure))
        print(f"drawn to {options.picture}: {figure.get_label()}")


def add_probe(commands: argparse._SubParsersAction) -> None:
    """The command probe."""
    command = commands.add_parser(
        "probe",
        help="measure what the latents of a run know of the car's motion",
        description="Fit a linear probe from z, and from z with M's memory h, to the true motion of the car, and print"
        " its R2 on unseen drives of two drivers, a random one and the `input` agent that comes with stad_lab. Wants V"
        " and M alone, so it can be asked while C is still searched; takes a few minutes.",
    )
    add_variant(command)
    add_path(command)
    command.add_argument(
        "--drives", type=int, default=PROBE_DRIVES, help=f"random drives, default {PROBE_DRIVES}"
    )
    add_processes(command)
    command.add_argument(
        "--json",
        type=Path,
        help="where to write the result; default probe-VARIANT.json in the run, or here",
    )
    command.set_defaults(do=do_probe)


def do_probe(options: argparse.Namespace) -> None:
    """Probe V and M, and write every R2 with its interval."""
    file = options.json or (options.path or Path()) / f"probe-{options.variant}.json"
    check_variant(options.variant)
    load_world_model(run_folder(options.variant, options.path), options.variant)
    check_writable(file)
    found = probe_run(options.variant, options.path, options.drives, options.processes)
    print(describe_probe(found), flush=True)
    save_json(file, found)
    print(f"  with intervals: {file}")


def add_study(commands: argparse._SubParsersAction) -> None:
    """The command study."""
    command = commands.add_parser(
        "study",
        help="measure what the latents know, and how good V and M are",
        description="Measure the V and M that come with stad_lab on unseen drives: a linear probe for the car's true"
        " motion, V's errors, M's likelihood, calibration and dreams. What it compares them with is trained first,"
        " which takes an hour or two; stop it when you like, the same command goes on.",
    )
    command.add_argument("--settings", help="preset of what is trained; default: as for train")
    command.add_argument(
        "--out", required=True, type=Path, help="folder for what is trained, and for study.json"
    )
    command.add_argument(
        "--rollouts", type=Path, help="folder of the rollouts; default OUT/rollouts"
    )
    add_parts(command, STUDY_PARTS)
    command.set_defaults(do=do_study, resumes=True)


def do_study(options: argparse.Namespace) -> None:
    """Measure the parts."""
    settings, rollouts = (
        Settings.preset(options.settings),
        options.rollouts or options.out / "rollouts",
    )
    file = options.out / "study.json"
    check_writable(file)
    study(settings, rollouts, options.out, options.part or list(STUDY_PARTS))
    print(f"every measurement: {file}")


def add_benchmark(commands: argparse._SubParsersAction) -> None:
    """The command benchmark."""
    command = commands.add_parser(
        "benchmark",
        help="measure speeds side by side with Gymnasium and EnvPool",
        description="Let the fast renderer, the loop and the training take turns with the usual ways to do the same"
        " work, on a machine that does nothing else; without the part cluster it takes about eight minutes. EnvPool"
        " takes part if it is installed.",
    )
    add_parts(command, PARTS)
    command.add_argument(
        "--rounds", type=int, default=5, help="how often the contenders take turns, default 5"
    )
    command.add_argument(
        "--json", type=Path, default=Path("benchmark.json"), help="where to write every measurement"
    )
    command.set_defaults(do=do_benchmark)


def do_benchmark(options: argparse.Namespace) -> None:
    """Measure the parts."""
    check_writable(options.json)
    benchmark(options.part or list(PARTS), options.rounds, options.json)
    print(f"\nevery measurement: {options.json}")


def add_ship(commands: argparse._SubParsersAction) -> None:
    """The command ship."""
    command = commands.add_parser(
        "ship", help="copy a run's weights and records to stad_lab/pretrained"
    )
    add_variant(command)
    command.add_argument("--path", type=Path, required=True, help="folder of the run")
    command.set_defaults(do=do_ship)


def do_ship(options: argparse.Namespace) -> None:
    """Copy them."""
    print(f"shipped to {ship(options.variant, options.path)}")


def add_film(commands: argparse._SubParsersAction) -> None:
    """The command film."""
    command = commands.add_parser(
        "film",
        help="make a moving picture of an agent driving",
        description="Observation, difference image, reconstruction and dream side by side, as an animated GIF.",
    )
    add_variant(command)
    add_path(command)
    command.add_argument(
        "--out", type=Path, required=True, help="the GIF to write; with --viewer it may be a .webp"
    )
    command.add_argument(
        "--viewer",
        action="store_true",
        help="film everything: latents, forecast, action and return too",
    )
    command.add_argument("--track", type=int, default=5, help="seed of the track, default 5")
    command.add_argument(
        "--first",
        type=int,
        default=60,
        help="first frame shown, default 60: after the opening zoom",
    )
    command.add_argument(
        "--frames", type=int, default=240, help="frames covered, default 240; every third is shown"
    )
    command.set_defaults(do=do_film)


def do_film(options: argparse.Namespace) -> None:
    """Drive, and write the picture."""
    from stad_lab.viz.video import (
        film_agent,
        film_viewer,
    )  # matplotlib takes a second, and workers import this file

    agent = load_agent(options.variant, options.path)
    shown = (agent, options.track, options.first, options.frames)
    kind = options.out.suffix.lstrip(".").lower()
    if not options.viewer and kind != "gif":
        raise ValueError(
            f"--out {options.out}: expected a file that ends in .gif (or, with --viewer, .webp)"
        )
    check_writable(options.out)
    write_bytes(
        options.out, film_viewer(*shown, kind=kind) if options.viewer else film_agent(*shown)
    )
    print(f"filmed to {options.out}")


if __name__ == "__main__":
    sys.exit(main())
