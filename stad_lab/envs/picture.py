"""Pictures of CarRacing: a texture of the track, one affine warp, then the car and the bar.

For every observation Gymnasium transforms some 800 polygons, draws those near a window of 1000 x
800 pixels and shrinks it to 96 x 96. But the ground hardly changes within an episode, and the
camera is fixed to the car. So we paint the ground once per episode into a texture; a picture then
takes three steps:

1. **Warp.** The camera's rotation, zoom and position make one affine map from the pixels of the
   picture to the texture (*inverse mapping*: for every pixel we ask which point of the ground it
   shows). The map is linear, so walking one pixel to the right is always the same step on the
   texture: two additions. Where that point lies inside an area of one colour, this colour is the
   answer. Only near an edge do we interpolate between the four nearest texels (texture pixels);
   this is *bilinear interpolation*.
2. **Car.** It never moves in the picture; only its wheels do. Four small pictures with a wheel
   each are blended over the ground.
3. **Indicator bar.** The score is copied from a table; each indicator is one rectangle.

The texture stores no colours but *kinds* of ground (background, grass, road, ...), one byte each,
as in a picture with a palette. Two bits of the byte say whether an edge is near, so that one read
tells whether interpolation is needed. In the opening zoom a pixel covers many texels. To average
them all would be slow, so there are copies of the texture at 1/4, 1/8 and 1/16 of its size, in
colour (*mip levels*), and a picture uses the copy with about two texels per pixel.

`draw_picture` makes the observation, uint8 (96, 96, 3), or the agent's frame, uint8 (64, 64, 3),
straight from the texture. All drawing is compiled by Numba and releases the GIL. Images are
indexed [row, column]; the texture's rows follow the world's y axis upward, its columns the x axis.

To keep compilation short, the code avoids what makes Numba compile a function twice (integer
literals as arguments, arrays of different layouts) and array expressions where a loop does.
"""

import functools
import math
import os
import threading
from typing import NamedTuple

os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")  # pygame prints a greeting on import

import numpy as np
import pygame
from gymnasium.envs.box2d import car_dynamics
from gymnasium.envs.box2d import car_racing as reference

from stad_lab.envs.compiling import compiled
from stad_lab.envs.frames import BAR_TOP, OBSERVATION_SIZE

fast = compiled(error_model="numpy")
merged = compiled(error_model="numpy", inline="always")  # into its one caller

# The pictures, and Gymnasium's window, whose coordinates we share.
BAR_ROWS = OBSERVATION_SIZE - BAR_TOP  # of the observation
WINDOW_W, WINDOW_H = float(reference.WINDOW_W), float(reference.WINDOW_H)  # window pixels
PIXEL_W, PIXEL_H = WINDOW_W / OBSERVATION_SIZE, WINDOW_H / OBSERVATION_SIZE  # of the observation
ZOOM = reference.ZOOM * reference.SCALE  # window pixels per world unit, after the first second
DARKENING = 2  # pygame's smoothscale loses two levels of every channel to its fixed-point sums

# The texture.
FIELD = 1920  # texels, width and height of the field: 1.9 to a pixel of the observation
CELL = 16  # texels: the texture is restored and shrunk in cells of this size
RIM = CELL  # texels of black around the field
SIZE = FIELD + 2 * RIM  # texels, width and height of the texture
SCALE = FIELD / (2 * reference.PLAYFIELD)  # texels per world unit
ORIGIN = SIZE / 2  # x and y of the world's origin, texels
PERIOD = FIELD // 20  # texels from one grass square to the next
CELLS = SIZE // CELL
HAS_ROAD, CHANGED = 1, 2  # flags of a cell
SHARP = 2.6  # a pixel that covers more texels than this (in x) needs more samples or a smaller copy

# A texel: the kind of ground in bits 2 to 4, the shade of the road in bits 0 and 1, and the flags.
# The shades differ by 5 levels of 255 at most, so they count as one kind when we look for edges.
BACKGROUND, GRASS, ROAD, WHITE, RED, OUTSIDE = 0, 4, 8, 12, 16, 20
ROAD_SHADES = 3
KIND, KIND_AND_SHADE = 0b11100, 0b11111
EDGE = 0x80  # the 2 x 2 texels from here to the right and up are of more than one kind
NEAR = 0x40  # the 4 x 4 texels around those are
TEXELS = (BACKGROUND, GRASS, ROAD, ROAD + 1, ROAD + 2, WHITE, RED, OUTSIDE)  # without flags

# A colour in 16-bit lanes of one 64-bit number: one multiplication weighs all three channels.
LANES = np.uint64(0x00FF00FF00FF)
HALVES = np.uint64(0x7FFF7FFF7FFF)  # the lanes of 256 times a colour that has been halved
ROUND = np.uint64(0x008000800080)  # rounds 256 times a colour to the nearest level
FRACTION = 16  # positions on the texture are fixed-point numbers with so many binary digits
ONE = 1 << FRACTION
BLOCK = 8  # pixels that are searched for flags at a time

# The car. The hull's origin lies at a corner between four pixels of the observation.
HULL_ROW, HULL_COLUMN = 72, 48
QUARTER_ROWS, QUARTER_COLUMNS = 6, 4  # pixels, size of a quarter of the car
CANVAS_ROWS = math.ceil(QUARTER_ROWS * PIXEL_H)  # of the window, in which a quarter is drawn
CANVAS_COLUMNS = math.ceil(QUARTER_COLUMNS * PIXEL_W)
TURN_STEPS, MAX_TURN = 24, 12  # a wheel's angle to the hull: steps of 1/24 rad, at most 12 of them
LARGEST_TURN = MAX_TURN / TURN_STEPS  # radians
PHASE_STEPS = 32  # a wheel's rotation: steps of 2 pi / 32
CORNERS = 8  # of a polygon of the car; those with fewer corners repeat the last
HULL_POLYGONS = [
    polygon + polygon[-1:] * (CORNERS - len(polygon))
    for polygon in (
        car_dynamics.HULL_POLY1,
        car_dynamics.HULL_POLY2,
        car_dynamics.HULL_POLY3,
        car_dynamics.HULL_POLY4,
    )
]
HULL_POLYGONS = np.array(HULL_POLYGONS) * car_dynamics.SIZE  # (4, CORNERS, 2), world units
WHEEL_PLACES = np.array(car_dynamics.WHEELPOS) * car_dynamics.SIZE  # world units
WHEEL_HALF_WIDTH = car_dynamics.WHEEL_W * car_dynamics.SIZE
WHEEL_RADIUS = car_dynamics.WHEEL_R * car_dynamics.SIZE
TYRE, STRIPE, HULL = 1, 2, 3
SHAPE_RED = np.array([0.0, 0.0, 75.0, 202.0])  # darkened, of nothing, tyre, stripe and hull
SHAPE_GREEN = np.array([0.0, 0.0, 75.0, 0.0])  # and blue
TINY = 1e-6

# The agent's frame is made from exact observation pixels in this area around the car.
CAR_TOP, CAR_BOTTOM = HULL_ROW - QUARTER_ROWS, HULL_ROW + QUARTER_ROWS
CAR_LEFT, CAR_RIGHT = HULL_COLUMN - QUARTER_COLUMNS, HULL_COLUMN + QUARTER_COLUMNS
PATCH_TOP, PATCH_LEFT = CAR_TOP - 1, CAR_LEFT - 1
PATCH_ROWS, PATCH_COLUMNS = 2 * QUARTER_ROWS + 2, 2 * QUARTER_COLUMNS + 2

# The score in the indicator bar.
SCORE_COLUMNS = 12  # pixels of the observation that the score may cover
MIN_SCORE, MAX_SCORE = -999, 1000
MINUS_ZERO = MAX_SCORE - MIN_SCORE + 1  # where the table has "-000"


class Ground(NamedTuple):
    """The painted grounds of several cars."""

    texels: np.ndarray
    """uint8 (cars, SIZE, SIZE), kinds, shades and flags."""
    quarter: np.ndarray
    """uint32 (cars, SIZE / 4, SIZE / 4), a smaller copy, in colours (red in the lowest byte)."""
    eighth: np.ndarray
    """uint32 (cars, SIZE / 8, SIZE / 8), the same."""
    sixteenth: np.ndarray
    """uint32 (cars, SIZE / 16, SIZE / 16), the same."""
    colors: np.ndarray
    """uint8 (cars, 8, 3), in the order of TEXELS."""
    palette: np.ndarray
    """uint64 (cars, 256), the colour of each texel in 16-bit lanes."""
    cells: np.ndarray
    """uint8 (cars, CELLS, CELLS), HAS_ROAD where a road polygon may have painted."""
    pattern: np.ndarray
    """uint8 (PERIOD, PERIOD), texels of background and grass without a road."""


def make_ground(cars: int) -> Ground:
    """Memory for the grounds of so many cars, 5.1 MB each; `paint` adds colours and tracks."""
    field = empty_field()
    first = RIM + PERIOD
    return Ground(
        texels=np.repeat(field[None], cars, axis=0),
        quarter=np.zeros((cars, SIZE // 4, SIZE // 4), np.uint32),
        eighth=np.zeros((cars, SIZE // 8, SIZE // 8), np.uint32),
        sixteenth=np.zeros((cars, SIZE // 16, SIZE // 16), np.uint32),
        colors=np.zeros((cars, len(TEXELS), 3), np.uint8),
        palette=np.zeros((cars, 256), np.uint64),
        cells=np.zeros((cars, CELLS, CELLS), np.uint8),
        pattern=field[first : first + PERIOD, first : first + PERIOD].copy(),
    )


def empty_field() -> np.ndarray:
    """Texels of the field without a track, uint8 (SIZE, SIZE)."""
    pattern = np.full((PERIOD, PERIOD), BACKGROUND, np.uint8)
    pattern[: PERIOD // 2, : PERIOD // 2] = GRASS
    texels = np.pad(np.tile(pattern, (20, 20)), RIM, constant_values=OUTSIDE)
    mark_edges(texels, np.full((CELLS, CELLS), HAS_ROAD, np.uint8))
    return texels


def ground_colors(background: np.ndarray, grass: np.ndarray, road: np.ndarray) -> np.ndarray:
    """The colours of an episode as Gymnasium's picture shows them, uint8 (8, 3), as in TEXELS.

    Args:
        background, grass, road: (3,) each, 0 to 255: Gymnasium's `bg_color`, `grass_color` and
            `road_color`.
    """
    shades = [np.asarray(road) + 0.01 * shade * 255 for shade in range(ROAD_SHADES)]
    colors = [background, grass, *shades, (255, 255, 255), (255, 0, 0), (0, 0, 0)]
    return np.array([[max(0, int(c) - DARKENING) for c in color] for color in colors], np.uint8)


# Painting


@fast
def paint(ground, car, road, kinds, colors):
    """Paint the track of a new episode over the last one.

    Args:
        ground: the Ground to paint on, at index `car`.
        road: float64 (n, 4, 2), polygons in world units, in the order in which they are drawn.
        kinds: uint8 (n,), ROAD + i % 3 for tile i of the track, WHITE or RED for a kerb.
        colors: uint8 (8, 3), from `ground_colors`.
    """
    texels, cells = ground.texels[car], ground.cells[car]
    restore(texels, cells, ground.pattern)
    corners = np.empty((4, 2))
    for number in range(len(road)):
        to_texels(corners, road[number])
        fill_polygon(texels, corners, kinds[number])
        mark_cells(cells, corners)
    mark_edges(texels, cells)
    new_colors = set_palette(ground.palette[car], ground.colors[car], colors)
    shrink(ground, car, new_colors)


@fast
def restore(texels, cells, pattern):
    """Give the cells with road the texels of background and grass again."""
    for i in range(CELLS):
        for j in range(CELLS):
            if cells[i, j]:
                cells[i, j] = CHANGED
                column = (j * CELL - RIM) % PERIOD
                for row in range(i * CELL, i * CELL + CELL):
                    line = (row - RIM) % PERIOD
                    for k in range(CELL):
                        texels[row, j * CELL + k] = pattern[line, column + k]


@fast
def to_texels(corners, polygon):
    """Write the corners of a polygon in world units, float64 (n, 2), in texels."""
    for i in range(len(polygon)):
        corners[i, 0] = polygon[i, 0] * SCALE + ORIGIN
        corners[i, 1] = polygon[i, 1] * SCALE + ORIGIN


@fast
def bounds(corners):
    """Smallest and largest x, smallest and largest y of a polygon, float64 (n, 2)."""
    left = right = corners[0, 0]
    low = high = corners[0, 1]
    for i in range(1, len(corners)):
        left, right = min(left, corners[i, 0]), max(right, corners[i, 0])
        low, high = min(low, corners[i, 1]), max(high, corners[i, 1])
    return left, right, low, high


@fast
def column_range(corners, row, width):
    """First and end of the pixels of a row whose centres lie in a convex polygon."""
    y = row + 0.5
    left, right = 1e9, -1e9
    x1, y1 = corners[len(corners) - 1, 0], corners[len(corners) - 1, 1]
    for i in range(len(corners)):
        x2, y2 = corners[i, 0], corners[i, 1]
        if (y1 <= y) != (y2 <= y):  # this side crosses the row
            x = x1 + (y - y1) / (y2 - y1) * (x2 - x1)
            left, right = min(left, x), max(right, x)
        x1, y1 = x2, y2
    return max(0, math.ceil(left - 0.5)), min(width, math.ceil(right - 0.5))


@fast
def fill_polygon(canvas, corners, value):
    """Set the pixels whose centres lie in a convex polygon.

    Args:
        canvas: uint8 (rows, columns).
        corners: float64 (n, 2), x and y in pixels.
        value: uint8.
    """
    _, _, low, high = bounds(corners)
    rows, columns = canvas.shape
    for row in range(max(0, math.ceil(low - 0.5)), min(rows, math.ceil(high - 0.5))):
        first, end = column_range(corners, row, columns)
        for column in range(first, end):
            canvas[row, column] = value


@fast
def visit(ground, car, tile):
    """Give a tile that the car has touched the first shade of the road, as Gymnasium does.

    Args:
        tile: float64 (4, 2), its corners in world units.
    """
    texels, corners = ground.texels[car], np.empty((4, 2))
    to_texels(corners, tile)
    _, _, low, high = bounds(corners)
    for row in range(max(0, math.ceil(low - 0.5)), min(SIZE, math.ceil(high - 0.5))):
        first, end = column_range(corners, row, texels.shape[1])
        for column in range(first, end):
            if texels[row, column] & KIND == ROAD:  # leave the kerbs of the neighbours
                texels[row, column] &= EDGE | NEAR | KIND


@fast
def mark_cells(cells, corners):
    """Mark the cells around a polygon, corners in texels, with room for the flags it causes."""
    left, right, low, high = bounds(corners)
    for i in range(max(0, int(low - 3) // CELL), min(CELLS, int(high + 3) // CELL + 1)):
        for j in range(max(0, int(left - 3) // CELL), min(CELLS, int(right + 3) // CELL + 1)):
            cells[i, j] = HAS_ROAD | CHANGED


@fast
def mark_edges(texels, cells):
    """Set the flags EDGE and NEAR in the cells with road and in those between them."""
    for i in range(CELLS):
        first, end = road_columns(cells[i])
        for row in range(i * CELL, min(i * CELL + CELL, SIZE - 1) if first < end else 0):
            mark_edge_row(texels[row, first : end + 1], texels[row + 1, first : end + 1])
    around = np.zeros(SIZE, np.uint8)
    for i in range(CELLS):
        first, end = road_columns(cells[i])
        for row in range(max(1, i * CELL), min(i * CELL + CELL, SIZE - 1) if first < end else 0):
            three = texels[row - 1 : row + 2, max(first - 1, 0) : end + 1]
            mark_near_row(three[0], three[1], three[2], around)


@fast
def road_columns(cells):
    """First texel and end of the cells with road in a row of cells, uint8 (CELLS,)."""
    first, end = SIZE, 0
    for j in range(CELLS):
        if cells[j] & HAS_ROAD:
            first, end = min(first, j * CELL), j * CELL + CELL
    return first, min(end, SIZE - 1)


@fast
def mark_edge_row(line, above):
    """EDGE: do the four texels from here to the right and up differ in kind?

    Args:
        line, above: uint8 (n + 1,), a part of the row to mark, all but its last texel, and of the
            next row. Indices from 0 let the compiler use vector instructions.
    """
    for x in range(len(line) - 1):
        here = line[x]
        different = (here ^ line[x + 1]) | (here ^ above[x]) | (here ^ above[x + 1])
        flag = np.uint8(EDGE) if np.uint8(different & KIND) else np.uint8(0)
        line[x] = (here & ~EDGE) | flag


@fast
def mark_near_row(below, line, above, around):
    """NEAR: is there an EDGE among the 3 x 3 texels around this one?

    Args:
        below, line, above: uint8 (n + 2,), parts of three rows; the middle one is marked, all but
            its first and its last texel.
        around: uint8 (n + 2 or more,), to work with.
    """
    for x in range(len(line)):
        around[x] = (below[x] | line[x] | above[x]) & EDGE
    for x in range(1, len(line) - 1):
        line[x] |= np.uint8(around[x - 1] | around[x] | around[x + 1]) >> 1


@fast
def set_palette(palette, own, colors):
    """Store the colours, uint8 (8, 3), and make the palette; returns whether they are new.

    Args:
        palette: uint64 (256,), to write; `own`: uint8 (8, 3), to write.
        colors: uint8 (8, 3).
    """
    new = False
    for i in range(len(TEXELS)):
        value = np.uint64(0)
        for channel in range(3):
            new |= own[i, channel] != colors[i, channel]
            own[i, channel] = colors[i, channel]
            value |= np.uint64(colors[i, channel]) << np.uint64(16 * channel)
        for flags in range(0, 256, 32):
            palette[flags + TEXELS[i]] = value
    return new


@fast
def shrink(ground, car, everywhere):
    """Average the texels of the changed cells, or of all, down to the smaller copies."""
    texels, palette, cells = ground.texels[car], ground.palette[car], ground.cells[car]
    quarter, eighth, sixteenth = ground.quarter[car], ground.eighth[car], ground.sixteenth[car]
    for i in range(CELLS):
        for j in range(CELLS):
            if everywhere or cells[i, j] & CHANGED:
                cells[i, j] &= HAS_ROAD
                for row in range(4 * i, 4 * i + 4):
                    for column in range(4 * j, 4 * j + 4):
                        quarter[row, column] = average_16(texels, palette, 4 * row, 4 * column)
                for row in range(2 * i, 2 * i + 2):
                    for column in range(2 * j, 2 * j + 2):
                        eighth[row, column] = average_4(quarter, 2 * row, 2 * column)
                sixteenth[i, j] = average_4(eighth, 2 * i, 2 * j)


@fast
def average_16(texels, palette, row, column):
    """Mean colour of 4 x 4 texels, uint32."""
    if not texels[row + 1, column + 1] & NEAR:  # all of one kind
        return to_bytes(palette[texels[row, column]])
    total = np.uint64(0)
    for y in range(row, row + 4):
        for x in range(column, column + 4):
            total += palette[texels[y, x]]
    return to_bytes((total >> np.uint64(4)) & LANES)


@fast
def average_4(colors, row, column):
    """Mean colour of 2 x 2 colours, uint32."""
    total = np.uint64(0)
    for y in range(row, row + 2):
        for x in range(column, column + 2):
            total += to_lanes(colors[y, x])
    return to_bytes((total >> np.uint64(2)) & LANES)


@fast
def to_bytes(color):
    """A colour in 16-bit lanes, uint64, to one in bytes, uint32: red is lowest."""
    red, green = color & np.uint64(0xFF), (color >> np.uint64(8)) & np.uint64(0xFF00)
    return np.uint32(red | green | (color >> np.uint64(16)) & np.uint64(0xFF0000))


@fast
def to_lanes(color):
    """A colour in bytes, uint32, to one in 16-bit lanes, uint64."""
    wide = np.uint64(color)
    red, green = wide & np.uint64(0xFF), (wide & np.uint64(0xFF00)) << np.uint64(8)
    return red | green | (wide & np.uint64(0xFF0000)) << np.uint64(16)


# The warp


@fast
def camera_zoom(time):
    """Window pixels per world unit, `time` seconds after the start: the first second zooms in."""
    return 0.1 * reference.SCALE * max(1 - time, 0.0) + ZOOM * min(time, 1.0)


@fast
def look(out, ground, car, pose, zoom, pixel, corner):
    """Draw what the camera sees of the ground.

    Args:
        out: uint8 (rows, columns, 3), the picture or a part of it.
        pose: x, y and angle of the hull, which stands in the middle of the window, three quarters
            of its height below the upper edge; the camera turns with it.
        zoom: window pixels per world unit.
        pixel: width and height of a pixel of the picture, in window pixels.
        corner: row and column of the picture where `out` begins, floats.
    """
    x, y, angle = pose
    step_x, step_y = pixel[0] / zoom, pixel[1] / zoom  # world units from one pixel to the next
    # From the hull to the centre of the first pixel, in the camera's axes: right and up.
    right = (corner[1] + 0.5) * step_x - 0.5 * WINDOW_W / zoom
    up = 0.75 * WINDOW_H / zoom - (corner[0] + 0.5) * step_y
    covered = step_x * SCALE / SHARP
    shrunk = 1 if covered < 2 else 4 if covered < 4 else 8 if covered < 8 else 16
    scale = SCALE / shrunk  # texels per world unit
    cos, sin = math.cos(angle) * scale, math.sin(angle) * scale
    start_x = x * scale + ORIGIN / shrunk + cos * right - sin * up
    start_y = y * scale + ORIGIN / shrunk + sin * right + cos * up
    # Texels are numbered by their centres, hence - 0.5; 1/32 rounds the weights to sixteenths.
    start = to_fixed(start_x - 0.5 + 1 / 32), to_fixed(start_y - 0.5 + 1 / 32)
    across = to_fixed(cos * step_x), to_fixed(sin * step_x)  # from one column to the next
    down = to_fixed(sin * step_y), to_fixed(-cos * step_y)  # from one row to the next
    if shrunk == 1:
        warp_texels(out, ground, car, start, across, down, covered < 1)
    else:
        copy = ground.quarter if shrunk == 4 else ground.eighth if shrunk == 8 else ground.sixteenth
        warp_colors(out, copy[car], start, across, down)


@fast
def to_fixed(position):
    """A position or step in texels as a fixed-point number, int64."""
    return math.floor(min(max(position, -1e9), 1e9) * ONE)


@fast
def columns_inside(start, step, columns, size):
    """First and end of the columns in 0 to `columns` where 0 <= start + column * step < size."""
    last = size * ONE - 1
    if step > 0:
        first, end = -(start // step), (last - start) // step + 1
    elif step < 0:
        first, end = -((last - start) // -step), start // -step + 1
    else:
        first, end = 0, columns if 0 <= start <= last else 0
    return max(0, first), min(columns, end)


@fast
def columns_on_texture(x, y, across, columns, size):
    """First and end of the columns of a row that see a texture; the others see black.

    The texture has a black rim, so we may keep away from its borders, where an interpolation would
    need texels beyond them.

    Args:
        x, y: fixed-point position of column 0; `across`: the steps from one column to the next.
        columns: of the row; `size`: of the texture, texels.
    """
    margin = 4 * size // SIZE
    low, inner = margin * ONE, size - 1 - 2 * margin
    first_x, end_x = columns_inside(x - low, across[0], columns, inner)
    first_y, end_y = columns_inside(y - low, across[1], columns, inner)
    first = min(max(first_x, first_y), columns)
    return first, max(first, min(end_x, end_y))


@merged
def warp_texels(out, ground, car, start, across, down, fine):
    """Warp the full-size texture into `out`, uint8 (rows, columns, 3).

    Args:
        start: fixed-point x and y on the texture of the first pixel's centre.
        across, down: fixed-point steps to the next column and to the next row.
        fine: whether one interpolation is enough for a flagged pixel; else it takes two.
    """
    rows, columns = out.shape[0], out.shape[1]
    pixels, texels = out.reshape(-1), ground.texels[car].reshape(-1)
    palette = ground.palette[car]
    nearest = np.zeros(rows * columns + BLOCK, np.uint8)  # the texel of each pixel
    for row in range(rows):
        x, y = start[0] + row * down[0], start[1] + row * down[1]
        first, end = columns_on_texture(x, y, across, columns, ground.texels.shape[1])
        line = nearest[row * columns : (row + 1) * columns]
        read_texels(line, texels, x, y, across, first, end)
    write_colors(pixels, nearest, ground.colors[car])
    smooth_edges(pixels, nearest, texels, palette, columns, start, across, down, fine)


@fast
def read_texels(line, texels, x, y, across, first, end):
    """Read the texels under the columns of a row; those before `first` and from `end` on are black.

    Args:
        line: uint8 (columns,), to write.
        texels: uint8 (SIZE * SIZE,).
        x, y: fixed-point position of column 0; `across`: the steps from one column to the next.
    """
    for column in range(first):
        line[column] = OUTSIDE
    for column in range(end, len(line)):
        line[column] = OUTSIDE
    x += first * across[0]
    y += first * across[1]
    for column in range(first, end):
        line[np.uint64(column)] = texels[np.uint64((y >> FRACTION) * SIZE + (x >> FRACTION))]
        x += across[0]
        y += across[1]


@fast
def write_colors(pixels, nearest, colors):
    """Turn the texels of pixels into colours, uint8 (3 n,): red, green, blue, red, ...

    Selections instead of a table: so the loop compiles to vector instructions, 64 pixels at once.
    """
    background, grass, road_0 = row_of(colors, 0), row_of(colors, 1), row_of(colors, 2)
    road_1, road_2, white = row_of(colors, 3), row_of(colors, 4), row_of(colors, 5)
    red, outside = row_of(colors, 6), row_of(colors, 7)
    for i in range(len(pixels) // 3):
        texel = np.uint8(nearest[i] & KIND_AND_SHADE)
        color = background
        color = grass if texel == GRASS else color
        color = road_0 if texel == ROAD else color
        color = road_1 if texel == ROAD + 1 else color
        color = road_2 if texel == ROAD + 2 else color
        color = white if texel == WHITE else color
        color = red if texel == RED else color
        color = outside if texel == OUTSIDE else color
        place = np.uint64(3 * i)
        pixels[place] = color[0]
        pixels[place + np.uint64(1)] = color[1]
        pixels[place + np.uint64(2)] = color[2]


@merged
def row_of(colors, i):
    """Red, green and blue of colour i, as a tuple."""
    return colors[i, 0], colors[i, 1], colors[i, 2]


@fast
def channels(color):
    """Red, green and blue, uint8, of a colour in 16-bit lanes."""
    return np.uint8(color), np.uint8(color >> np.uint64(16)), np.uint8(color >> np.uint64(32))


@fast
def find_flagged(found, nearest, flag):
    """List the pixels whose texel has a flag; returns how many there are.

    Most have none, so we look at several at a time. Where there is one, each of these pixels is
    written to the list, but the list grows by the flagged ones only: so there is no jump that a
    processor may predict wrongly.

    Args:
        found: uint16 (n,), to write.
        nearest: uint8 (n,), the texels and, at the end, BLOCK zeros.
        flag: uint8.
    """
    count = np.uint64(0)
    for first in range(0, len(nearest) - BLOCK, BLOCK):
        flags = np.uint8(0)
        for i in range(BLOCK):
            flags = np.uint8(flags | nearest[np.uint64(first + i)])
        if flags & flag:
            for i in range(first, first + BLOCK):
                found[count] = i
                count += np.uint64((nearest[np.uint64(i)] & flag) != 0)
    return count


@merged
def smooth_edges(pixels, nearest, texels, palette, columns, start, across, down, fine):
    """Interpolate the pixels whose texels are flagged.

    Args:
        pixels: uint8 (3 n,), to write.
        nearest: uint8 (n + BLOCK,), the texel of each pixel, and zeros.
        texels: uint8 (SIZE * SIZE,); `palette`: uint64 (256,).
        columns: of the picture.
        start, across, down, fine: as in `warp_texels`.
    """
    found = np.empty(len(nearest), np.uint16)
    for i in range(find_flagged(found, nearest, np.uint8(EDGE if fine else NEAR))):
        pixel = np.uint32(found[i])
        row = np.int64(np.uint32(pixel // np.uint32(columns)))
        column = np.int64(pixel) - row * columns
        x = start[0] + row * down[0] + column * across[0]
        y = start[1] + row * down[1] + column * across[1]
        if fine:
            color = interpolate(texels, palette, x, y)
        else:  # the mean of two, a quarter of a pixel to either side
            shift_x, shift_y = across[0] >> 2, across[1] >> 2
            left = interpolate(texels, palette, x - shift_x, y - shift_y)
            right = interpolate(texels, palette, x + shift_x, y + shift_y)
            color = ((left >> np.uint64(1)) & HALVES) + ((right >> np.uint64(1)) & HALVES)
        write(pixels, np.uint64(3) * np.uint64(pixel), color)


@fast
def weights(x, y):
    """How far a fixed-point position is beyond the texel to its left and below, in sixteenths."""
    return np.uint64((x >> (FRACTION - 4)) & 15), np.uint64((y >> (FRACTION - 4)) & 15)


@fast
def interpolate(texels, palette, x, y):
    """Bilinear interpolation of four texels: 256 times the colour, in 16-bit lanes."""
    right, up = weights(x, y)
    left, down = np.uint64(16) - right, np.uint64(16) - up
    here = np.uint64((y >> FRACTION) * SIZE + (x >> FRACTION))
    above, one = here + np.uint64(SIZE), np.uint64(1)
    lower = palette[texels[here]] * left + palette[texels[here + one]] * right
    upper = palette[texels[above]] * left + palette[texels[above + one]] * right
    return lower * down + upper * up + ROUND


@fast
def warp_colors(out, colors, start, across, down):
    """Warp a smaller copy of the texture, uint32 (n, n), with interpolation at every pixel."""
    rows, columns = out.shape[0], out.shape[1]
    pixels, size = out.reshape(-1), len(colors)
    for row in range(rows):
        x, y = start[0] + row * down[0], start[1] + row * down[1]
        first, end = columns_on_texture(x, y, across, columns, size)
        for column in range(columns):
            color = np.uint64(0)
            if first <= column < end:
                color = interpolate_colors(colors, x + column * across[0], y + column * across[1])
            write(pixels, np.uint64(3 * (row * columns + column)), color)


@fast
def interpolate_colors(colors, x, y):
    """As `interpolate`, of a smaller copy of the texture."""
    right, up = weights(x, y)
    left, down = np.uint64(16) - right, np.uint64(16) - up
    row, column, one = np.uint64(y >> FRACTION), np.uint64(x >> FRACTION), np.uint64(1)
    lower = to_lanes(colors[row, column]) * left + to_lanes(colors[row, column + one]) * right
    row += one
    upper = to_lanes(colors[row, column]) * left + to_lanes(colors[row, column + one]) * right
    return lower * down + upper * up + ROUND


@fast
def write(pixels, place, color):
    """Write 256 times a colour, in 16-bit lanes, to three bytes from `place` on."""
    red, green, blue = channels(color >> np.uint64(8))
    pixels[place] = red
    pixels[place + np.uint64(1)] = green
    pixels[place + np.uint64(2)] = blue


# The car


@fast
def draw_car(out, pictures, wheels, zoom, corner):
    """Blend the car over a part of the observation.

    Args:
        out: uint8 (rows, columns, 3).
        pictures: the Pictures.
        wheels: float64 (4, 3), for each wheel its angle to the hull, its rotation (both radians)
            and its speed of rotation.
        zoom: window pixels per world unit.
        corner: row and column of the observation where `out` begins, floats.
    """
    drawn = np.empty((QUARTER_ROWS, QUARTER_COLUMNS, 4), np.uint8)
    for place in range(4):
        turn = round(TURN_STEPS * min(max(wheels[place, 0], -LARGEST_TURN), LARGEST_TURN))
        phase = int(wheels[place, 1] % math.tau * PHASE_STEPS / math.tau) % PHASE_STEPS
        if zoom == ZOOM:
            quarter = pictures.car[place, turn + MAX_TURN, phase]
        else:  # in the opening second
            draw_quarter(drawn, place, turn, phase, zoom)
            quarter = drawn
        top = HULL_ROW - int(corner[0]) - (QUARTER_ROWS if place < 2 else 0)
        left = HULL_COLUMN - int(corner[1]) - (QUARTER_COLUMNS if place % 2 == 0 else 0)
        for row in range(QUARTER_ROWS):
            for column in range(QUARTER_COLUMNS):
                free = 255 - np.int64(quarter[row, column, 3])
                for channel in range(3):
                    ground = (out[top + row, left + column, channel] * free + 127) // 255
                    out[top + row, left + column, channel] = ground + quarter[row, column, channel]


@fast
def draw_quarter(quarter, place, turn, phase, zoom):
    """Draw a quarter of the car with one wheel.

    Args:
        quarter: uint8 (6, 4, 4), to write: red, green, blue, and how much of the ground is covered.
        place: of the wheel: front left, front right, rear left, rear right.
        turn: its angle to the hull in 1/24 radian, positive to the left.
        phase: its rotation in 1/32 of a turn.
        zoom: window pixels per world unit.
    """
    canvas = np.zeros((CANVAS_ROWS, CANVAS_COLUMNS), np.uint8)
    # The column and row of the canvas where the hull's origin lies.
    origin = CANVAS_COLUMNS * (place % 2 == 0), CANVAS_ROWS * (place < 2)
    cos, sin = math.cos(turn / TURN_STEPS), math.sin(turn / TURN_STEPS)
    low, high = wheel_stripe((phase + 0.5) * math.tau / PHASE_STEPS)
    polygon = np.empty((CORNERS, 2))
    for shape in range(TYRE, HULL + len(HULL_POLYGONS)):
        if shape < HULL:
            bottom, top = (-1.0, 1.0) if shape == TYRE else (low, high)
            for i in range(CORNERS):
                x = WHEEL_HALF_WIDTH if 0 < i < 3 else -WHEEL_HALF_WIDTH
                y = WHEEL_RADIUS * (top if i < 2 else bottom)
                polygon[i, 0] = cos * x - sin * y + WHEEL_PLACES[place, 0]
                polygon[i, 1] = sin * x + cos * y + WHEEL_PLACES[place, 1]
            if bottom > top:
                continue
        else:
            for i in range(CORNERS):
                polygon[i, 0] = HULL_POLYGONS[shape - HULL, i, 0]
                polygon[i, 1] = HULL_POLYGONS[shape - HULL, i, 1]
        to_window(polygon, zoom, origin)
        fill_polygon(canvas, polygon, np.uint8(min(shape, HULL)))
    average_quarter(quarter, canvas, origin)


@fast
def wheel_stripe(phase):
    """Ends of the light stripe on a turning wheel, in radii along it; (1, -1) if hidden."""
    sin1, sin2 = math.sin(phase), math.sin(phase + 1.2)
    cos1, cos2 = math.cos(phase), math.cos(phase + 1.2)
    if sin1 > 0 and sin2 > 0:
        return 1.0, -1.0
    if sin1 > 0:
        cos1 = math.copysign(1.0, cos1)
    if sin2 > 0:
        cos2 = math.copysign(1.0, cos2)
    return min(cos1, cos2), max(cos1, cos2)


@merged
def to_window(polygon, zoom, origin):
    """Turn world units into window pixels, in place, so that it is filled as pygame fills it.

    For pygame a corner is a whole pixel, and the pixels on the sides belong to the polygon. So we
    move each corner to the centre of its pixel, and a little outward.

    Args:
        polygon: float64 (n, 2), from the hull's origin.
        zoom: window pixels per world unit.
        origin: column and row of the hull's origin on the canvas.
    """
    left, right, low, high = bounds(polygon)
    for i in range(len(polygon)):
        out_x = TINY if 2 * polygon[i, 0] > left + right else -TINY
        out_y = TINY if 2 * polygon[i, 1] > low + high else -TINY
        polygon[i, 0] = origin[0] + math.floor(polygon[i, 0] * zoom) + 0.5 + out_x
        polygon[i, 1] = origin[1] - math.floor(polygon[i, 1] * zoom) - 0.5 - out_y


@merged
def average_quarter(quarter, canvas, origin):
    """Average the shapes on a canvas of window pixels to a picture, uint8 (6, 4, 4)."""
    # The side of the canvas where the hull's origin lies is the side of the picture, too.
    shift_x = CANVAS_COLUMNS - QUARTER_COLUMNS * PIXEL_W if origin[0] else 0.0
    shift_y = CANVAS_ROWS - QUARTER_ROWS * PIXEL_H if origin[1] else 0.0
    for row in range(QUARTER_ROWS):
        top, bottom = row * PIXEL_H + shift_y, (row + 1) * PIXEL_H + shift_y
        for column in range(QUARTER_COLUMNS):
            left, right = column * PIXEL_W + shift_x, (column + 1) * PIXEL_W + shift_x
            covered, red, green = 0.0, 0.5, 0.5  # 0.5 rounds; blue is equal to green
            for y in range(int(top), min(CANVAS_ROWS, math.ceil(bottom))):
                height = (min(bottom, y + 1.0) - max(top, float(y))) / (PIXEL_W * PIXEL_H)
                for x in range(int(left), min(CANVAS_COLUMNS, math.ceil(right))):
                    shape = canvas[y, x]
                    if shape:
                        area = height * (min(right, x + 1.0) - max(left, float(x)))
                        covered += area
                        red += area * SHAPE_RED[shape]
                        green += area * SHAPE_GREEN[shape]
            quarter[row, column, 0] = int(red)
            quarter[row, column, 1] = int(green)
            quarter[row, column, 2] = int(green)
            quarter[row, column, 3] = int(255 * covered + 0.5)


@fast
def average_patch(frame, patch, rows, columns):
    """Average observation pixels around the car to the pixels of the agent's frame.

    Args:
        frame: uint8 (rows, 64, 3), to write where the car is.
        patch: uint8 (PATCH_ROWS, PATCH_COLUMNS, 3), pixels of the observation from row
            PATCH_TOP and column PATCH_LEFT on.
        rows, columns: how many observation pixels a frame pixel is high and wide.
    """
    first_row, end_row = int(CAR_TOP / rows), math.ceil(CAR_BOTTOM / rows)
    first_column, end_column = int(CAR_LEFT / columns), math.ceil(CAR_RIGHT / columns)
    for row in range(first_row, end_row):
        top = row * rows - PATCH_TOP
        for column in range(first_column, end_column):
            left = column * columns - PATCH_LEFT
            red, green, blue = 0.5, 0.5, 0.5  # rounds
            for y in range(int(top), math.ceil(top + rows)):
                height = (min(top + rows, y + 1.0) - max(top, float(y))) / (rows * columns)
                for x in range(int(left), math.ceil(left + columns)):
                    weight = height * (min(left + columns, x + 1.0) - max(left, float(x)))
                    red += weight * patch[y, x, 0]
                    green += weight * patch[y, x, 1]
                    blue += weight * patch[y, x, 2]
            frame[row, column, 0] = int(red)
            frame[row, column, 1] = int(green)
            frame[row, column, 2] = int(blue)


# The indicator bar


@fast
def draw_bar(out, score, speed, spin, wheels, reward):
    """Draw the score and the seven indicators over the lower edge of a picture.

    Args:
        out: uint8 (rows, columns, 3), an observation or a frame with its indicator bar.
        score: uint8 (n, rows of the bar, columns), the pictures of the score.
        speed: of the hull, world units per second.
        spin: its angular velocity, radians per second.
        wheels: float64 (4, 3), angle to the hull, rotation and speed of rotation of each wheel.
        reward: so far.
    """
    index, top = score_index(reward), out.shape[0] - score.shape[1]
    for row in range(score.shape[1]):
        for column in range(out.shape[1]):
            level = score[index, row, column] if column < score.shape[2] else 0
            for channel in range(3):
                out[top + row, column, channel] = level
    draw_upright(out, 5.0, 0.02 * speed, speed, 253.0, 253.0, 253.0)
    for place in range(4):
        omega = wheels[place, 2]
        draw_upright(out, 7.0 + place, 0.01 * omega, omega, 0.0 if place < 2 else 49.0, 0.0, 253.0)
    draw_sideways(out, 20.0, -10.0 * wheels[0, 0], wheels[0, 0], 0.0, 253.0)
    draw_sideways(out, 30.0, -0.8 * spin, spin, 253.0, 0.0)


@fast
def score_index(reward):
    """Where the table of scores has the picture of a reward."""
    score = round(min(max(reward, float(MIN_SCORE)), float(MAX_SCORE)))
    if score == 0 and math.copysign(1.0, reward) < 0:
        return MINUS_ZERO  # Python prints "-000"
    return int(score) - MIN_SCORE


@fast
def draw_upright(out, place, length, value, red, green, blue):
    """A vertical indicator, `place` / 40 of the width from the left, `length` / 40 high."""
    if abs(value) > 1e-4:
        unit, end = WINDOW_W / 40, WINDOW_H - WINDOW_H / 40
        top = np.trunc(end - length * WINDOW_H / 40)
        draw_rectangle(out, place * unit, (place + 1) * unit, top, end, red, green, blue)


@fast
def draw_sideways(out, place, length, value, red, green):
    """A horizontal indicator, `place` / 40 of the width from the left, `length` / 40 of it."""
    if abs(value) > 1e-4:
        begin, unit = place * WINDOW_W / 40, WINDOW_H / 40
        end = np.trunc((place + length) * WINDOW_W / 40)
        draw_rectangle(out, begin, end, WINDOW_H - 4 * unit, WINDOW_H - 2 * unit, red, green, 0.0)


@fast
def draw_rectangle(out, x1, x2, y1, y2, red, green, blue):
    """Blend an upright rectangle over a picture.

    Args:
        out: uint8 (rows, columns, 3).
        x1, x2, y1, y2: the outermost window pixels, in any order; all of them are filled.
        red, green, blue: its colour, 0 to 255.
    """
    width, height = out.shape[1] / WINDOW_W, out.shape[0] / WINDOW_H
    left, right = max(min(x1, x2), 0.0) * width, (min(max(x1, x2), WINDOW_W - 1) + 1) * width
    top, bottom = max(min(y1, y2), 0.0) * height, (min(max(y1, y2), WINDOW_H - 1) + 1) * height
    for row in range(int(top), math.ceil(bottom)):
        rows = min(bottom, row + 1.0) - max(top, float(row))
        for column in range(int(left), math.ceil(right)):
            cover = rows * (min(right, column + 1.0) - max(left, float(column)))
            pixel = out[row, column]
            pixel[0] = int(pixel[0] + cover * (red - pixel[0]) + 0.5)
            pixel[1] = int(pixel[1] + cover * (green - pixel[1]) + 0.5)
            pixel[2] = int(pixel[2] + cover * (blue - pixel[2]) + 0.5)


# Whole pictures


@fast
def all_finite(hull, wheels, reward):
    """Whether no number of the car's state is infinite or NaN."""
    total = reward
    for i in range(len(hull)):
        total += hull[i]
    for i in range(len(wheels)):
        total += wheels[i, 0] + wheels[i, 1] + wheels[i, 2]
    return math.isfinite(total)


@merged
def draw_picture(out, ground, pictures, car, hull, wheels, reward, time, bar):
    """Draw the observation or the agent's frame of one car.

    The frame equals, up to rounding near edges, the observation after
    `stad_lab.envs.frames.to_frame`.

    Args:
        out: uint8, to write: (96, 96, 3) for the observation, (64, 64, 3) for the frame.
        ground: the Ground, painted, of which this is number `car`.
        pictures: from `make_pictures`.
        hull: float64 (5,): x and y (world units), angle (radians), speed (world units per second),
            angular velocity (radians per second).
        wheels: float64 (4, 3), for each wheel its angle to the hull, its rotation (radians) and its
            speed of rotation (radians per second).
        reward: so far in the episode.
        time: since its start, seconds.
        bar: whether to draw the indicator bar. Without it the rows of the observation are black,
            and the frame shows the rest, stretched to its height.

    A state that is not finite gives a black picture.
    """
    if not all_finite(hull, wheels, reward):  # the physics has failed; there is nothing to see
        out[:] = 0
        return
    whole = out.shape[0] == OBSERVATION_SIZE
    columns = OBSERVATION_SIZE / out.shape[1]  # of the observation to one column of this picture
    rows = columns if whole or bar else BAR_TOP / out.shape[0]
    zoom, pose, corner = camera_zoom(time), (hull[0], hull[1], hull[2]), (0.0, 0.0)
    view = out[: round(BAR_TOP / rows)]
    look(view, ground, car, pose, zoom, (PIXEL_W * columns, PIXEL_H * rows), corner)
    if whole:
        draw_car(view, pictures, wheels, zoom, corner)
    else:  # the car is so small that we average the pixels of the observation
        patch = np.empty((PATCH_ROWS, PATCH_COLUMNS, 3), np.uint8)
        corner = float(PATCH_TOP), float(PATCH_LEFT)
        look(patch, ground, car, pose, zoom, (PIXEL_W, PIXEL_H), corner)
        draw_car(patch, pictures, wheels, zoom, corner)
        average_patch(view, patch, rows, columns)
    if bar:
        score = pictures.score if whole else pictures.small_score
        draw_bar(out, score, hull[3], hull[4], wheels, reward)
    elif whole:
        out[BAR_TOP:] = 0


@fast
def draw_cars(out, ground, pictures, which, cars, roads, tiles, bar):
    """Draw what some cars see; tiles that they have touched since the last time change colour.

    Args:
        out: uint8 (n, 96, 96, 3) or (n, 64, 64, 3), to write.
        ground: the painted Ground of all cars.
        pictures: from `make_pictures`.
        which: int64 (n,), numbers of the cars.
        cars, roads: `physics.CAR` and `physics.ROAD` (cars,).
        tiles: float64 (cars, MAX_TILES, 4, 2), corners of the tiles in world units.
        bar: whether to draw the indicator bar.
    """
    hull, wheels = np.empty(5), np.empty((4, 3))
    for n in range(len(which)):
        number = which[n]
        car, road = cars[number], roads[number]
        for tile in range(road.tiles):
            if road.darkened[tile] == 1:
                road.darkened[tile] = 2  # and painted
                visit(ground, number, tiles[number, tile])
        hull[0], hull[1], hull[2] = car.position[0, 0], car.position[0, 1], car.angle[0]
        hull[3] = math.sqrt(car.velocity[0, 0] ** 2 + car.velocity[0, 1] ** 2)
        hull[4] = car.velocity[0, 2]
        for i in range(4):
            wheels[i, 0] = car.angle[1 + i] - car.angle[0]
            wheels[i, 1], wheels[i, 2] = car.phase[i], car.omega[i]
        # Gymnasium draws before it takes 0.1 off.
        shown = car.reward + 0.1 if car.frames else car.reward
        draw_picture(out[n], ground, pictures, number, hull, wheels, shown, car.time, bar)


# Tables, made once


class Pictures(NamedTuple):
    """Small pictures that many frames share; nobody writes to them."""

    car: np.ndarray
    """uint8 (4, turns, phases, 6, 4, 4), quarters of the car as `draw_quarter` makes them."""
    score: np.ndarray
    """uint8 (n, 12, 12), every score in white on black, in the size of the observation."""
    small_score: np.ndarray
    """uint8 (n, 8, 8), in the size of the agent's frame."""


_making = threading.Lock()  # pygame's fonts are not made for threads


def make_pictures() -> Pictures:
    """The small pictures; made at the first call, which takes 0.1 s, and shared afterwards."""
    with _making:
        return _make_pictures()


@functools.cache
def _make_pictures() -> Pictures:
    texts = [f"{score:04d}" for score in range(MIN_SCORE, MAX_SCORE + 1)] + ["-000"]
    pygame.font.init()
    font = pygame.font.Font(pygame.font.get_default_font(), 42)
    score = np.array([score_picture(font, text) for text in texts])
    halves = score.repeat(2, axis=1).repeat(2, axis=2)  # three of them make a pixel of the frame
    small = halves.reshape(len(score), 8, 3, 8, 3).mean(axis=(2, 4)).round().astype(np.uint8)
    car = np.empty((4, 2 * MAX_TURN + 1, PHASE_STEPS, QUARTER_ROWS, QUARTER_COLUMNS, 4), np.uint8)
    for place, turn, phase in np.ndindex(car.shape[:3]):
        draw_quarter(car[place, turn, phase], place, turn - MAX_TURN, phase, ZOOM)
    return Pictures(car, np.ascontiguousarray(score), np.ascontiguousarray(small))


def score_picture(font: pygame.font.Font, text: str) -> np.ndarray:
    """The score as the left end of the indicator bar shows it, uint8 (12, 12)."""
    surface = pygame.Surface((round(SCORE_COLUMNS * PIXEL_W), round(BAR_ROWS * PIXEL_H)), depth=24)
    label = font.render(text, True, (255, 255, 255), (0, 0, 0))
    surface.blit(label, label.get_rect(center=(60, WINDOW_H * 2.5 / 40)))
    small = pygame.transform.smoothscale(surface, (SCORE_COLUMNS, BAR_ROWS))
    return pygame.surfarray.array3d(small)[:, :, 0].T
