"""Figures: what they show is in their alternative texts, and no colour has to tell alone."""

import itertools

import numpy as np

from stad_lab.envs.car_racing import TRACK_WIDTH
from stad_lab.viz.plots import (
    STYLES,
    plot_bars,
    plot_claims,
    plot_curves,
    plot_intervals,
    plot_mixture,
    plot_road,
    plot_shares,
    plot_stacks,
)


def test_what_the_first_variant_lacks_is_drawn_for_the_others():
    paper, ours = (827.0, [827.0, 827.0], []), (637.0, [600.0, 670.0], [637.0])
    figure = plot_claims(
        {"frame": {"the paper": paper}, "input": {"the paper": paper, "ours": ours}}
    )
    assert [text.get_text() for text in figure.legends[0].texts] == ["the paper", "ours"]
    assert any(637.0 in line.get_xdata() for line in figure.axes[0].lines)


def test_the_alternative_text_of_a_figure_tells_its_values():
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
    assert "one from 9 to 1.5" in plot_bars(curves, "T", "x", "y").get_label()
    assert "one 0.5 to 1.5" in plot_shares({"one": np.array([0.25, 0.75])}, "T", "x").get_label()


def test_lines_beside_each_other_differ_in_colour_and_in_their_dashes():
    assert len(set(STYLES)) == len(STYLES) == 24
    assert all(
        one[0] != other[0] and one[1] != other[1] for one, other in itertools.pairwise(STYLES[:6])
    )


def test_the_density_of_a_mixture_holds_one_and_widens_with_the_temperature():
    figure = plot_mixture(np.log([0.7, 0.3]), np.array([-1.0, 2.0]), np.log([0.5, 1.0]), [1.0, 4.0])
    widths = []
    for line in figure.axes[0].lines:
        z, density = line.get_data()
        assert abs(np.trapezoid(density, z) - 1) < 0.01
        middle = np.trapezoid(z * density, z)
        widths.append(np.trapezoid((z - middle) ** 2 * density, z))
    weights = (
        np.array([0.7, 0.3]) ** 0.25 / (np.array([0.7, 0.3]) ** 0.25).sum()
    )  # as sample_mixture has it
    spread = weights @ np.array([-1.0, 2.0]) ** 2 - (weights @ np.array([-1.0, 2.0])) ** 2
    assert np.allclose(
        widths, [0.7 * 0.25 + 0.3 + 9 * 0.21, weights @ [1.0, 4.0] + spread], rtol=0.02
    )


def test_every_part_of_a_stack_is_drawn():
    stacks = {"one": dict.fromkeys("abcd", 1.0), "two": dict.fromkeys("abcd", 2.0)}
    bars = plot_stacks(stacks, "T", "x").axes[0].patches
    assert [bar.get_x() + bar.get_width() for bar in bars] == [1, 2, 3, 4, 2, 4, 6, 8]


def test_a_road_is_as_wide_as_it_is_and_is_shown_around_its_tile():
    angle = np.linspace(0, 2 * np.pi, 200, endpoint=False)
    road = 100 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    figure = plot_road(
        road, {"one": road[:50] * 1.01, "two": road[:80]}, "A ring", center=50, reach=30
    )
    ring, whole = figure.axes[0].patches[0].get_xy(), figure.axes[0].lines
    radii = np.linalg.norm(ring, axis=1)
    assert np.isclose(radii.min(), 100 - TRACK_WIDTH) and np.isclose(radii.max(), 100 + TRACK_WIDTH)
    assert np.allclose(whole[0].get_xydata(), road[:50] * 1.01)
    assert np.allclose(
        [figure.axes[1].get_xlim(), figure.axes[1].get_ylim()], [[-30, 30], [70, 130]]
    )
    assert "200 tiles" in figure.get_label() and "one, two" in figure.get_label()
