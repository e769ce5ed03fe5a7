"""CMA-ES over C: ask for a population, let it drive in parallel, tell the returns, log, and go on.

The log is the state. CMA-ES is deterministic: its mean, step size, covariance, paths and random state follow from the
seed and the fitnesses it was told. So a resumed run tells a new strategy every logged generation again (no car drives
for that, it takes seconds) and then stands exactly where the old one stood, on the same machine and with the same
versions of cma and numpy. Nothing has to be unpickled. All this runs on one thread, because the last bits of an
eigendecomposition depend on the number of threads.
"""

import dataclasses
import math
import zlib
from collections.abc import Callable
from concurrent.futures import Executor
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from threadpoolctl import threadpool_limits
from tqdm.auto import tqdm

from stad_lab.agent import (
    CONTROLLER,
    Agent,
    WorldModel,
    drive,
    load_controller,
    load_world_model,
    read_world_model,
    save_controller,
)
from stad_lab.config import Settings, check_same_run
from stad_lab.io.files import load_json, locked, save_json
from stad_lab.io.workers import (
    refuse_in_starting_worker,
    return_freed_memory,
    run_in_order,
    work_alone,
    worker_processes,
)
from stad_lab.models.mdn_rnn import check_partner
from stad_lab.training.dataset import track_seeds
from stad_lab.training.subspace import SearchSpace, search_space

if TYPE_CHECKING:
    import cma

LOG = "evolution.json"
REMEMBERED, RESTING = (
    20,
    4,
)  # generations from which a hard track may be driven again, and the last ones, which rest


def evolve(
    variant: str,
    settings: Settings,
    folder: Path,
    executor: Executor | None = None,
    watch: Callable[[list[dict]], None] | None = None,
) -> bool:
    """Evolve C for the V and M in `folder`; writes `evolution.json` after every generation and the best C found.

    Every agent of a generation drives the same few tracks; its fitness is its mean return. From time to time the mean
    of the search distribution, or the average of its last means, drives the validation tracks, and the best one so far
    is kept as `controller.safetensors`: choosing the best *agent* instead would choose the luckiest.

    Args:
        executor: who drives; None for `settings.processes` processes of this machine.
        watch: called with the log's generations after each of them is on the disk, and with those of an earlier call.

    Returns:
        False if the run was complete already, True if there was something to do.

    Raises:
        ValueError: a file in `folder` is damaged, of another run, or of other settings; or an action is not finite.
        OSError: another process works in the folder, or a file cannot be read or written.
        TaskError: a drive failed, or no worker answers.
        KeyboardInterrupt: passed on; the log holds every finished generation.
    """
    refuse_in_starting_worker()
    folder = Path(folder)
    world_model = read_world_model(folder, variant)
    log = read_log(variant, settings, folder, world_model)
    kept = kept_generation(variant, folder, log)
    if watch and log["generations"]:
        watch(log["generations"])
    if (
        log["best"]
        and kept == log["best"]["generation"]
        and len(log["generations"]) >= settings.generations
    ):
        return False
    space = search_space(settings, world_model, folder)
    with (
        locked(folder),
        threadpool_limits(1),
        worker_processes(settings.processes, executor) as executor,
    ):
        strategy, means = resume(variant, settings, folder, log, world_model, space, kept)
        source = hand_out(executor, folder, variant)
        done = len(log["generations"])
        progress = tqdm(
            range(done, settings.generations),
            f"evolve C ({variant})",
            settings.generations,
            initial=done,
        )
        for _ in progress:
            entry = run_generation(
                log["generations"], strategy, means, space, executor, source, variant, settings
            )
            log["generations"].append(entry)
            better = note_best(log)
            save_json(folder / LOG, log)
            if better:  # after the log: a controller that the log does not know would be a stranger
                keep_controller(
                    variant, folder, log, space.expand(averaged_mean(means, settings)), world_model
                )
            worst, average, best = fitness_curves([entry])[:, 0]
            progress.set_postfix_str(f"worst {worst:.0f}, average {average:.0f}, best {best:.0f}")
            if watch:
                watch(log["generations"])
    return True


def run_generation(
    earlier: list[dict],
    strategy: "cma.CMAEvolutionStrategy",
    means: list[np.ndarray],
    space: SearchSpace,
    executor: Executor,
    source: Any,
    variant: str,
    settings: Settings,
) -> dict:
    """Ask for a population, let it drive, and tell its fitness; adds to the means, returns the log's entry.

    The means, before and after, are float64 (searched,) each.

    Its "sigma" is the step size that CMA-ES would take next, which `settings.sigma_decay` overrules (see `ask`).
    """
    population = ask(strategy, settings, len(earlier))
    entry = drive_generation(executor, source, variant, settings, earlier, space.expand(population))
    tell(strategy, population, entry["returns"], means)
    entry |= {"sigma": float(strategy.sigma), "mean_checksum": vector_checksum(strategy.mean)}
    if entry["generation"] % settings.validate_every == 0:
        controller = space.expand(averaged_mean(means, settings))
        entry["validation"] = validate(executor, source, variant, settings, controller)
    return entry


def resume(
    variant: str,
    settings: Settings,
    folder: Path,
    log: dict,
    world_model: WorldModel,
    space: SearchSpace,
    kept: int | None,
) -> tuple["cma.CMAEvolutionStrategy", list[np.ndarray]]:
    """The strategy and its means as the log left them; makes `controller.safetensors` again if it is not the best."""
    strategy, means = replay(space.first, settings, log["generations"])
    check_space(folder, settings, space, log["generations"], means)
    if log["best"] and log["best"]["generation"] != kept:
        best = averaged_mean(means[: log["best"]["generation"]], settings)
        keep_controller(variant, folder, log, space.expand(best), world_model)
    return strategy, means


@threadpool_limits.wrap(limits=1)
def check_space(
    folder: Path,
    settings: Settings,
    space: SearchSpace,
    generations: list[dict],
    means: list[np.ndarray],
) -> None:
    """Raise ValueError if the last validated C is not what this search space makes of the means up to it."""
    last = max(
        (number for number, entry in enumerate(generations, 1) if "validation" in entry), default=0
    )
    if not last:
        return
    found = vector_checksum(space.expand(averaged_mean(means[:last], settings)))
    if found != generations[last - 1]["validation"]["controller_checksum"]:
        raise ValueError(
            f"{folder} holds other components, or another start, than the search in {folder / LOG} had: put the"
            " right files back, or start in a new folder"
        )


def averaged_mean(means: list[np.ndarray], settings: Settings) -> np.ndarray:
    """The average of the last `averaged_share` of the means, of one at least: the controller that a search has found.

    The means and their average are float64 (searched,).

    The noise of the returns drives the mean about; what several means have in common is what was learned (Polyak's
    averaging).
    """
    return np.mean(means[-max(1, round(settings.averaged_share * len(means))) :], axis=0)


def read_log(variant: str, settings: Settings, folder: Path, world_model: WorldModel) -> dict:
    """The log of the run in `folder`, or a new one.

    Raises:
        ValueError: it is damaged, was made with other settings, another V or another M, or is longer than asked for.
    """
    new = {
        "variant": variant,
        "settings": settings.as_dict(),
        **world_model.identities,
        "best": None,
    }
    if not (folder / LOG).exists():
        return new | {"generations": []}
    log = load_json(folder / LOG, f"evolve C again, with {CONTROLLER} moved away, too")
    made = {"variant": log["variant"], **log["settings"]}
    check_same_run(folder / LOG, made, {"variant": variant, **new["settings"]})
    check_partner(folder / LOG, log, **world_model.identities)
    if len(log["generations"]) > settings.generations:
        raise ValueError(
            f"{folder / LOG} holds {len(log['generations'])} generations, and now generations={settings.generations} is"
            " asked for: ask for at least as many, or choose another folder"
        )
    return log | {"settings": new["settings"]}


def kept_generation(variant: str, folder: Path, log: dict) -> int | None:
    """The generation after which `controller.safetensors` was found, by the log; None if there is no such file.

    Raises:
        ValueError: it is damaged, or the log does not know it.
    """
    path = folder / CONTROLLER
    if not path.exists():
        return None
    parameters, facts = load_controller(path, variant)
    validated = {
        entry["generation"]: entry["validation"]["controller_checksum"]
        for entry in log["generations"]
        if "validation" in entry
    }
    generation = facts.get("generation")
    if vector_checksum(parameters) != validated.get(generation):
        raise ValueError(
            f"{path} does not come from the run that {folder / LOG} tells of: move it away, and the same command makes"
            " the right one"
        )
    return generation


def note_best(log: dict) -> bool:
    """Note in the log after which generation the validation tracks were driven best; True if it is the last one."""
    last = log["generations"][-1]
    if "validation" not in last or (
        log["best"] and last["validation"]["mean"] <= log["best"]["validation"]
    ):
        return False
    log["best"] = {"generation": last["generation"], "validation": last["validation"]["mean"]}
    return True


def keep_controller(
    variant: str, folder: Path, log: dict, controller: np.ndarray, world_model: WorldModel
) -> None:
    """Write C, float64 (parameters,), with what it has to do with the log and with V and M."""
    save_controller(
        folder / CONTROLLER, controller, variant=variant, **log["best"], **world_model.identities
    )


def make_strategy(start: np.ndarray, settings: Settings) -> "cma.CMAEvolutionStrategy":
    """pycma's strategy from `start`, float64 (searched,), with a Generator of its own: nothing else can disturb it.

    Below 300 parameters pycma adapts the step size by the length of the mean's path. From there on it sets two agents
    of a generation on the line of the mean's last move, one ahead of the mean and one behind it, and lengthens the step
    if in the last few generations the one ahead has ranked better (two-point adaptation).

    NumPy fills up a seed with zeros: with evolution_seed 0 its numbers are those of the random driver's fourth episode.
    They are used for such different things that nothing follows from it.
    """
    import cma  # here, because it takes two seconds, and the workers that drive have no use for it

    rng = np.random.default_rng([settings.seed, 3, settings.evolution_seed])
    options = {
        "popsize": settings.population,
        "randn": lambda *shape: rng.standard_normal(shape),
        "seed": np.nan,  # "do nothing": leave NumPy's global generator alone
        "verbose": -9,
        "verb_log": 0,
    }
    return cma.CMAEvolutionStrategy(start, settings.sigma, options)


def ask(strategy: "cma.CMAEvolutionStrategy", settings: Settings, generation: int) -> np.ndarray:
    """The population of a generation, float64 (agents, searched).

    CMA-ES finds out by itself how far to step, but in hundreds of dimensions that takes it dozens of generations; with
    `settings.sigma_decay` the step size follows a plan instead.
    """
    if settings.sigma_decay:
        strategy.sigma = settings.sigma * settings.sigma_decay**generation
    return np.array(strategy.ask())


def tell(
    strategy: "cma.CMAEvolutionStrategy", population: np.ndarray, returns: list, means: list
) -> None:
    """Tell CMA-ES, which minimises, what each agent of a population has returned on its tracks; adds to the means."""
    strategy.tell(population, [-np.mean(own) for own in returns])
    means.append(strategy.mean.copy())


@threadpool_limits.wrap(limits=1)
def replay(
    start: np.ndarray, settings: Settings, generations: list[dict]
) -> tuple["cma.CMAEvolutionStrategy", list[np.ndarray]]:
    """A strategy that has been told all logged generations, the full state of the interrupted run, and all its means.

    Raises:
        ValueError: the state is not the logged one, because the log was changed or comes from another machine.
    """
    strategy, means = make_strategy(start, settings), []
    for number, entry in enumerate(generations):
        population = ask(strategy, settings, number)
        tell(strategy, population, entry["returns"], means)
        if vector_checksum(strategy.mean) != entry["mean_checksum"]:
            raise ValueError(
                f"replaying the log gives another mean in generation {number + 1} than the run had: the log was"
                " changed, or made on another machine or by other versions of cma and numpy. Start in a new folder"
            )
    return strategy, means


def vector_checksum(vector: np.ndarray) -> int:
    """CRC-32 of the bytes of CMA-ES's mean or of a C, float64: two that agree in it agree to the last bit."""
    return zlib.crc32(np.ascontiguousarray(vector).tobytes())


def hand_out(executor: Executor, folder: Path, variant: str) -> Any:
    """What tells a worker which V and M to drive with.

    On this machine that is their folder. On a cluster there may be no common disk: V and M themselves, which the
    executor's `share` brings once to every worker that needs them.
    """
    share = getattr(executor, "share", None)
    return share(read_world_model(folder, variant)) if share else Path(folder)


def generation_tracks(settings: Settings, earlier: list[dict]) -> list[int]:
    """The tracks of the generation after the `earlier` ones: new ones, and some hard ones again.

    Ranks say who was better, not by how much. On an easy track the fastest agents win, and that they lose hundreds of
    points elsewhere counts in no rank. So a share `revisited_share` of the tracks, one by one, goes back to the one on
    which the average agent did worst when it was last driven, among those of the last REMEMBERED generations, without
    the last RESTING ones (a simple form of prioritised level replay: Jiang, Grefenstette and Rocktaschel, 2021). With
    one track a generation, those with a new track and with a hard one take turns.
    """
    number, count, share = len(earlier), settings.tracks, settings.revisited_share
    new = track_seeds("evolve", count, settings.seed, number, settings.evolution_seed)
    back = int((number + 1) * count * share) - int(number * count * share)
    if not back:
        return new
    last_average = {}
    for entry in earlier[-REMEMBERED:]:
        last_average |= dict(zip(entry["tracks"], np.mean(entry["returns"], axis=0), strict=True))
    resting = {track for entry in earlier[-RESTING:] for track in entry["tracks"]}
    hard = sorted(last_average.keys() - resting, key=last_average.get)
    return (hard[:back] + new)[:count]


def drive_generation(
    executor: Executor,
    source: Any,
    variant: str,
    settings: Settings,
    earlier: list[dict],
    population: np.ndarray,
) -> dict:
    """Let every agent drive the tracks of the generation after the `earlier` ones: the log's entry.

    Its "returns" are [agent][track].
    """
    tracks = generation_tracks(settings, earlier)
    agents = np.repeat(population, len(tracks), axis=0)
    returns, lengths = drive_parallel(
        executor, source, variant, agents, tracks * len(population), settings
    )
    shape = (len(population), len(tracks))
    return {
        "generation": len(earlier) + 1,
        "tracks": tracks,
        "returns": returns.reshape(shape).tolist(),
        "frames": int(lengths.sum()),
    }


def validate(
    executor: Executor, source: Any, variant: str, settings: Settings, controller: np.ndarray
) -> dict:
    """Drive a controller, float64 (parameters,), on the validation tracks.

    Returns its mean return, all returns, the frames, and which one it was.
    """
    tracks = track_seeds("validate", settings.validation_tracks)  # the same ones for every seed
    copies = np.repeat(controller[None], len(tracks), axis=0)
    patient = dataclasses.replace(
        settings, patience=0
    )  # nobody is given up on, as in the final evaluation
    returns, lengths = drive_parallel(executor, source, variant, copies, tracks, patient)
    return {
        "mean": float(returns.mean()),
        "returns": returns.tolist(),
        "frames": int(lengths.sum()),
        "controller_checksum": vector_checksum(controller),
    }


def drive_parallel(
    executor: Executor,
    source: Any,
    variant: str,
    parameters: np.ndarray,
    tracks: list[int],
    settings: Settings,
) -> tuple[np.ndarray, np.ndarray]:
    """Drive one episode for each row of `parameters` (episodes, parameters): (returns, lengths in frames).

    They drive in groups of at most `settings.cars`, under its max_frames and patience, and in two groups if there are
    two episodes, so that two cores have work. The groups do not depend on how many processes share them, so neither do
    the numbers.
    """
    size = min(settings.cars, math.ceil(len(tracks) / 2))
    groups = [slice(start, start + size) for start in range(0, len(tracks), size)]
    tasks = [
        (source, variant, parameters[group], tracks[group], True, settings) for group in groups
    ]
    return tuple(
        np.concatenate(part)
        for part in zip(*run_in_order(executor, drive_group, tasks), strict=True)
    )


def drive_group(
    source: Path | WorldModel,
    variant: str,
    parameters: np.ndarray,
    tracks: list[int],
    fast: bool,
    limits: Settings | None,
) -> tuple[np.ndarray, np.ndarray]:
    """What a worker process does: load V and M once, drive a group of cars in step."""
    work_alone()
    agent = make_agent(source, variant, parameters)
    rules = {"max_frames": limits.max_frames, "patience": limits.patience} if limits else {}
    return_freed_memory()
    return drive(agent, tracks, fast, **rules)


def make_agent(source: Path | WorldModel, variant: str, parameters: np.ndarray) -> Agent:
    """An agent of the V and M that `hand_out` tells of, and of C."""
    world_model = source if isinstance(source, WorldModel) else load_world_model(source, variant)
    autoencoder, mdn_rnn, stride, crop_bar, _ = world_model
    return Agent(autoencoder, mdn_rnn, parameters, stride, crop_bar)


def fitness_curves(generations: list[dict]) -> np.ndarray:
    """Worst, average and best fitness of every generation, (3, generations): the paper's three figures.

    A fitness is an agent's mean return over its tracks.
    """
    fitness = [np.mean(entry["returns"], axis=1) for entry in generations]
    return np.array([[f.min(), f.mean(), f.max()] for f in fitness]).T
