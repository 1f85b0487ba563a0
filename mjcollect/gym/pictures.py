"""Takes pictures of flights while they last, by the chase camera of the videos."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from gymnasium.error import ResetNeeded

from mjcollect.envs.course import Course
from mjcollect.geometry.compiled import Array, Indices
from mjcollect.render.arrivals import Progress
from mjcollect.render.camera import Picture, chase_views
from mjcollect.render.fleet import FleetProgress
from mjcollect.render.settings import VideoSettings
from mjcollect.render.video import check_gl
from mjcollect.scene.order import DEPOT
from mjcollect.scene.trajectory import Trajectory

if TYPE_CHECKING:
    from mjcollect.render.film.scene_renderer import Stage

WINDOW = 25  # The camera is smoothed over so many slots.


class Moment(NamedTuple):
    """Holds position (3,) in m and velocity (3,) in m/s of a UAV."""

    x: Array
    v: Array


class Pictures:
    """Remembers N flights of a course, and shows each from behind, with the path it has flown."""

    def __init__(self, course: Course, count: int, size: tuple[int, int]) -> None:
        """Prepares for `count` flights; the renderer is opened for the first picture.

        Args:
            size: width and height in pixels.
        """
        self._course, self._size = course, size
        self._flown: list[list[Moment]] = [[] for _ in range(count)]
        self._stage: Stage | None = None

    def begin(self, which: Indices, x: Array, v: Array) -> None:
        """Forgets the flights `which` (n,), which begin anew at their rows of x, v (N, 3)."""
        for index in which:
            self._flown[index] = [Moment(x[index].copy(), v[index].copy())]

    def add(self, x: Array, v: Array) -> None:
        """Adds where all flights are after a slot, x, v (N, 3)."""
        for flown, *moment in zip(self._flown, x.copy(), v.copy(), strict=True):
            flown.append(Moment(*moment))

    def take(self, index: int, reached: int, moving: Sequence[Array]) -> Picture:
        """Returns a picture (H, W, 3) uint8 of flight `index`, which reached so many targets.

        The boxes `moving`, (2, 3) each, are where they are now.

        Raises:
            ResetNeeded: it has not begun, or the environment is closed.
            RenderError: there is no GL; the message says how to get it.
        """
        if not self._flown[index]:
            raise ResetNeeded("there is nothing to show: call reset() before render()")
        from mjcollect.render.flown_model import Pose
        from mjcollect.render.overlay import speed_colours

        stage, scene = self._open(), self._course.scene
        x, v = (np.array(part) for part in zip(*self._flown[index], strict=True))
        nodes = self._course.nodes
        goal = scene.point(nodes[min(reached + 1, len(nodes) - 1)])
        last = slice(-WINDOW, None)
        goals = np.tile(goal, (len(x[last]), 1))
        views, heading = chase_views(scene, x[last], v[last], goals, 1 / scene.slot, self._size)
        a = (v[-1] - v[-2]) / scene.slot if len(v) > 1 else np.zeros(3)
        stage.place([Pose(x[-1], a, float(heading[-1]))], len(x))
        colours = speed_colours(np.linalg.norm(v[1:], axis=1), scene.v_max)
        return stage.chase(views[-1], (reached,), [(x, colours)], goal, moving).copy()

    def _open(self) -> Stage:
        if self._stage is None:
            check_gl()
            from mjcollect.render.film.scene_renderer import Stage

            self._stage = Stage(_unflown(self._course), VideoSettings(self._size))
        return self._stage

    def close(self) -> None:
        """Closes the renderer, and forgets all flights."""
        for flown in self._flown:
            flown.clear()
        if self._stage is not None:
            self._stage.close()
            self._stage = None


def _unflown(course: Course) -> FleetProgress:
    """Returns a flight along a course that has just begun."""
    start = course.scene.point(course.nodes[0])[None]
    still = np.zeros((1, 3))
    order = (*course.before, *(node for node in course.nodes[1:] if node != DEPOT))
    begun = Trajectory(np.zeros(1), start, still, still)
    segment = len(course.before)
    return FleetProgress.alone(Progress(course.scene, begun, order, segment, course.nodes, ()))
