"""What a leg's way costs: its tight shape, and by how much turns take more than its length.

Beside a box a body at v_max turns on a circle of v_max^2 / a_max, so a way round corners takes
longer than its length. By how much is found by flying it: with a slot too few, the best motion
stops short of the end, and by more than the length alone explains.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mjcollect.geometry import Array, segment_clear
from mjcollect.paths import path_length, tighten
from mjcollect.planners.allotment import Route, least_slots, reach
from mjcollect.planners.program import COMFORT, Program
from mjcollect.scene import Scene

SOFT_ROUNDS = 8  # of solving anew while boxes are overlapped
ROUNDS = 6  # and then
SETTLED = 1e-2  # metres by which a round must come nearer, else it is the last
REACHED = 1e-2  # metres from the end that count as having reached it
GENTLE = 1.1  # lengths of a way in place of one, for the number of slots first tried
TOLD = 3  # numbers of slots for which the solver may fail before a way is given up
SHAPE = 0.1  # metres beyond the body's radius that the tight shape keeps from boxes


@dataclass(frozen=True)
class Way:
    """A leg's way between two stops.

    Attributes:
        route: how its length depends on the stops. path: (M + 1, 3) a motion along it, in about as
            many slots as it takes. length: metres between these stops, the toll included.
    """

    route: Route
    path: Array
    length: float


def resample(path: Array, slots: int) -> Array:
    """Positions (slots + 1, 3) of the motion `path` (M + 1, 3) flown in another number of slots."""
    return _between(path, np.arange(0.0, len(path)), np.linspace(0.0, len(path) - 1.0, slots + 1))


def fitted(path: Array, slots: int, begin: Array, end: Array) -> Array:
    """The same, shifted so as to begin and end at the points (3,)."""
    path = resample(path, slots)
    share = np.linspace(0.0, 1.0, slots + 1)[:, None]
    return np.asarray(path + (1 - share) * (begin - path[0]) + share * (end - path[-1]))


def guess(way: Array, scene: Scene, spare: float = GENTLE) -> Array:
    """Positions (M + 1, 3) of a motion from rest to rest along a polyline (P, 3).

    In as many slots as a way `spare` times as long takes.
    """
    marks = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1))])
    slots = max(least_slots(scene, spare * marks[-1]), 2)
    ramp = scene.a_max * scene.slot * np.minimum(np.arange(slots + 1), slots - np.arange(slots + 1))
    covered = np.cumsum(np.minimum(ramp, scene.v_max))
    return _between(way, marks, covered * (marks[-1] / covered[-1]))


def _between(points: Array, marks: Array, at: Array) -> Array:
    return np.stack([np.interp(at, marks, points[:, axis]) for axis in range(3)], axis=-1)


def explore(program: Program, scene: Scene, path: Array) -> Way:
    """The way that grows out of a motion `path` (M + 1, 3).

    The path may be a first guess, through boxes perhaps. Of a way along which no motion is found,
    the length is infinite.
    """
    begin, end, flown = path[0], path[-1], None
    if segment_clear(begin, end, scene.obstacles, scene.uav_radius + SHAPE):
        return Way(Route(np.empty((0, 3)), 0.0), path, float(np.linalg.norm(end - begin)))
    for slots in range(len(path) - 1, 1, -1):
        nearer = _reach_out(program, resample(path, slots), end)
        if nearer is None and (flown is not None or slots < len(path) - TOLD):
            break
        if nearer is not None:
            path = flown = nearer
            if np.linalg.norm(path[-1] - end) > REACHED:
                break
    whole = np.concatenate([path, end[None]])
    tight = tighten(whole, scene.obstacles, scene.uav_radius + SHAPE)
    length = path_length(tight)
    if flown is None:
        return Way(Route(tight[1:-1], 0.0), path, np.inf)
    short = float(np.linalg.norm(end - flown[-1]))
    toll = max(0.0, short + reach(scene, len(flown) - 1) - length)
    return Way(Route(tight[1:-1], toll), flown, length + toll)


def _reach_out(program: Program, path: Array, end: Array) -> Array | None:
    """Positions of the motion near `path`, in as many slots, that ends nearest to `end` (3,)."""
    elastic, best, rounds = True, np.inf, 0
    found = None
    for _ in range(SOFT_ROUNDS + ROUNDS):
        solution = program.solve(np.zeros(3), path, end, None, elastic)
        if solution is None:
            break
        path = solution.q
        if elastic:
            elastic = solution.slack > COMFORT
            rounds += elastic
            if rounds > SOFT_ROUNDS:
                break
            continue
        found = path
        short = float(np.linalg.norm(path[-1] - end))
        if short > best - SETTLED or short < REACHED:
            break
        best = short
    return found
