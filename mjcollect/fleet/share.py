"""Gives each UAV of a fleet its part of a scene: its items, and a place of its own at its depot."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from itertools import combinations

import numpy as np

from mjcollect.geometry.among_boxes import gap_to_boxes, segment_clear
from mjcollect.geometry.compiled import Array
from mjcollect.scene.depots import depot_field, depot_of
from mjcollect.scene.file_format import SceneError
from mjcollect.scene.scene import Scene

GRID = 13  # Places are looked for in the directions of a cube's surface with such a grid.
SHARES = 0.025 * np.arange(18, 0, -1)  # Stops may miss them by one of these shares of the depot's
# tolerance, the greatest for which there is room.
STEEP = 12  # The force between places falls with this power of their distance.
TIE = 1e-9  # Of what is equal up to rounding the first counts, so that no machine decides.


def pads(scene: Scene, count: int, number: int = 0) -> tuple[Array, float]:
    """Returns places (count, 3) in m at a depot where UAVs start and end, and how exactly.

    UAVs that rest within the tolerance returned (m) of their places are within `return_tolerance`
    of the depot, and keep apart from each other. A single one has the depot itself. The depot is
    that of this `number` among the scene's depots.

    Raises:
        SceneError: so many do not find room.
    """
    depot = scene.depots[number]
    if count == 1:
        return depot[None].copy(), scene.return_tolerance
    whole = scene.return_tolerance
    # All places lie on one sphere: one inside of others could not be reached once they are taken.
    axis = np.linspace(-1.0, 1.0, GRID)
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    outer = grid[np.abs(grid).max(axis=1) == 1.0]
    ways = np.concatenate([outer / np.linalg.norm(outer, axis=1, keepdims=True), _ring(count)])
    for share in SHARES:
        tolerance = float(share) * whole
        if count > most_places(whole - tolerance, scene.apart + 2 * tolerance - TIE):
            continue
        chosen = spread(_free(scene, depot, depot + (whole - tolerance) * ways), count)
        if chosen is not None and least_gap(chosen) >= scene.apart + 2 * tolerance - TIE:
            return chosen, tolerance
    raise SceneError(
        "return_tolerance", whole,
        f"{count} UAVs that keep {scene.apart:g} m apart find no room within it at "
        f"{'the depot' if number == 0 else depot_field(number)}; "
        "raise it, lower separation, or take fewer UAVs",
    )  # fmt: skip


def most_places(radius: float, gap: float) -> float:
    """Returns how many points of a sphere can at most be `gap` m from each other.

    Round each there is a cap of the sphere that holds no part of another's cap.
    """
    if gap >= 2 * radius:
        return 1.0 if gap > 2 * radius else 2.0
    half = np.arcsin(gap / (2 * radius))  # half the angle between two, seen from the centre
    return float(2.0 / (1.0 - np.cos(half)))


def _ring(count: int) -> Array:
    """Returns unit vectors (count, 3) evenly round a level circle."""
    angle = 2 * np.pi * np.arange(count) / count
    return np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)


def _free(scene: Scene, depot: Array, points: Array) -> Array:
    """Returns those of points (n, 3) that a body reaches straight from a depot (3,)."""
    low, high = scene.bounds
    inside = np.all((points >= low) & (points <= high), axis=1)
    points = points[inside]
    clear = segment_clear(depot[None], points, scene.tree, scene.reach)
    clear &= gap_to_boxes(points, scene.tree, scene.reach) >= scene.reach
    return points[clear]


def spread(points: Array, count: int) -> Array | None:
    """Returns `count` of points (n, 3) that are far from each other; None if there are fewer.

    First each is the farthest from those before. Then they move one by one, like charges whose
    force falls steeply with the distance, until none is better placed elsewhere.
    """
    if len(points) < count:
        return None
    push_of = _pushes(points)
    chosen = [_least(-np.linalg.norm(points - points.mean(axis=0), axis=1))]
    while len(chosen) < count:
        chosen.append(_least(push_of.take(chosen, axis=1).sum(axis=1)))
    moved = True
    while moved:
        moved = False
        for uav in range(count):
            push = push_of.take(chosen[:uav] + chosen[uav + 1 :], axis=1).sum(axis=1)
            to = _least(push)
            if push[to] < push[chosen[uav]] * (1 - 1e-9):
                chosen[uav], moved = to, True
    return points[chosen]


def _pushes(points: Array) -> Array:
    """Returns how hard each of points (n, 3) pushes at each, as numbers (n, n)."""
    gap = np.linalg.norm(points[:, None] - points, axis=2)
    return np.asarray(np.maximum(gap, 1e-9) ** -STEEP)


def _least(values: Array) -> int:
    """Returns the index of the least of some values (n,), the first one of those as good as it."""
    least = values.min()
    return int(np.argmax(values <= least + TIE * abs(least)))


def least_gap(points: Array) -> float:
    """Returns the distance (m) of the two of points (n, 3) that are nearest to each other."""
    return min(float(np.linalg.norm(one - other)) for one, other in combinations(points, 2))


def parts(
    scene: Scene, tours: Sequence[Sequence[int]], depots: Sequence[int] | None = None
) -> tuple[Scene, ...]:
    """Returns one scene for each tour: its items in the order of visit, a place at its depot.

    They share what is computed of the boxes. A scene of one UAV is the scene itself, with its items
    in the order of visit, and has no further depots.

    Args:
        tours: indices of items, at least one each; no item twice.
        depots: numbers of the depots of these tours; None for m mod D of tour m.

    Raises:
        SceneError: so many UAVs find no room at a depot, or two depots are too near to each other.
    """
    if depots is None:
        depots = [depot_of(uav, len(scene.depots)) for uav in range(len(tours))]
    places, tolerances = np.zeros((len(tours), 3)), np.zeros(len(tours))
    for number in sorted(set(depots)):
        own = [uav for uav, depot in enumerate(depots) if depot == number]
        places[own], tolerances[own] = pads(scene, len(own), number)
    _check_apart(scene, depots, places, tolerances)
    return tuple(
        _part(scene, f"{scene.name} {uav}", tour, places[uav], float(tolerances[uav]))
        for uav, tour in enumerate(tours)
    )


def _check_apart(scene: Scene, depots: Sequence[int], places: Array, tolerances: Array) -> None:
    """Refuses places (M, 3) at different depots where UAVs at rest could come too near.

    Args:
        depots: the number of each one's depot. tolerances: (M,) m within which they rest.
    """
    for one, other in combinations(range(len(places)), 2):
        if depots[one] == depots[other]:
            continue  # `pads` keeps these apart.
        gap = float(np.linalg.norm(places[one] - places[other]))
        short = scene.apart + float(tolerances[one] + tolerances[other]) - gap
        if short > TIE:
            first, last = sorted((depots[one], depots[other]))
            raise SceneError(
                depot_field(last), scene.depots[last].tolist(),
                f"has a place {gap:.3g} m from one at {depot_field(first)}, where UAVs at rest may "
                f"come nearer than {scene.apart:g} m; move it {short:.3g} m away, or lower "
                "return_tolerance or separation",
            )  # fmt: skip


def _part(scene: Scene, name: str, tour: Sequence[int], depot: Array, tolerance: float) -> Scene:
    own = copy.copy(scene)  # with what it has computed of its boxes, which stay as they are
    values = {"items": scene.items[list(tour)], "depot": depot.copy()}
    values["more_depots"] = np.zeros((0, 3))
    for array in values.values():
        array.setflags(write=False)
    for name_, value in {**values, "name": name, "return_tolerance": tolerance}.items():
        object.__setattr__(own, name_, value)
    return own
