"""Figures: functions that take arrays and return a matplotlib Figure, or a moving picture, and nothing else.

Each Figure's label (`figure.get_label()`) is its alternative text. Colours are Okabe and Ito's, which colour-blind eyes
can tell apart; difference images lie on one diverging map centred at zero.
"""

import io
import itertools
from collections.abc import Callable, Iterable

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from PIL import Image, ImageDraw, ImageFont

from stad_lab.envs.car_racing import TRACK_WIDTH
from stad_lab.evaluation.evaluate import SOLVED
from stad_lab.evaluation.trajectories import MOTION, Drive, Inside

BLUE, ORANGE, GREEN, RED, PURPLE, SKY = (
    "#0072B2",
    "#E69F00",
    "#009E73",
    "#D55E00",
    "#CC79A7",
    "#56B4E9",
)
COLORS = (BLUE, ORANGE, GREEN, PURPLE, RED, SKY)
DASHES = ("-", "--", "-.", ":")
# Of lines: to colour-blind eyes GREEN and PURPLE are two greys, so they differ in more than colour.
STYLES = tuple(
    (color, DASHES[(place + turn) % 4]) for turn in range(4) for place, color in enumerate(COLORS)
)
MARKERS = "os^DvP"
DIFFERENCE_MAP = "PuOr_r"


def new_figure(
    width: float, height: float, rows: int = 1, columns: int = 1, **kwargs
) -> tuple[Figure, np.ndarray]:
    """An empty figure of so many inches, outside pyplot's global state: (Figure, its axes (rows, columns))."""
    figure = Figure(figsize=(width, height), layout="constrained", dpi=100)
    return figure, figure.subplots(rows, columns, squeeze=False, **kwargs)


def plot_pictures(
    rows: list[list[np.ndarray | None]], columns: list[str], names: list[str], title: str
) -> Figure:
    """Pictures in a grid.

    Args:
        rows: each a list of pictures: uint8 (H, W, 3), or a difference image float (H, W, 3) in [-1, 1], of which the
            mean over the colours is shown on a diverging map, one scale for the whole figure; None leaves a gap.
        columns: titles of the columns.
        names: of the rows; "" for none.
    """
    figure, axes = new_figure(
        1.7 * len(columns) + 0.8, 1.75 * len(rows) + 0.75, len(rows), len(columns)
    )
    differences = [
        p.mean(axis=-1) for row in rows for p in row if p is not None and p.dtype != np.uint8
    ]
    limit = max([0.05, *(float(np.quantile(np.abs(d), 0.995)) for d in differences)])
    scale, drawn = Normalize(-limit, limit), None
    for row, name, row_axes in zip(rows, names, axes, strict=True):
        for picture, axis in zip(row, row_axes, strict=True):
            axis.set(xticks=[], yticks=[])
            axis.spines[:].set_visible(False)
            if picture is None:
                continue
            if picture.dtype == np.uint8:
                axis.imshow(picture, interpolation="nearest")
            else:
                drawn = axis.imshow(
                    picture.mean(axis=-1), cmap=DIFFERENCE_MAP, norm=scale, interpolation="nearest"
                )
        row_axes[0].set_ylabel(name, fontsize=9)
    for column, axis in zip(columns, axes[0], strict=True):
        axis.set_title(column, fontsize=9)
    if drawn is not None:
        figure.colorbar(drawn, ax=axes, shrink=0.8, aspect=30, label="difference d")
    figure.suptitle(title, fontsize=11)
    figure.set_label(
        f"{title}. Rows: {', '.join(filter(None, names)) or 'one'}; columns: {', '.join(columns)}."
    )
    return figure


def plot_speed(speed: np.ndarray, change: dict[int, np.ndarray]) -> Figure:
    """How much of the picture changes against how fast the car is.

    Args:
        speed: of the car in every ride, world units per second.
        change: stride -> mean `|d|` at the end of every ride.
    """
    figure, ((axis,),) = new_figure(6.5, 3.6)
    for (stride, values), color in zip(change.items(), itertools.cycle(COLORS), strict=False):
        correlation = np.corrcoef(speed, values)[0, 1]
        axis.scatter(
            speed,
            values,
            s=8,
            color=color,
            alpha=0.6,
            label=f"stride {stride}: correlation {correlation:.2f}",
        )
    axis.set(xlabel="true speed (world units per second)", ylabel="mean |d| of the frame")
    axis.legend(frameon=False)
    title = "The difference image grows with speed, and with the stride"
    axis.set_title(title, fontsize=11)
    figure.set_label(
        f"{title}: one point for every ride and stride; strides {', '.join(map(str, change))}."
    )
    return figure


def plot_history(history: list[dict], title: str, unit: str) -> Figure:
    """Training and held-out loss against the training step; `history` as `training.fit` returns it."""
    figure, ((axis,),) = new_figure(6.5, 3.2)
    steps = [entry["step"] for entry in history]
    for kind, color, style in (("train", BLUE, "-"), ("heldout", ORANGE, "--")):
        axis.plot(
            steps,
            [entry[kind]["total"] for entry in history],
            style,
            color=color,
            label=kind,
            marker=".",
        )
    axis.set(xlabel="training step", ylabel=f"loss ({unit})")
    axis.legend(frameon=False)
    axis.set_title(title, fontsize=11)
    last = history[-1]
    figure.set_label(
        f"{title}. After {last['step']} steps: train {last['train']['total']:.3g},"
        f" held-out {last['heldout']['total']:.3g} {unit}."
    )
    return figure


def plot_bars(values: dict[str, np.ndarray], title: str, xlabel: str, ylabel: str) -> Figure:
    """Sorted values, one panel for each name, on one scale: for example the KL of every latent dimension."""
    figure, axes = new_figure(2.1 * len(values) + 0.6, 2.7, 1, len(values), sharey=True)
    for (name, array), axis, color in zip(
        values.items(), axes[0], itertools.cycle(COLORS), strict=False
    ):
        axis.bar(np.arange(len(array)), np.sort(array)[::-1], color=color, width=0.9)
        axis.set_title(name, fontsize=9)
        axis.set_xlabel(xlabel, fontsize=9)
    axes[0, 0].set_ylabel(ylabel)
    figure.suptitle(title, fontsize=11)
    told = ", ".join(
        f"{name} from {max(array):.3g} to {min(array):.3g}" for name, array in values.items()
    )
    figure.set_label(f"{title}. Bars sorted from high to low: {told}.")
    return figure


def plot_mixture(
    logpi: np.ndarray,
    mean: np.ndarray,
    logsigma: np.ndarray,
    temperatures: list[float],
    actual: float | None = None,
) -> Figure:
    """The density of one latent dimension that a mixture (each array (mixtures,)) stands for, at some temperatures."""
    figure, ((axis,),) = new_figure(6.5, 3.4)
    reach = 4 * np.exp(logsigma) * np.sqrt(max(temperatures))
    z = np.linspace((mean - reach).min(), (mean + reach).max(), 600)
    for temperature, (color, dash) in zip(temperatures, itertools.cycle(STYLES), strict=False):
        weights = np.exp((logpi - logpi.max()) / temperature)
        weights /= weights.sum()
        sigma = np.exp(logsigma) * np.sqrt(temperature)
        parts = (
            weights
            * np.exp(-0.5 * ((z[:, None] - mean) / sigma) ** 2)
            / (sigma * np.sqrt(2 * np.pi))
        )
        axis.plot(
            z, parts.sum(axis=1), dash, color=color, lw=2, label=f"temperature {temperature:g}"
        )
        if len(temperatures) == 1:
            axis.plot(z, parts, color="grey", lw=0.8, ls=":")
    if actual is not None:
        axis.axvline(actual, color=RED, ls="--", lw=1.5, label="what came")
    axis.set(
        xlabel="next value of the latent dimension", ylabel="probability density", ylim=(0, None)
    )
    axis.legend(frameon=False)
    title = "What M expects of one latent dimension"
    axis.set_title(title, fontsize=11)
    figure.set_label(
        f"{title}: density of the mixture at temperature {', '.join(f'{t:g}' for t in temperatures)}."
    )
    return figure


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
        x: of all lines; None to count 1, 2, 3, ...
        marker: matplotlib's name of a mark at each point; with more than four lines each has a shape of its own.
        **axis_settings: of matplotlib's axis, for example `xscale="log"`.
    """
    many = len(curves) > 4  # then the names stand beside the lines
    figure, ((axis,),) = new_figure(7.5 if many else 6.5, 3.2)
    shapes = itertools.cycle(MARKERS if many and marker else [marker])
    for (name, values), (color, dash), shape in zip(
        curves.items(), itertools.cycle(STYLES), shapes, strict=False
    ):
        places = np.arange(1, len(values) + 1) if x is None else x
        axis.plot(places, values, dash, color=color, label=name, marker=shape)
    axis.set(xlabel=xlabel, ylabel=ylabel, **axis_settings)
    beside = {"loc": "center left", "bbox_to_anchor": (1, 0.5)} if many else {}
    axis.legend(frameon=False, fontsize=9, **beside)
    axis.set_title(title, fontsize=11)
    told = ", ".join(
        f"{name} from {values[0]:.3g} to {values[-1]:.3g}" for name, values in curves.items()
    )
    figure.set_label(f"{title}. Lines: {told}.")
    return figure


def plot_intervals(
    panels: dict[str, dict[str, dict[str, tuple[float, list[float]]]]],
    title: str,
    xlabel: str,
    columns: int = 3,
    limits: tuple[float, float] | None = None,
) -> Figure:
    """Values with their intervals: a panel for each question, a row for each contender, a colour for each series.

    Args:
        panels: panel -> row -> series -> (value, [low, high]).
        columns: panels beside each other.
        limits: of the common horizontal axis; a value further left is marked by an arrow at the edge.
    """
    lines = -(-len(panels) // columns)
    rows = list(next(iter(panels.values())))
    width = 2.0 + 2.5 * columns if columns > 1 else 6.5
    names = list(
        dict.fromkeys(
            name for contenders in panels.values() for row in contenders.values() for name in row
        )
    )
    height = max(0.32, 0.11 * len(names)) * len(rows) + 0.75  # of a panel, in inches
    figure, axes = new_figure(width, lines * height + 0.7, lines, columns, sharex=True, sharey=True)
    shifts = np.linspace(-0.2, 0.2, len(names)) if len(names) > 1 else [0]
    for axis, (panel, contenders) in zip(axes.flat, panels.items(), strict=False):
        for place, row in enumerate(rows):
            for name, color, shift in zip(names, itertools.cycle(COLORS), shifts, strict=False):
                if name not in contenders[row]:
                    continue
                value, interval = contenders[row][name]
                outside = limits is not None and value < limits[0]
                x, y = (
                    limits[0] if outside else value,
                    place + (shift if len(contenders[row]) > 1 else 0),
                )
                axis.plot(interval, [y] * 2, color=color, lw=2, alpha=0.5)
                axis.plot(x, y, "<" if outside else "o", color=color, ms=5, clip_on=not outside)
        axis.set(yticks=range(len(rows)), yticklabels=rows, ylim=(len(rows) - 0.5, -0.5))
        axis.grid(axis="x", color="0.9")
        axis.set_title(panel, fontsize=9)
    for axis in axes[-1]:
        axis.set_xlabel(xlabel, fontsize=9)
    if limits:  # and left alone without them: a limit that is set, if only to itself, no longer grows with later panels
        axes[0, 0].set_xlim(limits)
    if len(names) > 1:
        handles = [
            axes[0, 0].plot([], [], "o", color=c)[0]
            for _, c in zip(names, itertools.cycle(COLORS), strict=False)
        ]
        figure.legend(
            handles, names, loc="outside lower right", ncols=len(names), frameon=False, fontsize=9
        )
    figure.suptitle(title, fontsize=11)
    count = sum(len(found) for contenders in panels.values() for found in contenders.values())
    told = names if count <= 40 else names[:1]  # more than that, nobody would listen to
    values = [
        " ".join(filter(None, (panel, row, name, f"{contenders[row][name][0]:.3g}")))
        for panel, contenders in panels.items()
        for row in rows
        for name in told
        if name in contenders[row]
    ]
    figure.set_label(f"{title}. {'; '.join(values)}.")
    return figure


def plot_claims(scores: dict[str, dict[str, tuple[float, list[float], list[float]]]]) -> Figure:
    """What the paper reports of each variant beside what came out here: `table.claims_and_outcomes`.

    A dot is a mean, with its interval; a short line through it is one search. The second panel is a close-up.
    """
    names = list(
        dict.fromkeys(name for found in scores.values() for name in found)
    )  # a variant may lack some
    figure, ((whole, close),) = new_figure(
        9.0, 3.4, 1, 2, sharey=True, gridspec_kw={"width_ratios": [3, 2]}
    )
    for axis, (place, found) in itertools.product((whole, close), enumerate(scores.values())):
        for name, color, shift in zip(
            names, COLORS, np.linspace(-0.27, 0.27, len(names)), strict=False
        ):
            if name in found:
                mean, interval, searches = found[name]
                axis.plot(interval, [place + shift] * 2, color=color, lw=2, alpha=0.4)
                axis.plot(
                    searches, [place + shift] * len(searches), "|", color=color, ms=8, mew=1.5
                )
                axis.plot(mean, place + shift, "o" if searches else "D", color=color, ms=5)
    whole.set(yticks=range(len(scores)), yticklabels=list(scores), ylim=(len(scores) - 0.5, -0.5))
    close.set_xlim(870, 930)
    for axis, panel in ((whole, "all"), (close, "close up")):
        axis.set_title(panel, fontsize=9)
        axis.set_xlabel("return", fontsize=9)
        axis.grid(axis="x", color="0.9")
    handles = [
        whole.plot([], [], "D" if name == names[0] else "o", color=color)[0]
        for name, color in zip(names, COLORS, strict=False)
    ]
    figure.legend(
        handles, names, loc="outside lower right", ncols=len(names), frameon=False, fontsize=9
    )
    title = (
        "Claimed and found: mean return on 100 tracks, ours with its 95% interval and its searches"
    )
    figure.suptitle(title, fontsize=11)
    told = [
        f"{variant} {name} {mean:.0f}"
        + (f" (searches {', '.join(f'{own:.0f}' for own in searches)})" * bool(searches))
        for variant, found in scores.items()
        for name, (mean, _, searches) in found.items()
    ]
    figure.set_label(f"{title}. {'; '.join(told)}.")
    return figure


def plot_stacks(stacks: dict[str, dict[str, float]], title: str, xlabel: str) -> Figure:
    """Sums and what they are made of: name -> part -> value, a bar for each name, a colour for each part."""
    figure, ((axis,),) = new_figure(7.5, 0.42 * len(stacks) + 1.5)
    for place, parts in enumerate(stacks.values()):
        left = 0.0
        for (part, value), color in zip(parts.items(), itertools.cycle(COLORS), strict=False):
            axis.barh(
                place, value, left=left, color=color, height=0.6, label=part if place == 0 else None
            )
            left += value
        axis.text(left, place, f" {left:.0f}", va="center", fontsize=9)
    axis.set(
        xlabel=xlabel,
        yticks=range(len(stacks)),
        yticklabels=list(stacks),
        ylim=(len(stacks) - 0.5, -0.5),
    )
    axis.margins(x=0.1)
    axis.legend(frameon=False, fontsize=9, loc="lower center", bbox_to_anchor=(0.5, 1), ncols=3)
    figure.suptitle(title, fontsize=11)
    told = "; ".join(
        f"{name}: {', '.join(f'{part} {value:.0f}' for part, value in parts.items())}"
        for name, parts in stacks.items()
    )
    figure.set_label(f"{title}. {told}.")
    return figure


def plot_rate_distortion(
    rates: np.ndarray, errors: np.ndarray, names: list[str], title: str
) -> Figure:
    """What a latent tells (rate, nats) against what the drawing misses (distortion): a named point for each V."""
    figure, ((axis,),) = new_figure(6.5, 3.4)
    axis.plot(rates, errors, "o-", color=BLUE)
    for rate, error, name in zip(rates, errors, names, strict=True):
        axis.annotate(name, (rate, error), xytext=(6, 6), textcoords="offset points", fontsize=9)
    axis.set(xlabel="rate: KL (nats)", ylabel="distortion: squared error")
    axis.margins(0.18)
    axis.set_title(title, fontsize=11)
    points = ", ".join(
        f"{name} {rate:.0f} nats, {error:.0f}"
        for name, rate, error in zip(names, rates, errors, strict=True)
    )
    figure.set_label(f"{title}. Points: {points}.")
    return figure


def plot_shares(shares: dict[str, np.ndarray], title: str, xlabel: str) -> Figure:
    """Histograms of numbers in [0, 1] as outlines, each bar as a multiple of what a uniform one would have."""
    figure, ((axis,),) = new_figure(6.5, 3.2)
    for (name, share), (color, dash) in zip(shares.items(), itertools.cycle(STYLES), strict=False):
        edges = np.linspace(0, 1, len(share) + 1)
        axis.stairs(share * len(share), edges, color=color, ls=dash, lw=1.8, label=name)
    axis.axhline(1, color="black", lw=1, ls="--", label="uniform")
    axis.set(xlabel=xlabel, ylabel="density", ylim=(0, None))
    axis.legend(frameon=False, fontsize=9)
    axis.set_title(title, fontsize=11)
    told = ", ".join(
        f"{name} {min(s) * len(s):.2g} to {max(s) * len(s):.2g}" for name, s in shares.items()
    )
    figure.set_label(f"{title}. Histograms against a uniform one, which is 1: {told}.")
    return figure


def plot_map(points: np.ndarray, colors: dict[str, np.ndarray], title: str) -> Figure:
    """Points in the plane (n, 2), once for each name, coloured by that name's values (n,)."""
    figure, axes = new_figure(
        3.3 * len(colors) + 0.4, 3.3, 1, len(colors), sharex=True, sharey=True
    )
    for axis, (name, values) in zip(axes[0], colors.items(), strict=True):
        low, high = np.quantile(values, [0.02, 0.98])
        drawn = axis.scatter(*points.T, c=values, s=3, cmap="cividis", vmin=low, vmax=high)
        axis.set(xticks=[], yticks=[], xlabel="first principal component")
        axis.set_title(name, fontsize=9)
        figure.colorbar(drawn, ax=axis, shrink=0.9, label=MOTION.get(name, ""))
    axes[0, 0].set_ylabel("second")
    figure.suptitle(title, fontsize=11)
    figure.set_label(f"{title}. {len(points)} points, coloured by {', '.join(colors)}.")
    return figure


def plot_fit(
    x: np.ndarray, y: np.ndarray, samples: dict[str, tuple[np.ndarray, np.ndarray]], title: str
) -> Figure:
    """Data points, and beside them what models would draw in their place: name -> (x, y)."""
    figure, axes = new_figure(
        2.5 * (1 + len(samples)) + 0.3, 2.9, 1, 1 + len(samples), sharex=True, sharey=True
    )
    for axis, (name, dots), color in zip(
        axes[0], {"data": (x, y), **samples}.items(), itertools.cycle(COLORS), strict=False
    ):
        axis.scatter(*dots, s=3, alpha=0.4, color=color)
        axis.set_title(name, fontsize=9)
        axis.set_xlabel("input")
    axes[0, 0].set_ylabel("target")
    figure.suptitle(title, fontsize=11)
    figure.set_label(f"{title}. Panels: data, {', '.join(samples)}.")
    return figure


def plot_paths(paths: dict[str, tuple[np.ndarray, np.ndarray]], title: str) -> Figure:
    """Driven paths seen from above, a panel for each: name -> (points (T, 2), whether the hand drove, bool (T,))."""
    figure, axes = new_figure(max(3.4 * len(paths), 5.0), 3.9, 1, len(paths))
    for axis, (name, (points, by_hand)) in zip(axes[0], paths.items(), strict=True):
        for driver, shown, color, size in (
            ("agent", ~by_hand, BLUE, 4),
            ("hand", by_hand, ORANGE, 12),
        ):
            if shown.any():
                axis.scatter(*points[shown].T, s=size, color=color, label=driver)
        axis.plot(*points[0], "^", color="black", ms=9, label="start")
        axis.set_xlabel("world units, to the right of the start")
        axis.set_aspect("equal", adjustable="datalim")  # panels of one size, whatever the way was
        axis.set_title(name, fontsize=9)
        axis.legend(frameon=False, fontsize=8)
    axes[0, 0].set_ylabel("world units, ahead of the start")
    figure.suptitle(title, fontsize=11)
    ends = ", ".join(
        f"{name}: {len(hand)} frames, {hand.sum()} by hand" for name, (_, hand) in paths.items()
    )
    figure.set_label(f"{title}. The way of the car from above. {ends}.")
    return figure


def plot_road(
    road: np.ndarray, paths: dict[str, np.ndarray], title: str, center: int, reach: float
) -> Figure:
    """A lap from above, and a part of it close up, with the ways that cars took.

    Args:
        road: centres of its tiles, world units (tiles, 2).
        paths: name -> where a car was in every frame, world units (T, 2).
        center: the tile around which the second panel is drawn.
        reach: how far that panel goes to each side, world units.
    """
    figure, axes = new_figure(8.6, 4.3, 1, 2)
    along = np.roll(road, -1, axis=0) - np.roll(road, 1, axis=0)
    across = TRACK_WIDTH * along[:, ::-1] * (-1, 1) / np.linalg.norm(along, axis=1, keepdims=True)
    edges = [np.concatenate([edge, edge[:1]]) for edge in (road + across, road - across)]
    for axis in axes[0]:
        axis.fill(*np.concatenate([edges[0], edges[1][::-1]]).T, color="0.85", label="road")
        for (name, path), (color, dash) in zip(paths.items(), STYLES, strict=False):
            axis.plot(*path.T, dash, color=color, lw=1.6, label=name)
            axis.plot(*path[-1], "x", color=color, ms=7)
        axis.set(xlabel="world units", aspect="equal")
    axes[0, 0].set(ylabel="world units", title="the lap (x: where the drive ends)")
    (x, y), far = road[center], np.array([-reach, reach])
    axes[0, 1].set(xlim=x + far, ylim=y + far, title=f"around tile {center}")
    axes[0, 1].legend(fontsize=8)
    figure.suptitle(title, fontsize=11)
    ways = f"the ways of {', '.join(paths)}"
    figure.set_label(
        f"{title}. A lap of {len(road)} tiles from above, and close up around tile {center}: {ways}."
    )
    return figure


def plot_moment(drive: Drive, inside: Inside, moment: int) -> Figure:
    """Everything about one moment of a drive: pictures, latents, forecast, action, and the return so far.

    Args:
        inside: what V and M make of the drive.
        moment: which frame, 0 to len(drive) - 1.

    Raises:
        ValueError: a moment outside the drive.
    """
    if not 0 <= moment < len(drive):
        raise ValueError(
            f"moment={moment}: expected 0 to {len(drive) - 1}, the drive has {len(drive)} frames"
        )
    figure = Figure(figsize=(9.5, 5.6), layout="constrained", dpi=100)
    above, middle, below = figure.subfigures(3, 1, height_ratios=[1.6, 1.25, 0.8])
    pictures = {
        "observation": drive.observations[moment],
        "frame x": inside.frames[moment],
        "difference d": difference_colors(inside.differences[moment]),
        "V's frame": inside.drawn_frames[moment],
    }
    if inside.drawn_differences is not None:
        pictures["V's difference"] = difference_colors(inside.drawn_differences[moment])
    for (name, picture), axis in zip(
        pictures.items(), above.subplots(1, len(pictures)), strict=True
    ):
        axis.imshow(picture, interpolation="nearest")
        axis.set(xticks=[], yticks=[])
        axis.set_title(name, fontsize=9)
        axis.spines[:].set_visible(False)
    latents, weights, action = middle.subplots(1, 3, width_ratios=[2, 2, 1])
    latents.bar(np.arange(inside.mu.shape[1]), inside.mu[moment], color=BLUE, width=0.9)
    reach = np.abs(inside.mu).max()
    latents.set(ylim=(-reach, reach), xlabel="latent", ylabel="z")
    shares = inside.mixture.logpi[0, moment].exp().numpy().T
    weights.imshow(shares, aspect="auto", cmap="cividis", vmin=0, vmax=1, interpolation="nearest")
    weights.set(xlabel="latent", ylabel="Gaussian", yticks=[])
    weights.set_title("M's mixture weights for the next z (yellow: 1)", fontsize=9)
    action.barh(["steering", "gas", "brake"], drive.actions[moment], color=[ORANGE, GREEN, RED])
    action.set(xlim=(-1, 1))
    action.invert_yaxis()
    action.axvline(0, color="black", lw=0.8)
    reward = below.subplots()
    reward.plot(drive.rewards.cumsum(), color=GREEN)
    reward.axvline(moment, color="black", lw=1)
    reward.set(xlabel="frame", ylabel="return so far", xlim=(0, len(drive) - 1))
    speed = drive.motion[moment, 0]
    title = f"Frame {moment} of {len(drive)}: speed {speed:.0f} world units per second, reward {drive.rewards[moment]:+.1f}"
    figure.suptitle(title, fontsize=11)
    figure.set_label(
        f"{title}. Observation, frame, difference, what V redraws, z, mixture weights, action, return."
    )
    return figure


def plot_search(
    landscape: Callable[[np.ndarray], np.ndarray], generations: list[dict], shown: list[int]
) -> Figure:
    """CMA-ES on a function of two variables: the population and the one-sigma ellipse of some generations.

    Args:
        landscape: function of an array (..., 2), to be minimised.
        generations: each {"population" (n, 2), "mean" (2,), "covariance" (2, 2)}, the covariance with sigma squared.
        shown: indices of the generations to draw, one panel each.
    """
    figure, axes = new_figure(2.5 * len(shown) + 0.5, 3.5, 1, len(shown), sharex=True, sharey=True)
    reach = 4.0  # the panels show [-reach, reach] in both variables
    x = np.linspace(-reach, reach, 121)
    height = landscape(np.stack(np.meshgrid(x, x), axis=-1))
    for index, axis in zip(shown, axes[0], strict=True):
        generation = generations[index]
        axis.contourf(x, x, np.log(height - height.min() + 1e-2), 18, cmap="Greys_r", alpha=0.8)
        axis.scatter(
            *generation["population"].T, s=16, color=ORANGE, edgecolor="black", lw=0.4, zorder=3
        )
        values, vectors = np.linalg.eigh(generation["covariance"])
        tilt = np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1]))
        width, thickness = 2 * np.sqrt(values[1]), 2 * np.sqrt(values[0])
        axis.add_patch(
            Ellipse(
                generation["mean"],
                width,
                thickness,
                angle=tilt,
                fill=False,
                ec=SKY,
                lw=2.5,
                zorder=4,
            )
        )
        axis.plot(*generation["mean"], "+", color=RED, ms=10, mew=2, zorder=5)
        axis.set(xlim=(-reach, reach), ylim=(-reach, reach), xlabel="x", aspect="equal")
        axis.set_title(f"generation {index + 1}", fontsize=9)
    axes[0, 0].set_ylabel("y")
    title = "CMA-ES learns where to look: population (dots), mean (cross), one-sigma ellipse"
    figure.suptitle(title if len(shown) > 2 else "Population, mean, one-sigma ellipse", fontsize=11)
    figure.set_label(f"{title}, in generations {', '.join(str(i + 1) for i in shown)}.")
    return figure


def plot_evolution(curves: np.ndarray, validation: dict[int, float], title: str) -> Figure:
    """Worst, average and best fitness against the generation: the paper's three figures in one.

    Args:
        curves: (3, generations), as `evolution.fitness_curves` makes them.
        validation: generation -> mean return of C so far on the validation tracks.
    """
    figure, ((axis,),) = new_figure(7.0, 3.8)
    generation = np.arange(1, curves.shape[1] + 1)
    for values, name, color in zip(
        curves, ("worst", "average", "best"), (RED, BLUE, GREEN), strict=True
    ):
        axis.plot(generation, values, color=color, lw=1.3, label=f"{name} agent of the generation")
    if validation:
        axis.plot(
            *zip(*validation.items(), strict=True),
            "o--",
            color="black",
            ms=4,
            label="C, validation tracks",
        )
    axis.axhline(SOLVED, color="grey", lw=0.8, ls=":")
    axis.set(
        xlabel="generation",
        ylabel="fitness: mean return over the tracks",
        ylim=(min(-60, curves.min() - 20), 1000),
    )
    axis.legend(frameon=False, fontsize=9)
    axis.set_title(title, fontsize=11)
    figure.set_label(
        f"{title}. In the last of {curves.shape[1]} generations: worst {curves[0, -1]:.0f},"
        f" average {curves[1, -1]:.0f}, best {curves[2, -1]:.0f}."
    )
    return figure


def plot_seeds(runs: dict[str, np.ndarray], title: str, window: int = 5) -> Figure:
    """The paper's three figures, worst, average and best agent against the generation, with seeds as bands.

    Args:
        runs: name -> (seeds, 3, generations), for each seed what `evolution.fitness_curves` makes. A line is the mean
            over the seeds, its band goes from the lowest to the highest, and each seed is a thin line in it.
        window: generations of the running mean, which lets a line be seen through the noise; all of a shorter run.
    """
    figure, axes = new_figure(11.0, 3.9, 1, 3, sharey=True)
    for panel, (axis, name) in enumerate(zip(axes[0], ("worst", "average", "best"), strict=True)):
        for (label, curves), (color, dash) in zip(
            runs.items(), itertools.cycle(STYLES), strict=False
        ):
            width = min(window, curves.shape[2])
            smooth = np.apply_along_axis(
                np.convolve, 1, curves[:, panel], np.full(width, 1 / width), "valid"
            )
            generation = np.arange(smooth.shape[1]) + (width + 1) / 2
            axis.plot(generation, smooth.mean(axis=0), dash, color=color, lw=1.6, label=label)
            axis.plot(generation, smooth.T, color=color, lw=0.7, alpha=0.5)
            axis.fill_between(
                generation, smooth.min(axis=0), smooth.max(axis=0), color=color, alpha=0.1, lw=0
            )
        axis.axhline(SOLVED, color="grey", lw=0.8, ls=":")
        axis.set_title(f"{name} agent of a generation", fontsize=10)
        axis.set_xlabel("generation")
    window = min([window, *(curves.shape[2] for curves in runs.values())])
    axes[0, 0].set_ylabel(f"fitness, mean of {window} generations")
    figure.legend(
        *axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False
    )
    figure.suptitle(title, fontsize=11)
    last = ", ".join(f"{name} {curves[:, 1, -window:].mean():.0f}" for name, curves in runs.items())
    figure.set_label(
        f"{title}. Average agent of the last {window} generations, mean of the seeds: {last}."
    )
    return figure


def plot_episodes(
    runs: dict[str, list[tuple[np.ndarray, np.ndarray]]],
    published: dict[str, dict[int, float]],
    title: str,
) -> Figure:
    """Score against the episodes that were driven for it, on a logarithmic axis: the fair comparison of recipes.

    Args:
        runs: name -> for every seed its episodes and its scores at those.
        published: name -> episodes -> score, as others have reported: points without a line.
    """
    figure, ((axis,),) = new_figure(8.0, 4.2 + 0.08 * len(runs))
    for (name, seeds), (color, dash) in zip(runs.items(), itertools.cycle(STYLES), strict=False):
        for number, (episodes, scores) in enumerate(seeds):
            axis.plot(
                episodes,
                scores,
                dash,
                color=color,
                lw=1.3,
                alpha=0.8,
                label=name if number == 0 else None,
            )
    for (name, points), marker in zip(published.items(), MARKERS, strict=False):
        axis.plot(list(points), list(points.values()), marker, color="black", ms=6, label=name)
    axis.axhline(SOLVED, color="grey", lw=0.8, ls=":")
    axis.set(
        xscale="log",
        xlabel="episodes driven in all (logarithmic)",
        ylabel="score",
        ylim=(None, 960),
    )
    # Below the axis: inside it, many names would hide the points.
    figure.legend(
        *axis.get_legend_handles_labels(),
        loc="outside lower center",
        ncols=3,
        frameon=False,
        fontsize=9,
    )
    axis.set_title(title, fontsize=11)
    last = ", ".join(
        f"{name} {np.mean([scores[-1] for _, scores in seeds]):.0f}" for name, seeds in runs.items()
    )
    figure.set_label(f"{title}. At the end, mean of the seeds: {last}.")
    return figure


def plot_returns(returns: dict[str, np.ndarray], title: str) -> Figure:
    """Every episode's return as a dot, one row for each name, with the mean as a bar."""
    figure, ((axis,),) = new_figure(7.0, 0.8 * len(returns) + 1.4)
    rng = np.random.default_rng(0)
    for row, (values, color) in enumerate(
        zip(returns.values(), itertools.cycle(COLORS), strict=False)
    ):
        axis.scatter(
            values, row + rng.uniform(-0.22, 0.22, len(values)), s=12, color=color, alpha=0.6
        )
        axis.plot([values.mean()] * 2, [row - 0.35, row + 0.35], color="black", lw=2.5)
        axis.text(
            1.01,
            row,
            f"mean {values.mean():.0f}",
            transform=axis.get_yaxis_transform(),
            va="center",
            fontsize=9,
        )
    axis.axvline(SOLVED, color="grey", lw=0.8, ls=":")
    axis.set(
        xlabel="return of an episode",
        yticks=range(len(returns)),
        yticklabels=list(returns),
        ylim=(len(returns), -1),
    )
    axis.set_title(title, fontsize=11)
    means = ", ".join(f"{name} mean {values.mean():.0f}" for name, values in returns.items())
    figure.set_label(f"{title}. {means}.")
    return figure


def difference_colors(difference: np.ndarray) -> np.ndarray:
    """A difference image, float (..., 3) in [-1, 1], as uint8 colours of the diverging map: for moving pictures.

    Beyond -0.15 and 0.15 the colours no longer change.
    """
    shade = np.clip(difference.mean(axis=-1) / 0.3 + 0.5, 0, 1)
    return (colormaps[DIFFERENCE_MAP](shade)[..., :3] * 255).round().astype(np.uint8)


def moving_picture(columns: dict[str, np.ndarray], fps: float = 25) -> bytes:
    """An animated GIF of films side by side.

    Args:
        columns: title -> film, uint8 (frames, H, W, 3), square; all of one length.
        fps: pictures per second.

    Raises:
        ValueError: no films, or films of different lengths.
    """
    lengths = {title: len(film) for title, film in columns.items()}
    if len(set(lengths.values())) != 1 or 0 in lengths.values():
        raise ValueError(
            f"films of lengths {lengths}: expected films of one length, at least one frame"
        )
    size, header, gap = 192, 20, 6  # pixels
    font = ImageFont.load_default(13)
    pages = []
    for pictures in zip(*columns.values(), strict=True):
        page = Image.new("RGB", (len(columns) * (size + gap) - gap, size + header), "white")
        draw = ImageDraw.Draw(page)
        for place, (title, picture) in enumerate(zip(columns, pictures, strict=True)):
            left = place * (size + gap)
            draw.text((left + size / 2, header / 2), title, fill="black", font=font, anchor="mm")
            page.paste(
                Image.fromarray(picture).resize((size, size), Image.Resampling.NEAREST),
                (left, header),
            )
        pages.append(page)
    # One palette for the whole film, or colours would flicker; "maximum coverage" keeps rare ones, as the car's red.
    sample = np.concatenate([np.asarray(page) for page in pages[:: max(1, len(pages) // 8)]])
    palette = Image.fromarray(sample).quantize(256, Image.Quantize.MAXCOVERAGE)
    pages = [page.quantize(palette=palette, dither=Image.Dither.NONE) for page in pages]
    buffer = io.BytesIO()
    pages[0].save(
        buffer, "GIF", save_all=True, append_images=pages[1:], duration=round(1000 / fps), loop=0
    )
    return buffer.getvalue()


def moving_figure(figures: Iterable[Figure], fps: float, kind: str = "gif") -> bytes:
    """Figures of one size as an animation, for readers without a kernel.

    Args:
        kind: "gif", or "webp", which is sharper and smaller.

    Raises:
        ValueError: another kind, or no figures.
    """
    check_kind(kind)
    pages = [Image.open(io.BytesIO(to_png(figure))).convert("RGB") for figure in figures]
    if not pages:
        raise ValueError("no figures: expected at least one")
    buffer = io.BytesIO()
    pages[0].save(
        buffer, kind, save_all=True, append_images=pages[1:], duration=round(1000 / fps), loop=0
    )
    return buffer.getvalue()


def check_kind(kind: str) -> None:
    """Raise ValueError unless `kind` is one of those that `moving_figure` can write."""
    if kind not in ("gif", "webp"):
        raise ValueError(f"kind={kind!r}: expected 'gif' or 'webp', by the file's name too")


def to_png(figure: Figure) -> bytes:
    """A Figure as PNG, with its alternative text in it."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Description": figure.get_label()})
    return buffer.getvalue()
