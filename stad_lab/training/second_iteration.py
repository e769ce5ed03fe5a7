"""A second iteration of the world model: V and M learn from what the first agent sees.

The random driver soon leaves the road, so the first V and M have hardly seen the road at speed,
which is nearly all that their agent sees. In a second iteration that agent drives for the dataset
too, and V and M are retrained. The new V has other latents, on which the old C is useless, so a
ridge regression finds the C whose outputs on the new z and h are those of the old C on the recorded
episodes, and evolution starts there. (World Models, section 5, proposes such iterations.)
"""

from collections.abc import Callable
from concurrent.futures import Executor
from pathlib import Path

import numpy as np

from stad_lab.agent import Agent, load_agent
from stad_lab.config import Config, random_stream, track_seeds
from stad_lab.envs.cars import Cars
from stad_lab.features import features_of
from stad_lab.io.files import checksum_of_arrays
from stad_lab.io.weights import (
    CONTROLLER_FILE,
    WorldModel,
    load_controller,
    load_kind,
    load_world_model,
)
from stad_lab.io.workers import single_thread, worker_threads
from stad_lab.models.controller import seen_columns, unpack
from stad_lab.training.dataset import (
    Dataset,
    Episode,
    collect_episodes,
    drive_randomly,
    made_with,
    record_frames,
)
from stad_lab.training.evolution import hand_out, make_agent
from stad_lab.training.ridge import fit_ridge
from stad_lab.training.subspace import START_FILE, load_start, save_start

NOISE = 0.1  # mean deviation of what each frame adds to the noise, whose own is 2.3 times that
LIMIT = 2.5  # of C's outputs before squashing, as targets: tanh(2.5) is 0.987
PENALTY = 0.01  # of the ridge regression, for each frame


def collect_again(
    config: Config, earlier: Path, folder: Path, executor: Executor | None = None
) -> bool:
    """Collect a dataset of the random driver and of the agent of the run in `earlier`.

    The random driver's episodes are those of a first iteration with the same configuration; the
    agent's are mixed among them. Executor, result and errors are those of `collect`.
    """
    parameters, _ = load_controller(earlier / CONTROLLER_FILE)
    agent = {"variant": config.variant, "controller": checksum_of_arrays(parameters=parameters)}
    order, data = order_of_episodes(config), config.data
    limits = data.episode_frames, data.agent_frames
    longest = [limits[number >= data.episodes] for number in order]
    with worker_threads(config.processes, executor) as executor:
        source = hand_out(executor, earlier)
        tasks = [(source, parameters, config, number) for number in order]
        depends_on = {**made_with(config), "agent": agent}
        return collect_episodes(folder, depends_on, drive_either, tasks, longest, executor)


def check_earlier_agent(config: Config, earlier: Path) -> None:
    """Raise ValueError unless the earlier agent is of this variant and sees the same frames."""
    world_model = load_agent(Path(earlier)).world_model
    variant, crop_bar = world_model.vae.variant, world_model.crop_bar
    if variant != config.variant:
        found = f"variant={config.variant!r}, but the run in {earlier} is of {variant!r}"
        raise ValueError(f"{found}: give a run of the same variant")
    if crop_bar != config.data.crop_bar:
        found = f"data.crop_bar={config.data.crop_bar}, but the run in {earlier} has {crop_bar}"
        raise ValueError(f"{found}: set the same, or train a first iteration with it")


def order_of_episodes(config: Config) -> list[int]:
    """The episode of every entry in the dataset; from `data.episodes` on they are the agent's.

    They are mixed, because the last entries of a dataset are held out from training.
    """
    count = config.data.episodes + config.data.agent_episodes
    return random_stream("order", config.seed).permutation(count).tolist()


def drive_either(
    source: Path | WorldModel, parameters: np.ndarray, config: Config, number: int
) -> Episode:
    """Drive one episode of a second iteration. Runs in a worker."""
    if number < config.data.episodes:
        return drive_randomly(config, number)
    single_thread()
    agent = make_agent(source, parameters)
    return drive_noisily(agent, config, number - config.data.episodes)


class NoisyDriver:
    """An agent whose steering and gas are disturbed, so that it meets many situations.

    The strength of the noise is drawn once for a driver. M receives the disturbed actions.
    """

    def __init__(self, agent: Agent, rng: np.random.Generator):
        self.agent, self.rng = agent, rng
        self.strength, self.noise = rng.uniform(0, 2 * NOISE), np.zeros(2)

    def reset(self) -> None:
        """Begin an episode."""
        self.agent.reset()

    def act_batch(self, seen: np.ndarray) -> np.ndarray:
        """The disturbed action of the only car, float32 (1, 3)."""
        before, actions = self.agent.state, self.agent.act_batch(seen)
        self.noise = 0.9 * self.noise + self.strength * self.rng.standard_normal(2)
        actions[:, :2] = np.clip(actions[:, :2] + self.noise, [-1, 0], 1)
        self.agent.remember(actions, before)
        return actions

    def keep(self, cars: np.ndarray) -> None:
        """There is one car."""


def drive_noisily(agent: Agent, config: Config, index: int) -> Episode:
    """Let an agent drive episode `index` with noise."""
    data = config.data
    driver = NoisyDriver(agent, random_stream("agent driver", config.seed, index))
    track = track_seeds("collect", data.agent_episodes, config.seed, 1)[index]
    cars = Cars(1, "frame", bar=not data.crop_bar)
    cars.reset([track])
    limits = {"max_frames": data.agent_frames, "patience": data.agent_patience}
    return *record_frames(driver, cars, **limits), track


def carry_over(config: Config, earlier: Path, dataset: Callable[[], Dataset], folder: Path) -> bool:
    """Fit the C whose outputs on V and M in `folder` are the earlier C's; writes START_FILE.

    False if it was there already, for the same features. ValueError or FileNotFoundError if a file
    is damaged or missing.
    """
    path, new = Path(folder) / START_FILE, load_world_model(Path(folder))
    sees = {"features": config.evolution.features}
    if path.exists():
        load_start(path, new)  # raises if it is of another world model
        if (sees | load_kind(path, "start")[1])["features"] == sees["features"]:
            return False
    old, (parameters, _) = load_world_model(earlier), load_controller(earlier / CONTROLLER_FILE)
    wanted, seen, data = [], [], dataset()
    for entry, number in enumerate(order_of_episodes(config)):
        if number >= config.data.episodes:
            episode = data.frames[entry], data.actions[entry]
            wanted.append(outputs(parameters, features_of(old, *episode)))
            seen.append(features_of(new, *episode))
    columns = seen_columns(config.evolution.features, *new.sizes)
    targets = np.clip(np.concatenate(wanted), -LIMIT, LIMIT)
    start = fit_controller(np.concatenate(seen), targets, columns)
    save_start(path, start, config.variant, new, **sees)
    return True


def outputs(parameters: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """C's three outputs before squashing (T, 3) for features (T, features)."""
    weights, bias = unpack(parameters)
    return seen @ weights.T + bias


def fit_controller(seen: np.ndarray, wanted: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """The C whose outputs come closest to the wanted ones, float64 (parameters,).

    Small weights matter more here than the last percent of the fit, because evolution changes all
    weights by equal steps.

    Args:
        seen: features (T, features).
        wanted: outputs before squashing, (T, 3).
        columns: bool (features,), those that may have weights.
    """
    fitted, intercept = fit_ridge(seen[:, columns], wanted, PENALTY * len(seen))
    weights = np.zeros((wanted.shape[1], len(columns)))
    weights[:, columns] = fitted.T
    return np.concatenate([weights.ravel(), intercept])
