"""Computes shortest free path lengths to a point on a grid, by fast marching (scikit-fmm).

The grid is vertex-centred and conservative: a node counts as blocked if any part of its cell is
within the body's radius of a box, so a path through free nodes never touches a box.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
import skfmm
from numpy.typing import NDArray
from scipy import ndimage

from mjcollect.geometry.among_boxes import gap_to_boxes, segment_clear
from mjcollect.geometry.compiled import Array
from mjcollect.geometry.occupancy import blocked_grid
from mjcollect.scene.scene import Scene

CROWDING = 0.5  # A metre right at a box or bound counts as 1.5, so that paths keep clear of both.
CROWDED = 25.0  # units of the scene; farther than this from boxes and bounds a metre counts as one
RISE = 2.0  # In blocked cells the field rises by so many metres a metre from the nearest free one.


class DistanceField:
    """Holds the distances in m to `aim` on a grid over the bounds, longer where it is crowded.

    Attributes:
        low, h: (3,), position of the first node, and spacing of nodes, in metres.
    """

    def __init__(
        self,
        scene: Scene,
        aim: Array,
        cells: int,
        within: tuple[Array, float] | None = None,
        crowding: float = CROWDING,
    ) -> None:
        """Marches from `aim` (3,) over `cells` cells along the longest axis.

        Args:
            within: (focus (3,), total): only the ellipsoid with foci `focus` and `aim` and `total`
                metres as the sum of distances is marched; elsewhere the field is undefined. Every
                path from `focus` of at most that length lies inside.
            crowding: by how much a metre right at a box or bound counts more than one.
        """
        low, high = scene.bounds
        count = np.maximum(np.ceil((high - low) / np.max(high - low) * cells), 4).astype(int)
        self._scene, self.low, self.h = scene, low, (high - low) / count
        first, last = np.zeros(3, dtype=int), count
        if within is not None:  # the grid has only the nodes around the ellipsoid
            reach = _half_widths(*within, aim)
            middle = (within[0] + aim) / 2
            first = np.clip(np.floor((middle - reach - low) / self.h).astype(int), 0, count - 1)
            last = np.clip(np.ceil((middle + reach - low) / self.h).astype(int), first + 1, count)
            self.low = low + first * self.h
        nodes = last - first + 1
        self._shape = int(nodes[0]), int(nodes[1]), int(nodes[2])
        bounds = np.stack([self.low, self.low + (last - first) * self.h])
        blocked = blocked_grid(bounds, scene.boxes, scene.reach, self._shape)
        straight = self._straight(aim)
        outside = None
        if within is not None:
            outside = straight + self._straight(within[0]) > within[1]
        # The front starts from a small ball, inside which the straight distance is exact.
        ball = 2.0 * float(np.max(self.h))
        near = np.argwhere(straight <= ball)
        seen = segment_clear(self.points(near), aim, scene.tree, scene.reach)
        seen &= ~self._leaks(near, straight, ball, blocked)
        blocked[tuple(near.T)] = ~seen
        self._connected = bool(seen.any())
        if not self._connected:
            self._distance = np.full(self._shape, np.nan, dtype=np.float32)
        else:
            closed = blocked if outside is None else blocked | outside
            front = np.ma.MaskedArray(straight - ball, closed)
            pace = np.ones(self._shape)
            if crowding > 0.0:
                pace /= 1.0 + crowding * self._crowding(blocked)
            try:
                distance = skfmm.travel_time(front, pace, dx=self.h.tolist())
                distance = np.ma.filled(distance, np.nan) + ball
            except ValueError:  # "no zero contour": no node around the ball is free
                distance = np.full(self._shape, np.nan)
            inside = tuple(near[seen].T)
            distance[inside] = straight[inside]
            self._distance = distance.astype(np.float32)
        self._free, self._outside = np.isfinite(self._distance), outside

    def _leaks(
        self, near: np.ndarray, straight: Array, ball: float, blocked: np.ndarray
    ) -> np.ndarray:
        """Returns for which nodes (n, 3) of the ball a free step out of it leads through a box.

        Only there is that possible: outside the ball no cell is free that a box is in.
        """
        scene, found = self._scene, np.zeros(len(near), dtype=bool)
        for step in np.concatenate([np.eye(3, dtype=int), -np.eye(3, dtype=int)]):
            to = np.clip(near + step, 0, np.array(self._shape) - 1)
            where = np.flatnonzero((straight[tuple(to.T)] > ball) & ~blocked[tuple(to.T)])
            ends = self.points(near[where]), self.points(to[where])
            found[where] |= ~segment_clear(*ends, scene.tree, scene.reach)
        return found

    def _crowding(self, blocked: np.ndarray) -> np.ndarray:
        """Returns how near each node is to boxes or bounds: 1 at them, 0 from CROWDED on."""
        away = ndimage.distance_transform_edt(~blocked, sampling=self.h)
        low, high = self._scene.bounds
        for axis in range(3):
            at = self.low[axis] + self.h[axis] * np.arange(self._shape[axis])
            wall = np.minimum(at - low[axis], high[axis] - at)
            away = np.minimum(away, np.expand_dims(wall, [k for k in range(3) if k != axis]))
        return np.asarray(np.clip(1.0 - away / (CROWDED * self._scene.unit), 0.0, 1.0))

    def _straight(self, point: Array) -> Array:
        square = [
            (self.low[k] + self.h[k] * np.arange(self._shape[k]) - point[k]) ** 2 for k in range(3)
        ]
        return np.asarray(
            np.sqrt(square[0][:, None, None] + square[1][None, :, None] + square[2][None, None, :])
        )

    @cached_property
    def filled(self) -> NDArray[np.float32]:
        """Returns the field (X, Y, Z) in m, continued into blocked cells; NaN where undefined.

        There it rises away from the nearest free cell.
        """
        if not self._connected:
            return self._distance
        away, index = ndimage.distance_transform_edt(
            ~self._free, sampling=self.h, return_indices=True
        )
        filled = self._distance[tuple(index)] + np.float32(RISE) * away.astype(np.float32)
        if self._outside is not None:
            filled[self._outside] = np.nan
        return np.asarray(filled)

    def points(self, nodes: np.ndarray) -> Array:
        """Returns the positions (n, 3) in m of grid nodes (n, 3)."""
        return np.asarray(self.low + nodes * self.h)

    def entry(self, start: Array) -> tuple[int, ...] | None:
        """Returns the best node near `start` (3,) joined to the aim and clear to reach, or None.

        If there is one, the way to it keeps about the clearance that `start` has.
        """
        index = np.rint((start - self.low) / self.h).astype(int)
        near = index + np.stack(np.meshgrid(*[np.arange(-2, 3)] * 3, indexing="ij"), -1)
        near = near.reshape(-1, 3)
        near = near[np.all((near >= 0) & (near < self._shape), axis=1)]
        near = near[self._free[tuple(near.T)]]
        scene = self._scene
        for reach in (room_kept(scene, start), scene.reach):
            clear = segment_clear(start, self.points(near), scene.tree, reach)
            if clear.any():
                break
        else:
            return None
        near = near[clear]
        total = np.linalg.norm(self.points(near) - start, axis=1) + self._distance[tuple(near.T)]
        return tuple(near[int(np.argmin(total))])

    def descend(self, node: tuple[int, ...]) -> tuple[int, ...] | None:
        """Returns the neighbour (of 26) with the steepest descent; None where none is lower.

        Near the aim a node's cell need not be free throughout, so the step itself must be clear.
        """
        low = np.maximum(np.array(node) - 1, 0)
        high = np.minimum(np.array(node) + 2, self._shape)
        block = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
        near = np.stack(
            np.meshgrid(*[np.arange(s.start, s.stop) for s in block], indexing="ij"), -1
        )
        length = np.linalg.norm((near - np.array(node)) * self.h, axis=-1)
        fall = self._distance[node] - self._distance[block]
        slope = np.where(length > 0, fall / np.maximum(length, 1e-9), -np.inf)
        slope = np.nan_to_num(slope, nan=-np.inf)
        here, scene = self.points(np.array(node)), self._scene
        clear = segment_clear(here, self.points(near), scene.tree, scene.reach)
        slope[~clear] = -np.inf
        best = np.unravel_index(np.argmax(slope), slope.shape)
        return tuple(near[best]) if slope[best] > 0 else None


def _half_widths(focus: Array, total: float, aim: Array) -> Array:
    """Returns the half widths (3,) in m of the box around the ellipsoid with these two foci."""
    axis = aim - focus
    focal = float(np.linalg.norm(axis))
    minor = (max(total, focal) ** 2 - focal**2) / 4
    return np.asarray(np.sqrt(minor + axis**2 / 4))


WAY_ROOM = 2.5  # units of the scene; clearance that paths keep from boxes where they can


def room_kept(scene: Scene, point: Array) -> float:
    """Returns the distance (m) from boxes that a way to or from a point (3,) should keep."""
    beside = float(gap_to_boxes(point, scene.tree)) - scene.reach
    return scene.reach + min(1.01 * WAY_ROOM * scene.unit, max(0.9 * beside, 0.0))


class NoWay(ValueError):
    """Says that a field does not join two points."""


def way_down(field: DistanceField, scene: Scene, start: Array, aim: Array) -> Array:
    """Returns a free path (P, 3) from `start` down a field to its aim, both (3,), node by node.

    The last piece is straight, with WAY_ROOM of clearance unless the aim itself has less.

    Raises:
        NoWay: the field does not join the two points.
    """
    radius, boxes, reach = scene.reach, scene.tree, room_kept(scene, aim)
    points, node = [start], field.entry(start)
    while not segment_clear(points[-1], aim, boxes, reach):
        if node is None:
            if segment_clear(points[-1], aim, boxes, radius):
                break
            raise NoWay(f"no way down from {points[-1].tolist()} to {aim.tolist()}")
        points.append(field.points(np.array(node)))
        node = field.descend(node)
    return np.array([*points, aim])
