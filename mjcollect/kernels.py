"""The rules of one simulation, compiled by numba, and loops over all simulations.

What is called for every slot of every simulation is written here once, for a single one: rows are
arrays (3,), booleans or numbers. The loops give one simulation and many the same bits, since each
row is computed by the same code in the same order; fast-math stays off. The modules that the
rules belong to (`flight`, `guidance`, `observation`, `geometry`) wrap the loops and say shapes and
units. Constants that are tuned live there and come in as arguments.

All of it is one file on purpose: numba caches machine code by the file's date, and would not
notice that a function called from another file has changed.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mjcollect.compiled import compiled

if TYPE_CHECKING:
    from mjcollect.flight import World
    from mjcollect.guidance import Way

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Indices = NDArray[np.intp]


# Vectors and boxes


@compiled
def dot(a: Array, b: Array) -> float:
    """Scalar product."""
    return float(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


@compiled
def norm(a: Array) -> float:
    """Length."""
    return math.sqrt(dot(a, a))


@compiled
def box_offset(point: Array, box: Array, offset: Array) -> float:
    """Distance to a box; `offset` becomes the vector to its nearest point."""
    for k in range(3):
        offset[k] = min(max(point[k], box[0, k]), box[1, k]) - point[k]
    return norm(offset)


@compiled
def slab(start: Array, step: Array, box: Array, grow: float, tiny: float) -> tuple[float, float]:
    """Where the line start + t step enters and leaves a box grown by `grow`: enter > leave if not.

    Components of `step` smaller than `tiny` count as `tiny`.
    """
    enter, leave = -np.inf, np.inf
    for k in range(3):
        along = step[k] if abs(step[k]) >= tiny else tiny
        one = (box[0, k] - grow - start[k]) / along
        two = (box[1, k] + grow - start[k]) / along
        enter, leave = max(enter, min(one, two)), min(leave, max(one, two))
    return enter, leave


@compiled
def box_slope(start: Array, end: Array, box: Array, t: float) -> float:
    """Half the derivative by t of the squared distance of start + t (end - start) to a box."""
    slope = 0.0
    for k in range(3):
        at = start[k] + t * (end[k] - start[k])
        slope += (at - min(max(at, box[0, k]), box[1, k])) * (end[k] - start[k])
    return slope


@compiled
def segment_gap(start: Array, end: Array, box: Array) -> float:
    """Exact distance between a segment and a box.

    The squared distance is convex and its derivative linear between the faces' planes: it changes
    sign between the last plane with a falling slope and the first with a rising one.
    """
    left, right = 0.0, 1.0
    falling, rising = box_slope(start, end, box, left), box_slope(start, end, box, right)
    if falling >= 0.0:
        nearest = left
    elif rising <= 0.0:
        nearest = right
    else:
        for k in range(3):
            for side in range(2):
                step = end[k] - start[k]
                t = (box[side, k] - start[k]) / step if step != 0.0 else 0.0
                if left < t < right:
                    slope = box_slope(start, end, box, t)
                    if slope < 0.0:
                        left, falling = t, slope
                    else:
                        right, rising = t, slope
        nearest = left + falling / (falling - rising) * (right - left)
    square = 0.0
    for k in range(3):
        at = start[k] + nearest * (end[k] - start[k])
        square += (at - min(max(at, box[0, k]), box[1, k])) ** 2
    return math.sqrt(square)


@compiled
def segment_gaps(start: Array, end: Array, boxes: Array, gap: Array) -> None:
    """`segment_gap` of each of (n,) pairs of a segment and a box."""
    for i in range(len(start)):
        gap[i] = segment_gap(start[i], end[i], boxes[i])


@compiled
def segments_clear(start: Array, end: Array, boxes: Array, radius: float, clear: Bools) -> None:
    """Whether (n,) segments keep `radius` from all of the boxes (M, 2, 3)."""
    for i in range(len(start)):
        clear[i] = True
        for b in range(len(boxes)):
            if segment_gap(start[i], end[i], boxes[b]) < radius:
                clear[i] = False
                break


# Flight


@compiled
def scene_of(world: World, i: int) -> int:
    """Index of simulation i's scene in the world."""
    return i if len(world.bounds) > 1 else 0


@compiled
def into_ball(vector: Array, radius: float) -> None:
    """Shorten a vector to `radius`."""
    size = norm(vector)
    if size > radius:
        for k in range(3):
            vector[k] = vector[k] * (radius / size)


@compiled
def project_row(world: World, w: int, v: Array, action: Array, a: Array) -> None:
    """See `flight.project`."""
    a_max, v_max = world.a_max[w, 0], world.v_max[w, 0]
    for k in range(3):
        raw = action[k] if math.isfinite(action[k]) else 0.0
        a[k] = min(max(raw, -1e100), 1e100) * a_max  # its square must not overflow
    into_ball(a, a_max)
    for k in range(3):
        a[k] = v[k] + a[k] * world.slot
    into_ball(a, v_max)
    for k in range(3):
        a[k] = (a[k] - v[k]) / world.slot


@compiled
def project(world: World, v: Array, action: Array, a: Array) -> None:
    """See `flight.project`."""
    for i in range(len(v)):
        project_row(world, scene_of(world, i), v[i], action[i], a[i])


@compiled
def arrests_row(world: World, w: int, q: Array, v: Array, goal: Array, tolerance: float) -> bool:
    """See `flight.arrests`."""
    coasted = world.slot * (world.substeps - 1) / (2 * world.substeps)
    square = 0.0
    for k in range(3):
        square += (q[k] + v[k] * coasted - goal[k]) ** 2
    return bool(norm(v) <= world.a_max[w, 0] * world.slot and math.sqrt(square) <= tolerance)


@compiled
def command(
    world: World, q: Array, v: Array, action: Array, goal: Array, tolerance: Array,
    a: Array, stop: Bools,
) -> None:  # fmt: skip
    """See `flight.command`."""
    for i in range(len(v)):
        w = scene_of(world, i)
        stop[i] = arrests_row(world, w, q[i], v[i], goal[i], tolerance[i])
        if stop[i]:
            for k in range(3):
                a[i, k] = -v[i, k] / world.slot
        else:
            project_row(world, w, v[i], action[i], a[i])


@compiled
def sweep(world: World, w: int, path: Array, touch: Bools) -> None:
    """Add to `touch` (n,) the pieces of a path (n + 1, 3) that come within the radius of a box."""
    radius, boxes = world.radius[w, 0], world.boxes[w]
    for b in range(len(boxes)):  # by index: iteration forgets that boxes are contiguous
        box = boxes[b]
        near = True
        for k in range(3):
            low = high = path[0, k]
            for s in range(1, len(path)):
                low, high = min(low, path[s, k]), max(high, path[s, k])
            near = near and box[0, k] <= high + radius and box[1, k] >= low - radius
        if near:
            for s in range(len(touch)):
                touch[s] = touch[s] or segment_gap(path[s], path[s + 1], box) < radius


@compiled
def is_outside(bounds: Array, point: Array, tolerance: float) -> bool:
    """Whether a point lies outside the bounds (2, 3) by more than `tolerance`."""
    for k in range(3):
        if point[k] < bounds[0, k] - tolerance or point[k] > bounds[1, k] + tolerance:
            return True
    return False


@compiled
def events(world: World, path: Array, tolerance: float, touch: Bools, outside: Bools) -> None:
    """Contact and leaving the bounds, each (N, n), on paths (N, n + 1, 3) from the slot's start.

    `touch` comes in as what was sensed. See `flight.contacts`, `flight.leaves_bounds`.
    """
    for i in range(len(path)):
        w = scene_of(world, i)
        sweep(world, w, path[i], touch[i])
        for s in range(touch.shape[1]):
            outside[i, s] = is_outside(world.bounds[w], path[i, s + 1], tolerance)


@compiled
def room_to_brake(
    bounds: Array, boxes: Array, a_max: float, radius: float, q: Array, v: Array, room: Bools
) -> None:
    """See `Course.starts`: in bounds and clear of boxes, also after braking."""
    offset, ahead = np.empty(3), np.empty(3)
    for i in range(len(q)):
        speed = norm(v[i])
        for k in range(3):
            ahead[k] = q[i, k] + v[i, k] * (speed / (2 * a_max))
        room[i] = not (is_outside(bounds, q[i], 0.0) or is_outside(bounds, ahead, 0.0))
        for b in range(len(boxes)):
            if box_offset(q[i], boxes[b], offset) < radius + speed**2 / (2 * a_max):
                room[i] = False
                break


# Guidance


@compiled
def sees_aim(way: Way, q: Array, offset: Array) -> bool:
    """Whether the straight line to the aim, `offset` away, misses every box with room to spare."""
    for b in range(len(way.keep)):
        enter, leave = slab(q, offset, way.keep[b], 0.0, 1e-12)
        if enter <= leave and leave >= 0.0 and enter <= 1.0:
            return False
    return True


@compiled
def between(a: float, b: float, share: float) -> float:
    """From `a` to `b`."""
    return a + share * (b - a)


@compiled
def value_at(way: Way, node: int) -> float:
    """Value of a node, from here on in double precision."""
    return np.float64(way.values[node])


@compiled
def interpolate(way: Way, field: int, q: Array, downhill: Array) -> float:
    """Trilinear value of a field at a point, and minus its gradient."""
    dx, dy, dz = way.nodes[field, 1] * way.nodes[field, 2], way.nodes[field, 2], 1
    corner, strides = way.first[field], (dx, dy, dz)
    for k in range(3):
        where = (q[k] - way.low[field, k]) / way.spacing[field, k]
        cell = min(max(int(where), 0), way.nodes[field, k] - 2)
        downhill[k] = min(max(where - cell, 0.0), 1.0)
        corner += cell * strides[k]
    x, y, z = downhill[0], downhill[1], downhill[2]
    v000, v100 = value_at(way, corner), value_at(way, corner + dx)
    v010, v110 = value_at(way, corner + dy), value_at(way, corner + dx + dy)
    v001, v101 = value_at(way, corner + dz), value_at(way, corner + dx + dz)
    v011, v111 = value_at(way, corner + dy + dz), value_at(way, corner + dx + dy + dz)
    x00, x10 = between(v000, v100, x), between(v010, v110, x)
    x01, x11 = between(v001, v101, x), between(v011, v111, x)
    xy0, xy1 = between(x00, x10, y), between(x01, x11, y)
    slope_x = between(between(v100 - v000, v110 - v010, y), between(v101 - v001, v111 - v011, y), z)
    downhill[0] = -slope_x / way.spacing[field, 0]
    downhill[1] = -between(x10 - x00, x11 - x01, z) / way.spacing[field, 1]
    downhill[2] = -(xy1 - xy0) / way.spacing[field, 2]
    return between(xy0, xy1, z)


@compiled
def query_row(way: Way, q: Array, direction: Array) -> float:
    """See `guidance.Guidance.query`."""
    for k in range(3):
        direction[k] = way.aim[k] - q[k]
    straight = norm(direction)
    distance = straight
    if not sees_aim(way, q, direction):
        for field in range(len(way.first) - 1, -1, -1):  # the finest that is defined here
            found = interpolate(way, field, q, direction)
            if math.isfinite(found):
                break
        distance = max(found, straight)
    size = norm(direction)
    for k in range(3):
        direction[k] = direction[k] / size if size > 1e-9 else 0.0
    return distance


@compiled
def query(way: Way, which: Indices, q: Array, distance: Array, direction: Array) -> None:
    """See `guidance.Guidance.query`, for the simulations `which`."""
    for i in which:
        distance[i] = query_row(way, q[i], direction[i])


@compiled
def look(
    way: Way, which: Indices, goal: Array, strides: Array, q: Array, v: Array,
    offset: Array, distance: Array, direction: Array, closing: Array, ahead: Array,
) -> None:  # fmt: skip
    """How the simulations `which` stand towards a goal (3,), see `reward.Approach`.

    The points `ahead`, `strides` metres from one to the next, show bends before they are reached.
    """
    point, towards = np.empty(3), np.empty(3)
    for i in which:
        left = distance[i] = query_row(way, q[i], direction[i])
        closing[i] = dot(v[i], direction[i])
        for k in range(3):
            offset[i, k] = goal[k] - q[i, k]
            point[k], towards[k] = q[i, k], direction[i, k]
        for a in range(len(strides)):
            if a > 0:
                left = query_row(way, point, towards)
            for k in range(3):
                point[k] += towards[k] * min(strides[a], left)
                ahead[i, a, k] = point[k] - q[i, k]


# Observation


@compiled
def nearest_boxes(
    boxes: Array, q: Array, reach: float, far: float, gaps: Array, offset: Array, out: Array
) -> None:
    """Direction times closeness to the nearest boxes, nearest first: `out` (3 * len(gaps),).

    One metre away reads close to 1, `reach` away 1/2, far away 0; padding exactly 0, so that an
    observation does not depend on how many boxes other simulations have.
    """
    count = len(gaps)
    gaps[:], out[:] = far, 0.0
    for b in range(len(boxes)):
        gap = box_offset(q, boxes[b], offset)
        if gap >= gaps[count - 1] or gap >= far / 2:
            continue
        slot = count - 1
        while slot > 0 and gaps[slot - 1] > gap:
            gaps[slot] = gaps[slot - 1]
            for k in range(3):
                out[3 * slot + k] = out[3 * slot - 3 + k]
            slot -= 1
        gaps[slot] = gap
        for k in range(3):
            out[3 * slot + k] = offset[k] / max(gap, 1e-9) / (1.0 + gap / reach)


@compiled
def guided(
    world: World, q: Array, v: Array, goal_offset: Array, distance: Array, direction: Array,
    closing: Array, ahead: Array, nearest: int, reach: float, far: float, out: Array,
) -> None:  # fmt: skip
    """See `observation.guided`; the parts one after another, in the order of `GUIDED`."""
    gaps, offset = np.empty(nearest), np.empty(3)
    for i in range(len(q)):
        w, row, at = scene_of(world, i), out[i], 0
        a_max, v_max, bounds = world.a_max[w, 0], world.v_max[w, 0], world.bounds[w]
        for k in range(3):
            row[at + k] = v[i, k] / v_max
            row[at + 3 + k] = direction[i, k]
        at += 6
        for a in range(1, ahead.shape[1]):
            for k in range(3):
                row[at + k] = ahead[i, a, k] / 100
            at += 3
        row[at] = distance[i] / 300
        row[at + 1] = math.tanh(distance[i] / 60)
        row[at + 2] = math.tanh(distance[i] / 12)
        at += 3
        for k in range(3):
            row[at + k] = goal_offset[i, k] / 300
            row[at + 3 + k] = math.tanh(goal_offset[i, k] / 60)
            row[at + 6 + k] = math.tanh(goal_offset[i, k] / 12)
        at += 9
        # Along the path, across it, and how much faster than one can still stop.
        stopping = min(math.sqrt(2 * a_max * distance[i]), v_max)
        row[at] = closing[i] / v_max
        row[at + 1] = math.sqrt(max(dot(v[i], v[i]) - closing[i] ** 2, 0.0)) / v_max
        row[at + 2] = math.tanh((closing[i] - stopping) / 10)
        at += 3
        nearest_boxes(world.boxes[w], q[i], reach, far, gaps, offset, row[at : at + 3 * nearest])
        at += 3 * nearest
        for k in range(3):
            row[at + k] = math.tanh((q[i, k] - bounds[0, k]) / reach)
            row[at + 3 + k] = math.tanh((bounds[1, k] - q[i, k]) / reach)
