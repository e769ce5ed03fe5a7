"""Checks of the exercises to notebook 03. Each takes the student's functions."""

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch.distributions import Categorical, MixtureSameFamily, Normal

from stad_course.checks.answers import WrongAnswer, ask, check, check_interval


def mixtures() -> tuple[torch.Tensor, ...]:
    """Mixtures of five Gaussians: logpi, mean, ln deviation, equal ln deviation: (4, 6, 5)."""
    generator = torch.Generator().manual_seed(2)
    mean = torch.randn(4, 6, 5, generator=generator)
    logpi = torch.randn(4, 6, 5, generator=generator).log_softmax(-1)
    widths = 0.5 * torch.randn(4, 6, 5, generator=generator)
    return logpi, mean, widths, torch.full((4, 6, 5), -0.5)


def log_density_values(log_density: Callable) -> None:
    """The log density of targets near the mixtures, of (4, 6) and of (2, 2, 6)."""
    target = torch.rand(4, 6, generator=torch.Generator().manual_seed(3))
    check_log_density(log_density, mixtures()[:3], target, "log_density")
    deeper = [part.reshape(2, 2, 6, 5) for part in mixtures()[:3]]
    what = "log_density of (2, 2, 6) targets"
    check_log_density(log_density, deeper, target.reshape(2, 2, 6), what)


def log_density_far(log_density: Callable) -> None:
    """The log density a thousand away, where every density is 0 in the computer.

    There 136 nats are within the tolerance, so the formula is checked near the mixtures before, and
    40 away afterwards.
    """
    logpi, mean, _, equal = mixtures()
    far, what = torch.full((4, 6), 1e3), "log_density, 1000 away"
    found = ask(what, log_density, logpi, mean, equal, far)
    if isinstance(found, torch.Tensor) and torch.isinf(found).any():
        hint = "exp(-1360000) is 0 in the computer, and ln 0 is -inf: sum inside torch.logsumexp"
        wrong = f"the answer is {found.flatten()[0].item()}: expected about -1.36e6"
        raise WrongAnswer(what, wrong, hint)
    log_density_values(log_density)
    check_log_density(log_density, (logpi, mean, equal), far, what)
    nearer = torch.full((4, 6), 40.0)
    check_log_density(log_density, (logpi, mean, equal), nearer, "log_density, 40 away")


def check_log_density(
    log_density: Callable, mixture: Sequence, target: torch.Tensor, what: str
) -> None:
    """Check a log density of targets."""
    logpi, mean, logsigma = mixture
    each, shift = Normal(mean, logsigma.exp()).log_prob(target[..., None]), 0.5 * np.log(2 * np.pi)
    choice = Categorical(logits=logpi)
    right = MixtureSameFamily(choice, Normal(mean, logsigma.exp())).log_prob(target)
    halved = MixtureSameFamily(choice, Normal(mean, (0.5 * logsigma).exp())).log_prob(target)
    mistakes = {
        "the weights are missing: add logpi before you sum over the Gaussians": each.logsumexp(-1),
        "the factor 1 / sigma is missing: a narrow Gaussian is higher": torch.logsumexp(
            logpi + each + logsigma, -1
        ),
        "the factor 1 / sqrt(2 pi) is missing": right + shift,
        "the factor 1/2 before the square is missing": torch.logsumexp(
            logpi + 2 * each + logsigma + shift, -1
        ),
        "logsigma was taken for ln sigma squared: it is ln sigma, so take its exponential": halved,
        "these are logarithms of negative numbers: logpi is a logarithm already, so add it": (
            torch.full(target.shape, torch.nan)
        ),
        "logarithms were added: densities add up, so use logsumexp over the Gaussians": (
            logpi + each
        ).sum(-1),
        "this is a weighted mean of logarithms: sum densities, then take the logarithm": (
            logpi.exp() * each
        ).sum(-1),
        "this is a density: return its logarithm": right.exp(),
        "the sign is turned round: this is the loss, the negative logarithm": -right,
        "it is cut off, by a clamp or a number in the log: use logsumexp alone": right.clamp(
            min=-1e5
        ),
    }
    found = ask(what, log_density, logpi, mean, logsigma, target)
    check(what, found, right, mistakes)


def moments_of_mixtures(moments: Callable) -> None:
    """Mean and standard deviation of mixtures."""
    logpi, mean, widths, _ = mixtures()
    parts, pi = Normal(mean, widths.exp()), logpi.exp()
    both = MixtureSameFamily(Categorical(logits=logpi), parts)
    within, mixed = (pi * parts.variance).sum(-1), (pi * widths.exp()).sum(-1)
    between = both.variance - within
    unweighed = ((mean - both.mean[..., None]) ** 2).mean(-1)
    mistakes = {
        "the parts lie apart, and that is missing: add the variance of their means": within.sqrt(),
        "deviations were averaged, and the spread of the means is missing: add variances": (mixed),
        "the parts are wide, and that is missing: add their mean variance": between.sqrt(),
        "the squares are not weighted: use pi = exp(logpi)": (within + unweighed).sqrt(),
        "a standard deviation was taken for a variance: that is its square, exp(2 * logsigma)": (
            mixed + between
        ).sqrt(),
        "this is the variance: take its square root": both.variance,
        "standard deviations were added: add variances, then take the root": within.sqrt()
        + between.sqrt(),
    }
    found = ask("moments", moments, logpi, mean, widths)
    some = isinstance(found, tuple | list) or (isinstance(found, torch.Tensor) and found.ndim > 0)
    if not some or len(found) != 2:
        wrong = "moments must return two tensors"
        raise WrongAnswer("moments", wrong, "return mean, standard deviation")
    weigh = "use pi = exp(logpi)"
    centers = {f"the means are not weighted: {weigh}": mean.mean(-1)}
    centers[f"logpi, which is negative, was taken as the weight: {weigh}"] = (logpi * mean).sum(-1)
    check("the mean", found[0], both.mean, centers)
    check("the standard deviation", found[1], both.stddev, mistakes)
    what = "moments of (2, 2, 6) mixtures"
    deeper = (part.reshape(2, 2, 6, 5) for part in (logpi, mean, widths))
    found = ask(what, moments, *deeper)
    look = "sum over the last axis, dim=-1"
    for part, right in zip(found, (both.mean, both.stddev), strict=True):
        check(what, part, right.reshape(2, 2, 6), look=look)


def horizons(horizon: Callable) -> None:
    """The horizon of three episodes: where errors cross once, twice, and never."""
    dream = np.array(
        [[1.0, 6.0, 2.0, 4.0, 6.0], [1.0, 5.0, 5.0, 13.0, 13.0], [1.0, 1.0, 1.0, 1.0, 3.0]]
    )
    average = np.repeat([[5.0], [10.0], [2.0]], 5, axis=1)
    most = (
        "at this step most episodes err more, or it is the last one: compare sums, find the first"
    )
    mistakes = {
        "this is the place of a column: steps count from 1, so add 1": 3,
        "only a single episode errs more there: take the sums over the episodes": 2,
        most: 5,
    }
    check("horizon", ask("horizon", horizon, dream, average), 4, mistakes)
    twice, what = dream[:, [0, 3, 1, 4]], "horizon, if they meet twice"
    mistakes = {
        "this is the second time that they err more: find the first place": 4,
        "this is the place of a column: steps count from 1, so add 1": 1,
    }
    check(what, ask(what, horizon, twice, average[:, :4]), 2, mistakes)
    what = "horizon, if they err equally at first"
    equal = np.column_stack([dream[:, 0], average[:, 0], dream[:, 4]])
    mistakes = {"at this step both err equally: find the first where the dreams err more": 2}
    check(what, ask(what, horizon, equal, average[:, :3]), 3, mistakes)
    what = "horizon, if dreams never err more"
    mistakes = {
        "argmax of no True at all is 0: ask first whether there is one": 1,
        "this is the place of the last column: steps count from 1, so add 1": 4,
    }
    check(what, ask(what, horizon, dream, 9 + average), 5, mistakes)


def horizon_intervals(horizon_interval: Callable) -> None:
    """The interval of a horizon, where episodes are alike, and where they differ."""
    source = np.random.default_rng(8)
    grown = source.gamma(4.0, 0.25, (15, 1)) * np.linspace(0.1, 2.5, 60)
    dream = grown + 0.3 * source.standard_normal((15, 60))
    single = (
        "far too wide: these are horizons of single episodes; draw 15, take one horizon of them"
    )
    steps = "steps of one episode belong together: sample episodes, not a set of them for each step"
    mean = "this is the mean of single episodes' horizons: take the horizon of the summed errors"
    same = "without replacement every sample is the same: sample with replacement"
    narrow = "this is a 90% interval: take the percentiles 2.5 and 97.5"
    bounds = {single: (8.35, 54.05), steps: (19, 33), narrow: (22, 37)}
    bounds |= {mean: (14.67, 28.6), same: (30, 30)}
    given = dream, np.ones((15, 60)), np.random.default_rng(0)
    check_interval("horizon_interval", horizon_interval, given, (19, 39), bounds, 0.032)
    source = np.random.default_rng(9)
    hard = source.gamma(2.0, 0.5, (15, 1))  # on a hard episode both errors are large
    grown = hard * source.gamma(4.0, 0.25, (15, 1)) * np.linspace(0.1, 2.5, 60)
    bounds = {
        "the average picture's errors are of the same episodes: resample them together": (18, 44.5),
        "both errors of an episode belong together: sample the episodes once, for both": (16, 48.5),
    }
    dream = grown + 0.1 * source.standard_normal((15, 60))
    given = dream, np.repeat(hard, 60, axis=1), np.random.default_rng(0)
    what = "horizon_interval, where episodes differ"
    check_interval(what, horizon_interval, given, (23, 33), bounds, 0.032)
