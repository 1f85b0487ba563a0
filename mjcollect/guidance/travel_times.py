"""Computes the cost between nodes among obstacles: the least time along the shortest free path."""

from __future__ import annotations

import numpy as np

from mjcollect.geometry.among_boxes import segment_clear
from mjcollect.geometry.compiled import Array
from mjcollect.geometry.polyline import path_length, tighten
from mjcollect.guidance.aim import feasible_aim, place
from mjcollect.guidance.distance_field import DistanceField, way_down
from mjcollect.guidance.guidance import COARSE, WIDE, Guidance
from mjcollect.scene.bounds import leg_time
from mjcollect.scene.scene import Scene

# A field with more nodes takes seconds; a wider one, in a cube a fifteenth of that. Paths are
# tightened, so that times differ by 0.1% in the mean among 20 floating boxes and 0.4% in a city.
MOST_NODES = 250_000


def travel_times(scene: Scene, depots: int = 1) -> Array:
    """Returns symmetric (D + K, D + K) seconds between nodes, for `plan_order` and `assign`.

    The first D of the scene's depots come first. Between them nothing is flown: it takes 0 s.

    A stop anywhere in a node's ball counts: epsilon is taken off at each item's end. One distance
    field is marched for each node with a blocked neighbour; a pair that its grid does not join
    gets the finer field of `Guidance`.

    Raises:
        GuidanceError: the finest grid does not join two nodes.
    """
    homes = [-1 - depot for depot in range(depots)]
    nodes = [*homes, *range(len(scene.items))]
    points = np.array([place(scene, node) for node in nodes])  # items may be too near to a wall
    length = np.asarray(np.linalg.norm(points[:, None] - points[None], axis=-1))
    clear = segment_clear(points[:, None], points[None], scene.tree, scene.reach)
    sides = scene.bounds[1] - scene.bounds[0]
    nodes_of_coarse = np.prod(np.ceil(sides / sides.max() * COARSE) + 1)
    cells = COARSE if nodes_of_coarse <= MOST_NODES else WIDE
    for to in range(depots, len(nodes)):
        blocked = np.flatnonzero(~clear[:to, to])
        if len(blocked) == 0:
            continue
        aim = feasible_aim(scene, points[to], scene.tolerance(nodes[to]))
        field = DistanceField(scene, aim, cells, crowding=0.0)
        for start in blocked:
            if field.entry(points[start]) is None:
                way = Guidance(scene, nodes[to], points[start]).length
            else:
                found = way_down(field, scene, points[start], aim)
                tight = tighten(found, scene.tree, scene.reach, scene.unit)
                way = path_length(tight)
            length[start, to] = length[to, start] = way
    taken = np.array([0.0 if node < 0 else scene.epsilon for node in nodes])
    free = np.maximum(length - taken[:, None] - taken[None], 0.0)
    cost = np.array(leg_time(free, scene.v_max, scene.a_max))
    np.fill_diagonal(cost, 0.0)
    cost[:depots, :depots] = 0.0
    return cost
