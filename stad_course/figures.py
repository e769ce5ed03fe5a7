"""Figures of the lessons, each for one idea; the others are in `stad_lab.viz.plots`."""

from collections.abc import Callable
from itertools import cycle

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from stad_lab.viz.plots import (
    BLUE,
    ORANGE,
    RED,
    SKY,
    STYLES,
    THIN,
    caption,
    describe,
    legend_below,
    new_figure,
)


def plot_speed(speeds: np.ndarray, changes: np.ndarray) -> Figure:
    """The mean `|d|` at each speed (speeds,), a line for each place: changes (places, speeds)."""
    figure, ((axis,),) = new_figure(6.5, 3.6)
    axis.plot(speeds, changes.T, ".-", color=BLUE, lw=1, alpha=0.6)
    axis.set(xlabel="true speed (world units per second)", ylabel="mean |d| of the frame")
    lead = f"{len(changes)} lines; at the highest speed from "
    ends = f"{changes[:, -1].min():.3f} to {changes[:, -1].max():.3f}"
    return describe(figure, "How much the picture changes: a line is one place", lead, [ends])


def plot_rate_distortion(
    rates: np.ndarray, errors: np.ndarray, names: list[str], title: str
) -> Figure:
    """Rate (KL, nats) against distortion (squared error), a named point for each V."""
    figure, ((axis,),) = new_figure(6.5, 3.4)
    axis.plot(rates, errors, "o-", color=BLUE)
    axis.set(xlabel="rate: KL (nats)", ylabel="distortion: squared error")
    axis.margins(0.18)
    axis.set_xlim(left=-0.02 * rates.max())
    values = []
    for name, rate, error in zip(names, rates, errors, strict=True):
        place = {"xytext": (6, 6), "textcoords": "offset points"}
        axis.annotate(name, (rate, error), fontsize=9, **place)
        values.append(f"{name} {rate:.0f} nats, {error:.0f}")
    return describe(figure, title, "Points: ", values)


def plot_mixture(
    logpi: np.ndarray,
    mean: np.ndarray,
    logsigma: np.ndarray,
    temperatures: list[float],
    actual: float | None = None,
) -> Figure:
    """The density of a mixture, each array (mixtures,), at some temperatures.

    A single temperature also shows the parts, and one Gaussian of the same mean and variance.
    `actual` is the true value.
    """
    figure, ((axis,),) = new_figure(6.5, 3.4)
    reach = 4 * np.exp(logsigma) * np.sqrt(max(temperatures))
    z = np.linspace((mean - reach).min(), (mean + reach).max(), 600)
    for temperature, (color, dash) in zip(temperatures, cycle(STYLES), strict=False):
        weights = np.exp((logpi - logpi.max()) / temperature)
        weights /= weights.sum()
        sigma = np.exp(logsigma) * np.sqrt(temperature)
        gaussians = gaussian(z[:, None], mean, sigma)
        label = f"temperature {temperature:g}" if len(temperatures) > 1 else "M's mixture"
        axis.plot(z, gaussians @ weights, dash, color=color, lw=2, label=label)
        if len(temperatures) == 1:
            axis.plot(z, weights * gaussians, **THIN)
            center = weights @ mean
            spread = np.sqrt(weights @ (sigma**2 + (mean - center) ** 2))
            one = gaussian(z, center, spread)
            axis.plot(z, one, "-.", color=ORANGE, lw=1.5, label="one Gaussian")
    if actual is not None:
        axis.axvline(actual, color=RED, ls="--", lw=1.5, label="actual value")
    axis.set(xlabel="next value of the latent", ylabel="probability density", ylim=(0, None))
    axis.legend(frameon=False)
    lead, chosen = "Density of the mixture at temperature ", (f"{one:g}" for one in temperatures)
    return describe(figure, "M's prediction for one latent", lead, chosen)


def gaussian(z: np.ndarray, mean: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """The density of normal distributions at z; the arrays are broadcast together."""
    return np.exp(-0.5 * ((z - mean) / sigma) ** 2) / (np.sqrt(2 * np.pi) * sigma)


def plot_cma_es(
    landscape: Callable[[np.ndarray], np.ndarray],
    generations: list[dict],
    shown: list[int],
    title: str = "Population (dots), mean (cross) and one-sigma ellipse",
) -> Figure:
    """CMA-ES on a function of two variables: population and one-sigma ellipse of generations.

    Args:
        landscape: function of an array (..., 2), to be minimised.
        generations: each {"population" (n, 2), "mean" (2,), "covariance" (2, 2)}, the covariance
            with sigma squared.
        shown: indices of the generations to draw, one panel each.
    """
    size, reach = (2.5 * len(shown) + 0.5, 3.5), 4.0  # the panels show [-4, 4] in both variables
    figure, axes = new_figure(*size, 1, len(shown), sharex=True, sharey=True)
    x = np.linspace(-reach, reach, 121)
    height = landscape(np.stack(np.meshgrid(x, x), axis=-1))
    dots = {"s": 16, "color": ORANGE, "edgecolor": "black", "lw": 0.4, "zorder": 3}
    outline = {"fill": False, "ec": SKY, "lw": 2.5, "zorder": 4}
    for index, axis in zip(shown, axes[0], strict=True):
        generation, mean = generations[index], generations[index]["mean"]
        axis.contourf(x, x, np.log(height - height.min() + 1e-2), 18, cmap="Greys_r", alpha=0.8)
        axis.scatter(*generation["population"].T, **dots)
        values, vectors = np.linalg.eigh(generation["covariance"])
        tilt = np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1]))
        thickness, width = 2 * np.sqrt(values)
        axis.add_patch(Ellipse(mean, width, thickness, angle=tilt, **outline))
        axis.plot(*mean, "+", color=RED, ms=10, mew=2, zorder=5)
        axis.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal")
        caption(axis, f"generation {index + 1}", "x")
    axes[0, 0].set_ylabel("y")
    describe(figure, title, "Generations ", (str(index + 1) for index in shown))
    if len(shown) < 3:
        figure.suptitle("Population, mean, ellipse", fontsize=11)  # for a narrow figure
    return figure


def plot_ranks(ranks: dict[str, np.ndarray], title: str) -> Figure:
    """Ranks of the same candidates in several contests: name -> ranks (candidates,), 1 the best.

    A line for each candidate; the winner of the first contest is ORANGE.
    """
    figure, ((axis,),) = new_figure(6.5, 3.6)
    table = np.array(list(ranks.values()))
    winner = int(table[0].argmin())
    for candidate in range(table.shape[1]):
        if candidate != winner:
            axis.plot(table[:, candidate], "o-", color=BLUE, alpha=0.35, ms=4)
    label = "who won on the first"
    axis.plot(table[:, winner], "o-", color=ORANGE, lw=2.5, ms=7, label=label)
    axis.set(xticks=range(len(ranks)), xticklabels=list(ranks), ylabel="rank (1: the best)")
    axis.set(ylim=(table.max() + 0.7, 0.3), yticks=[1, *range(4, table.max() + 1, 4)])
    legend_below(figure, axis)
    places = [f"{name} rank {own[winner]}" for name, own in ranks.items()]
    return describe(figure, title, "The winner of the first: ", places)
