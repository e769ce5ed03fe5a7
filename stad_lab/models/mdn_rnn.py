"""M, the MDN-RNN: an LSTM that predicts the next z, as a mixture of Gaussians.

The prediction is a distribution because the road beyond the picture's edge is unknown: a single
Gaussian would predict the average of a left and a right bend, a road that does not exist. (World
Models, Ha and Schmidhuber 2018, section 2.2; mixture density networks: Bishop 1994.)
"""

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import nn

from stad_lab.models.controller import ACTION_SIZE
from stad_lab.models.vae import soft_bound

LOGSIGMA_RANGE = (-5.0, 3.0)  # without the lower bound a likelihood could grow without limit

State = tuple[torch.Tensor, torch.Tensor]  # h and c of the LSTM, each (1, batch, hidden_size)


class Mixture(NamedTuple):
    """A mixture of Gaussians for every latent: tensors (batch, time, latent_size, mixtures)."""

    logpi: torch.Tensor
    """Logarithms of the weights, which sum to 1 over the last axis."""
    mean: torch.Tensor
    logsigma: torch.Tensor

    def log_likelihood(self, target: torch.Tensor) -> torch.Tensor:
        """Log density in nats of each entry of `target` (batch, time, latent_size); same shape.

        log sum_k pi_k N(target; mean_k, sigma_k^2). The sum is a logsumexp, because the densities
        far from every mean underflow to zero and their logarithms do not.
        """
        error = (target[..., None] - self.mean) * torch.exp(-self.logsigma)
        log_density = -0.5 * error**2 - self.logsigma - 0.5 * math.log(2 * math.pi)
        return torch.logsumexp(self.logpi + log_density, dim=-1)

    def sample(
        self, temperature: float = 1.0, generator: torch.Generator | None = None
    ) -> torch.Tensor:
        """Sample z, (batch, time, latent_size).

        Args:
            temperature: at least 1e-6. The weights become softmax(logpi / temperature), the
                standard deviations sigma * sqrt(temperature), as in World Models.
            generator: source of random numbers; None for torch's own.

        Raises:
            ValueError: another temperature.
        """
        check_temperature(temperature)
        weights = (self.logpi / temperature).softmax(-1)
        flat = weights.reshape(-1, weights.shape[-1])
        choice = torch.multinomial(flat, 1, generator=generator).view(*weights.shape[:-1], 1)
        mean, logsigma = (part.gather(-1, choice)[..., 0] for part in (self.mean, self.logsigma))
        noise = torch.randn(mean.shape, generator=generator, dtype=mean.dtype, device=mean.device)
        return mean + logsigma.exp() * math.sqrt(temperature) * noise


class MDNRNN(nn.Module):
    """M: latents and actions -> the distribution of the next latents.

    Args:
        latent_size: dimensions of z.
        hidden_size: units of the LSTM (World Models: 256).
        mixtures: Gaussians for each latent (World Models: 5).
    """

    def __init__(self, latent_size: int = 32, hidden_size: int = 256, mixtures: int = 5):
        super().__init__()
        self.latent_size, self.hidden_size, self.mixtures = latent_size, hidden_size, mixtures
        self.lstm = nn.LSTM(latent_size + ACTION_SIZE, hidden_size, batch_first=True)
        self.head = nn.Linear(hidden_size, 3 * latent_size * mixtures)  # logpi, mean, logsigma

    @classmethod
    def of(cls, config: Any) -> "MDNRNN":
        """The M of a run's `Config`."""
        sizes = config.mdn_rnn.hidden_size, config.mdn_rnn.mixtures
        return cls(config.vae.latent_size, *sizes)

    def forward(
        self, latents: torch.Tensor, actions: torch.Tensor, state: State | None = None
    ) -> tuple[Mixture, State]:
        """Predict z_(t+1) from z_t, a_t and the memory, for every t.

        Args:
            latents: z, (batch, time, latent_size); one step is a sequence of length 1.
            actions: (batch, time, 3).
            state: the memory before the first step; None at the start of an episode.

        Returns:
            The mixture for every step, and the memory after the last.
        """
        hidden, state = self.remember(latents, actions, state)
        return self.mixture(hidden), state

    def remember(
        self, latents: torch.Tensor, actions: torch.Tensor, state: State | None = None
    ) -> tuple[torch.Tensor, State]:
        """The memory alone: h after every step (batch, time, hidden_size), and the last state."""
        return self.lstm(torch.cat([latents, actions], dim=2), state)

    def mixture(self, hidden: torch.Tensor) -> Mixture:
        """The head: h (batch, time, hidden_size) -> the predicted mixture."""
        shape = (*hidden.shape[:2], 3, self.latent_size, self.mixtures)
        logits, mean, logsigma = self.head(hidden).view(shape).unbind(2)
        return Mixture(logits.log_softmax(-1), mean, soft_bound(logsigma, *LOGSIGMA_RANGE))


def mdn_loss(mixture: Mixture, target: torch.Tensor) -> torch.Tensor:
    """Negative log-likelihood of `target` (batch, time, latent_size), nats per latent: a scalar.

    It is minus the logarithm of a density, so it may be negative.
    """
    return -mixture.log_likelihood(target).mean()


def to_state(memory: np.ndarray | None) -> State | None:
    """h and c, float32 (2, batch, hidden_size), as the LSTM takes them: copies; None stays None."""
    return None if memory is None else tuple(torch.tensor(memory).split(1))


def check_temperature(temperature: float) -> None:
    """Raise ValueError unless the temperature is a number, at least 1e-6 and less than 1e20."""
    number = isinstance(temperature, int | float | np.number) and temperature is not True
    if not number or not 1e-6 <= temperature < 1e20:
        found = " ".join(repr(temperature).split())
        raise ValueError(
            f"temperature={found}: expected a finite number from 1e-6 on; 1 is as trained"
        )
