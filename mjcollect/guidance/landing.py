"""Says who of a fleet lands after whom: one that is home rests, and may shut another's way.

A depot may lie in a passage in which UAVs cannot pass each other, as in a blind alley. Then who
rests nearer to its mouth lands last. It is known beforehand: a way is shut if the place where a UAV
will rest, grown by its tolerance and by what UAVs keep apart, leaves no way round it close by.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import find_objects, label

from mjcollect.flight.world import World
from mjcollect.geometry.among_boxes import gap_to_boxes
from mjcollect.geometry.compiled import Array
from mjcollect.geometry.polyline import path_length, point_along
from mjcollect.guidance.guidance import Guidance
from mjcollect.guidance.room import Rooms

GRAIN = 8  # The way round a ball is looked for on a grid of so many points along its radius,
AROUND = 2  # in a cube whose half side is so many times the radius.


class Landing(NamedTuple):
    """Says what one UAV of M lets pass before it lands.

    Attributes:
        last: (M,) number of the last target of each other one whose way it shuts once it is home,
            -1 for none. path: (P, 3) m, all these ways. way_out: m that it would have to fly from
            its place until it is off them, inf if no way out was found.
    """

    last: tuple[int, ...]
    path: Array
    way_out: float


def landings(flights: Sequence[Sequence[Guidance]]) -> list[Landing | None]:
    """Returns what each of M UAVs lets pass before it lands, None for nothing.

    Of two that would each have to land after the other, the first one does not wait.

    Args:
        flights: the guidance of each UAV to each of its targets, the last of which is its place.
    """
    uavs = range(len(flights))
    shut = [[[] if i == j else _shut(flights[j][-1], flights[i]) for i in uavs] for j in uavs]
    after = np.eye(len(flights), dtype=bool)  # whether one lands after another, or is that one
    for i in uavs:
        for j in uavs:
            if len(flights[i]) - 1 in shut[j][i]:  # j has to land after i.
                if after[i, j]:
                    shut[j][i] = []
                else:
                    after |= np.outer(after[:, j], after[i])
    return [_landing(flights, j, shut[j]) if any(shut[j]) else None for j in uavs]


def _landing(flights: Sequence[Sequence[Guidance]], j: int, shut: list[list[int]]) -> Landing:
    """Returns what UAV j lets pass, which shuts the others' ways to their targets `shut`."""
    ways: list[Array] = []
    for legs, numbers in zip(flights, shut, strict=True):
        for number in numbers:
            way = _way(legs[number])
            # Led back, since what joins two ways must not lead across where there is room.
            ways += [way] if not ways else [way[::-1], way]
    path, place = np.concatenate(ways), flights[j][-1]
    world = World.stack([place.scene])
    out = Rooms().route(world, 0, place.goal, path, np.empty((0, 3)))
    far = path_length(np.concatenate([place.goal[None], out])) if len(out) else np.inf
    return Landing(tuple(max(numbers, default=-1) for numbers in shut), path, far)


def _way(leg: Guidance) -> Array:
    """Returns the path (P, 3) to a target, on to the target itself."""
    return np.concatenate([leg.path, leg.goal[None]])


def _shut(place: Guidance, legs: Sequence[Guidance]) -> list[int]:
    """Returns the numbers of the targets of one UAV whose way another one shuts, at rest at home.

    Args:
        place: guidance to where that one rests. legs: the guidance to each target.
    """
    radius = place.scene.apart + place.tolerance
    if np.linalg.norm(legs[-1].goal - place.goal) < radius:
        return []  # They have no places of their own.
    spacing, air = radius / GRAIN, None
    found: list[int] = []
    for number, leg in enumerate(legs):
        way = _way(leg)
        points = point_along(way, np.arange(0.0, path_length(way) + spacing, spacing))
        inside = np.linalg.norm(points - place.goal, axis=1) < radius
        if number == 0 and inside[0]:
            inside[: np.append(inside, False).argmin()] = False  # It starts there, and leaves.
        for (stretch,) in find_objects(label(inside)[0]):
            air = air or _Air(place, radius, spacing)
            if stretch.start > 0:
                before = air.at(points[stretch.start - 1])
            else:
                before = air.within(points[0], legs[number - 1].tolerance)
            if stretch.stop < len(points):
                behind = air.at(points[stretch.stop])
            else:
                behind = air.within(leg.goal, leg.tolerance)
            if not before & behind:
                found.append(number)
                break
    return found


class _Air:
    """Knows which places round one that is taken are connected."""

    def __init__(self, place: Guidance, radius: float, spacing: float) -> None:
        """Labels a grid of points round a place, but for those within `radius` m of it."""
        scene, half = place.scene, AROUND * GRAIN
        axis = spacing * np.arange(-half, half + 1)
        offset = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
        self._points = place.goal + offset
        free = np.linalg.norm(offset, axis=-1) >= radius
        low, high = scene.bounds
        free &= np.all((self._points >= low) & (self._points <= high), axis=-1)
        free[free] = gap_to_boxes(self._points[free], scene.tree, scene.reach) >= scene.reach
        self._labels: NDArray[np.intp] = label(free)[0]

    def within(self, point: Array, reach: float) -> set[int]:
        """Returns the parts of the air that one within `reach` m of a point (3,) can be in."""
        near = np.linalg.norm(self._points - point, axis=-1) <= reach
        return set(self._labels[near & (self._labels > 0)].tolist())

    def at(self, point: Array) -> set[int]:
        """Returns the part of the air that a free point (3,) is in, by the nearest of the grid."""
        gap = np.where(self._labels > 0, np.linalg.norm(self._points - point, axis=-1), np.inf)
        return {int(self._labels.flat[gap.argmin()])} - {0}
