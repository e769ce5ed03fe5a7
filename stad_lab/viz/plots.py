"""Figures: functions that take arrays and return a matplotlib Figure.

A Figure's label (`figure.get_label()`) is its alternative text. Colours are those of Okabe and Ito,
which colour-blind readers can distinguish; difference images share a diverging map centred at 0.
"""

import io
from collections.abc import Callable, Iterable
from itertools import cycle, product
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Ellipse

from stad_lab.envs.track import TRACK_WIDTH
from stad_lab.evaluation.statistics import SOLVED
from stad_lab.evaluation.trajectories import MOTION, Inspection, Trajectory

BLUE, ORANGE, GREEN, RED = "#0072B2", "#E69F00", "#009E73", "#D55E00"
PURPLE, SKY = "#CC79A7", "#56B4E9"
COLORS = (BLUE, ORANGE, GREEN, PURPLE, RED, SKY)
DASHES = ("-", "--", "-.", ":")
# Lines differ in more than colour: to colour-blind readers GREEN and PURPLE are two greys.
STYLES = [(color, DASHES[(i + turn) % 4]) for turn in range(4) for i, color in enumerate(COLORS)]
MARKERS = "os^DvP"
DIFFERENCE_MAP = "PuOr_r"
THIN = {"color": "grey", "lw": 0.8, "ls": ":"}  # a line for reference
SMALL: dict[str, Any] = {"frameon": False, "fontsize": 9}  # a legend


def new_figure(
    width: float, height: float, rows: int = 1, columns: int = 1, **kwargs
) -> tuple[Figure, np.ndarray]:
    """A Figure in inches, outside pyplot's global state, and its axes (rows, columns)."""
    figure = Figure(figsize=(width, height), layout="constrained", dpi=100)
    return figure, figure.subplots(rows, columns, squeeze=False, **kwargs)


def describe(figure: Figure, title: str, lead: str, values: Iterable[str] = ()) -> Figure:
    """Give a Figure its title, and an alternative text: the title, `lead` and all `values`."""
    figure.suptitle(title, fontsize=11)
    figure.set_label(f"{title}. {lead}{', '.join(values)}.")
    return figure


def show_picture(axis: Axes, picture: np.ndarray, **scale) -> AxesImage:
    """A picture in an axis without ticks and border; returns what a colour bar needs."""
    axis.set(xticks=[], yticks=[])
    axis.spines[:].set_visible(False)
    return axis.imshow(picture, interpolation="nearest", **scale)


def caption(axis: Axes, title: str, xlabel: str = "") -> None:
    """The title of a panel and the name of its horizontal axis."""
    axis.set_title(title, fontsize=9)
    axis.set_xlabel(xlabel, fontsize=9)


def name_rows(axis: Axes, names: Iterable[str]) -> None:
    """Names at the vertical axis, from the top down."""
    names = list(names)
    axis.set(yticks=range(len(names)), yticklabels=names, ylim=(len(names) - 0.5, -0.5))


def legend_below(figure: Figure, axis: Axes) -> None:
    """A legend below the figure, of all that an axis names."""
    figure.legend(*axis.get_legend_handles_labels(), loc="outside lower center", ncols=4, **SMALL)


def to_png(figure: Figure) -> bytes:
    """A Figure as PNG, with its alternative text in it."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Description": figure.get_label()})
    return buffer.getvalue()


def difference_colors(difference: np.ndarray) -> np.ndarray:
    """Difference images float (..., 3) in [-1, 1] as uint8 colours, saturated beyond 0.15."""
    shade = np.clip(difference.mean(axis=-1) / 0.3 + 0.5, 0, 1)
    return (colormaps[DIFFERENCE_MAP](shade)[..., :3] * 255).round().astype(np.uint8)


# Frames and driving


def plot_pictures(
    rows: list[list[np.ndarray | None]],
    columns: list[str],
    names: list[str],
    title: str,
    scale_name: str = "difference d",
) -> Figure:
    """Pictures in a grid.

    Args:
        rows: lists of pictures: uint8 (H, W, 3), or difference images float (H, W, 3), shown as
            their mean over the colours on one scale; None leaves a gap.
        columns: titles of the columns.
        names: of the rows; "" for none.
        scale_name: label of the difference images' scale.
    """
    size = 1.7 * len(columns) + 0.8, 1.75 * len(rows) + 0.75
    figure, axes = new_figure(*size, len(rows), len(columns))
    differences = [p for row in rows for p in row if p is not None and p.dtype != np.uint8]
    largest = (float(np.quantile(np.abs(p.mean(axis=-1)), 0.995)) for p in differences)
    limit, drawn = max([0.05, *largest]), None
    scale = {"cmap": DIFFERENCE_MAP, "norm": Normalize(-limit, limit)}
    for row, name, row_axes in zip(rows, names, axes, strict=True):
        for picture, axis in zip(row, row_axes, strict=True):
            if picture is None:
                show_picture(axis, np.full((1, 1, 4), 0))  # transparent
            elif picture.dtype == np.uint8:
                show_picture(axis, picture)
            else:
                drawn = show_picture(axis, picture.mean(axis=-1), **scale)
        row_axes[0].set_ylabel(name, fontsize=9)
    for column, axis in zip(columns, axes[0], strict=True):
        caption(axis, column)
    if drawn is not None:
        figure.colorbar(drawn, ax=axes, shrink=0.8, aspect=30, label=scale_name)
    lead = f"Rows: {', '.join(filter(None, names)) or 'one'}; columns: "
    return describe(figure, title, lead, columns)


def plot_speed(speed: np.ndarray, change: dict[int, np.ndarray]) -> Figure:
    """The car's speed at the end of every episode, and for each stride the mean `|d|` there."""
    figure, ((axis,),) = new_figure(6.5, 3.6)
    for (stride, values), color in zip(change.items(), cycle(COLORS), strict=False):
        label = f"stride {stride}: correlation {np.corrcoef(speed, values)[0, 1]:.2f}"
        axis.scatter(speed, values, s=8, color=color, alpha=0.6, label=label)
    axis.set(xlabel="true speed (world units per second)", ylabel="mean |d| of the frame")
    axis.legend(frameon=False)
    title = "The difference image grows with speed, and with the stride"
    lead = "One point for every episode and stride; strides "
    return describe(figure, title, lead, map(str, change))


def plot_paths(
    road: np.ndarray, paths: dict[str, tuple[np.ndarray, np.ndarray]], title: str
) -> Figure:
    """Driven paths on the road, from above, one panel each.

    Args:
        road: centres of its tiles, world units (tiles, 2).
        paths: name -> (where the car was, world units (T, 2); whether the human drove, bool (T,)).
    """
    figure, axes = new_figure(max(3.4 * len(paths), 5.0), 3.9, 1, len(paths))
    left, right = road_edges(road)
    points = np.concatenate([own for own, _ in paths.values()])
    low, high = points.min(axis=0), points.max(axis=0)
    middle, reach = (low + high) / 2, (high - low).max() / 2 + 2 * TRACK_WIDTH
    for axis, (name, (points, by_hand)) in zip(axes[0], paths.items(), strict=True):
        axis.fill(*np.concatenate([left, right[::-1]]).T, color="0.85")
        drivers = ("agent", ~by_hand, BLUE, 4), ("you, by hand", by_hand, ORANGE, 12)
        for driver, shown, color, size in drivers:
            if shown.any():
                axis.scatter(*points[shown].T, label=driver, color=color, s=size)
        axis.plot(*points[0], "^", color="black", ms=7, label="start")
        axis.plot(*points[-1], "x", color="black", ms=7, label="end")
        caption(axis, name, "world units")
        (x, y), far = middle, np.array([-reach, reach])
        axis.set(xlim=x + far, ylim=y + far, aspect="equal")
        axis.legend(frameon=False, fontsize=8)
    axes[0, 0].set_ylabel("world units")
    ends = [f"{name}: {len(own)} frames, {own.sum()} by hand" for name, (_, own) in paths.items()]
    return describe(figure, title, "The car's path on the road, from above. ", ends)


def plot_road(
    road: np.ndarray, paths: dict[str, np.ndarray], title: str, center: int, reach: float
) -> Figure:
    """A lap from above and a part of it enlarged, with the paths of cars.

    Args:
        road: centres of its tiles, world units (tiles, 2).
        paths: name -> position of a car in every frame, world units (T, 2).
        center: the tile around which the second panel is drawn.
        reach: how far that panel extends to each side, world units.
    """
    figure, axes = new_figure(8.6, 4.3, 1, 2)
    left, right = road_edges(road)
    for axis in axes[0]:
        axis.fill(*np.concatenate([left, right[::-1]]).T, color="0.85", label="road")
        for (name, path), (color, dash) in zip(paths.items(), STYLES, strict=False):
            axis.plot(*path.T, dash, color=color, lw=1.6, label=name)
            axis.plot(*path[-1], "x", color=color, ms=7)
        axis.set(xlabel="world units", aspect="equal")
    axes[0, 0].set(ylabel="world units", title="the lap (x: end of an episode)")
    (x, y), far = road[center], np.array([-reach, reach])
    axes[0, 1].set(xlim=x + far, ylim=y + far, title=f"around tile {center}")
    axes[0, 1].legend(fontsize=8)
    lead = f"A lap of {len(road)} tiles from above, and enlarged around tile {center}: "
    return describe(figure, title, f"{lead}the paths of ", paths)


def plot_moment(trajectory: Trajectory, inspection: Inspection, moment: int) -> Figure:
    """Frame `moment` of an episode: pictures, latents, prediction, action, and the return so far.

    Raises ValueError for a moment outside the episode.
    """
    length = len(trajectory)
    if not 0 <= moment < length:
        raise ValueError(f"moment={moment}: expected 0 to {length - 1}, a frame of the episode")
    figure = Figure(figsize=(9.5, 5.6), layout="constrained", dpi=100)
    parts: Any = figure.subfigures(3, 1, height_ratios=[1.6, 1.25, 0.8])
    above, middle, below = parts
    pictures = {
        "observation": trajectory.observations[moment],
        "frame x": inspection.frames[moment],
        "difference d": difference_colors(inspection.differences[moment]),
        "V's frame": inspection.frame_reconstructions[moment],
    }
    if inspection.difference_reconstructions is not None:
        reconstruction = inspection.difference_reconstructions[moment]
        pictures["V's difference"] = difference_colors(reconstruction)
    axes = above.subplots(1, len(pictures))
    for (name, picture), axis in zip(pictures.items(), axes, strict=True):
        show_picture(axis, picture)
        caption(axis, name)
    latents, weights, action = middle.subplots(1, 3, width_ratios=[2, 2, 1])
    latents.bar(np.arange(inspection.mu.shape[1]), inspection.mu[moment], color=BLUE, width=0.9)
    reach = np.abs(inspection.mu).max()
    latents.set(ylim=(-reach, reach), xlabel="latent", ylabel="z")
    shares = inspection.mixture.logpi[0, moment].exp().numpy().T
    weights.imshow(shares, aspect="auto", cmap="cividis", vmin=0, vmax=1, interpolation="nearest")
    weights.set(xlabel="latent", ylabel="Gaussian", yticks=[])
    weights.set_title("M's mixture weights for the next z (yellow: 1)", fontsize=9)
    names, colors = ["steering", "gas", "brake"], [ORANGE, GREEN, RED]
    action.barh(names, trajectory.actions[moment], color=colors)
    action.set(xlim=(-1, 1))
    action.invert_yaxis()
    action.axvline(0, color="black", lw=0.8)
    reward = below.subplots()
    reward.plot(trajectory.rewards.cumsum(), color=GREEN)
    reward.axvline(moment, color="black", lw=1)
    reward.set(xlabel="frame", ylabel="return so far", xlim=(0, length - 1))
    speed, earned = trajectory.motion[moment, 0], trajectory.rewards[moment]
    title = f"Frame {moment} of {length}: speed {speed:.0f} world units per second"
    content = "Observation, frame, difference, reconstruction, z, mixture weights, action, return"
    return describe(figure, f"{title}, reward {earned:+.1f}", content)


# V and M


def plot_history(history: list[dict], title: str, unit: str) -> Figure:
    """Training and held-out loss against the training step, from a training's history."""
    steps = np.array([entry["step"] for entry in history])
    train, heldout = (
        np.array([entry[data]["total"] for entry in history]) for data in ("train", "heldout")
    )
    losses = {"train": train, "held-out": heldout}
    return plot_curves(losses, title, "training step", f"loss ({unit})", x=steps, marker=".")


def plot_bars(values: dict[str, np.ndarray], title: str, xlabel: str, ylabel: str) -> Figure:
    """Sorted values, a panel for each name: for example the KL of every latent dimension."""
    figure, axes = new_figure(2.1 * len(values) + 0.6, 2.7, 1, len(values), sharey=True)
    for (name, array), axis, color in zip(values.items(), axes[0], cycle(COLORS), strict=False):
        axis.bar(np.arange(len(array)), np.sort(array)[::-1], color=color, width=0.9)
        caption(axis, name, xlabel)
    axes[0, 0].set_ylabel(ylabel)
    ranges = [f"{name} from {max(own):.3g} to {min(own):.3g}" for name, own in values.items()]
    return describe(figure, title, "Bars sorted from high to low: ", ranges)


def plot_rate_distortion(
    rates: np.ndarray, errors: np.ndarray, names: list[str], title: str
) -> Figure:
    """Rate (KL, nats) against distortion (squared error), a named point for each V."""
    figure, ((axis,),) = new_figure(6.5, 3.4)
    axis.plot(rates, errors, "o-", color=BLUE)
    axis.set(xlabel="rate: KL (nats)", ylabel="distortion: squared error")
    axis.margins(0.18)
    values = []
    for name, rate, error in zip(names, rates, errors, strict=True):
        place = {"xytext": (6, 6), "textcoords": "offset points"}
        axis.annotate(name, (rate, error), fontsize=9, **place)
        values.append(f"{name} {rate:.0f} nats, {error:.0f}")
    return describe(figure, title, "Points: ", values)


def plot_scatter(
    panels: dict[str, tuple[np.ndarray, np.ndarray]],
    title: str,
    xlabel: str,
    ylabel: str,
    values: dict[str, np.ndarray] | None = None,
) -> Figure:
    """Points, a panel for each name -> (x, y); `values` of some names colour their points."""
    size = 3.0 * len(panels) + 0.4, 3.1
    figure, axes = new_figure(*size, 1, len(panels), sharex=True, sharey=True)
    for axis, (name, points), color in zip(axes[0], panels.items(), cycle(COLORS), strict=False):
        caption(axis, name, xlabel)
        if values is None or name not in values:
            axis.scatter(*points, s=3, alpha=0.4, color=color)
            continue
        low, high = np.quantile(values[name], [0.02, 0.98])
        drawn = axis.scatter(*points, c=values[name], s=3, cmap="cividis", vmin=low, vmax=high)
        figure.colorbar(drawn, ax=axis, shrink=0.9, label=MOTION.get(name, ""))
    axes[0, 0].set_ylabel(ylabel)
    counts = [f"{name} ({len(x)} points)" for name, (x, _) in panels.items()]
    return describe(figure, title, "Panels: ", counts)


def plot_mixture(
    logpi: np.ndarray,
    mean: np.ndarray,
    logsigma: np.ndarray,
    temperatures: list[float],
    actual: float | None = None,
) -> Figure:
    """The density of a mixture, each array (mixtures,), at some temperatures."""
    figure, ((axis,),) = new_figure(6.5, 3.4)
    reach = 4 * np.exp(logsigma) * np.sqrt(max(temperatures))
    z = np.linspace((mean - reach).min(), (mean + reach).max(), 600)
    for temperature, (color, dash) in zip(temperatures, cycle(STYLES), strict=False):
        weights = np.exp((logpi - logpi.max()) / temperature)
        weights /= weights.sum()
        sigma = np.exp(logsigma) * np.sqrt(temperature)
        gaussians = np.exp(-0.5 * ((z[:, None] - mean) / sigma) ** 2) / (np.sqrt(2 * np.pi) * sigma)
        label = f"temperature {temperature:g}"
        axis.plot(z, gaussians @ weights, dash, color=color, lw=2, label=label)
        if len(temperatures) == 1:
            axis.plot(z, weights * gaussians, **THIN)
    if actual is not None:
        axis.axvline(actual, color=RED, ls="--", lw=1.5, label="actual value")
    axis.set(xlabel="next value of the latent", ylabel="probability density", ylim=(0, None))
    axis.legend(frameon=False)
    lead, chosen = "Density of the mixture at temperature ", (f"{one:g}" for one in temperatures)
    return describe(figure, "M's prediction for one latent", lead, chosen)


def plot_histograms(shares: dict[str, np.ndarray], title: str, xlabel: str) -> Figure:
    """Histograms of numbers in [0, 1] as outlines; shares (bins,) are scaled so that 1 is uniform.

    Of a calibrated prediction the probability integral transform is uniform.
    """
    figure, ((axis,),) = new_figure(6.5, 3.2)
    for (name, share), (color, dash) in zip(shares.items(), cycle(STYLES), strict=False):
        edges = np.linspace(0, 1, len(share) + 1)
        axis.stairs(share * len(share), edges, color=color, ls=dash, lw=1.8, label=name)
    axis.axhline(1, color="black", lw=1, ls="--", label="uniform")
    scaled = {name: share * len(share) for name, share in shares.items()}
    lowest = min(0.8, *(own.min() - 0.05 for own in scaled.values()))
    axis.set(xlabel=xlabel, ylabel="density (not from 0)", ylim=(lowest, None))
    axis.legend(**SMALL)
    ranges = [f"{name} {min(own):.2g} to {max(own):.2g}" for name, own in scaled.items()]
    return describe(figure, title, "Histograms relative to uniform, 1: ", ranges)


# CMA-ES


def plot_cma_es(
    landscape: Callable[[np.ndarray], np.ndarray],
    generations: list[dict],
    shown: list[int],
    title: str = "Population (dots), mean (cross) and one-sigma ellipse of CMA-ES",
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


def plot_evolution(curves: np.ndarray, validation: dict[int, float], title: str) -> Figure:
    """Worst, average and best fitness of each generation: (3, generations), of `fitness_curves`.

    `validation`: generation -> mean return of C on the validation tracks.
    """
    figure, ((axis,),) = new_figure(7.0, 3.8)
    generation = np.arange(1, curves.shape[1] + 1)
    names = ("worst", "average", "best")
    for values, name, color in zip(curves, names, (RED, BLUE, GREEN), strict=True):
        axis.plot(generation, values, color=color, lw=1.3, label=f"{name} agent of the generation")
    if validation:
        style = {"color": "black", "ms": 4, "label": "C, validation tracks"}
        axis.plot(list(validation), list(validation.values()), "o--", **style)
    axis.axhline(SOLVED, **THIN, label=f"{SOLVED} points")
    axis.set(xlabel="generation", ylabel="fitness: mean return over the tracks")
    axis.set_ylim(min(-60, curves.min() - 20), 1000)
    axis.legend(**SMALL)
    last = [f"{name} {value:.0f}" for name, value in zip(names, curves[:, -1], strict=True)]
    return describe(figure, title, f"In the last of {curves.shape[1]} generations: ", last)


def plot_episodes(
    runs: dict[str, list[tuple[np.ndarray, np.ndarray]]],
    published: dict[str, dict[int, float]],
    title: str,
) -> Figure:
    """Sample efficiency: score against the episodes driven for it, on a logarithmic axis.

    Args:
        runs: name -> for every seed its episodes and its scores at those.
        published: name -> episodes -> score, as others have reported: points without a line.
    """
    figure, ((axis,),) = new_figure(8.0, 4.2 + 0.08 * len(runs))
    last = []
    for (name, seeds), (color, dash) in zip(runs.items(), cycle(STYLES), strict=False):
        for episodes, scores in seeds:
            (line,) = axis.plot(episodes, scores, dash, color=color, lw=1.3, alpha=0.8)
        line.set_label(name)
        last.append(f"{name} {np.mean([scores[-1] for _, scores in seeds]):.0f}")
    for (name, points), marker in zip(published.items(), MARKERS, strict=False):
        axis.plot(list(points), list(points.values()), marker, color="black", ms=6, label=name)
    axis.axhline(SOLVED, **THIN)
    axis.set(xscale="log", xlabel="episodes (logarithmic)", ylabel="score", ylim=(None, 960))
    legend_below(figure, axis)  # inside the axis, many names would hide the points
    return describe(figure, title, "At the end, mean of the seeds: ", last)


# Results


def plot_curves(
    curves: dict[str, np.ndarray],
    title: str,
    xlabel: str,
    ylabel: str,
    x: np.ndarray | None = None,
    marker: str = "",
    **axis_settings,
) -> Figure:
    """Lines over a common axis.

    Args:
        x: of all lines; None for 1, 2, 3, ...
        marker: matplotlib's name of a mark at each point; of more than four lines each has its own.
        **axis_settings: of matplotlib's axis, for example `xscale="log"`.
    """
    many = len(curves) > 4  # then the names stand beside the lines
    figure, ((axis,),) = new_figure(7.5 if many else 6.5, 3.2)
    styles = zip(curves.items(), cycle(STYLES), cycle(MARKERS if many and marker else [marker]))
    for (name, values), (color, dash), shape in styles:
        places = np.arange(1, len(values) + 1) if x is None else x
        axis.plot(places, values, dash, color=color, label=name, marker=shape)
    axis.set(xlabel=xlabel, ylabel=ylabel, **axis_settings)
    beside = {"loc": "center left", "bbox_to_anchor": (1, 0.5)} if many else {}
    axis.legend(**SMALL, **beside)
    ends = [f"{name} from {own[0]:.3g} to {own[-1]:.3g}" for name, own in curves.items()]
    return describe(figure, title, "Lines: ", ends)


def plot_returns(returns: dict[str, np.ndarray], title: str, paired: bool = False) -> Figure:
    """Every episode's return as a dot, a row for each name, with the mean as a bar.

    `paired`: the rows have the same episodes in the same order, and lines join them.
    """
    figure, ((axis,),) = new_figure(7.0, 0.8 * len(returns) + 1.4)
    rng, text = np.random.default_rng(0), {"va": "center", "fontsize": 9}
    if paired:
        axis.plot(list(returns.values()), range(len(returns)), color="0.8", lw=1, zorder=0)
    for row, (values, color) in enumerate(zip(returns.values(), cycle(COLORS), strict=False)):
        mean, spread = values.mean(), 0.22 * (not paired)
        heights = row + rng.uniform(-spread, spread, len(values))
        axis.scatter(values, heights, 12, color, alpha=0.6)
        axis.plot([mean] * 2, [row - 0.35, row + 0.35], color="black", lw=2.5)
        axis.text(1.01, row, f"mean {mean:.0f}", transform=axis.get_yaxis_transform(), **text)
    axis.axvline(SOLVED, **THIN)
    axis.set_xlabel("return of an episode")
    name_rows(axis, returns)
    means = (f"{name} mean {values.mean():.0f}" for name, values in returns.items())
    return describe(figure, title, "", means)


def plot_stacks(stacks: dict[str, dict[str, float]], title: str, xlabel: str) -> Figure:
    """Stacked bars: name -> part -> value."""
    figure, ((axis,),) = new_figure(7.5, 0.42 * len(stacks) + 1.5)
    sums = []
    for place, (name, parts) in enumerate(stacks.items()):
        left = 0.0
        for (part, value), color in zip(parts.items(), cycle(COLORS), strict=False):
            label = part if place == 0 else None
            axis.barh(place, value, left=left, color=color, height=0.6, label=label)
            left += value
        axis.text(left, place, f" {left:.0f}", va="center", fontsize=9)
        sums.append(f"{name}: {', '.join(f'{part} {value:.0f}' for part, value in parts.items())}")
    axis.set_xlabel(xlabel)
    name_rows(axis, stacks)
    axis.margins(x=0.1)
    axis.legend(**SMALL, loc="lower center", bbox_to_anchor=(0.5, 1), ncols=3)
    return describe(figure, title, "; ".join(sums))


def plot_intervals(
    panels: dict[str, dict[str, dict[str, tuple]]],
    title: str,
    xlabel: str,
    columns: int = 3,
    limits: tuple[float, float] | None = None,
) -> Figure:
    """Values with their intervals, in panels, rows and series of their own colour and mark.

    Args:
        panels: panel -> row -> series -> (value, [low, high]), or with a list of single values
            behind them, which become short lines.
        columns: panels beside each other.
        limits: of the common horizontal axis; an arrow at the edge marks a value further left.
    """
    rows = list(next(iter(panels.values())))
    contents = [series for found in panels.values() for series in found.values()]
    names = list(dict.fromkeys(name for series in contents for name in series))
    shifts = np.linspace(-0.25, 0.25, len(names)) if len(names) > 1 else [0]
    styles = dict(zip(names, zip(cycle("oDs^vP"), cycle(COLORS), shifts), strict=False))
    lines, width = -(-len(panels) // columns), 2.0 + 2.5 * columns if columns > 1 else 6.5
    height = lines * (max(0.32, 0.11 * len(names)) * len(rows) + 0.75) + 0.7  # inches
    figure, axes = new_figure(width, height, lines, columns, sharex=True, sharey=True)
    lowest = -np.inf if limits is None else limits[0]
    # Nobody would listen to a longer alternative text.
    read, values = names if sum(map(len, contents)) <= 40 else names[:1], []
    for axis, (panel, found) in zip(axes.flat, panels.items(), strict=False):
        for (place, row), name in product(enumerate(rows), names):
            if name not in found[row]:
                continue
            (value, interval, *single), (mark, color, shift) = found[row][name], styles[name]
            y = place + (float(shift) if len(found[row]) > 1 else 0.0)
            outside = value < lowest
            x, mark = (lowest, "<") if outside else (value, mark)
            lower = 0.18 * bool(single)  # the single values go below their mean
            y -= lower / 2
            axis.plot(interval, [y] * 2, color=color, lw=2, alpha=0.5)
            axis.plot(x, y, mark, color=color, ms=5, clip_on=not outside)
            for places in single:
                axis.plot(places, [y + 2 * lower] * len(places), "|", color=color, ms=8, mew=1.2)
            if name in read:
                values.append(" ".join(filter(None, (panel, row, name, f"{value:.3g}"))))
        name_rows(axis, rows)
        axis.grid(axis="x", color="0.9")
        axis.set_title(panel, fontsize=9)
    for axis in axes[-1]:
        axis.set_xlabel(xlabel, fontsize=9)
    if limits:  # a limit that is set no longer grows with later panels
        axes[0, 0].set_xlim(limits)
    if len(names) > 1:
        for name, (mark, color, _) in styles.items():
            axes[0, 0].plot([], [], mark, color=color, label=name)
        legend_below(figure, axes[0, 0])
    return describe(figure, title, "; ".join(values))


# Candidates on the map


def road_edges(road: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Both edges of a lap, closed: centres of its tiles (tiles, 2) -> (tiles + 1, 2) each."""
    along = np.roll(road, -1, axis=0) - np.roll(road, 1, axis=0)
    across = TRACK_WIDTH * along[:, ::-1] * (-1, 1) / np.linalg.norm(along, axis=1, keepdims=True)
    left, right = (np.concatenate([edge, edge[:1]]) for edge in (road + across, road - across))
    return left, right


def draw_map(axis: Axes, road: np.ndarray, paths: list[np.ndarray], returns: np.ndarray) -> None:
    """A lap from above with the path of each car: the best in ORANGE, the others in BLUE."""
    left, right = road_edges(road)
    axis.fill(*np.concatenate([left, right[::-1]]).T, color="0.87")
    best = int(np.argmax(returns))
    for place, path in enumerate(paths):
        if place != best:
            axis.plot(*path.T, color=BLUE, lw=1.0, alpha=0.6)
            axis.plot(*path[-1], ".", color=BLUE, ms=5)
    axis.plot(*paths[best].T, color=ORANGE, lw=2.2)
    axis.plot(*paths[best][-1], ".", color=ORANGE, ms=9)
    axis.plot(*road[0], "^", color="black", ms=7)
    low, high = road.min(axis=0) - 35, road.max(axis=0) + 35  # a car may end far in the grass
    axis.set(xticks=[], yticks=[], aspect="equal", xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    axis.spines[:].set_visible(False)


def plot_maps(maps: dict[str, tuple], title: str) -> Figure:
    """Laps from above: name -> (road (tiles, 2), paths of cars (T, 2) each, returns (cars,))."""
    rows = -(-len(maps) // 5)
    columns = -(-len(maps) // rows)
    figure, axes = new_figure(min(2.6 * columns, 10.5) + 0.2, 2.9 * rows + 0.4, rows, columns)
    for axis, (name, (road, paths, returns)) in zip(axes.flat, maps.items(), strict=False):
        draw_map(axis, road, paths, returns)
        caption(axis, f"{name}: best {returns.max():.0f}" if len(returns) > 1 else name)
    for axis in axes.flat[len(maps) :]:
        axis.set_visible(False)
    bests = [f"{name}, best return {own[2].max():.0f}" for name, own in maps.items()]
    return describe(figure, title, "Laps from above (triangle: start, dot: end). ", bests)


def plot_learning(generations: list[dict], total: int, title: str) -> Figure:
    """The last generation on its map, beside the returns of all so far.

    Args:
        generations: each {"road", "paths", "returns"} as `plot_maps` takes them.
        total: generations of the whole run, the width of the axis.
    """
    figure, axes = new_figure(9.4, 4.2, 1, 2, width_ratios=[1, 1.25])
    last, number = generations[-1], np.arange(1, len(generations) + 1)
    draw_map(axes[0, 0], last["road"], last["paths"], last["returns"])
    caption(axes[0, 0], f"generation {len(generations)}: all candidates (orange: the best)")
    axis = axes[0, 1]
    returns = np.array([own["returns"] for own in generations])
    axis.plot(number, returns, ".", color=BLUE, ms=3, alpha=0.5)
    axis.plot(number, returns.max(axis=1), color=ORANGE, lw=1.6, label="best candidate")
    axis.plot(number, returns.mean(axis=1), color=BLUE, lw=2.2, label="average candidate")
    axis.axhline(SOLVED, **THIN, label=f"{SOLVED} points")
    axis.set(xlabel="generation", ylabel="return of an episode", xlim=(0.5, total + 0.5))
    axis.set_ylim(min(-20, returns.min() - 20), 960)
    legend_below(figure, axis)
    means = f"average return {returns[0].mean():.0f} at first, {returns[-1].mean():.0f} at last"
    return describe(figure, title, f"{len(generations)} generations: {means}")


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
    axis.set_ylim(table.max() + 1, 0)
    legend_below(figure, axis)
    places = [f"{name} rank {own[winner]}" for name, own in ranks.items()]
    return describe(figure, title, "The winner of the first: ", places)


def plot_dream(
    real: np.ndarray,
    dream: np.ndarray,
    moment: int,
    name: str,
    steps: np.ndarray,
    errors: dict[str, np.ndarray],
) -> Figure:
    """A moment of an episode beside its dream, and how far dreams are from reality by then.

    Args:
        real, dream: uint8 (T, 64, 64, 3) from the same moment on.
        moment: the frame to show, from 0.
        name: of the dream.
        steps: of `errors`, 1 for the first dreamed frame.
        errors: name -> error at these steps, 1 for that of the best constant picture.
    """
    figure, axes = new_figure(9.4, 3.0, 1, 3, width_ratios=[1, 1, 1.7])
    for axis, picture, title in zip(axes[0], (real, dream), ("real", name), strict=False):
        show_picture(axis, picture[moment])
        caption(axis, title)
    axis = axes[0, 2]
    for (way, values), (color, dash) in zip(errors.items(), STYLES, strict=False):
        axis.plot(steps, values, dash, color=color, label=way)
    axis.axhline(1, **THIN)
    axis.axvline(moment + 1, color="black", lw=1.5)
    axis.set(xlabel="steps dreamed", ylabel="error (best constant = 1)", ylim=(0, None))
    axis.legend(**SMALL, loc="lower right")
    title = f"Step {moment + 1} of a dream ({(moment + 1) / 50:.1f} seconds)"
    now = [f"{way} {np.interp(moment + 1, steps, own):.2f}" for way, own in errors.items()]
    return describe(figure, title, "Real frame, dreamed frame, and errors at this step: ", now)
