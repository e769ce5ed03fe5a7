"""V, the difference auto encoder: a variational auto encoder in the four variants of the paper (section 3.3).

    variant        V sees                 V redraws
    frame          frame                  frame                  World Models' own
    input          frame + difference     frame
    output         frame                  frame + difference
    input_output   frame + difference     frame + difference

The paper's figures of the two networks are not public. So the layers are World Models' (four strided convolutions down,
four transposed ones up), and frame and difference are stacked as six channels instead of three.
"""

from pathlib import Path

import numpy as np
import torch
from torch import nn

from stad_lab.checkpoints import load_into, load_tensors, save_tensors
from stad_lab.rollouts import Rollouts
from stad_lab.settings import Settings, check_same_run
from stad_lab.training import fit, training_device

VARIANTS = ("frame", "input", "output", "input_output")
REMEDY = "train it: python -m stad_lab train --help"


def check_variant(variant: str) -> None:
    """Raise ValueError unless `variant` is one of the four."""
    if variant not in VARIANTS:
        raise ValueError(f"unknown variant {variant!r}: choose one of {', '.join(VARIANTS)}")


class FromOnePixel(nn.ConvTranspose2d):
    """A transposed convolution of pictures of one pixel: a matrix product, and computed as one it is 3 times faster."""

    def forward(self, pixel: torch.Tensor) -> torch.Tensor:
        """(batch, in_channels, 1, 1) -> (batch, out_channels, kernel, kernel)."""
        rows, columns = self.kernel_size
        weight = self.weight.permute(2, 3, 1, 0).reshape(-1, self.in_channels)
        drawn = nn.functional.linear(pixel.flatten(1), weight, self.bias.repeat(rows * columns))
        return drawn.view(-1, rows, columns, self.out_channels).permute(0, 3, 1, 2)


class AutoEncoder(nn.Module):
    """V: pictures -> latent z -> pictures.

    Pictures are float32 (batch, 3, 64, 64): a frame in [0, 1] and a difference image in [-1, 1]. A variant that does
    not see the difference ignores it; one that does not redraw it returns None in its place.

    Args:
        variant: "frame", "input", "output" or "input_output".
        latent_size: dimensions of z.
        width: channels of the first convolution (World Models: 32).
    """

    def __init__(self, variant: str, latent_size: int = 32, width: int = 32):
        super().__init__()
        check_variant(variant)
        self.variant, self.latent_size, self.width = variant, latent_size, width
        self.sees_difference = variant in ("input", "input_output")
        self.redraws_difference = variant in ("output", "input_output")
        self.encoder = nn.Sequential(
            nn.Conv2d(6 if self.sees_difference else 3, width, 4, stride=2),  # 64 -> 31
            nn.ReLU(),
            nn.Conv2d(width, 2 * width, 4, stride=2),  # 31 -> 14
            nn.ReLU(),
            nn.Conv2d(2 * width, 4 * width, 4, stride=2),  # 14 -> 6
            nn.ReLU(),
            nn.Conv2d(4 * width, 8 * width, 4, stride=2),  # 6 -> 2
            nn.ReLU(),
            nn.Flatten(),
            nn.Linear(32 * width, 2 * latent_size),  # mu and logvar
        )
        self.decoder = nn.Sequential(
            nn.Linear(latent_size, 32 * width),
            nn.Unflatten(1, (32 * width, 1, 1)),
            FromOnePixel(32 * width, 4 * width, 5),  # 1 -> 5
            nn.ReLU(),
            nn.ConvTranspose2d(4 * width, 2 * width, 5, stride=2),  # 5 -> 13
            nn.ReLU(),
            nn.ConvTranspose2d(2 * width, width, 6, stride=2),  # 13 -> 30
            nn.ReLU(),
            nn.ConvTranspose2d(width, 6 if self.redraws_difference else 3, 6, stride=2),  # 30 -> 64
        )

    def encode(self, frame: torch.Tensor, difference: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """q(z | x) = N(mu, exp(logvar)): two tensors (batch, latent_size)."""
        seen = torch.cat([frame, difference], 1) if self.sees_difference else frame
        mu, logvar = self.encoder(seen).chunk(2, dim=1)
        return mu, logvar.clamp(-10, 10)

    def decode(self, z: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor | None]:
        """z (batch, latent_size) -> the frame in [0, 1], and the difference image in [-1, 1] or None."""
        drawn = self.decoder(z)
        return torch.sigmoid(drawn[:, :3]), torch.tanh(drawn[:, 3:]) if self.redraws_difference else None

    def reconstruct(self, frame: torch.Tensor, difference: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor | None]:
        """Encode and decode through the mean mu, without sampling."""
        return self.decode(self.encode(frame, difference)[0])


def to_pictures(
    frames: np.ndarray, earlier: np.ndarray, device: torch.device | str = "cpu"
) -> tuple[torch.Tensor, torch.Tensor]:
    """uint8 frames and the frames before them, (batch, 64, 64, 3) -> frame in [0, 1] and difference in [-1, 1].

    The pictures come as float32 (batch, 3, 64, 64), in the "channels last" memory order of the frames: convolutions
    on a CPU are 1.7 times faster on it.
    """
    frame, before = (torch.from_numpy(part).to(device).permute(0, 3, 1, 2).float() / 255 for part in (frames, earlier))
    return frame, frame - before


def autoencoder_losses(
    autoencoder: AutoEncoder, frame: torch.Tensor, difference: torch.Tensor, noise: torch.Tensor, settings: Settings
) -> dict[str, torch.Tensor]:
    """The loss of V, each term named; means over the batch.

    total = frame_error + difference_weight * difference_error + kl_weight * max(kl, free_bits * latent_size)

    The errors are squared errors summed over a picture's pixels, `kl` is the divergence of q(z | x) from N(0, 1) in
    nats summed over z, and the floor under it (free bits) is World Models' own. `noise` is N(0, 1) of shape (batch,
    latent_size).
    """
    mu, logvar = autoencoder.encode(frame, difference)
    z = mu + torch.exp(0.5 * logvar) * noise  # the reparameterisation trick: gradients flow through mu and logvar
    drawn_frame, drawn_difference = autoencoder.decode(z)
    losses = {"frame_error": ((drawn_frame - frame) ** 2).sum(dim=(1, 2, 3)).mean()}
    total = losses["frame_error"]
    if drawn_difference is not None:
        losses["difference_error"] = ((drawn_difference - difference) ** 2).sum(dim=(1, 2, 3)).mean()
        total = total + settings.difference_weight * losses["difference_error"]
    kl = 0.5 * (mu**2 + logvar.exp() - 1 - logvar).sum(dim=1)
    losses["kl"] = kl.mean()
    floor = settings.free_bits * settings.latent_size
    return {"total": total + settings.kl_weight * kl.clamp(min=floor).mean(), **losses}


def train_autoencoder(variant: str, settings: Settings, rollouts_folder: Path, folder: Path) -> bool:
    """Train V on the rollouts and write `autoencoder.safetensors` into `folder`; resumes, and returns False if done.

    The last twentieth of the episodes is held out; training has a fixed length, and the history shows both losses.
    """
    path = Path(folder) / "autoencoder.safetensors"
    if path.exists():
        check_facts(path, load_autoencoder(path, variant)[1], settings)
        return False
    rollouts = Rollouts(rollouts_folder)
    torch.manual_seed(settings.seed)
    autoencoder, device = AutoEncoder(variant, settings.latent_size, settings.width), training_device()
    autoencoder.to(device, memory_format=torch.channels_last)
    training, heldout = rollouts.split()
    heldout = heldout[np.linspace(0, len(heldout) - 1, min(1000, len(heldout))).astype(int)]

    def losses_on(indices: np.ndarray, rng: np.random.Generator) -> dict[str, torch.Tensor]:
        frame, difference = to_pictures(*rollouts.pairs(indices, settings.stride), device)
        noise = torch.from_numpy(rng.standard_normal((len(indices), settings.latent_size), np.float32))
        return autoencoder_losses(autoencoder, frame, difference, noise.to(device), settings)

    def batch_losses(step: int) -> dict[str, torch.Tensor]:
        rng = np.random.default_rng([settings.seed, 1, step])
        return losses_on(np.sort(rng.choice(training, settings.v_batch)), rng)

    @torch.no_grad()
    def heldout_losses() -> dict[str, float]:
        parts = np.array_split(heldout, min(8, len(heldout)))
        losses = [losses_on(part, np.random.default_rng(0)) for part in parts]
        weights = [len(part) for part in parts]
        return {name: float(np.average([loss[name].item() for loss in losses], weights=weights)) for name in losses[0]}

    checkpoint = path.with_name("autoencoder.training.safetensors")
    label = f"train V ({variant})"
    history = fit(
        autoencoder, batch_losses, heldout_losses, settings.v_steps, settings.v_learning_rate, checkpoint, label
    )
    save_autoencoder(path, autoencoder, settings, history)
    checkpoint.unlink()
    return True


def check_facts(path: Path, facts: dict, settings: Settings) -> None:
    """Raise ValueError if weights were made with other settings, as far as their facts tell, than asked for now."""
    check_same_run(path, facts, {name: wanted for name, wanted in settings.as_dict().items() if name in facts})


def save_autoencoder(path: Path, autoencoder: AutoEncoder, settings: Settings, history: list) -> None:
    """Write V's weights with what is needed to build it again and to feed it as it was trained."""
    facts = {"part": "autoencoder", "variant": autoencoder.variant, "width": autoencoder.width}
    facts |= {"latent_size": autoencoder.latent_size, "stride": settings.stride, "crop_bar": settings.crop_bar}
    save_tensors(path, autoencoder.state_dict(), **facts, history=history)


def check_part(path: Path, facts: dict, part: str, variant: str | None) -> None:
    """Raise ValueError unless a file's facts say that it holds `part`, and of this variant unless that is None."""
    if facts.get("part") != part:
        raise ValueError(f"{path} holds {facts.get('part')!r}: expected {part!r}; give the file of that name")
    if variant not in (None, facts.get("variant")):
        raise ValueError(
            f"{path} holds variant {facts.get('variant')!r}, and {variant!r} was asked for: give its own run"
        )


def load_autoencoder(path: Path, variant: str | None = None) -> tuple[AutoEncoder, dict]:
    """Read V: (the auto encoder in evaluation mode, the facts it was saved with, among them its history).

    Raises:
        FileNotFoundError: no such file.
        ValueError: damaged, not V, or of another variant than `variant`.
    """
    tensors, facts = load_tensors(path, REMEDY)
    check_part(path, facts, "autoencoder", variant)
    autoencoder = AutoEncoder(facts["variant"], facts["latent_size"], facts["width"])
    load_into(autoencoder.to(memory_format=torch.channels_last), tensors, path)
    return autoencoder.eval().requires_grad_(False), facts
