"""What C sees in a recorded episode: z of every frame, and M's memory h before it."""

from collections.abc import Iterator

import numpy as np
import torch

from stad_lab.envs.frames import earlier_frames, to_pictures
from stad_lab.io.weights import WorldModel
from stad_lab.models.mdn_rnn import MDNRNN
from stad_lab.models.vae import VAE, to_tensor

CHUNK = 250  # frames that V encodes at once, or up to twice as many


def chunks(frames: np.ndarray, earlier: np.ndarray) -> Iterator[list[torch.Tensor]]:
    """Yield [frames, differences] for V, float32 (m, 3, 64, 64), from uint8 (n, 64, 64, 3)."""
    count = max(1, len(frames) // CHUNK)
    for pair in zip(np.array_split(frames, count), np.array_split(earlier, count), strict=True):
        yield [to_tensor(picture) for picture in to_pictures(*pair)]


@torch.no_grad()
def encode_episode(vae: VAE, frames: np.ndarray, stride: int) -> np.ndarray:
    """V's mu and logvar for the frames of an episode, uint8 (T, 64, 64, 3) -> float32 (2, T, z)."""
    device, parts = next(vae.parameters()).device, []
    for pictures in chunks(frames, earlier_frames(frames, stride)):
        parts.append(torch.stack(vae.encode(*(picture.to(device) for picture in pictures))))
    return torch.cat(parts, dim=1).cpu().numpy()


@torch.no_grad()
def remember_episode(mdn_rnn: MDNRNN, latents: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """M's memory before every frame of an episode, which C sees with that frame's z.

    float32 (T, latent_size) and (T, 3) -> (T, hidden_size); the first row is zero.
    """
    after, _ = mdn_rnn.remember(torch.from_numpy(latents)[None], torch.from_numpy(actions)[None])
    return torch.cat([torch.zeros_like(after[:, :1]), after[:, :-1]], dim=1)[0].numpy()


def features_of(world_model: WorldModel, frames: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """What C sees in an episode, z and the h before it: float32 (T, latent_size + hidden_size).

    `frames` are uint8 (T, 64, 64, 3), `actions` float32 (T, 3).
    """
    latents = encode_episode(world_model.vae, frames, world_model.stride)[0]
    hidden = remember_episode(world_model.mdn_rnn, latents, actions)
    return np.concatenate([latents, hidden], axis=1)
