"""Says whose depot is which, and refuses those that no UAV could start from.

As nodes the depot is -1, `more_depots[0]` is -2 and so on.
"""

from __future__ import annotations

import numpy as np

from mjcollect.geometry.boxes import point_box_distance
from mjcollect.geometry.compiled import Array
from mjcollect.geometry.enclosure import Space, walled_in
from mjcollect.scene.file_format import SceneError
from mjcollect.scene.moving import MovingBox


def depot_of(uav: int, depots: int) -> int:
    """Returns the number of the depot, of so many, where a UAV of a fleet starts and ends."""
    return uav % depots


def depot_field(index: int) -> str:
    """Returns the key of a scene file that holds a depot, for errors: `depot` is number 0."""
    return "depot" if index == 0 else f"more_depots[{index - 1}]"


def check_inside(depots: Array, bounds: Array) -> None:
    """Refuses depots (D, 3) in m outside of the bounds (2, 3).

    Raises:
        SceneError: there is one.
    """
    outside = np.any((depots < bounds[0]) | (depots > bounds[1]), axis=1)
    for index in np.flatnonzero(outside).tolist():
        fix = "lies outside the bounds; move it inside"
        raise SceneError(depot_field(index), depots[index].tolist(), fix)


def check_room(depots: Array, boxes: Array, reach: float, radius: str) -> None:
    """Refuses depots (D, 3) nearer than `reach` metres to one of the boxes, as they stand.

    Args:
        radius: what `reach` consists of, in words.

    Raises:
        SceneError: there is one.
    """
    for index, depot in enumerate(depots):
        distance = point_box_distance(depot, boxes)
        for box in np.flatnonzero(distance < reach).tolist():
            raise SceneError(
                depot_field(index),
                depot.tolist(),
                f"is {distance[box]:.3g} m from obstacles[{box}], closer than the body's "
                f"radius uav_radius = {radius} m; move the depot or the obstacle",
            )


def check_moving_box(depots: Array, box: MovingBox, reach: float, field: str) -> None:
    """Refuses a moving box, named `field`, that is nearer than `reach` m to a depot at first.

    Raises:
        SceneError: it is.
    """
    start = box.box_at(0.0)[None]
    if min(point_box_distance(depot, start)[0] for depot in depots) < reach:
        fix = "stands on the depot at first; begin its path elsewhere"
        raise SceneError(f"{field}.path[0]", list(box.path[0]), fix)


def check_open(space: Space, more: Array, clearance: str) -> None:
    """Refuses items that are walled in from the depot, and depots that are from every item.

    Args:
        space: with the depot. more: (D - 1, 3) m, the others. clearance: in words, or nothing.

    Raises:
        SceneError: there is one.
    """
    passage = f"; open a passage wider than the body{clearance} or move it"
    for node in walled_in(space):
        field, point = ("depot", space.depot) if node < 0 else (f"items[{node}]", space.items[node])
        cut = "every item" if node < 0 else "the depot"
        fix = f"is walled in: obstacles close it off from {cut}{passage}"
        raise SceneError(field, point.tolist(), fix)
    # All items are in the depot's part of space: who is cut off from one is cut off from all.
    for index, depot in enumerate(more):
        if walled_in(space._replace(depot=depot)):
            fix = f"is walled in: obstacles close it off from every item{passage}"
            raise SceneError(f"more_depots[{index}]", depot.tolist(), fix)
