"""Pictures of CarRacing: a texture of the track, one affine warp, the car and the indicator bar on top.

Gymnasium draws some 800 polygons on 1000 x 800 window pixels for every observation and shrinks the
result to 96 x 96. But the ground hardly changes within an episode, and the camera is fixed to the
car. So we paint the ground once per episode into a texture; a picture then takes three steps:

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

`draw_observation` makes the full observation, uint8 (96, 96, 3). `draw_frame` makes the agent's
frame, uint8 (64, 64, 3), straight from the texture. Everything is compiled by Numba and releases the
GIL; nothing here knows Box2D. Images are indexed [row, column]; the texture's rows follow the
world's y axis upward, its columns the x axis.
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
from numba import njit

compiled = njit(cache=True, nogil=True, error_model="numpy")

# The pictures and Gymnasium's window, whose coordinates we share.
OBSERVATION_SIZE = 96  # pixels, width and height of the observation
BAR_TOP = 84  # the first row of the observation that belongs to the indicator bar
FRAME_SIZE = 64  # pixels, width and height of the agent's frame
WINDOW_W, WINDOW_H = float(reference.WINDOW_W), float(reference.WINDOW_H)  # window pixels
PLAYFIELD = reference.PLAYFIELD  # half the side of the square field, world units
DARKENING = 2  # pygame's smoothscale loses two levels of every channel to its fixed-point sums

# The texture.
FIELD = 1920  # texels, width and height of the field
CELL = 16  # texels: the texture is restored and shrunk in cells of this size
RIM = CELL  # texels of black around the field
SIZE = FIELD + 2 * RIM  # texels, width and height of the texture
SCALE = FIELD / (2 * PLAYFIELD)  # texels per world unit: 1.9 texels to a pixel of the observation
ORIGIN = SIZE / 2  # x and y of the world's origin, texels
PERIOD = FIELD // 20  # texels from one grass square to the next
CELLS = SIZE // CELL
SHARP = 2.6  # a pixel that covers more texels than this (in x) needs more samples or a smaller copy

# A texel: the kind of ground in bits 0 to 4, the flags in bits 6 and 7. Roads have three shades,
# told apart by bits 0 and 1, which count as one kind when edges are looked for.
BACKGROUND, GRASS, ROAD, WHITE, RED, OUTSIDE = 0, 4, 8, 12, 16, 20
KIND, KIND_AND_SHADE = 0b11100, 0b11111
EDGE = 0x80  # the 2 x 2 texels from here to the right and up are of more than one kind
NEAR = 0x40  # the 4 x 4 texels around those are
COLORS = 8  # number of colours: background, grass, three shades of road, white, red, outside
ROAD_SHADES = 3

# Colours with 16 bits for each channel in one 64-bit number: one multiplication weighs all three.
LANES = np.uint64(0x00FF00FF00FF)
HALF = np.uint64(0x008000800080)  # rounds a sum of weights 256 to the nearest level
HALVES = np.uint64(0x7FFF7FFF7FFF)  # the lanes of a colour that has been halved
FRACTION = 16  # positions on the texture are fixed-point numbers with so many binary digits
ONE = 1 << FRACTION

# The car: the hull's origin lies at the corner between these pixels of the observation.
HULL_ROW, HULL_COLUMN = 72, 48
QUARTER_ROWS, QUARTER_COLUMNS = 6, 4  # pixels, size of a quarter of the car
PIXEL_W, PIXEL_H = WINDOW_W / OBSERVATION_SIZE, WINDOW_H / OBSERVATION_SIZE  # window pixels
CANVAS_ROWS = math.ceil(QUARTER_ROWS * PIXEL_H)  # a quarter is drawn in window pixels, then averaged
TINY = 1e-6
CANVAS_COLUMNS = math.ceil(QUARTER_COLUMNS * PIXEL_W)
TURN_STEPS, MAX_TURN = 24, 12  # a wheel's angle to the hull: steps of 1/24 rad, at most 12 of them
PHASE_STEPS = 32  # a wheel's rotation: steps of 2 pi / 32
HULL_POLYGONS = tuple(
    np.array(polygon) * car_dynamics.SIZE  # world units
    for polygon in (
        car_dynamics.HULL_POLY1,
        car_dynamics.HULL_POLY2,
        car_dynamics.HULL_POLY3,
        car_dynamics.HULL_POLY4,
    )
)
FULL_ZOOM = reference.ZOOM * reference.SCALE  # window pixels per world unit after the first second
CAR_TOP, CAR_BOTTOM = HULL_ROW - QUARTER_ROWS, HULL_ROW + QUARTER_ROWS
CAR_LEFT, CAR_RIGHT = HULL_COLUMN - QUARTER_COLUMNS, HULL_COLUMN + QUARTER_COLUMNS
PATCH_CORNER = CAR_TOP - 1, CAR_LEFT - 4  # the part of the observation that frames need exactly
PATCH_ROWS, PATCH_COLUMNS = 2 * QUARTER_ROWS + 2, 16
WHEEL_PLACES = np.array(car_dynamics.WHEELPOS) * car_dynamics.SIZE  # world units
WHEEL_HALF_WIDTH = car_dynamics.WHEEL_W * car_dynamics.SIZE
WHEEL_RADIUS = car_dynamics.WHEEL_R * car_dynamics.SIZE
TYRE, STRIPE, HULL = 1, 2, 3
CAR_COLORS = np.array([(0, 0, 0), (0, 0, 0), (75, 75, 75), (202, 0, 0)], np.float64)  # darkened

# The indicator bar.
SCORE_COLUMNS = 12  # pixels of the observation that the score may cover
MIN_SCORE, MAX_SCORE = -999, 1000
MINUS_ZERO = MAX_SCORE - MIN_SCORE + 1  # where the table keeps "-000"


class Ground(NamedTuple):
    """The painted grounds of several cars.

    Attributes:
        texels: uint8 (cars, SIZE, SIZE), kinds and flags.
        quarter, eighth, sixteenth: uint32 (cars, SIZE / n, SIZE / n), smaller copies, in colours
            (red in the lowest byte).
        colors: uint8 (cars, COLORS, 3), of background, grass, three shades of road, white, red,
            outside of the field.
        palette: uint64 (cars, 256), the colour of each texel in 16-bit lanes.
        touched: bool (cars, CELLS, CELLS), the cells that a road polygon may have changed.
        pattern: uint8 (PERIOD, PERIOD), texels of background and grass without a road.
    """

    texels: np.ndarray
    quarter: np.ndarray
    eighth: np.ndarray
    sixteenth: np.ndarray
    colors: np.ndarray
    palette: np.ndarray
    touched: np.ndarray
    pattern: np.ndarray


def make_ground(cars: int) -> Ground:
    """Memory for the grounds of so many cars, 5 MB each; `paint` adds colours and tracks."""
    field = empty_field()
    first = RIM + PERIOD
    return Ground(
        texels=np.repeat(field[None], cars, axis=0),
        quarter=np.zeros((cars, SIZE // 4, SIZE // 4), np.uint32),
        eighth=np.zeros((cars, SIZE // 8, SIZE // 8), np.uint32),
        sixteenth=np.zeros((cars, SIZE // 16, SIZE // 16), np.uint32),
        colors=np.zeros((cars, COLORS, 3), np.uint8),
        palette=np.zeros((cars, 256), np.uint64),
        touched=np.zeros((cars, CELLS, CELLS), np.bool_),
        pattern=field[first : first + PERIOD, first : first + PERIOD].copy(),
    )


def empty_field() -> np.ndarray:
    """Texels of the field without a track, uint8 (SIZE, SIZE)."""
    pattern = np.full((PERIOD, PERIOD), BACKGROUND, np.uint8)
    pattern[: PERIOD // 2, : PERIOD // 2] = GRASS
    texels = np.pad(np.tile(pattern, (20, 20)), RIM, constant_values=OUTSIDE)
    mark_edges(texels, np.ones((CELLS, CELLS), np.bool_))
    return texels


def ground_colors(background: np.ndarray, grass: np.ndarray, road: np.ndarray) -> np.ndarray:
    """The colours of an episode, uint8 (COLORS, 3), as Gymnasium's picture shows them.

    Args:
        background, grass, road: (3,) each, 0 to 255: Gymnasium's `bg_color`, `grass_color` and
            `road_color`.
    """
    shades = [np.asarray(road) + 0.01 * shade * 255 for shade in range(ROAD_SHADES)]
    colors = [background, grass, *shades, (255, 255, 255), (255, 0, 0), (0, 0, 0)]
    return np.array([[max(0, int(c) - DARKENING) for c in color] for color in colors], np.uint8)


# Painting


@compiled
def paint(ground, car, road, kinds, colors):
    """Paint the track of a new episode over the last one.

    Args:
        ground: the Ground to paint on, at index `car`.
        road: float64 (n, 4, 2), polygons in world units, in the order in which they are drawn.
        kinds: uint8 (n,), ROAD + i % 3 for tile i of the track, WHITE or RED for a kerb.
        colors: uint8 (COLORS, 3), from `ground_colors`.
    """
    texels, touched = ground.texels[car], ground.touched[car]
    restore(texels, touched, ground.pattern)
    changed = touched.copy()
    if (colors != ground.colors[car]).any():
        changed[:] = True  # the smaller copies hold colours: all of them are new
        ground.colors[car] = colors
        set_palette(ground.palette[car], colors)
    touched[:] = False
    for number in range(len(road)):
        corners = road[number] * SCALE + ORIGIN
        fill_polygon(texels, corners, kinds[number])
        touch(touched, corners)
    mark_edges(texels, touched)
    changed |= touched
    shrink(ground, car, changed)


@compiled
def set_palette(palette, colors):
    """Spread the colours, uint8 (COLORS, 3), to the lanes of a palette, uint64 (256,)."""
    for texel in range(256):
        kind, shade = (texel & KIND) >> 2, min(texel & 3, ROAD_SHADES - 1)
        if kind == ROAD >> 2:
            kind += shade
        elif kind > ROAD >> 2:
            kind = min(kind + ROAD_SHADES - 1, COLORS - 1)
        value = np.uint64(0)
        for channel in range(3):
            value |= np.uint64(colors[kind, channel]) << np.uint64(16 * channel)
        palette[texel] = value


@compiled
def restore(texels, touched, pattern):
    """Give the touched cells the texels of background and grass again."""
    for i in range(CELLS):
        for j in range(CELLS):
            if touched[i, j]:
                column = (j * CELL - RIM) % PERIOD
                for row in range(i * CELL, i * CELL + CELL):
                    line = (row - RIM) % PERIOD
                    for k in range(CELL):
                        texels[row, j * CELL + k] = pattern[line, column + k]


@compiled
def touch(touched, corners):
    """Mark the cells around a polygon, corners float64 (n, 2) in texels, with room for the flags."""
    left, right = corners[:, 0].min() - 3, corners[:, 0].max() + 3
    low, high = corners[:, 1].min() - 3, corners[:, 1].max() + 3
    for i in range(max(0, int(low) // CELL), min(CELLS, int(high) // CELL + 1)):
        for j in range(max(0, int(left) // CELL), min(CELLS, int(right) // CELL + 1)):
            touched[i, j] = True


@compiled
def row_range(corners, height):
    """First and end of the rows whose centres a polygon may contain, within 0 to `height`."""
    low, high = corners[0, 1], corners[0, 1]
    for i in range(1, len(corners)):
        low, high = min(low, corners[i, 1]), max(high, corners[i, 1])
    return max(0, math.ceil(low - 0.5)), min(height, math.ceil(high - 0.5))


@compiled
def column_range(corners, row, width):
    """First and end of the columns of one row whose centres lie in a convex polygon."""
    y = row + 0.5
    left, right = 1e9, -1e9
    x1, y1 = corners[-1, 0], corners[-1, 1]
    for i in range(len(corners)):
        x2, y2 = corners[i, 0], corners[i, 1]
        if (y1 <= y) != (y2 <= y):  # this side crosses the row
            x = x1 + (y - y1) / (y2 - y1) * (x2 - x1)
            left, right = min(left, x), max(right, x)
        x1, y1 = x2, y2
    return max(0, math.ceil(left - 0.5)), min(width, math.ceil(right - 0.5))


@compiled
def fill_polygon(canvas, corners, value):
    """Set the pixels whose centres lie in a convex polygon, float64 (n, 2): x and y in pixels."""
    first_row, end_row = row_range(corners, canvas.shape[0])
    for row in range(first_row, end_row):
        first, end = column_range(corners, row, canvas.shape[1])
        for column in range(first, end):
            canvas[row, column] = value


@compiled
def visit(ground, car, tile):
    """Give a tile that the car has touched the first shade of the road, as Gymnasium does.

    Args:
        tile: float64 (4, 2), its corners in world units.
    """
    texels = ground.texels[car]
    corners = tile * SCALE + ORIGIN
    first_row, end_row = row_range(corners, SIZE)
    for row in range(first_row, end_row):
        first, end = column_range(corners, row, SIZE)
        for column in range(first, end):
            texel = texels[row, column]
            if texel & KIND == ROAD:  # not the kerbs of the neighbours
                texels[row, column] = texel & ~(KIND_AND_SHADE ^ KIND)


@compiled
def mark_edges(texels, touched):
    """Set the flags EDGE and NEAR in the touched cells and between them."""
    around = np.zeros(SIZE, np.uint8)
    for i in range(CELLS):
        first, end = touched_columns(touched[i])
        for row in range(i * CELL, min(i * CELL + CELL, SIZE - 1) if first < end else 0):
            mark_edge_row(texels[row, first : end + 1], texels[row + 1, first : end + 1])
    for i in range(CELLS):
        first, end = touched_columns(touched[i])
        for row in range(max(1, i * CELL), min(i * CELL + CELL, SIZE - 1) if first < end else 0):
            rows = texels[row - 1 : row + 2, first : end + 1]
            mark_near_row(rows[0], rows[1], rows[2], around)


@compiled
def touched_columns(touched):
    """First texel and end of the touched cells in a row of cells, bool (CELLS,)."""
    first, end = SIZE, 0
    for j in range(CELLS):
        if touched[j]:
            first, end = min(first, j * CELL), j * CELL + CELL
    return first, min(end, SIZE - 1)


@compiled
def mark_edge_row(line, above):
    """EDGE: do the four texels from here to the right and up differ in kind?

    Args:
        line: uint8 (n + 1,), of which the first n are marked; `above`: the same of the next row.
    """
    for x in range(len(line) - 1):
        here = line[x]
        different = (here ^ line[x + 1]) | (here ^ above[x]) | (here ^ above[x + 1])
        flag = np.uint8(EDGE) if np.uint8(different & KIND) else np.uint8(0)
        line[x] = (here & ~EDGE) | flag


@compiled
def mark_near_row(below, line, above, around):
    """NEAR: is there an EDGE among the 3 x 3 texels around this one?

    Args:
        below, line, above: uint8 (n + 1,), three rows, of which the middle one is marked.
        around: uint8 (at least n + 1,), to work with.
    """
    for x in range(len(line)):
        around[x] = (below[x] | line[x] | above[x]) & EDGE
    for x in range(1, len(line) - 1):
        line[x] |= np.uint8(around[x - 1] | around[x] | around[x + 1]) >> 1


@compiled
def shrink(ground, car, changed):
    """Average the texels of the changed cells, bool (CELLS, CELLS), down to the smaller copies."""
    texels, palette = ground.texels[car], ground.palette[car]
    quarter, eighth, sixteenth = ground.quarter[car], ground.eighth[car], ground.sixteenth[car]
    for i in range(CELLS):
        for j in range(CELLS):
            if changed[i, j]:
                for row in range(4 * i, 4 * i + 4):
                    for column in range(4 * j, 4 * j + 4):
                        quarter[row, column] = average_16(texels, palette, 4 * row, 4 * column)
                for row in range(2 * i, 2 * i + 2):
                    for column in range(2 * j, 2 * j + 2):
                        eighth[row, column] = average_4(quarter, 2 * row, 2 * column)
                sixteenth[i, j] = average_4(eighth, 2 * i, 2 * j)


@compiled
def average_16(texels, palette, row, column):
    """Mean colour of 4 x 4 texels, uint32."""
    if not texels[row + 1, column + 1] & NEAR:  # all of one kind
        return to_bytes(palette[texels[row, column]])
    total = np.uint64(0)
    for y in range(row, row + 4):
        for x in range(column, column + 4):
            total += palette[texels[y, x]]
    return to_bytes((total >> np.uint64(4)) & LANES)


@compiled
def average_4(colors, row, column):
    """Mean colour of 2 x 2 colours, uint32."""
    total = to_lanes(colors[row, column]) + to_lanes(colors[row, column + 1])
    total += to_lanes(colors[row + 1, column]) + to_lanes(colors[row + 1, column + 1])
    return to_bytes((total >> np.uint64(2)) & LANES)


@compiled
def to_bytes(color):
    """A colour in 16-bit lanes, uint64, to one in bytes, uint32: red is lowest."""
    red, green = color & np.uint64(0xFF), (color >> np.uint64(8)) & np.uint64(0xFF00)
    return np.uint32(red | green | (color >> np.uint64(16)) & np.uint64(0xFF0000))


@compiled
def to_lanes(color):
    """A colour in bytes, uint32, to one in 16-bit lanes, uint64."""
    wide = np.uint64(color)
    red, green = wide & np.uint64(0xFF), (wide & np.uint64(0xFF00)) << np.uint64(8)
    return red | green | (wide & np.uint64(0xFF0000)) << np.uint64(16)


# The warp


@compiled
def camera_zoom(time):
    """Window pixels per world unit, `time` seconds after the start: the first second zooms in."""
    return 0.1 * reference.SCALE * max(1 - time, 0) + reference.ZOOM * reference.SCALE * min(time, 1)


@compiled
def look(out, ground, car, pose, zoom, pixel, corner):
    """Draw what the camera sees of the ground.

    Args:
        out: uint8 (rows, columns, 3), the picture or a part of it.
        pose: x, y and angle of the hull, which stands in the middle of the window, 600 window
            pixels below its upper edge; the camera turns with it.
        zoom: window pixels per world unit.
        pixel: width and height of a pixel of the picture, in window pixels.
        corner: row and column of the picture at which `out` begins.
    """
    x, y, angle = pose
    step_x, step_y = pixel[0] / zoom, pixel[1] / zoom  # world units from one pixel to the next
    # From the hull to the centre of the first pixel, in the camera's axes: right and up.
    right = (corner[1] + 0.5) * step_x - 0.5 * WINDOW_W / zoom
    up = 0.75 * WINDOW_H / zoom - (corner[0] + 0.5) * step_y
    covered = step_x * SCALE  # texels to a pixel
    shrunk = 1 if covered < 2 * SHARP else 4 if covered < 4 * SHARP else 8 if covered < 8 * SHARP else 16
    scale = SCALE / shrunk
    cos, sin = math.cos(angle) * scale, math.sin(angle) * scale
    start_x = x * scale + ORIGIN / shrunk + cos * right - sin * up
    start_y = y * scale + ORIGIN / shrunk + sin * right + cos * up
    # Texels are numbered by their centres, hence - 0.5; 1/32 rounds the weights of the interpolation.
    start = to_fixed(start_x - 0.5 + 1 / 32), to_fixed(start_y - 0.5 + 1 / 32)
    across = to_fixed(cos * step_x), to_fixed(sin * step_x)  # from one column to the next
    down = to_fixed(sin * step_y), to_fixed(-cos * step_y)  # from one row to the next
    if shrunk == 1:
        fine = covered < SHARP
        warp_texels(out, ground, car, start, across, down, fine)
    elif shrunk == 4:
        warp_colors(out, ground.quarter[car], start, across, down)
    elif shrunk == 8:
        warp_colors(out, ground.eighth[car], start, across, down)
    else:
        warp_colors(out, ground.sixteenth[car], start, across, down)


@compiled
def to_fixed(position):
    """A position or step in texels as a fixed-point number, int64."""
    return int(math.floor(min(max(position, -1e9), 1e9) * ONE))


@compiled
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


@compiled
def columns_on_texture(x, y, across, columns, size, margin):
    """First and end of the columns of a row that see a texture, `margin` texels from its borders.

    Args:
        x, y: fixed-point position of column 0; `across`: the steps from one column to the next.
        columns: of the row; `size`: of the texture, texels.
    """
    low, inner = margin * ONE, size - 1 - 2 * margin
    first_x, end_x = columns_inside(x - low, across[0], columns, inner)
    first_y, end_y = columns_inside(y - low, across[1], columns, inner)
    first = max(first_x, first_y)
    return first, max(first, min(end_x, end_y))


@compiled
def warp_texels(out, ground, car, start, across, down, fine):
    """Warp the full-size texture into `out`, uint8 (rows, columns, 3).

    Args:
        start: fixed-point x and y on the texture of the first pixel's centre.
        across, down: fixed-point steps to the next column and to the next row.
        fine: whether one interpolation is enough for a flagged pixel; else it takes two.
    """
    rows, columns = out.shape[0], out.shape[1]
    pixels, margin = out.reshape(-1), 0 if fine else 3
    nearest = np.empty(rows * columns, np.uint8)  # the texel of each pixel
    for row in range(rows):
        x, y = start[0] + row * down[0], start[1] + row * down[1]
        first, end = columns_on_texture(x, y, across, columns, SIZE, margin)
        line = nearest[row * columns : (row + 1) * columns]
        read_texels(line, ground.texels[car].reshape(-1), x, y, across, first, end)
    write_colors(pixels, nearest, shade_tuple(ground.colors[car]))
    smooth_edges(pixels, nearest, ground, car, columns, start, across, down, fine)


@compiled
def read_texels(line, texels, x, y, across, first, end):
    """Read the texels under the columns of a row; those before `first` and from `end` on are black.

    Args:
        line: uint8 (columns,), to write.
        texels: uint8 (SIZE * SIZE,).
        x, y: fixed-point position of column 0.
    """
    line[:first] = OUTSIDE
    line[end:] = OUTSIDE
    x += first * across[0]
    y += first * across[1]
    for column in range(first, end):
        line[np.uint64(column)] = texels[np.uint64((y >> FRACTION) * SIZE + (x >> FRACTION))]
        x += across[0]
        y += across[1]


@compiled
def write_colors(pixels, nearest, shades):
    """Turn texels, uint8 (n,), into colours, uint8 (3 n,): red, green, blue, red, ..."""
    for i in range(len(nearest)):
        color = color_of(np.uint8(nearest[i] & KIND_AND_SHADE), shades)
        place = np.uint64(3 * i)
        pixels[place] = color[0]
        pixels[place + np.uint64(1)] = color[1]
        pixels[place + np.uint64(2)] = color[2]


@compiled
def find_flagged(found, nearest, flag):
    """List the pixels whose texel has a flag; returns how many there are.

    Most have none, so we look at eight at a time, as one 64-bit number. Where there is one, every
    pixel of the eight is written to the list, but the list grows by the flagged ones only: so there
    is no jump for a processor to predict wrongly.

    Args:
        found: uint16 (n + 8,), to write.
        nearest: uint8 (n,), the texels; n is a multiple of 8.
    """
    eights, count = nearest.view(np.uint64), np.uint64(0)
    eight_flags = np.uint64(flag) * np.uint64(0x0101010101010101)
    for eight in range(len(eights)):
        if eights[eight] & eight_flags:
            for i in range(8 * eight, 8 * eight + 8):
                found[count] = i
                count += np.uint64((nearest[np.uint64(i)] & flag) != 0)
    return count


@compiled
def smooth_edges(pixels, nearest, ground, car, columns, start, across, down, fine):
    """Interpolate the pixels whose texels are flagged; arguments as in `warp_texels`."""
    texels, palette = ground.texels[car].reshape(-1), ground.palette[car]
    found = np.empty(len(nearest) + 8, np.uint16)
    for i in range(find_flagged(found, nearest, EDGE if fine else NEAR)):
        pixel = np.uint32(found[i])
        row = np.int64(np.uint32(pixel // np.uint32(columns)))
        column = np.int64(pixel) - row * columns
        x = start[0] + row * down[0] + column * across[0]
        y = start[1] + row * down[1] + column * across[1]
        if fine:
            color = interpolate(texels, palette, x, y)
        else:
            color = interpolate_2(texels, palette, x, y, across)
        write(pixels, np.uint64(3) * np.uint64(pixel), color)


@compiled
def shade_tuple(colors):
    """The colours, uint8 (COLORS, 3), as nested tuples, which a compiler may keep in registers."""
    return (
        (colors[0, 0], colors[0, 1], colors[0, 2]),
        (colors[1, 0], colors[1, 1], colors[1, 2]),
        (colors[2, 0], colors[2, 1], colors[2, 2]),
        (colors[3, 0], colors[3, 1], colors[3, 2]),
        (colors[4, 0], colors[4, 1], colors[4, 2]),
        (colors[5, 0], colors[5, 1], colors[5, 2]),
        (colors[6, 0], colors[6, 1], colors[6, 2]),
        (colors[7, 0], colors[7, 1], colors[7, 2]),
    )


@compiled
def color_of(texel, shades):
    """Red, green and blue of a texel without its flags; selections, no jumps and no table."""
    color = shades[0]
    if texel == GRASS:
        color = shades[1]
    if texel == ROAD:
        color = shades[2]
    if texel == ROAD + 1:
        color = shades[3]
    if texel == ROAD + 2:
        color = shades[4]
    if texel == WHITE:
        color = shades[5]
    if texel == RED:
        color = shades[6]
    if texel == OUTSIDE:
        color = shades[7]
    return color


@compiled
def weights(x, y):
    """How far a fixed-point position is beyond the texel to its left and below, in 16ths."""
    return np.uint64((x >> (FRACTION - 4)) & 15), np.uint64((y >> (FRACTION - 4)) & 15)


@compiled
def interpolate(texels, palette, x, y):
    """Bilinear interpolation of four texels: 256 times the colour, in 16-bit lanes."""
    right, up = weights(x, y)
    left, down = np.uint64(16) - right, np.uint64(16) - up
    here = np.uint64((y >> FRACTION) * SIZE + (x >> FRACTION))
    above = here + np.uint64(SIZE)
    one = np.uint64(1)
    lower = palette[texels[here]] * left + palette[texels[here + one]] * right
    upper = palette[texels[above]] * left + palette[texels[above + one]] * right
    return lower * down + upper * up + HALF


@compiled
def interpolate_2(texels, palette, x, y, across):
    """Mean of two interpolations, a quarter of a pixel to the left and to the right."""
    shift_x, shift_y = across[0] >> 2, across[1] >> 2
    left = interpolate(texels, palette, x - shift_x, y - shift_y)
    right = interpolate(texels, palette, x + shift_x, y + shift_y)
    return ((left >> np.uint64(1)) & HALVES) + ((right >> np.uint64(1)) & HALVES)


@compiled
def warp_colors(out, colors, start, across, down):
    """Warp a smaller copy of the texture, uint32 (n, n), with interpolation at every pixel."""
    rows, columns = out.shape[0], out.shape[1]
    pixels, size = out.reshape(-1), len(colors)
    pixels[:] = 0
    for row in range(rows):
        x, y = start[0] + row * down[0], start[1] + row * down[1]
        first, end = columns_on_texture(x, y, across, columns, size, 0)
        for column in range(first, end):
            here = x + column * across[0], y + column * across[1]
            color = interpolate_colors(colors, here[0], here[1])
            write(pixels, np.uint64(3 * (row * columns + column)), color)


@compiled
def interpolate_colors(colors, x, y):
    """As `interpolate`, of a smaller copy of the texture."""
    right, up = weights(x, y)
    left, down = np.uint64(16) - right, np.uint64(16) - up
    row, column, one = np.uint64(y >> FRACTION), np.uint64(x >> FRACTION), np.uint64(1)
    lower = to_lanes(colors[row, column]) * left + to_lanes(colors[row, column + one]) * right
    row += one
    upper = to_lanes(colors[row, column]) * left + to_lanes(colors[row, column + one]) * right
    return lower * down + upper * up + HALF


@compiled
def write(pixels, place, color):
    """Write 256 times a colour, in 16-bit lanes, to three bytes from `place` on."""
    pixels[place] = (color >> np.uint64(8)) & np.uint64(255)
    pixels[place + np.uint64(1)] = (color >> np.uint64(24)) & np.uint64(255)
    pixels[place + np.uint64(2)] = (color >> np.uint64(40)) & np.uint64(255)


# The car


@compiled
def draw_car(out, pictures, wheels, zoom, corner):
    """Blend the car over a part of the observation.

    Args:
        out: uint8 (rows, columns, 3).
        pictures: the Pictures.
        wheels: float64 (4, 3), for each wheel its angle to the hull, its rotation (both radians) and
            its speed of rotation.
        zoom: window pixels per world unit.
        corner: row and column of the observation at which `out` begins.
    """
    quarter = np.empty((QUARTER_ROWS, QUARTER_COLUMNS, 4), np.uint8)
    for place in range(4):
        turn = min(max(round(wheels[place, 0] * TURN_STEPS), -MAX_TURN), MAX_TURN)
        phase = int(math.floor(wheels[place, 1] * PHASE_STEPS / math.tau)) % PHASE_STEPS
        top = HULL_ROW - corner[0] - (QUARTER_ROWS if place < 2 else 0)
        left = HULL_COLUMN - corner[1] - (QUARTER_COLUMNS if place % 2 == 0 else 0)
        area = out[top : top + QUARTER_ROWS, left : left + QUARTER_COLUMNS]
        if zoom == FULL_ZOOM:
            blend(area, pictures.car[place, turn + MAX_TURN, phase])
        else:  # in the opening second
            draw_quarter(quarter, place, turn, phase, zoom)
            blend(area, quarter)


@compiled
def blend(area, quarter):
    """Blend a quarter of the car, uint8 (6, 4, 4), over a part of the picture, uint8 (6, 4, 3)."""
    for row in range(QUARTER_ROWS):
        for column in range(QUARTER_COLUMNS):
            free = 255 - np.int64(quarter[row, column, 3])
            for channel in range(3):
                ground = (area[row, column, channel] * free + 127) // 255
                area[row, column, channel] = ground + quarter[row, column, channel]


@compiled
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
    corner = CANVAS_COLUMNS * (place % 2 == 0), CANVAS_ROWS * (place < 2)
    cos, sin = math.cos(turn / TURN_STEPS), math.sin(turn / TURN_STEPS)
    low, high = wheel_stripe((phase + 0.5) * math.tau / PHASE_STEPS)
    rectangle = np.empty((4, 2))
    for shape, bottom, top in ((TYRE, -1.0, 1.0), (STRIPE, low, high)):
        if bottom <= top:
            for i in range(4):
                x = WHEEL_HALF_WIDTH if 0 < i < 3 else -WHEEL_HALF_WIDTH
                y = WHEEL_RADIUS * (top if i < 2 else bottom)
                rectangle[i, 0] = cos * x - sin * y + WHEEL_PLACES[place, 0]
                rectangle[i, 1] = sin * x + cos * y + WHEEL_PLACES[place, 1]
            fill_shape(canvas, rectangle, shape, zoom, corner)
    for polygon in HULL_POLYGONS:
        fill_shape(canvas, polygon, HULL, zoom, corner)
    average_quarter(quarter, canvas, corner)


@compiled
def fill_shape(canvas, polygon, shape, zoom, corner):
    """Fill a part of the car as pygame does: its corners are whole pixels, its edges belong to it.

    Args:
        canvas: uint8 (CANVAS_ROWS, CANVAS_COLUMNS), a quarter of the car in window pixels.
        polygon: float64 (n, 2), world units from the hull's origin.
        shape: TYRE, STRIPE or HULL.
        zoom: window pixels per world unit.
        corner: column and row of the canvas where the hull's origin lies.
    """
    corners = np.empty(polygon.shape)
    middle_x, middle_y = polygon[:, 0].mean(), polygon[:, 1].mean()
    for i in range(len(polygon)):
        x, y = polygon[i, 0], polygon[i, 1]
        # To the pixel's centre, and a little outward, so that `fill_polygon` takes that pixel.
        corners[i, 0] = corner[0] + math.floor(x * zoom) + 0.5 + (TINY if x > middle_x else -TINY)
        corners[i, 1] = corner[1] - math.floor(y * zoom) - 0.5 - (TINY if y > middle_y else -TINY)
    fill_polygon(canvas, corners, shape)


@compiled
def average_quarter(quarter, canvas, corner):
    """Average the shapes on a canvas to a picture, uint8 (6, 4, 4)."""
    # The edge of the canvas is the edge of the picture where the hull's origin lies.
    shift_x = CANVAS_COLUMNS - QUARTER_COLUMNS * PIXEL_W if corner[0] else 0.0
    shift_y = CANVAS_ROWS - QUARTER_ROWS * PIXEL_H if corner[1] else 0.0
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
                        red += area * CAR_COLORS[shape, 0]
                        green += area * CAR_COLORS[shape, 1]
            quarter[row, column, 0] = int(red)
            quarter[row, column, 1] = int(green)
            quarter[row, column, 2] = int(green)
            quarter[row, column, 3] = int(255 * covered + 0.5)


@compiled
def wheel_stripe(phase):
    """The light stripe on a turning wheel: its ends along the wheel, in radii; (1, -1) if hidden."""
    sin1, sin2 = math.sin(phase), math.sin(phase + 1.2)
    cos1, cos2 = math.cos(phase), math.cos(phase + 1.2)
    if sin1 > 0 and sin2 > 0:
        return 1.0, -1.0
    if sin1 > 0:
        cos1 = math.copysign(1.0, cos1)
    if sin2 > 0:
        cos2 = math.copysign(1.0, cos2)
    return min(cos1, cos2), max(cos1, cos2)


@compiled
def average_patch(frame, patch, rows, columns):
    """Average observation pixels around the car to the pixels of the agent's frame.

    Args:
        frame: uint8 (rows, 64, 3), to write where the car is.
        patch: uint8 (PATCH_ROWS, PATCH_COLUMNS, 3), pixels of the observation from PATCH_CORNER on.
        rows, columns: how many observation pixels a frame pixel is high and wide.
    """
    first_row, end_row = int(CAR_TOP / rows), math.ceil(CAR_BOTTOM / rows)
    first_column, end_column = int(CAR_LEFT / columns), math.ceil(CAR_RIGHT / columns)
    for row in range(first_row, end_row):
        top = row * rows - PATCH_CORNER[0]
        for column in range(first_column, end_column):
            left = column * columns - PATCH_CORNER[1]
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


@compiled
def draw_bar(out, score, speed, spin, wheels, reward):
    """Draw the score and the seven indicators over the lower edge of a picture.

    Args:
        out: uint8 (rows, columns, 3), an observation or a frame with its indicator bar.
        score: uint8 (n, rows of the bar, columns), the pictures of the score.
        speed: of the hull, world units per second; `spin`: its angular velocity, radians per second.
        wheels: float64 (4, 3), angle to the hull, rotation and speed of rotation of each wheel.
        reward: so far.
    """
    picture = score[score_index(reward)]
    top = len(out) - len(picture)
    out[top:] = 0
    for row in range(len(picture)):
        for column in range(picture.shape[1]):
            out[top + row, column] = picture[row, column]
    draw_upright(out, 5, 0.02 * speed, speed, (253, 253, 253))
    for place, blue_red in ((0, 0), (1, 0), (2, 49), (3, 49)):
        omega = wheels[place, 2]
        draw_upright(out, 7 + place, 0.01 * omega, omega, (blue_red, 0, 253))
    draw_level(out, 20, -10.0 * wheels[0, 0], wheels[0, 0], (0, 253, 0))
    draw_level(out, 30, -0.8 * spin, spin, (253, 0, 0))


@compiled
def score_index(reward):
    """Where the table of scores has the picture of a reward."""
    score = round(min(max(reward, float(MIN_SCORE)), float(MAX_SCORE)))
    if score == 0 and (reward < 0 or math.copysign(1.0, reward) < 0):
        return MINUS_ZERO  # Python prints "-000"
    return int(score) - MIN_SCORE


@compiled
def draw_upright(out, place, length, value, color):
    """A vertical indicator: `place` in fortieths of the width, `length` in fortieths of the height."""
    if abs(value) > 1e-4:
        unit, end = WINDOW_W / 40, WINDOW_H - WINDOW_H / 40
        top = math.trunc(end - length * WINDOW_H / 40)
        draw_rectangle(out, place * unit, (place + 1) * unit, top, end, color)


@compiled
def draw_level(out, place, length, value, color):
    """A horizontal indicator: `place` and `length` in fortieths of the width."""
    if abs(value) > 1e-4:
        end = math.trunc((place + length) * WINDOW_W / 40)
        begin, unit = place * WINDOW_W / 40, WINDOW_H / 40
        draw_rectangle(out, begin, end, WINDOW_H - 4 * unit, WINDOW_H - 2 * unit, color)


@compiled
def draw_rectangle(out, x1, x2, y1, y2, color):
    """Blend an upright rectangle over a picture.

    Args:
        out: uint8 (rows, columns, 3).
        x1, x2, y1, y2: the outermost window pixels, in any order; all of them are filled.
        color: red, green, blue.
    """
    width, height = out.shape[1] / WINDOW_W, out.shape[0] / WINDOW_H
    left, right = min(x1, x2) * width, (max(x1, x2) + 1) * width
    top, bottom = min(y1, y2) * height, (max(y1, y2) + 1) * height
    for row in range(max(0, int(top)), min(out.shape[0], math.ceil(bottom))):
        rows = min(bottom, row + 1.0) - max(top, float(row))
        for column in range(max(0, int(left)), min(out.shape[1], math.ceil(right))):
            cover = rows * (min(right, column + 1.0) - max(left, float(column)))
            for channel in range(3):
                old = out[row, column, channel]
                out[row, column, channel] = int(old + cover * (color[channel] - old) + 0.5)


# Whole pictures


@compiled
def draw_observation(out, ground, pictures, car, hull, wheels, reward, time):
    """Draw the full observation.

    Args:
        out: uint8 (96, 96, 3), to write.
        ground: the Ground, painted, of which this is number `car`.
        pictures: from `make_pictures`.
        hull: float64 (5,): x and y (world units), angle (radians), speed (world units per second),
            angular velocity (radians per second).
        wheels: float64 (4, 3), for each wheel its angle to the hull, its rotation (radians) and its
            speed of rotation (radians per second).
        reward: so far in the episode.
        time: since its start, seconds.
    """
    zoom, corner = camera_zoom(time), (0, 0)
    pixel = WINDOW_W / OBSERVATION_SIZE, WINDOW_H / OBSERVATION_SIZE
    view = out[:BAR_TOP]
    look(view, ground, car, (hull[0], hull[1], hull[2]), zoom, pixel, corner)
    draw_car(view, pictures, wheels, zoom, corner)
    draw_bar(out, pictures.score, hull[3], hull[4], wheels, reward)


@compiled
def draw_frame(out, ground, pictures, car, hull, wheels, reward, time, crop_bar):
    """Draw the agent's frame, as if prepared from the observation.

    Args:
        out: uint8 (64, 64, 3), to write.
        crop_bar: whether to leave out the indicator bar and to stretch the rest.
        ground, pictures, car, hull, wheels, reward, time: as for `draw_observation`.
    """
    zoom = camera_zoom(time)
    pose = hull[0], hull[1], hull[2]
    rows = BAR_TOP / FRAME_SIZE if crop_bar else OBSERVATION_SIZE / FRAME_SIZE
    pixel = WINDOW_W / FRAME_SIZE, WINDOW_H / OBSERVATION_SIZE * rows
    view = out if crop_bar else out[: FRAME_SIZE * BAR_TOP // OBSERVATION_SIZE]
    look(view, ground, car, pose, zoom, pixel, (0, 0))
    # The car is so small that we draw the observation around it and average its pixels.
    near = np.empty((PATCH_ROWS, PATCH_COLUMNS, 3), np.uint8)
    small = WINDOW_W / OBSERVATION_SIZE, WINDOW_H / OBSERVATION_SIZE
    look(near, ground, car, pose, zoom, small, PATCH_CORNER)
    draw_car(near, pictures, wheels, zoom, PATCH_CORNER)
    average_patch(view, near, rows, OBSERVATION_SIZE / FRAME_SIZE)
    if not crop_bar:
        draw_bar(out, pictures.small_score, hull[3], hull[4], wheels, reward)


# Tables, made once


class Pictures(NamedTuple):
    """Small pictures that many frames share; nobody writes to them.

    Attributes:
        car: uint8 (4, turns, phases, 6, 4, 4), quarters of the car as `draw_quarter` makes them.
        score: uint8 (n, 12, 12), every score in white on black, in the size of the observation.
        small_score: uint8 (n, 8, 8), in the size of the agent's frame.
    """

    car: np.ndarray
    score: np.ndarray
    small_score: np.ndarray


_making = threading.Lock()  # pygame's fonts are not made for threads


def make_pictures() -> Pictures:
    """The small pictures; made at the first call, which takes a moment, and shared afterwards."""
    with _making:
        return _make_pictures()


@functools.cache
def _make_pictures() -> Pictures:
    scores = [f"{score:04d}" for score in range(MIN_SCORE, MAX_SCORE + 1)] + ["-000"]
    pygame.font.init()
    font = pygame.font.Font(pygame.font.get_default_font(), 42)
    score = np.stack([score_picture(font, text) for text in scores])
    pairs = score.repeat(2, axis=1).repeat(2, axis=2)  # three halves of a pixel make one of a frame
    small = pairs.reshape(len(score), 8, 3, 8, 3).mean(axis=(2, 4)).round().astype(np.uint8)
    pictures = Pictures(car_pictures(), score, small)
    for table in pictures:
        table.flags.writeable = False
    return pictures


def score_picture(font: pygame.font.Font, text: str) -> np.ndarray:
    """The score as the left end of the indicator bar shows it, uint8 (12, 12)."""
    rows = OBSERVATION_SIZE - BAR_TOP
    size = round(SCORE_COLUMNS * WINDOW_W / OBSERVATION_SIZE), round(rows * WINDOW_H / OBSERVATION_SIZE)
    surface = pygame.Surface(size, depth=24)  # no alpha, as Gymnasium's window
    label = font.render(text, True, (255, 255, 255), (0, 0, 0))
    surface.blit(label, label.get_rect(center=(60, WINDOW_H * 2.5 / 40)))
    small = pygame.transform.smoothscale(surface, (SCORE_COLUMNS, rows))
    return pygame.surfarray.array3d(small)[:, :, 0].T


@compiled
def car_pictures():
    """All quarters of the car in full zoom."""
    shape = (4, 2 * MAX_TURN + 1, PHASE_STEPS, QUARTER_ROWS, QUARTER_COLUMNS, 4)
    car = np.empty(shape, np.uint8)
    for place in range(4):
        for turn in range(-MAX_TURN, MAX_TURN + 1):
            for phase in range(PHASE_STEPS):
                draw_quarter(car[place, turn + MAX_TURN, phase], place, turn, phase, FULL_ZOOM)
    return car
