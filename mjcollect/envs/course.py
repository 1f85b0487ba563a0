"""A course: the nodes of one scene to be visited in turn. A segment has two, a mission K + 2."""

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
from mjcollect.scene.order import legs
from mjcollect.scene.scene import Scene

StartKind = Literal["point", "ball", "spread"]
START_KINDS: tuple[StartKind, ...] = ("point", "ball", "spread")
MIN_SLOTS = 100  # step limit P: at least this, and LIMIT_FACTOR times the guidance path's time
LIMIT_FACTOR = 3.0
STREWN, UNDER_WAY = 0.3, 0.4  # shares of the `spread` starts; the rest lie in the ball
SPREAD_SPEED = 15.0  # m/s, the fastest `spread` start
SPREAD_SLACK = 40.0  # metres added to the path length for the ellipsoid of `spread` starts
LAST_PART = 1.3  # stops from v_max: how far from the goal half of the starts under way are
SPEEDS = (0.6, 1.02)  # of what can still be stopped in time: starts under way


@dataclass(frozen=True, eq=False)
class Course:
    """Where to go, with a guidance field for each target.

    Attributes:
        scene: the scene.
        nodes: start node, then the targets in turn; item index, or -1 for the depot.
        before: items collected before the course begins.
        next_node: the node that the tour goes on to afterwards, if it does.
        folder: where `save_guidance` of the same course has put files, if it has.
        guidance: one per target, from the node before.
        step_limit: slots after which an episode is cut off (P).
    """

    scene: Scene
    nodes: tuple[int, ...]
    before: tuple[int, ...] = ()
    next_node: int | None = None
    folder: Path | None = None
    guidance: tuple[Guidance, ...] = field(init=False)
    step_limit: int = field(init=False)

    def __post_init__(self) -> None:
        """Build the guidance fields.

        Raises:
            GuidanceError: a target cannot be reached.
        """
        ways = list(zip(self.nodes[:-1], self.nodes[1:], strict=True))
        nexts = [*self.nodes[2:], self.next_node]
        fields = [
            self._guidance(frm, to, after) for (frm, to), after in zip(ways, nexts, strict=True)
        ]
        time = sum(
            detour_bound(self.scene, frm, to, field.length)
            for (frm, to), field in zip(ways, fields, strict=True)
        )
        object.__setattr__(self, "guidance", tuple(fields))
        limit = max(MIN_SLOTS, int(np.ceil(LIMIT_FACTOR * time / self.scene.slot)))
        object.__setattr__(self, "step_limit", limit)

    def _guidance(self, frm: int, to: int, after: int | None) -> Guidance:
        next_goal = None if after is None else self.scene.point(after)
        leg = self.scene, to, place(self.scene, frm), next_goal
        saved = None if self.folder is None else cache.load(self.folder, *leg)
        if saved is not None:
            return saved
        return Guidance(*leg)

    def save_guidance(self, folder: Path) -> None:
        """Write the guidance into files in `folder`, for a course of the same legs to load.

        Raises:
            OSError: they cannot be written.
        """
        for guide in self.guidance:
            cache.save(guide, folder)

    @classmethod
    def segment(
        cls, scene: Scene, order: tuple[int, ...], index: int, folder: Path | None = None
    ) -> Course:
        """Segment `index` of a tour, 0..K; `folder` as above.

        Raises:
            ValueError: there is no such segment.
        """
        if not 0 <= index <= len(order):
            raise ValueError(
                f"segment: {index}: must be 0 to {len(order)}: a tour of {len(order)} items has "
                f"{len(order) + 1} segments"
            )
        all_legs = legs(order)
        next_node = all_legs[index + 1][1] if index + 1 < len(all_legs) else None
        return cls(scene, all_legs[index], tuple(order[:index]), next_node, folder)

    @classmethod
    def mission(cls, scene: Scene, order: tuple[int, ...], folder: Path | None = None) -> Course:
        """The whole tour from depot to depot; `folder` as above."""
        return cls(scene, (-1, *order, -1), folder=folder)

    def starts(self, kind: StartKind, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
        """Start positions and velocities, each (count, 3), in bounds and clear of boxes.

        Args:
            kind: `point`: at rest exactly at the start node, or as near as a body can be. `ball`:
                at rest anywhere within the node's tolerance, where the segment before can have
                stopped. `spread`, for training: some in the ball, some in an ellipsoid around the
                way, moving at up to 15 m/s, and some under way, about as fast as can still be
                stopped in time, many of them near the goal: each flight brakes once, and there
                tenths of seconds are lost.
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
            plain(scene.obstacles),
            scene.a_max,
            scene.slot,
            scene.uav_radius,
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
        # A start node wedged between boxes: the node itself is known to be free.
        q[wanting], v[wanting] = home, 0.0
        return q, v

    def _under_way(self, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
        """Positions and velocities (count, 3) along the way, whether or not they are clear."""
        scene, path = self.scene, self.guidance[0].path
        whole = path_length(path)
        stopping = scene.v_max**2 / (2 * scene.a_max)
        most = np.where(rng.random(count) < 0.5, min(LAST_PART * stopping, whole), whole)
        left = most * rng.random(count)
        q = point_along(path, whole - left)
        ahead = point_along(path, np.minimum(whole - left + 1.0, whole)) - q
        ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)
        fastest = np.minimum(np.sqrt(2 * scene.a_max * left), scene.v_max)
        v = ahead * (fastest * rng.uniform(*SPEEDS, count))[:, None]
        q = q + rng.normal(0.0, self.guidance[0].tolerance / 2, (count, 3))
        v = v + rng.normal(0.0, scene.a_max * scene.slot / 2, (count, 3))
        speed = np.linalg.norm(v, axis=1, keepdims=True)
        return q, v * np.minimum(1.0, scene.v_max / np.maximum(speed, 1e-9))

    @cached_property
    def _ellipsoids(self) -> tuple[Array, Array, Array, Array]:
        """Where `ball` and `spread` starts lie, see `kernels.try_starts`; metres and m/s."""
        start, end = place(self.scene, self.nodes[0]), self.guidance[0].aim
        reach, axis = self.scene.tolerance(self.nodes[0]), end - start
        focal = float(np.linalg.norm(axis))
        total = max(self.guidance[0].length, focal) + SPREAD_SLACK
        minor = float(np.sqrt(total**2 - focal**2)) / 2
        along = axis / focal if focal > 1e-9 else np.array([1.0, 0.0, 0.0])
        return (
            np.stack([self.scene.point(self.nodes[0]), (start + end) / 2]),
            along,
            np.array([[reach, reach], [total / 2, minor]]),
            np.array([0.0, min(SPREAD_SPEED, self.scene.v_max)]),
        )
