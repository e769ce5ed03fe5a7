"""The figures of the studies that docs/protocol.md fixes."""

from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from stad_lab.viz.plots import (
    VARIANT_STYLES,
    caption,
    describe,
    legend_below,
    name_rows,
    new_figure,
    plot_intervals,
    styles_of,
)

COLOURS = {variant: colour for variant, (colour, _) in VARIANT_STYLES.items()}
SEEN = {"z, h": "C sees z and h", "z": "C sees z"}
DRIVERS = {"agent": "an agent", "random_driver": "the random driver"}
SOURCES = {"z": "z", "z, h": "z and h"}
CAUSE = {  # the comparisons of study 5, in Markdown
    "effect with z": "`input_output` - `frame`, C sees z",
    "effect with z and h": "`input_output` - `frame`, C sees z and h",
    "interaction": "`input_output` - `frame`: interaction, row 1 minus row 2",
    "input_output less input": "`input_output` - `input`, mean of both C",
    "adding motion": "`frame`: z + motion, minus z + placebo",
    "erasing motion": "`input_output`: z - motion, minus z - placebo",
    "both with motion": "`input_output` - `frame`, both with z + motion",
    "remembering the action": "`frame`: z + action, minus z + placebo",
}
TURNING = ("slip speed", "yaw rate", "wheel angle")  # what a single frame does not show


def difference_of(one: dict) -> str:
    """A variant's difference to `frame` with its interval, as on the pages."""
    low, high = one["interval"]
    return f"{one['difference']:+.1f} ({low:.1f} to {high:.1f})"


def plot_study(comparisons: dict[str, dict], margin: float, reported: float) -> Figure:
    """The forest plot of study 1: each pipeline minus `frame` of its seed, and the mean of these.

    Args:
        comparisons: "FEATURES: VARIANT" -> "difference", "interval", "by_seed" and "verdict".
        margin: differences within +-margin, in points, are not relevant.
        reported: the gain of `input_output` that the paper reports, in points.
    """
    variants = [variant for variant in COLOURS if variant != "frame"]
    paper = f"paper, input_output: {reported:+.0f}"
    figure, axes = new_figure(8.0, 4.6, 2, 1, sharex=True)
    for axis, (features, title) in zip(axes[:, 0], SEEN.items(), strict=True):
        draw_margin(axis, margin)
        axis.axvline(reported, color="black", linestyle="--", label=paper)
        for height, variant in enumerate(variants):
            one = comparisons[f"{features}: {variant}"]
            plot_comparison(axis, height, one, COLOURS[variant])
            beside = axis.get_yaxis_transform()
            axis.text(1.01, height, one["verdict"], transform=beside, va="center", fontsize=9)
        name_rows(axis, variants)
        axis.set_title(title, loc="left", fontsize=10)
    axes[1, 0].set_xlabel("mean return minus that of frame with the same seed, points")
    legend_below(figure, axes[0, 0])
    told = []
    for features, seen in SEEN.items():
        named = ((variant, comparisons[f"{features}: {variant}"]) for variant in variants)
        cells = (f"{name} {difference_of(one)}, {one['verdict']}" for name, one in named)
        told.append(f"{seen}: {'; '.join(cells)}")
    pairs = len(comparisons["z: input"]["by_seed"])
    lead = f"Means, 95% intervals, a circle for each of {pairs} seeds. "
    return describe(figure, "Study 1: points more or less than frame", lead, [". ".join(told)])


def draw_margin(axis: Axes, margin: float) -> None:
    """The band of a forest plot within the margin, and its zero line."""
    axis.axvspan(-margin, margin, color="0.92", label=f"margin: {margin} points")
    axis.axvline(0, color="black", linewidth=0.8)


def plot_comparison(axis: Axes, height: float, one: dict, colour: str) -> None:
    """A line of a forest plot: the interval and the mean, and above them the seeds."""
    seeds: dict[str, Any] = {
        "markerfacecolor": "white",
        "markeredgecolor": colour,
        "linestyle": "none",
    }
    axis.plot(
        one["interval"], [height] * 2, color=colour, linewidth=2.5, label="mean, 95% interval"
    )
    axis.plot(one["difference"], height, "D", color=colour, markersize=7)
    places = [height - 0.27] * len(one["by_seed"])
    axis.plot(one["by_seed"], places, "o", markersize=5, label="one seed", **seeds)


def plot_cause(comparisons: dict[str, dict], margin: float) -> Figure:
    """The comparisons of study 5 that there are, a row each.

    Args:
        comparisons: name, of `CAUSE` -> "difference", "interval" and "by_seed".
        margin: as of `plot_study`.
    """
    titles = {name: title.replace("`", "") for name, title in CAUSE.items()}
    rows = {title: comparisons[name] for name, title in titles.items() if name in comparisons}
    figure, ((axis,),) = new_figure(8.6, 1.4 + 0.55 * len(rows))
    draw_margin(axis, margin)
    for height, (title, one) in enumerate(rows.items()):
        plot_comparison(axis, height, one, COLOURS[title.split()[0].rstrip(":")])
    name_rows(axis, [title.replace(": ", ":\n") for title in rows])
    axis.set_xlabel("difference, points (a score is the mean of three C)")
    legend_below(figure, axis)
    told = [f"{title} {difference_of(one)}" for title, one in rows.items()]
    return describe(figure, "Study 5: the differences", "Means: ", ["; ".join(told)])


def plot_cause_curves(arms: dict[str, dict], every: int) -> Figure:
    """Validation means of the arms of study 5 whose C sees z or a changed z, by generation.

    Args:
        arms: "VARIANT: SEES" -> "curve" -> "mean", at each validation.
        every: generations between two validations.
    """
    figure, axes = new_figure(8.6, 4.0, 1, 2, sharex=True, sharey=True)
    told = []
    for axis, variant in zip(axes[0], ("frame", "input_output"), strict=True):
        own = {
            arm.partition(": ")[2]: one["curve"]["mean"]
            for arm, one in arms.items()
            if arm.startswith(f"{variant}: z") and not arm.endswith("z, h")
        }
        for (sees, mean), (colour, dash) in zip(own.items(), styles_of(own), strict=False):
            generations = [every * (number + 1) for number in range(len(mean))]
            axis.plot(generations, mean, dash, color=colour, label=f"C sees {sees}")
        caption(axis, variant, "generation")
        axis.legend(fontsize=8, loc="lower right")
        ends = (f"{sees} {mean[-1]:.0f}" for sees, mean in own.items())
        told.append(f"{variant}: {', '.join(ends)}")
    axes[0, 0].set_ylabel("mean on the validation tracks")
    return describe(figure, "Study 5: learning curves, means of all runs", "At the end: ", told)


def plot_scores(arms: dict[str, dict]) -> Figure:
    """The score of every pipeline of study 1, a circle each, and the mean of each arm.

    Args:
        arms: "FEATURES: VARIANT" -> "mean" and "by_seed".
    """
    figure, axes = new_figure(8.0, 2.9, 1, 2, sharex=True, sharey=True)
    for axis, (features, title) in zip(axes[0], SEEN.items(), strict=True):
        for height, (variant, colour) in enumerate(COLOURS.items()):
            one = arms[f"{features}: {variant}"]
            scores = one["by_seed"]
            axis.plot(scores, [height] * len(scores), "o", markersize=5, markerfacecolor="white",
                      markeredgecolor=colour)  # fmt: skip
            axis.plot(one["mean"], height, "D", color=colour, markersize=7)
        name_rows(axis, list(COLOURS))
        caption(axis, title, "mean return on 400 tracks")
    told = [f"{seen}: " + ", ".join(f"{one} {arms[f'{features}: {one}']['mean']:.0f}"
            for one in COLOURS) for features, seen in SEEN.items()]  # fmt: skip
    title = "Study 1: the score of every pipeline, and the mean of each arm"
    return describe(figure, title, "Means: ", told)


def plot_learning_curves(curves: dict[str, dict]) -> Figure:
    """Validation means of study 1 minus those of `frame`, against all episodes driven.

    Args:
        curves: "FEATURES: VARIANT" -> "episodes", "mean", "low" and "high" of the difference.
    """
    variants = list(COLOURS)[1:]
    figure, axes = new_figure(8.6, 4.8, 2, len(variants), sharex=True, sharey=True)
    for row, (features, title) in zip(axes, SEEN.items(), strict=True):
        for axis, variant in zip(row, variants, strict=True):
            one, colour = curves[f"{features}: {variant}"], COLOURS[variant]
            axis.axhline(0, color="black", linewidth=0.8)
            axis.fill_between(one["episodes"], one["low"], one["high"], color=colour, alpha=0.2)
            axis.plot(one["episodes"], one["mean"], color=colour)
            caption(axis, f"{variant}, {title}")
    figure.supylabel("validation mean minus that of frame", fontsize=9)
    figure.supxlabel("episodes, those of the dataset included", fontsize=9)
    ends = [f"{seen}: " + ", ".join(f"{one} {curves[f'{features}: {one}']['mean'][-1]:+.0f}"
            for one in variants) for features, seen in SEEN.items()]  # fmt: skip
    title = "Study 1: learning curves minus that of frame, with 95% intervals of the mean"
    return describe(figure, title, "At the end: ", ends)


def plot_drivers(study3: dict) -> Figure:
    """R2 of what a single frame does not show, for all V networks of study 1, with both drivers.

    study3: "DRIVER: VARIANT" -> features -> quantity -> "mean", "interval" and "values".
    """
    panels = {
        f"{quantity}, {name} drives": representation(study3, driver)[quantity]
        for driver, name in DRIVERS.items()
        for quantity in TURNING
    }
    title = f"Study 3: the motion that {study3['networks']} V networks carry"
    figure = plot_intervals(panels, title, "R2 on unseen episodes", limits=(-0.2, 1.05))
    told = []
    for panel, rows in panels.items():
        means = [f"{row} {one['from z'][0]:z.2f}" for row, one in rows.items()]
        told.append(f"{panel}: {', '.join(means)}")
    return describe(figure, title, "Mean R2 from z. ", ["; ".join(told)])


def representation(study3: dict, driver: str) -> dict[str, dict]:
    """Quantity -> row -> "from z" or "from z and h" -> mean, interval and value of each network."""
    start, parts = f"{driver}: ", ("mean", "interval", "values")
    rows = {name.removeprefix(start): one for name, one in study3.items() if name.startswith(start)}
    return {
        quantity: {
            row: {
                f"from {SOURCES[f]}": tuple(by[quantity][part] for part in parts)
                for f, by in found.items()
            }
            for row, found in rows.items()
        }
        for quantity in next(iter(rows.values()))["z"]
    }


def plot_primary(comparisons: dict[str, dict], margin: float) -> Figure:
    """The two primary differences of study 1, for the overview: `input_output` minus `frame`.

    Args:
        comparisons, margin: as of `plot_study`.
    """
    figure, ((axis,),) = new_figure(7.6, 2.5)
    draw_margin(axis, margin)
    primary = {seen: comparisons[f"{name}: input_output"] for name, seen in SEEN.items()}
    for height, one in enumerate(primary.values()):
        plot_comparison(axis, height, one, COLOURS["input_output"])
    name_rows(axis, primary)
    axis.set_xlabel("points more or less than frame")
    legend_below(figure, axis)
    told = [f"{seen} {difference_of(one)}, {one['verdict']}" for seen, one in primary.items()]
    lead = f"Means of {len(one['by_seed'])} seeds with 95% intervals: "
    return describe(figure, "input_output minus frame", lead, ["; ".join(told)])
