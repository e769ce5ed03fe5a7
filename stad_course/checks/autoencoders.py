"""Checks of the exercises to the notebooks on autoencoders. Each takes the student's function."""

from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import torch

from stad_course.checks.answers import WrongAnswer, ask, check
from stad_lab.envs.frames import earlier_index


def codes() -> torch.Tensor:
    """Means, log-variances and noise of six pictures, with gradients: (3, 6, 32)."""
    generator = torch.Generator().manual_seed(1)
    return torch.randn(3, 6, 32, generator=generator, requires_grad=True)


def check_gradients(
    what: str, answer: Callable, given: tuple, right: torch.Tensor, mistakes: dict
) -> None:
    """Check a function of mu, logvar and more: its values, and the gradients of mu and logvar.

    `right` is computed from the tensors of `given`.
    """
    mu, logvar, *others = (part.detach().clone() for part in given)
    leaves = {"mu": mu.requires_grad_(), "logvar": logvar.requires_grad_()}
    found = ask(what, answer, *leaves.values(), *others)
    check(what, found, right, mistakes)
    if found.requires_grad:
        found.sum().backward()
    if lost := [name for name, leaf in leaves.items() if leaf.grad is None]:
        remedy = "then nothing is learned through it: do not detach, and avoid NumPy and no_grad()"
        raise WrongAnswer(what, f"no gradient comes back to {' and '.join(lost)}", remedy)
    gradients = torch.autograd.grad(right.sum(), given[:2])
    for (name, leaf), gradient in zip(leaves.items(), gradients, strict=True):
        if not torch.allclose(leaf.grad, gradient, atol=1e-4):
            remedy = "then V learns something else: do not detach a part of the formula"
            raise WrongAnswer(what, f"a wrong gradient comes back to {name}", remedy)


def kl_values(kl: Callable) -> None:
    """The KL divergence of six pictures, in nats."""
    mu, logvar, _ = codes()
    normal = torch.distributions.Normal
    sigma, variance = torch.exp(0.5 * logvar), logvar.exp()
    each = torch.distributions.kl_divergence(normal(mu, sigma), normal(0.0, 1.0))
    right = each.sum(1)
    mistakes = {
        "the factor 1/2 is missing": 2 * right,
        "the 1 is missing: a latent with mu = 0 and sigma = 1 must cost nothing": right + 16,
        "sigma stands where the formula wants its square: take exp(logvar)": right
        + 0.5 * (sigma - variance).sum(1),
        "the sign of the logarithm is turned round: a narrow q has a larger KL": right
        + logvar.sum(1),
        "logvar was taken for ln sigma: it is the logarithm of sigma squared": 0.5
        * (mu**2 + variance**2 - 1 - 2 * logvar).sum(1),
        "this is how much N(0, 1) diverges from q: exchange the two": 0.5
        * ((mu**2 + 1) / variance - 1 + logvar).sum(1),
        "the sign is turned round: a KL divergence is never negative": -right,
        "this is the mean over the latents: nats add up, so sum": each.mean(1),
        "this is each latent by itself: sum over them": each,
        "this is the sum over the pictures: sum over the latents (dim=1)": each.sum(0),
        "this is the sum over all pictures too: keep one number for each": each.sum(),
        "this is the mean over all pictures: keep one number for each": right.mean(),
    }
    check_gradients("kl(mu, logvar)", kl, (mu, logvar), right, mistakes)


def reparameterise_values(reparameterise: Callable) -> None:
    """The sample that a given noise stands for, and the gradients that pass through it."""
    mu, logvar, noise = codes()
    sigma, what = torch.exp(0.5 * logvar), "reparameterise(mu, logvar, noise)"
    torch.manual_seed(0)
    own = torch.randn(6, 32)
    mistakes = {
        "the noise was scaled by the variance, exp(logvar): take its root": mu
        + logvar.exp() * noise,
        "the noise was scaled by a logarithm: take exp(0.5 * logvar)": mu + logvar * noise,
        "there is no noise in it: multiply sigma by the noise that is given": mu + sigma,
        "this is the mean alone: add sigma times the noise": mu,
        "the mean is missing: add mu": sigma * noise,
        "mu and noise are exchanged: it is the noise that sigma scales": noise + sigma * mu,
        "this noise was sampled by you: use the one that is given": mu + sigma * own,
    }
    right = mu + sigma * noise
    torch.manual_seed(0)
    check_gradients(what, reparameterise, (mu, logvar, noise), right, mistakes)
    print("gradients reach mu and logvar, though z is a sample")


def active_latents(active: Callable) -> None:
    """The latents with more than 0.05 nats, and those with more than 1."""
    nats = np.array(
        [
            [0.3, 0.4, 0.04, 4.0, 0.06, 0.1, 0.02],
            [0.9, 0.4, 0.04, 2.0, 0.0, 0.0, 0.5],
            [0.3, 0.4, 0.03, 3.0, 0.0, 0.0, 0.02],
        ]
    )
    once = "latents 4 and 5 have more than 0.05 in one frame only: take the mean over the frames"
    missing = "the threshold is missing, or this is the sum over the frames: take the mean"
    mistakes = {
        "the smallest KL comes first: reverse the order": [6, 1, 0, 3],
        "the medians over the frames were sorted: take the mean": [3, 1, 0, 6],
        "these have a median above 0.05: take the mean over the frames": [3, 0, 1],
        "this is the median over the frames: take the mean": [3, 1, 0],
        "this is the order of the numbers, not of the nats: sort by the nats": [0, 1, 3, 6],
        once: [3, 0, 6, 1, 5, 4],
        "the largest KL of any frame was sorted: take the mean over the frames": [3, 0, 6, 1],
        missing: [3, 0, 1, 6, 2, 5, 4],
        "this says which latents are active, as bools: return their numbers": nats.mean(0) > 0.05,
        "these are nats: return the numbers of the latents": nats.mean(0)[[3, 0, 1, 6]],
    }
    right = np.array([3, 0, 1, 6])
    check("active(nats)", ask("active(nats)", active, nats), right, mistakes)
    mistakes = {
        "the threshold is not used: compare with `threshold`": [3, 0, 1, 6],
        "this says which latents are active, as bools: return their numbers": nats.mean(0) > 1,
        "this is a share of the frames: take the mean over the frames": [3, 0],
    }
    check("active(nats, 1.0)", ask("active(nats, 1.0)", active, nats, 1.0), np.array([3]), mistakes)


def silenced(silence: Callable) -> None:
    """Two latents of five pictures, set to zero in a copy."""
    z = torch.arange(1.0, 31.0).reshape(5, 6)
    keep = torch.tensor([1.0, 0.0, 1.0, 1.0, 0.0, 1.0])
    mistakes = {
        "these latents were kept, and the others silenced: set the named ones to 0": z * (1 - keep),
        "you silenced pictures (rows): latents are columns, z[:, latents]": z
        * torch.tensor([[1.0], [0.0], [1.0], [1.0], [0.0]]),
        "nothing was silenced: assign 0 to z[:, latents] of the copy": z.clone(),
        "this is the mean of these pictures: the prior's mean is 0": z * keep
        + (1 - keep) * z.mean(0),
        "these latents are 1, which is not the mean of the prior: set them to 0": z * keep
        + (1 - keep),
    }
    what = "silence(z, [1, 4])"
    check(what, ask(what, silence, z, np.array([1, 4])), z * keep, mistakes)


def reactions(reaction: Callable, encode: Callable) -> None:
    """The reaction of a V that one can compute by hand, at strides 4 and 2."""
    brightest: list[float] = []  # what V is given must lie between 0 and 1

    def note(frame: torch.Tensor, difference: torch.Tensor) -> tuple:
        brightest.append(float(frame.max()))
        return encode(frame, difference)

    vae, brightness = SimpleNamespace(encode=note), np.arange(120) ** 2 // 60
    film = np.ones((120, 64, 64, 3), np.uint8) * brightness.astype(np.uint8)[:, None, None, None]
    expected = {}
    for k in (4, 2):
        d = brightness - brightness[earlier_index(np.arange(120), k)]
        turned = 2 * d[50:]
        moved = np.hypot(brightness[50:] - brightness[:-50], d[50:] - d[:-50])
        expected[k] = right = turned.mean() / moved.mean()
        one_norm = np.linalg.norm(turned) / np.linalg.norm(moved)
        mistakes = {
            "this compares d with 0: compare with -d": right / 2,
            "it is upside down: the second between frames belongs below": 1 / right,
            "one norm over all frames: take each frame's (dim=1)": one_norm,
            "this is the mean of ratios: divide the means": (turned / moved).mean(),
            "the upper mean begins before frame 50: begin with it in both": 2
            * d.mean()
            / moved.mean(),
            "stride is not used: give it to earlier_frames": expected[4],
        }
        what = f"reaction(vae, film, {k})"
        check(what, ask(what, reaction, vae, film, k), right, mistakes)
        if max(brightest, default=0) > 1:
            remedy = "use to_tensors, which divides them by 255"
            raise WrongAnswer(what, "V was given frames from 0 to 255, not from 0 to 1", remedy)
