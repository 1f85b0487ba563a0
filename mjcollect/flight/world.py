"""Stacks over simulations the scene constants that the rules of flight read."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mjcollect.geometry.boxes import EMPTY_BOX
from mjcollect.geometry.compiled import Array, Indices, compiled
from mjcollect.geometry.tree import Tree, in_one_leaf
from mjcollect.geometry.turns import with_turn
from mjcollect.scene.scene import Scene


class World(NamedTuple):
    """Holds scene constants stacked over simulations, N of them or 1 that all share.

    Attributes:
        bounds: (N, 2, 3) m. boxes: (N, M, 2 or 3, 3) m, padded with `EMPTY_BOX`.
        nodes, members: (N, ..., 2, 3) m, (N, M), the boxes' trees, see `geometry.tree.Tree`.
        v_max, a_max, radius, unit: (N, 1) in m/s, m/s^2, m, m; unit is that of `Scene.unit`.
        apart: (N, 1) m that the centres of two UAVs keep apart.
        slot, step: seconds of a slot and of a physics step, the same for all simulations.
        substeps: physics steps in a slot, n.
    """

    bounds: Array
    boxes: Array
    nodes: Array
    members: Indices
    v_max: Array
    a_max: Array
    radius: Array
    unit: Array
    apart: Array
    slot: float
    step: float
    substeps: int

    @classmethod
    def stack(cls, scenes: Sequence[Scene]) -> World:
        """Stacks one scene per simulation, or a single one that all share.

        Raises:
            ValueError: the scenes disagree on `slot` or `physics_step`.
        """
        first = scenes[0]
        for scene in scenes:
            if (scene.slot, scene.physics_step) != (first.slot, first.physics_step):
                raise ValueError(
                    f"scenes {first.name!r}, {scene.name!r}: slot {first.slot} and {scene.slot}, "
                    f"physics_step {first.physics_step} and {scene.physics_step}: simulations that "
                    "run side by side need the same slot and physics step"
                )
        most = max(len(scene.obstacles) for scene in scenes)
        turn = any(scene.boxes.shape[1] == 3 for scene in scenes)
        empty = with_turn(EMPTY_BOX) if turn else EMPTY_BOX
        boxes = np.broadcast_to(empty, (len(scenes), max(most, 1), *empty.shape)).copy()
        trees: dict[int, Tree] = {}
        for index, scene in enumerate(scenes):
            own = with_turn(scene.boxes) if turn else scene.boxes
            boxes[index, : len(scene.obstacles)] = own
            if id(scene) not in trees:
                whole = scene.boxes.shape == boxes[index].shape  # neither padded nor widened
                trees[id(scene)] = scene.tree if whole else Tree.of(boxes[index])
        tree = [trees[id(scene)] for scene in scenes]

        def column(field: str) -> Array:
            return np.array([[getattr(scene, field)] for scene in scenes])

        return cls(
            bounds=np.stack([scene.bounds for scene in scenes]),
            boxes=boxes,
            nodes=np.stack([each.nodes for each in tree]),
            members=np.stack([each.members for each in tree]),
            v_max=column("v_max"),
            a_max=column("a_max"),
            radius=column("reach"),
            unit=column("unit"),
            apart=column("apart"),
            slot=first.slot,
            step=first.physics_step,
            substeps=first.substeps,
        )

    def with_boxes(self, boxes: Array) -> World:
        """Returns the world with a few other boxes (N, M, 2 or 3, 3) in m."""
        return self._replace(**in_one_leaf(boxes)._asdict())

    def rows(self, which: Indices) -> World:
        """Returns the constants of the simulations `which` (n,) only."""
        if len(self.bounds) == 1:
            return self
        return self._replace(
            bounds=self.bounds[which],
            boxes=self.boxes[which],
            nodes=self.nodes[which],
            members=self.members[which],
            v_max=self.v_max[which],
            a_max=self.a_max[which],
            radius=self.radius[which],
            unit=self.unit[which],
            apart=self.apart[which],
        )


@compiled
def scene_of(world: World, i: int) -> int:
    """Returns the index of simulation i's scene in the world."""
    return i if len(world.bounds) > 1 else 0


@compiled
def tree_of(world: World, w: int) -> Tree:
    """Returns the tree of the boxes of scene w; boxes that move are not in it."""
    return Tree(world.boxes[w], world.nodes[w], world.members[w])
