"""V, the difference autoencoder: World Models' variational autoencoder, and the three of the paper (section 3.3).

    variant        V sees                 V redraws
    frame          frame                  frame                  World Models' own
    input          frame + difference     frame
    output         frame                  frame + difference
    input_output   frame + difference     frame + difference

The paper's figures of the two networks are missing from the source that we have. So the layers are World Models' (four
strided convolutions down, four transposed ones up), and frame and difference are stacked as six channels instead of
three.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import nn

from stad_lab.config import Settings, check_same_run
from stad_lab.envs.frames import check_pair
from stad_lab.io.files import checksum_of_tensors, load_into, load_tensors, locked, save_tensors
from stad_lab.training.dataset import Rollouts, check_seen
from stad_lab.training.trainer import fit, training_device

VARIANTS = ("frame", "input", "output", "input_output")
REMEDY = "train it: python -m stad_lab train --help"
V_SETTINGS = (  # what a trained V depends on, beside its sizes and its rollouts
    "seed",
    "stride",
    "crop_bar",
    "kl_weight",
    "free_bits",
    "difference_weight",
    "v_steps",
    "v_batch",
    "v_learning_rate",
)


def check_variant(variant: str) -> None:
    """Raise ValueError unless `variant` is one of the four."""
    if variant not in VARIANTS:
        raise ValueError(f"unknown variant {variant!r}: choose one of {', '.join(VARIANTS)}")


class FromOnePixel(nn.ConvTranspose2d):
    """A transposed convolution of pictures of one pixel: a matrix product, and computed as one it is 3 times faster."""

    def forward(self, pixel: torch.Tensor) -> torch.Tensor:
        """(batch, in_channels, 1, 1) -> (batch, out_channels, size, size)."""
        size = self.kernel_size[0]
        weight = self.weight.permute(2, 3, 1, 0).reshape(-1, self.in_channels)
        drawn = nn.functional.linear(pixel.flatten(1), weight, self.bias.repeat(size**2))
        return drawn.view(-1, size, size, self.out_channels).permute(0, 3, 1, 2)


class ToColours(nn.ConvTranspose2d):
    """A transposed convolution with stride 2 to few channels: the same numbers, half the time forward.

    Every output pixel with the same parity of row and column is an ordinary convolution of the input; so one ordinary
    convolution makes 4 times the channels, and a shuffle puts them in their places. PyTorch computes 16 channels at a
    time, so that 12 cost hardly more than 3. Backward its own way is the faster one.
    """

    def __init__(self, in_channels: int, out_channels: int):
        super().__init__(in_channels, out_channels, kernel_size=6, stride=2)

    def forward(self, pictures: torch.Tensor) -> torch.Tensor:
        """(batch, in_channels, size, size) -> (batch, out_channels, 2 * size + 4, 2 * size + 4)."""
        return _Enlarge.apply(pictures, self.weight, self.bias)


class _Enlarge(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx, pictures: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor
    ) -> torch.Tensor:
        """The shuffled convolution."""
        ctx.save_for_backward(pictures, weight)
        channels_in, channels_out = weight.shape[:2]
        taps = weight.reshape(channels_in, channels_out, 3, 2, 3, 2).flip(
            2, 4
        )  # row, its parity, column, its parity
        taps = taps.permute(1, 3, 5, 0, 2, 4).reshape(4 * channels_out, channels_in, 3, 3)
        drawn = nn.functional.conv2d(pictures, taps, bias.repeat_interleave(4), padding=2)
        return nn.functional.pixel_shuffle(drawn, 2)

    @staticmethod
    def backward(ctx, gradient: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Gradients of pictures, weight and bias, by PyTorch's own transposed convolution."""
        geometry = {"stride": [2, 2], "padding": [0, 0], "dilation": [1, 1], "transposed": True}
        return torch.ops.aten.convolution_backward(
            gradient,
            *ctx.saved_tensors,
            [gradient.shape[1]],
            **geometry,
            output_padding=[0, 0],
            groups=1,
            output_mask=[True, True, True],
        )


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
            FromOnePixel(32 * width, 4 * width, 5),  # 1 -> 5
            nn.ReLU(inplace=True),
            nn.ConvTranspose2d(4 * width, 2 * width, 5, stride=2),  # 5 -> 13
            nn.ReLU(inplace=True),
            nn.ConvTranspose2d(2 * width, width, 6, stride=2),  # 13 -> 30
            nn.ReLU(inplace=True),
            ToColours(width, 6 if self.redraws_difference else 3),  # 30 -> 64
        )

    def encode(
        self, frame: torch.Tensor, difference: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """q(z | x) = N(mu, exp(logvar)): two tensors (batch, latent_size)."""
        seen = torch.cat([frame, difference], 1) if self.sees_difference else frame
        mu, logvar = self.encoder(seen).chunk(2, dim=1)
        return mu, logvar.clamp(-10, 10)

    def decode(self, z: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor | None]:
        """z (batch, latent_size) -> the frame in [0, 1], and the difference image in [-1, 1] or None."""
        drawn = self.decoder(z)
        return torch.sigmoid(drawn[:, :3]), torch.tanh(
            drawn[:, 3:]
        ) if self.redraws_difference else None

    def reconstruct(
        self, frame: torch.Tensor, difference: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor | None]:
        """Encode and decode through the mean mu, without sampling."""
        return self.decode(self.encode(frame, difference)[0])


def to_pictures(
    frames: np.ndarray, earlier: np.ndarray, device: torch.device | str = "cpu"
) -> tuple[torch.Tensor, torch.Tensor]:
    """uint8 frames and the frames before them, (batch, 64, 64, 3) -> frame in [0, 1] and difference in [-1, 1].

    The pictures come as float32 (batch, 3, 64, 64) on `device`, in the "channels last" memory order of the frames:
    convolutions on a CPU are faster on it.

    Raises:
        ValueError: shapes that differ, or a dtype other than uint8.
    """
    check_pair(frames, earlier)
    pictures = (torch.from_numpy(part).to(device).permute(0, 3, 1, 2) for part in (frames, earlier))
    frame, before = (picture.float().div_(255) for picture in pictures)
    return frame, frame - before


def to_array(pictures: torch.Tensor) -> np.ndarray:
    """Pictures (batch, 3, 64, 64) as an array (batch, 64, 64, 3)."""
    return pictures.permute(0, 2, 3, 1).numpy()


def to_uint8(frames: torch.Tensor) -> np.ndarray:
    """Frames that V drew, float (batch, 3, 64, 64) in [0, 1] -> uint8 (batch, 64, 64, 3)."""
    return to_array((frames * 255).round().byte())


def autoencoder_losses(
    autoencoder: AutoEncoder,
    frame: torch.Tensor,
    difference: torch.Tensor,
    noise: torch.Tensor,
    settings: Settings,
) -> dict[str, torch.Tensor]:
    """The loss of V, each term named; means over the batch.

    total = frame_error + difference_weight * difference_error + kl_weight * max(kl, free_bits * latent_size)

    The errors are squared errors summed over a picture's pixels, `kl` is the divergence of q(z | x) from N(0, 1) in
    nats summed over z, and the floor under it (free bits, Kingma et al., 2016) is one for the whole picture, as in
    World Models. `noise` is N(0, 1) of shape (batch, latent_size).
    """
    mu, logvar = autoencoder.encode(frame, difference)
    z = (
        mu + torch.exp(0.5 * logvar) * noise
    )  # the reparameterisation trick: gradients flow through mu and logvar
    drawn_frame, drawn_difference = autoencoder.decode(z)
    losses = {"frame_error": squared_error(drawn_frame, frame)}
    total = losses["frame_error"]
    if drawn_difference is not None:
        losses["difference_error"] = squared_error(drawn_difference, difference)
        total = total + settings.difference_weight * losses["difference_error"]
    kl = kl_divergence(mu, logvar).sum(dim=1)
    losses["kl"] = kl.mean()
    floor = settings.free_bits * settings.latent_size
    return {"total": total + settings.kl_weight * kl.clamp(min=floor).mean(), **losses}


def kl_divergence(mu: torch.Tensor, logvar: torch.Tensor) -> torch.Tensor:
    """KL divergence of N(mu, exp(logvar)) from N(0, 1) in nats, for every latent by itself; all shapes are equal."""
    return 0.5 * (mu**2 + logvar.exp() - 1 - logvar)


def squared_error(drawn: torch.Tensor, picture: torch.Tensor) -> torch.Tensor:
    """Squared error summed over a picture (batch, 3, 64, 64), mean over the batch: a scalar."""
    return nn.functional.mse_loss(drawn, picture, reduction="sum") / len(picture)


def train_autoencoder(
    variant: str,
    settings: Settings,
    rollouts_folder: Path,
    folder: Path,
    watch: Callable[[list[dict]], None] | None = None,
) -> bool:
    """Train V on the rollouts and write `autoencoder.safetensors` into `folder`; resumes, and returns False if done.

    The last twentieth of the episodes is held out; training has a fixed length, and the history shows both losses.
    `watch` is called with the history whenever it has grown, as `training.fit` does.

    Raises:
        ValueError: the weights, checkpoint or rollouts in the folders are damaged or of another run.
        OSError: another process works in the folder, or a file cannot be read or written.
        FloatingPointError: the loss is not finite.
    """
    path = Path(folder) / "autoencoder.safetensors"
    checkpoint = path.with_name("autoencoder.training.safetensors")
    if path.exists():
        facts = load_autoencoder(path, variant)[1]
        check_facts(path, facts, settings)
        check_seen(path, facts["rollouts"], rollouts_folder)
        checkpoint.unlink(missing_ok=True)  # of a process that was killed before it did
        if watch:
            watch(facts["history"])
        return False
    rollouts = Rollouts(rollouts_folder)
    torch.manual_seed(settings.seed)
    autoencoder, device = (
        AutoEncoder(variant, settings.latent_size, settings.width),
        training_device(),
    )
    autoencoder.to(device, memory_format=torch.channels_last)
    training, heldout = rollouts.split()
    heldout = heldout[np.linspace(0, len(heldout) - 1, min(1000, len(heldout))).astype(int)]

    def draw(
        indices: np.ndarray, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray, torch.Tensor]:
        noise = torch.from_numpy(
            rng.standard_normal((len(indices), settings.latent_size), np.float32)
        )
        return *rollouts.pairs(indices, settings.stride), noise

    def batch(step: int) -> tuple[np.ndarray, np.ndarray, torch.Tensor]:
        rng = np.random.default_rng([settings.seed, 1, step])
        return draw(np.sort(rng.choice(training, settings.v_batch)), rng)

    def losses(
        frames: np.ndarray, earlier: np.ndarray, noise: torch.Tensor
    ) -> dict[str, torch.Tensor]:
        frame, difference = to_pictures(frames, earlier, device)
        return autoencoder_losses(autoencoder, frame, difference, noise.to(device), settings)

    @torch.no_grad()
    def heldout_losses() -> dict[str, float]:
        parts = np.array_split(heldout, min(8, len(heldout)))
        found = [losses(*draw(part, np.random.default_rng(0))) for part in parts]
        weights = [len(part) for part in parts]
        return {
            name: float(np.average([loss[name].item() for loss in found], weights=weights))
            for name in found[0]
        }

    label = f"train V ({variant})"
    identity = {
        "part": "autoencoder",
        "variant": variant,
        "rollouts": rollouts.identity,
        **settings.as_dict(),
    }
    steps, rate = settings.v_steps, settings.v_learning_rate
    with locked(path.parent):
        history = fit(
            autoencoder,
            batch,
            losses,
            heldout_losses,
            steps,
            rate,
            checkpoint,
            label,
            identity,
            watch,
        )
        save_autoencoder(path, autoencoder, settings, history, rollouts.identity)
        checkpoint.unlink(missing_ok=True)
    return True


def check_facts(path: Path, facts: dict, settings: Settings) -> None:
    """Raise ValueError if weights were made with other settings, as far as their facts tell, than asked for now."""
    check_same_run(
        path, facts, {name: wanted for name, wanted in settings.as_dict().items() if name in facts}
    )


def save_autoencoder(
    path: Path,
    autoencoder: AutoEncoder,
    settings: Settings,
    history: list,
    rollouts: str | None = None,
) -> None:
    """Write V's weights with what is needed to build it again and to feed it as it was trained.

    Its identity, by which M and C know the V that they were trained with, is a checksum of the weights; that of the
    rollouts says what it has seen.
    """
    facts = {"part": "autoencoder", "variant": autoencoder.variant, "width": autoencoder.width}
    facts["latent_size"] = autoencoder.latent_size
    facts |= {name: getattr(settings, name) for name in V_SETTINGS}
    facts |= {"identity": checksum_of_tensors(autoencoder.state_dict()), "rollouts": rollouts}
    save_tensors(path, autoencoder.state_dict(), **facts, history=history)


def check_part(path: Path, facts: dict, part: str, variant: str | None) -> None:
    """Raise ValueError unless a file's facts say that it holds `part`, and of this variant unless that is None."""
    if facts.get("part") != part:
        raise ValueError(
            f"{path} holds {facts.get('part')!r}: expected {part!r}; give the file of that name"
        )
    if variant not in (None, facts.get("variant")):
        raise ValueError(
            f"{path} holds variant {facts.get('variant')!r}, and {variant!r} was asked for: give its own run"
        )


def load_autoencoder(path: Path, variant: str | None = None) -> tuple[AutoEncoder, dict]:
    """Read V: (the autoencoder in evaluation mode, the facts it was saved with, among them its history).

    Raises:
        FileNotFoundError: no such file.
        ValueError: damaged, not V, or of another variant than `variant`.
    """
    tensors, facts = load_tensors(path, REMEDY)
    check_part(path, facts, "autoencoder", variant)
    autoencoder = AutoEncoder(facts["variant"], facts["latent_size"], facts["width"])
    load_into(autoencoder.to(memory_format=torch.channels_last), tensors, path)
    return autoencoder.eval().requires_grad_(False), facts
