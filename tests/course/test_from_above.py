"""Drives seen from above."""

import numpy as np
import pytest

from stad_course import from_above
from stad_course.from_above import plot_learning, plot_maps, plot_road
from stad_lab.agent import drive, load_agent
from stad_lab.envs.cars import Cars
from stad_lab.envs.track import TRACK_WIDTH
from stad_lab.training.evolution import make_agent


def test_paths_begin_on_the_road_and_scores_are_those_of_a_drive():
    agent = load_agent("cropped_input")
    controllers = np.stack([agent.parameters, np.zeros_like(agent.parameters)])
    found = from_above.drive(agent.world_model, controllers, [7, 7], max_frames=60)
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
        from_above.drive(agent.world_model, agent.parameters[None], [7, 8])


def test_a_road_has_its_true_width_and_is_enlarged_around_its_tile():
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


def test_the_sharpest_bends_are_where_the_road_turns_most():
    degrees, begins = from_above.sharpest_bends([3, 4])
    cars = Cars(1)
    cars.reset([4])
    heading = np.degrees(np.unwrap(cars.tracks[0].path[:, 1]))
    turned = heading[20:] - heading[:-20]
    assert turned[begins[1]] == pytest.approx([turned.max(), turned.min()])
    assert degrees[1] == pytest.approx([turned.max(), -turned.min()])
    assert (degrees[:, 0] > degrees[:, 1]).all()  # laps run anticlockwise


def test_a_watched_episode_has_a_position_for_every_frame():
    agent = load_agent("cropped_input")
    one = from_above.watch(agent, 3)
    assert len(one.path) == len(one.trajectory) == len(one.trajectory.motion)
    moved = np.linalg.norm(np.diff(one.path, axis=0), axis=1)
    speed = np.linalg.norm(one.trajectory.motion[:, :2], axis=1)
    assert np.corrcoef(moved, speed[1:])[0, 1] > 0.95
