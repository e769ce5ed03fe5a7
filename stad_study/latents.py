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
from typing import Any

import numpy as np
import torch

from stad_lab.agent import PRETRAINED
from stad_lab.config import PRESETS, VARIANTS, Config, check_same, random_stream
from stad_lab.envs.frames import earlier_frames
from stad_lab.evaluation import metrics
from stad_lab.evaluation.probe_run import (
    FEWEST_TRAJECTORIES,
    LONGEST_STRIDE,
    RANDOM_FRAMES,
    Encoder,
    encoder_of,
    probe_trajectories,
    random_trajectories,
    two_drivers,
)
from stad_lab.evaluation.statistics import bootstrap
from stad_lab.evaluation.trajectories import (
    Trajectory,
    encode_trajectory,
)
from stad_lab.io import weights
from stad_lab.io.files import load_json, save_json
from stad_lab.io.weights import WorldModel, load_world_model
from stad_lab.models.mdn_rnn import MDNRNN
from stad_lab.models.vae import VAE, kl_divergence
from stad_lab.training.dataset import Dataset, collect
from stad_lab.training.mdn_rnn import Latents, encode_dataset, fit_mdn_rnn, sample_latents
from stad_lab.training.pipeline import train
from stad_lab.training.record import provenance
from stad_lab.training.trainer import torch_settings

STRIDES = (1, 2, 4, LONGEST_STRIDE)
KL_WEIGHTS = (0.02, 0.08, 0.25, 1.0, 4.0, 16.0)
SHORTER = 0.3  # share of the steps for which the V of a comparison are trained
REDUCED = {  # an M that lacks something: the change, and whether it sees the actions
    "one Gaussian": ({"mixtures": 1}, True),
    "no actions": ({}, False),
    "no memory": ({"sequence": 1}, True),  # on as many frames, each on its own
}
AWAKE = 30  # frames that M sees before a dream
HORIZON = [1, 2, 3, 5, 7, 10, 14, 20, 30, 40, 50, 60, 70, 80, 90, 100]  # dreamed steps
RESAMPLES = 1000  # of the trajectories, for an interval
DREAMERS = 60  # trajectories from which M dreams on


@dataclass(frozen=True)
class Given:
    """What every part of `measure` works with."""

    config: Config  # of the dataset and of what is trained here
    dataset: Path
    work: Path  # folder for what is trained
    trajectories: list[Trajectory]  # of the random driver


def measure(config: Config, dataset_folder: Path, work: Path, parts: Sequence[str]) -> dict:
    """Measure some of PARTS, and write each into `work/latents.json` as soon as it is measured.

    The dataset is collected if it is not there. Returns what is written, part by part.
    """
    if unknown := [part for part in parts if part not in PARTS]:
        raise ValueError(f"unknown part {unknown[0]!r}: choose from {', '.join(PARTS)}")
    if (file := work / "latents.json").exists():
        load_json(file)  # before any work: it may be damaged
    preset = next((f" --preset {name}" for name, one in PRESETS.items() if one == config), "")
    command = f"python -m stad_study latents{preset} --out ... --parts "
    made_with = provenance(command)  # before the work: the checkout may change meanwhile
    collect(config, dataset_folder)
    count = max(FEWEST_TRAJECTORIES, config.data.episodes // 5)
    driven = random_trajectories(count, config.seed + 1, config.processes)
    given, result = Given(config, dataset_folder, work, driven), {}
    for name in parts:
        found = PARTS[name](given)
        found |= {"trajectories": len(driven), "config": config.as_dict()}
        found["made_with"] = made_with | {"command": command + name}
        result[name] = found
        save_json(file, (load_json(file) if file.exists() else {}) | result)
    return result


def shipped(prefix: str = "cropped_") -> Iterator[tuple[str, WorldModel]]:
    """The variants, and the shipped V and M of each; with the prefix "" those that see the bar."""
    for variant in VARIANTS:
        yield variant, load_world_model(PRETRAINED / f"{prefix}{variant}")


def probe_part(given: Given) -> dict:
    """Probe the latents of every variant, of untrained V, and of every stride: two drivers."""
    config, names = given.config, ("frame", "input_output")
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
        encoders[f"stride {stride}"] = shorter_encoder(given, stride=stride)
    found = {
        driver: {name: probe_trajectories(*driven, one) for name, one in encoders.items()}
        for driver, driven in two_drivers(given.trajectories, config.processes).items()
    }
    return {"drivers": found}


def shorter_encoder(given: Given, **change) -> Encoder:
    """V of `input_output`, trained with one change for a share of the steps; kept in `work`."""
    ((name, value),), usual = change.items(), given.config.vae
    if value == getattr(usual, name):  # no change: one training serves all comparisons
        name, value = "stride", usual.stride
    folder = given.work / f"{name}_{value:g}"
    settings = {"steps": round(SHORTER * usual.steps), **change}
    config = given.config.replace(variant="input_output", vae=settings)
    train(config, folder, given.dataset, until="vae")
    vae, _ = weights.load_vae(folder / weights.VAE_FILE)
    return Encoder(vae, config.vae.stride, config.data.crop_bar, {})


def vae_part(given: Given) -> dict:
    """Measure V of every variant, and rate against distortion."""

    def measured(encoder: Encoder) -> dict:
        vae, stride, crop_bar, _ = encoder
        films = [one.frames(crop_bar) for one in given.trajectories]
        frames = np.concatenate([film[stride::3] for film in films])
        earlier = np.concatenate([earlier_frames(film, stride)[stride::3] for film in films])
        return metrics.vae_metrics(vae, frames, earlier)

    variants = {variant: measured(encoder_of(model, {})) for variant, model in shipped()}
    shorter = {f"{one:g}": measured(shorter_encoder(given, kl_weight=one)) for one in KL_WEIGHTS}
    return {"variants": variants, "rate_distortion": shorter}


def mdn_rnn_part(given: Given) -> dict:
    """Measure M of every variant; for `input` also the reduced M."""
    whole = [one for one in given.trajectories if len(one) == RANDOM_FRAMES]
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
            nll |= reduced_predictions(given, model, z, actions)
        result["variants"][variant] = {
            "active": int(active.sum()),
            "nll": compare_nll(nll, active),
            "pit": (counts / counts.sum()).tolist(),
            "horizon": metrics.horizon_errors(model.vae, dreamed, some, AWAKE, HORIZON),
        }
    return result


def compare_nll(nll: dict[str, np.ndarray], active: np.ndarray) -> dict:
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
    given: Given, model: WorldModel, z: np.ndarray, actions: np.ndarray
) -> dict[str, np.ndarray]:
    """NLL of M that lack something, trained like the whole one."""
    result, usual = {}, given.config.mdn_rnn
    for name, (changes, sees_actions) in REDUCED.items():
        batch = usual.batch * usual.sequence // changes.get("sequence", usual.sequence)
        config = given.config.replace(variant=model.vae.variant, mdn_rnn={"batch": batch} | changes)
        path = given.work / name.replace(" ", "_") / weights.MDN_RNN_FILE
        if not path.exists():
            dataset = Dataset(given.dataset)
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
