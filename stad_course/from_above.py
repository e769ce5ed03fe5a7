"""Episodes seen from above: where each car of a batch went, what it scored, and figures of it."""

from collections.abc import Iterable
from itertools import chain
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from stad_lab.agent import Agent, rollout
from stad_lab.envs.cars import Cars
from stad_lab.envs.track import TRACK_WIDTH
from stad_lab.evaluation.statistics import SOLVED
from stad_lab.evaluation.trajectories import Recorder, Trajectory
from stad_lab.io.weights import WorldModel
from stad_lab.io.workers import run_in_order, single_thread, worker_threads
from stad_lab.training.evolution import make_agent
from stad_lab.viz.plots import (
    BLUE,
    ORANGE,
    THIN,
    caption,
    describe,
    legend_below,
    new_figure,
    styles_of,
)

THREADS = 2  # that share the cars; the results do not depend on it
BEND = 20  # tiles


class Driven(NamedTuple):
    """One episode of each of n controllers."""

    returns: np.ndarray  # float64 (n,)
    paths: list[np.ndarray]  # position in every frame, world units (T, 2), for each
    roads: list[np.ndarray]  # centres of the track's tiles, world units (tiles, 2), for each


def drive(
    world_model: WorldModel,
    controllers: np.ndarray,
    tracks: list[int],
    max_frames: int = 1000,
    patience: int = 0,
) -> Driven:
    """Drive each controller, float64 (n, parameters), on its track with our engine.

    Args:
        tracks: n seeds.
        max_frames, patience: of `rollout`.

    Raises:
        ValueError: not as many tracks as controllers, or none.
    """
    if not 0 < len(controllers) == len(tracks):
        raise ValueError(f"{len(controllers)} controllers on {len(tracks)} tracks: expected pairs")
    groups = np.array_split(np.arange(len(tracks)), min(THREADS, len(tracks)))
    limits = max_frames, patience
    tasks = [(world_model, controllers[own], [tracks[i] for i in own], *limits) for own in groups]
    with worker_threads(len(groups)) as executor:
        returns, paths, roads = zip(*run_in_order(executor, drive_batch, tasks), strict=True)
    return Driven(np.concatenate(returns), [*chain(*paths)], [*chain(*roads)])


def drive_batch(
    world_model: WorldModel,
    controllers: np.ndarray,
    tracks: list[int],
    max_frames: int,
    patience: int,
) -> Driven:
    """Drive a batch of cars on one thread."""
    single_thread()
    cars = Cars(len(tracks), "frame", bar=not world_model.crop_bar)
    paths: list[list] = [[] for _ in tracks]
    cars.reset(tracks)

    def note(driving: np.ndarray, _: np.ndarray, __: np.ndarray) -> None:
        for car in driving:
            paths[car].append(cars.cars["position"][car, 0].copy())

    agent = make_agent(world_model, controllers)
    episodes = rollout(agent, cars, max_frames, patience, observe=note)
    roads = [track.path[:, 2:] for track in cars.tracks]
    return Driven(episodes.returns, [np.array(path) for path in paths], roads)


class Watched(NamedTuple):
    """One episode of an agent, with where it went."""

    trajectory: Trajectory
    path: np.ndarray  # position in every frame, world units (T, 2)
    road: np.ndarray  # centres of the track's tiles, world units (tiles, 2)


def watch(agent: Agent, track: int) -> Watched:
    """Let an agent drive an episode of at most 1,000 frames, and note where it is."""
    cars, path = Cars(1), []
    cars.reset([track])
    recorder = Recorder(cars)

    def note(which: np.ndarray, seen: np.ndarray, actions: np.ndarray) -> None:
        recorder(which, seen, actions)
        path.append(cars.cars["position"][0, 0].astype(float))

    episodes = rollout(agent, cars, max_frames=1000, observe=note)
    road = cars.tracks[0].path[:, 2:]
    return Watched(recorder.trajectory(episodes.rewards[0]), np.array(path), road)


def sharpest_bends(tracks: Iterable[int]) -> tuple[np.ndarray, np.ndarray]:
    """The sharpest bend of each track over BEND tiles, to the left and to the right.

    A bend across the start line is not seen.

    Returns:
        How far it turns, degrees, float64 (tracks, 2), and the tile where it begins, int64
        (tracks, 2).
    """
    cars, degrees, begins = Cars(1), [], []
    for track in tracks:
        cars.reset([track])
        heading = np.unwrap(cars.tracks[0].path[:, 1])
        turned = heading[BEND:] - heading[:-BEND]  # radians to the left
        degrees.append(np.degrees([turned.max(), -turned.min()]))
        begins.append([turned.argmax(), turned.argmin()])
    return np.array(degrees), np.array(begins)


# Figures

ARROWS = 120  # frames between the arrows of a path


def plot_paths(
    road: np.ndarray, paths: dict[str, tuple[np.ndarray, np.ndarray]], title: str
) -> Figure:
    """Driven paths on the road, from above, one panel each.

    Args:
        road: centres of its tiles, world units (tiles, 2).
        paths: name -> (where the car was, world units (T, 2); whether the human drove, bool (T,)).
    """
    figure, axes = new_figure(max(3.4 * len(paths), 5.0), 3.9, 1, len(paths))
    points = np.concatenate([own for own, _ in paths.values()])
    low, high = points.min(axis=0), points.max(axis=0)
    middle, reach = (low + high) / 2, (high - low).max() / 2 + 2 * TRACK_WIDTH
    for axis, (name, (points, by_hand)) in zip(axes[0], paths.items(), strict=True):
        fill_road(axis, road, color="0.85")
        drivers = ("agent", ~by_hand, BLUE, 4), ("by hand", by_hand, ORANGE, 12)
        for driver, shown, color, size in drivers:
            if shown.any():
                axis.scatter(*points[shown].T, label=driver, color=color, s=size)
        axis.plot(*points[0], "^", color="black", ms=7, label="start")
        axis.plot(*points[-1], "x", color="black", ms=7, label="end")
        caption(axis, name, "world units")
        (x, y), far = middle, np.array([-reach, reach])
        axis.set(xlim=x + far, ylim=y + far, aspect="equal")
        axis.legend(frameon=False, fontsize=8)
    axes[0, 0].set_ylabel("world units")
    ends = [f"{name}: {len(own)} frames, {own.sum()} by hand" for name, (_, own) in paths.items()]
    return describe(figure, title, "The car's path on the road, from above. ", ends)


def plot_road(
    road: np.ndarray, paths: dict[str, np.ndarray], title: str, center: int, reach: float
) -> Figure:
    """A lap from above and a part of it enlarged, with the paths of cars.

    Args:
        road: centres of its tiles, world units (tiles, 2).
        paths: name -> position of a car in every frame, world units (T, 2).
        center: the tile around which the second panel is drawn.
        reach: how far that panel extends to each side, world units.
    """
    figure, axes = new_figure(8.6, 4.3, 1, 2)
    for axis in axes[0]:
        fill_road(axis, road, color="0.85", label="road")
        for (name, path), (color, dash) in zip(paths.items(), styles_of(paths), strict=False):
            axis.plot(*path.T, dash, color=color, lw=1.6, label=name)
            axis.plot(*path[-1], "x", color=color, ms=10, mew=2.5, zorder=5)
            for tail, head in zip(path[:-5:ARROWS], path[5::ARROWS], strict=False):
                arrow = {"arrowstyle": "-|>", "color": color}
                axis.annotate("", head, tail, arrowprops=arrow, annotation_clip=True)
        axis.plot(*road[0], "^", color="black", ms=7)
        axis.set(xlabel="world units", aspect="equal")
    axes[0, 0].set(ylabel="world units", title="the lap (triangle: start, x: end)")
    (x, y), far = road[center], np.array([-reach, reach])
    enlarged = Rectangle((x - reach, y - reach), 2 * reach, 2 * reach, fill=False, ls=":")
    axes[0, 0].add_patch(enlarged)
    axes[0, 1].set(xlim=x + far, ylim=y + far, title=f"around tile {center}")
    axes[0, 1].legend(fontsize=8)
    lead = f"A lap of {len(road)} tiles from above, and enlarged around tile {center}: "
    return describe(figure, title, f"{lead}the paths of ", paths)


def plot_maps(maps: dict[str, tuple], title: str) -> Figure:
    """Laps from above: name -> (road (tiles, 2), paths of cars (T, 2) each, returns (cars,))."""
    rows = -(-len(maps) // 5)
    columns = -(-len(maps) // rows)
    figure, axes = new_figure(min(2.6 * columns, 10.5) + 0.2, 2.9 * rows + 0.4, rows, columns)
    for axis, (name, (road, paths, returns)) in zip(axes.flat, maps.items(), strict=False):
        draw_map(axis, road, paths, returns)
        caption(axis, f"{name}: best {returns.max():.0f}" if len(returns) > 1 else name)
    for axis in axes.flat[len(maps) :]:
        axis.set_visible(False)
    bests = [f"{name}, best return {own[2].max():.0f}" for name, own in maps.items()]
    return describe(figure, title, "Laps from above (triangle: start, dot: end). ", bests)


def plot_learning(generations: list[dict], total: int, title: str) -> Figure:
    """The last generation on its map, beside the returns of all so far.

    Args:
        generations: each {"road", "paths", "returns"} as `plot_maps` takes them.
        total: generations of the whole run, the width of the axis.
    """
    figure, axes = new_figure(9.4, 4.2, 1, 2, width_ratios=[1, 1.25])
    last, number = generations[-1], np.arange(1, len(generations) + 1)
    draw_map(axes[0, 0], last["road"], last["paths"], last["returns"])
    caption(axes[0, 0], f"generation {len(generations)}: all candidates (orange: the best)")
    axis = axes[0, 1]
    returns = np.array([own["returns"] for own in generations])
    axis.plot(number, returns, ".", color=BLUE, ms=3, alpha=0.5)
    axis.plot(number, returns.max(axis=1), color=ORANGE, lw=1.6, label="best candidate")
    axis.plot(number, returns.mean(axis=1), color=BLUE, lw=2.2, label="average candidate")
    axis.axhline(SOLVED, **THIN, label=f"{SOLVED} points")
    axis.set(xlabel="generation", ylabel="return of an episode", xlim=(0.5, total + 0.5))
    axis.set_ylim(min(-20, returns.min() - 20), 960)
    legend_below(figure, axis)
    means = f"average return {returns[0].mean():.0f} at first, {returns[-1].mean():.0f} at last"
    return describe(figure, title, f"{len(generations)} generations: {means}")


def draw_map(axis: Axes, road: np.ndarray, paths: list[np.ndarray], returns: np.ndarray) -> None:
    """A lap from above with the path of each car: the best in ORANGE, the others in BLUE."""
    fill_road(axis, road, color="0.87")
    best = int(np.argmax(returns))
    for place, path in enumerate(paths):
        if place != best:
            axis.plot(*path.T, color=BLUE, lw=1.0, alpha=0.6)
            axis.plot(*path[-1], ".", color=BLUE, ms=5)
    axis.plot(*paths[best].T, color=ORANGE, lw=2.2)
    axis.plot(*paths[best][-1], ".", color=ORANGE, ms=9)
    axis.plot(*road[0], "^", color="black", ms=7)
    low, high = road.min(axis=0) - 35, road.max(axis=0) + 35  # a car may end far in the grass
    axis.set(xticks=[], yticks=[], aspect="equal", xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    axis.spines[:].set_visible(False)


def fill_road(axis: Axes, road: np.ndarray, **style) -> None:
    """Fill a lap from above; `road` has the centres of its tiles, world units (tiles, 2)."""
    along = np.roll(road, -1, axis=0) - np.roll(road, 1, axis=0)
    across = TRACK_WIDTH * along[:, ::-1] * (-1, 1) / np.linalg.norm(along, axis=1, keepdims=True)
    left, right = (np.concatenate([edge, edge[:1]]) for edge in (road + across, road - across))
    axis.fill(*np.concatenate([left, right[::-1]]).T, **style)
