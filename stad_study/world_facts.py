"""What the arms of study 5 need to know of a world: scales, erasers, placebo and components.

All of it is computed before C is evolved, from episodes that no score drives: the seed's dataset
(the random driver's), the probe's trajectories, and episodes of an agent for the placebo.
"""

from pathlib import Path

import numpy as np
import torch
from tqdm import tqdm

from stad_lab.agent import load_agent, rollout
from stad_lab.config import Config, random_stream, track_seeds
from stad_lab.envs.cars import Cars
from stad_lab.evaluation.probe import probe, split_episodes
from stad_lab.evaluation.probe_run import (
    AGENT,
    PROBE_SEED,
    PROBED,
    agent_trajectories,
    frames_in_sight,
    random_trajectories,
    two_drivers,
)
from stad_lab.evaluation.trajectories import Trajectory, encode_trajectory
from stad_lab.features import encode_episode, remember_episode
from stad_lab.io.files import save_tensors
from stad_lab.io.weights import WorldModel, check_belongs, load_kind
from stad_lab.training.dataset import random_start
from stad_lab.training.subspace import principal_components
from stad_study.networks import find_world_model, load_kept_world_model
from stad_study.senses import (
    COLUMNS,
    ERASED,
    SEES,
    Eraser,
    Sense,
    erase,
    motion_directions,
    random_directions,
    removed_variance,
    turning,
    whiten,
)
from stad_study.study import STUDIES, groups_of

WORLD_FILE = "world.safetensors"
PLACEBO_EPISODES = 64  # of an agent, on tracks kept for inspection
SENSED_VARIANTS = ("frame", "input", "input_output")


def prepare_seed(seed: int, folder: Path, networks: Path) -> None:
    """Write `folder/VARIANT/world.safetensors` for the worlds of a seed.

    Args:
        networks: the folder with the kept V and M of study 1, which the worlds come from.

    Raises FileNotFoundError or ValueError as `find_world_model` and `load_kept_world_model`.
    """
    kept = {one: find_world_model(networks, "study1", seed, one) for one in SENSED_VARIANTS}
    models = {one: load_kept_world_model(file) for one, file in kept.items()}
    config = STUDIES["study1"].config.replace(seed=seed)
    count = range(config.data.episodes)
    episodes = [drive_with_motion(config, i) for i in tqdm(count, f"dataset of seed {seed}")]
    driven, skip = agent_trajectories(PROBED, 1)
    others = placebo_episodes()
    for variant, model in models.items():
        erasers = fit_erasers(model, driven, skip, random_stream("bootstrap", seed, 5))
        facts = describe_world(model, episodes, erasers, others)
        path, tensors = folder / variant / WORLD_FILE, {}
        for name, array in facts.items():
            tensors[name] = torch.from_numpy(np.ascontiguousarray(array))
        save_tensors(path, tensors, kind="world", variant=variant, **model.checksums)


def drive_with_motion(config: Config, index: int) -> tuple[np.ndarray, ...]:
    """Episode `index` of the random driver in a dataset: frames, actions, and motion (T, 3)."""
    cars, driver = random_start(config, index)
    frames, actions, motion = [], [], []

    def observe(_: np.ndarray, seen: np.ndarray, action: np.ndarray) -> None:
        frames.append(seen[0])
        actions.append(action[0])
        motion.append(turning(cars, np.array([0]))[0])

    rollout(driver, cars, max_frames=config.data.episode_frames, observe=observe)
    return np.array(frames), np.array(actions), np.array(motion)


def placebo_episodes() -> list[np.ndarray]:
    """The motion (T, 3) of whole episodes of an agent, on tracks kept for inspection."""
    agent, tracks = load_agent(AGENT), track_seeds("inspect", PLACEBO_EPISODES, 5)
    found = []
    for own in groups_of(tracks):
        cars = Cars(len(own), "frame", bar=not agent.world_model.crop_bar)
        rows: list[list] = [[] for _ in own]
        cars.reset(own)

        def observe(which: np.ndarray, *_, cars: Cars = cars, rows: list = rows) -> None:
            for car, numbers in zip(which, turning(cars, which), strict=True):
                rows[car].append(numbers)

        rollout(agent, cars, observe=observe)
        found += [np.array(one) for one in rows]
    return found


def fit_erasers(
    model: WorldModel, driven: list[Trajectory], skip: int, rng: np.random.Generator
) -> dict[str, Eraser]:
    """The erasers of the motion and of random directions, from the probe's training episodes."""
    latents, motion, number = rows_in_sight(model, driven, skip)
    fit = ~np.isin(number, split_episodes(number, np.random.default_rng(0))[0])
    white = whiten(latents[fit])
    directions = motion_directions(white, latents[fit], motion[fit][:, COLUMNS])
    placebo = random_directions(white, removed_variance(white, directions), rng)
    return {"z - motion": erase(white, directions), "z - placebo": erase(white, placebo)}


def describe_world(
    model: WorldModel, episodes: list[tuple], erasers: dict[str, Eraser], others: list[np.ndarray]
) -> dict[str, np.ndarray]:
    """The arrays of a world's file, by name.

    "SEES.keep" and "SEES.shift" are an eraser, "SEES.scale" the standard deviations of added
    numbers, "others.N" the placebo's episodes, and "SEES.middle" and "SEES.components" the
    principal components of what C sees in the dataset.
    """
    facts = {f"others.{number}": one for number, one in enumerate(others)}
    for sees, eraser in erasers.items():
        facts |= {f"{sees}.keep": eraser.keep, f"{sees}.shift": eraser.shift}
    _, actions, motion = (np.concatenate(part) for part in zip(*episodes, strict=True))
    for added, numbers in {"motion": motion, "placebo": motion, "action": actions}.items():
        facts[f"z + {added}.scale"] = numbers.std(axis=0)
    bar = tqdm(episodes, f"encode ({model.vae.variant})", unit="episode")
    latents = [encode_episode(model.vae, frames, model.stride)[0] for frames, _, _ in bar]
    count, (latent_size, _) = STUDIES["study1"].config.evolution.components, model.sizes
    for sees in SEES:
        sense, seen = sense_of(facts, model, sees), []
        for number, (z, episode) in enumerate(zip(latents, episodes, strict=True)):
            seen.append(sense.features(z, beside_in_dataset(sense, number, z, *episode[1:])))
        columns = np.arange(seen[0].shape[1]) < latent_size  # z, and what C sees beside it
        columns |= "+" in sees or sees == "z, h"
        found = principal_components(seen, columns, count)
        facts[f"{sees}.middle"], facts[f"{sees}.components"] = found
    return facts


def beside_in_dataset(
    sense: Sense, number: int, latents: np.ndarray, actions: np.ndarray, motion: np.ndarray
) -> np.ndarray:
    """What C sees beside z in episode `number` of the dataset, in its own units: (T, numbers)."""
    if sense.sees == "z + motion":
        return motion
    if sense.sees == "z + placebo":
        return sense.other_motion(number, np.arange(len(motion)))
    if sense.sees == "z + action":
        return np.concatenate([np.zeros((1, 3), np.float32), actions[:-1]])
    if sense.sees == "z, h":
        return remember_episode(sense.world_model.mdn_rnn, latents, actions)
    return np.zeros((len(latents), sense.sizes[1]), np.float32)  # h, of which C sees nothing


def load_sense(
    path: Path, model: WorldModel, sees: str
) -> tuple[Sense, tuple[np.ndarray, np.ndarray]]:
    """What C sees in a world, and the mean and principal components of it in the dataset.

    ValueError if the file is damaged, or of another world.
    """
    tensors, metadata = load_kind(path, "world", "vae", "mdn_rnn")
    check_belongs(path, metadata, **model.checksums)
    facts = {name: tensor.numpy() for name, tensor in tensors.items()}
    return sense_of(facts, model, sees), (facts[f"{sees}.middle"], facts[f"{sees}.components"])


def sense_of(facts: dict[str, np.ndarray], model: WorldModel, sees: str) -> Sense:
    """The Sense that the arrays of a world's file describe."""
    eraser = Eraser(facts[f"{sees}.keep"], facts[f"{sees}.shift"]) if " - " in sees else None
    others = [facts[f"others.{number}"] for number in range(PLACEBO_EPISODES)]
    return Sense(model, sees, eraser, facts.get(f"{sees}.scale"), others)


def measure_erasure(
    model: WorldModel, count: int = PROBED, processes: int = 2
) -> dict[str, dict[str, dict]]:
    """What a linear probe reads from z with and without the erasers, on held-out episodes.

    The erasers are fitted as for the runs, on an agent's episodes. Driver -> what C sees -> "r2"
    of each of ERASED, and "variance", the share of z's variance that is left.
    """
    drivers = two_drivers(random_trajectories(count, PROBE_SEED, processes), processes)
    erasers = fit_erasers(model, *drivers["trained agent"], random_stream("bootstrap", 0, 5))
    found: dict = {}
    for driver, (driven, skip) in drivers.items():
        latents, motion, number = rows_in_sight(model, driven, skip)
        found[driver] = {}
        for sees, eraser in {"z": None, **erasers}.items():
            seen = eraser(latents) if eraser else latents
            share = float(seen.var(axis=0).sum() / latents.var(axis=0).sum())
            r2 = probe(seen, motion[:, COLUMNS], number)["r2"].tolist()
            found[driver][sees] = {"r2": r2, "variance": share}
    return found


def describe_erasure(found: dict[str, dict[str, dict]]) -> str:
    """What `measure_erasure` found, in lines."""
    head = "".join(f"{one:>14}" for one in (*ERASED, "variance"))
    lines = [f"{'R2 on held-out episodes':<24}{head}"]
    for driver, by_sight in found.items():
        for sees, one in by_sight.items():
            numbers = "".join(f"{value:z14.2f}" for value in [*one["r2"], one["variance"]])
            lines.append(f"{driver + ': ' + sees:<24}{numbers}")
    return "\n".join(lines)


def rows_in_sight(
    model: WorldModel, driven: list[Trajectory], skip: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """z, motion and number of the episode of every frame that the probe counts."""
    encoded = [encode_trajectory(model.vae, one, model.stride, model.crop_bar)[0] for one in driven]
    kept, motion, number = frames_in_sight(driven, skip)
    return np.concatenate(encoded)[kept], motion[kept], number[kept]
