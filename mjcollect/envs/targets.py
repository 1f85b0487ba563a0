"""Keeps the targets of N episodes: where they lie, how each episode stands towards its own."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from mjcollect.envs.course import Course
from mjcollect.flight.world import World
from mjcollect.geometry.boxes import FAR
from mjcollect.geometry.compiled import Array, Indices
from mjcollect.guidance.approach import LOOK_AHEAD, Approach, approach_rows
from mjcollect.guidance.guidance import STOP_SHARE
from mjcollect.guidance.law import law_rows


class Targets:
    """Lists the T targets of all distinct courses; each episode visits a stretch of the list.

    Attributes:
        courses: one course for all episodes, or one each. guidance: guidance to each target.
        node: (T,) item index, or -1 for the depot. goal: (T, 3) m. tolerance: (T,) m.
        first, last: (N,) index of each episode's first and last target.
        step_limit: (N,) number of slots after which an episode is cut off.
        items: (N, K, 3) m, padded with points far away.
        before: (N, K) flags of the items that were collected before the episode begins.
    """

    def __init__(self, courses: Sequence[Course], count: int) -> None:
        """Lists the targets of `count` episodes, on one course or one each.

        Raises:
            ValueError: the number of courses is neither 1 nor `count`.
        """
        if len(courses) not in (1, count):
            raise ValueError(f"courses: {len(courses)}: must be 1 or the batch size {count}")
        self.courses = tuple(courses)
        distinct = list(dict.fromkeys(courses))
        self.guidance = [field for course in distinct for field in course.guidance]
        self.node = np.array([node for course in distinct for node in course.nodes[1:]])
        self.goal = np.array([field.goal for field in self.guidance])
        self.tolerance = np.array([field.tolerance for field in self.guidance])
        offset = np.cumsum([0, *(len(course.guidance) for course in distinct)])
        which = np.array([distinct.index(course) for course in courses])
        which = np.broadcast_to(which, (count,))
        self.first, self.last = offset[which], offset[which + 1] - 1
        self.step_limit = np.array([distinct[w].step_limit for w in which])
        most = max(len(course.scene.items) for course in courses)
        self.items = np.full((count, most, 3), FAR)
        self.before = np.zeros((count, most), dtype=bool)
        for index, w in enumerate(which):
            course = distinct[w]
            self.items[index, : len(course.scene.items)] = course.scene.items
            self.before[index, list(course.before)] = True

    def course(self, index: int) -> Course:
        """Returns the course of episode `index`."""
        return self.courses[index if len(self.courses) > 1 else 0]

    def update_approach(
        self, world: World, target: Indices, q: Array, v: Array, which: Indices, approach: Approach
    ) -> None:
        """Writes the rows `which` (n,) of an approach.

        Args:
            world: the world as decisions see it. target: (N,) index of each current target.
            q, v: (N, 3) positions (m) and velocities (m/s).
        """
        for current, mine in self._groups(target, which):
            guide = self.guidance[current]
            radius = STOP_SHARE * guide.tolerance
            approach_rows(world, guide.way, mine, guide.goal, radius, LOOK_AHEAD, q, v, approach)
            approach.speed[mine] = np.linalg.norm(v[mine], axis=1)
            approach.returning[mine] = self.node[current] < 0
            if guide.next_goal is not None:
                to_next = guide.next_goal - guide.goal
                distance = float(np.linalg.norm(guide.goal - guide.next_goal))
                approach.next_direction[mine] = to_next / max(distance, 1e-9)
                from_here = np.linalg.norm(q[mine] - guide.next_goal, axis=-1)
                approach.next_excess[mine] = from_here - distance

    def law(self, world: World, target: Indices, q: Array, v: Array) -> Array:
        """Returns the guidance law's actions (N, 3) in units of a_max; see `update_approach`."""
        action = np.empty(q.shape)
        for current, mine in self._groups(target, np.arange(len(q))):
            guide = self.guidance[current]
            law_rows(world, guide.way, guide.slack, mine, guide.goal, q, v, action)
        return action

    def _groups(self, target: Indices, which: Indices) -> Iterator[tuple[int, Indices]]:
        """Yields each current target with those of the episodes `which` that head for it."""
        if len(self.guidance) == 1:
            yield 0, which
            return
        if len(which) == 1:
            yield int(target[which[0]]), which
            return
        targets = target[which]
        for current in np.unique(targets):
            yield int(current), which[targets == current]
