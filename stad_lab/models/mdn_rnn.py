"""M, the MDN-RNN: an LSTM that predicts the next latent z as a mixture of Gaussians, given z and the action.

The prediction is a distribution, because the road beyond the picture's edge is not known: one Gaussian would answer
with the average of a left and a right bend, which is a road that does not exist.
"""

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import nn
from tqdm.auto import tqdm

from stad_lab.config import Settings
from stad_lab.envs.frames import earlier_frames
from stad_lab.io.files import checksum_of_tensors, load_into, load_tensors, locked, save_tensors
from stad_lab.models.vae import (
    REMEDY,
    AutoEncoder,
    check_facts,
    check_part,
    load_autoencoder,
    to_pictures,
)
from stad_lab.training.dataset import Rollouts, check_seen
from stad_lab.training.trainer import fit, training_device

ACTION_SIZE = 3
M_SETTINGS = (
    "seed",
    "m_steps",
    "m_batch",
    "m_sequence",
    "m_learning_rate",
)  # what a trained M depends on, beside V
LOGSIGMA_RANGE = (
    -5.0,
    3.0,
)  # a narrower Gaussian would let the likelihood run away on a single latent

State = tuple[torch.Tensor, torch.Tensor]  # h and c of the LSTM, each (1, batch, hidden_size)


class Mixture(NamedTuple):
    """A mixture of Gaussians for every latent dimension; each tensor is (batch, time, latent_size, mixtures)."""

    logpi: torch.Tensor
    """Logarithms of the weights; their exponentials sum to 1 over the last axis."""
    mean: torch.Tensor
    logsigma: torch.Tensor


class MDNRNN(nn.Module):
    """M: latents and actions -> the distribution of the next latents.

    One step and a whole sequence run the same code: a step is a sequence of length one.

    Args:
        latent_size: dimensions of z.
        hidden_size: units of the LSTM (World Models: 256).
        mixtures: Gaussians for each latent dimension (World Models: 5).
    """

    def __init__(self, latent_size: int = 32, hidden_size: int = 256, mixtures: int = 5):
        super().__init__()
        self.latent_size, self.hidden_size, self.mixtures = latent_size, hidden_size, mixtures
        self.lstm = nn.LSTM(latent_size + ACTION_SIZE, hidden_size, batch_first=True)
        self.head = nn.Linear(hidden_size, 3 * latent_size * mixtures)

    def forward(
        self, latents: torch.Tensor, actions: torch.Tensor, state: State | None = None
    ) -> tuple[Mixture, State]:
        """Predict z_(t+1) from z_t, a_t and the memory, for every t.

        Args:
            latents: z, (batch, time, latent_size).
            actions: (batch, time, 3).
            state: the memory before the first step; None at an episode's start.

        Returns:
            The mixture for every step, and the memory after the last.
        """
        hidden, state = self.remember(latents, actions, state)
        return self.mixture(hidden), state

    def remember(
        self, latents: torch.Tensor, actions: torch.Tensor, state: State | None
    ) -> tuple[torch.Tensor, State]:
        """The memory without the prediction: h after every step (batch, time, hidden_size), and the state."""
        return self.lstm(torch.cat([latents, actions], dim=2), state)

    def mixture(self, hidden: torch.Tensor) -> Mixture:
        """The head: h (batch, time, hidden_size) -> the mixture it stands for."""
        batch, time, _ = hidden.shape
        logits, mean, logsigma = (
            self.head(hidden).view(batch, time, 3, self.latent_size, self.mixtures).unbind(2)
        )
        return Mixture(logits.log_softmax(-1), mean, logsigma.clamp(*LOGSIGMA_RANGE))


def log_likelihood(mixture: Mixture, target: torch.Tensor) -> torch.Tensor:
    """Logarithm of the density of each entry of `target` (batch, time, latent_size) in nats, of the same shape.

    log sum_k pi_k N(target; mean_k, sigma_k^2), with the sum inside a logsumexp: densities of latents far from every
    mean underflow to zero, their logarithms do not.
    """
    error = (target[..., None] - mixture.mean) * torch.exp(-mixture.logsigma)
    log_density = -0.5 * error**2 - mixture.logsigma - 0.5 * math.log(2 * math.pi)
    return torch.logsumexp(mixture.logpi + log_density, dim=-1)


def mdn_loss(mixture: Mixture, target: torch.Tensor) -> torch.Tensor:
    """Negative log-likelihood of `target` (batch, time, latent_size) in nats for each latent dimension, a scalar.

    It is minus the logarithm of a density, so it can honestly be negative.
    """
    return -log_likelihood(mixture, target).mean()


def sample_mixture(
    mixture: Mixture, temperature: float, generator: torch.Generator | None = None
) -> torch.Tensor:
    """Draw z (batch, time, latent_size) from the mixture.

    Args:
        temperature: above 0, from 1e-6 on. The weights become softmax(logpi / temperature), the deviations
            sigma * sqrt(temperature), as in World Models: below 1 M dreams of what is likely, above 1 of what is not.
        generator: the random source; None for torch's own.

    Raises:
        ValueError: a temperature that is not a finite number from 1e-6 on.
    """
    check_temperature(temperature)
    weights = (mixture.logpi / temperature).softmax(-1)
    flat = weights.reshape(-1, weights.shape[-1])
    choice = torch.multinomial(flat, 1, generator=generator).view(*weights.shape[:-1], 1)
    mean, logsigma = (
        mixture.mean.gather(-1, choice)[..., 0],
        mixture.logsigma.gather(-1, choice)[..., 0],
    )
    noise = torch.randn(mean.shape, generator=generator)
    return mean + logsigma.exp() * math.sqrt(temperature) * noise


def check_temperature(temperature: float) -> None:
    """Raise ValueError unless the temperature is a finite number above 0, by as much as float32 can divide by."""
    if not 1e-6 <= temperature < math.inf:
        raise ValueError(
            f"temperature={temperature}: expected a finite number above 0, from 1e-6 on; 1 is what M has learned"
        )


@torch.no_grad()
def encode_frames(autoencoder: AutoEncoder, frames: np.ndarray, stride: int) -> np.ndarray:
    """What V makes of an episode's frames, uint8 (T, 64, 64, 3): mu and logvar, float32 (2, T, latent_size)."""
    device, count = next(autoencoder.parameters()).device, max(1, len(frames) // 250)
    pairs = zip(
        np.array_split(frames, count),
        np.array_split(earlier_frames(frames, stride), count),
        strict=True,
    )
    parts = [torch.stack(autoencoder.encode(*to_pictures(*pair, device))) for pair in pairs]
    return torch.cat(parts, dim=1).cpu().numpy()


def encode_rollouts(autoencoder: AutoEncoder, rollouts: Rollouts, stride: int) -> list[np.ndarray]:
    """What V makes of every episode: one float32 array (2, T, latent_size) each, mu and logvar."""
    # One array, made before the work: a small one kept after each episode would chop up the memory that is freed.
    whole = np.empty((2, len(rollouts), autoencoder.latent_size), np.float32)
    encoded = np.split(whole, np.flatnonzero(np.diff(rollouts.episode)) + 1, axis=1)  # views on it
    for episode, frames in zip(
        encoded, tqdm(rollouts.frames, "encode", unit="episode"), strict=True
    ):
        episode[:] = encode_frames(autoencoder, frames, stride)
    return encoded


def sequence_batch(
    encoded: list[np.ndarray],
    actions: list[np.ndarray],
    length: int,
    batch: int,
    rng: np.random.Generator,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Random stretches of random episodes: z (batch, length + 1, latent_size) and actions (batch, length, 3).

    z is drawn anew from N(mu, exp(logvar)) each time, so that M cannot learn one sample by heart.

    Raises:
        ValueError: no episode is longer than `length`.
    """
    long_enough = long_episodes([episode.shape[1] for episode in encoded], length)
    latents, chosen_actions = [], []
    for index in rng.choice(long_enough, batch):
        mu, logvar = encoded[index]
        start = rng.integers(len(mu) - length)
        stretch = slice(start, start + length + 1)
        latents.append(sample_latents(mu[stretch], logvar[stretch], rng))
        chosen_actions.append(actions[index][start : start + length])
    return torch.from_numpy(np.stack(latents)), torch.from_numpy(np.stack(chosen_actions))


def sample_latents(mu: np.ndarray, logvar: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Draw z from N(mu, exp(logvar)), float32 of their common shape."""
    return mu + np.exp(0.5 * logvar) * rng.standard_normal(mu.shape, np.float32)


def long_episodes(lengths: list[int], length: int, which: str = "") -> list[int]:
    """Indices of the episodes with more than `length` frames; raises ValueError if there are none.

    Args:
        lengths: of the episodes, in frames.
        which: what the message calls the episodes, for example "held-out ".
    """
    found = [index for index, frames in enumerate(lengths) if frames > length]
    if not found:
        raise ValueError(
            f"m_sequence={length}, but the longest {which}episode has {max(lengths)} frames: use shorter sequences, in"
            " another folder"
        )
    return found


def train_mdn_rnn(variant: str, settings: Settings, rollouts_folder: Path, folder: Path) -> bool:
    """Train M on what V, in `folder`, makes of the rollouts, and write `mdn_rnn.safetensors` beside it.

    Resumes, and returns False if it was done already.

    Raises:
        ValueError: the weights, checkpoint or rollouts in the folders are damaged or of another run.
        OSError: another process works in the folder, or a file cannot be read or written.
        FloatingPointError: the loss is not finite.
    """
    path = Path(folder) / "mdn_rnn.safetensors"
    v_path = path.with_name("autoencoder.safetensors")
    autoencoder, v_facts = load_autoencoder(v_path, variant)
    check_facts(v_path, v_facts, settings)
    if path.exists():
        facts = load_mdn_rnn(path, variant)[1]
        check_facts(path, facts, settings)
        check_partner(path, facts, autoencoder=v_facts["identity"])
        check_seen(path, v_facts["rollouts"], rollouts_folder)
        checkpoint_of(path).unlink(missing_ok=True)  # of a process that was killed before it did
        return False
    rollouts = Rollouts(rollouts_folder)
    check_seen(v_path, v_facts["rollouts"], rollouts_folder)
    if v_facts["rollouts"] is None:
        raise ValueError(
            f"{v_path} does not tell on which rollouts it was trained: train it again in another folder"
        )
    torch.manual_seed(settings.seed)
    device = training_device()
    mdn_rnn = MDNRNN(settings.latent_size, settings.hidden_size, settings.mixtures).to(device)
    encoded = []
    if settings.m_steps:
        check_lengths(rollouts, settings)  # before V encodes them all
        encoded = encode_rollouts(autoencoder.to(device), rollouts, settings.stride)
    fit_mdn_rnn(
        path, mdn_rnn, variant, v_facts["identity"], encoded, rollouts.actions, rollouts, settings
    )
    return True


def check_lengths(rollouts: Rollouts, settings: Settings) -> None:
    """Raise ValueError unless there is a training episode, and a held-out one, that holds a whole sequence."""
    lengths, first_heldout = (
        np.bincount(rollouts.episode).tolist(),
        rollouts.episode[rollouts.split()[1][0]],
    )
    long_episodes(lengths[:first_heldout], settings.m_sequence, "training ")
    long_episodes(lengths[first_heldout:], settings.m_sequence, "held-out ")


def fit_mdn_rnn(
    path: Path,
    mdn_rnn: MDNRNN,
    variant: str,
    v_identity: str,
    encoded: list[np.ndarray],
    actions: list[np.ndarray],
    rollouts: Rollouts,
    settings: Settings,
) -> None:
    """Train M on encoded episodes (see `encode_rollouts`) and the actions that it is shown, and write it to `path`.

    Training has a fixed length; the rollouts say which episodes are held out, `v_identity` is that of the V that
    has encoded them. It resumes.
    """
    device, first_heldout = (
        next(mdn_rnn.parameters()).device,
        rollouts.episode[rollouts.split()[1][0]],
    )

    def draw(
        episodes: slice, batch: int, rng: np.random.Generator
    ) -> tuple[torch.Tensor, torch.Tensor]:
        return sequence_batch(encoded[episodes], actions[episodes], settings.m_sequence, batch, rng)

    def batch(step: int) -> tuple[torch.Tensor, torch.Tensor]:
        return draw(
            slice(first_heldout), settings.m_batch, np.random.default_rng([settings.seed, 2, step])
        )

    def losses(latents: torch.Tensor, actions: torch.Tensor) -> dict[str, torch.Tensor]:
        latents = latents.to(device)
        mixture, _ = mdn_rnn(latents[:, :-1], actions.to(device))
        return {"total": mdn_loss(mixture, latents[:, 1:])}

    @torch.no_grad()
    def heldout_losses() -> dict[str, float]:
        return {
            "total": losses(*draw(slice(first_heldout, None), 64, np.random.default_rng(0)))[
                "total"
            ].item()
        }

    if settings.m_steps:
        check_lengths(rollouts, settings)
    checkpoint = checkpoint_of(path)
    identity = {
        "part": "mdn_rnn",
        "variant": variant,
        "autoencoder": v_identity,
        "rollouts": rollouts.identity,
    }
    identity |= settings.as_dict()
    steps, rate = settings.m_steps, settings.m_learning_rate
    with locked(path.parent):
        history = fit(
            mdn_rnn, batch, losses, heldout_losses, steps, rate, checkpoint, "train M", identity
        )
        save_mdn_rnn(path, mdn_rnn, variant, settings, history, v_identity)
        checkpoint.unlink(missing_ok=True)  # there is none after 0 steps


def checkpoint_of(path: Path) -> Path:
    """Where the training of M that ends in `path` keeps its state."""
    return path.with_name("mdn_rnn.training.safetensors")


def save_mdn_rnn(
    path: Path,
    mdn_rnn: MDNRNN,
    variant: str,
    settings: Settings,
    history: list,
    v_identity: str | None = None,
) -> None:
    """Write M's weights with what is needed to build it again, and the variant and identity of the V it belongs to."""
    facts = {"part": "mdn_rnn", "variant": variant, "autoencoder": v_identity, "history": history}
    facts |= {name: getattr(mdn_rnn, name) for name in ("latent_size", "hidden_size", "mixtures")}
    facts |= {name: getattr(settings, name) for name in M_SETTINGS}
    save_tensors(
        path, mdn_rnn.state_dict(), identity=checksum_of_tensors(mdn_rnn.state_dict()), **facts
    )


def check_partner(path: Path, facts: dict, **identities: str) -> None:
    """Raise ValueError unless a file's facts name the V, and the M, of these identities as those it was made with."""
    for part, identity in identities.items():
        if facts.get(part) != identity:
            raise ValueError(
                f"{path} was made with another {part} than the one beside it: give V, M and C of one run"
            )


def load_mdn_rnn(path: Path, variant: str | None = None) -> tuple[MDNRNN, dict]:
    """Read M: (the MDN-RNN in evaluation mode, the facts it was saved with, among them its history).

    Raises:
        FileNotFoundError: no such file.
        ValueError: damaged, not M, or for a V of another variant.
    """
    tensors, facts = load_tensors(path, REMEDY)
    check_part(path, facts, "mdn_rnn", variant)
    mdn_rnn = MDNRNN(facts["latent_size"], facts["hidden_size"], facts["mixtures"])
    load_into(mdn_rnn, tensors, path)
    return mdn_rnn.eval().requires_grad_(False), facts
