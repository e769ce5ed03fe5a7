"""V, the variational autoencoder, and its three difference variants (STAD, section 3.3).

    variant        V sees                 V reconstructs
    frame          frame                  frame                  World Models' own
    input          frame + difference     frame
    output         frame                  frame + difference
    input_output   frame + difference     frame + difference

Pictures are float32 (batch, 3, 64, 64): a frame in [0, 1] and a difference image in [-1, 1]. The
layers are those of World Models (Ha and Schmidhuber 2018, figure 22): four strided convolutions
down to z, four transposed ones up. The paper's figures of its networks are missing from the source
that we have, so we stack frame and difference as six channels.
"""

from typing import Any

import numpy as np
import torch
from torch import nn

DIFFERENCE = {  # whether V sees, and whether it reconstructs, the difference image
    "frame": (False, False),
    "input": (True, False),
    "output": (False, True),
    "input_output": (True, True),
}
LOGVAR_RANGE = (-10.0, 10.0)
SHARPNESS = 5.0  # of a soft bound: 0.5 inside it, a value moves by 0.02


class VAE(nn.Module):
    """V: pictures (batch, 3, 64, 64) -> z -> pictures; frames in [0, 1], differences in [-1, 1].

    Args:
        variant: one of DIFFERENCE; ValueError for another.
        latent_size: dimensions of z.
        width: channels of the first convolution (World Models: 32; `Config` has 16).
    """

    def __init__(self, variant: str, latent_size: int = 32, width: int = 32):
        super().__init__()
        if variant not in DIFFERENCE:
            raise ValueError(f"unknown variant {variant!r}: choose one of {', '.join(DIFFERENCE)}")
        self.variant, self.latent_size, self.width = variant, latent_size, width
        self.sees_difference, self.reconstructs_difference = DIFFERENCE[variant]
        self.encoder = nn.Sequential(
            nn.Conv2d(6 if self.sees_difference else 3, width, 4, stride=2),  # 64 -> 31 pixels
            nn.ReLU(inplace=True),
            nn.Conv2d(width, 2 * width, 4, stride=2),  # 31 -> 14
            nn.ReLU(inplace=True),
            nn.Conv2d(2 * width, 4 * width, 4, stride=2),  # 14 -> 6
            nn.ReLU(inplace=True),
            nn.Conv2d(4 * width, 8 * width, 4, stride=2),  # 6 -> 2
            nn.ReLU(inplace=True),
            nn.Flatten(),
            nn.Linear(32 * width, 2 * latent_size),  # mu and logvar
        )
        self.decoder = nn.Sequential(
            nn.Linear(latent_size, 32 * width),
            nn.Unflatten(1, (32 * width, 1, 1)),
            PixelDeconvolution(32 * width, 4 * width, 5),  # 1 -> 5 pixels
            nn.ReLU(inplace=True),
            nn.ConvTranspose2d(4 * width, 2 * width, 5, stride=2),  # 5 -> 13
            nn.ReLU(inplace=True),
            nn.ConvTranspose2d(2 * width, width, 6, stride=2),  # 13 -> 30
            nn.ReLU(inplace=True),
            ColourDeconvolution(width, 6 if self.reconstructs_difference else 3, 6, stride=2),  # 64
        )

    @classmethod
    def of(cls, config: Any) -> "VAE":
        """The V of a run's `Config`."""
        return cls(config.variant, config.vae.latent_size, config.vae.width)

    def encode(
        self, frame: torch.Tensor, difference: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """q(z | x) = N(mu, exp(logvar)): mu and logvar, (batch, latent_size) each."""
        seen = torch.cat([frame, difference], 1) if self.sees_difference else frame
        mu, logvar = self.encoder(seen).chunk(2, dim=1)
        return mu, soft_bound(logvar, *LOGVAR_RANGE)

    def decode(self, z: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor | None]:
        """z (batch, latent_size) -> the frame, and the difference image or None."""
        parts = self.decoder(z).split(3, dim=1)
        # Copies: sigmoid and tanh are several times slower on a part of an array.
        parts = [part.contiguous(memory_format=torch.channels_last) for part in parts]
        frame = torch.sigmoid(parts[0])
        return frame, torch.tanh(parts[1]) if self.reconstructs_difference else None

    def reconstruct(
        self, frame: torch.Tensor, difference: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor | None]:
        """Encode, then decode mu without sampling: arguments of `encode`, results of `decode`."""
        return self.decode(self.encode(frame, difference)[0])


class ColourDeconvolution(nn.ConvTranspose2d):
    """A transposed convolution to few channels, kernel 6, stride 2: in half the time forward."""

    def forward(self, pictures: torch.Tensor) -> torch.Tensor:  # type: ignore[override]
        """(batch, channels, n, n) -> (batch, out_channels, 2 n + 4, 2 n + 4)."""
        return Interleave.apply(pictures, self.weight, self.bias)


class Interleave(torch.autograd.Function):
    """Computes `ColourDeconvolution`: forward as a convolution, backward as PyTorch does.

    The outputs in rows and columns of one parity are an ordinary convolution of the input. So one
    convolution with four times the channels computes all of them, and fills a processor's registers
    where three or six channels do not.
    """

    @staticmethod
    def forward(ctx, pictures, weight, bias):
        """One convolution, whose channels become the four parities of the pixels."""
        ctx.save_for_backward(pictures, weight)
        channels, made = weight.shape[:2]
        parts = weight.reshape(channels, made, 3, 2, 3, 2)  # row, its parity, column, its parity
        parts = parts.flip(2, 4).permute(1, 3, 5, 0, 2, 4).reshape(4 * made, channels, 3, 3)
        convolved = nn.functional.conv2d(pictures, parts, bias.repeat_interleave(4), padding=2)
        return nn.functional.pixel_shuffle(convolved, 2)

    @staticmethod
    def backward(ctx, gradient):
        """Gradients of the pictures, the weight and the bias."""
        made, no = gradient.shape[1], [0, 0]
        return torch.ops.aten.convolution_backward(
            gradient, *ctx.saved_tensors, [made], [2, 2], no, [1, 1], True, no, 1, [True] * 3
        )


class PixelDeconvolution(nn.ConvTranspose2d):
    """The transposed convolution of a single pixel, computed as the matrix product that it is.

    (batch, channels, 1, 1) -> (batch, out_channels, k, k), in a third of the time.
    """

    def forward(self, pixel: torch.Tensor) -> torch.Tensor:  # type: ignore[override]
        """Each place of the k x k pixels has its own linear layer."""
        weights = self.weight.permute(0, 2, 3, 1)  # channels, row, column, out_channels
        bias = self.bias.repeat(self.kernel_size[0] * self.kernel_size[1])  # type: ignore[union-attr]
        made = torch.addmm(bias, pixel.flatten(1), weights.reshape(len(weights), -1))
        return made.view(-1, *weights.shape[1:]).permute(0, 3, 1, 2)


def soft_bound(value: torch.Tensor, low: float, high: float) -> torch.Tensor:
    """Keep a tensor between two bounds smoothly: unlike a clamp, it has a gradient outside."""
    raised = low + nn.functional.softplus(value - low, beta=SHARPNESS)
    return high - nn.functional.softplus(high - raised, beta=SHARPNESS)


def vae_losses(
    vae: VAE,
    frame: torch.Tensor,
    difference: torch.Tensor,
    noise: torch.Tensor,
    kl_weight: float = 1.0,
    free_bits: float = 0.0,
    difference_weight: float = 1.0,
) -> dict[str, torch.Tensor]:
    """V's loss "total" and its terms: squared errors of a picture, and "kl" in nats; batch means.

    Args:
        frame, difference: as for `VAE.encode`; a V that reconstructs the difference needs it, too.
        noise: N(0, 1), (batch, latent_size).
        kl_weight: weight of the KL term.
        free_bits: nats for each latent below which a picture's KL is not penalised (Kingma et al.
            2016); the bound holds for the picture as a whole, as in World Models.
        difference_weight: weight of the difference image's error, if it is reconstructed.
    """
    mu, logvar = vae.encode(frame, difference)
    # The reparameterisation trick: z is a sample, and gradients still reach mu and logvar.
    z = mu + torch.exp(0.5 * logvar) * noise
    frame_hat, difference_hat = vae.decode(z)
    kl = kl_divergence(mu, logvar).sum(dim=1)
    losses = {"frame_error": squared_error(frame_hat, frame), "kl": kl.mean()}
    penalised = kl.clamp(min=free_bits * vae.latent_size).mean()
    total = losses["frame_error"] + kl_weight * penalised
    if difference_hat is not None:
        losses["difference_error"] = squared_error(difference_hat, difference)
        total = total + difference_weight * losses["difference_error"]
    return {"total": total, **losses}


def kl_divergence(mu: torch.Tensor, logvar: torch.Tensor) -> torch.Tensor:
    """KL divergence of N(mu, exp(logvar)) from N(0, 1) in nats, for each latent by itself."""
    return 0.5 * (mu**2 + logvar.exp() - 1 - logvar)


def squared_error(reconstruction: torch.Tensor, picture: torch.Tensor) -> torch.Tensor:
    """Squared error summed over a picture (batch, 3, 64, 64), mean over the batch: a scalar."""
    return nn.functional.mse_loss(reconstruction, picture, reduction="sum") / len(picture)


def to_tensor(pictures: np.ndarray) -> torch.Tensor:
    """Pictures float32 (batch, 64, 64, 3) as a tensor (batch, 3, 64, 64) on the same memory.

    The memory order stays "channels last", in which convolutions on a CPU are faster.
    """
    return torch.from_numpy(pictures).permute(0, 3, 1, 2)


def to_array(pictures: torch.Tensor) -> np.ndarray:
    """The inverse of `to_tensor`."""
    return pictures.permute(0, 2, 3, 1).cpu().numpy()


def to_uint8(frames: torch.Tensor) -> np.ndarray:
    """Frames in [0, 1], float (batch, 3, 64, 64) -> uint8 (batch, 64, 64, 3)."""
    return to_array((frames * 255).round().byte())
