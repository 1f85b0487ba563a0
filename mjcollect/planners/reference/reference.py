"""The reference: a mission in the fewest slots that can be found, with the whole scene known.

It shows how far everyone else is from the limit. Three parts work together: an MPC's flight, or
the shortest way, says round which side of the boxes each leg goes and `routes` what that costs; a
small model of all legs (`allotment`) says how many slots each needs, with every stop anywhere in
its ball; and a cone program of the whole mission at once (`tour_program`) finds the motion in these
slots, solved anew round its last solution as the planes between path and boxes turn. Where that
finds nothing better than the MPC's flight, that is what is flown.
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

PASSES = 4  # of looking for fewer slots along the ways of the last success
HOPE = -1.0  # metres of margin down to which an allotment is tried
TURNS = 2  # of looking for other ways past the boxes
NOTED = 0.1  # metres by which another way must be shorter
TRIED = 3  # allotments of each total
SOFT_ROUNDS = 6  # of solving anew while boxes are overlapped
ROUNDS = 10  # of solving anew in all
GAIN = 0.02  # share of the miss that a round must take away, else there is no hope
SPARE = (1.2, 1.5, 2.0, 3.0)  # lengths of a way in place of one, where there is no flight yet
HIT = INSIDE / 2  # metres by which stops may miss their balls, which are smaller by INSIDE


class NoFlight(ValueError):
    """No flight of the course was found."""


class Reference:
    """Plans a course once; then the commands are flown as they are.

        commands = Reference(course).plan()  # (N, 3) m/s^2, one for each slot

    Attributes:
        counts: allotments `tried`; motions `refused` by the rules of flight.
        mpc_slots: slots of the MPC's flight; None if it did not arrive.
    """

    def __init__(self, course: Course, tell: Callable[[str], None] | None = None) -> None:
        """Prepare for `course`; `tell` gets lines on how the planning goes."""
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
        """How often the solver ended in which status, the MPC's solves apart."""
        return self._program.statuses + self._solver

    def summary(self) -> str:
        """How the plan was made, in a sentence."""
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
        """Action (3,) in units of a_max for the only episode of `episodes`, from its start on.

        Raises:
            NoFlight: see `plan`.
        """
        commands, slot = self.plan(), int(episodes.steps[0])
        if slot >= len(commands):  # not flown from the course's start
            return np.asarray(episodes.guidance_action()[0])
        return np.asarray(commands[slot] / self._scene.a_max)

    def plan(self) -> Array:
        """Commands (N, 3) in m/s^2, each for a slot, from rest exactly at the course's start.

        Plans when first called. Deterministic.

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
        """A flight along the shortest ways, in more slots than are needed."""
        guides = self._course.guidance
        for spare in SPARE:
            paths = []
            for guide in guides:
                slots = max(least_slots(self._scene, spare * path_length(guide.path)), 2)
                paths.append(guess(guide.path, self._scene, slots))
            flight = self._attempt(paths)
            if flight is not None:
                return flight
        raise NoFlight(
            f"scene {self._scene.name!r}: no flight through nodes {list(self._course.nodes)} was "
            "found, by the MPC or all at once; widen the gaps between the boxes along the way"
        )

    def _fewer(self, flight: Rehearsal, widely: bool) -> Rehearsal | None:
        """A flight in fewer slots along the best ways known; None if none is found."""
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
        """The shortest way found for each leg: as flown or, `widely`, elsewhere past boxes."""
        ways = []
        for k, (path, guide) in enumerate(zip(flight.legs, self._course.guidance, strict=True)):
            best = explore(self._scene, path, self._solver)
            if widely and len(best.route.corners):
                self._tell(f"reference: leg {k} turns round boxes; trying other ways")
                guided = np.concatenate([path[:1], guide.path[1:-1], path[-1:]])
                best = self._shortest(best, [guided, path[[0, -1]]], len(path) - 1)
                best = self._past_others(best, path)
            ways.append(best)
        return ways

    def _past_others(self, best: PricedPath, path: Array) -> PricedPath:
        """A shorter way past other sides of the boxes than those of the leg `path` (M + 1, 3)."""
        scene = self._scene
        worth = scene.v_max * scene.slot / 2  # metres, half a slot
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
        """The shortest of a way and those along other polylines (P, 3), first tried in `slots`."""
        for other in others:
            found = explore(self._scene, guess(other, self._scene, slots), self._solver)
            if found.length < best.length - NOTED:
                best = found
        return best

    def _attempt(self, paths: Sequence[Array]) -> Rehearsal | None:
        """A flight near `paths`, in as many slots; None if none is found."""
        self.counts["tried"] += 1
        self._tell(f"reference: trying {sum(len(path) - 1 for path in paths)} slots")
        elastic, last = True, np.inf
        for number in range(ROUNDS):
            motion = self._program.best(paths, elastic)
            if motion is None:
                return None
            paths, miss = motion.legs, float(motion.misses.sum())
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
        """The motion as the rules of flight let it be flown, if it arrives as planned."""
        actions = np.diff(motion.v, axis=0) / (self._scene.slot * self._scene.a_max)

        def pilot(episodes: Episodes) -> Array:
            return np.asarray(actions[min(int(episodes.steps[0]), len(actions) - 1)])

        flight = rehearse(self._course, pilot)
        return flight if flight is not None and len(flight.commands) <= len(actions) else None
