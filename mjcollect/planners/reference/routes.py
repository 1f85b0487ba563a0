"""Finds what a segment's way costs: its tight shape, and the extra length that its turns cost.

Beside a box a body at v_max turns on a circle of radius v_max^2 / a_max, so a way round corners
takes longer than its length says. How much longer is found by planning it: with one slot too few,
the best motion stops short of the end, by more than the length alone explains.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from mjcollect.geometry.boxes import segment_clear
from mjcollect.geometry.compiled import Array
from mjcollect.geometry.polyline import interpolate, marks, path_length, point_along, tighten
from mjcollect.planners.reference.mission_program import TourProgram
from mjcollect.planners.reference.slot_allotment import Route, reach
from mjcollect.planners.slot_program import COMFORT
from mjcollect.scene.scene import Scene

SOFT_ROUNDS = 8  # A program is solved anew at most this often while boxes are overlapped.
ROUNDS = 6  # This many further rounds may follow.
SETTLED = 1e-2  # A round that comes nearer to the end by less than this is the last (m).
NEAR = 0.5  # A segment's end is reached within this distance (m).
REACHED = 1e-2  # The solver's tolerance may add this to it (m).
SHAPE = 0.1  # The tight shape keeps this margin to boxes beyond the body's radius (m).


@dataclass(frozen=True)
class PricedPath:
    """Holds a segment's way between two stops and what it costs.

    Attributes:
        route: how its length depends on the stops. path: (M + 1, 3) positions (m) of a motion along
            it, in about as many slots as it takes. length: between these stops, with the toll (m).
    """

    route: Route
    path: Array
    length: float


def resample(path: Array, slots: int) -> Array:
    """Returns positions (slots + 1, 3) of the motion `path` (M + 1, 3) in another slot count."""
    at = np.linspace(0.0, len(path) - 1.0, slots + 1)
    return interpolate(path, np.arange(0.0, len(path)), at)


def fitted(path: Array, slots: int, begin: Array, end: Array) -> Array:
    """Returns the same, shifted so that it begins and ends at the given points (3,)."""
    path = resample(path, slots)
    share = np.linspace(0.0, 1.0, slots + 1)[:, None]
    return np.asarray(path + (1 - share) * (begin - path[0]) + share * (end - path[-1]))


def guess(way: Array, scene: Scene, slots: int) -> Array:
    """Returns positions (slots + 1, 3) of a motion from rest to rest along a polyline (P, 3)."""
    k = np.arange(slots + 1)
    ramp = scene.a_max * scene.slot * np.minimum(k, slots - k)
    covered = np.cumsum(np.minimum(ramp, scene.v_max))
    return point_along(way, covered * (marks(way)[-1] / covered[-1]))


def explore(scene: Scene, path: Array, statuses: Counter[str]) -> PricedPath:
    """Returns the way that a motion becomes when it is improved; infinitely long if none is found.

    Args:
        path: (M + 1, 3) positions (m), perhaps a first guess that crosses boxes.
        statuses: counts of the solver's statuses, to which those of this call are added.
    """
    begin, end, short = path[0], path[-1], 0.0
    flown: Array | None = None
    if segment_clear(begin, end, scene.obstacles, scene.uav_radius + SHAPE):
        return PricedPath(Route(np.empty((0, 3)), 0.0), path, float(np.linalg.norm(end - begin)))
    program = TourProgram(scene, [(end, NEAR)])
    for slots in range(len(path) - 1, 1, -1):
        nearer, missed = _reach_out(program, resample(path, slots))
        if nearer is None:
            break
        path, flown, short = nearer, nearer, missed
        if short > REACHED:
            break
    statuses.update(program.statuses)
    whole = np.concatenate([path, end[None]])
    tight = tighten(whole, scene.obstacles, scene.uav_radius + SHAPE)
    length = path_length(tight)
    if flown is None:
        return PricedPath(Route(tight[1:-1], 0.0), path, np.inf)
    toll = max(0.0, short + NEAR + reach(scene, len(flown) - 1) - length)
    return PricedPath(Route(tight[1:-1], toll), flown, length + toll)


def _reach_out(program: TourProgram, path: Array) -> tuple[Array | None, float]:
    """Returns the motion (M + 1, 3) near `path` that misses the ball least, and the miss (m)."""
    elastic, found, best = True, None, np.inf
    for number in range(SOFT_ROUNDS + ROUNDS):
        motion = program.best([path], elastic)
        if motion is None:
            break
        path, short = motion.segments[0], float(motion.misses[0])
        if elastic:
            elastic = motion.slack > COMFORT
            if elastic and number >= SOFT_ROUNDS:
                break
            continue
        gained, found, best = best - short, path, short
        if gained < SETTLED or short < REACHED:
            break
    return found, best
