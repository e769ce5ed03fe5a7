"""Training of V."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from stad_lab.config import Config, check_same, random_stream
from stad_lab.envs.frames import to_pictures
from stad_lab.io.files import locked
from stad_lab.io.weights import VAE_FILE, load_vae, save_vae
from stad_lab.models.vae import VAE, to_tensor, vae_losses
from stad_lab.training.dataset import Dataset
from stad_lab.training.trainer import Training, Watch, fit, torch_settings

CHECKPOINT = "vae.training.safetensors"
HELDOUT_FRAMES, HELDOUT_BATCHES = 1000, 8  # on which the loss is measured


def train_vae(
    config: Config,
    dataset: Callable[[], Dataset],
    folder: Path,
    watch: Watch | None = None,
) -> bool:
    """Train V into `folder`, or continue an interrupted training; False if V was there already.

    Args:
        dataset: opens the dataset.
        watch: called with the training's history as it grows.

    Raises:
        ValueError: a file in the folder is damaged or of another configuration or dataset.
        OSError: another process works in the folder, or a file cannot be read or written.
        FloatingPointError: the loss is not finite.
    """
    path = Path(folder) / VAE_FILE
    if path.exists():
        history = check_vae(config, folder)["history"]
        path.with_name(CHECKPOINT).unlink(missing_ok=True)  # of a process that was killed
        if watch:
            watch(history)
        return False
    data = dataset()
    with locked(path.parent), torch_settings(config.seed, 0) as device:
        vae = VAE.of(config)
        vae.to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        training = vae_training(config, data, vae, path.with_name(CHECKPOINT))
        training.watch = watch
        history = fit(training)
        save_vae(path, vae, config, history, data.checksum)
        training.checkpoint.unlink(missing_ok=True)
    return True


def vae_depends_on(config: Config) -> dict:
    """The configuration that V depends on, beside its dataset."""
    return {
        "variant": config.variant,
        "seed": config.seed,
        "crop_bar": config.data.crop_bar,
        "vae": dataclasses.asdict(config.vae),
    }


def check_vae(config: Config, folder: Path, dataset_checksum: str | None = None) -> dict:
    """V's metadata. ValueError if damaged, or of another configuration or dataset (None: any)."""
    path = Path(folder) / VAE_FILE
    metadata = load_vae(path)[1]
    check_same(path, metadata, vae_depends_on(config))
    if dataset_checksum and metadata["dataset"] and metadata["dataset"] != dataset_checksum:
        raise ValueError(f"{path} was trained on another dataset: give its own one")
    return metadata


def vae_training(config: Config, dataset: Dataset, vae: VAE, checkpoint: Path) -> Training:
    """What `fit` needs to train V."""
    device = next(vae.parameters()).device
    training, heldout = dataset.split()
    count = min(HELDOUT_FRAMES, len(heldout))
    heldout = heldout[np.linspace(0, len(heldout) - 1, count).astype(int)]
    names = ("kl_weight", "free_bits", "difference_weight")
    weights = {name: getattr(config.vae, name) for name in names}

    def read(indices: np.ndarray, rng: np.random.Generator) -> tuple:
        noise = rng.standard_normal((len(indices), config.vae.latent_size), np.float32)
        return *dataset.pairs(indices, config.vae.stride), noise

    def batch(step: int) -> tuple:
        rng = random_stream("vae", config.seed, step)
        return read(np.sort(rng.choice(training, config.vae.batch)), rng)

    def losses(frames: np.ndarray, earlier: np.ndarray, noise: np.ndarray) -> dict:
        frame, difference = (to_tensor(one).to(device) for one in to_pictures(frames, earlier))
        return vae_losses(vae, frame, difference, torch.from_numpy(noise).to(device), **weights)

    def heldout_losses() -> dict[str, float]:
        parts = np.array_split(heldout, min(HELDOUT_BATCHES, len(heldout)))
        rngs = [random_stream("heldout", 0, number) for number in range(len(parts))]
        found = [losses(*read(part, rng)) for part, rng in zip(parts, rngs, strict=True)]
        sizes = [len(part) for part in parts]
        values = {name: [one[name].item() for one in found] for name in found[0]}
        return {name: float(np.average(own, weights=sizes)) for name, own in values.items()}

    made_with = {**vae_depends_on(config), "dataset": dataset.checksum}
    label, schedule = f"train V ({config.variant})", (config.vae.steps, config.vae.learning_rate)
    return Training(vae, batch, losses, heldout_losses, *schedule, checkpoint, made_with, label)
