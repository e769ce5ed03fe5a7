"""The figure of the replication: each recipe's differences to `frame`, with a dot for each run."""

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from stad_lab.viz.plots import BLUE, GREEN, RED, new_figure

CONDITIONS = {
    "paper": "1. Paper's recipe, indicator bar cropped",
    "no_bar": "2. One iteration, indicator bar cropped",
    "two_iterations": "3. Two iterations, indicator bar visible",
    "fine_tuned": "4. As 3 with fine-tuning",
}
COLOURS = {"frame": "#555555", "input": BLUE, "output": RED, "input_output": GREEN}
PAPER_LEAD = 75  # of `input_output`, the smallest of the three that the paper reports


def plot_forest(recipes: dict[str, dict[str, dict]], best_episode: float) -> Figure:
    """For each condition and variant: the runs less the mean of `frame`, and the 95% interval.

    Args:
        recipes: condition -> variant -> "mean", "runs" and, but for `frame`, "difference" and
            "interval", in points.
        best_episode: the highest return of any episode; a mean cannot lie above it.
    """
    figure, axes = new_figure(8.0, 7.2, len(CONDITIONS))
    axes, described = axes[:, 0], []
    for axis, (condition, title) in zip(axes, CONDITIONS.items(), strict=True):
        found = recipes[condition]
        base = found["frame"]["mean"]
        axis.set_title(f"{title} (frame: {base:.0f} points)", loc="left", fontsize=10)
        plot_condition(axis, found)
        others = [f"{name} {difference_of(found[name])}" for name in COLOURS if name != "frame"]
        panel = title.replace("indicator ", "")
        described += [f"{panel}, frame {base:.0f}: " + ", ".join(others) + "."]
    ends = [end for axis in axes[1:] for end in axis.get_xlim()]
    for axis in axes[1:]:
        axis.set_xlim(min(ends), max(ends))
    for axis, condition in zip(axes, CONDITIONS, strict=True):
        shade_from(axis, best_episode - recipes[condition]["frame"]["mean"])
    axes[-1].set_xlabel("Difference of the mean return to frame, points")
    figure.legend(*axes[1].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    figure.set_label(
        "Mean return less that of frame, with 95% intervals; the paper reports"
        f" +{PAPER_LEAD}. " + " ".join(described)
    )
    return figure


def plot_condition(axis: Axes, found: dict[str, dict]) -> None:
    """One line for each variant, from the top, in one condition."""
    base = found["frame"]["mean"]
    axis.axvline(0, color="black", linewidth=0.8)
    axis.axvline(PAPER_LEAD, color="black", linestyle="--", label=f"paper: +{PAPER_LEAD}")
    for height, (variant, colour) in enumerate(COLOURS.items()):
        one = found[variant]
        if "interval" in one:
            label = "mean, 95% interval" if variant == "input" else None
            axis.plot(one["interval"], [height] * 2, color=colour, linewidth=2.5, label=label)
            axis.plot(one["difference"], height, "D", color=colour, markersize=7)
        runs = [run - base for run in one["runs"]]
        label = "one run" if variant == "frame" else None
        style = {"markerfacecolor": "white", "markeredgecolor": colour, "linestyle": "none"}
        axis.plot(runs, [height + 0.25] * len(runs), "o", markersize=5, label=label, **style)
    axis.set_yticks(range(len(COLOURS)), list(COLOURS))
    axis.set_ylim(len(COLOURS) - 0.4, -0.5)
    axis.grid(axis="x", color="#dddddd")
    axis.set_axisbelow(True)


def shade_from(axis: Axes, start: float) -> None:
    """Shade the differences that would need a mean above our best episode."""
    low, high = axis.get_xlim()
    if start < high:
        label = "above our best episode"
        axis.axvspan(start, high, color="#eeeeee", zorder=0, label=label)
    axis.set_xlim(low, high)


def difference_of(one: dict) -> str:
    """A variant's difference to `frame` with its interval, as on the pages."""
    low, high = one["interval"]
    return f"{signed(one['difference'])} ({round(low)} to {round(high)})"


def signed(number: float) -> str:
    """A rounded number with its sign, and 0 without."""
    return f"{round(number):+d}" if round(number) else "0"
