"""Record the data of the live page *Evolution*: what each generation of a CMA-ES run drives.

    python docs/live/record_evolution.py

The run is that of the shipped agent `cropped_input` (notebook 04). Its log is told to CMA-ES again,
which gives the mean controller of every generation without driving. Some of these controllers then
drive two tracks that no training and no evaluation uses. It takes three
minutes and writes into docs/live/data:

    evolution_tensors.safetensors    controllers, roads, paths, and the memories of M to dream from
    evolution.json                   the learning curve, and the return of each path
"""

import json
from pathlib import Path

import numpy as np
import torch
from safetensors.numpy import save

from stad_lab.agent import Agent, rollout, run_folder
from stad_lab.config import Config, track_seeds
from stad_lab.envs import physics
from stad_lab.envs.cars import Cars
from stad_lab.evaluation.trajectories import encode_trajectory, record_trajectory
from stad_lab.io.files import load_json
from stad_lab.io.weights import CONTROLLER_FILE, WorldModel, load_controller, load_world_model
from stad_lab.training.evolution import LOG, fitness_curves, replay
from stad_lab.training.record import RECORD
from stad_lab.training.subspace import search_space

DATA = Path(__file__).parent / "data"
AGENT = "cropped_input"
SHOWN = (0, 1, 2, 3, 4, 5, 6, 8, 10, 12, 14, 16, 18, 20, 25, 30, 35, 40, 45, 50, 60, 70, 80, 90, 95)
TRACKS = track_seeds("inspect", 2, 41)
EVERY = 5  # frames between two recorded positions, a tenth of a second
STARTS = (70, 180, 320)  # frames of an episode of the agent, from which a dream may go on


def mean_controllers(config: Config, folder: Path, world_model: WorldModel, log: dict) -> list:
    """C at the mean of CMA-ES, before the first generation and after each: float64 (867,) each.

    The log's checksums hold on the machine that made the run alone; here the kept C must agree.
    """
    space = search_space(config, world_model, folder)
    _, means = replay(space.first, config.evolution, log, check=False)
    controllers = [space.expand(mean) for mean in (space.first, *means)]
    kept, metadata = load_controller(folder / CONTROLLER_FILE)
    difference = np.abs(controllers[metadata["generation"]] - kept).max()
    if difference > 1e-6:
        raise ValueError(f"the replayed C differs from the shipped one by {difference:.1e}")
    return controllers


def drive_path(world_model: WorldModel, controllers: np.ndarray, track: int) -> dict:
    """Drive one track with every controller: centre line, paths and returns."""
    cars = Cars(len(controllers), "frame", bar=not world_model.crop_bar)
    cars.reset([track] * len(controllers))
    places = [[] for _ in controllers]

    def observe(driving: np.ndarray, seen: np.ndarray, actions: np.ndarray) -> None:
        for car in driving:
            places[car].append(cars.cars["position"][car, 0].copy())

    episodes = rollout(Agent(world_model, controllers), cars, observe=observe)
    paths = [np.array(own)[::EVERY].astype(np.float16) for own in places]
    return {
        "road": cars.tracks[0].path[:, 2:4].astype(np.float32),
        "paths": np.concatenate(paths),
        "points": [len(path) for path in paths],
        "returns": episodes.returns.round(1).tolist(),
        "frames": episodes.lengths.tolist(),
        "laps": (cars.cars["ending"] == physics.LAP_FINISHED).tolist(),
    }


@torch.no_grad()
def dream_starts(world_model: WorldModel, controller: np.ndarray) -> dict[str, np.ndarray]:
    """Frames of an episode from which a dream may go on: z, and h and c of M before it."""
    driven = record_trajectory(Agent(world_model, controller), TRACKS[0], max(STARTS) + 1)
    how = world_model.stride, world_model.crop_bar
    z = torch.from_numpy(encode_trajectory(world_model.vae, driven, *how)[0])
    actions = torch.from_numpy(driven.actions)
    states = [world_model.mdn_rnn.remember(z[None, :t], actions[None, :t])[1] for t in STARTS]
    h, c = (np.stack([state[part].numpy().ravel() for state in states]) for part in (0, 1))
    return {"start.z": z[list(STARTS)].numpy(), "start.h": h, "start.c": c}


def main() -> None:
    """Replay, drive and write."""
    folder = run_folder(AGENT)
    config = Config.from_dict(load_json(folder / RECORD)["config"])
    world_model, log = load_world_model(folder), load_json(folder / LOG)
    controllers = np.array(mean_controllers(config, folder, world_model, log))[list(SHOWN)]
    controllers = controllers.astype(np.float32).astype(float)  # as they are kept, for the paths
    tensors = {"controllers": controllers.astype(np.float32)}
    tensors |= dream_starts(world_model, controllers[-1])
    tracks = []
    for number, track in enumerate(TRACKS):
        driven = drive_path(world_model, controllers, track)
        tensors |= {f"{name}.{number}": driven.pop(name) for name in ("road", "paths")}
        tracks.append({"track": track, **driven})
    entries = log["generations"]
    worst, mean, best = fitness_curves(entries).round(1).tolist()
    validated = {n: e["validation"]["mean"] for n, e in enumerate(entries, 1) if "validation" in e}
    curves = {
        "generations": SHOWN,
        "tracks": tracks,
        "every": EVERY,
        "population": config.evolution.population,
        "episodes": config.evolution.population * config.evolution.tracks,
        "worst": worst,
        "mean": mean,
        "best": best,
        "sigma": [round(entry["sigma"], 4) for entry in entries],
        "validation": {str(n): round(value, 1) for n, value in validated.items()},
    }
    DATA.mkdir(exist_ok=True)
    (DATA / "evolution_tensors.safetensors").write_bytes(save(tensors))
    (DATA / "evolution.json").write_text(json.dumps(curves) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
