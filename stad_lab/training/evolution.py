"""CMA-ES over C: ask for a population, let it drive, tell the returns, validate, log.

The log is the state: CMA-ES's mean, covariance, step size and random state follow from the seed and
the fitnesses that it was told. A resumed run tells a new strategy every logged generation again,
which takes seconds and no driving, and continues bit-identically on the same machine and versions.
All of it runs on one thread: the last bits of an eigendecomposition depend on how many there are.
"""

import dataclasses
import math
import zlib
from concurrent.futures import Executor
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from threadpoolctl import threadpool_limits
from tqdm.auto import tqdm

from stad_lab.agent import Agent, Episodes, drive
from stad_lab.config import STREAMS, Config, EvolutionConfig, check_same, track_seeds
from stad_lab.io import weights
from stad_lab.io.files import load_json, locked, save_json
from stad_lab.io.weights import CONTROLLER_FILE, WorldModel, load_world_model
from stad_lab.io.workers import run_in_order, single_thread, worker_threads
from stad_lab.models.controller import unpack
from stad_lab.training.subspace import SearchSpace, search_space
from stad_lab.training.trainer import Watch

if TYPE_CHECKING:
    from cma import CMAEvolutionStrategy as Strategy

LOG = "evolution.json"
# A hard track may be replayed from the last so many generations, without the very last ones.
REMEMBERED, RESTING = 20, 4


class DrivingModel(Protocol):
    """What `evolve` drives with in place of a world model, if C is to see something else."""

    sizes: tuple[int, int]  # how many numbers z has, and how many C sees beside it
    checksums: dict[str, str]  # what a log and a controller must belong to

    def drive(self, parameters: np.ndarray, tracks: list[int], **limits) -> Episodes:
        """Drive each track once, with its row of `parameters`, as `stad_lab.agent.drive`."""


@dataclasses.dataclass
class Evolution:
    """A CMA-ES run: its configuration, its log, and the state that follows from the log."""

    config: Config
    folder: Path
    world_model: WorldModel | DrivingModel
    space: SearchSpace
    log: dict
    strategy: "Strategy"
    means: list[np.ndarray]  # after every generation, float64 (dimensions,)

    def controller(self, generation: int | None = None) -> np.ndarray:
        """C as found so far, or up to a generation: float64 (parameters,)."""
        return self.space.expand(averaged_mean(self.means[:generation], self.config.evolution))


def evolve(
    config: Config, folder: Path, executor: Executor | None = None, watch: Watch | None = None,
    drives: DrivingModel | None = None,
) -> bool:  # fmt: skip
    """Evolve C for the V and M in `folder`; False if the run was complete already.

    The candidates of a generation drive the same tracks; their fitness is their mean return. Every
    few generations the averaged CMA mean drives the validation tracks, and the best one so far is
    kept: to keep the best *candidate* would be to keep the one with the easiest tracks.

    Args:
        executor: where episodes run; None for `config.processes` threads of this machine.
        watch: called with the log's generations after each, and first with those already there.
        drives: what drives instead of the V and M in `folder`; on this machine alone.

    Raises:
        ValueError: a file in `folder` is damaged or of another run, or an action is not finite.
        OSError: another process works in the folder, or a file cannot be read or written.
        TaskError: an episode failed, or no worker answers.
    """
    folder, settings = Path(folder), config.evolution
    world_model = drives or load_world_model(folder)
    log = read_log(config, folder, world_model)
    kept, done = kept_generation(folder, log), len(log["generations"])
    if watch and done:
        watch(log["generations"])
    chosen = log["best"] and log["best"]["generation"]
    if chosen and kept == chosen and done >= settings.generations:
        return False
    workers = worker_threads(config.processes, executor)  # restores the threads of before the limit
    with locked(folder), workers as executor, threadpool_limits(1):
        run = resume(config, folder, world_model, log)
        if chosen and kept != chosen:
            keep_controller(run, run.controller(chosen))
        source = drives or hand_out(executor, folder)
        label, last = f"evolve C ({config.variant})", settings.generations
        bar = tqdm(range(done, last), label, last, initial=done)
        for _ in bar:
            run_generation(run, executor, source)
            worst, mean, best = fitness_curves(log["generations"][-1:])[:, 0]
            bar.set_postfix_str(f"worst {worst:.0f}, mean {mean:.0f}, best {best:.0f}")
            if watch:
                watch(log["generations"])
    return True


def run_generation(run: Evolution, executor: Executor, source: Any) -> None:
    """Ask, drive, tell, validate if it is time, and write the log and a better C."""
    settings, generations = run.config.evolution, run.log["generations"]
    population = ask(run.strategy, settings, len(generations))
    candidates = run.space.expand(population)
    entry = drive_generation(executor, source, run.config, generations, candidates)
    tell(run.strategy, population, entry["returns"], run.means)
    # Sigma as CMA-ES leaves it; with `sigma_decay` the next `ask` overwrites it.
    entry |= {"sigma": float(run.strategy.sigma), "mean_checksum": crc(run.strategy.mean)}
    if entry["generation"] % settings.validate_every == 0:
        entry["validation"] = validate(executor, source, run.config, run.controller())
    generations.append(entry)
    better = note_best(run.log)
    save_json(run.folder / LOG, run.log)
    if better:  # after the log, so that every kept C is in the log
        keep_controller(run, run.controller())


def read_log(config: Config, folder: Path, world_model: WorldModel | DrivingModel) -> dict:
    """The log of the run in `folder`, or a new one; ValueError if it is damaged or does not fit."""
    path, settings = folder / LOG, dataclasses.asdict(config.evolution)
    made_with = {"variant": config.variant, "seed": config.seed, "evolution": settings}
    if not path.exists():
        spawn_key = [STREAMS.index("evolution"), config.evolution.seed]
        return {
            "kind": "evolution",
            **made_with,
            "random": {"entropy": config.seed, "spawn_key": spawn_key},
            **world_model.checksums,
            "best": None,
            "generations": [],
        }
    log = load_json(path, "move it and the controller away to evolve C again", kind="evolution")
    free = ("generations", "cars")  # neither changes what was driven
    fixed = {name: value for name, value in settings.items() if name not in free}
    check_same(path, log, made_with | {"evolution": fixed})
    weights.check_belongs(path, log, **world_model.checksums)
    done, asked = len(log["generations"]), config.evolution.generations
    if done > asked:
        raise ValueError(
            f"{path} holds {done} generations, and now evolution.generations={asked}: ask for at"
            " least as many, or choose another folder"
        )
    return log | {"evolution": settings}


@threadpool_limits.wrap(limits=1)
def resume(config: Config, folder: Path, world_model: WorldModel, log: dict) -> Evolution:
    """The run as its log left it.

    Raises:
        ValueError: the log was changed, comes from another machine, or its last validated C does
            not follow from the search space in `folder`.
    """
    space, generations = search_space(config, world_model, folder), log["generations"]
    strategy, means = replay(space.first, config.evolution, log)
    run = Evolution(config, folder, world_model, space, log, strategy, means)
    validated = [entry for entry in generations if "validation" in entry]
    if validated:
        last = validated[-1]
        if crc(run.controller(last["generation"])) != last["validation"]["controller_checksum"]:
            raise ValueError(
                f"{folder} holds other components, or another first C, than the run in"
                f" {folder / LOG} had: restore the right files, or start in a new folder"
            )
    return run


def make_strategy(start: np.ndarray, settings: EvolutionConfig, random: dict) -> "Strategy":
    """pycma's strategy from `start`, float64 (dimensions,); its SeedSequence takes `random`.

    The rule that adapts the step size is set explicitly: pycma's default has changed between its
    versions, and depends on the number of dimensions. CSA compares the length of the mean's path
    with that of a random walk; TPA compares two candidates ahead of the mean and behind it.
    """
    import cma  # here, because it takes two seconds and drivers do not need it
    from cma import sigma_adaptation

    rules = {"CSA": sigma_adaptation.CMAAdaptSigmaCSA, "TPA": sigma_adaptation.CMAAdaptSigmaTPA}
    rng = np.random.default_rng(np.random.SeedSequence(**random))
    options = {
        "popsize": settings.population,
        "randn": lambda *shape: rng.standard_normal(shape),
        "seed": np.nan,  # "do nothing": leave NumPy's global generator alone
        "AdaptSigma": rules[settings.step_size_rule],
        "verbose": -9,
        "verb_log": 0,
    }
    return cma.CMAEvolutionStrategy(start, settings.sigma, options)


def ask(strategy: "Strategy", settings: EvolutionConfig, generation: int) -> np.ndarray:
    """The population of a generation, counted from 0: float64 (candidates, dimensions).

    With `sigma_decay` the step size follows a schedule: in hundreds of dimensions CMA-ES takes
    dozens of generations to adapt it.
    """
    if settings.sigma_decay:
        strategy.sigma = settings.sigma * settings.sigma_decay**generation
    return np.array(strategy.ask())


def tell(strategy: "Strategy", population: np.ndarray, returns: list, means: list) -> None:
    """Tell CMA-ES, which minimises, the returns (candidates, tracks); adds its mean to `means`."""
    strategy.tell(population, [-np.mean(own) for own in returns])
    means.append(strategy.mean.copy())


@threadpool_limits.wrap(limits=1)
def replay(
    start: np.ndarray, settings: EvolutionConfig, log: dict, check: bool = True
) -> tuple["Strategy", list[np.ndarray]]:
    """A strategy that was told every logged generation, and its mean after each.

    ValueError if a mean is not the logged one, unless `check` is False.
    """
    strategy, means = make_strategy(start, settings, log["random"]), list[np.ndarray]()
    for number, entry in enumerate(log["generations"]):
        population = ask(strategy, settings, number)
        tell(strategy, population, entry["returns"], means)
        if check and crc(strategy.mean) != entry["mean_checksum"]:
            raise ValueError(
                f"replaying the log gives another mean in generation {number + 1}: the log was"
                " changed, or is of another machine or other versions. Move it and C away"
            )
    return strategy, means


def averaged_mean(means: list[np.ndarray], settings: EvolutionConfig) -> np.ndarray:
    """Polyak average of the last `averaged_share` of the means, float64 (dimensions,)."""
    return np.mean(means[-max(1, round(settings.averaged_share * len(means))) :], axis=0)


def kept_generation(folder: Path, log: dict) -> int | None:
    """The generation of the kept C; None if none is kept, ValueError if it is not in the log."""
    path = folder / CONTROLLER_FILE
    if not path.exists():
        return None
    parameters, metadata = weights.load_controller(path)
    generation = metadata.get("generation")
    validated = [entry for entry in log["generations"] if "validation" in entry]
    known = {one["generation"]: one["validation"]["controller_checksum"] for one in validated}
    if crc(parameters) != known.get(generation):
        raise ValueError(
            f"{path} does not come from the run in {folder / LOG}: move it away, and the same"
            " command writes the right one"
        )
    return generation


def note_best(log: dict) -> bool:
    """Note the generation with the best validation; True if it is the last one."""
    last = log["generations"][-1]
    mean = last["validation"]["mean"] if "validation" in last else -math.inf
    if mean <= (log["best"]["validation"] if log["best"] else -math.inf):
        return False
    log["best"] = {"generation": last["generation"], "validation": mean}
    return True


def keep_controller(run: Evolution, controller: np.ndarray) -> None:
    """Write C, float64 (parameters,), with its generation and the checksums of V and M."""
    metadata = {"variant": run.config.variant, **run.log["best"], **run.world_model.checksums}
    weights.save_controller(run.folder / CONTROLLER_FILE, controller, **metadata)


def crc(vector: np.ndarray) -> int:
    """CRC-32 of the bytes of a float64 vector: vectors that differ in it are not bit-identical."""
    return zlib.crc32(np.ascontiguousarray(vector).tobytes())


def generation_tracks(config: Config, earlier: list[dict]) -> list[int]:
    """The tracks of the generation after the `earlier` ones: new ones, and some hard ones again.

    On an easy track the fastest candidates win, even if they lose hundreds of points elsewhere. So
    a share `replay_share` of the tracks is replayed: those on which the candidates' mean return was
    lowest when last driven, among the last REMEMBERED generations without the last RESTING ones. It
    is a simple form of prioritized level replay (Jiang, Grefenstette and Rocktaschel, 2021).
    """
    settings, number = config.evolution, len(earlier)
    new = track_seeds("evolve", settings.tracks, config.seed, number, settings.seed)
    share = settings.tracks * settings.replay_share
    replayed = int((number + 1) * share) - int(number * share)
    if not replayed:
        return new
    last_mean: dict[int, float] = {}
    for entry in earlier[-REMEMBERED:]:
        last_mean |= dict(zip(entry["tracks"], np.mean(entry["returns"], axis=0), strict=True))
    resting = {track for entry in earlier[-RESTING:] for track in entry["tracks"]}
    hard = sorted(last_mean.keys() - resting, key=lambda track: last_mean[track])
    return (hard[:replayed] + new)[: settings.tracks]


def drive_generation(
    executor: Executor, source: Any, config: Config, earlier: list[dict], candidates: np.ndarray
) -> dict:
    """Let every candidate drive the next generation's tracks; returns its entry of the log.

    `source` is from `hand_out`; `candidates` are controllers, float64 (candidates, parameters).
    """
    tracks = generation_tracks(config, earlier)
    repeated = np.repeat(candidates, len(tracks), axis=0), tracks * len(candidates)
    returns, lengths = drive_parallel(executor, source, config.evolution, *repeated)
    return {
        "generation": len(earlier) + 1,
        "tracks": tracks,
        "returns": returns.reshape(len(candidates), len(tracks)).tolist(),
        "frames": int(lengths.sum()),
    }


def validate(executor: Executor, source: Any, config: Config, controller: np.ndarray) -> dict:
    """Drive C, float64 (parameters,), on the validation tracks; returns its entry of the log."""
    tracks = track_seeds("validate", config.evolution.validation_tracks)  # for every seed the same
    copies = np.repeat(controller[None], len(tracks), axis=0)
    settings = dataclasses.replace(config.evolution, patience=0)  # as in the evaluation
    returns, lengths = drive_parallel(executor, source, settings, copies, tracks)
    return {
        "mean": float(returns.mean()),
        "returns": returns.tolist(),
        "frames": int(lengths.sum()),
        "controller_checksum": crc(controller),
    }


def drive_parallel(
    executor: Executor, source: Any, settings: EvolutionConfig, parameters: np.ndarray, tracks: list
) -> tuple[np.ndarray, np.ndarray]:
    """Returns and lengths in frames, (episodes,), of an episode for each row of `parameters`.

    The cars drive in groups of at most `settings.cars`. The groups do not depend on the number of
    threads, so neither do the results.
    """
    size = min(settings.cars, math.ceil(len(tracks) / 2))  # so that two cores have work
    groups = [slice(start, start + size) for start in range(0, len(tracks), size)]
    limits = {"max_frames": settings.max_frames, "patience": settings.patience}
    tasks = [(source, parameters[group], tracks[group], True, limits) for group in groups]
    found = run_in_order(executor, drive_group, tasks)
    returns, lengths = zip(*found, strict=True)
    return np.concatenate(returns), np.concatenate(lengths)


def drive_group(
    source: Path | WorldModel | DrivingModel,
    parameters: np.ndarray,
    tracks: list[int],
    fast: bool = True,
    limits: dict | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Drive a group of cars: returns and lengths in frames, (cars,) each. Runs in a worker."""
    single_thread()
    if not isinstance(source, Path | WorldModel):
        return source.drive(parameters, tracks, **limits or {})[:2]
    episodes = drive(make_agent(source, parameters), tracks, fast, **limits or {})
    return episodes.returns, episodes.lengths


def hand_out(executor: Executor, source: Path | WorldModel) -> Any:
    """V and M in the form that tasks are given: on this machine, `source` itself.

    A cluster may share no disk: its executor's `share` brings V and M once to every worker.
    """
    share = getattr(executor, "share", None)
    if not share:
        return source
    return share(source if isinstance(source, WorldModel) else load_world_model(source))


def make_agent(source: Path | WorldModel, parameters: np.ndarray) -> Agent:
    """An agent of the V and M from `hand_out` and of C; without M's memory if no C sees h."""
    world_model = source if isinstance(source, WorldModel) else load_world_model(source)
    sees_hidden = unpack(parameters)[0][..., world_model.vae.latent_size :].any()
    return Agent(world_model, parameters, remembers=bool(sees_hidden))


def fitness_curves(generations: list[dict]) -> np.ndarray:
    """Worst, mean and best fitness (a candidate's mean return), float64 (3, generations)."""
    fitness = [np.mean(entry["returns"], axis=1) for entry in generations]
    return np.array([[own.min(), own.mean(), own.max()] for own in fitness]).T
