"""Training of M, on the latents of a trained V."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from tqdm.auto import tqdm

from stad_lab.config import Config, check_same, random_stream
from stad_lab.features import encode_episode
from stad_lab.io import weights
from stad_lab.io.files import locked
from stad_lab.io.weights import MDN_RNN_FILE, VAE_FILE, load_vae
from stad_lab.models.mdn_rnn import MDNRNN, mdn_loss
from stad_lab.models.vae import VAE
from stad_lab.training.dataset import Dataset
from stad_lab.training.trainer import Training, Watch, fit, torch_settings
from stad_lab.training.vae import check_vae

CHECKPOINT = "mdn_rnn.training.safetensors"
HELDOUT_SEQUENCES = 64  # on which the loss is measured


@dataclasses.dataclass
class Latents:
    """What M is trained on: episodes as V encodes them, with their actions."""

    encoded: list[np.ndarray]  # mu and logvar of each episode, float32 (2, T, latent_size)
    actions: list[np.ndarray]  # of each episode, float32 (T, 3)
    first_heldout: int  # from this episode on they are held out
    vae: str  # checksum of the V that encoded them


def train_mdn_rnn(
    config: Config,
    dataset: Callable[[], Dataset],
    folder: Path,
    watch: Watch | None = None,
) -> bool:
    """Train M on the dataset as V, in `folder`, encodes it; False if M was there already.

    An interrupted training continues. Arguments and errors are those of `train_vae`; ValueError,
    too, if no training or no held-out episode is longer than `mdn_rnn.sequence`.
    """
    path = Path(folder) / MDN_RNN_FILE
    if path.exists():
        check_vae(config, folder)
        check_mdn_rnn(config, folder)
        path.with_name(CHECKPOINT).unlink(missing_ok=True)  # of a process that was killed
        if watch:
            watch(weights.load_mdn_rnn(path)[1]["history"])
        return False
    data = dataset()
    check_vae(config, folder, data.checksum)
    vae, metadata = load_vae(path.with_name(VAE_FILE))
    if config.mdn_rnn.steps:
        check_lengths(data, config.mdn_rnn.sequence)  # before V encodes the whole dataset
    with locked(path.parent), torch_settings(config.seed, 1) as device:
        encoded = []
        if config.mdn_rnn.steps:
            encoded = encode_dataset(vae.to(device), data, config.vae.stride)
        latents = Latents(encoded, data.actions, data.first_heldout, metadata["weights"])
        fit_mdn_rnn(config, latents, path, device, watch)
    return True


def check_mdn_rnn(config: Config, folder: Path) -> None:
    """Raise ValueError if M is damaged, or of another configuration or V."""
    path = Path(folder) / MDN_RNN_FILE
    _, metadata = weights.load_mdn_rnn(path)
    check_same(path, metadata, mdn_rnn_depends_on(config))
    weights.check_belongs(path, metadata, vae=load_vae(path.with_name(VAE_FILE))[1]["weights"])


def mdn_rnn_depends_on(config: Config) -> dict:
    """The configuration that M depends on, beside its V."""
    return {"seed": config.seed, "mdn_rnn": dataclasses.asdict(config.mdn_rnn)}


def fit_mdn_rnn(
    config: Config,
    latents: Latents,
    path: Path,
    device: torch.device,
    watch: Watch | None = None,
) -> None:
    """Train an M on encoded episodes and write it to `path`. Raises as `fit`."""
    mdn_rnn = MDNRNN.of(config).to(device)
    training = mdn_rnn_training(config, latents, mdn_rnn, path.with_name(CHECKPOINT))
    training.watch = watch
    history = fit(training)
    weights.save_mdn_rnn(path, mdn_rnn, config, history, latents.vae)
    training.checkpoint.unlink(missing_ok=True)


def mdn_rnn_training(
    config: Config, latents: Latents, mdn_rnn: MDNRNN, checkpoint: Path
) -> Training:
    """What `fit` needs to train M."""
    settings, device = config.mdn_rnn, next(mdn_rnn.parameters()).device

    def read(episodes: slice, count: int, rng: np.random.Generator) -> tuple:
        encoded, actions = latents.encoded[episodes], latents.actions[episodes]
        return sequence_batch(encoded, actions, settings.sequence, count, rng)

    def batch(step: int) -> tuple:
        rng = random_stream("mdn_rnn", config.seed, step)
        return read(slice(latents.first_heldout), settings.batch, rng)

    def losses(z: torch.Tensor, actions: torch.Tensor) -> dict[str, torch.Tensor]:
        z = z.to(device)
        mixture, _ = mdn_rnn(z[:, :-1], actions.to(device))
        return {"total": mdn_loss(mixture, z[:, 1:])}

    def heldout_losses() -> dict[str, float]:
        heldout = slice(latents.first_heldout, None)
        found = losses(*read(heldout, HELDOUT_SEQUENCES, random_stream("heldout", 0)))
        return {"total": found["total"].item()}

    made_with = {**mdn_rnn_depends_on(config), "vae_weights": latents.vae}
    schedule = settings.steps, settings.learning_rate
    return Training(
        mdn_rnn, batch, losses, heldout_losses, *schedule, checkpoint, made_with, label="train M"
    )


def encode_dataset(vae: VAE, dataset: Dataset, stride: int) -> list[np.ndarray]:
    """V's mu and logvar of every episode: float32 (2, T, latent_size) each."""
    # One array for all: small ones that stay between large ones would fragment the memory.
    whole = np.empty((2, len(dataset), vae.latent_size), np.float32)
    encoded = np.split(whole, np.flatnonzero(np.diff(dataset.episode)) + 1, axis=1)  # views on it
    frames = tqdm(dataset.frames, "encode", unit="episode")
    for episode, pictures in zip(encoded, frames, strict=True):
        episode[:] = encode_episode(vae, pictures, stride)
    return encoded


def sequence_batch(
    encoded: list, actions: list, length: int, count: int, rng: np.random.Generator
) -> tuple[torch.Tensor, torch.Tensor]:
    """Random sequences of random episodes: z (count, length + 1, z) and actions (count, length, 3).

    z is sampled from N(mu, exp(logvar)) each time, so that M cannot memorise one sample. Episodes
    are as in `Latents`; ValueError if none has more than `length` frames.
    """
    long_enough = long_episodes([episode.shape[1] for episode in encoded], length)
    latents, chosen = [], []
    for index in rng.choice(long_enough, count):
        mu, logvar = encoded[index]
        start = rng.integers(len(mu) - length)
        sequence = slice(start, start + length + 1)
        latents.append(sample_latents(mu[sequence], logvar[sequence], rng))
        chosen.append(actions[index][start : start + length])
    return torch.from_numpy(np.stack(latents)), torch.from_numpy(np.stack(chosen))


def sample_latents(mu: np.ndarray, logvar: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Sample z from N(mu, exp(logvar)), float32 of their common shape."""
    return mu + np.exp(0.5 * logvar) * rng.standard_normal(mu.shape, np.float32)


def long_episodes(lengths: list[int], length: int, which: str = "") -> list[int]:
    """Indices of the episodes with more than `length` frames; ValueError if there are none."""
    found = [index for index, frames in enumerate(lengths) if frames > length]
    if not found:
        raise ValueError(
            f"mdn_rnn.sequence={length}, but the longest {which}episode has {max(lengths)} frames:"
            " use shorter sequences, in another folder"
        )
    return found


def check_lengths(dataset: Dataset, length: int) -> None:
    """Raise ValueError unless a training and a held-out episode are longer than `length`."""
    lengths = np.bincount(dataset.episode).tolist()
    long_episodes(lengths[: dataset.first_heldout], length, "training ")
    long_episodes(lengths[dataset.first_heldout :], length, "held-out ")
