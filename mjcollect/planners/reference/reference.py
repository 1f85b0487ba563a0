"""Plans a mission in the fewest slots that it can find, with the whole scene known.

It shows how far other pilots are from the limit. Three parts work together: an MPC's flight, or
the shortest way, decides on which side of the boxes each segment passes, and `routes` what that
costs; a small model of all segments (`slot_allotment`) decides how many slots each needs, with
every stop anywhere in its ball; and a cone program of the whole mission (`mission_program`) finds
the motion in these slots, solved anew round its last solution as the planes between path and boxes
turn. Where that finds nothing better than the MPC's flight, the MPC's flight is the plan.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np

from mjcollect.envs.course import Course
from mjcollect.envs.episode import Episodes
from mjcollect.geometry.compiled import Array
from mjcollect.geometry.polyline import path_length
from mjcollect.planners.mpc import INSIDE, Mpc
from mjcollect.planners.reference.detours import detours
from mjcollect.planners.reference.mission_program import Motion, TourProgram
from mjcollect.planners.reference.rehearsal import Rehearsal, rehearse
from mjcollect.planners.reference.routes import PricedPath, explore, fitted, guess
from mjcollect.planners.reference.slot_allotment import Allotments, Slots, least_slots, reach
from mjcollect.planners.slot_program import COMFORT

PASSES = 4  # Fewer slots are looked for at most this often, along the ways of the last success.
HOPE = -1.0  # An allotment is tried if its margin is at least this (m).
TURNS = 2  # Other ways past the boxes are looked for at most this often.
NOTED = 0.1  # Another way replaces the present one if it is shorter by more than this (m).
TRIED = 3  # At most this many allotments with the same total of slots are tried.
SOFT_ROUNDS = 6  # A program is solved anew at most this often while boxes are overlapped.
ROUNDS = 10  # A program is solved at most this often in all.
GAIN = 0.02  # A round must shrink the total miss by at least this share, else the attempt ends.
# Where there is no flight yet, slots are allotted as for ways that are longer by these factors.
DETOUR_FACTORS = (1.2, 1.5, 2.0, 3.0)
HIT = INSIDE / 2  # A stop may miss its ball, whose radius is reduced by INSIDE, by this much (m).


class NoFlight(ValueError):
    """Says that no flight of the course was found."""


class Reference:
    """Plans a course once, then flies the commands as they are.

        commands = Reference(course).plan()  # (N, 3) m/s^2, one for each slot

    Attributes:
        counts: allotments `tried`, and motions `refused` by the rules of flight.
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
        self._solver: Counter[str] = Counter()
        self._best: Rehearsal | None = None
        self.counts: Counter[str] = Counter()
        self.mpc_slots: int | None = None

    @property
    def statuses(self) -> Counter[str]:
        """Returns how often the solver ended in each status, without the MPC's solves."""
        return self._program.statuses + self._solver

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
        for number in range(PASSES):
            self._tell(f"reference: {len(best.commands)} slots; looking for fewer")
            better = self._fewer(best, widely=number == 0)
            if better is None:
                return best
            best = better
        return best

    def _from_ways(self) -> Rehearsal:
        """Returns a flight along the shortest ways, in more slots than are needed."""
        guides = self._course.guidance
        for factor in DETOUR_FACTORS:
            paths = []
            for guide in guides:
                slots = max(least_slots(self._scene, factor * path_length(guide.path)), 2)
                paths.append(guess(guide.path, self._scene, slots))
            flight = self._attempt(paths)
            if flight is not None:
                return flight
        raise NoFlight(
            f"scene {self._scene.name!r}: no flight through nodes {list(self._course.nodes)} was "
            "found, by the MPC or all at once; widen the gaps between the boxes along the way"
        )

    def _fewer(self, flight: Rehearsal, widely: bool) -> Rehearsal | None:
        """Returns a flight in fewer slots along the best ways known, or None."""
        ways = self._ways(flight, widely)
        start = self._scene.point(self._course.nodes[0])
        routes = [way.route for way in ways]
        allotments = Allotments(self._scene, start, self._balls, routes)
        totals: list[list[Slots]] = []
        slots = flight.slots
        while found := allotments.fewer(slots):
            slots = found[0]
            if allotments.margin(slots) < HOPE:
                break
            totals.append(found[:TRIED])
        better = None
        for candidates in reversed(totals):
            for slots in candidates:
                if better is None and allotments.margin(slots) >= HOPE:
                    stops = np.concatenate([start[None], allotments.stops(slots)])
                    paths = [
                        fitted(way.path, number, stops[k], stops[k + 1])
                        for k, (way, number) in enumerate(zip(ways, slots, strict=True))
                    ]
                    better = self._attempt(paths)
        self._solver += allotments.statuses
        return better

    def _ways(self, flight: Rehearsal, widely: bool) -> list[PricedPath]:
        """Returns the shortest way of each segment: as flown or, if `widely`, past other sides."""
        ways = []
        for k, (path, guide) in enumerate(zip(flight.segments, self._course.guidance, strict=True)):
            best = explore(self._scene, path, self._solver)
            if widely and len(best.route.corners):
                self._tell(f"reference: segment {k} turns round boxes; trying other ways")
                guided = np.concatenate([path[:1], guide.path[1:-1], path[-1:]])
                best = self._shortest(best, [guided, path[[0, -1]]], len(path) - 1)
                best = self._past_others(best, path)
            ways.append(best)
        return ways

    def _past_others(self, best: PricedPath, path: Array) -> PricedPath:
        """Returns a way past other sides of the boxes than `path` (M + 1, 3), or else `best`."""
        scene = self._scene
        worth = scene.v_max * scene.slot / 2  # The least gain worth a search: half a slot (m).
        straight = float(np.linalg.norm(path[-1] - path[0]))
        for _ in range(TURNS):
            length = min(best.length, reach(scene, len(path) - 1))
            if length < straight + worth:
                break
            way = np.concatenate([path[:1], best.route.corners, path[-1:]])
            others = detours(scene, way, length)
            better = self._shortest(best, others, least_slots(scene, length) + 1)
            if better is best:
                break
            best = better
        return best

    def _shortest(self, best: PricedPath, others: Sequence[Array], slots: int) -> PricedPath:
        """Returns the shortest of `best` and ways along other polylines, first tried in `slots`."""
        for other in others:
            found = explore(self._scene, guess(other, self._scene, slots), self._solver)
            if found.length < best.length - NOTED:
                best = found
        return best

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
                elastic = motion.slack > COMFORT
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
