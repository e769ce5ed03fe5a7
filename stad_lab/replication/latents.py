"""What the latents carry, and how good V and M are, on episodes that nothing was trained on::

    probe    a linear probe for six quantities of the car's true motion, from z and from z with h:
             in every variant, in an untrained V, and for other strides
    bar      the same for the shipped agents' V and M, which see the indicator bar
    vae      the errors of V in every variant, and rate against distortion over the KL weight
    mdn_rnn  the NLL of M beside simple predictions and reduced M, its calibration, and the error
             of its dreams

The V and M trained without the bar (`cropped_...`) are measured. What they are compared with is
trained in a working folder, on a dataset of the same configuration, and kept there.
"""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from stad_lab.agent import PRETRAINED, encode_episode, load_agent, remember_episode, run_folder
from stad_lab.config import VARIANTS, Config, random_stream, track_seeds
from stad_lab.envs.frames import earlier_frames
from stad_lab.evaluation.metrics import (
    ACTIVE,
    constant_prediction,
    dream_open_loop,
    horizon_errors,
    linear_prediction,
    mixture_nll,
    pit,
    predict,
    repeat_prediction,
    single_step_nll,
    vae_metrics,
)
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
from stad_lab.io.files import load_json, save_json
from stad_lab.io.weights import (
    MDN_RNN_FILE,
    VAE_FILE,
    WorldModel,
    check_belongs,
    load_mdn_rnn,
    load_vae,
    load_world_model,
)
from stad_lab.io.workers import run_in_order, worker_processes
from stad_lab.models.mdn_rnn import MDNRNN
from stad_lab.models.vae import VAE, kl_divergence
from stad_lab.training.dataset import Dataset, collect
from stad_lab.training.mdn_rnn import Latents, encode_dataset, fit_mdn_rnn, sample_latents
from stad_lab.training.pipeline import provenance, train
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

Drivers = dict[str, tuple[list[Trajectory], int]]
"""Driver -> its trajectories, and how many first frames of each are not probed."""


def measure(config: Config, dataset_folder: Path, work: Path, parts: list[str]) -> dict:
    """Measure some parts, and write each into `work/latents.json` as soon as it is measured.

    Args:
        config: of the dataset and of what is trained here.
        dataset_folder: collected if it is not there.
        work: folder for what is trained.
        parts: some of PARTS.

    Returns:
        A dict for JSON: for each part what was found, its "config" and what it was "made_with".
    """
    if unknown := [part for part in parts if part not in PARTS]:
        raise ValueError(f"unknown part {unknown[0]!r}: choose from {', '.join(PARTS)}")
    collect(config, dataset_folder)
    count = max(FEWEST, config.data.episodes // 5)
    trajectories = random_trajectories(count, config.seed + 1, config.processes)
    file, result = Path(work) / "latents.json", {}
    for name in parts:
        found = PARTS[name](config, Path(dataset_folder), Path(work), trajectories)
        made_with = provenance(f"python -m stad_lab latents --parts {name} --out ...")
        about = {"trajectories": len(trajectories), "config": config.as_dict()}
        result[name] = {**found, **about, "made_with": made_with}
        save_json(file, (load_json(file) if file.exists() else {}) | result)
    return result


def random_trajectories(count: int, seed: int, processes: int) -> list[Trajectory]:
    """Trajectories of the random driver, from random tiles of tracks kept for inspection."""
    data = {"episodes": count, "episode_frames": RANDOM_FRAMES, "random_starts": 1.0}
    one = functools.partial(record_random_trajectory, Config(seed=seed).replace(data=data))
    return record_all(one, list(range(count)), "random", processes)


def agent_trajectories(count: int, processes: int) -> list[Trajectory]:
    """The beginnings of episodes of AGENT: the road at speed, which no random driver sees."""
    return record_all(begin_episode, track_seeds("inspect", count, 2), "agent", processes)


def record_all(
    record: Callable[[int], Trajectory], numbers: list[int], label: str, processes: int
) -> list[Trajectory]:
    """`record` of every number, in worker processes."""
    with worker_processes(processes) as executor:
        tasks = [(number,) for number in numbers]
        return run_in_order(executor, record, tasks, f"{label} trajectories")


def begin_episode(track: int) -> Trajectory:
    """The first frames of an episode of AGENT. Runs in a worker process."""
    return record_trajectory(load_agent(AGENT), track, AGENT_FRAMES)


def two_drivers(trajectories: list[Trajectory], processes: int) -> Drivers:
    """The random driver's trajectories, and a third as many of AGENT."""
    by_agent = agent_trajectories(max(FEWEST, len(trajectories) // 3), processes)
    return {"random driver": (trajectories, RANDOM_SKIP), "trained agent": (by_agent, AGENT_SKIP)}


def probe_part(
    config: Config, dataset_folder: Path, work: Path, trajectories: list[Trajectory]
) -> dict:
    """Probe the latents of every variant, and of every stride, under two drivers."""
    drivers = two_drivers(trajectories, config.processes)
    result = {"variants": probe_variants(config, "cropped_", drivers), "strides": {}}
    for driver, (driven, skip) in drivers.items():
        found = result["strides"][driver] = {}
        for stride in STRIDES:
            vae = shorter_vae(config, dataset_folder, work, stride=stride)
            found[str(stride)] = probe_trajectories(driven, skip, vae, {}, stride, True)
    return result


def bar_part(
    config: Config, dataset_folder: Path, work: Path, trajectories: list[Trajectory]
) -> dict:
    """Probe the shipped agents' V and M: do their latents carry what the indicator bar shows?"""
    drivers = two_drivers(trajectories, config.processes)
    return {"variants": probe_variants(config.replace(data={"crop_bar": False}), "", drivers)}


def probe_variants(config: Config, prefix: str, drivers: Drivers) -> dict:
    """Probe the shipped V and M of every variant, and untrained ones.

    Returns:
        Driver -> source -> features -> what `probe_trajectories` finds.
    """
    sizes = config.vae.latent_size, config.vae.width
    with torch_settings(config.seed, 0):
        untrained = {name: VAE(name, *sizes) for name in ("frame", "input_output")}
        settings = config.mdn_rnn
        untrained_mdn_rnn = MDNRNN(sizes[0], settings.hidden_size, settings.mixtures)
    result = {}
    for driver, (driven, skip) in drivers.items():
        found = result[driver] = {}
        for variant in VARIANTS:
            world_model = load_world_model(PRETRAINED / f"{prefix}{variant}")
            how = world_model.stride, world_model.crop_bar
            memories = {"z, h": world_model.mdn_rnn, "z, h of an untrained M": untrained_mdn_rnn}
            found[variant] = probe_trajectories(driven, skip, world_model.vae, memories, *how)
        for name, vae in untrained.items():
            how = config.vae.stride, config.data.crop_bar
            found[f"{name}, untrained"] = probe_trajectories(driven, skip, vae, {}, *how)
    return result


def probe_trajectories(
    trajectories: list[Trajectory],
    skip: int,
    vae: VAE,
    memories: dict[str, MDNRNN],
    stride: int,
    crop_bar: bool,
) -> dict:
    """Probe the mean of z, which C sees, and z with the memory of each M in `memories`.

    Only frames count in which the road is in sight, after the first `skip` of each trajectory.

    Returns:
        {"z": {quantity: {"r2": number, "interval": [low, high]}}}, and so for every M.
    """
    latents = [encode_trajectory(vae, one, stride, crop_bar)[0] for one in trajectories]
    features = {"z": np.concatenate(latents)}
    for name, mdn_rnn in memories.items():
        hidden = [
            remember_episode(mdn_rnn, z, one.actions)
            for z, one in zip(latents, trajectories, strict=True)
        ]
        features[name] = np.concatenate([features["z"], np.concatenate(hidden)], axis=1)
    lengths = [len(one) for one in trajectories]
    motion = np.concatenate([one.motion for one in trajectories])
    number = np.repeat(np.arange(len(trajectories)), lengths)
    moment = np.concatenate([np.arange(length) for length in lengths])
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
    """Probe V and M of one run for the true motion, under two drivers.

    Args:
        source: a shipped agent, or the folder of a run with V and M.
        count: trajectories of the random driver.
        processes: that drive.

    Returns:
        A dict for JSON: "variant", checksums of "vae" and "mdn_rnn", "trajectories", "drivers"
        (driver -> what `probe_trajectories` finds of "z" and of "z, h") and "made_with".

    Raises:
        ValueError: too few trajectories, or V and M that do not belong together.
        FileNotFoundError: no V or M there.
    """
    if count < FEWEST:
        raise ValueError(f"episodes={count}: expected at least {FEWEST}, to fit and measure on")
    model = load_world_model(run_folder(source))
    drivers = two_drivers(random_trajectories(count, PROBE_SEED, processes), processes)
    memories, how = {"z, h": model.mdn_rnn}, (model.stride, model.crop_bar)
    return {
        "kind": "probe",
        "variant": model.vae.variant,
        **model.checksums,
        "trajectories": count,
        "drivers": {
            name: probe_trajectories(driven, skip, model.vae, memories, *how)
            for name, (driven, skip) in drivers.items()
        },
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


def shorter_vae(config: Config, dataset_folder: Path, work: Path, **change) -> VAE:
    """V of `input_output`, trained with one change for a share of the steps; kept in `work`."""
    ((name, value),) = change.items()
    if value == getattr(config.vae, name):  # no change: one training serves all comparisons
        name, value = "stride", config.vae.stride
    settings = {"steps": round(SHORTER * config.vae.steps), **change}
    folder = work / f"{name}_{value:g}"
    changed = config.replace(variant="input_output", vae=settings)
    train(changed, folder, dataset_folder, until="vae")
    return load_vae(folder / VAE_FILE)[0]


def vae_part(
    config: Config, dataset_folder: Path, work: Path, trajectories: list[Trajectory]
) -> dict:
    """Measure V of every variant, and rate against distortion."""

    def metrics(vae: VAE, stride: int, crop_bar: bool) -> dict:
        films = [one.frames(crop_bar) for one in trajectories]
        pairs = [(film[stride::3], earlier_frames(film, stride)[stride::3]) for film in films]
        return vae_metrics(vae, *(np.concatenate(part) for part in zip(*pairs, strict=True)))

    variants, rate_distortion = {}, {}
    for variant in VARIANTS:
        model = load_world_model(PRETRAINED / f"cropped_{variant}")
        variants[variant] = metrics(model.vae, model.stride, model.crop_bar)
    for weight in KL_WEIGHTS:
        vae = shorter_vae(config, dataset_folder, work, kl_weight=weight)
        rate_distortion[f"{weight:g}"] = metrics(vae, config.vae.stride, config.data.crop_bar)
    return {"variants": variants, "rate_distortion": rate_distortion}


def mdn_rnn_part(
    config: Config, dataset_folder: Path, work: Path, trajectories: list[Trajectory]
) -> dict:
    """Measure M of every variant; for `input` also the reduced M."""
    whole = [one for one in trajectories if len(one) == RANDOM_FRAMES]
    actions = np.array([one.actions for one in whole])
    result = {"whole_trajectories": len(whole), "horizon_steps": HORIZON, "variants": {}}
    for variant in VARIANTS:
        model = load_world_model(PRETRAINED / f"cropped_{variant}")
        encoded = [encode_episode(model.vae, one.frames(True), model.stride) for one in whole]
        mu, logvar = np.array(encoded).swapaxes(0, 1)
        z = sample_latents(mu, logvar, random_stream("heldout", 0))
        kl = kl_divergence(torch.from_numpy(mu), torch.from_numpy(logvar))
        active = kl.mean(dim=(0, 1)).numpy() > ACTIVE
        mixture = predict(model.mdn_rnn, z, actions)
        counts, _ = np.histogram(pit(mixture, z)[..., active], bins=20, range=(0, 1))
        dreamed = dream_open_loop(model.mdn_rnn, mu[:DREAMERS], actions[:DREAMERS], AWAKE)
        nll = {"M": mixture_nll(mixture, z), **simple_predictions(z, actions)}
        if variant == "input":
            one = config.replace(variant=variant)
            nll |= reduced_predictions(one, dataset_folder, work, model, z, actions)
        result["variants"][variant] = {
            "active": int(active.sum()),
            "nll": compare(nll, active),
            "pit": (counts / counts.sum()).tolist(),
            "horizon": horizon_errors(model.vae, dreamed, mu[:DREAMERS], AWAKE, HORIZON),
        }
    return result


def compare(nll: dict[str, np.ndarray], active: np.ndarray) -> dict:
    """Predictions beside M, on the second half of the trajectories: the simple ones need the first.

    All are judged on the same frames, those of the longest prediction, and on active latents only:
    the others are noise.

    Args:
        nll: name -> nats (trajectories, frames, latent_size); "M" among them.
        active: bool (latent_size,).

    Returns:
        Name -> {"nats": mean, "interval": of it, "more_than_M": interval of the difference}.
    """
    frames = min(found.shape[1] for found in nll.values())
    means = {
        name: found[len(found) // 2 :, -frames:, active].mean(axis=(1, 2))
        for name, found in nll.items()
    }
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
    half = len(z) // 2
    fitted = z[:half], actions[:half]
    return {
        "always the same": constant_prediction(z[:half], z),
        "repeat the last z": repeat_prediction(z[:half], z),
        "linear, last z": linear_prediction(*fitted, z, actions, order=1),
        "linear, last 4 z": linear_prediction(*fitted, z, actions, order=4),
    }


def reduced_predictions(
    config: Config,
    dataset_folder: Path,
    work: Path,
    model: WorldModel,
    z: np.ndarray,
    actions: np.ndarray,
) -> dict[str, np.ndarray]:
    """NLL of M that lack something, trained like the whole one."""
    result, weights = {}, model.checksums["vae"]
    for name, (changes, sees_actions) in REDUCED.items():
        path = work / name.replace(" ", "_") / MDN_RNN_FILE
        reduced = config.replace(mdn_rnn=changes)
        frames = config.mdn_rnn.batch * config.mdn_rnn.sequence
        reduced = reduced.replace(mdn_rnn={"batch": frames // reduced.mdn_rnn.sequence})
        if not path.exists():
            dataset = Dataset(dataset_folder)
            shown = [action * sees_actions for action in dataset.actions]
            encoded = encode_dataset(model.vae, dataset, model.stride)
            latents = Latents(encoded, shown, dataset.first_heldout, weights)
            with torch_settings(config.seed, 1) as device:
                fit_mdn_rnn(reduced, latents, path, device)
        mdn_rnn, metadata = load_mdn_rnn(path)
        check_belongs(path, metadata, vae=weights)
        if metadata["mdn_rnn"] != dataclasses.asdict(reduced.mdn_rnn):
            raise ValueError(f"{path} was trained with other settings: choose another folder")
        if reduced.mdn_rnn.sequence > 1:
            result[name] = mixture_nll(predict(mdn_rnn, z, actions * sees_actions), z)
        else:
            result[name] = single_step_nll(mdn_rnn, z, actions)
    return result


PARTS = {"probe": probe_part, "bar": bar_part, "vae": vae_part, "mdn_rnn": mdn_rnn_part}
