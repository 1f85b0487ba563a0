"""Plans a mission in the fewest slots that it can find, with the whole scene known.

It shows how far other pilots are from the limit. Three parts work together: an MPC's flight, or
the shortest way, decides on which side of the boxes each segment passes; a small model of all
segments (`slot_allotment`) decides how many slots each needs, with every stop anywhere in its ball;
and a cone program of the whole mission (`mission_program`) finds the motion in these slots, solved
anew round its last solution as the planes between path and boxes turn. Where that finds nothing
better than the MPC's flight, the MPC's flight is the plan.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from mjcollect.envs.course import Course
from mjcollect.envs.episode import Episodes, Rules
from mjcollect.flight.straight_line import roll_out
from mjcollect.geometry.compiled import Array
from mjcollect.geometry.polyline import interpolate, path_length, point_along, tighten
from mjcollect.planners.mpc import INSIDE, Mpc
from mjcollect.planners.reference.mission_program import Motion, TourProgram
from mjcollect.planners.reference.slot_allotment import Allotments, Slots, fastest
from mjcollect.planners.slot_program import COMFORT
from mjcollect.scene.scene import Scene

HOPE = -1.0  # An allotment is tried if its margin is at least so many units of the scene.
SHAPE = (
    0.1  # The tight shape of a way keeps this margin to boxes beyond the body's radius, in units.
)
TRIED = 3  # At most this many allotments with the same total of slots are tried.
SOFT_ROUNDS = 6  # A program is solved anew at most this often while boxes are overlapped.
ROUNDS = 10  # A program is solved at most this often in all.
GAIN = 0.02  # A round must shrink the total miss by at least this share, else the attempt ends.
# Where there is no flight yet, slots are allotted as for ways that are longer by these factors.
DETOUR_FACTORS = (1.2, 1.5, 2.0, 3.0)
HIT = INSIDE / 2  # A stop may miss its ball, whose radius is reduced by INSIDE, by this much (m).


@dataclass(frozen=True)
class Rehearsal:
    """Holds the flight of a finished course.

    Attributes:
        commands: (N, 3) accelerations in m/s^2, as the rules of flight let them be flown.
        segments: positions (M + 1, 3) in m at each segment's slot starts, both stops included.
    """

    commands: Array
    segments: list[Array]


class NoFlight(ValueError):
    """Says that no flight of the course was found."""


class Reference:
    """Plans a course once, then flies the commands as they are.

        commands = Reference(course).plan()  # (N, 3) m/s^2, one for each slot

    Attributes:
        counts: allotments `tried`, and motions `refused` by the rules of flight.
        statuses: how often the solver ended in each status, without the MPC's solves.
        mpc_slots: number of slots of the MPC's flight, None if it did not arrive.
    """

    def __init__(self, course: Course, tell: Callable[[str], None] | None = None) -> None:
        """Prepares to plan `course`; `tell` receives lines on the progress."""
        self._course, self._scene = course, course.scene
        self._tell = tell or (lambda _: None)
        balls = [
            (guide.goal, guide.tolerance - min(INSIDE, guide.tolerance / 2))
            for guide in course.guidance
        ]
        self._balls, self._program = balls, TourProgram(self._scene, balls)
        self._best: Rehearsal | None = None
        self.statuses: Counter[str] = self._program.statuses
        self.counts: Counter[str] = Counter()
        self.mpc_slots: int | None = None

    def summary(self) -> str:
        """Returns a sentence that says how the plan was made."""
        slots = len(self.plan())
        if self.mpc_slots is None:
            against = "the MPC does not arrive"
        elif slots == self.mpc_slots:
            against = "no fewer than the MPC, whose flight this is"
        else:
            against = f"the MPC takes {self.mpc_slots}"
        ended = ", ".join(f"{status} {count}" for status, count in sorted(self.statuses.items()))
        return (
            f"{slots} slots; {against}. {self.counts['tried']} allotments of slots tried, "
            f"{sum(self.statuses.values())} cone programs ({ended}), {self.counts['refused']} "
            "motions refused by the rules of flight."
        )

    def action(self, episodes: Episodes) -> Array:
        """Returns the action (3,) in units of a_max for the one episode, from its start on.

        Raises:
            NoFlight: neither the MPC nor this planner finds a flight.
        """
        commands, slot = self.plan(), int(episodes.steps[0])
        if slot >= len(commands):  # The episode did not begin at the course's start.
            return np.asarray(episodes.guidance_action()[0])
        return np.asarray(commands[slot] / self._scene.a_max)

    def plan(self) -> Array:
        """Returns commands (N, 3) in m/s^2, one per slot, from rest exactly at the course's start.

        The first call plans, deterministically; later ones return the same commands.

        Raises:
            NoFlight: neither the MPC nor this planner finds a flight.
        """
        if self._best is None:
            self._best = self._search()
        return self._best.commands

    def _search(self) -> Rehearsal:
        mpc = Mpc(self._course)
        best = rehearse(self._course, mpc.action)
        self.mpc_slots = None if best is None else len(best.commands)
        if best is None:
            self._tell("reference: the MPC does not arrive; planning from the shortest ways")
            best = self._from_ways()
        better: Rehearsal | None = best
        while better is not None:
            best = better
            self._tell(f"reference: {len(best.commands)} slots; looking for fewer")
            better = self._fewer(best)
        return best

    def _from_ways(self) -> Rehearsal:
        """Returns a flight along the shortest ways, in more slots than are needed."""
        for factor in DETOUR_FACTORS:
            ways = [guide.path for guide in self._course.guidance]
            flight = self._attempt([_guess(way, self._scene, factor) for way in ways])
            if flight is not None:
                return flight
        raise NoFlight(
            f"scene {self._scene.name!r}: no flight through nodes {list(self._course.nodes)} was "
            "found, by the MPC or all at once; widen the gaps between the boxes along the way"
        )

    def _fewer(self, flight: Rehearsal) -> Rehearsal | None:
        """Returns a flight in fewer slots past the same sides of the boxes, or None."""
        boxes, radius = self._scene.tree, self._scene.reach + SHAPE * self._scene.unit
        ways = [tighten(path, boxes, radius, self._scene.unit) for path in flight.segments]
        slots = tuple(len(path) - 1 for path in flight.segments)
        allotments = Allotments(self._scene, self._balls, ways, slots, self.statuses)
        hopeful = list[Slots]()  # The fewest slots come first.
        least = HOPE * self._scene.unit
        while found := [
            less for less in allotments.fewer(slots)[:TRIED] if allotments.margin(less) >= least
        ]:
            hopeful, slots = found + hopeful, found[0]
        for slots in hopeful:
            stops = [ways[0][0], *allotments.stops(slots)]
            parts = zip(flight.segments, slots, itertools.pairwise(stops), strict=True)
            better = self._attempt([_fitted(path, number, *ends) for path, number, ends in parts])
            if better is not None:
                return better
        return None

    def _attempt(self, paths: Sequence[Array]) -> Rehearsal | None:
        """Returns a flight near `paths` in as many slots, or None."""
        self.counts["tried"] += 1
        self._tell(f"reference: trying {sum(len(path) - 1 for path in paths)} slots")
        elastic, last = True, np.inf
        for number in range(ROUNDS):
            motion = self._program.best(paths, elastic)
            if motion is None:
                return None
            paths, miss = motion.segments, float(motion.misses.sum())
            if elastic:
                elastic = motion.slack > COMFORT * self._scene.unit
                if elastic and number >= SOFT_ROUNDS:
                    return None
                continue
            if motion.misses.max() < HIT:
                flight = self._flown(motion)
                if flight is not None:
                    return flight
                self.counts["refused"] += 1
            elif miss > (1 - GAIN) * last:
                return None
            last = miss
        return None

    def _flown(self, motion: Motion) -> Rehearsal | None:
        """Returns the motion as the rules of flight let it be flown, if it arrives as planned."""
        actions = np.diff(motion.v, axis=0) / (self._scene.slot * self._scene.a_max)

        def pilot(episodes: Episodes) -> Array:
            return np.asarray(actions[min(int(episodes.steps[0]), len(actions) - 1)])

        flight = rehearse(self._course, pilot)
        return flight if flight is not None and len(flight.commands) <= len(actions) else None


def rehearse(course: Course, pilot: Callable[[Episodes], Array]) -> Rehearsal | None:
    """Flies `course` from rest exactly at its start; returns None if it is not finished.

    Args:
        pilot: maps the episode to an action (3,) in units of a_max.
    """
    episodes = Episodes([course], 1, Rules(shield=False))
    episodes.reset(np.array([0]), course.scene.point(course.nodes[0])[None], np.zeros((1, 3)))
    sensed = np.zeros((1, course.scene.substeps), dtype=bool)
    commands, q, segments = [], [episodes.q[0].copy()], list[Array]()
    while True:
        a = episodes.begin_slot(pilot(episodes)[None])
        path, speeds = roll_out(episodes.world, episodes.q[0], episodes.v[0], a)
        outcome = episodes.end_slot(path[:, 1:], speeds[:, -1], sensed)
        commands.append(a[0].copy())
        q.append(episodes.q[0].copy())
        if outcome.slot.arrived[0]:
            segments.append(np.array(q))
            q = q[-1:]
        if outcome.success[0]:
            return Rehearsal(np.array(commands), segments)
        if outcome.terminated[0] or outcome.truncated[0]:
            return None


def _guess(way: Array, scene: Scene, factor: float) -> Array:
    """Returns positions (M + 1, 3) of a motion along a polyline (P, 3) `factor` times as long."""
    length, ramp = path_length(way), scene.v_max / scene.a_max
    slots = 1 + math.ceil((factor * length / scene.v_max + ramp) / scene.slot)
    covered = np.cumsum(fastest(scene, slots))
    return point_along(way, covered * (length / covered[-1]))


def _fitted(path: Array, slots: int, begin: Array, end: Array) -> Array:
    """Returns the motion `path` (M + 1, 3) in another slot count, shifted to other ends (3,)."""
    at = np.linspace(0.0, len(path) - 1.0, slots + 1)
    path = interpolate(path, np.arange(0.0, len(path)), at)
    share = np.linspace(0.0, 1.0, slots + 1)[:, None]
    return np.asarray(path + (1 - share) * (begin - path[0]) + share * (end - path[-1]))
