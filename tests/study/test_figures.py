"""Figures of the studies: every seed is drawn, and the alternative text holds the results."""

import itertools

import numpy as np
import pytest

from stad_lab.config import VARIANTS
from stad_lab.evaluation.trajectories import MOTION
from stad_study.figures import (
    DRIVERS,
    plot_drivers,
    plot_learning_curves,
    plot_primary,
    plot_scores,
    plot_study,
)
from stad_study.study_claims import FEATURES, MARGIN


@pytest.fixture
def comparisons():
    """Three variants with both features, of four seeds."""
    names = [f"{features}: {variant}" for features in FEATURES for variant in VARIANTS[1:]]
    return {
        name: {
            "difference": 10.0 * place,
            "interval": [10.0 * place - 8, 10.0 * place + 8],
            "by_seed": [10.0 * place + seed for seed in (-3, -1, 1, 3)],
            "verdict": "undecided",
        }
        for place, name in enumerate(names)
    }


def test_the_forest_plot_has_a_circle_for_each_pipeline_and_lines_at_the_gain_of_the_paper(
    comparisons,
):
    figure = plot_study(comparisons, MARGIN, 75.0)
    for axis, features in zip(figure.axes, ("z, h", "z"), strict=True):
        drawn = [list(line.get_xdata()) for line in axis.lines]
        for variant in VARIANTS[1:]:
            one = comparisons[f"{features}: {variant}"]
            assert one["by_seed"] in drawn and one["interval"] in drawn
        assert [75, 75] in drawn
    label = figure.get_label()
    assert "a circle for each of 4 seeds" in label
    assert "C sees z and h: input +30.0" in label
    assert "input_output +50.0 (42.0 to 58.0), undecided" in label


def test_learning_curves_have_a_band_over_the_seeds():
    curve = {"episodes": [900, 1200], "mean": [100.0, 800.0], "low": [50, 700], "high": [150, 900]}
    arms = itertools.product(FEATURES, VARIANTS[1:])
    figure = plot_learning_curves({f"{features}: {variant}": curve for features, variant in arms})
    assert len(figure.axes) == len(FEATURES) * len(VARIANTS[1:])
    for axis in figure.axes:
        assert len(axis.lines) == 1 + len(axis.collections) == 2  # one more at zero
        low = axis.collections[0].get_paths()[0].vertices
        assert [900, 50] in low.tolist() and [1200, 900] in low.tolist()
    assert "C sees z: input +800" in figure.get_label()


def test_every_pipeline_has_its_score():
    one = {"mean": 820.0, "by_seed": [800.0, 820.0, 840.0]}
    arms = {f"{features}: {variant}": one for features in FEATURES for variant in VARIANTS}
    figure = plot_scores(arms)
    for axis in figure.axes:
        circles = [line for line in axis.lines if line.get_marker() == "o"]
        assert [list(line.get_xdata()) for line in circles] == [one["by_seed"]] * 4
    assert "C sees z and h: frame 820" in figure.get_label()


def test_every_network_has_its_line_and_both_drivers_stand_below_each_other():
    one = {"mean": 0.5, "interval": [0.4, 0.6], "values": [0.4, 0.5, 0.6]}
    found = {features: dict.fromkeys(MOTION, one) for features in FEATURES}
    study3 = {f"{driver}: {name}": found for driver in DRIVERS for name in VARIANTS}
    figure = plot_drivers(study3 | {"networks": 12})
    marks = [line for line in figure.axes[1].lines if line.get_marker() == "|"]
    assert len(marks) == 2 * 4 and all(np.size(line.get_xdata()) == 3 for line in marks)
    titles = [axis.get_title() for axis in figure.axes]
    assert titles[1] == "yaw rate, an agent drives"
    assert titles[4] == "yaw rate, the random driver drives"


def test_the_overviews_figure_has_the_two_primary_differences_and_no_other(comparisons):
    figure = plot_primary(comparisons, MARGIN)
    drawn = [list(line.get_xdata()) for line in figure.axes[0].lines]
    for name, one in comparisons.items():
        assert (one["interval"] in drawn) == name.endswith(": input_output")
    assert figure.get_label().count("undecided") == 2 and "Means of 4 seeds" in figure.get_label()
