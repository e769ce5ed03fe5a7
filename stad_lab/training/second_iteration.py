"""A second round: the first agent drives, V and M learn from what it sees, and what C knows goes over to them.

The random driver is soon on the grass. So the first V and M have hardly seen the road at speed, which is nearly all
that their agent sees later. In a second round that agent drives for the data, beside the random driver, and V and M
are trained anew on both. A new V has other latents, and the old C is lost on them. But its outputs on the recorded
drives are known, so a ridge regression finds the C that gives the same outputs from the new z and h, and evolution goes
on from there. That costs no episode. (World Models, section 5, proposes such rounds for harder tasks.)

V draws its batches from all frames alike, M its sequences from all episodes alike: of these the agent's, which are
long, are only about one in ten.
"""

from concurrent.futures import Executor
from pathlib import Path

import numpy as np
import torch

from stad_lab.agent import (
    CONTROLLER,
    Agent,
    WorldModel,
    load_agent,
    load_controller,
    read_world_model,
)
from stad_lab.config import Settings
from stad_lab.envs.car_racing import make_env
from stad_lab.envs.frames import to_frame
from stad_lab.io.files import checksum
from stad_lab.io.workers import work_alone, worker_processes
from stad_lab.models.controller import seen_columns, unpack
from stad_lab.models.mdn_rnn import ACTION_SIZE
from stad_lab.training.dataset import (
    AGENT_SETTINGS,
    COLLECT_SETTINGS,
    Rollouts,
    collect,
    drive_randomly,
    track_seeds,
)
from stad_lab.training.evolution import hand_out, make_agent
from stad_lab.training.subspace import START, features, load_start, save_start, sizes

NOISE = 0.1  # of a frame's steering and gas; it wanders like the random driver's hand, so that many moments differ
LIMIT = 2.5  # of C's outputs before squashing, as targets: tanh(2.5) = 0.987, and what lies beyond makes no difference
PENALTY = 0.01  # of the ridge regression, for each frame


def collect_again(
    variant: str, settings: Settings, earlier: Path, folder: Path, executor: Executor | None = None
) -> bool:
    """Collect a dataset of both drivers into `folder`; goes on where an earlier call stopped.

    The random driver's episodes are those of a first round with the same settings; the agent's are mixed among them.

    Args:
        earlier: folder of the first run, of the same variant, whose agent drives.
        executor: who drives; None for `settings.processes` processes of this machine.

    Returns:
        False if everything was there already, True if something was collected.

    Raises:
        ValueError: the folder holds other rollouts, or the first run is damaged.
        FileNotFoundError: the first run has no agent.
        OSError, TaskError: as `collect_rollouts`.
    """
    parameters, _ = load_controller(earlier / CONTROLLER, variant)
    made_with = {field: getattr(settings, field) for field in (*COLLECT_SETTINGS, *AGENT_SETTINGS)}
    made_with |= {
        "variant": variant,
        "controller_sha256": checksum((earlier / CONTROLLER).read_bytes()),
    }
    numbers = order_of_episodes(settings)
    longest = [
        settings.episode_frames if number < settings.episodes else settings.max_frames
        for number in numbers
    ]
    with worker_processes(settings.processes, executor) as executor:
        source = hand_out(executor, earlier, variant)
        tasks = [(source, variant, parameters, settings, number) for number in numbers]
        return collect(folder, made_with, drive_either, tasks, longest, executor)


def check_earlier_agent(variant: str, settings: Settings, earlier: Path) -> None:
    """Raise ValueError unless the earlier V saw the indicator bar as the new one will: the frames are one dataset.

    And unless the earlier V, M and C belong together, as `load_agent` raises.
    """
    seen = load_agent(variant, earlier).crop_bar
    if seen != settings.crop_bar:
        raise ValueError(
            f"crop_bar={settings.crop_bar}, but the run in {earlier} has crop_bar={seen}: set that in the second round,"
            " too, or train a first round anew"
        )


def order_of_episodes(settings: Settings) -> list[int]:
    """The number of every block's episode, int: 0, 1, ... are the random driver's, those after them the agent's.

    They are mixed, because the last blocks of a dataset are held out from training.
    """
    rng = np.random.default_rng([settings.seed, 4])
    return rng.permutation(settings.episodes + settings.agent_episodes).tolist()


def drive_either(
    source: Path | WorldModel, variant: str, parameters: np.ndarray, settings: Settings, number: int
) -> tuple[np.ndarray, np.ndarray, int]:
    """Drive episode `number` of a second round, as `drive_randomly` does. Runs in a worker process."""
    if number < settings.episodes:
        return drive_randomly(settings, number)
    work_alone()
    return drive_noisily(
        make_agent(source, variant, parameters), settings, number - settings.episodes
    )


@torch.inference_mode()
def drive_noisily(
    agent: Agent, settings: Settings, index: int
) -> tuple[np.ndarray, np.ndarray, int]:
    """Let an agent drive with an unsteady hand: (frames uint8 (T, 64, 64, 3), actions float32 (T, 3), track seed).

    How unsteady it is differs from episode to episode. M remembers what was done, not what was meant.
    """
    rng = np.random.default_rng([settings.seed, 5, index])
    track = track_seeds("collect", settings.agent_episodes, settings.seed, 1)[index]
    unsteadiness, noise, waiting, frames, actions = (
        rng.uniform(0, 2 * NOISE),
        np.zeros(2),
        0,
        [],
        [],
    )
    env = make_env(fast=True, bar=not settings.crop_bar)
    observation, _ = env.reset(seed=track)
    agent.reset()
    while len(frames) < settings.max_frames and not (
        settings.patience and waiting >= settings.patience
    ):
        before, action = agent.state, agent.act(observation)
        noise = 0.9 * noise + unsteadiness * rng.standard_normal(2)
        action[:2] = np.clip(action[:2] + noise, [-1, 0], 1)
        agent.take_in(action[None], before)
        frames.append(to_frame(observation, settings.crop_bar))
        actions.append(action)
        observation, reward, terminated, truncated, _ = env.step(action)
        waiting = 0 if reward > 0 else waiting + 1
        if terminated or truncated:
            break
    env.close()
    return np.array(frames), np.array(actions), track


def carry_over(
    variant: str, settings: Settings, earlier: Path, rollouts_folder: Path, folder: Path
) -> bool:
    """Find the C that does with the new V and M, in `folder`, what the earlier C does; writes `start.safetensors`.

    Returns:
        False if it was there already.

    Raises:
        ValueError, FileNotFoundError: a file of one of the runs, or the rollouts, are damaged or missing.
    """
    path, new = Path(folder) / START, read_world_model(Path(folder), variant)
    if path.exists():
        load_start(path, new)
        return False
    rollouts, old = Rollouts(rollouts_folder), read_world_model(earlier, variant)
    parameters, _ = load_controller(earlier / CONTROLLER, variant)
    wanted, seen = [], []
    for block, number in enumerate(order_of_episodes(settings)):
        if number >= settings.episodes:
            frames, actions = rollouts.frames[block], rollouts.actions[block]
            wanted.append(outputs(parameters, features(old, frames, actions)))
            seen.append(features(new, frames, actions))
    columns = seen_columns(settings.features, *sizes(new))
    start = fit_controller(
        np.concatenate(seen), np.clip(np.concatenate(wanted), -LIMIT, LIMIT), columns
    )
    save_start(path, start, variant, new)
    return True


def outputs(parameters: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """C's three outputs before squashing, (T, 3), for what it sees, (T, features)."""
    weights, bias = unpack(parameters)
    return seen @ weights.T + bias


def fit_controller(seen: np.ndarray, wanted: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """The C that comes nearest to the wanted outputs (T, 3) from what it sees (T, features): float64 (parameters,).

    Only the features in `columns`, bool (features,), have weights; the others' are 0.

    Ridge regression: W and b make the mean squared error of W s + b, plus the penalty times the sum of all squared
    weights, the smallest. Small weights matter more here than the last percent of the fit, since evolution changes all
    weights by equal steps.
    """
    middle, target = seen.mean(axis=0, dtype=np.float64), wanted.mean(axis=0)
    centred = (seen - middle)[:, columns]
    square = centred.T @ centred + PENALTY * len(seen) * np.eye(columns.sum())
    weights = np.zeros((ACTION_SIZE, len(columns)))
    weights[:, columns] = np.linalg.solve(square, centred.T @ (wanted - target)).T
    return np.concatenate([weights.ravel(), target - weights @ middle])
