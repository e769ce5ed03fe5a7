"""Drives seen from above: where each car of a batch went, and what it scored."""

from itertools import chain
from typing import NamedTuple

import numpy as np

from stad_lab.agent import rollout
from stad_lab.envs.cars import Cars
from stad_lab.io.weights import WorldModel
from stad_lab.io.workers import run_in_order, single_thread, worker_threads
from stad_lab.training.evolution import make_agent


class Drives(NamedTuple):
    """One episode of each of n controllers."""

    returns: np.ndarray  # float64 (n,)
    paths: list[np.ndarray]  # position in every frame, world units (T, 2), for each
    roads: list[np.ndarray]  # centres of the track's tiles, world units (tiles, 2), for each


def drive_from_above(
    world_model: WorldModel,
    controllers: np.ndarray,
    tracks: list[int],
    max_frames: int = 1000,
    patience: int = 0,
    threads: int = 2,
) -> Drives:
    """Drive each controller, float64 (n, parameters), on its track with our engine.

    Args:
        tracks: n seeds.
        max_frames, patience: of `rollout`.
        threads: that share the cars; the results do not depend on it.
    """
    if len(controllers) != len(tracks):
        raise ValueError(f"{len(controllers)} controllers on {len(tracks)} tracks: expected pairs")
    groups = np.array_split(np.arange(len(tracks)), min(threads, len(tracks)))
    limits = max_frames, patience
    tasks = [(world_model, controllers[own], [tracks[i] for i in own], *limits) for own in groups]
    with worker_threads(len(groups)) as executor:
        returns, paths, roads = zip(*run_in_order(executor, drive_group, tasks), strict=True)
    return Drives(np.concatenate(returns), [*chain(*paths)], [*chain(*roads)])


def drive_group(
    world_model: WorldModel,
    controllers: np.ndarray,
    tracks: list[int],
    max_frames: int,
    patience: int,
) -> Drives:
    """Drive a batch of cars on one thread."""
    single_thread()
    cars = Cars(len(tracks), "frame", bar=not world_model.crop_bar)
    paths: list[list] = [[] for _ in tracks]
    cars.reset(tracks)

    def note(driving: np.ndarray, _: np.ndarray, __: np.ndarray) -> None:
        for car in driving:
            paths[car].append(cars.cars["position"][car, 0].copy())

    agent = make_agent(world_model, controllers)
    episodes = rollout(agent, cars, max_frames, patience, observe=note)
    roads = [track.path[:, 2:] for track in cars.tracks]
    return Drives(episodes.returns, [np.array(path) for path in paths], roads)
