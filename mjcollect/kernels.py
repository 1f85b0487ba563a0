"""The rules of one simulation, compiled by numba, and loops over all simulations.

What is called for every slot of every simulation is written here once, for a single one: rows are
arrays (3,), booleans or numbers. The loops give one simulation and many the same bits, since each
row is computed by the same code in the same order; fast-math stays off. The modules that the
rules belong to (`flight`, `guidance`, `observation`, `geometry`) wrap the loops and say shapes and
units. Constants that are tuned live there and come in as arguments.

All of it is one file on purpose: numba caches machine code by the file's content, and would not
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

WAYPOINT_FAVOUR = 1.0  # metres by which a way over waypoints may be longer than a field's
ONE_TURN = 30.0  # metres within which corners count as one turn
CORNER_BRAKE = 0.9  # share of a_max that the guidance law counts on before corners
WALL_SHARE = 0.2  # the same towards a bound, at least
FREE_ROOM = 0.1  # metres beyond the body's radius that the law's straight way keeps from boxes
BOX_ROOM = 0.5  # metres beyond the body's radius from which it does not approach a box


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
    low, high = path[0].copy(), path[0].copy()
    for s in range(1, len(path)):
        for k in range(3):
            low[k], high[k] = min(low[k], path[s, k]), max(high[k], path[s, k])
    for b in range(len(boxes)):  # by index: iteration forgets that boxes are contiguous
        near = True
        for k in range(3):
            near = near and low[k] - radius <= boxes[b, 1, k] and boxes[b, 0, k] <= high[k] + radius
        if near:
            for s in range(len(touch)):
                touch[s] = touch[s] or segment_gap(path[s], path[s + 1], boxes[b]) < radius


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
    bounds: Array, boxes: Array, a_max: float, radius: float, q: Array, v: Array
) -> bool:
    """Whether a body is in bounds and clear of boxes, also after braking."""
    offset, ahead = np.empty(3), np.empty(3)
    speed = norm(v)
    for k in range(3):
        ahead[k] = q[k] + v[k] * (speed / (2 * a_max))
    if is_outside(bounds, q, 0.0) or is_outside(bounds, ahead, 0.0):
        return False
    for b in range(len(boxes)):
        if box_offset(q, boxes[b], offset) < radius + speed**2 / (2 * a_max):
            return False
    return True


@compiled
def from_ball(normal: Array, share: float, vector: Array) -> None:
    """A point of the unit ball, uniform if `normal` (3,) and `share` come from N(0, 1), U(0, 1)."""
    size = norm(normal)
    for k in range(3):
        vector[k] = normal[k] / size * share ** (1 / 3)


@compiled
def try_starts(
    bounds: Array, boxes: Array, a_max: float, radius: float, middle: Array, along: Array,
    half: Array, top: Array, kind: Indices, where: Array, where_share: Array, speed: Array,
    speed_share: Array, todo: Indices, q: Array, v: Array, wanting: Bools,
) -> None:  # fmt: skip
    """Starts of each `kind` (N,) in the episodes `todo`, which go on `wanting` if one does not fit.

    A kind's positions fill the ellipsoid round `middle` (kinds, 3) with axis `along` (3,) and half
    widths `half` (kinds, 2) along and across it; its velocities the ball of radius `top` (kinds,).
    """
    unit = np.empty(3)
    for j in range(len(todo)):
        i = todo[j]
        from_ball(where[j], where_share[j, 0], unit)
        major, minor = half[kind[i], 0], half[kind[i], 1]
        share = dot(unit, along)
        for k in range(3):
            across = unit[k] - share * along[k]
            q[i, k] = middle[kind[i], k] + share * along[k] * major + across * minor
        from_ball(speed[j], speed_share[j, 0], v[i])
        for k in range(3):
            v[i, k] *= top[kind[i]]
        wanting[i] = not room_to_brake(bounds, boxes, a_max, radius, q[i], v[i])


# Guidance


@compiled
def in_sight(boxes: Array, q: Array, offset: Array) -> bool:
    """Whether the straight line to the point `offset` away misses every box (M, 2, 3)."""
    for b in range(len(boxes)):
        enter, leave = slab(q, offset, boxes[b], 0.0, 1e-12)
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
def unit(vector: Array, to: Array) -> float:
    """Length of a vector; `to` becomes its direction, or zero."""
    size = norm(vector)
    for k in range(3):
        to[k] = vector[k] / size if size > 1e-9 else 0.0
    return size


@compiled
def query_row(way: Way, q: Array, direction: Array) -> tuple[float, int]:
    """See `guidance.Guidance.query`; with the index of the waypoint flown to, -1 for none."""
    offset, chosen, best = np.empty(3), -1, np.inf
    last = len(way.points) - 1
    for p in range(last, -1, -1):
        for k in range(3):
            offset[k] = way.points[p, k] - q[k]
        whole = norm(offset) + way.rest[p]
        if whole < best and in_sight(way.sight[p], q, offset):
            chosen, best = p, whole
            unit(offset, direction)
            if p == last:
                return best, last
    for k in range(3):
        offset[k] = way.points[last, k] - q[k]
    straight = norm(offset)
    found = np.inf
    downhill = np.empty(3)
    for field in range(len(way.first) - 1, -1, -1):  # the finest that is defined here
        found = interpolate(way, field, q, downhill)
        if math.isfinite(found):
            break
    found = max(found, straight) if math.isfinite(found) else np.inf
    if chosen >= 0 and best <= found + WAYPOINT_FAVOUR:
        return best, chosen
    unit(downhill, direction)
    return found, -1


@compiled
def query(way: Way, which: Indices, q: Array, distance: Array, direction: Array) -> None:
    """See `guidance.Guidance.query`, for the simulations `which`."""
    for i in which:
        distance[i], _ = query_row(way, q[i], direction[i])


@compiled
def heading_row(
    way: Way, slot: float, a_max: float, chosen: int, q: Array, v: Array, heading: Array
) -> float:
    """Turn `heading` in time for a corner; the speed in m/s at which those ahead can be flown.

    Turning from direction u into w with a_max takes v |u - w| / a_max seconds and cuts the corner
    by v^2 |u - w|^2 / (8 a_max) metres if it begins half that time before. See `Waypoints`.
    """
    if chosen < 0:
        return np.inf
    speed, limit, before = norm(v), np.inf, np.empty(3)
    gap, bend = np.empty(3), np.empty(3)
    for k in range(3):
        gap[k], before[k] = way.points[chosen, k] - q[k], heading[k]
    ahead = norm(gap)
    for p in range(chosen, len(way.points) - 1):
        end, cut = p, way.cut[p]
        while end < len(way.points) - 2 and way.rest[p] - way.rest[end + 1] < ONE_TURN:
            end += 1
            cut = min(cut, way.cut[end])
        for k in range(3):
            bend[k] = way.onward[end, k] - before[k]
            before[k] = way.onward[p, k]
        turn = max(norm(bend), 1e-6)
        corner = math.sqrt(8 * cut * a_max) / turn
        begin = ahead - corner**2 * turn / a_max / 2 - speed * slot / 2
        soon = ahead <= speed * (speed * turn / a_max + slot) / 2
        if p == chosen and soon and speed <= 1.3 * corner:
            for k in range(3):
                gap[k] = way.points[p + 1, k] - q[k]
            unit(gap, heading)
            limit = min(limit, corner)
        else:
            limit = min(limit, math.sqrt(corner**2 + 2 * CORNER_BRAKE * a_max * max(begin, 0.0)))
        ahead += way.rest[p] - way.rest[p + 1]
    return limit


@compiled
def stopping(brake: float, room: float, speed: float, slot: float) -> float:
    """Speed at the slot's end from which `brake` m/s^2 still stops within `room` metres.

    Solves w^2 = 2 brake (room - (speed + w) slot / 2) for w: what the slot itself takes is gone.
    """
    half = brake * slot / 2
    return math.sqrt(max(half**2 + 2 * brake * room - 2 * half * speed, 0.0)) - half


@compiled
def free_way(boxes: Array, grow: float, q: Array, direction: Array) -> float:
    """Metres along `direction` to the first box grown by `grow`; from inside one, it is free."""
    free = 1e6
    for b in range(len(boxes)):
        enter, leave = slab(q, direction, boxes[b], grow, 1e-9)
        if 0.0 <= enter <= leave:
            free = min(free, enter)
    return free


@compiled
def hold_back(world: World, w: int, q: Array, v: Array, wanted: Array) -> None:
    """Take from a wanted velocity what leads into the nearest box or out of bounds."""
    boxes, radius, a_max = world.boxes[w], world.radius[w, 0], world.a_max[w, 0]
    offset, nearest, gap = np.empty(3), np.zeros(3), np.inf
    for b in range(len(boxes)):
        this = box_offset(q, boxes[b], offset)
        if this < gap:
            gap = this
            for k in range(3):
                nearest[k] = offset[k] / max(this, 1e-9)
    excess = dot(wanted, nearest) - max(gap - radius - BOX_ROOM, 0.0) / world.slot
    if excess > 0.0:
        for k in range(3):
            wanted[k] -= excess * nearest[k]
    speed = max(norm(v), 1e-9)
    for k in range(3):
        # Braking against the velocity, each axis gets its share of a_max.
        brake = a_max * max(abs(v[k]) / speed, WALL_SHARE)
        low, high = q[k] - world.bounds[w, 0, k], world.bounds[w, 1, k] - q[k]
        slowest = -stopping(brake, max(low, 0.0), -v[k], world.slot)
        fastest = stopping(brake, max(high, 0.0), v[k], world.slot)
        wanted[k] = min(max(wanted[k], slowest), fastest)


@compiled
def law_row(
    world: World, w: int, q: Array, v: Array, room: float, heading: Array, corner: float,
    action: Array,
) -> None:  # fmt: skip
    """Action of the guidance law, which learns nothing: `room` metres are left to fly.

    Along `heading` at the greatest speed from which full braking still ends in time, at the aim,
    at corners and before boxes. The yardstick of what is learned, its prior, and the source of
    demonstrations.
    """
    a_max, slot = world.a_max[w, 0], world.slot
    closing = dot(v, heading)
    speed = min(stopping(a_max, room, closing, slot), world.v_max[w, 0], corner)
    free = free_way(world.boxes[w], world.radius[w, 0] + FREE_ROOM, q, heading)
    speed = min(speed, stopping(a_max, free, closing, slot))
    wanted = np.empty(3)
    for k in range(3):
        wanted[k] = heading[k] * speed
    hold_back(world, w, q, v, wanted)
    # Across the path first: a body that keeps to it may brake late, not the other way round.
    for k in range(3):
        wanted[k] = (wanted[k] - v[k]) / slot
    along = dot(wanted, heading)
    for k in range(3):
        wanted[k] -= along * heading[k]
    into_ball(wanted, a_max)
    left = math.sqrt(max(a_max**2 - dot(wanted, wanted), 0.0))
    along = min(max(along, -left), left)
    for k in range(3):
        wanted[k] = (wanted[k] + along * heading[k]) / a_max
    project_row(world, w, v, wanted, action)
    for k in range(3):
        action[k] /= a_max


@compiled
def look(
    world: World, way: Way, slack: float, which: Indices, goal: Array, strides: Array,
    q: Array, v: Array,
    offset: Array, distance: Array, direction: Array, closing: Array, ahead: Array, law: Array,
) -> None:  # fmt: skip
    """How the simulations `which` stand towards a goal (3,), see `reward.Approach`.

    The points `ahead`, `strides` metres from one to the next, show bends before they are reached.
    """
    point, towards = np.empty(3), np.empty(3)
    for i in which:
        w = scene_of(world, i)
        left, chosen = query_row(way, q[i], direction[i])
        distance[i] = left
        closing[i] = dot(v[i], direction[i])
        for k in range(3):
            offset[i, k] = goal[k] - q[i, k]
            point[k], towards[k] = q[i, k], direction[i, k]
        corner = heading_row(way, world.slot, world.a_max[w, 0], chosen, q[i], v[i], towards)
        law_row(world, w, q[i], v[i], max(left - slack, 0.0), towards, corner, law[i])
        for k in range(3):
            towards[k] = direction[i, k]
        for a in range(len(strides)):
            if a > 0:
                left, _ = query_row(way, point, towards)
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
    closing: Array, ahead: Array, slack: Array, law: Array,
    nearest: int, reach: float, far: float, out: Array,
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
        fastest = min(math.sqrt(2 * a_max * distance[i]), v_max)
        row[at] = closing[i] / v_max
        row[at + 1] = math.sqrt(max(dot(v[i], v[i]) - closing[i] ** 2, 0.0)) / v_max
        row[at + 2] = math.tanh((closing[i] - fastest) / 10)
        at += 3
        # Share of a_max that a stop takes at the near and the far end of what will do; and by how
        # many metres full braking overshoots the near end, begun now or a slot later.
        braking = max(closing[i], 0.0) ** 2 / (2 * a_max)
        first, last = max(distance[i] - slack[i], 0.0), distance[i] + slack[i]
        row[at] = min(braking / max(first, 0.1), 2.0)
        row[at + 1] = min(braking / max(last, 0.1), 2.0)
        row[at + 2] = math.tanh((braking - first) / 5)
        row[at + 3] = math.tanh((braking + max(closing[i], 0.0) * world.slot - first) / 5)
        at += 4
        nearest_boxes(world.boxes[w], q[i], reach, far, gaps, offset, row[at : at + 3 * nearest])
        at += 3 * nearest
        for k in range(3):
            row[at + k] = math.tanh((q[i, k] - bounds[0, k]) / reach)
            row[at + 3 + k] = math.tanh((bounds[1, k] - q[i, k]) / reach)
            row[at + 6 + k] = law[i, k]
