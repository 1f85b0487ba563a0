"""Keeps boxes in a tree, so that what is asked about few of them does not look at all of them.

The tree is a bounding volume hierarchy: every node holds the hull of the boxes below it, parallel
to the axes, and every leaf about as many boxes as any other. Few boxes are all in one leaf, in
their own order. A kernel goes from leaf to leaf, and tests each box of a leaf as if there were no
tree: so the tree changes no result, only how many boxes are tested.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from mjcollect.geometry.boxes import slab
from mjcollect.geometry.compiled import Array, Indices, compiled, plain
from mjcollect.geometry.turns import around, is_near

FEW = 32  # Up to so many boxes are in one leaf.
LEAF = 8  # Of more, a leaf has at most so many.
ROUNDING = 1e-6  # Hulls are so many metres wider, more than turning and tests can round.


class Tree(NamedTuple):
    """Holds boxes and the nodes of their tree, L leaves after L - 1 inner nodes.

    Node k has the children 2k + 1 and 2k + 2. Of M boxes leaf l holds the `members` from l M // L
    up to (l + 1) M // L.

    Attributes:
        boxes: (M, 2 or 3, 3) m; more may follow that are not in the tree.
        nodes: (2 L - 1, 2, 3) m, hulls. members: (M,) indices of boxes.
    """

    boxes: Array
    nodes: Array
    members: Indices

    @classmethod
    def of(cls, boxes: Array) -> Tree:
        """Returns the tree of boxes (M, 2 or 3, 3)."""
        if len(boxes) <= FEW:
            return in_one_leaf(boxes)
        count, members = len(boxes), np.arange(len(boxes))
        leaves = 1 << math.ceil(math.log2(count / LEAF))
        hulls = around(boxes) + np.array([[-ROUNDING], [ROUNDING]])
        middle = hulls.mean(axis=1)
        width = leaves  # leaves below each node of a level
        while width > 1:
            for first in range(0, leaves, width):
                begin, end = first * count // leaves, (first + width) * count // leaves
                mine = members[begin:end]
                axis = int(np.ptp(middle[mine], axis=0).argmax())
                members[begin:end] = mine[np.argsort(middle[mine, axis], kind="stable")]
            width //= 2
        nodes = np.empty((2 * leaves - 1, 2, 3))
        for leaf in range(leaves):
            mine = hulls[members[leaf * count // leaves : (leaf + 1) * count // leaves]]
            nodes[leaves - 1 + leaf] = mine[:, 0].min(axis=0), mine[:, 1].max(axis=0)
        for node in range(leaves - 2, -1, -1):
            children = nodes[2 * node + 1 : 2 * node + 3]
            nodes[node] = children[:, 0].min(axis=0), children[:, 1].max(axis=0)
        return cls(plain(boxes), nodes, members)


def in_one_leaf(boxes: Array) -> Tree:
    """Returns trees with one leaf of boxes (..., M, 2 or 3, 3), with the same leading axes."""
    hulls = around(boxes)
    low = hulls[..., 0, :].min(axis=-2, initial=np.inf) - ROUNDING
    high = hulls[..., 1, :].max(axis=-2, initial=-np.inf) + ROUNDING
    nodes = np.stack([low, high], axis=-2)[..., None, :, :]
    members = np.broadcast_to(np.arange(boxes.shape[-3]), boxes.shape[:-2]).copy()
    return Tree(plain(boxes), nodes, members)


@compiled
def after(node: int) -> int:
    """Returns the node that follows one and all below it; -1 after the last."""
    while node > 0 and node % 2 == 0:  # Nodes with even numbers are their parent's last child.
        node = (node - 1) // 2
    return node + 1 if node > 0 else -1


@compiled
def next_leaf(tree: Tree, leaf: int, low: Array, high: Array, reach: float) -> int:
    """Returns the next leaf after one, -1 for the first, that may hold what is near; -1 for none.

    Near is a box that may come within `reach` metres of what lies between low and high (3,).
    """
    node = 0 if leaf < 0 else after(leaf)
    while node >= 0:
        if not is_near(low, high, reach, tree.nodes[node]):
            node = after(node)
        elif node >= len(tree.nodes) // 2:
            return node
        else:
            node = 2 * node + 1
    return -1


@compiled
def next_leaf_on(tree: Tree, leaf: int, start: Array, step: Array, most: float, grow: float) -> int:
    """Returns the next leaf after one, -1 for the first, that may hold what is on a line; or -1.

    The line leads from start (3,) to start + most step; boxes count as grown by `grow` metres.
    """
    node = 0 if leaf < 0 else after(leaf)
    while node >= 0:
        enter, leave = slab(start, step, tree.nodes[node], grow, 1e-9)
        if enter > leave or leave < 0.0 or enter > most:
            node = after(node)
        elif node >= len(tree.nodes) // 2:
            return node
        else:
            node = 2 * node + 1
    return -1


@compiled
def first_member(tree: Tree, leaf: int) -> int:
    """Returns where the `members` of a leaf begin; those of the next begin where they end."""
    leaves = len(tree.nodes) // 2 + 1
    return (leaf - leaves + 1) * len(tree.members) // leaves
