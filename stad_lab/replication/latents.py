"""What the latents carry, and how good V and M are, on episodes that nothing was trained on::

    probe    a linear probe for six quantities of the car's true motion, from z and from z with h:
             in every variant without and with the indicator bar, untrained, and for other strides
    vae      the errors of V in every variant, and rate against distortion over the KL weight
    mdn_rnn  the NLL of M beside simple predictions and reduced M, its calibration, and the error
             of its dreams

The shipped V and M are measured, those without the bar (`cropped_...`) if not said otherwise. What
they are compared with is trained in a working folder, on a dataset of its own, and kept there.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from stad_lab.agent import PRETRAINED, load_agent, run_folder
from stad_lab.config import VARIANTS, Config, check_same, random_stream, track_seeds
from stad_lab.envs.frames import earlier_frames
from stad_lab.evaluation import metrics
from stad_lab.evaluation.probe import probe
from stad_lab.evaluation.statistics import bootstrap
from stad_lab.evaluation.trajectories import (
    MOTION,
    Trajectory,
    encode_trajectory,
    record_random_trajectory,
    record_trajectory,
    road_in_sight,
)
from stad_lab.features import remember_episode
from stad_lab.io import weights
from stad_lab.io.files import load_json, save_json
from stad_lab.io.weights import WorldModel, load_world_model
from stad_lab.io.workers import run_in_order, worker_threads
from stad_lab.models.mdn_rnn import MDNRNN
from stad_lab.models.vae import VAE, kl_divergence
from stad_lab.training.dataset import Dataset, collect
from stad_lab.training.mdn_rnn import Latents, encode_dataset, fit_mdn_rnn, sample_latents
from stad_lab.training.pipeline import train
from stad_lab.training.record import provenance
from stad_lab.training.trainer import torch_settings

STRIDES = (1, 2, 4, 8)
KL_WEIGHTS = (0.02, 0.08, 0.25, 1.0, 4.0, 16.0)
SHORTER = 0.3  # share of the steps for which the V of a comparison are trained
REDUCED = {  # an M that lacks something: the change, and whether it sees the actions
    "one Gaussian": ({"mixtures": 1}, True),
    "no actions": ({}, False),
    "no memory": ({"sequence": 1}, True),  # on as many frames, each on its own
}
RANDOM_FRAMES, AGENT_FRAMES = 150, 360  # of a trajectory of the random driver, and of the agent
# First frames that are not probed: without a difference image, or with the opening zoom.
RANDOM_SKIP, AGENT_SKIP = max(STRIDES), 60
FEWEST = 12  # trajectories: a probe is fitted on some and measured on others
PROBED, PROBE_SEED = 180, 100  # trajectories when one run is probed; no dataset has this seed
AGENT = "cropped_input"  # the competent driver whose trajectories are probed
AWAKE = 30  # frames that M sees before a dream
HORIZON = [1, 2, 3, 5, 7, 10, 14, 20, 30, 40, 50, 60, 70, 80, 90, 100]  # dreamed steps
RESAMPLES = 1000  # of the trajectories, for an interval
DREAMERS = 60  # trajectories from which M dreams on


@dataclass(frozen=True)
class Study:
    """What every part of `measure` works with."""

    config: Config  # of the dataset and of what is trained here
    dataset: Path
    work: Path  # folder for what is trained
    trajectories: list[Trajectory]  # of the random driver


class Encoder(NamedTuple):
    """A V, how its pictures are made, and the M (by name) whose h is probed with its z."""

    vae: VAE
    stride: int
    crop_bar: bool
    memories: dict[str, MDNRNN]


def encoder_of(model: WorldModel, memories: dict[str, MDNRNN]) -> Encoder:
    """V of a world model, with some M."""
    return Encoder(model.vae, model.stride, model.crop_bar, memories)


def measure(config: Config, dataset_folder: Path, work: Path, parts: Sequence[str]) -> dict:
    """Measure some of PARTS, and write each into `work/latents.json` as soon as it is measured.

    The dataset is collected if it is not there. Returns what is written, part by part.
    """
    if unknown := [part for part in parts if part not in PARTS]:
        raise ValueError(f"unknown part {unknown[0]!r}: choose from {', '.join(PARTS)}")
    collect(config, dataset_folder)
    count = max(FEWEST, config.data.episodes // 5)
    driven = random_trajectories(count, config.seed + 1, config.processes)
    study, file, result = Study(config, dataset_folder, work, driven), work / "latents.json", {}
    for name in parts:
        found = PARTS[name](study)
        found |= {"trajectories": len(driven), "config": config.as_dict()}
        found["made_with"] = provenance(f"python -m stad_lab latents --parts {name} --out ...")
        result[name] = found
        save_json(file, (load_json(file) if file.exists() else {}) | result)
    return result


def random_trajectories(count: int, seed: int, processes: int) -> list[Trajectory]:
    """Trajectories of the random driver, from random tiles of tracks kept for inspection."""
    data = {"episodes": count, "episode_frames": RANDOM_FRAMES, "random_starts": 1.0}
    tasks = [(Config(seed=seed).replace(data=data), index) for index in range(count)]
    with worker_threads(processes) as executor:
        return run_in_order(executor, record_random_trajectory, tasks, "random driver")


# The trajectories of a driver, and how many first frames of each are not probed.
Driven = tuple[list[Trajectory], int]


def two_drivers(driven: list[Trajectory], processes: int) -> dict[str, Driven]:
    """The random driver's trajectories, and a third as many of AGENT: the road at speed.

    Returns driver -> (trajectories, number of first frames of each that are not probed).
    """
    tracks = track_seeds("inspect", max(FEWEST, len(driven) // 3), 2)
    tasks = [(load_agent(AGENT), track, AGENT_FRAMES) for track in tracks]
    with worker_threads(processes) as executor:
        by_agent = run_in_order(executor, record_trajectory, tasks, "trained agent")
    return {"random driver": (driven, RANDOM_SKIP), "trained agent": (by_agent, AGENT_SKIP)}


def shipped(prefix: str = "cropped_") -> Iterator[tuple[str, WorldModel]]:
    """The variants, and the shipped V and M of each; with the prefix "" those that see the bar."""
    for variant in VARIANTS:
        yield variant, load_world_model(PRETRAINED / f"{prefix}{variant}")


def probe_part(study: Study) -> dict:
    """Probe the latents of every variant, of untrained V, and of every stride: two drivers."""
    config, names = study.config, ("frame", "input_output")
    with torch_settings(config.seed, 0):
        untrained = {name: VAE.of(config.replace(variant=name)) for name in names}
        mdn_rnn = MDNRNN.of(config)
    encoders = {}
    for prefix in ("cropped_", ""):
        for variant, model in shipped(prefix):
            memories = {"z, h": model.mdn_rnn, "z, h of an untrained M": mdn_rnn}
            encoders[f"{prefix}{variant}"] = encoder_of(model, memories)
    for name, vae in untrained.items():
        encoders[f"{name}, untrained"] = Encoder(vae, config.vae.stride, config.data.crop_bar, {})
    for stride in STRIDES:
        encoders[f"stride {stride}"] = shorter_encoder(study, stride=stride)
    found = {
        driver: {name: probe_trajectories(*driven, one) for name, one in encoders.items()}
        for driver, driven in two_drivers(study.trajectories, config.processes).items()
    }
    return {"drivers": found}


def probe_trajectories(driven: list[Trajectory], skip: int, encoder: Encoder) -> dict:
    """Probe the mean of z, which C sees, and z with the memory of each M.

    Only frames count in which the road is in sight, after the first `skip` of each trajectory.
    Returns {"z": {quantity: {"r2": number, "interval": [low, high]}}}, and so for every M.
    """
    vae, stride, crop_bar, memories = encoder
    latents = [encode_trajectory(vae, one, stride, crop_bar)[0] for one in driven]
    features = {"z": np.concatenate(latents)}
    for name, mdn_rnn in memories.items():
        pairs = zip(latents, driven, strict=True)
        hidden = [remember_episode(mdn_rnn, z, one.actions) for z, one in pairs]
        features[name] = np.concatenate([features["z"], np.concatenate(hidden)], axis=1)
    motion = np.concatenate([one.motion for one in driven])
    number = np.repeat(np.arange(len(driven)), [len(one) for one in driven])
    moment = np.concatenate([np.arange(len(one)) for one in driven])
    kept = road_in_sight(motion) & (moment >= skip)
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
    if count < FEWEST:
        raise ValueError(f"episodes={count}: expected at least {FEWEST}, to fit and measure on")
    model = load_world_model(run_folder(source))
    drivers = two_drivers(random_trajectories(count, PROBE_SEED, processes), processes)
    encoder = encoder_of(model, {"z, h": model.mdn_rnn})
    return {
        "kind": "probe",
        "variant": model.vae.variant,
        **model.checksums,
        "trajectories": count,
        "drivers": {name: probe_trajectories(*driven, encoder) for name, driven in drivers.items()},
        "made_with": provenance("python -m stad_lab probe --run ..."),
    }


def describe_probe(found: dict) -> str:
    """What `probe_run` found, in lines: R2 for each driver, z and z with h, and quantity."""
    lines = [f"R2 of a linear probe: V and M of {found['variant']}"]
    for driver, by_features in found["drivers"].items():
        lines.append(f"  {driver:18s}" + "".join(f"{quantity:>16s}" for quantity in MOTION))
        for features, by_quantity in by_features.items():
            cells = (f"{by_quantity[quantity]['r2'] + 0.0:16.2f}" for quantity in MOTION)
            lines.append(f"    {features:16s}" + "".join(cells))
    return "\n".join(lines)


def shorter_encoder(study: Study, **change) -> Encoder:
    """V of `input_output`, trained with one change for a share of the steps; kept in `work`."""
    ((name, value),), usual = change.items(), study.config.vae
    if value == getattr(usual, name):  # no change: one training serves all comparisons
        name, value = "stride", usual.stride
    folder = study.work / f"{name}_{value:g}"
    settings = {"steps": round(SHORTER * usual.steps), **change}
    config = study.config.replace(variant="input_output", vae=settings)
    train(config, folder, study.dataset, until="vae")
    vae, _ = weights.load_vae(folder / weights.VAE_FILE)
    return Encoder(vae, config.vae.stride, config.data.crop_bar, {})


def vae_part(study: Study) -> dict:
    """Measure V of every variant, and rate against distortion."""

    def measured(encoder: Encoder) -> dict:
        vae, stride, crop_bar, _ = encoder
        films = [one.frames(crop_bar) for one in study.trajectories]
        frames = np.concatenate([film[stride::3] for film in films])
        earlier = np.concatenate([earlier_frames(film, stride)[stride::3] for film in films])
        return metrics.vae_metrics(vae, frames, earlier)

    variants = {variant: measured(encoder_of(model, {})) for variant, model in shipped()}
    shorter = {f"{one:g}": measured(shorter_encoder(study, kl_weight=one)) for one in KL_WEIGHTS}
    return {"variants": variants, "rate_distortion": shorter}


def mdn_rnn_part(study: Study) -> dict:
    """Measure M of every variant; for `input` also the reduced M."""
    whole = [one for one in study.trajectories if len(one) == RANDOM_FRAMES]
    actions = np.array([one.actions for one in whole])
    result: dict[str, Any] = {
        "whole_trajectories": len(whole),
        "horizon_steps": HORIZON,
        "variants": {},
    }
    for variant, model in shipped():
        how = model.stride, model.crop_bar
        encoded = [encode_trajectory(model.vae, one, *how) for one in whole]
        mu, logvar = np.array(encoded).swapaxes(0, 1)
        z = sample_latents(mu, logvar, random_stream("heldout", 0))
        kl = kl_divergence(torch.from_numpy(mu), torch.from_numpy(logvar))
        active = kl.mean(dim=(0, 1)).numpy() > metrics.ACTIVE
        mixture, some = metrics.predict(model.mdn_rnn, z, actions), mu[:DREAMERS]
        counts, _ = np.histogram(metrics.pit(mixture, z)[..., active], bins=20, range=(0, 1))
        dreamed = metrics.dream_open_loop(model.mdn_rnn, some, actions[:DREAMERS], AWAKE)
        nll = {"M": metrics.mixture_nll(mixture, z), **simple_predictions(z, actions)}
        if variant == "input":
            nll |= reduced_predictions(study, model, z, actions)
        result["variants"][variant] = {
            "active": int(active.sum()),
            "nll": compare(nll, active),
            "pit": (counts / counts.sum()).tolist(),
            "horizon": metrics.horizon_errors(model.vae, dreamed, some, AWAKE, HORIZON),
        }
    return result


def compare(nll: dict[str, np.ndarray], active: np.ndarray) -> dict:
    """Predictions beside M: name -> mean nats, its interval, and that of the difference to M.

    Their nll (trajectories, frames, latent_size) counts on the second half of the trajectories, as
    the simple ones need the first, on frames that all predict, and where `active` (latent_size,).
    """
    half, frames = len(nll["M"]) // 2, min(found.shape[1] for found in nll.values())
    means = {name: one[half:, -frames:, active].mean(axis=(1, 2)) for name, one in nll.items()}
    return {
        name: {
            "nats": float(found.mean()),
            "interval": bootstrap(found[None], RESAMPLES),
            "more_than_M": bootstrap((found - means["M"])[None], RESAMPLES),
        }
        for name, found in means.items()
    }


def simple_predictions(z: np.ndarray, actions: np.ndarray) -> dict[str, np.ndarray]:
    """NLL of predictions without a network, fitted on the first half of the trajectories."""
    first, driven = z[: len(z) // 2], actions[: len(z) // 2]
    return {
        "always the same": metrics.constant_prediction(first, z),
        "repeat the last z": metrics.repeat_prediction(first, z),
        "linear, last z": metrics.linear_prediction(first, driven, z, actions, order=1),
        "linear, last 4 z": metrics.linear_prediction(first, driven, z, actions, order=4),
    }


def reduced_predictions(
    study: Study, model: WorldModel, z: np.ndarray, actions: np.ndarray
) -> dict[str, np.ndarray]:
    """NLL of M that lack something, trained like the whole one."""
    result, usual = {}, study.config.mdn_rnn
    for name, (changes, sees_actions) in REDUCED.items():
        batch = usual.batch * usual.sequence // changes.get("sequence", usual.sequence)
        config = study.config.replace(variant=model.vae.variant, mdn_rnn={"batch": batch} | changes)
        path = study.work / name.replace(" ", "_") / weights.MDN_RNN_FILE
        if not path.exists():
            dataset = Dataset(study.dataset)
            shown = [action * sees_actions for action in dataset.actions]
            encoded = encode_dataset(model.vae, dataset, model.stride)
            latents = Latents(encoded, shown, dataset.first_heldout, model.checksums["vae"])
            with torch_settings(config.seed, 1) as device:
                fit_mdn_rnn(config, latents, path, device)
        mdn_rnn, metadata = weights.load_mdn_rnn(path)
        weights.check_belongs(path, metadata, vae=model.checksums["vae"])
        check_same(path, metadata["mdn_rnn"], dataclasses.asdict(config.mdn_rnn))
        if config.mdn_rnn.sequence > 1:
            mixture = metrics.predict(mdn_rnn, z, actions * sees_actions)
            result[name] = metrics.mixture_nll(mixture, z)
        else:
            result[name] = metrics.single_step_nll(mdn_rnn, z, actions)
    return result


PARTS = {"probe": probe_part, "vae": vae_part, "mdn_rnn": mdn_rnn_part}
