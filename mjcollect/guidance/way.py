"""Holds the numbers that guidance is read from, and reads them at a point."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mjcollect.geometry.among_boxes import in_sight
from mjcollect.geometry.compiled import Array, Indices, compiled
from mjcollect.geometry.tree import Tree
from mjcollect.geometry.vectors import lerp, norm, unit


class Way(NamedTuple):
    """Holds the numbers that `query_row` reads guidance from; of F fields the finest is the last.

    Attributes:
        points, remaining, next_direction, cut, tree, margin, most_margin: see `Waypoints`.
        low, spacing: (F, 3) m, see `DistanceField`. nodes: (F, 3), nodes along each axis.
        stop: (4,), where a stop is best for the tour, and the radius in m of the ball around the
            goal in which a stop is free; 0 if it is not free all around.
        unit: (1,) m, see `Scene.unit`.
        first: (F,), index of each field's first node in `values` (V,), which are in metres.
    """

    points: Array
    remaining: Array
    next_direction: Array
    cut: Array
    tree: Tree
    margin: Array
    most_margin: Array
    low: Array
    spacing: Array
    nodes: NDArray[np.int64]
    first: NDArray[np.int64]
    values: NDArray[np.float32]
    stop: Array
    unit: Array


WAYPOINT_FAVOUR = 1.0  # units by which a path over waypoints may be longer than a field's


@compiled
def value_at(way: Way, node: int) -> float:
    """Returns the value of a node in double precision."""
    return np.float64(way.values[node])


@compiled
def interpolate_field(way: Way, field: int, q: Array, downhill: Array) -> float:
    """Returns the trilinear value of a field at q; writes minus its gradient to `downhill`."""
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
    x00, x10 = lerp(v000, v100, x), lerp(v010, v110, x)
    x01, x11 = lerp(v001, v101, x), lerp(v011, v111, x)
    xy0, xy1 = lerp(x00, x10, y), lerp(x01, x11, y)
    slope_x = lerp(lerp(v100 - v000, v110 - v010, y), lerp(v101 - v001, v111 - v011, y), z)
    downhill[0] = -slope_x / way.spacing[field, 0]
    downhill[1] = -lerp(x10 - x00, x11 - x01, z) / way.spacing[field, 1]
    downhill[2] = -(xy1 - xy0) / way.spacing[field, 2]
    return lerp(xy0, xy1, z)


@compiled
def query_row(way: Way, q: Array, direction: Array) -> tuple[float, int]:
    """Returns the path's length (m) from q and the waypoint it leads to, -1 for none.

    It writes the path's unit direction to `direction` (3,).
    """
    offset, chosen, best = np.empty(3), -1, np.inf
    last = len(way.points) - 1
    for p in range(last, -1, -1):
        for k in range(3):
            offset[k] = way.points[p, k] - q[k]
        whole = norm(offset) + way.remaining[p]
        if whole < best and in_sight(way.tree, way.margin[p], way.most_margin[p], q, offset):
            chosen, best = p, whole
            unit(offset, direction)
            if p == last:
                return best, last
    for k in range(3):
        offset[k] = way.points[last, k] - q[k]
    straight = norm(offset)
    found = np.inf
    downhill = np.empty(3)
    for field in range(len(way.first) - 1, -1, -1):  # the finest that is defined at q
        found = interpolate_field(way, field, q, downhill)
        if math.isfinite(found):
            break
    found = max(found, straight) if math.isfinite(found) else np.inf
    if chosen >= 0 and best <= found + WAYPOINT_FAVOUR * way.unit[0]:
        return best, chosen
    unit(downhill, direction)
    return found, -1


@compiled
def query_rows(way: Way, which: Indices, q: Array, distance: Array, direction: Array) -> None:
    """Compiled loop of `query_row` over the simulations `which`, written to their rows."""
    for i in which:
        distance[i], _ = query_row(way, q[i], direction[i])
