"""Verify a run: are its files whole, do they belong together, does its car drive as recorded?

The same seed, settings, versions, processor and number of threads give equal bits in every stage.
So a recorded episode can be driven again to the same return, and a log of CMA-ES can be replayed to
the same mean. Elsewhere rounding differs, and what follows from it is tolerated up to a bound.
"""

from collections.abc import Callable
from concurrent.futures import Executor
from pathlib import Path

import numpy as np
import torch
from threadpoolctl import threadpool_limits

from stad_lab.config import Config
from stad_lab.evaluation.evaluate import evaluations_of, is_of_agent
from stad_lab.io.files import load_json, load_tensors
from stad_lab.io.weights import (
    CONTROLLER_FILE,
    MDN_RNN_FILE,
    VAE_FILE,
    load_controller,
    load_world_model,
)
from stad_lab.io.workers import TaskError, run_in_order, worker_processes, worker_threads
from stad_lab.training import evolution
from stad_lab.training.dataset import MANIFEST, Dataset, check_seen, count_episodes, load_manifest
from stad_lab.training.mdn_rnn import check_mdn_rnn
from stad_lab.training.record import (
    MACHINE,
    PACKAGES,
    provenance,
    read_record,
    starts,
)
from stad_lab.training.subspace import search_space
from stad_lab.training.vae import check_vae

AGAIN = 3  # recorded episodes that are driven again
# Bounds of what other rounding explains. One car in three may leave the road, so the median counts.
POINTS = 30.0  # between a recorded return and the one driven again
SHARE = 1e-5  # between C and what the log gives, of the way from the first C; we saw 3e-9
MISSING = "none: trained elsewhere or not yet"


class NotRepeated(ValueError):
    """A repetition gave another result within the bounds: an error only on the recorded machine."""


def verify(folder: str | Path, executor: Executor | None = None) -> dict[str, str]:
    """Check every file of the run in `folder`, and drive three recorded episodes again.

    Args:
        executor: where episodes run; None for workers of this machine.

    Returns:
        What was checked -> what was found. It begins with "ok", "FAILED", "none" if there is
        nothing to check, or "differs" if a result differs within bounds and this machine differs
        from the recorded one, or parts of that one are not recorded.

    Raises:
        FileNotFoundError, ValueError: no record in the folder, or a damaged one.
    """
    folder = Path(folder)
    record = read_record(folder)
    config = Config.from_dict(record["config"])
    dataset, vae = folder / "dataset", folder / VAE_FILE
    models, log = (VAE_FILE, MDN_RNN_FILE), evolution.LOG
    # Name -> the check, and the files without which there is nothing to check.
    checks: dict[str, tuple[Callable[[], str | None], tuple[str, ...]]] = {
        "record": (lambda: f"ok: {config.variant}", ()),
        "dataset": (lambda: verify_dataset(dataset), ()),
        "V": (lambda: check_seen(vae, check_vae(config, folder)["dataset"], dataset), (VAE_FILE,)),
        "M": (lambda: check_mdn_rnn(config, folder), (MDN_RNN_FILE,)),
        "log of CMA-ES": (lambda: verify_log(folder, config), (*models, log)),
        # A C that has lost its V or M fails.
        "C": (lambda: verify_controller(folder, config), (log, CONTROLLER_FILE)),
        "evaluations": (lambda: verify_evaluations(folder), ()),
        "episodes": (lambda: drive_again(folder, config, executor), (*models, CONTROLLER_FILE)),
    }
    here, found = provenance(""), {}
    for name, (check, needed) in checks.items():
        there = all((folder / file).exists() for file in needed)
        found[name] = outcome(check, record, here) if there else MISSING
    return found


def outcome(check: Callable[[], str | None], record: dict, here: dict) -> str:
    """What a check says, or "ok"; an error that it raises is a failure, if nothing excuses it."""
    try:
        return check() or "ok"
    except NotRepeated as error:
        made_with = error.args[1:] or starts(record)
        excuses = [other_machine(start, here) for start in made_with]
        excuse = "; ".join(dict.fromkeys(filter(None, excuses)))
        return f"differs: {error.args[0]}; {excuse}" if excuse else f"FAILED: {error.args[0]}"
    except (ValueError, KeyError, OSError, TaskError) as error:
        return f"FAILED: {error}"


def other_machine(made_with: dict, here: dict) -> str:
    """In what this machine differs from the recorded one, or may differ; empty if in nothing."""
    names = (*MACHINE, *PACKAGES)
    found = [
        f"{name} is {here[name]!r} and was {made_with[name]!r}"
        for name in (*names, "blas")  # which older records lack
        if name in made_with and here[name] != made_with[name]
    ]
    if unknown := [name for name in names if name not in made_with]:
        found.append(f"unknown, because not recorded: {', '.join(unknown)}")
    return ", ".join(found)


def verify_dataset(folder: Path) -> str:
    """Check every file of the dataset against the manifest."""
    if not (folder / MANIFEST).exists():
        return MISSING
    made, wanted = count_episodes(load_manifest(folder / MANIFEST))
    if made < wanted:
        return f"none: {made} of {wanted} episodes so far"
    dataset = Dataset(folder)
    return f"ok: {len(dataset.frames)} episodes, {len(dataset)} frames"


def logged(folder: Path, config: Config) -> tuple[Config, dict]:
    """The configuration, with the number of generations of the log of CMA-ES, and that log."""
    asked = load_json(folder / evolution.LOG, kind="evolution")["evolution"]["generations"]
    config = config.replace(evolution={"generations": asked})
    return config, evolution.read_log(config, folder, load_world_model(folder))


def verify_log(folder: Path, config: Config) -> str:
    """Replay the log of CMA-ES: it must give the logged means."""
    config, log = logged(folder, config)
    try:
        evolution.resume(config, folder, load_world_model(folder), log)
    except ValueError as error:
        share = replayed_distance(folder, config, log)
        if not share <= SHARE:
            raise ValueError(f"{error} (C moves by {share:.1e} of its way)") from error
        raise NotRepeated(f"{error} (C moves by {share:.1e} of its way)") from error
    return f"ok: {len(log['generations'])} generations give the same mean"


@threadpool_limits.wrap(limits=1)
def replayed_distance(folder: Path, config: Config, log: dict) -> float:
    """How far the log, replayed here, ends from the kept C, as a share of its way from the first.

    Infinite if no C is kept.
    """
    if (last := evolution.kept_generation(folder, log)) is None:
        return np.inf
    space = search_space(config, load_world_model(folder), folder)
    kept_part = log | {"generations": log["generations"][:last]}
    _, means = evolution.replay(space.first, config.evolution, kept_part, check=False)
    replayed = space.expand(evolution.averaged_mean(means, config.evolution))
    kept, _ = load_controller(folder / CONTROLLER_FILE)
    way = np.linalg.norm(kept - space.expand(space.first))
    return float(np.linalg.norm(replayed - kept) / way)


def verify_controller(folder: Path, config: Config) -> str:
    """Check that C is the one with the best validation in the log, and that this is the best."""
    _, log = logged(folder, config)
    validated = [entry for entry in log["generations"] if "validation" in entry]
    best = max(validated, key=lambda entry: entry["validation"]["mean"], default=None)
    expected = best and {
        "generation": best["generation"],
        "validation": float(np.mean(best["validation"]["returns"])),
    }
    kept = evolution.kept_generation(folder, log)
    if log["best"] != expected or best is None or kept != best["generation"]:
        raise ValueError(
            f"{folder / CONTROLLER_FILE} is of generation {kept}, the log names {log['best']}, and"
            f" its validations give {expected}"
        )
    return f"ok: C of generation {kept}"


def verify_evaluations(folder: Path) -> str:
    """Check the evaluations in the folder, and that they are of this C."""
    files = evaluations_of(folder)
    for file, found in files.items():
        if not is_of_agent(found, folder):
            raise ValueError(f"{file} is of another controller: evaluate again")
    return f"ok: {', '.join(file.name for file in files)}" if files else "none: not evaluated here"


def in_half(folder: Path) -> bool:
    """Whether V is kept in half precision, as an agent is shipped."""
    tensors, _ = load_tensors(folder / VAE_FILE)
    return any(tensor.dtype == torch.float16 for tensor in tensors.values())


def drive_again(folder: Path, config: Config, executor: Executor | None) -> str:
    """Drive recorded episodes again: of an evaluation, or of the validation that chose C."""
    parameters, _ = load_controller(folder / CONTROLLER_FILE)
    evaluations = list(evaluations_of(folder).values())
    if not evaluations and not (folder / evolution.LOG).exists():
        return MISSING
    official = [one for one in evaluations if one["renderer"] == "gymnasium"]
    chosen = [*official, *evaluations][:1]
    workers = worker_processes if official else worker_threads
    with workers(config.processes, executor) as executor:
        source = evolution.hand_out(executor, folder)
        if evaluations:
            episodes = chosen[0]["episodes"]
            numbers = np.linspace(0, len(episodes) - 1, min(AGAIN, len(episodes))).astype(int)
            recorded = [episodes[number]["return"] for number in numbers]
            tracks = [[episodes[number]["track"]] for number in numbers]
            tasks = [(source, parameters, track, not official) for track in tracks]
            found = run_in_order(executor, evolution.drive_group, tasks)
            driven = [float(returns[0]) for returns, _ in found]
        elif in_half(folder):  # the validations were driven in full precision
            return "none: V and M are in half precision: evaluate the agent first"
        else:  # `validate` drives all of its tracks
            _, log = logged(folder, config)
            kept = evolution.kept_generation(folder, log)
            assert kept is not None  # there is a controller
            entry = log["generations"][kept - 1]
            recorded = entry["validation"]["returns"][:AGAIN]
            driven = evolution.validate(executor, source, config, parameters)["returns"][:AGAIN]
    if driven != recorded:
        message = f"the record says {recorded}, now it was {driven}"
        if not np.median(np.abs(np.subtract(driven, recorded))) <= POINTS:
            raise ValueError(f"{message}: rounding alone does not explain it")
        made_with = [one["made_with"] for one in chosen if "made_with" in one]
        raise NotRepeated(message, *made_with)
    return f"ok: {', '.join(f'{value:.1f}' for value in driven)} points, bit-identical"
