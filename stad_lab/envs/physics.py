"""The physics of the car, compiled with Numba: a frame of CarRacing-v3 without its picture.

The car is five rigid bodies in the plane, the hull and four wheels. A revolute joint holds each
wheel to the hull: it keeps two points together, and lets the wheel turn against the hull between
two stops. A motor in the joint steers. There is no gravity and nothing collides; road tiles only
report that they are touched. One frame goes in this order.

1. `drive_wheels`: throttle, brakes and steering act, and each tyre pushes its wheel. The tyre's
   force grows with the difference between the speed of the ground and that of the tread, up to a
   limit that depends on the ground. These are the equations of Gymnasium's `Car.step`, in float64.
2. `touch_tiles`: which tiles does the car touch? New ones are rewarded.
3. `solve`: one time step of rigid-body dynamics, in float32.
   - Forces change velocities (`apply_forces`).
   - The joints correct the velocities by impulses (`solve_velocities`).
   - Velocities change positions (`move`).
   - The joints correct the small errors that are left in the positions (`solve_positions`).
4. `score`: the reward of the frame, and whether the episode ends.

**What a revolute joint solves.** Let r_A and r_B lead from the centres of two bodies to the joint.
The two points at the joint should move alike, so the velocity error

    e = v_B + w_B x r_B - v_A - w_A x r_A

should be zero. An impulse p on B and -p on A, both at the joint, changes e by K p, where the 2 x 2
matrix K depends on the masses, the moments of inertia, r_A and r_B. So p = -K^-1 e repairs this
joint at once. At a stop, the difference of the spins is a third component of e, and K is a 3 x 3
matrix; a stop may only push. All joints share the hull, so repairing one spoils the others a
little. Sweeping over them again and again (projected Gauss-Seidel) converges to impulses that
satisfy all. The impulses of the last frame are applied first (warm starting), so little is left to
correct.

**Why sweeps may stop early.** Gymnasium asks for 180 sweeps in each frame. What a sweep does
depends on the velocities and on the accumulated impulses of motors and stops: 23 numbers. In most
frames rounding soon brings them to a fixed point or a short cycle, and all further sweeps repeat
it. The accumulated impulses of the points are not read by the sweeps, only added to. So we
find the cycle, add its impulses as often as they would have been added, and leave out the sweeps.
The result is the same to the last bit.

**Equality with Box2D.** The method, its constants and the order of all float32 operations are those
of Box2D 2.3 (Erin Catto, https://box2d.org), the library behind Gymnasium. The code is our own. On
Linux x86-64 all bodies agree to the last bit, as `tests/envs/test_physics.py` shows. On other
processors a compiler may fuse a product and a sum into one rounding, and another C library may
round `sin` differently. There, trajectories agree at first and drift apart as rounding errors grow.

A car is one record of the NumPy dtype `CAR`, and the tiles around it are one record of `ROAD`. A
batch of cars is two arrays, and copying them copies the whole state. All compiled functions are in
this file, since Numba's cache does not notice when a function in another file changes.
"""

import math

import numpy as np

from stad_lab.envs.compiling import compiled
from stad_lab.envs.track import MAX_TILES

f32 = np.float32

# --- Gymnasium's car: sizes in world units, float64 -----------------------------------------------

SIZE = 0.02  # Gymnasium's unit of length for the car
FRAME = 1.0 / 50  # seconds
ENGINE_POWER = 100000000 * SIZE * SIZE
WHEEL_INERTIA = 4000 * SIZE * SIZE  # of a wheel about its axle
FRICTION_LIMIT = 1000000 * SIZE * SIZE  # the largest force of a tyre on the road
GRASS_FRICTION_LIMIT = FRICTION_LIMIT * 0.6
TYRE_STIFFNESS = 205000  # force per difference of speed, before `SIZE` is applied twice
BRAKE_FORCE = 15  # radians per second that a full brake takes off a wheel in one frame
WHEEL_RADIUS = 27 * SIZE
WHEEL_HALF_WIDTH = 14 * SIZE
PLAYFIELD = 2000 / 6.0  # world units; an episode ends beyond

WHEEL_PLACES = [(-55, 80), (55, 80), (-55, -82), (55, -82)]  # left, right front; left, right rear
HULL_POLYGONS = [
    [(-60, 130), (60, 130), (60, 110), (-60, 110)],
    [(-15, 120), (15, 120), (20, 20), (-20, 20)],
    [(25, 20), (50, -10), (50, -40), (20, -90), (-20, -90), (-50, -40), (-50, -10), (-25, 20)],
    [(-50, -120), (50, -120), (50, -90), (-50, -90)],
]
WHEEL_POLYGON = [(-14, 27), (14, 27), (14, -27), (-14, -27)]

# --- Box2D's constants, float32 -------------------------------------------------------------------

ZERO, HALF, ONE, TWO = f32(0), f32(0.5), f32(1), f32(2)
PI = f32(3.14159265359)
STEP = f32(FRAME)
VELOCITY_SWEEPS, POSITION_SWEEPS = 6 * 30, 2 * 30  # at most, as Gymnasium asks for
STOP = f32(0.4)  # radians, the largest steering angle
MOTOR_IMPULSE = STEP * f32(180 * 900 * SIZE * SIZE)  # the largest impulse of a motor in one step
LINEAR_SLOP = f32(0.005)  # errors of positions up to these are left alone
ANGULAR_SLOP = TWO / f32(180) * PI
MAX_TURN_BACK = f32(8) / f32(180) * PI  # radians, the largest correction at a stop
MAX_TRANSLATION = TWO  # world units in one step
MAX_ROTATION = HALF * PI  # radians in one step
REST_SPEED, REST_SPIN = f32(0.01), TWO / f32(180) * PI  # below these a body counts as at rest
TIME_TO_SLEEP = HALF  # seconds at rest until velocities are set to zero
SKIN = TWO * LINEAR_SLOP  # every polygon is this much thicker than drawn
OVERLAP = f32(10) * np.finfo(f32).eps  # at a smaller distance of their skins, polygons touch
SHORTEST = np.finfo(f32).eps * np.finfo(f32).eps  # square of the shortest vector with a direction
GJK_STEPS = 20

# Ours: bounds that are far wider than any rounding error, so that no answer depends on them.
REACH = f32(4)  # world units from the hull's origin; no part of the car is further away
CLEAR_GAP = f32(0.03)  # at a larger distance, polygons do not touch; two skins are 0.02

# --- Records --------------------------------------------------------------------------------------

BODIES, WHEELS = 5, 4  # body 0 is the hull, body 1 + i is wheel i
HULL = np.int64(0)  # a NumPy number: Numba compiles a function anew for each Python constant
DRIVING, LAP_FINISHED, LEFT_FIELD = 0, 1, 2  # values of `ending`

CAR = np.dtype(
    [
        # Rigid bodies: hull, then wheels as in WHEEL_PLACES. World units, radians, seconds.
        ("center", "f4", (BODIES, 2)),  # centre of mass
        ("angle", "f4", BODIES),
        ("velocity", "f4", (BODIES, 3)),  # of the centre of mass: x, y, and spin
        ("position", "f4", (BODIES, 2)),  # origin of the body's own coordinates
        ("rotation", "f4", (BODIES, 2)),  # cosine and sine of `angle`
        ("force", "f4", (BODIES, 2)),
        ("rest", "f4", BODIES),  # seconds at rest
        # Joints, one per wheel.
        ("push", "f4", (WHEELS, 2)),  # accumulated impulse of the point, x and y
        ("motor", "f4", WHEELS),  # accumulated impulse of the motor
        ("stop", "f4", WHEELS),  # accumulated impulse of the stop
        ("at_stop", "i4", WHEELS),  # -1 at the lower stop, 1 at the upper, else 0
        ("motor_speed", "f4", WHEELS),  # radians per second
        # Wheels as Gymnasium's `Car` sees them.
        ("steer", "f8", WHEELS),
        ("gas", "f8", WHEELS),
        ("brake", "f8", WHEELS),
        ("omega", "f8", WHEELS),  # rotation about the axle, radians per second
        ("phase", "f8", WHEELS),  # angle about the axle, radians
        ("on_road", "u1", WHEELS),  # whether the wheel touches a tile
        # The episode.
        ("time", "f8"),  # seconds
        ("reward", "f8"),  # so far
        ("previous_reward", "f8"),
        ("tiles_visited", "i4"),
        ("frames", "i4"),
        ("lap_complete", "f8"),  # Gymnasium's `lap_complete_percent`
        ("new_lap", "u1"),
        ("ending", "u1"),  # DRIVING, LAP_FINISHED or LEFT_FIELD
    ],
    align=True,
)

ROAD = np.dtype(
    [
        ("tiles", "i4"),  # how many there are
        ("corners", "f4", (MAX_TILES, 4, 2)),  # counter-clockwise
        ("corner_count", "u1", MAX_TILES),  # 4; less if Box2D drops collinear corners
        ("box", "f4", (MAX_TILES, 4)),  # bounds: lowest x, lowest y, highest x, highest y
        ("edges", "f4", (MAX_TILES, 4, 3)),  # outward unit normal (x, y), its product with a corner
        ("visited", "u1", MAX_TILES),  # whether a wheel has touched the tile
        ("darkened", "u1", MAX_TILES),  # whether anything of the car has: it then changes colour
    ],
    align=True,
)


# --- Shapes and masses ----------------------------------------------------------------------------


@compiled
def convex_hull(points, hull):
    """Wrap points as Box2D does: from the rightmost one, counter-clockwise, without collinear ones.

    Args:
        points: float32 (n, 2).
        hull: float32 (n, 2), is written.

    Returns:
        how many corners the hull has.
    """
    start = 0
    for i in range(1, len(points)):
        x, y = points[i, 0], points[i, 1]
        if x > points[start, 0] or (x == points[start, 0] and y < points[start, 1]):
            start = i
    count, corner = 0, start
    while True:
        hull[count, 0], hull[count, 1] = points[corner, 0], points[corner, 1]
        count += 1
        end = 0
        for i in range(1, len(points)):
            if end == corner:
                end = i
                continue
            ax, ay = points[end, 0] - points[corner, 0], points[end, 1] - points[corner, 1]
            bx, by = points[i, 0] - points[corner, 0], points[i, 1] - points[corner, 1]
            side = ax * by - ay * bx
            if side < ZERO or (side == ZERO and bx * bx + by * by > ax * ax + ay * ay):
                end = i
        corner = end
        if corner == start or count == len(points):
            return count


def make_polygon(points: list[tuple[int, int]]) -> np.ndarray:
    """A polygon of the car in world units, float32 (n, 2), counter-clockwise."""
    vertices = (np.array(points) * SIZE).astype(f32)
    hull = np.empty_like(vertices)
    return hull[: convex_hull.py_func(vertices, hull)]


def polygon_mass(polygon: np.ndarray, density: np.float32) -> tuple:
    """Mass, centre and moment of inertia about the origin, summed over triangles around the mean.

    Args:
        polygon: float32 (n, 2).
        density: mass per area.
    """
    third = ONE / f32(3)
    x, y = ZERO, ZERO
    for corner in polygon:
        x, y = x + corner[0], y + corner[1]
    scale = ONE / f32(len(polygon))
    x, y = x * scale, y * scale
    area, moment, center_x, center_y = ZERO, ZERO, ZERO, ZERO
    for a, b in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        ax, ay, bx, by = a[0] - x, a[1] - y, b[0] - x, b[1] - y
        cross = ax * by - ay * bx
        area += HALF * cross
        center_x += HALF * cross * third * (ax + bx)
        center_y += HALF * cross * third * (ay + by)
        squares = (ax * ax + bx * ax + bx * bx) + (ay * ay + by * ay + by * by)
        moment += (f32(0.25) * third * cross) * squares
    mass = density * area
    scale = ONE / area
    center_x, center_y = center_x * scale, center_y * scale
    far_x, far_y = center_x + x, center_y + y
    shift = (far_x * far_x + far_y * far_y) - (center_x * center_x + center_y * center_y)
    return mass, (far_x, far_y), density * moment + mass * shift


def body_mass(polygons: list[np.ndarray], density: np.float32) -> tuple:
    """Inverse mass, inverse moment of inertia about the centre, and centre (x, y) of a body."""
    mass, moment, x, y = ZERO, ZERO, ZERO, ZERO
    for polygon in reversed(polygons):  # Box2D keeps the last one first
        part, center, part_moment = polygon_mass(polygon, density)
        mass += part
        x, y = x + part * center[0], y + part * center[1]
        moment += part_moment
    inverse = ONE / mass
    x, y = x * inverse, y * inverse
    return inverse, ONE / (moment - mass * (x * x + y * y)), (x, y)


WHEEL_SHAPE = make_polygon(WHEEL_POLYGON)
HULL_SHAPES = [make_polygon(polygon) for polygon in HULL_POLYGONS]
HULL_INV_MASS, HULL_INV_INERTIA, HULL_CENTER = body_mass(HULL_SHAPES, ONE)
WHEEL_INV_MASS, WHEEL_INV_INERTIA, WHEEL_CENTER = body_mass([WHEEL_SHAPE], f32(0.1))
TURN_MASS = ONE / (HULL_INV_INERTIA + WHEEL_INV_INERTIA)  # what a motor or a stop has to turn
# From the hull's centre of mass to the joints, float32 (4, 2), in the hull's own coordinates. A
# joint sits in the centre of its wheel, so r_B is zero in all formulas, and we leave it out.
ANCHORS = (np.array(WHEEL_PLACES) * SIZE).astype(f32) - np.array(HULL_CENTER)
WHEEL_OFFSETS = np.array(WHEEL_PLACES) * SIZE  # from the hull's origin, float64 (4, 2)
CENTERS = np.array([HULL_CENTER] + [WHEEL_CENTER] * WHEELS)  # of all bodies, float32 (5, 2)
# All polygons of the car: the four of the hull, then the wheel. Rows beyond SHAPE_CORNERS are
# unused.
SHAPES = np.zeros((len(HULL_SHAPES) + 1, 8, 2), f32)
SHAPE_CORNERS = np.array([len(shape) for shape in [*HULL_SHAPES, WHEEL_SHAPE]])
for _row, _shape in zip(SHAPES, [*HULL_SHAPES, WHEEL_SHAPE], strict=True):
    _row[: len(_shape)] = _shape
WHEEL = np.int64(len(HULL_SHAPES))  # the wheel's row in SHAPES


# --- 1. Throttle, brakes, steering and tyres ------------------------------------------------------


@compiled
def control(car, steering, gas, brake):
    """Set the controls. Gas rises by at most 0.1 a frame, everything else acts at once."""
    car.steer[0] = car.steer[1] = -steering
    gas = min(max(gas, 0.0), 1.0)
    for i in range(2, 4):  # rear-wheel drive
        car.gas[i] += min(gas - car.gas[i], 0.1)
    for i in range(WHEELS):
        car.brake[i] = brake


@compiled
def drive_wheels(car):
    """Turn the controls into motor speeds of the joints, and into the force of each tyre."""
    for i in range(WHEELS):
        error = car.steer[i] - np.float64(car.angle[1 + i] - car.angle[HULL])
        car.motor_speed[i] = f32(np.sign(error) * min(50.0 * abs(error), 3.0))

        omega = car.omega[i]
        omega += FRAME * ENGINE_POWER * car.gas[i] / WHEEL_INERTIA / (abs(omega) + 5.0)
        omega = slow_down(omega, car.brake[i])
        car.phase[i] += omega * FRAME

        # The tyre's own directions; a wheel's local y axis points forward.
        cosine, sine = np.float64(car.rotation[1 + i, 0]), np.float64(car.rotation[1 + i, 1])
        vx, vy = np.float64(car.velocity[1 + i, 0]), np.float64(car.velocity[1 + i, 1])
        forward_speed = -sine * vx + cosine * vy
        side_speed = cosine * vx + sine * vy
        forward = (-forward_speed + omega * WHEEL_RADIUS) * (TYRE_STIFFNESS * SIZE * SIZE)
        side = -side_speed * (TYRE_STIFFNESS * SIZE * SIZE)
        limit = FRICTION_LIMIT if car.on_road[i] else GRASS_FRICTION_LIMIT
        force = math.sqrt(forward * forward + side * side)
        if force > limit:  # the tyre slips
            forward = forward / force * limit
            side = side / force * limit
        car.omega[i] = omega - FRAME * forward * WHEEL_RADIUS / WHEEL_INERTIA
        car.force[1 + i, 0] = f32(side * cosine + forward * -sine)
        car.force[1 + i, 1] = f32(side * sine + forward * cosine)


@compiled
def slow_down(omega, brake):
    """The rotation of a wheel after braking for one frame. From 0.9 on the brake locks it."""
    if brake >= 0.9:
        return 0.0
    if brake > 0:
        omega += -np.sign(omega) * min(BRAKE_FORCE * brake, abs(omega))
    return omega


# --- 2. Which tiles does the car touch? -----------------------------------------------------------


@compiled
def touch_tiles(car, road, simplex, corners):
    """Find the tiles under the car, before it moves, and reward those that a wheel touches first.

    A tile that any part of the car has touched is `darkened`, which only the picture shows.
    Box2D first pairs fattened bounding boxes. That never hides a touch: a box is fattened by 0.1,
    and polygons touch at a gap of 0.02. So we may choose candidates in our own way. Tiles come in
    descending order, as Box2D reports them in a new world. The order matters only where tile 0 and
    others are new in the same frame and `lap_complete` lies between their shares.

    Args:
        car, road: records, are changed.
        simplex, corners: memory for `polygons_touch`.
    """
    left, right = car.position[HULL, 0] - REACH, car.position[HULL, 0] + REACH
    low, high = car.position[HULL, 1] - REACH, car.position[HULL, 1] + REACH
    for i in range(WHEELS):
        car.on_road[i] = 0
    for tile in range(road.tiles - 1, -1, -1):
        if (
            road.box[tile, 0] > right
            or road.box[tile, 1] > high
            or road.box[tile, 2] < left
            or road.box[tile, 3] < low
        ):
            continue
        touched = False
        for i in range(WHEELS):
            if car.on_road[i] and road.visited[tile]:
                continue  # the answer would change nothing
            if wheel_touches(car, i, road, tile, simplex, corners):
                car.on_road[i] = 1
                touched = True
        if touched and not road.visited[tile]:
            road.visited[tile] = 1
            car.reward += 1000.0 / road.tiles
            car.tiles_visited += 1
            if tile == 0 and car.tiles_visited / road.tiles > car.lap_complete:
                car.new_lap = 1
        if not road.darkened[tile]:
            for shape in range(WHEEL):
                if not touched:
                    touched = polygons_touch(road, tile, car, HULL, shape, simplex, corners)
            road.darkened[tile] = touched


@compiled
def wheel_touches(car, i, road, tile, simplex, corners):
    """Whether wheel i touches a tile. Where rounding could decide, Box2D's own test is made."""
    x, y = car.position[1 + i, 0], car.position[1 + i, 1]
    cosine, sine = car.rotation[1 + i, 0], car.rotation[1 + i, 1]
    inside = True
    for edge in range(road.corner_count[tile]):
        nx, ny = road.edges[tile, edge, 0], road.edges[tile, edge, 1]
        outside = nx * x + ny * y - road.edges[tile, edge, 2]  # how far the wheel's centre is
        extent = abs(nx * cosine + ny * sine) * f32(WHEEL_HALF_WIDTH)
        extent += abs(ny * cosine - nx * sine) * f32(WHEEL_RADIUS)
        if outside > extent + CLEAR_GAP:
            return False
        inside = inside and outside < -CLEAR_GAP
    return inside or polygons_touch(road, tile, car, 1 + i, WHEEL, simplex, corners)


@compiled
def polygons_touch(road, tile, car, body, shape, simplex, corners):
    """Whether a polygon of the car and a tile touch: Box2D's test, that their skins overlap.

    The distance of two convex polygons A and B is that of the origin to the polygon of all
    differences b - a. The algorithm of Gilbert, Johnson and Keerthi (GJK) keeps a simplex of up to
    three corners of that polygon. In each step it finds the point of the simplex nearest to the
    origin, drops the corners that this point does not need, and adds the corner that lies furthest
    towards the origin. It ends when that corner is known already.

    Args:
        road, tile: record and number of polygon A.
        car, body, shape: record, body and row in SHAPES of polygon B.
        simplex: float32 (3, 7), memory. Each row is a corner: a (x, y), b (x, y), b - a (x, y), and
            its weight in the nearest point.
        corners: int64 (6, 2), memory: the numbers of a and b of each row; then those before the
            last drop.
    """
    count = np.int64(1)
    add_corner(road, tile, car, body, shape, count - 1, count - 1, simplex[0], corners[0])
    simplex[0, 6] = ONE
    for _ in range(GJK_STEPS):
        before = count
        for k in range(3):
            corners[3 + k, 0], corners[3 + k, 1] = corners[k, 0], corners[k, 1]
        if count > 1:
            count, j, k, weight_j, weight_k = nearest_point(simplex, count)
            if count == 3:
                return True  # the origin lies within the triangle
            keep_corners(simplex, corners, j, k, weight_j, weight_k)
        dx, dy = towards_origin(simplex, count)
        if dx * dx + dy * dy < SHORTEST:
            break
        a = furthest_on_tile(road, tile, -dx, -dy)
        b = furthest_on_car(car, body, shape, dx, dy)
        known = False
        for k in range(3, 3 + before):
            known = known or (corners[k, 0] == a and corners[k, 1] == b)
        if known:
            break
        add_corner(road, tile, car, body, shape, a, b, simplex[count], corners[count])
        count += 1
    return skins_overlap(simplex, count)


@compiled
def add_corner(road, tile, car, body, shape, a, b, row, numbers):
    """Write the corner b - a of the polygon of differences into a row of the simplex."""
    cosine, sine = car.rotation[body, 0], car.rotation[body, 1]
    x, y = SHAPES[shape, b, 0], SHAPES[shape, b, 1]
    row[0], row[1] = road.corners[tile, a, 0], road.corners[tile, a, 1]
    row[2] = (cosine * x - sine * y) + car.position[body, 0]
    row[3] = (sine * x + cosine * y) + car.position[body, 1]
    row[4], row[5] = row[2] - row[0], row[3] - row[1]
    numbers[0], numbers[1] = a, b


@compiled
def furthest_on_tile(road, tile, dx, dy):
    """The corner of a tile that lies furthest in a direction."""
    best = 0
    best_value = road.corners[tile, 0, 0] * dx + road.corners[tile, 0, 1] * dy
    for k in range(1, road.corner_count[tile]):
        value = road.corners[tile, k, 0] * dx + road.corners[tile, k, 1] * dy
        if value > best_value:
            best, best_value = k, value
    return best


@compiled
def furthest_on_car(car, body, shape, dx, dy):
    """The corner of a polygon of the car that lies furthest in a direction."""
    cosine, sine = car.rotation[body, 0], car.rotation[body, 1]
    own_x, own_y = cosine * dx + sine * dy, -sine * dx + cosine * dy  # in the body's coordinates
    best = 0
    best_value = SHAPES[shape, 0, 0] * own_x + SHAPES[shape, 0, 1] * own_y
    for k in range(1, SHAPE_CORNERS[shape]):
        value = SHAPES[shape, k, 0] * own_x + SHAPES[shape, k, 1] * own_y
        if value > best_value:
            best, best_value = k, value
    return best


@compiled
def towards_origin(simplex, count):
    """A direction from a point, or from an edge at right angles, to the origin."""
    if count == 1:
        return -simplex[0, 4], -simplex[0, 5]
    ex, ey = simplex[1, 4] - simplex[0, 4], simplex[1, 5] - simplex[0, 5]
    if ex * -simplex[0, 5] - ey * -simplex[0, 4] > ZERO:
        return -ey, ex
    return ey, -ex


@compiled
def cross(ax, ay, bx, by):
    """The cross product of two vectors."""
    return ax * by - ay * bx


@compiled
def along(ax, ay, bx, by):
    """The weights of a and b, up to a common factor, in the point of line ab nearest to zero."""
    ex, ey = bx - ax, by - ay
    return bx * ex + by * ey, -(ax * ex + ay * ey)


@compiled
def nearest_point(simplex, count):
    """Find the point of an edge or a triangle nearest to the origin.

    It lies at a corner, on an edge or inside; the signs of weights and areas tell which.

    Returns:
        how many corners this point needs, two corners j and k, and their weights up to a common
        factor. If it needs one only, that is j.
    """
    x0, y0, x1, y1 = simplex[0, 4], simplex[0, 5], simplex[1, 4], simplex[1, 5]
    on_01_0, on_01_1 = along(x0, y0, x1, y1)
    if count == 2:
        if on_01_1 <= ZERO:
            return 1, 0, 1, ONE, ZERO
        if on_01_0 <= ZERO:
            return 1, 1, 1, ONE, ZERO
        return 2, 0, 1, on_01_0, on_01_1
    x2, y2 = simplex[2, 4], simplex[2, 5]
    on_02_0, on_02_2 = along(x0, y0, x2, y2)
    on_12_1, on_12_2 = along(x1, y1, x2, y2)
    area = cross(x1 - x0, y1 - y0, x2 - x0, y2 - y0)
    if on_01_1 <= ZERO and on_02_2 <= ZERO:
        return 1, 0, 1, ONE, ZERO
    if on_01_0 > ZERO and on_01_1 > ZERO and area * cross(x0, y0, x1, y1) <= ZERO:
        return 2, 0, 1, on_01_0, on_01_1
    if on_02_0 > ZERO and on_02_2 > ZERO and area * cross(x2, y2, x0, y0) <= ZERO:
        return 2, 0, 2, on_02_0, on_02_2
    if on_01_0 <= ZERO and on_12_2 <= ZERO:
        return 1, 1, 1, ONE, ZERO
    if on_02_0 <= ZERO and on_12_1 <= ZERO:
        return 1, 2, 1, ONE, ZERO
    if on_12_1 > ZERO and on_12_2 > ZERO and area * cross(x1, y1, x2, y2) <= ZERO:
        return 2, 2, 1, on_12_2, on_12_1
    return 3, 0, 1, ZERO, ZERO


@compiled
def keep_corners(simplex, corners, j, k, weight_j, weight_k):
    """Move the corners j and k of the simplex to its rows 0 and 1, and store their weights."""
    scale = ONE / (weight_j + weight_k)
    for row, corner, weight in ((0, j, weight_j), (1, k, weight_k)):
        for n in range(6):
            simplex[row, n] = simplex[corner, n]
        simplex[row, 6] = weight * scale
        corners[row, 0], corners[row, 1] = corners[corner, 0], corners[corner, 1]


@compiled
def skins_overlap(simplex, count):
    """Whether the nearest points of the two polygons are closer than their skins are thick."""
    if count == 1:
        ax, ay, bx, by = simplex[0, 0], simplex[0, 1], simplex[0, 2], simplex[0, 3]
    else:
        w0, w1 = simplex[0, 6], simplex[1, 6]
        ax = w0 * simplex[0, 0] + w1 * simplex[1, 0]
        ay = w0 * simplex[0, 1] + w1 * simplex[1, 1]
        bx = w0 * simplex[0, 2] + w1 * simplex[1, 2]
        by = w0 * simplex[0, 3] + w1 * simplex[1, 3]
    distance = math.sqrt((ax - bx) * (ax - bx) + (ay - by) * (ay - by))
    return distance - (SKIN + SKIN) < OVERLAP


# --- 3. Rigid bodies ------------------------------------------------------------------------------
# In the sweeps, `state` is float32 (24,): the velocities of the five bodies (x, y, spin), one
# number that is not used, and the accumulated impulses of the four motors and of the four stops.

MOTOR, STOPPER = 16, 20  # where these impulses begin in `state`
STATE_SIZE = 24
# What a joint needs in the sweeps, in its row of `joints`: r_A, the matrix K in the plane, its
# third column, the reciprocals of the two determinants, and the product of its second and third
# column.
RX, RY, K11, K12, K22, K13, K23, SCALE2, SCALE3, NX, NY, NZ = range(12)
K33 = HULL_INV_INERTIA + WHEEL_INV_INERTIA


@compiled
def solve(car, state, saved, joints, pushes):
    """One time step: forces, joints, motion, and sleep.

    Args:
        car: record, is changed.
        state, saved: float32 (24,), memory.
        joints: float32 (4, 12), memory.
        pushes: float32 (180, 4, 2), memory.
    """
    apply_forces(car, state)
    prepare_joints(car, state, joints)
    solve_velocities(car, state, saved, joints, pushes)
    move(car, state)
    solved = False
    for _ in range(POSITION_SWEEPS):
        if solve_positions(car):
            solved = True
            break
    for body in range(BODIES):
        place_body(car, body)
    fall_asleep(car, solved)


@compiled
def apply_forces(car, state):
    """Change velocities by the forces on the wheels, and collect the numbers of the sweeps."""
    for body in range(BODIES):
        inverse = HULL_INV_MASS if body == HULL else WHEEL_INV_MASS
        for k in range(2):
            acceleration = ZERO + inverse * (ZERO + car.force[body, k])
            state[3 * body + k] = car.velocity[body, k] + STEP * acceleration
        state[3 * body + 2] = car.velocity[body, 2] + ZERO  # there is no torque
    state[15] = ZERO
    for i in range(WHEELS):
        state[MOTOR + i] = car.motor[i]
        state[STOPPER + i] = car.stop[i]


@compiled
def prepare_joints(car, state, joints):
    """Set up each joint for this step, and apply its impulses of the last frame again.

    (Box2D scales them by the ratio of time steps; here it is one.)
    """
    cosine, sine = car.rotation[HULL, 0], car.rotation[HULL, 1]
    ma, mb, ia, ib = HULL_INV_MASS, WHEEL_INV_MASS, HULL_INV_INERTIA, WHEEL_INV_INERTIA
    for i in range(WHEELS - 1, -1, -1):
        rx = cosine * ANCHORS[i, 0] - sine * ANCHORS[i, 1]
        ry = sine * ANCHORS[i, 0] + cosine * ANCHORS[i, 1]
        k11 = ma + mb + ry * ry * ia
        k12 = -ry * rx * ia
        k13 = -ry * ia
        k22 = ma + mb + rx * rx * ia
        k23 = rx * ia
        nx, ny, nz = k22 * K33 - k23 * k23, k23 * k13 - k12 * K33, k12 * k23 - k22 * k13
        row = joints[i]
        row[RX], row[RY], row[K11], row[K12], row[K22], row[K13] = rx, ry, k11, k12, k22, k13
        row[K23], row[NX], row[NY], row[NZ] = k23, nx, ny, nz
        row[SCALE2] = ONE / (k11 * k22 - k12 * k12)
        row[SCALE3] = ONE / (k11 * nx + k12 * ny + k13 * nz)

        angle = car.angle[1 + i] - car.angle[HULL]
        at_stop = -1 if angle <= -STOP else (1 if angle >= STOP else 0)
        if at_stop == 0 or at_stop != car.at_stop[i]:
            state[STOPPER + i] = ZERO
        car.at_stop[i] = at_stop

        px, py = car.push[i, 0], car.push[i, 1]
        motor, stop = state[MOTOR + i], state[STOPPER + i]
        w = 3 + 3 * i
        state[0] -= ma * px
        state[1] -= ma * py
        state[2] -= ia * (cross(rx, ry, px, py) + motor + stop)
        state[w] += mb * px
        state[w + 1] += mb * py
        state[w + 2] += ib * (motor + stop)


@compiled
def solve_velocities(car, state, saved, joints, pushes):
    """Sweep over the joints `VELOCITY_SWEEPS` times, or skip what only repeats itself.

    To find a cycle we compare `state` with that of an earlier sweep, which we replace now and then,
    after ever more sweeps. If it returns after n sweeps, the next n sweeps are the whole cycle:
    their pushes are added again and again, one by one as the sweeps would do. Only the sweeps that
    do not fill a cycle are left.
    """
    bits, saved_bits = state.view(np.int32), saved.view(np.int32)
    for k in range(STATE_SIZE):
        saved_bits[k] = bits[k]
    done, age = 0, 0  # sweeps so far, and since the state was saved
    while done < VELOCITY_SWEEPS:
        sweep(car, state, joints, pushes[0])
        add_push(car, pushes[0])
        done += 1
        age += 1
        changed = np.int32(0)
        for k in range(STATE_SIZE):
            changed |= bits[k] ^ saved_bits[k]
        if changed == 0:
            break
        if age >= max(2, done // 8):
            for k in range(STATE_SIZE):
                saved_bits[k] = bits[k]
            age = 0
    left = VELOCITY_SWEEPS - done
    rounds = left // age if age > 0 else 0
    if rounds > 0:
        for n in range(age):
            sweep(car, state, joints, pushes[n])
        for _ in range(rounds):
            for n in range(age):
                add_push(car, pushes[n])
        left -= rounds * age
    for _ in range(left):
        sweep(car, state, joints, pushes[0])
        add_push(car, pushes[0])


@compiled
def add_push(car, push):
    """Add what one sweep has pushed to the accumulated impulses of the points."""
    for i in range(WHEELS):
        car.push[i, 0] += push[i, 0]
        car.push[i, 1] += push[i, 1]


@compiled
def sweep(car, state, joints, push):
    """Repair the velocity error of each joint once: its motor, then its stop and its point.

    Args:
        car: record, is read.
        state: float32 (24,), is changed.
        joints: constants of the joints.
        push: float32 (4, 2), is written: the impulses of the points.
    """
    ma, mb, ia, ib = HULL_INV_MASS, WHEEL_INV_MASS, HULL_INV_INERTIA, WHEEL_INV_INERTIA
    vax, vay, wa = state[0], state[1], state[2]
    for i in range(WHEELS - 1, -1, -1):
        w = 3 + 3 * i
        vbx, vby, wb = state[w], state[w + 1], state[w + 2]
        rx, ry = joints[i, RX], joints[i, RY]

        old = state[MOTOR + i]
        wanted = old + -TURN_MASS * (wb - wa - car.motor_speed[i])
        state[MOTOR + i] = max(-MOTOR_IMPULSE, min(wanted, MOTOR_IMPULSE))
        turn = state[MOTOR + i] - old
        wa -= ia * turn
        wb += ib * turn

        ex, ey = vbx - vax - -wa * ry, vby - vay - wa * rx
        if car.at_stop[i] == 0:
            px, py = solve_point(joints, i, -ex, -ey)
            turn = ZERO
        else:
            so_far, side = state[STOPPER + i], np.int64(car.at_stop[i])
            px, py, turn = solve_stop(joints, i, ex, ey, wb - wa, so_far, side)
            state[STOPPER + i] += turn
        push[i, 0], push[i, 1] = px, py
        vax -= ma * px
        vay -= ma * py
        wa -= ia * (cross(rx, ry, px, py) + turn)
        vbx += mb * px
        vby += mb * py
        wb += ib * turn
        state[w], state[w + 1], state[w + 2] = vbx, vby, wb
    state[0], state[1], state[2] = vax, vay, wa


@compiled
def solve_point(joints, i, bx, by):
    """The impulse p that solves K p = b at joint i."""
    k11, k12, k22, scale = joints[i, K11], joints[i, K12], joints[i, K22], joints[i, SCALE2]
    return scale * (k22 * bx - k12 * by), scale * (k11 * by - k12 * bx)


@compiled
def solve_stop(joints, i, ex, ey, spin, so_far, at_stop):
    """The impulse at joint i that repairs point and stop together, unless the stop would pull.

    Args:
        joints, i: constants of the joint.
        ex, ey, spin: velocity errors of the point, and the difference of spins.
        so_far: accumulated impulse of the stop.
        at_stop: -1 or 1.

    Returns:
        impulse x, y, and that of the stop.
    """
    k11, k12, k13 = joints[i, K11], joints[i, K12], joints[i, K13]
    k22, k23 = joints[i, K22], joints[i, K23]
    scale = joints[i, SCALE3]
    turn = scale * (
        k11 * (k22 * spin - k23 * ey) + k12 * (k23 * ex - k12 * spin) + k13 * (k12 * ey - k22 * ex)
    )
    total = so_far + -turn
    if (at_stop < 0 and total < ZERO) or (at_stop > 0 and total > ZERO):
        # The stop lets go: it takes back what it has given, and only the point is repaired.
        px, py = solve_point(joints, i, -ex + so_far * k13, -ey + so_far * k23)
        return px, py, -so_far
    px = scale * (ex * joints[i, NX] + ey * joints[i, NY] + spin * joints[i, NZ])
    py = scale * (
        k11 * (ey * K33 - spin * k23) + k12 * (spin * k13 - ex * K33) + k13 * (ex * k23 - ey * k13)
    )
    return -px, -py, -turn


@compiled
def move(car, state):
    """Change positions by velocities, within the caps on the motion of one step."""
    for body in range(BODIES):
        vx, vy, spin = state[3 * body], state[3 * body + 1], state[3 * body + 2]
        dx, dy = STEP * vx, STEP * vy
        if dx * dx + dy * dy > MAX_TRANSLATION * MAX_TRANSLATION:
            ratio = MAX_TRANSLATION / math.sqrt(dx * dx + dy * dy)
            vx *= ratio
            vy *= ratio
        turn = STEP * spin
        if turn * turn > MAX_ROTATION * MAX_ROTATION:
            spin *= MAX_ROTATION / abs(turn)
        car.center[body, 0] += STEP * vx
        car.center[body, 1] += STEP * vy
        car.angle[body] += STEP * spin
        car.velocity[body, 0], car.velocity[body, 1], car.velocity[body, 2] = vx, vy, spin
    for i in range(WHEELS):
        car.motor[i] = state[MOTOR + i]
        car.stop[i] = state[STOPPER + i]


@compiled
def solve_positions(car):
    """Repair the position error of each joint once; return whether all errors were small.

    As with velocities, but the impulses act on positions directly, and are not kept.
    """
    ma, mb, ia, ib = HULL_INV_MASS, WHEEL_INV_MASS, HULL_INV_INERTIA, WHEEL_INV_INERTIA
    small = True
    cax, cay, aa = car.center[HULL, 0], car.center[HULL, 1], car.angle[HULL]
    for i in range(WHEELS - 1, -1, -1):
        ab = car.angle[1 + i]
        turn_error = ZERO
        if car.at_stop[i] != 0:
            turn_error, turn = stop_error(ab - aa, np.int64(car.at_stop[i]))
            aa -= ia * turn
            ab += ib * turn
        cosine, sine = math.cos(aa), math.sin(aa)
        rx = cosine * ANCHORS[i, 0] - sine * ANCHORS[i, 1]
        ry = sine * ANCHORS[i, 0] + cosine * ANCHORS[i, 1]
        ex, ey = car.center[1 + i, 0] - cax - rx, car.center[1 + i, 1] - cay - ry
        error = math.sqrt(ex * ex + ey * ey)
        k11 = ma + mb + ia * ry * ry
        k12 = -ia * rx * ry
        k22 = ma + mb + ia * rx * rx
        scale = ONE / (k11 * k22 - k12 * k12)
        px, py = -(scale * (k22 * ex - k12 * ey)), -(scale * (k11 * ey - k12 * ex))
        cax -= ma * px
        cay -= ma * py
        aa -= ia * cross(rx, ry, px, py)
        car.center[1 + i, 0] += mb * px
        car.center[1 + i, 1] += mb * py
        car.angle[1 + i] = ab
        small = small and error <= LINEAR_SLOP and turn_error <= ANGULAR_SLOP
    car.center[HULL, 0], car.center[HULL, 1], car.angle[HULL] = cax, cay, aa
    return small


@compiled
def stop_error(angle, at_stop):
    """How far a joint has turned beyond its stop, and the impulse that turns it back, radians."""
    if at_stop < 0:
        excess = angle + STOP
        back = max(-MAX_TURN_BACK, min(excess + ANGULAR_SLOP, ZERO))
        return -excess, -TURN_MASS * back
    excess = angle - STOP
    back = max(ZERO, min(excess - ANGULAR_SLOP, MAX_TURN_BACK))
    return excess, -TURN_MASS * back


@compiled
def place_body(car, body):
    """Derive a body's rotation and origin from its angle and centre of mass."""
    cosine, sine = math.cos(car.angle[body]), math.sin(car.angle[body])
    x, y = CENTERS[body, 0], CENTERS[body, 1]
    car.rotation[body, 0], car.rotation[body, 1] = cosine, sine
    car.position[body, 0] = car.center[body, 0] - (cosine * x - sine * y)
    car.position[body, 1] = car.center[body, 1] - (sine * x + cosine * y)


@compiled
def fall_asleep(car, solved):
    """Stop all bodies after half a second in which none moved faster than a threshold.

    Box2D then lets them sleep, but Gymnasium wakes them in the next frame by its forces.
    """
    shortest = TIME_TO_SLEEP
    for body in range(BODIES):
        vx, vy, spin = car.velocity[body, 0], car.velocity[body, 1], car.velocity[body, 2]
        if spin * spin > REST_SPIN * REST_SPIN or vx * vx + vy * vy > REST_SPEED * REST_SPEED:
            car.rest[body] = ZERO
        else:
            car.rest[body] += STEP
        shortest = min(shortest, car.rest[body])
    if shortest >= TIME_TO_SLEEP and solved:
        for body in range(BODIES):
            car.rest[body] = ZERO
            for k in range(3):
                car.velocity[body, k] = ZERO


# --- 4. Reward, start, and many cars --------------------------------------------------------------


@compiled
def advance(car, road, memory):
    """One frame of the world with the controls as they are set."""
    state, saved, joints, pushes, simplex, corners = memory
    drive_wheels(car)
    touch_tiles(car, road, simplex, corners)
    solve(car, state, saved, joints, pushes)
    car.time += FRAME


@compiled
def score(car, road):
    """The reward of a frame, float64; sets `ending`."""
    car.ending = DRIVING
    car.reward -= 0.1
    reward = car.reward - car.previous_reward
    car.previous_reward = car.reward
    if car.tiles_visited == road.tiles or car.new_lap:
        car.ending = LAP_FINISHED
    if abs(car.position[HULL, 0]) > PLAYFIELD or abs(car.position[HULL, 1]) > PLAYFIELD:
        car.ending = LEFT_FIELD
        reward = -100.0
    return reward


@compiled
def make_memory():
    """What one thread needs besides the records: arrays that hold nothing between frames."""
    return (
        np.empty(STATE_SIZE, np.float32),
        np.empty(STATE_SIZE, np.float32),
        np.empty((WHEELS, 12), np.float32),
        np.empty((VELOCITY_SWEEPS, WHEELS, 2), np.float32),
        np.empty((3, 7), np.float32),
        np.empty((6, 2), np.int64),
    )


@compiled
def step_cars(cars, roads, which, actions, rewards):
    """Drive some cars for one frame. Releases the GIL: threads may step different cars at once.

    Args:
        cars: CAR (cars,), is changed; `ending` says which episodes are over.
        roads: ROAD (cars,), is changed.
        which: int64 (n,), numbers of the cars that drive.
        actions: float64 (n, 3): steering -1 to 1, gas and brake 0 to 1.
        rewards: float64 (n,), is written.
    """
    memory = make_memory()
    for n in range(len(which)):
        car, road = cars[which[n]], roads[which[n]]
        control(car, actions[n, 0], actions[n, 1], actions[n, 2])
        advance(car, road, memory)
        car.frames += 1
        rewards[n] = score(car, road)


@compiled
def start_car(cars, roads, n, path, tiles, lap_complete):
    """Begin an episode of car n: lay out the road, and let one frame pass, as Gymnasium does.

    Args:
        cars, roads: CAR and ROAD arrays; element n is changed.
        path, tiles: of a `Track`.
        lap_complete: share of the tiles after which touching tile 0 for the first time ends the
            lap. Since a car starts on tile 0, this matters only for shares of a few tiles.
    """
    car, road = cars[n], roads[n]
    lay_road(road, tiles)
    put_at_rest(car, path[0, 1], path[0, 2], path[0, 3])
    car.time = car.reward = car.previous_reward = 0.0
    car.lap_complete = lap_complete
    car.tiles_visited = car.frames = car.new_lap = car.ending = 0
    advance(car, road, make_memory())


@compiled
def put_at_rest(car, heading, x, y):
    """Make a new car at rest. Its wheels are placed as if it faced north, as Gymnasium does.

    Args:
        car: record, is changed.
        heading: radians.
        x, y: of the hull's origin, world units.
    """
    angle = f32(heading)
    cosine, sine = math.cos(angle), math.sin(angle)
    for body in range(BODIES):
        px, py = f32(x), f32(y)
        if body != HULL:
            px = f32(x + WHEEL_OFFSETS[body - 1, 0])
            py = f32(y + WHEEL_OFFSETS[body - 1, 1])
        car.angle[body] = angle
        car.rotation[body, 0], car.rotation[body, 1] = cosine, sine
        car.position[body, 0], car.position[body, 1] = px, py
        lx, ly = CENTERS[body, 0], CENTERS[body, 1]
        car.center[body, 0] = (cosine * lx - sine * ly) + px
        car.center[body, 1] = (sine * lx + cosine * ly) + py
        car.rest[body] = ZERO
        for k in range(3):
            car.velocity[body, k] = ZERO
        for k in range(2):
            car.force[body, k] = ZERO
    for i in range(WHEELS):
        car.push[i, 0] = car.push[i, 1] = car.motor[i] = car.stop[i] = ZERO
        car.at_stop[i], car.on_road[i], car.motor_speed[i] = 0, 0, ZERO
        car.steer[i] = car.gas[i] = car.brake[i] = car.omega[i] = car.phase[i] = 0.0


@compiled
def place_car(cars, n, heading, x, y, speed):
    """Replace car n by a new one that moves straight ahead, its wheels rolling.

    Args:
        cars: CAR (cars,); element n is changed.
        heading: radians.
        x, y: of the hull's origin, world units.
        speed: world units per second.
    """
    car = cars[n]
    put_at_rest(car, heading, x, y)
    cosine, sine = car.rotation[HULL, 0], car.rotation[HULL, 1]
    for i in range(WHEELS):
        lx, ly = f32(WHEEL_OFFSETS[i, 0]), f32(WHEEL_OFFSETS[i, 1])
        px = (cosine * lx - sine * ly) + car.position[HULL, 0]
        py = (sine * lx + cosine * ly) + car.position[HULL, 1]
        cx, cy = CENTERS[1 + i, 0], CENTERS[1 + i, 1]
        car.position[1 + i, 0], car.position[1 + i, 1] = px, py
        car.center[1 + i, 0] = (cosine * cx - sine * cy) + px
        car.center[1 + i, 1] = (sine * cx + cosine * cy) + py
        car.omega[i] = speed / WHEEL_RADIUS
    for body in range(BODIES):
        car.velocity[body, 0] = f32(-math.sin(heading) * speed)
        car.velocity[body, 1] = f32(math.cos(heading) * speed)
    car.time = max(car.time, 1.0)  # the opening zoom is over


@compiled
def lay_road(road, tiles):
    """Fill a ROAD record with the tiles of a track, float64 (n, 4, 2), none of them visited."""
    road.tiles = len(tiles)
    corners, hull = np.empty((4, 2), np.float32), np.empty((4, 2), np.float32)
    for tile in range(len(tiles)):
        for k in range(4):
            corners[k, 0], corners[k, 1] = tiles[tile, k, 0], tiles[tile, k, 1]
        count = convex_hull(corners, hull)
        road.corner_count[tile] = count
        road.visited[tile] = road.darkened[tile] = 0
        road.box[tile, 0] = road.box[tile, 1] = np.inf
        road.box[tile, 2] = road.box[tile, 3] = -np.inf
        for k in range(count):
            x, y = hull[k, 0], hull[k, 1]
            road.corners[tile, k, 0], road.corners[tile, k, 1] = x, y
            road.box[tile, 0] = min(road.box[tile, 0], x)
            road.box[tile, 1] = min(road.box[tile, 1], y)
            road.box[tile, 2] = max(road.box[tile, 2], x)
            road.box[tile, 3] = max(road.box[tile, 3], y)
            end = (k + 1) % count
            nx, ny = hull[end, 1] - y, x - hull[end, 0]
            length = math.sqrt(nx * nx + ny * ny)
            nx, ny = nx / length, ny / length
            road.edges[tile, k, 0], road.edges[tile, k, 1] = nx, ny
            road.edges[tile, k, 2] = nx * x + ny * y
