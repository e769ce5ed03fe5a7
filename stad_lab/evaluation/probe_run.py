"""What z, and z with M's memory, carry of the car's motion: a linear probe of one V and M."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from stad_lab.agent import load_agent, run_folder
from stad_lab.config import Config, track_seeds
from stad_lab.evaluation.probe import probe
from stad_lab.evaluation.trajectories import (
    MOTION,
    Trajectory,
    encode_trajectory,
    record_random_trajectory,
    record_trajectory,
    road_in_sight,
)
from stad_lab.features import remember_episode
from stad_lab.io.weights import WorldModel, load_world_model
from stad_lab.io.workers import run_in_order, worker_threads
from stad_lab.models.mdn_rnn import MDNRNN
from stad_lab.models.vae import VAE
from stad_lab.training.record import provenance

LONGEST_STRIDE = 8
RANDOM_FRAMES, AGENT_FRAMES = 150, 360  # of a trajectory of the random driver, and of the agent
# First frames that are not probed: without a difference image, or with the opening zoom.
RANDOM_SKIP, AGENT_SKIP = LONGEST_STRIDE, 60
FEWEST_TRAJECTORIES = 12  # a probe is fitted on some and measured on others
PROBED, PROBE_SEED = 180, 100  # trajectories when one run is probed; no counted run has this seed
AGENT = "cropped_input"  # the competent driver whose trajectories are probed


class Encoder(NamedTuple):
    """A V, how its pictures are made, and the M (by name) whose h is probed with its z."""

    vae: VAE
    stride: int
    crop_bar: bool
    memories: dict[str, MDNRNN]


def encoder_of(model: WorldModel, memories: dict[str, MDNRNN]) -> Encoder:
    """V of a world model, with some M."""
    return Encoder(model.vae, model.stride, model.crop_bar, memories)


def random_trajectories(count: int, seed: int, processes: int) -> list[Trajectory]:
    """Trajectories of the random driver, from random tiles of tracks kept for inspection."""
    data = {"episodes": count, "episode_frames": RANDOM_FRAMES, "random_starts": 1.0}
    tasks = [(Config(seed=seed).replace(data=data), index) for index in range(count)]
    with worker_threads(processes) as executor:
        return run_in_order(executor, record_random_trajectory, tasks, "random driver")


# The trajectories of a driver, and how many first frames of each are not probed.
Driven = tuple[list[Trajectory], int]


def two_drivers(driven: list[Trajectory], processes: int) -> dict[str, Driven]:
    """The random driver's trajectories `driven`, and those of AGENT from `agent_trajectories`.

    Returns driver -> (trajectories, number of first frames of each that are not probed).
    """
    by_agent = agent_trajectories(len(driven), processes)
    return {"random driver": (driven, RANDOM_SKIP), "trained agent": by_agent}


def agent_trajectories(count: int, processes: int) -> Driven:
    """Trajectories of AGENT on tracks for inspection: `count` / 3, at least FEWEST_TRAJECTORIES."""
    tracks = track_seeds("inspect", max(FEWEST_TRAJECTORIES, count // 3), 2)
    tasks = [(load_agent(AGENT), track, AGENT_FRAMES) for track in tracks]
    with worker_threads(processes) as executor:
        return run_in_order(executor, record_trajectory, tasks, "trained agent"), AGENT_SKIP


def frames_in_sight(
    driven: list[Trajectory], skip: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Which of n frames the probe counts, bool (n,); the motion (n, 6) and trajectory (n,) of all.

    It counts those that show the road, after the first `skip` of each trajectory.
    """
    motion = np.concatenate([one.motion for one in driven])
    number = np.repeat(np.arange(len(driven)), [len(one) for one in driven])
    moment = np.concatenate([np.arange(len(one)) for one in driven])
    return road_in_sight(motion) & (moment >= skip), motion, number


def probe_trajectories(driven: list[Trajectory], skip: int, encoder: Encoder) -> dict:
    """Probe the mean of z, which C sees, and z with the memory of each M.

    Returns {"z": {quantity: {"r2": number, "interval": [low, high]}}}, and so for every M.
    """
    vae, stride, crop_bar, memories = encoder
    latents = [encode_trajectory(vae, one, stride, crop_bar)[0] for one in driven]
    features = {"z": np.concatenate(latents)}
    for name, mdn_rnn in memories.items():
        pairs = zip(latents, driven, strict=True)
        hidden = [remember_episode(mdn_rnn, z, one.actions) for z, one in pairs]
        features[name] = np.concatenate([features["z"], np.concatenate(hidden)], axis=1)
    kept, motion, number = frames_in_sight(driven, skip)
    result = {}
    for name, seen in features.items():
        found = probe(seen[kept], motion[kept], number[kept])
        result[name] = {
            quantity: {"r2": float(r2), "interval": [float(low), float(high)]}
            for quantity, r2, low, high in zip(MOTION, *found.values(), strict=True)
        }
    return result


def probe_run(source: str | Path, count: int = PROBED, processes: int = 2) -> dict:
    """Probe V and M of a shipped agent or a run's folder, on `count` random trajectories.

    Returns a dict for JSON; "drivers" is driver -> what `probe_trajectories` finds. Raises
    ValueError for too few trajectories, or V and M that do not belong together, and
    FileNotFoundError if they are not there.
    """
    if count < FEWEST_TRAJECTORIES:
        expected = f"expected at least {FEWEST_TRAJECTORIES}, to fit and measure on"
        raise ValueError(f"episodes={count}: {expected}")
    made_with = provenance(f"python -m stad_lab probe --run ... --episodes {count}")  # before work
    model = load_world_model(run_folder(source))
    drivers = two_drivers(random_trajectories(count, PROBE_SEED, processes), processes)
    encoder = encoder_of(model, {"z, h": model.mdn_rnn})
    return {
        "kind": "probe",
        "variant": model.vae.variant,
        **model.checksums,
        "trajectories": count,
        "drivers": {name: probe_trajectories(*driven, encoder) for name, driven in drivers.items()},
        "made_with": made_with,
    }


def describe_probe(found: dict) -> str:
    """What `probe_run` found, in lines: R2 for each driver, z and z with h, and quantity."""
    lines = [f"R2 of a linear probe: V and M of {found['variant']}"]
    for driver, by_features in found["drivers"].items():
        lines.append(f"  {driver:18s}" + "".join(f"{quantity:>16s}" for quantity in MOTION))
        for features, by_quantity in by_features.items():
            cells = (f"{by_quantity[quantity]['r2']:z16.2f}" for quantity in MOTION)
            lines.append(f"    {features:16s}" + "".join(cells))
    return "\n".join(lines)
