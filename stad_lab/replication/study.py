"""The study: what the latents know, measured on drives that nothing was trained on. Its record is what we report::

    probe        how well six numbers of the car's true motion can be read off z, and off z and h, in every variant, in
                 a V without training, and for other strides
    bar          the same for V and M of the second rounds, which see the indicator bar
    autoencoder  the quality of V in every variant, and rate against distortion over the weight of the KL
    mdn_rnn      the quality of M: its NLL beside simple forecasts and lesser M's, its calibration, its dreams' error

The V and M that come with stad_lab are measured. What else the comparison needs is trained in a working folder, on
rollouts by the settings that those had, and is kept; what is measured is measured again at every start (choose with
--part what is still missing). (The shipped ones saw the pictures of an earlier version of the fast renderer: what is
trained here has the advantage of the present one.)
"""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from stad_lab.agent import PRETRAINED, WorldModel, load_agent, load_world_model, run_folder
from stad_lab.config import Settings
from stad_lab.envs.frames import earlier_frames
from stad_lab.evaluation.evaluate import bootstrap
from stad_lab.evaluation.metrics import (
    ACTIVE,
    autoencoder_quality,
    constant_forecast,
    dream_with,
    forecast,
    horizon_errors,
    linear_forecast,
    mixture_nll,
    pit,
    repeat_forecast,
    single_step_nll,
)
from stad_lab.evaluation.probe import probe
from stad_lab.evaluation.trajectories import (
    MOTION,
    Drive,
    encode_drive,
    record_drive,
    record_random_drive,
    remember_drive,
    road_in_sight,
)
from stad_lab.io.files import load_json, save_json
from stad_lab.io.workers import run_in_order, worker_processes
from stad_lab.models.mdn_rnn import (
    MDNRNN,
    check_partner,
    encode_rollouts,
    fit_mdn_rnn,
    load_mdn_rnn,
    sample_latents,
)
from stad_lab.models.vae import (
    VARIANTS,
    AutoEncoder,
    check_facts,
    check_variant,
    kl_divergence,
    load_autoencoder,
)
from stad_lab.training.dataset import Rollouts, collect_rollouts, track_seeds
from stad_lab.training.pipeline import open_record, provenance, train
from stad_lab.training.trainer import training_device

STRIDES = (1, 2, 4, 8)
KL_WEIGHTS = (0.02, 0.08, 0.25, 1.0, 4.0, 16.0)
SHORTER = (
    0.3  # the V's of the comparisons are trained for this share of the steps, all of them alike
)
CONTENDERS = {  # lesser M's: what is changed, and whether they see the actions
    "one Gaussian": ({"mixtures": 1}, True),
    "no actions": ({}, False),
    "no memory": ({"m_sequence": 1}, True),  # on as many frames, each on its own
}
DRIVE_FRAMES, AGENT_FRAMES = 150, 360  # of a drive of the random driver, and of the agent
# Frames of a drive that are not probed: without a difference image, or with the opening zoom, which tells the speed.
RANDOM_SKIP, AGENT_SKIP = max(STRIDES), 60
FEWEST_DRIVES = 12  # a probe is fitted on some and measured on others
PROBE_DRIVES, PROBE_SEED = (
    180,
    100,
)  # of the random driver, when a run is probed; no rollouts of ours have this seed
STUDY_COMMAND = "python -m stad_lab study --settings {} --part {} --out ..."
RECORD = Path(__file__).parents[1] / "records" / "study.json"  # the study that we report
AWAKE = 30  # frames that M sees before a dream
HORIZON = [
    1,
    2,
    3,
    5,
    7,
    10,
    14,
    20,
    30,
    40,
    50,
    60,
    70,
    80,
    90,
    100,
]  # dreamed steps at which it is judged
DRIVE_RESAMPLES = 1000  # of the drives, for an interval
DREAMERS = 60  # drives in which M falls asleep


def study(settings: Settings, rollouts_folder: Path, work: Path, parts: list[str]) -> dict:
    """Measure the parts of the study.

    Args:
        settings: of the rollouts, and of what is trained here; `laptop` is what the shipped V and M were made with.
        rollouts_folder: collected if they are not there.
        work: folder for what is trained, and for `study.json`, to which each part is added as soon as it is measured.
        parts: some of PARTS.

    Returns:
        A dict for JSON: for each part what it found, its "settings", and what it was "made_with".
    """
    check_parts(parts)
    collect_rollouts(settings, rollouts_folder)
    drives = random_drives(
        max(FEWEST_DRIVES, settings.episodes // 5), settings.seed + 1, settings.processes
    )
    file, result = Path(work) / "study.json", {}
    for name in parts:
        found = PARTS[name](settings, Path(rollouts_folder), Path(work), drives)
        made_with = provenance(STUDY_COMMAND.format(settings.name, name))
        result[name] = {
            **found,
            "drives": len(drives),
            "settings": settings.as_dict(),
            "made_with": made_with,
        }
        save_json(file, (load_json(file) if file.exists() else {}) | result)
    return result


def check_parts(parts: list[str]) -> None:
    """Raise ValueError unless every part is one of PARTS."""
    for part in parts:
        if part not in PARTS:
            raise ValueError(f"unknown part {part!r}: choose from {', '.join(PARTS)}")


def random_drives(count: int, seed: int, processes: int) -> list[Drive]:
    """Drives of the random driver, each from a random tile of a track kept for inspection.

    With the seed of some rollouts its hand would do there what it did in those.
    """
    settings = Settings.preset(
        "laptop", seed=seed, episodes=count, episode_frames=DRIVE_FRAMES, random_starts=1.0
    )
    return record_all(
        functools.partial(record_random_drive, settings), list(range(count)), "random", processes
    )


def agent_drives(count: int, processes: int) -> list[Drive]:
    """The beginnings of drives of the shipped `input` agent: the road at speed, which no random driver sees."""
    return record_all(begin_agent_drive, track_seeds("inspect", count, 2), "agent", processes)


def record_all(
    record: Callable[[int], Drive], numbers: list[int], label: str, processes: int
) -> list[Drive]:
    """`record` of every number, in worker processes."""
    with worker_processes(processes) as executor:
        return run_in_order(executor, record, [(number,) for number in numbers], f"{label} drives")


def begin_agent_drive(track: int) -> Drive:
    """The first frames of a drive of the shipped `input` agent. Runs in a worker process."""
    return record_drive(load_agent("input"), track, AGENT_FRAMES)


def probe_part(settings: Settings, rollouts_folder: Path, work: Path, drives: list[Drive]) -> dict:
    """Probe the latents of every variant, and of every stride, for the true motion, under two drivers."""
    strides = {
        str(stride): shorter_autoencoder(settings, rollouts_folder, work, stride=stride)
        for stride in STRIDES
    }
    drivers = two_drivers(drives, settings.processes)
    result = {"variants": probe_variants(settings, PRETRAINED, drivers), "strides": {}}
    for driver, (driven, skip) in drivers.items():
        found = result["strides"][driver] = {}
        for stride, autoencoder in strides.items():
            found[stride] = probe_drives(
                driven, skip, autoencoder, {}, int(stride), settings.crop_bar
            )
    return result


def bar_part(settings: Settings, rollouts_folder: Path, work: Path, drives: list[Drive]) -> dict:
    """Probe the latents of the second rounds' V and M as `probe_part` does: do they hold the gauges of the bar?"""
    with_bar = dataclasses.replace(settings, crop_bar=False)
    return {
        "variants": probe_variants(
            with_bar, PRETRAINED / "second_round", two_drivers(drives, settings.processes)
        )
    }


def two_drivers(drives: list[Drive], processes: int) -> dict[str, tuple[list[Drive], int]]:
    """The two drivers under which latents are probed: name -> their drives, and how many first frames do not count."""
    by_agent = agent_drives(max(FEWEST_DRIVES, len(drives) // 3), processes)
    return {"random driver": (drives, RANDOM_SKIP), "trained agent": (by_agent, AGENT_SKIP)}


def probe_variants(
    settings: Settings, home: Path, drivers: dict[str, tuple[list[Drive], int]]
) -> dict:
    """Probe V and M of every variant in `home`, and V's and an M with random weights: driver -> source -> features."""
    torch.manual_seed(settings.seed)
    untrained = {
        f"{name}, untrained": AutoEncoder(name, settings.latent_size, settings.width)
        for name in ("frame", "input_output")
    }
    untrained_mdn_rnn = MDNRNN(
        settings.latent_size, settings.hidden_size, settings.mixtures
    ).requires_grad_(False)
    result = {}
    for driver, (driven, skip) in drivers.items():
        found = result[driver] = {}
        for variant in VARIANTS:
            autoencoder, mdn_rnn, stride, crop_bar, _ = load_world_model(home / variant, variant)
            memories = {"z, h": mdn_rnn, "z, h of an untrained M": untrained_mdn_rnn}
            found[variant] = probe_drives(driven, skip, autoencoder, memories, stride, crop_bar)
        for name, autoencoder in untrained.items():
            found[name] = probe_drives(
                driven, skip, autoencoder, {}, settings.stride, settings.crop_bar
            )
    return result


def probe_drives(
    drives: list[Drive],
    skip: int,
    autoencoder: AutoEncoder,
    memories: dict[str, MDNRNN],
    stride: int,
    crop_bar: bool,
) -> dict:
    """Probe the mean of z, which C is given, and z with what M's remember.

    Only frames count in which the road is in sight, after the first `skip` frames of each drive.

    Args:
        memories: name -> M.

    Returns:
        {"z": {quantity: {"r2": number, "interval": [low, high]}}}, and the same for every name in `memories`.
    """
    latents = [encode_drive(autoencoder, drive, stride, crop_bar)[0] for drive in drives]
    features = {"z": np.concatenate(latents)}
    for name, mdn_rnn in memories.items():
        hidden = [
            remember_drive(mdn_rnn, z, drive.actions)
            for z, drive in zip(latents, drives, strict=True)
        ]
        features[name] = np.concatenate([features["z"], np.concatenate(hidden)], axis=1)
    motion = np.concatenate([drive.motion for drive in drives])
    number = np.repeat(np.arange(len(drives)), [len(drive) for drive in drives])
    kept = road_in_sight(motion) & (
        np.concatenate([np.arange(len(drive)) for drive in drives]) >= skip
    )
    result = {}
    for name, seen in features.items():
        found = probe(seen[kept], motion[kept], number[kept])
        result[name] = {
            quantity: {"r2": float(r2), "interval": [float(low), float(high)]}
            for quantity, r2, low, high in zip(MOTION, *found.values(), strict=True)
        }
    return result


def probe_run(
    variant: str, path: str | Path | None = None, drives: int = PROBE_DRIVES, processes: int = 2
) -> dict:
    """Probe V and M of one run for the true motion, under the study's two drivers: what do *these* latents know?

    Args:
        variant: of the run.
        path: its folder, with V and M at least; None for those that come with stad_lab, as `load_agent` chooses them.
        drives: of the random driver; those of the agent are a third as many, but 12 at least.
        processes: that drive.

    Returns:
        A dict for JSON: "variant", "autoencoder" and "mdn_rnn" (the identities of V and M), "drives", "drivers" (name
        of the driver -> what `probe_drives` finds of "z" and of "z, h") and "made_with".

    Raises:
        ValueError: an unknown variant, too few drives, or V and M that are damaged or do not belong together.
        FileNotFoundError: no V or M there.
    """
    check_variant(variant)
    if drives < FEWEST_DRIVES:
        raise ValueError(
            f"drives={drives}: expected at least {FEWEST_DRIVES}, so that the probe has unseen ones"
        )
    autoencoder, mdn_rnn, stride, crop_bar, identities = load_world_model(
        run_folder(variant, path), variant
    )
    drivers = two_drivers(random_drives(drives, PROBE_SEED, processes), processes)
    return {
        "variant": variant,
        **identities,
        "drives": drives,
        "drivers": {
            name: probe_drives(driven, skip, autoencoder, {"z, h": mdn_rnn}, stride, crop_bar)
            for name, (driven, skip) in drivers.items()
        },
        "made_with": provenance(f"python -m stad_lab probe --variant {variant} --path ..."),
    }


def describe_probe(found: dict) -> str:
    """What `probe_run` found, in lines: the R2 of every quantity, for each driver and for z and z with h."""
    lines = [f"R2 of a linear probe: V and M of {found['variant']}"]
    for driver, by_features in found["drivers"].items():
        lines.append(f"  {driver:18s}" + "".join(f"{quantity:>16s}" for quantity in MOTION))
        for features, by_quantity in by_features.items():
            cells = (f"{by_quantity[quantity]['r2'] + 0.0:16.2f}" for quantity in MOTION)
            lines.append(f"    {features:16s}" + "".join(cells))
    return "\n".join(lines)


def probe_panels(found: dict) -> dict:
    """What `probe_part` found under one driver, as `plots.plot_intervals` wants it: quantity -> source -> features."""
    return {
        quantity: {
            source: {
                name: (r2s[quantity]["r2"], r2s[quantity]["interval"])
                for name, r2s in by_features.items()
            }
            for source, by_features in found.items()
        }
        for quantity in MOTION
    }


def shorter_autoencoder(
    settings: Settings, rollouts_folder: Path, work: Path, **change
) -> AutoEncoder:
    """V of the variant `input_output`, trained with one change for a share of the steps; loaded if it is there."""
    ((name, value),) = change.items()
    if value == getattr(settings, name):  # no change: one training serves all comparisons
        name, value = "stride", settings.stride
    recipe = dataclasses.replace(settings, v_steps=round(SHORTER * settings.v_steps), **change)
    folder = work / f"{name}_{value:g}"
    train("input_output", recipe, folder, rollouts_folder, until="autoencoder")
    return load_autoencoder(folder / "autoencoder.safetensors", "input_output")[0]


def autoencoder_part(
    settings: Settings, rollouts_folder: Path, work: Path, drives: list[Drive]
) -> dict:
    """Measure V of every variant, and rate against distortion."""

    def measure(autoencoder: AutoEncoder, stride: int, crop_bar: bool) -> dict:
        films = [drive.frames(crop_bar) for drive in drives]
        pairs = [(film[stride::3], earlier_frames(film, stride)[stride::3]) for film in films]
        return autoencoder_quality(
            autoencoder, *(np.concatenate(part) for part in zip(*pairs, strict=True))
        )

    variants = {}
    for variant in VARIANTS:
        autoencoder, facts = load_autoencoder(
            PRETRAINED / variant / "autoencoder.safetensors", variant
        )
        variants[variant] = measure(autoencoder, facts["stride"], facts["crop_bar"])
    rate_distortion = {}
    for weight in KL_WEIGHTS:
        autoencoder = shorter_autoencoder(settings, rollouts_folder, work, kl_weight=weight)
        rate_distortion[f"{weight:g}"] = measure(autoencoder, settings.stride, settings.crop_bar)
    return {"variants": variants, "rate_distortion": rate_distortion}


def mdn_rnn_part(
    settings: Settings, rollouts_folder: Path, work: Path, drives: list[Drive]
) -> dict:
    """Measure M of every variant; for `input` also the lesser M's."""
    whole = [drive for drive in drives if len(drive) == DRIVE_FRAMES]
    actions = np.array([drive.actions for drive in whole])
    result = {"whole_drives": len(whole), "horizon_steps": HORIZON, "variants": {}}
    for variant in VARIANTS:
        world_model = load_world_model(PRETRAINED / variant, variant)
        autoencoder, mdn_rnn, stride, crop_bar, _ = world_model
        mu, logvar = (
            np.array(part)
            for part in zip(
                *(encode_drive(autoencoder, drive, stride, crop_bar) for drive in whole),
                strict=True,
            )
        )
        z = sample_latents(mu, logvar, np.random.default_rng(0))
        active = (
            kl_divergence(torch.from_numpy(mu), torch.from_numpy(logvar)).mean(dim=(0, 1)).numpy()
            > ACTIVE
        )
        mixture = forecast(mdn_rnn, z, actions)
        counts, _ = np.histogram(pit(mixture, z)[..., active], bins=20, range=(0, 1))
        dreamed = dream_with(mdn_rnn, mu[:DREAMERS], actions[:DREAMERS], AWAKE)
        nll = {"M": mixture_nll(mixture, z), **simple_forecasts(z, actions)}
        if variant == "input":
            nll |= lesser_forecasts(settings, rollouts_folder, work, world_model, z, actions)
        result["variants"][variant] = {
            "active": int(active.sum()),
            "nll": compare(nll, active),
            "pit": (counts / counts.sum()).tolist(),
            "horizon": horizon_errors(autoencoder, dreamed, mu[:DREAMERS], AWAKE, HORIZON),
        }
    return result


def compare(nll: dict[str, np.ndarray], active: np.ndarray) -> dict:
    """Forecasts beside M, on the second half of the drives: the first half is what simple ones were fitted on.

    All are judged on the same frames, those that the longest forecast has, and on active latents only: the others are
    noise that V adds, which no forecast can foresee.

    Args:
        nll: name -> nats (drives, frames, latent_size), the last frames of each drive; "M" among them.
        active: bool (latent_size,).

    Returns:
        Name -> {"nats": mean, "interval": of it, "more_than_M": interval of the difference}, by bootstrap over drives.
    """
    frames = min(found.shape[1] for found in nll.values())
    means = {
        name: found[len(found) // 2 :, -frames:, active].mean(axis=(1, 2))
        for name, found in nll.items()
    }
    return {
        name: {
            "nats": float(found.mean()),
            "interval": bootstrap(found[None], DRIVE_RESAMPLES),
            "more_than_M": bootstrap((found - means["M"])[None], DRIVE_RESAMPLES),
        }
        for name, found in means.items()
    }


def simple_forecasts(z: np.ndarray, actions: np.ndarray) -> dict[str, np.ndarray]:
    """NLL of forecasts without a network, fitted on the first half of the drives, for all of them."""
    half = len(z) // 2
    return {
        "always the same": constant_forecast(z[:half], z),
        "repeat the last z": repeat_forecast(z[:half], z),
        "linear, last z": linear_forecast(z[:half], actions[:half], z, actions, order=1),
        "linear, last 4 z": linear_forecast(z[:half], actions[:half], z, actions, order=4),
    }


def lesser_forecasts(
    settings: Settings,
    rollouts_folder: Path,
    work: Path,
    world_model: WorldModel,
    z: np.ndarray,
    actions: np.ndarray,
) -> dict[str, np.ndarray]:
    """NLL of M's that lack something, trained like the whole one."""
    rollouts, encoded, result = Rollouts(rollouts_folder), None, {}
    identity = world_model.identities["autoencoder"]
    for name, (changes, sees_actions) in CONTENDERS.items():
        path = work / name.replace(" ", "_") / "mdn_rnn.safetensors"
        lesser = dataclasses.replace(settings, **changes)
        lesser = dataclasses.replace(
            lesser, m_batch=settings.m_batch * settings.m_sequence // lesser.m_sequence
        )
        record = open_record(
            path.parent, "input", lesser, STUDY_COMMAND.format(settings.name, "mdn_rnn")
        )
        if not path.exists():
            encoded = encoded or encode_rollouts(
                world_model.autoencoder, rollouts, world_model.stride
            )
            torch.manual_seed(settings.seed)
            mdn_rnn = MDNRNN(settings.latent_size, settings.hidden_size, lesser.mixtures).to(
                training_device()
            )
            shown = [action * sees_actions for action in rollouts.actions]
            fit_mdn_rnn(path, mdn_rnn, "input", identity, encoded, shown, rollouts, lesser)
            save_json(path.with_name("record.json"), record)
        mdn_rnn, facts = load_mdn_rnn(path, "input")
        check_facts(path, facts, lesser)
        check_partner(path, facts, autoencoder=identity)
        if lesser.m_sequence > 1:
            result[name] = mixture_nll(forecast(mdn_rnn, z, actions * sees_actions), z)
        else:
            result[name] = single_step_nll(mdn_rnn, z, actions)
    return result


PARTS = {
    "probe": probe_part,
    "bar": bar_part,
    "autoencoder": autoencoder_part,
    "mdn_rnn": mdn_rnn_part,
}
