"""What the game draws over the driver's picture, as SVG of 480 x 480 units.

Below, where the observation has its indicator bar: speed, score, time and the agent's lead. At the
top right a map. On the road the agent's own lap as a ghost. After an episode, its end card.
"""

from collections.abc import Callable, Iterable
from html import escape

import numpy as np

from stad_course.play.race import Ghost
from stad_course.play.session import Session, pose_of
from stad_lab.envs import physics, picture
from stad_lab.envs.frames import OBSERVATION_SIZE
from stad_lab.envs.track import TRACK_WIDTH
from stad_lab.evaluation.trajectories import FRAMES_A_SECOND
from stad_lab.viz.plots import BLUE, ORANGE, PURPLE

SIZE, STRIP = 480, 60  # of the whole, and the height of the dashboard at its bottom
MAP_SIZE, MAP_CORNER = 120, (352.0, 8.0)
TOP_SPEED = 110.0  # world units per second, the end of the speedometer
ENDINGS = {physics.LAP_FINISHED: "Lap complete", physics.LEFT_FIELD: "Lost in the field"}
RULES = "Blue is its car, which nothing can hit."
CAR = np.array([[-1.2, -2.4], [1.2, -2.4], [1.2, 1.4], [0.5, 2.6], [-0.5, 2.6], [-1.2, 1.4]])


def to_screen(points: np.ndarray, pose: tuple[float, float, float], time: float) -> np.ndarray:
    """World units (n, 2) -> where a car's camera shows them, SVG units (n, 2).

    Args:
        pose: position and heading of the car, which stands in the middle of the lower half.
        time: seconds since the start; the camera zooms in during the first.
    """
    x, y, angle = pose
    moved, zoom = points - (x, y), picture.camera_zoom(time) * SIZE / OBSERVATION_SIZE
    across = moved @ (np.cos(angle), np.sin(angle))
    along = moved @ (-np.sin(angle), np.cos(angle))
    across, along = across * zoom / picture.PIXEL_W, along * zoom / picture.PIXEL_H
    return np.stack([SIZE / 2 + across, SIZE * 3 / 4 - along], axis=1)


def on_map(road: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """A function from world units (n, 2) to places on the map of a road, SVG units (n, 2)."""
    low, high = road.min(axis=0) - TRACK_WIDTH, road.max(axis=0) + TRACK_WIDTH
    scale = (MAP_SIZE - 12) / (high - low).max()
    middle = np.array(MAP_CORNER) + MAP_SIZE / 2
    return lambda points: middle + (points - (low + high) / 2) * scale * (1, -1)


def joined(points: np.ndarray) -> str:
    """Points (n, 2) as SVG lists them."""
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in points)


def svg(*parts: str) -> str:
    """A layer over the picture, which hides from screen readers: the status says the same."""
    size = f'viewBox="0 0 {SIZE} {SIZE}" width="{SIZE}" height="{SIZE}"'
    style = "display: block; font-family: Helvetica, Arial, sans-serif"
    return f'<svg {size} style="{style}" aria-hidden="true">{"".join(parts)}</svg>'


def label(x: float, y: float, content: str, size: float = 12, more: str = "fill='#bbb'") -> str:
    """A line of text."""
    return f'<text x="{x}" y="{y}" font-size="{size}" {more}>{escape(content)}</text>'


def draw_background(road: np.ndarray) -> str:
    """What does not move: the dashboard's ground, and the map with its start line."""
    x, y = MAP_CORNER
    strip = f'<rect y="{SIZE - STRIP}" width="{SIZE}" height="{STRIP}" fill="#111"/>'
    box = f'<rect x="{x}" y="{y}" width="{MAP_SIZE}" height="{MAP_SIZE}" rx="8"'
    box += ' fill="#fff" fill-opacity="0.85"/>'
    places = on_map(road)(road)
    lap = f'<polygon points="{joined(places)}" fill="none" stroke="#555" stroke-width="4"/>'
    a, b = places[0]
    start = f'<circle cx="{a:.1f}" cy="{b:.1f}" r="4" fill="#fff" stroke="#111"/>'
    return svg(strip, box, lap, start)


def draw_moment(session: Session, ghost: Ghost) -> str:
    """What moves: speedometer, numbers, the places on the map, the ghost, and the end card."""
    if session.world == "dream":
        seconds = f"{len(session.dream_rows) / FRAMES_A_SECOND:.2f}"
        numbers = [("seconds dreamed", seconds), ("points in the dream", "none")]
        return svg(draw_numbers(numbers, (20, 180), PURPLE))
    car, frames = session.car, len(session.rows)
    there = ghost.poses[min(frames, len(ghost.poses) - 1)]
    parts = [draw_ghost(there, car), draw_places(session, there)]
    parts += [draw_speed(float(np.hypot(*car["velocity"][0, :2])))]
    parts += [draw_numbers(race_numbers(session, ghost), (122, 198, 284, 396), "#fff")]
    if session.real_ended:
        parts.append(draw_card(*end_lines(session, ghost), "R: once more"))
    elif not frames:
        parts.append(draw_card("Beat the agent", "Click here, then hold the up arrow.", RULES))
    return svg(*parts)


def race_numbers(session: Session, ghost: Ghost) -> list[tuple[str, str]]:
    """Score, time, the agent's lead in seconds, and the human's best: [(name, value), ...]."""
    frames, best = len(session.rows), session.best.get(session.track)
    lead = ghost.behind(int(session.car["tiles_visited"]), frames)
    return [
        ("points", f"{session.score:.0f}"),
        ("seconds", f"{frames / FRAMES_A_SECOND:.2f}"),
        ("agent ahead by" if lead >= 0 else "you lead by", f"{abs(lead):.1f} s"),
        ("your best", "-" if best is None else f"{best:.0f}"),
    ]


def draw_numbers(numbers: Iterable[tuple[str, str]], columns: tuple[int, ...], color: str) -> str:
    """Names and values on the dashboard, side by side from these places on."""
    parts = []
    for (name, value), x in zip(numbers, columns, strict=True):
        parts.append(label(x, SIZE - 40, name))
        parts.append(label(x, SIZE - 14, value, 22, f'fill="{color}" font-weight="bold"'))
    return "".join(parts)


def draw_speed(speed: float) -> str:
    """A speedometer: half a circle, filled as far as the car is fast; world units per second."""
    x, y, r = 62, SIZE - 10, 40
    share = min(speed / TOP_SPEED, 1.0)
    arc = f'<path d="M{x - r} {y}A{r} {r} 0 0 1 {x + r} {y}" fill="none" stroke-width="8"'
    length = np.pi * r
    full = f'{arc} stroke="#444"/>'
    part = f'{arc} stroke="{ORANGE}" stroke-dasharray="{share * length:.1f} {2 * length:.0f}"/>'
    middle = 'fill="#fff" font-weight="bold" text-anchor="middle"'
    return full + part + label(x, y, f"{speed:.0f}", 22, middle)


def draw_ghost(there: np.ndarray, car: np.ndarray) -> str:
    """The agent's car where the human's camera sees it."""
    x, y, angle = there
    turned = CAR @ [[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]
    corners = to_screen(turned + np.array([x, y]), pose_of(car), float(car["time"]))
    style = f'fill="{BLUE}" fill-opacity="0.45" stroke="{BLUE}" stroke-width="2"'
    above = f'<svg width="{SIZE}" height="{SIZE - STRIP}">'  # which cuts it off at the dashboard
    return f'{above}<polygon points="{joined(corners)}" {style}/></svg>'


def draw_places(session: Session, ghost: np.ndarray) -> str:
    """Both cars on the map, the human's above."""
    places = on_map(session.road)(np.array([ghost[:2], pose_of(session.car)[:2]]))
    circles = zip(places, (BLUE, ORANGE), strict=True)
    mark = '<circle cx="{:.1f}" cy="{:.1f}" r="5" fill="{}" stroke="#111"/>'
    return "".join(mark.format(x, y, color) for (x, y), color in circles)


def draw_card(title: str, *lines: str) -> str:
    """A card in the middle of the picture; its last line is in orange."""
    height = 60 + 26 * len(lines)
    top = (SIZE - STRIP - height) / 2
    card = f'<rect x="60" y="{top}" width="360" height="{height}" rx="12" fill="#111"'
    parts = [f'{card} stroke="{ORANGE}" stroke-width="3" fill-opacity="0.9"/>']
    middle = 'text-anchor="middle" fill="{}"'
    parts.append(label(240, top + 38, title, 26, middle.format("#fff") + ' font-weight="bold"'))
    for row, line in enumerate(lines):
        color = ORANGE if line == lines[-1] else "#fff"
        parts.append(label(240, top + 68 + 26 * row, line, 16, middle.format(color)))
    return "".join(parts)


def end_lines(session: Session, ghost: Ghost) -> list[str]:
    """How an episode ended, both scores, and what it means for the best so far."""
    seconds, agent = len(session.rows) / FRAMES_A_SECOND, len(ghost.poses) / FRAMES_A_SECOND
    title = ENDINGS.get(int(session.car["ending"]), "Time is up")
    lines = [title, f"{session.score:.0f} points in {seconds:.1f} seconds"]
    lines.append(f"the agent: {ghost.score:.0f} points in {agent:.1f} seconds")
    if not session.by_hand().all():
        return [*lines, "The agent helped: this does not count."]
    won = session.score > ghost.score
    best = session.best.get(session.track, session.score)
    return [*lines, f"your best here: {best:.0f}", "You beat the agent!" if won else "Not yet."]
