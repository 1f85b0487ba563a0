"""Defines a course: nodes of one scene to visit in turn, 2 for a segment, K + 2 for a mission."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np

from mjcollect.envs.starts import try_starts
from mjcollect.geometry.compiled import Array, plain
from mjcollect.geometry.polyline import path_length, point_along
from mjcollect.guidance import cache
from mjcollect.guidance.aim import place
from mjcollect.guidance.guidance import Guidance
from mjcollect.scene.bounds import detour_bound
from mjcollect.scene.order import tour_segments
from mjcollect.scene.scene import Scene

StartKind = Literal["point", "ball", "spread"]
START_KINDS: tuple[StartKind, ...] = ("point", "ball", "spread")
MIN_SLOTS = 100  # The step limit P (slots) is at least this.
LIMIT_FACTOR = 3.0  # P is also at least this many times the time that the guidance paths take.
# These shares of `spread` starts lie in an ellipsoid and under way; the rest lie in the ball.
STREWN, UNDER_WAY = 0.3, 0.4
SPREAD_SPEED = 0.3  # `spread` starts in the ellipsoid are at most this share of v_max fast.
# The ellipsoid's long axis exceeds the path's length by this margin, in units of the scene.
SPREAD_MARGIN = 40.0
LAST_PART = 1.3  # Half of the starts under way lie within this many stops from v_max of the goal.
SPEEDS = (0.6, 1.02)  # Starts under way have this share of the speed that can just be stopped.


def check_start(kind: str) -> None:
    """Raises a ValueError where there is no such kind of start."""
    if kind not in START_KINDS:
        raise ValueError(f"start: {kind!r}: must be one of {', '.join(START_KINDS)}")


@dataclass(frozen=True, eq=False)
class Course:
    """Says where to go, with the guidance to each target.

    Attributes:
        scene: scene of all nodes.
        nodes: start node, then the targets in turn; an item's index, or -1 for the depot.
        before: indices of the items collected before the course begins.
        next_node: node to which the tour goes on after the course, if it does.
        folder: folder in which `save_guidance` of the same course has put files, if any.
        guidance: guidance to each target, with its path from the node before.
        step_limit: number of slots after which an episode is cut off, P in the paper.
    """

    scene: Scene
    nodes: tuple[int, ...]
    before: tuple[int, ...] = ()
    next_node: int | None = None
    folder: Path | None = None
    guidance: tuple[Guidance, ...] = field(init=False)
    step_limit: int = field(init=False)

    def __post_init__(self) -> None:
        """Builds or loads the guidance to each target, and sets the step limit.

        Raises:
            GuidanceError: a target cannot be reached.
        """
        ends = list(zip(self.nodes[:-1], self.nodes[1:], strict=True))
        nexts = [*self.nodes[2:], self.next_node]
        guides = [
            self._guidance(*nodes, next_node) for nodes, next_node in zip(ends, nexts, strict=True)
        ]
        time = sum(
            detour_bound(self.scene, *nodes, guide.length)
            for nodes, guide in zip(ends, guides, strict=True)
        )
        object.__setattr__(self, "guidance", tuple(guides))
        limit = max(MIN_SLOTS, int(np.ceil(LIMIT_FACTOR * time / self.scene.slot)))
        object.__setattr__(self, "step_limit", limit)

    def _guidance(self, start_node: int, target: int, next_node: int | None) -> Guidance:
        next_goal = None if next_node is None else self.scene.point(next_node)
        segment = self.scene, target, place(self.scene, start_node), next_goal
        saved = None if self.folder is None else cache.load(self.folder, *segment)
        if saved is not None:
            return saved
        return Guidance(*segment)

    def save_guidance(self, folder: Path) -> None:
        """Writes the guidance into files in `folder`, for a course of the same segments to load.

        Raises:
            OSError: a file cannot be written.
        """
        for guide in self.guidance:
            cache.save(guide, folder)

    @classmethod
    def segment(
        cls, scene: Scene, order: tuple[int, ...], index: int, folder: Path | None = None
    ) -> Course:
        """Returns the course of segment `index`, 0 to K, of a tour of K items.

        Args:
            scene: scene of the tour.
            order: (K,) indices of the items in the order of visit.
            folder: folder from which to load saved guidance, if any.

        Raises:
            ValueError: there is no such segment.
        """
        if not 0 <= index <= len(order):
            raise ValueError(
                f"segment: {index}: must be 0 to {len(order)}: a tour of {len(order)} items has "
                f"{len(order) + 1} segments"
            )
        segments = tour_segments(order)
        next_node = segments[index + 1][1] if index + 1 < len(segments) else None
        return cls(scene, segments[index], tuple(order[:index]), next_node, folder)

    @classmethod
    def mission(cls, scene: Scene, order: tuple[int, ...], folder: Path | None = None) -> Course:
        """Returns the course of a whole tour from depot to depot, with arguments as `segment`."""
        return cls(scene, (-1, *order, -1), folder=folder)

    def starts(self, kind: StartKind, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
        """Draws start positions (m) and velocities (m/s), each (count, 3), clear of everything.

        Args:
            kind: `point` starts at rest exactly at the start node, or as near as a body can be.
                `ball` starts at rest anywhere within the node's tolerance, where the segment before
                can have stopped. `spread`, for training, starts in the ball, in an ellipsoid round
                the way at up to 0.3 v_max, or under way, about as fast as can still be stopped in
                time. Many of the last lie near the goal, where flights brake and lose time.
        """
        scene, home = self.scene, place(self.scene, self.nodes[0])
        if kind == "point":
            return np.tile(home, (count, 1)), np.zeros((count, 3))
        q, v = np.empty((count, 3)), np.empty((count, 3))
        share = rng.random(count)
        kinds = np.where(share < STREWN, 1, np.where(share < STREWN + UNDER_WAY, 2, 0))
        kinds = (kinds if kind == "spread" else np.zeros(count)).astype(np.intp)
        space = (
            plain(scene.bounds),
            scene.tree,
            scene.a_max,
            scene.slot,
            scene.reach,
        )
        wanting = np.ones(count, dtype=bool)
        for _ in range(1000):
            todo = np.flatnonzero(wanting)
            n = len(todo)
            if n == 0:
                return q, v
            where = rng.standard_normal((n, 3)), rng.random((n, 1))
            speed = rng.standard_normal((n, 3)), rng.random((n, 1))
            under_way = self._under_way(n, rng) if kind == "spread" else (np.empty((n, 3)),) * 2
            try_starts(
                *space,
                *self._ellipsoids,
                kinds,
                *where,
                *speed,
                *under_way,
                todo,
                q,
                v,
                wanting,
            )
        # Near a start node wedged between boxes no draw fits; the node itself is known to be free.
        q[wanting], v[wanting] = home, 0.0
        return q, v

    def _under_way(self, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
        """Draws positions (m) and velocities (m/s), (count, 3), along the way; may touch boxes."""
        scene, path = self.scene, self.guidance[0].path
        whole = path_length(path)
        stopping = scene.v_max**2 / (2 * scene.a_max)
        most = np.where(rng.random(count) < 0.5, min(LAST_PART * stopping, whole), whole)
        left = most * rng.random(count)
        q = point_along(path, whole - left)
        ahead = point_along(path, np.minimum(whole - left + scene.unit, whole)) - q
        ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)
        fastest = np.minimum(np.sqrt(2 * scene.a_max * left), scene.v_max)
        v = ahead * (fastest * rng.uniform(*SPEEDS, count))[:, None]
        q = q + rng.normal(0.0, self.guidance[0].tolerance / 2, (count, 3))
        v = v + rng.normal(0.0, scene.a_max * scene.slot / 2, (count, 3))
        speed = np.linalg.norm(v, axis=1, keepdims=True)
        return q, v * np.minimum(1.0, scene.v_max / np.maximum(speed, 1e-9))

    @cached_property
    def _ellipsoids(self) -> tuple[Array, Array, Array, Array]:
        """Returns `middle`, `along`, `half` (m) and `top` (m/s) for `starts.try_starts`."""
        start, end = place(self.scene, self.nodes[0]), self.guidance[0].aim
        reach, axis = self.scene.tolerance(self.nodes[0]), end - start
        focal = float(np.linalg.norm(axis))
        total = max(self.guidance[0].length, focal) + SPREAD_MARGIN * self.scene.unit
        minor = float(np.sqrt(total**2 - focal**2)) / 2
        along = axis / focal if focal > 1e-9 else np.array([1.0, 0.0, 0.0])
        return (
            np.stack([self.scene.point(self.nodes[0]), (start + end) / 2]),
            along,
            np.array([[reach, reach], [total / 2, minor]]),
            np.array([0.0, SPREAD_SPEED * self.scene.v_max]),
        )
