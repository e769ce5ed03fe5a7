"""Drives seen from above."""

import numpy as np
import pytest

from stad_lab.agent import drive, load_agent
from stad_lab.evaluation.paths import drive_from_above
from stad_lab.training.evolution import make_agent
from stad_lab.viz.plots import plot_learning, plot_maps


def test_paths_begin_on_the_road_and_scores_are_those_of_a_drive():
    agent = load_agent("cropped_input")
    controllers = np.stack([agent.parameters, np.zeros_like(agent.parameters)])
    found = drive_from_above(agent.world_model, controllers, [7, 7], max_frames=60)
    again = drive(make_agent(agent.world_model, controllers), [7, 7], max_frames=60)
    assert np.array_equal(found.returns, again.returns)
    assert [len(path) for path in found.paths] == again.lengths.tolist()
    for path, road in zip(found.paths, found.roads, strict=True):
        assert np.hypot(*(road - path[0]).T).min() < 5
    entry = {"road": found.roads[0], "paths": found.paths, "returns": found.returns}
    assert f"{found.returns.mean():.0f} at last" in plot_learning([entry], 3, "T").get_label()
    assert f"{found.returns.max():.0f}" in plot_maps({"a": tuple(entry.values())}, "T").get_label()


def test_each_controller_needs_its_track():
    agent = load_agent("cropped_input")
    with pytest.raises(ValueError, match="1 controllers on 2 tracks"):
        drive_from_above(agent.world_model, agent.parameters[None], [7, 8])
