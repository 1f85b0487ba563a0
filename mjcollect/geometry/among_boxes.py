"""Answers what is asked about many boxes at once: what is clear, in sight, free, or near.

Boxes beyond a tree's members, such as moving ones, count in `free_way` and `nearest_box`, which
decisions are made from.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mjcollect.geometry.boxes import box_offset, segment_gap, slab
from mjcollect.geometry.compiled import Array, Bools, compiled, rows
from mjcollect.geometry.tree import Tree, first_member, next_leaf, next_leaf_on

FARTHEST = 1e6  # metres; no way is longer


@compiled
def segments_clear(start: Array, end: Array, tree: Tree, radius: float, clear: Bools) -> None:
    """Writes to `clear` (n,) whether each segment keeps `radius` m from every box."""
    step = np.empty(3)
    for i in range(len(start)):
        for k in range(3):
            step[k] = end[i, k] - start[i, k]
        clear[i] = True
        leaf = next_leaf_on(tree, -1, start[i], step, 1.0, radius)
        while leaf >= 0 and clear[i]:
            for m in range(first_member(tree, leaf), first_member(tree, leaf + 1)):
                if segment_gap(start[i], end[i], tree.boxes[tree.members[m]]) < radius:
                    clear[i] = False
                    break
            leaf = next_leaf_on(tree, leaf, start[i], step, 1.0, radius)


@compiled
def in_sight(tree: Tree, grow: Array, most: float, q: Array, offset: Array) -> bool:
    """Returns whether the segment from q (3,) to q + offset misses every box.

    Each box is grown by a number of metres of its own, `grow` (M,), `most` at most.
    """
    leaf = next_leaf_on(tree, -1, q, offset, 1.0, most)
    while leaf >= 0:
        for m in range(first_member(tree, leaf), first_member(tree, leaf + 1)):
            b = tree.members[m]
            enter, leave = slab(q, offset, tree.boxes[b], grow[b], 1e-12)
            if enter <= leave and leave >= 0.0 and enter <= 1.0:
                return False
        leaf = next_leaf_on(tree, leaf, q, offset, 1.0, most)
    return True


@compiled
def free_way(tree: Tree, grow: float, q: Array, direction: Array) -> float:
    """Returns the metres from q along `direction` to the first box grown by `grow`, or FARTHEST.

    Grown boxes that q itself lies in do not count.
    """
    free = FARTHEST
    leaf = next_leaf_on(tree, -1, q, direction, free, grow)
    while leaf >= 0:
        for m in range(first_member(tree, leaf), first_member(tree, leaf + 1)):
            enter, leave = slab(q, direction, tree.boxes[tree.members[m]], grow, 1e-9)
            if 0.0 <= enter <= leave:
                free = min(free, enter)
        leaf = next_leaf_on(tree, leaf, q, direction, free, grow)
    for b in range(len(tree.members), len(tree.boxes)):
        enter, leave = slab(q, direction, tree.boxes[b], grow, 1e-9)
        if 0.0 <= enter <= leave:
            free = min(free, enter)
    return free


@compiled
def nearest_box(tree: Tree, q: Array, reach: float, to: Array) -> float:
    """Returns the distance (m) of q (3,) from the nearest box; `reach` if none is nearer.

    Writes the vector to the nearest point of that box to `to` (3,), if there is one.
    """
    offset = np.empty(3)
    leaf = next_leaf(tree, -1, q, q, reach)
    while leaf >= 0:
        for m in range(first_member(tree, leaf), first_member(tree, leaf + 1)):
            gap = box_offset(q, tree.boxes[tree.members[m]], offset)
            if gap < reach:
                reach = gap
                to[:] = offset
        leaf = next_leaf(tree, leaf, q, q, reach)
    for b in range(len(tree.members), len(tree.boxes)):
        gap = box_offset(q, tree.boxes[b], offset)
        if gap < reach:
            reach = gap
            to[:] = offset
    return reach


@compiled
def gaps_to_boxes(tree: Tree, points: Array, reach: float, gap: Array) -> None:
    """Writes to `gap` (n,) how far (m) points (n, 3) are from the nearest box, at most `reach`."""
    to = np.empty(3)
    for i in range(len(points)):
        gap[i] = nearest_box(tree, points[i], reach, to)


def gap_to_boxes(points: Array, tree: Tree, reach: float = np.inf) -> Array:
    """Returns how far (...) in m points (..., 3) are from the nearest box, at most `reach`."""
    gap = np.empty(points.shape[:-1])
    gaps_to_boxes(tree, rows(points, points.shape[:-1], (3,)), float(reach), gap.reshape(-1))
    return gap


def segment_clear(
    start: Array, end: Array, boxes: Tree | Array, radius: float
) -> NDArray[np.bool_]:
    """Returns whether a body of `radius` metres flies each segment without touching any box.

    Args:
        start, end: (..., 3). boxes: (M, 2 or 3, 3), or their tree.

    Returns:
        (...) booleans.
    """
    shape = np.broadcast_shapes(start.shape[:-1], end.shape[:-1])
    clear = np.empty(shape, dtype=bool)
    tree = boxes if isinstance(boxes, Tree) else Tree.of(boxes)
    segments_clear(
        rows(start, shape, (3,)),
        rows(end, shape, (3,)),
        tree,
        float(radius),
        clear.reshape(-1),
    )
    return clear
