"""Figures: functions that take arrays and return a matplotlib Figure.

A Figure's label (`figure.get_label()`) is its alternative text. Colours are those of Okabe and Ito,
which colour-blind readers can distinguish; difference images share a diverging map centred at 0.
"""

import io
from collections.abc import Iterable
from itertools import cycle, product
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from stad_lab.config import VARIANTS
from stad_lab.envs.state import MOTION
from stad_lab.evaluation.statistics import SOLVED

BLUE, ORANGE, GREEN, RED = "#0072B2", "#E69F00", "#009E73", "#D55E00"
PURPLE, SKY = "#CC79A7", "#56B4E9"
COLORS = (BLUE, ORANGE, GREEN, PURPLE, RED, SKY)
DASHES = ("-", "--", "-.", ":")
# Lines differ in more than colour: to colour-blind readers GREEN and PURPLE are two greys.
STYLES = [(color, DASHES[(i + turn) % 4]) for turn in range(4) for i, color in enumerate(COLORS)]
VARIANT_STYLES = dict(zip(VARIANTS, STYLES, strict=False))
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


def styles_of(names: Iterable[str]) -> Iterable[tuple[str, str]]:
    """Colour and dash of each line or row; a variant has its own if all names are variants."""
    names = list(names)
    own = set(names) <= set(VARIANT_STYLES)
    return [VARIANT_STYLES[name] for name in names] if own else cycle(STYLES)


def draw_picture(axis: Axes, picture: np.ndarray, **scale) -> AxesImage:
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
    """A legend below the figure, of all that an axis names, each name once."""
    named = {name: one for one, name in zip(*axis.get_legend_handles_labels(), strict=True)}
    figure.legend(named.values(), named, loc="outside lower center", ncols=4, **SMALL)


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
) -> Figure:
    """Pictures in a grid.

    Args:
        rows: lists of pictures: uint8 (H, W, 3), or difference images float (H, W, 3), shown as
            their mean over the colours on one scale; None leaves a gap.
        columns: titles of the columns.
        names: of the rows; "" for none.
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
                draw_picture(axis, np.full((1, 1, 4), 0))  # transparent
            elif picture.dtype == np.uint8:
                draw_picture(axis, picture)
            else:
                drawn = draw_picture(axis, picture.mean(axis=-1), **scale)
        row_axes[0].set_ylabel(name, fontsize=9)
    for column, axis in zip(columns, axes[0], strict=True):
        caption(axis, column)
    if drawn is not None:
        figure.colorbar(drawn, ax=axes, shrink=0.8, aspect=30, label="difference d")
    lead = f"Rows: {', '.join(filter(None, names)) or 'one'}; columns: "
    return describe(figure, title, lead, columns)


# V, M and C


def plot_history(history: list[dict], title: str, unit: str) -> Figure:
    """Training and held-out loss against the training step, from a training's history."""
    steps = np.array([entry["step"] for entry in history])
    train, heldout = (
        np.array([entry[data]["total"] for entry in history]) for data in ("train", "heldout")
    )
    losses = {"train": train, "held-out": heldout}
    return plot_curves(losses, title, "training step", f"loss ({unit})", x=steps, marker=".")


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


def plot_histograms(shares: dict[str, np.ndarray], title: str, xlabel: str) -> Figure:
    """Histograms of numbers in [0, 1] as outlines; shares (bins,) are scaled so that 1 is uniform.

    Of a calibrated prediction the probability integral transform is uniform.
    """
    figure, ((axis,),) = new_figure(6.5, 3.2)
    for (name, share), (color, dash) in zip(shares.items(), styles_of(shares), strict=False):
        edges = np.linspace(0, 1, len(share) + 1)
        axis.stairs(share * len(share), edges, color=color, ls=dash, lw=1.8, label=name)
    axis.axhline(1, color="black", lw=1, ls="--", label="uniform")
    scaled = {name: share * len(share) for name, share in shares.items()}
    lowest = min(0.8, *(own.min() - 0.05 for own in scaled.values()))
    axis.set(xlabel=xlabel, ylabel="height of a bin (axis not from 0)", ylim=(lowest, None))
    axis.legend(**SMALL)
    ranges = [f"{name} {min(own):.2g} to {max(own):.2g}" for name, own in scaled.items()]
    return describe(figure, title, "Histograms relative to uniform, 1: ", ranges)


def plot_evolution(curves: np.ndarray, validation: dict[int, float], title: str) -> Figure:
    """Worst, average and best fitness of each generation: (3, generations), of `fitness_curves`.

    `validation`: generation -> score of the mean driver (C) on the validation tracks.
    """
    figure, ((axis,),) = new_figure(7.0, 3.8)
    generation = np.arange(1, curves.shape[1] + 1)
    names = ("worst", "average", "best")
    for values, name, color in zip(curves, names, ("#8c8c8c", BLUE, ORANGE), strict=True):
        axis.plot(generation, values, color=color, lw=1.3, label=f"{name} candidate")
    if validation:
        style = {"color": GREEN, "ms": 4, "label": "mean driver, validation tracks"}
        axis.plot(list(validation), list(validation.values()), "o--", **style)
    axis.axhline(SOLVED, **THIN, label=f"{SOLVED} points")
    axis.set(xlabel="generation", ylabel="fitness: mean return over the tracks")
    axis.set_ylim(min(-60, curves.min() - 20), 1000)
    axis.legend(**SMALL)
    last = [f"{name} {value:.0f}" for name, value in zip(names, curves[:, -1], strict=True)]
    return describe(figure, title, f"In the last of {curves.shape[1]} generations: ", last)


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
    shapes = cycle(MARKERS if many and marker else [marker])
    styles = zip(curves.items(), styles_of(curves), shapes, strict=False)
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
    styles = zip(returns.values(), styles_of(returns), strict=False)
    for row, (values, (color, _)) in enumerate(styles):
        mean, spread = values.mean(), 0.22 * (not paired)
        heights = row + rng.uniform(-spread, spread, len(values))
        axis.plot([mean] * 2, [row - 0.35, row + 0.35], color="black", lw=2.5, zorder=1)
        axis.scatter(values, heights, 12, color, alpha=0.6)
        axis.text(1.01, row, f"mean {mean:.0f}", transform=axis.get_yaxis_transform(), **text)
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
    shifts = np.linspace(-0.2, 0.2, len(names)) if len(names) > 1 else [0]
    styles = dict(zip(names, zip(cycle("oDs^vP"), cycle(COLORS), shifts), strict=False))
    lines, width = -(-len(panels) // columns), 2.0 + 2.5 * columns if columns > 1 else 6.5
    singles = any(len(one) > 2 for series in contents for one in series.values())
    row_height = max(0.32, 0.11 * len(names)) + 0.12 * singles  # inches
    height = lines * (row_height * len(rows) + 0.75) + 0.7
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
            lower = 0.11 * bool(single)  # the single values go below their mean
            y -= lower
            axis.plot(interval, [y] * 2, color=color, lw=2, alpha=0.5)
            axis.plot(x, y, mark, color=color, ms=5, clip_on=not outside)
            for places in single:
                axis.plot(places, [y + 2 * lower] * len(places), "|", color=color, ms=8, mew=1.2)
            if name in read:
                values.append(" ".join(filter(None, (panel, row, name, f"{value:.3g}"))))
        name_rows(axis, rows)
        for line in range(1, len(rows)) if len(names) > 1 else ():
            axis.axhline(line - 0.5, color="0.9", lw=0.8)
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
