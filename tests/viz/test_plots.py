"""Figures: their alternative texts hold their values, and lines differ in more than colour."""

import itertools

import numpy as np
from matplotlib.colors import to_hex

from stad_lab.viz.plots import (
    STYLES,
    VARIANT_STYLES,
    difference_colors,
    plot_curves,
    plot_histograms,
    plot_history,
    plot_intervals,
    plot_pictures,
    plot_returns,
    plot_scatter,
    plot_stacks,
)


def test_a_series_that_the_first_row_lacks_is_drawn_and_named_for_the_others():
    one = (827.0, [827.0, 827.0])
    rows = {"frame": {"the paper": one}, "input": {"the paper": one, "ours": (637.0, [600, 670])}}
    figure = plot_intervals({"": rows}, "T", "x")
    assert [text.get_text() for text in figure.legends[0].texts] == ["the paper", "ours"]
    assert any(637.0 in line.get_xdata() for line in figure.axes[0].lines)


def test_the_alternative_text_of_a_figure_holds_its_values():
    found = {
        "speed": {
            "frame": {"z": (0.12, [0.1, 0.2]), "z, h": (0.98, [0.9, 1.0])},
            "untrained": {"z": (0.05, [0, 1])},
        }
    }
    label = plot_intervals(found, "R2", "R2").get_label()
    assert label == "R2. speed frame z 0.12; speed frame z, h 0.98; speed untrained z 0.05."
    curves = {"one": np.array([3.0, 9.0, 1.5]), "two": np.zeros(3)}
    assert (
        plot_curves(curves, "T", "x", "y").get_label()
        == "T. Lines: one from 3 to 1.5, two from 0 to 0."
    )
    assert (
        "one 0.5 to 1.5" in plot_histograms({"one": np.array([0.25, 0.75])}, "T", "x").get_label()
    )


def test_neighbouring_lines_differ_in_colour_and_in_dashes():
    assert len(set(STYLES)) == len(STYLES) == 24
    assert all(
        one[0] != other[0] and one[1] != other[1] for one, other in itertools.pairwise(STYLES[:6])
    )


def test_a_variant_has_one_colour_whatever_it_is_drawn_with():
    both = {"input_output": np.zeros(2), "input": np.ones(2)}
    lines = plot_curves(both, "T", "x", "y").axes[0].lines
    assert [line.get_color() for line in lines] == [VARIANT_STYLES[name][0] for name in both]
    rows = plot_returns(both, "T").axes[0].collections
    assert [to_hex(row.get_facecolor()[0]) for row in rows] == [
        VARIANT_STYLES[name][0].lower() for name in both
    ]
    others = plot_curves({"frame": np.zeros(2), "CMA-ES": np.ones(2)}, "T", "x", "y").axes[0].lines
    assert [line.get_color() for line in others] == [color for color, _ in STYLES[:2]]


def test_every_part_of_a_stack_is_drawn():
    stacks = {"one": dict.fromkeys("abcd", 1.0), "two": dict.fromkeys("abcd", 2.0)}
    bars = plot_stacks(stacks, "T", "x").axes[0].patches
    assert [bar.get_x() + bar.get_width() for bar in bars] == [1, 2, 3, 4, 2, 4, 6, 8]


def test_a_history_is_drawn_as_two_losses_over_the_steps():
    history = [
        {"step": step, "train": {"total": 9.0 / step}, "heldout": {"total": 10.0 / step}}
        for step in (1, 2, 4)
    ]
    figure = plot_history(history, "V", "nats")
    assert figure.get_label() == "V. Lines: train from 9 to 2.25, held-out from 10 to 2.5."
    assert figure.axes[0].lines[1].get_xdata().tolist() == [1, 2, 4]


def test_only_the_named_panels_of_a_scatter_are_coloured_by_values():
    points = (np.arange(5.0), np.arange(5.0))
    panels = {"yaw rate": points, "samples": points}
    figure = plot_scatter(panels, "T", "x", "y", {"yaw rate": np.arange(5.0)})
    plain, bar = figure.axes[1], figure.axes[2]
    assert plain.collections[0].get_array() is None
    assert bar.get_ylabel() == "radians per second, to the left"
    assert figure.get_label() == "T. Panels: yaw rate (5 points), samples (5 points)."


def test_difference_images_share_one_scale_centred_at_zero():
    frame = np.zeros((4, 4, 3), np.uint8)
    weak, strong = np.full((4, 4, 3), 0.1, np.float32), np.full((4, 4, 3), -0.5, np.float32)
    figure = plot_pictures([[frame, weak], [None, strong]], ["x", "d"], ["a", "b"], "T")
    scales = [axis.images[0].norm for axis in (figure.axes[1], figure.axes[3])]
    assert scales[0] is scales[1] and (scales[0].vmin, scales[0].vmax) == (-0.5, 0.5)
    nothing = difference_colors(np.zeros((1, 3)))
    assert np.abs(nothing.astype(int) - nothing[0, 0]).max() <= 1  # a grey or white
