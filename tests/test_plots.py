"""Figures: what they show is in their alternative texts, and no colour has to tell alone."""

import itertools

import numpy as np

from stad_lab.plots import STYLES, plot_bars, plot_curves, plot_intervals, plot_shares


def test_the_alternative_text_of_a_figure_tells_its_values():
    found = {
        "speed": {"frame": {"z": (0.12, [0.1, 0.2]), "z, h": (0.98, [0.9, 1.0])}, "untrained": {"z": (0.05, [0, 1])}}
    }
    label = plot_intervals(found, "R2", "R2").get_label()
    assert label == "R2. speed frame z 0.12; speed frame z, h 0.98; speed untrained z 0.05."
    curves = {"one": np.array([3.0, 9.0, 1.5]), "two": np.zeros(3)}
    assert plot_curves(curves, "T", "x", "y").get_label() == "T. Lines: one from 3 to 1.5, two from 0 to 0."
    assert "one from 9 to 1.5" in plot_bars(curves, "T", "x", "y").get_label()
    assert "one 0.5 to 1.5" in plot_shares({"one": np.array([0.25, 0.75])}, "T", "x").get_label()


def test_lines_beside_each_other_differ_in_colour_and_in_their_dashes():
    assert len(set(STYLES)) == len(STYLES) == 24
    assert all(one[0] != other[0] and one[1] != other[1] for one, other in itertools.pairwise(STYLES[:6]))
