"""How good V and M are on unseen episodes, each beside the simplest thing that could do its job.

- V: the squared error, split into road, grass and car; the KL of each latent.
- M: the negative log-likelihood (NLL) beside that of simple predictions; whether its probabilities
  are calibrated (PIT); how the error of a dream grows with its length.
"""

import math
from typing import NamedTuple

import numpy as np
import torch

from stad_lab.envs.frames import difference_image, normalise
from stad_lab.features import chunks
from stad_lab.models.mdn_rnn import MDNRNN, Mixture
from stad_lab.models.vae import VAE, kl_divergence, to_array

ACTIVE = 0.05  # nats; a latent with a smaller mean KL is called inactive
CAR = (slice(50, 60), slice(29, 35))  # rows and columns of the car: the camera is fixed to it


def region_masks(frames: np.ndarray) -> dict[str, np.ndarray]:
    """Which pixels are road (with kerbs), grass (with what lies beyond the field) and car.

    Frames uint8 (n, 64, 64, 3), without the indicator bar -> bool (n, 64, 64) for each.
    """
    red, green = frames[..., 0].astype(np.int16), frames[..., 1].astype(np.int16)
    grass = (green - red > 30) | (green < 20) & (red < 20)
    car = np.zeros_like(grass)
    car[:, *CAR] = True
    return {"road": ~grass & ~car, "grass": grass & ~car, "car": car}


def road_ahead(frames: np.ndarray) -> np.ndarray:
    """Where the road leads: its mean column in the upper half of the picture, right is positive.

    Frames as `region_masks` takes them -> float (n,), pixels from the middle; 0 without a road.
    """
    upper = region_masks(frames)["road"][:, :32]
    columns = np.arange(upper.shape[2]) - upper.shape[2] / 2 + 0.5
    return (upper * columns).sum(axis=(1, 2)) / np.maximum(upper.sum(axis=(1, 2)), 1)


class Reconstruction(NamedTuple):
    """What V makes of n frames."""

    frames: np.ndarray  # float32 (n, 64, 64, 3) in [0, 1]
    differences: np.ndarray | None  # likewise in [-1, 1]; None if V does not reconstruct them
    kl: np.ndarray  # float32 (n, latent_size), nats


@torch.no_grad()
def reconstruct(vae: VAE, frames: np.ndarray, earlier: np.ndarray) -> Reconstruction:
    """Encode and decode frames through the mean of z.

    `frames`, and `earlier`, which are subtracted from them, are uint8 (n, 64, 64, 3).
    """
    parts = []
    for pictures in chunks(frames, earlier):
        mu, logvar = vae.encode(*pictures)
        frame, difference = vae.decode(mu)
        changed = None if difference is None else to_array(difference)
        parts.append((to_array(frame), changed, kl_divergence(mu, logvar).numpy()))
    decoded, differences, kl = zip(*parts, strict=True)
    differences = None if differences[0] is None else np.concatenate(differences)
    return Reconstruction(np.concatenate(decoded), differences, np.concatenate(kl))


def vae_metrics(vae: VAE, frames: np.ndarray, earlier: np.ndarray) -> dict:
    """Measure V on unseen frames without the indicator bar; arguments as of `reconstruct`.

    Returns:
        A dict for JSON. "frame_error" and "difference_error" (None if not reconstructed) are
        squared errors summed over a picture, as in the loss; "blank_difference_error" is that of an
        empty difference image. "regions" has for each region its "share" of the pixels, its
        "error" (squared, of one pixel, summed over the colours), and "flat_error", that of the best
        single colour. "kl" is in nats, "kl_of_latents" of each, "active" counts those above ACTIVE.
    """
    found, true = reconstruct(vae, frames, earlier), normalise(frames)
    error = ((found.frames - true) ** 2).sum(axis=-1)
    difference, changed = difference_image(frames, earlier), None
    if found.differences is not None:
        changed = float(((found.differences - difference) ** 2).sum(axis=(1, 2, 3)).mean())
    regions = {}
    for name, mask in region_masks(frames).items():
        flat = ((true[mask] - true[mask].mean(axis=0, dtype=np.float64)) ** 2).sum(axis=-1).mean()
        one = {"share": mask.mean(), "error": error[mask].mean(), "flat_error": flat}
        regions[name] = {what: float(value) for what, value in one.items()}
    return {
        "frame_error": float(error.sum(axis=(1, 2)).mean()),
        "difference_error": changed,
        "blank_difference_error": float((difference**2).sum(axis=(1, 2, 3)).mean()),
        "kl": float(found.kl.sum(axis=1).mean()),
        "active": int((found.kl.mean(axis=0) > ACTIVE).sum()),
        "regions": regions,
        "kl_of_latents": found.kl.mean(axis=0).tolist(),
    }


def gaussian_nll(error: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """NLL in nats of errors under N(0, sigma^2), entry by entry."""
    return 0.5 * (error / sigma) ** 2 + np.log(sigma) + 0.5 * math.log(2 * math.pi)


def constant_prediction(training: np.ndarray, latents: np.ndarray) -> np.ndarray:
    """NLL of one Gaussian with the mean and deviation of all z; as `repeat_prediction`."""
    mean, sigma = training.mean(axis=(0, 1)), training.std(axis=(0, 1))
    return gaussian_nll(latents[:, 1:] - mean, sigma)


def repeat_prediction(training: np.ndarray, latents: np.ndarray) -> np.ndarray:
    """NLL of a Gaussian around the last z, with the deviation of the steps of z.

    z of episodes, float32 (episodes, T, latent_size) -> nats (episodes, T - 1, latent_size).
    """
    return gaussian_nll(np.diff(latents, axis=1), np.diff(training, axis=1).std(axis=(0, 1)))


def linear_prediction(
    training: np.ndarray,
    training_actions: np.ndarray,
    latents: np.ndarray,
    actions: np.ndarray,
    order: int,
) -> np.ndarray:
    """NLL of a linear autoregression: the next z from the last `order` z and actions, plus noise.

    Args:
        training, latents: z of episodes, float32 (episodes, T, latent_size).
        training_actions, actions: float32 (episodes, T, 3).

    Returns:
        Nats, (episodes, T - order, latent_size): of the frames order, order + 1, ...
    """

    def past(z: np.ndarray, a: np.ndarray) -> np.ndarray:
        both = np.concatenate([z, a], axis=2).astype(np.float64)
        steps = [both[:, lag : both.shape[1] - order + lag] for lag in range(order)]
        return np.concatenate([*steps, np.ones_like(steps[0][..., :1])], axis=2)

    seen, wanted = past(training, training_actions), training[:, order:]
    rows, targets = seen.reshape(-1, seen.shape[2]), wanted.reshape(-1, wanted.shape[2])
    weights = np.linalg.lstsq(rows, targets, rcond=None)[0]
    sigma = (wanted - seen @ weights).std(axis=(0, 1))
    return gaussian_nll(latents[:, order:] - past(latents, actions) @ weights, sigma)


@torch.no_grad()
def predict(mdn_rnn: MDNRNN, latents: np.ndarray, actions: np.ndarray) -> Mixture:
    """M's predictions of frames 1 to T - 1: parts (episodes, T - 1, latent_size, mixtures)."""
    z, a = (torch.from_numpy(part[:, :-1]) for part in (latents, actions))
    return mdn_rnn(z, a)[0]


def mixture_nll(mixture: Mixture, latents: np.ndarray) -> np.ndarray:
    """NLL of frames 1 to T - 1 under M's predictions: nats, (episodes, T - 1, latent_size)."""
    return -mixture.log_likelihood(torch.from_numpy(latents[:, 1:])).numpy()


def single_step_nll(mdn_rnn: MDNRNN, latents: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """`mixture_nll` of M with an empty memory before every frame."""
    size = latents.shape[2]
    pairs = np.stack([latents[:, :-1], latents[:, 1:]], axis=2).reshape(-1, 2, size)
    pair_actions = np.repeat(actions[:, :-1].reshape(-1, 1, actions.shape[2]), 2, axis=1)
    nll = mixture_nll(predict(mdn_rnn, pairs, pair_actions), pairs)
    return nll.reshape(len(latents), -1, size)


def pit(mixture: Mixture, latents: np.ndarray) -> np.ndarray:
    """The probability integral transform: the predicted probability below the true value.

    float32 (episodes, T - 1, latent_size). Calibrated predictions make them uniform in [0, 1]. Too
    many near 0 and 1: M is overconfident; too many in the middle: underconfident.
    """
    target = torch.from_numpy(latents[:, 1:, :, None])
    below = torch.special.ndtr((target - mixture.mean) * torch.exp(-mixture.logsigma))
    return (mixture.logpi.exp() * below).sum(dim=-1).clamp(max=1).numpy()  # rounding may exceed 1


@torch.no_grad()
def dream_open_loop(
    mdn_rnn: MDNRNN,
    latents: np.ndarray,
    actions: np.ndarray,
    awake: int,
    dreams: int = 16,
    temperature: float = 1.0,
) -> np.ndarray:
    """Let M dream on with the actions that were really taken, `dreams` times in every episode.

    Args:
        latents: z of episodes, float32 (episodes, T, latent_size).
        actions: float32 (episodes, T, 3).
        awake: number of frames that M sees first, 1 to T - 1.
        temperature: as for `Mixture.sample`, with its ValueError.

    Returns:
        z of frames awake to T - 1: float32 (dreams, episodes, T - awake, latent_size).
    """
    generator = torch.Generator().manual_seed(0)
    z, a = (torch.from_numpy(np.tile(part, (dreams, 1, 1))) for part in (latents, actions))
    mixture, state = mdn_rnn(z[:, :awake], a[:, :awake])
    last = Mixture(*(part[:, -1:] for part in mixture))
    dreamed = [last.sample(temperature, generator)]
    for step in range(awake, latents.shape[1] - 1):
        mixture, state = mdn_rnn(dreamed[-1], a[:, step : step + 1], state)
        dreamed.append(mixture.sample(temperature, generator))
    return torch.cat(dreamed, dim=1).numpy().reshape(dreams, len(latents), -1, latents.shape[2])


def horizon_errors(
    vae: VAE, dreamed: np.ndarray, mu: np.ndarray, awake: int, steps: list[int]
) -> dict[str, list[float]]:
    """How far dreams are from the truth, against the number of steps, in decoded frames.

    Frames are compared, not latents: an inactive latent is noise in the dream as well as in V.

    Args:
        dreamed: from `dream_open_loop`.
        mu: V's means of the real frames, float32 (episodes, T, latent_size).
        steps: at which to compare, 1 for the first dreamed frame.

    Returns:
        Root mean squared errors at these steps, as a share of that of the mean frame of the step:
        of "one dream", the "mean of the dreams" and "the last frame seen".
    """
    last = decode(vae, mu[:, awake - 1])
    errors: dict[str, list] = {"one dream": [], "mean of the dreams": [], "the last frame seen": []}
    for step in steps:
        true = decode(vae, mu[:, awake + step - 1])
        scale = np.sqrt(true.var(axis=0).mean())
        dreams = np.stack([decode(vae, dream[:, step - 1]) for dream in dreamed])
        for name, decoded in zip(errors, (dreams, dreams.mean(axis=0), last), strict=True):
            errors[name].append(float(np.sqrt(((decoded - true) ** 2).mean()) / scale))
    return errors


@torch.no_grad()
def decode(vae: VAE, z: np.ndarray) -> np.ndarray:
    """The frames that V decodes from z (n, latent_size): float32 (n, 64, 64, 3) in [0, 1]."""
    return to_array(vae.decode(torch.from_numpy(z))[0])


def two_peaks(logpi: np.ndarray, mean: np.ndarray, logsigma: np.ndarray) -> np.ndarray:
    """The two highest peaks of the density of mixtures, each array (..., mixtures).

    Returns:
        float64 (..., 3): how far the density rises from the valley between them to the lower peak,
        as a share of the higher one, and where the peaks are, from left to right; zeros where there
        is only one peak.
    """
    shape, count = mean.shape[:-1], mean.shape[-1]
    weight, center, sigma = (
        part.reshape(-1, count).astype(np.float64)
        for part in (np.exp(logpi), mean, np.exp(logsigma))
    )
    low, high = (center - 4 * sigma).min(axis=1), (center + 4 * sigma).max(axis=1)
    z = low[:, None] + (high - low)[:, None] * np.linspace(0, 1, 200)
    density = sum(
        weight[:, [k]] / sigma[:, [k]] * np.exp(-0.5 * ((z - center[:, [k]]) / sigma[:, [k]]) ** 2)
        for k in range(count)
    )
    inner = density[:, 1:-1]
    is_peak = (inner > density[:, :-2]) & (inner >= density[:, 2:])
    found = np.zeros((len(z), 3))
    for row in np.flatnonzero(is_peak.sum(axis=1) > 1):
        places = np.flatnonzero(is_peak[row]) + 1
        left, right = np.sort(places[np.argsort(density[row, places])[-2:]])
        lower, higher = np.sort(density[row, [left, right]])
        rise = (lower - density[row, left : right + 1].min()) / higher
        found[row] = rise, z[row, left], z[row, right]
    return found.reshape(*shape, 3)


def clearest_case(peaks: np.ndarray, came: np.ndarray) -> tuple[int, ...]:
    """The place of the deepest valley between two peaks of which one came true.

    A peak comes true if the value is not between the peaks, and nearer to one than half their
    distance. One Gaussian in place of both usually gives such a value less.

    Args:
        peaks: (..., 3), as `two_peaks` returns them.
        came: what came, (...).

    Raises:
        ValueError: nowhere did a peak come true.
    """
    rise, left, right = np.moveaxis(peaks, -1, 0)
    beyond = np.maximum(left - came, came - right)
    true = (rise > 0) & (beyond > 0) & (beyond < (right - left) / 2)
    if not true.any():
        raise ValueError(
            f"expected a density with two peaks that came true, got none of {rise.size}"
        )
    place = np.unravel_index(np.where(true, rise, 0).argmax(), rise.shape)
    return tuple(int(index) for index in place)
