"""How good V and M are on drives that they have not seen, each against the simplest thing that could do its job.

- V: the squared error, split into road, grass and car; the nats that each latent tells.
- M: the negative log-likelihood beside that of simple forecasts; whether its probabilities mean what they say (PIT);
  how the error of a dream grows with the number of steps since it last saw the road.
"""

import math
from typing import NamedTuple

import numpy as np
import torch

from stad_lab.envs.frames import difference_image
from stad_lab.models.mdn_rnn import MDNRNN, Mixture, log_likelihood, sample_mixture
from stad_lab.models.vae import AutoEncoder, kl_divergence, to_array, to_pictures

ACTIVE = 0.05  # nats; a latent that tells less on average is called inactive
CAR = (
    slice(50, 60),
    slice(29, 35),
)  # rows and columns of a frame that the car covers: the camera is fixed to it
REGIONS = ("road", "grass", "car")


def region_masks(frames: np.ndarray) -> dict[str, np.ndarray]:
    """Which pixels are road (with kerbs), grass (with the black beyond the field) and car: bool (n, 64, 64) for each.

    Args:
        frames: uint8 (n, 64, 64, 3), with the indicator bar cropped.
    """
    red, green = frames[..., 0].astype(np.int16), frames[..., 1].astype(np.int16)
    grass = (green - red > 30) | (green < 20) & (red < 20)
    car = np.zeros_like(grass)
    car[:, *CAR] = True
    return {"road": ~grass & ~car, "grass": grass & ~car, "car": car}


class Redrawn(NamedTuple):
    """What V makes of n frames."""

    frames: np.ndarray
    """float32 (n, 64, 64, 3) in [0, 1]."""
    differences: np.ndarray | None
    """float32 (n, 64, 64, 3) in [-1, 1]; None for a variant that does not redraw them."""
    kl: np.ndarray
    """float32 (n, latent_size), nats."""


@torch.no_grad()
def redraw(autoencoder: AutoEncoder, frames: np.ndarray, earlier: np.ndarray) -> Redrawn:
    """Encode and decode uint8 frames (n, 64, 64, 3), with the frames to subtract from them, through the mean of z."""
    count = max(1, len(frames) // 250)
    parts = []
    for pair in zip(np.array_split(frames, count), np.array_split(earlier, count), strict=True):
        mu, logvar = autoencoder.encode(*to_pictures(*pair))
        frame, difference = autoencoder.decode(mu)
        parts.append(
            (
                to_array(frame),
                None if difference is None else to_array(difference),
                kl_divergence(mu, logvar),
            )
        )
    drawn, differences, kl = zip(*parts, strict=True)
    return Redrawn(
        np.concatenate(drawn),
        None if differences[0] is None else np.concatenate(differences),
        np.concatenate(kl),
    )


def autoencoder_quality(autoencoder: AutoEncoder, frames: np.ndarray, earlier: np.ndarray) -> dict:
    """Measure V on frames that it has not seen.

    Args:
        frames, earlier: uint8 (n, 64, 64, 3), the bar cropped.

    Returns:
        A dict for JSON. "frame_error" and "difference_error" (None if not redrawn) are squared errors summed over a
        picture, as in the loss, of what is drawn from the mean of z; "blank_difference_error" is that of an empty
        difference image. "regions" has for each of REGIONS its "share" of the pixels, its "error" (squared, of one
        pixel, summed over the colours), and "flat_error", that of the best single colour, put there by an oracle that
        knows the region. "kl" is in nats, "kl_of_latents" of each, "active" counts those above ACTIVE.
    """
    redrawn = redraw(autoencoder, frames, earlier)
    true = frames / np.float32(255)
    error = ((redrawn.frames - true) ** 2).sum(axis=-1)
    difference = difference_image(frames, earlier)
    regions = {}
    for name, mask in region_masks(frames).items():
        flat = ((true[mask] - true[mask].mean(axis=0, dtype=np.float64)) ** 2).sum(axis=-1).mean()
        regions[name] = {"share": mask.mean(), "error": error[mask].mean(), "flat_error": flat}
    drawn = redrawn.differences
    result = {
        "frame_error": error.sum(axis=(1, 2)).mean(),
        "difference_error": None
        if drawn is None
        else ((drawn - difference) ** 2).sum(axis=(1, 2, 3)).mean(),
        "blank_difference_error": (difference**2).sum(axis=(1, 2, 3)).mean(),
        "kl": redrawn.kl.sum(axis=1).mean(),
        "active": int((redrawn.kl.mean(axis=0) > ACTIVE).sum()),
    }
    numbers = {
        name: value if value is None or name == "active" else float(value)
        for name, value in result.items()
    }
    regions = {
        name: {what: float(value) for what, value in region.items()}
        for name, region in regions.items()
    }
    return numbers | {"regions": regions, "kl_of_latents": redrawn.kl.mean(axis=0).tolist()}


def gaussian_nll(error: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """Negative log-likelihood in nats of errors under N(0, sigma^2), entry by entry."""
    return 0.5 * (error / sigma) ** 2 + np.log(sigma) + 0.5 * math.log(2 * math.pi)


def constant_forecast(training: np.ndarray, latents: np.ndarray) -> np.ndarray:
    """NLL of "the next z is as always": a Gaussian with mean and width of all training z; as `repeat_forecast`."""
    return gaussian_nll(latents[:, 1:] - training.mean(axis=(0, 1)), training.std(axis=(0, 1)))


def repeat_forecast(training: np.ndarray, latents: np.ndarray) -> np.ndarray:
    """NLL of "the next z is like this one": a Gaussian around it, as wide as the steps of the training drives.

    Args:
        training, latents: z of drives, float32 (drives, T, latent_size).

    Returns:
        Nats, (drives, T - 1, latent_size).
    """
    return gaussian_nll(np.diff(latents, axis=1), np.diff(training, axis=1).std(axis=(0, 1)))


def linear_forecast(
    training: np.ndarray,
    training_actions: np.ndarray,
    latents: np.ndarray,
    actions: np.ndarray,
    order: int,
) -> np.ndarray:
    """NLL of a linear autoregression: the next z as a weighted sum of the last `order` z's and actions, plus noise.

    Args:
        training, latents: z of drives, float32 (drives, T, latent_size).
        training_actions, actions: float32 (drives, T, 3).

    Returns:
        Nats, (drives, T - order, latent_size): of the frames order, order + 1, ...
    """

    def past(z: np.ndarray, a: np.ndarray) -> np.ndarray:
        both = np.concatenate([z, a], axis=2).astype(np.float64)
        steps = [both[:, lag : both.shape[1] - order + lag] for lag in range(order)]
        return np.concatenate([*steps, np.ones_like(steps[0][..., :1])], axis=2)

    seen, wanted = past(training, training_actions), training[:, order:]
    weights = np.linalg.lstsq(
        seen.reshape(-1, seen.shape[2]), wanted.reshape(-1, wanted.shape[2]), rcond=None
    )[0]
    sigma = (wanted - seen @ weights).std(axis=(0, 1))
    return gaussian_nll(latents[:, order:] - past(latents, actions) @ weights, sigma)


@torch.no_grad()
def forecast(mdn_rnn: MDNRNN, latents: np.ndarray, actions: np.ndarray) -> Mixture:
    """What M expects of frames 1, 2, ..., T - 1 of drives: parts (drives, T - 1, latent_size, mixtures)."""
    z, a = (torch.from_numpy(part[:, :-1]) for part in (latents, actions))
    return mdn_rnn(z, a)[0]


def mixture_nll(mixture: Mixture, latents: np.ndarray) -> np.ndarray:
    """NLL of frames 1, 2, ..., T - 1 under M's forecast: nats, (drives, T - 1, latent_size)."""
    return -log_likelihood(mixture, torch.from_numpy(latents[:, 1:])).numpy()


def single_step_nll(mdn_rnn: MDNRNN, latents: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """As `mixture_nll` of M's forecast, but with an empty memory before every frame: each two are a drive."""
    pairs = np.stack([latents[:, :-1], latents[:, 1:]], axis=2).reshape(-1, 2, latents.shape[2])
    pair_actions = np.repeat(actions[:, :-1].reshape(-1, 1, actions.shape[2]), 2, axis=1)
    return mixture_nll(forecast(mdn_rnn, pairs, pair_actions), pairs).reshape(
        len(latents), -1, latents.shape[2]
    )


def pit(mixture: Mixture, latents: np.ndarray) -> np.ndarray:
    """The probability integral transform: how much of the forecast lay below what came, in [0, 1].

    If the probabilities mean what they say, these numbers are uniform: a tenth of them below 0.1, and so on. Too many
    near 0 and 1: M is too sure of itself; too many in the middle: not sure enough.

    Returns:
        float32 (drives, T - 1, latent_size).
    """
    target = torch.from_numpy(latents[:, 1:, :, None])
    below = torch.special.ndtr((target - mixture.mean) * torch.exp(-mixture.logsigma))
    return (
        (mixture.logpi.exp() * below).sum(dim=-1).clamp(max=1).numpy()
    )  # weights add up to 1 but for rounding


@torch.no_grad()
def dream_with(
    mdn_rnn: MDNRNN,
    latents: np.ndarray,
    actions: np.ndarray,
    awake: int,
    dreams: int = 16,
    temperature: float = 1.0,
) -> np.ndarray:
    """Let M dream on with the actions that were really driven: open loop.

    Args:
        latents: z of drives, float32 (drives, T, latent_size); M is shown the first `awake` of them.
        actions: float32 (drives, T, 3).
        dreams: of every drive.
        temperature: as for `sample_mixture`.

    Returns:
        The dreamed z of frames awake, awake + 1, ..., T - 1: float32 (dreams, drives, T - awake, latent_size).
    """
    generator = torch.Generator().manual_seed(0)
    z, a = (torch.from_numpy(np.tile(part, (dreams, 1, 1))) for part in (latents, actions))
    mixture, state = mdn_rnn(z[:, :awake], a[:, :awake])
    dreamed = [sample_mixture(Mixture(*(part[:, -1:] for part in mixture)), temperature, generator)]
    for step in range(awake, latents.shape[1] - 1):
        mixture, state = mdn_rnn(dreamed[-1], a[:, step : step + 1], state)
        dreamed.append(sample_mixture(mixture, temperature, generator))
    return torch.cat(dreamed, dim=1).numpy().reshape(dreams, len(latents), -1, latents.shape[2])


def horizon_errors(
    autoencoder: AutoEncoder, dreamed: np.ndarray, mu: np.ndarray, awake: int, steps: list[int]
) -> dict[str, list[float]]:
    """How far dreams are from what came, against the number of steps dreamed, in what V draws of both.

    Pictures are compared, not latents: a latent that tells nothing is noise, in the dream as well as in V.

    Args:
        dreamed: float32 (dreams, drives, steps, latent_size), from `dream_with`.
        mu: V's means of the real frames, float32 (drives, T, latent_size).
        steps: at which to compare, 1 for the first dreamed frame.

    Returns:
        Name -> root of the mean squared error at these steps, as a share of that of the best constant picture for the
        step, which is the average of what came: "one dream", "mean of the dreams", "the last frame seen".
    """
    last = draw(autoencoder, mu[:, awake - 1])
    errors = {"one dream": [], "mean of the dreams": [], "the last frame seen": []}
    for step in steps:
        came = draw(autoencoder, mu[:, awake + step - 1])
        scale = np.sqrt(came.var(axis=0).mean())
        dreams = np.stack([draw(autoencoder, dream[:, step - 1]) for dream in dreamed])
        for name, drawn in zip(errors, (dreams, dreams.mean(axis=0), last), strict=True):
            errors[name].append(float(np.sqrt(((drawn - came) ** 2).mean()) / scale))
    return errors


@torch.no_grad()
def draw(autoencoder: AutoEncoder, z: np.ndarray) -> np.ndarray:
    """The frames that V draws from z (n, latent_size): float32 (n, 64, 64, 3) in [0, 1]."""
    return to_array(autoencoder.decode(torch.from_numpy(z))[0])
