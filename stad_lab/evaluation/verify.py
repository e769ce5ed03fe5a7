"""Verify a run: are its files what they were, do they belong together, and does its car still drive the same way?

The same seed, settings, versions, processor and number of threads give equal bits in every stage. So a recorded
episode can be driven again to the same return, and a log of CMA-ES can be told again to the same mean.
"""

import dataclasses
from collections.abc import Callable
from concurrent.futures import Executor
from pathlib import Path

import numpy as np

from stad_lab.agent import CONTROLLER, WorldModel, load_controller, read_world_model
from stad_lab.config import Settings
from stad_lab.io.files import checksum, load_json
from stad_lab.io.workers import TaskError, run_in_order, worker_processes
from stad_lab.models.mdn_rnn import load_mdn_rnn
from stad_lab.models.vae import check_facts, load_autoencoder
from stad_lab.training.dataset import MANIFEST, Rollouts, check_seen, count_episodes
from stad_lab.training.evolution import (
    LOG,
    check_space,
    drive_group,
    hand_out,
    kept_generation,
    read_log,
    replay,
    validate,
)
from stad_lab.training.pipeline import GIVE_A_RUN, MACHINE, PACKAGES, provenance, starts
from stad_lab.training.subspace import search_space

AGAIN = 3  # recorded episodes that are driven again
NOT_HERE = "trained elsewhere or not yet"


def verify(folder: str | Path, executor: Executor | None = None) -> dict[str, str]:
    """Check every file of the run in `folder`, and drive three of its recorded episodes again; about a minute.

    Args:
        executor: who drives; None for processes of this machine.

    Returns:
        What was checked -> what was found. It begins with "ok" if all is well, "FAILED" if not, "none" if there is
        nothing to check, and "differs" if another machine than that of the record has driven otherwise, as it may.

    Raises:
        FileNotFoundError: no run in the folder, since it has no record.
        ValueError: the record itself is damaged, or of a driver without V, M and C.
    """
    folder = Path(folder)
    record = load_json(folder / "record.json", GIVE_A_RUN)
    if "settings" not in record:
        raise ValueError(
            f"{folder} is of {record['variant']}, which has no V, M and C: there is nothing to verify"
        )
    variant, settings = record["variant"], Settings.from_dict(record["settings"])
    checks: dict[str, Callable[[], str]] = {
        "record": lambda: f"ok: {variant}, {settings.name} settings",
        "rollouts": lambda: verify_rollouts(folder / "rollouts"),
        "V": lambda: verify_autoencoder(folder, variant, settings),
        "M": lambda: verify_mdn_rnn(folder, variant, settings),
        "log of CMA-ES": lambda: verify_log(folder, variant, settings),
        "C": lambda: verify_controller(folder, variant, settings),
        "evaluations": lambda: verify_evaluations(folder),
        "drives": lambda: drive_again(folder, variant, settings, executor),
    }
    here = provenance("")
    excuse = "; ".join(filter(None, (other_machine(start, here) for start in starts(record))))
    return {name: outcome(check, excuse) for name, check in checks.items()}


class NotRepeated(ValueError):
    """The same again gave something else, which is a fault only on the same machine."""


def outcome(check: Callable[[], str], excuse: str) -> str:
    """What a check says; an error that it raises is a failure, or has an excuse."""
    try:
        return check()
    except NotRepeated as error:
        return f"differs: {error}; but {excuse}" if excuse else f"FAILED: {error}"
    except (ValueError, OSError, TaskError) as error:
        return f"FAILED: {error}"


def other_machine(made_with: dict, here: dict) -> str:
    """In what this machine, `here`, differs from that of the record; nothing if it is the same."""
    return ", ".join(
        f"{name} is {here[name]!r} and was {made_with.get(name, 'not recorded')!r}"
        for name in (*MACHINE, *PACKAGES)
        if here[name] != made_with.get(name)
    )


def verify_rollouts(folder: Path) -> str:
    """Check every block against the manifest."""
    if not (folder / MANIFEST).exists():
        return f"none: {NOT_HERE}"
    made, wanted = count_episodes(load_json(folder / MANIFEST))
    if made < wanted:
        return f"none: {made} of {wanted} episodes so far"
    rollouts = Rollouts(folder)
    return f"ok: {len(rollouts.frames)} episodes, {len(rollouts)} frames"


def verify_autoencoder(folder: Path, variant: str, settings: Settings) -> str:
    """Check V, its settings, and that it has seen these rollouts."""
    path = folder / "autoencoder.safetensors"
    if not path.exists():
        return f"none: {NOT_HERE}"
    _, facts = load_autoencoder(path, variant)
    check_facts(path, facts, settings)
    check_seen(path, facts["rollouts"], folder / "rollouts")
    return "ok"


def verify_mdn_rnn(folder: Path, variant: str, settings: Settings) -> str:
    """Check M, its settings, and that it belongs to V."""
    path = folder / "mdn_rnn.safetensors"
    if not path.exists():
        return f"none: {NOT_HERE}"
    check_facts(path, load_mdn_rnn(path, variant)[1], settings)
    read_world_model(folder, variant)
    return "ok"


def lacks(folder: Path, *names: str) -> bool:
    """Whether a file is not in the folder, or neither V nor M, with which it is checked: kept records have none."""
    weights = [folder / "autoencoder.safetensors", folder / "mdn_rnn.safetensors"]
    return not any(file.exists() for file in weights) or not all(
        (folder / name).exists() for name in names
    )


def read_longest_log(
    variant: str, settings: Settings, folder: Path, world_model: WorldModel
) -> dict:
    """The log as `read_log`; of a run that is being made longer it knows how long before the settings of the record."""
    asked = load_json(folder / LOG)["settings"]["generations"]
    return read_log(variant, dataclasses.replace(settings, generations=asked), folder, world_model)


def verify_log(folder: Path, variant: str, settings: Settings) -> str:
    """Tell CMA-ES every logged generation again: it must come to the logged means."""
    if lacks(folder, LOG):
        return f"none: {NOT_HERE}"
    world_model = read_world_model(folder, variant)
    log = read_longest_log(variant, settings, folder, world_model)
    space = search_space(settings, world_model, folder)
    try:
        _, means = replay(space.first, settings, log["generations"])
        check_space(folder, settings, space, log["generations"], means)
    except ValueError as error:
        raise NotRepeated(error) from error
    return f"ok: {len(log['generations'])} generations lead to the same mean"


def verify_controller(folder: Path, variant: str, settings: Settings) -> str:
    """Check that C is the one that the log calls the best."""
    if lacks(folder, LOG, CONTROLLER):
        return f"none: {NOT_HERE}"
    log = read_longest_log(variant, settings, folder, read_world_model(folder, variant))
    kept, best = kept_generation(variant, folder, log), log["best"]
    if best is None or kept != best["generation"]:
        raise ValueError(
            f"{folder / CONTROLLER} is the C of generation {kept}, the log calls {best} the best"
        )
    return f"ok: C of generation {kept}"


def verify_evaluations(folder: Path) -> str:
    """Check the files of `evaluate`, and that they are about this C."""
    files = sorted(folder.glob("evaluation*.json"))
    for file in files:
        if load_json(file, "evaluate again")["controller_sha256"] != checksum(
            (folder / CONTROLLER).read_bytes()
        ):
            raise ValueError(
                f"{file} tells of another controller than {folder / CONTROLLER}: evaluate again"
            )
    return (
        f"ok: {', '.join(file.name for file in files)}"
        if files
        else "none: not evaluated in this folder"
    )


def drive_again(folder: Path, variant: str, settings: Settings, executor: Executor | None) -> str:
    """Drive recorded episodes again: of an evaluation, if there is one an official one, or of the look that chose C."""
    if lacks(folder, CONTROLLER):
        return f"none: {NOT_HERE}"
    parameters, _ = load_controller(folder / CONTROLLER, variant)
    evaluations = [load_json(file) for file in sorted(folder.glob("evaluation*.json"))]
    if not evaluations and lacks(folder, LOG):
        return f"none: {NOT_HERE}"
    evaluations.sort(key=lambda evaluation: evaluation["renderer"] != "official")
    with worker_processes(settings.processes, executor) as executor:
        source = hand_out(executor, folder, variant)
        if evaluations:
            episodes, fast = evaluations[0]["episodes"], evaluations[0]["renderer"] == "fast"
            chosen = [
                episodes[n]
                for n in np.linspace(0, len(episodes) - 1, min(AGAIN, len(episodes))).astype(int)
            ]
            recorded = [episode["return"] for episode in chosen]
            tasks = [
                (source, variant, parameters, [episode["track"]], fast, None) for episode in chosen
            ]
            driven = [
                float(returns[0]) for returns, _ in run_in_order(executor, drive_group, tasks)
            ]
        else:  # all the tracks, because last bits depend on the cars that drive in step
            log = read_longest_log(variant, settings, folder, read_world_model(folder, variant))
            look = log["generations"][kept_generation(variant, folder, log) - 1]
            recorded = look["validation"]["returns"][:AGAIN]
            driven = validate(executor, source, variant, settings, parameters)["returns"][:AGAIN]
    if driven != recorded:
        raise NotRepeated(f"the record says {recorded}, now it was {driven}")
    return (
        f"ok: {', '.join(f'{value:.1f}' for value in driven)} points, to the last bit as recorded"
    )
