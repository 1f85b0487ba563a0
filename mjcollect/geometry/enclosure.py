"""Finds the nodes of a scene that are walled in: by proof, never on a grid's evidence alone.

A conservative grid, on which every free cell is free throughout, shows nearly every node to be
reachable. For the rest, space is cut exactly at the faces of boxes that lie inside the forbidden
set. What these leave free contains all that is truly free, so a node enclosed in it is walled in.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mjcollect.geometry.among_boxes import segment_clear
from mjcollect.geometry.compiled import Array
from mjcollect.geometry.occupancy import Mask, blocked_grid
from mjcollect.geometry.tree import Tree
from mjcollect.geometry.turns import inside

_DEPOT = -1  # This node is the depot, as in `scene.order`, which this room cannot import.
_GRIDS = (50, 100, 200)  # Grids of so many cells along the bounds' longest side are tried in turn.
_LOOKS = 100  # A node between blocked cells is tried with this many of the nearest free ones.
_MAX_CELLS = 4_000_000  # An exact decomposition has no more cells: so many take half a second.
_MANY_BOXES = 78  # So many boxes, with two lines a box and axis, always stay below _MAX_CELLS.
_GROWTH = 3.0  # Each window of the proof is this many times as wide as the one before.
_WIDEST = 0.1  # An item's windows have half sides below this share of the bounds' longest.
# A box is grown along each of these sets of axes, by radius / sqrt(their number): each box so grown
# lies within `radius` of the original.
_ALL_SUBSETS = np.array([axes for axes in product((0.0, 1.0), repeat=3) if any(axes)])
_ONE_SUBSET = np.ones((1, 3))
# Boxes are grown by this share less, since a gap of exactly the body's width can be passed.
_MARGIN = 1e-6


class Space(NamedTuple):
    """Holds what is needed of a scene, see `scene.scene.Scene`; node -1 is the depot.

    Attributes:
        bounds: (2, 3) m. tree: of the obstacles. uav_radius: m. depot: (3,). items: (K, 3).
        epsilon: m, how near to an item the body must come.
    """

    bounds: Array
    tree: Tree
    uav_radius: float
    depot: Array
    items: Array
    epsilon: float


def walled_in(space: Space) -> list[int]:
    """Returns the nodes that are proved to be walled in: items cut off from the depot.

    They are [-1] if all items are cut off and the depot's part is less than half of the space.
    """
    suspects = _unconnected(space)
    if not suspects:
        return []
    home = _home(space)
    cut = [item for item in suspects if not np.any(home.near(space.items[item], space.epsilon))]
    small = home.volume < float(np.prod(space.bounds[1] - space.bounds[0])) / 2
    if small and len(cut) == len(space.items):
        return [_DEPOT]
    return [item for item in suspects if item in cut or _enclosed(space, item)]


# The evidence: grids


def _unconnected(space: Space) -> list[int]:
    """Returns the items that no grid shows to be connected to the depot."""
    left = list(range(len(space.items)))
    if len(space.tree.boxes) == 0:
        return []
    extent = space.bounds[1] - space.bounds[0]
    for cells in _GRIDS:
        count = np.maximum(1, np.ceil(extent * cells / extent.max())).astype(int)
        shape = (int(count[0]) + 1, int(count[1]) + 1, int(count[2]) + 1)
        free = ~blocked_grid(space.bounds, space.tree.boxes, space.uav_radius, shape)
        labels = _label(free, corners=False)
        home = _entries(space, _DEPOT, labels)
        left = [item for item in left if home.isdisjoint(_entries(space, item, labels))]
        if not left:
            break
    return left


def _label(free: Mask, *, corners: bool) -> NDArray[np.int32]:
    """Numbers connected free parts from 1, blocked cells 0; `corners`: whether corners connect."""
    from scipy import ndimage

    structure = ndimage.generate_binary_structure(3, 3 if corners else 1)
    return np.asarray(ndimage.label(free, structure)[0])


def _entries(space: Space, node: int, labels: NDArray[np.int32]) -> set[int]:
    """Returns the grid's parts that can be entered from where the UAV may stand for `node`.

    Either a free cell touches the tolerance ball, or the way to the centre of one nearby is clear.
    The mission starts at the depot itself, so the depot's ball has no extent.
    """
    point = space.depot if node == _DEPOT else space.items[node]
    reach = 0.0 if node == _DEPOT else space.epsilon
    low = space.bounds[0]
    last_node = np.array(labels.shape) - 1
    spacing = (space.bounds[1] - low) / last_node
    first = np.maximum(0, np.floor((point - reach - low) / spacing - 2).astype(int))
    last = np.minimum(last_node, np.ceil((point + reach - low) / spacing + 2).astype(int))
    window = labels[tuple(slice(a, b + 1) for a, b in zip(first, last, strict=True))]
    index = np.argwhere(window)
    found = window[tuple(index.T)]
    centres = np.clip(low + (index + first) * spacing, *space.bounds)
    away = np.abs(point - centres)
    touching = np.linalg.norm(np.maximum(away - spacing / 2, 0.0), axis=1) <= reach
    if np.any(touching):
        return set(found[touching].tolist())
    nearest = np.argsort(np.linalg.norm(away, axis=1), kind="stable")[:_LOOKS]
    seen = segment_clear(point, centres[nearest], space.tree, space.uav_radius)
    return set(found[nearest][seen].tolist())


# The proof: an exact decomposition


@dataclass(frozen=True)
class _Pocket:
    """A pocket is a union of cells between `lines`, one array of coordinates (m) per axis."""

    lines: list[Array]
    cells: Mask

    @property
    def volume(self) -> float:
        """Returns the volume of the cells in cubic metres."""
        x, y, z = (np.diff(line) for line in self.lines)
        return float(np.einsum("ijk,i,j,k", self.cells.astype(float), x, y, z))

    def near(self, point: Array, reach: float) -> Mask:
        """Returns which of its closed cells come within `reach` metres of a point (3,)."""
        x, y, z = (
            np.maximum(np.maximum(line[:-1] - at, at - line[1:]), 0.0) ** 2
            for line, at in zip(self.lines, point, strict=True)
        )
        return self.cells & (x[:, None, None] + y[:, None] + z <= reach**2)


def _home(space: Space) -> _Pocket:
    """Returns the space around the depot that contains all that can be reached from it."""
    half = 2.0 * space.uav_radius
    while True:
        pocket, leaves = _component(space, space.depot, 0.0, half)
        if not leaves:
            return pocket
        half *= _GROWTH


def _enclosed(space: Space, item: int) -> bool:
    """Returns whether a window around an item proves that it is cut off.

    A small window has few boxes, so their shapes are exact; `_home` finds larger enclosures.
    """
    half = 2.0 * (space.epsilon + space.uav_radius)
    while half < _WIDEST * np.max(space.bounds[1] - space.bounds[0]):
        pocket, leaves = _component(space, space.items[item], space.epsilon, half)
        if not leaves:
            return not np.any(pocket.near(space.depot, 0.0))
        half *= _GROWTH
    return False


def _component(space: Space, point: Array, reach: float, half: float) -> tuple[_Pocket, bool]:
    """Returns free space that holds all that can be reached from a ball inside a window around it.

    The ball has the radius `reach`, the window the half side `half`, both in metres. Closed free
    cells count as connected where they share a corner, so no path is missed.

    Returns:
        The space, and whether it touches a side of the window that is not one of the bounds.
    """
    low = np.maximum(point - half, space.bounds[0])
    high = np.minimum(point + half, space.bounds[1])
    lines, free = _decompose(space, low, high)
    labels = _label(free, corners=True)
    start = _Pocket(lines, free).near(point, reach)
    cells = np.isin(labels, np.unique(labels[start])) & free
    return _Pocket(lines, cells), _leaves(cells, low > space.bounds[0], high < space.bounds[1])


def _leaves(cells: Mask, open_low: Mask, open_high: Mask) -> bool:
    """Returns whether cells touch a side of the window that is not a side of the bounds."""
    for axis in range(3):
        layers = np.moveaxis(cells, axis, 0)
        if (open_low[axis] and np.any(layers[0])) or (open_high[axis] and np.any(layers[-1])):
            return True
    return False


def _decompose(space: Space, low: Array, high: Array) -> tuple[list[Array], Mask]:
    """Returns the lines (m) between a window's cells, and which cells are free.

    Where there would be too many cells, first the boxes' shapes get cruder, then small boxes are
    left out: both only add free space, so the proof holds.
    """
    boxes = inside(space.tree.boxes)  # Of turned boxes only a part counts: that adds free space.
    near = np.all(
        (boxes[:, 0] - space.uav_radius <= high) & (boxes[:, 1] + space.uav_radius >= low), axis=1
    )
    obstacles = boxes[near]
    x, y, z = (obstacles[:, 1] - obstacles[:, 0]).T
    largest = np.argsort(-(x * y + y * z + z * x), kind="stable")[:_MANY_BOXES]
    for kept, subsets in (
        (obstacles, _ALL_SUBSETS),
        (obstacles, _ONE_SUBSET),
        (obstacles[largest], _ONE_SUBSET),
    ):
        boxes = np.clip(_inner_boxes(kept, space.uav_radius, subsets), low, high)
        lines = [np.unique([low[k], high[k], *boxes[:, :, k].ravel()]) for k in range(3)]
        shape = tuple(len(line) - 1 for line in lines)
        if np.prod(shape, dtype=float) <= _MAX_CELLS:
            break
    free = np.ones(shape, dtype=bool)
    for box in boxes:
        free[
            tuple(
                slice(*np.searchsorted(line, box[:, axis]).tolist())
                for axis, line in enumerate(lines)
            )
        ] = False
    return lines, free


def _inner_boxes(boxes: Array, radius: float, subsets: Array) -> Array:
    """Returns boxes (N, 2, 3) inside the set of points closer than `radius` to one of `boxes`."""
    grow = subsets * radius * (1 - _MARGIN) / np.sqrt(subsets.sum(axis=1, keepdims=True))
    grown = np.stack([boxes[:, None, 0] - grow, boxes[:, None, 1] + grow], axis=-2)
    return grown.reshape(-1, 2, 3)
