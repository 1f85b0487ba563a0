"""Foresees what a plan in disturbed air meets: moving boxes, and how far it may be flown astray."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any

import numpy as np

from mjcollect.envs.episode import Episodes
from mjcollect.flight.contact import MARGIN, contacts
from mjcollect.flight.disturbed_shield import BLURRED, LAG
from mjcollect.flight.moving_boxes import STEPS
from mjcollect.flight.world import World
from mjcollect.geometry.among_boxes import segment_clear
from mjcollect.geometry.compiled import Array
from mjcollect.scene.scene import Scene

CAUTION = 1.5  # A margin is so many times the distance by which the body is believed to be astray.
MOST = 3.0  # No margin is greater (m): the way to a target may lead close by a box.
BESIDE = 2.0  # The way round a moving box keeps this distance (m) on top of the margin,
SOON = 1.0  # round the place where the box is so many seconds after a plan's end.
_GRID = np.stack(np.meshgrid(*[np.linspace(-1.0, 1.0, 9)] * 3, indexing="ij"), -1).reshape(-1, 3)
# Points on the edges of a cube of side 2 round the origin (E, 3).
EDGES = _GRID[np.sum(np.abs(_GRID) == 1.0, axis=1) >= 2]
OUTSIDE = MARGIN - MOST  # A plan may lead out of the bounds by this (m), and is flown by MARGIN.


@dataclass(frozen=True)
class Foresight:
    """Holds what an episode in disturbed air knows of the seconds to come.

    Attributes:
        a_max: acceleration to count on (m/s²). late: s until a plan begins to be flown.
        boxes: (B, 2, 3) moving boxes now (m). ahead: (B, T, 3) how far they are moved at STEPS.
        spread: standard deviation of accelerations (m/s²). blur: that of the position (m).
    """

    a_max: float
    late: float
    boxes: Array
    ahead: Array
    spread: float
    blur: float

    @classmethod
    def of(cls, episodes: Episodes) -> Foresight:
        """Returns what the first of some disturbed episodes knows."""
        assert episodes.disturbances is not None
        movers, known = episodes.disturbances.movers, episodes.known
        there = np.flatnonzero(movers.speed[0] > 0.0)
        return cls(
            a_max=float(episodes.seen_world.a_max[0, 0]),
            late=float(known.late[0, 0]),
            boxes=movers.boxes[0, there],
            ahead=movers.ahead()[0, there],
            spread=float(known.spread[0, 0]),
            blur=float(known.blur[0, 0]),
        )

    def shifts(self, seconds: Any) -> Array:
        """Returns how far (B, ..., 3) the boxes are moved `seconds` (...) after a plan's start."""
        seconds = np.asarray(seconds) + self.late
        moved = np.empty((len(self.boxes), *seconds.shape, 3))
        for b, ahead in enumerate(self.ahead):
            for axis in range(3):
                moved[b, ..., axis] = np.interp(seconds, STEPS, ahead[:, axis])
        return moved

    def swept(self, slots: int, slot: float) -> Array:
        """Returns (slots, B, 2, 3) what the boxes sweep in each slot of `slot` s of a plan (m)."""
        moved = self.shifts(np.arange(slots + 1) * slot)
        low = self.boxes[:, None, 0] + np.minimum(moved[:, :-1], moved[:, 1:])
        high = self.boxes[:, None, 1] + np.maximum(moved[:, :-1], moved[:, 1:])
        return np.stack([low, high], axis=2).swapaxes(0, 1)

    def margins(self, slots: int, slot: float) -> Array:
        """Returns the distances (slots,) in m to keep from boxes in each slot of a plan."""
        astray = BLURRED * self.blur + LAG * self.spread * np.arange(slots) * slot
        return np.minimum(CAUTION * astray, MOST)

    def way_round(self, end: Array, pull: Array, slots: int, scene: Scene) -> Array | None:
        """Returns the point (3,) that pulls a plan of some slots round what hides `pull` (3,).

        It is `pull` itself if no moving box, at its place SOON after the plan ends, is between that
        and the plan's `end` (3,). Else it is the next corner of the shortest way past the box, by
        points on its edges; a slow box would hold the plan before it. Without a way it is None.
        """
        clear = scene.reach + float(self.margins(slots, scene.slot)[-1])
        for box, moved in zip(self.boxes, self.shifts(slots * scene.slot + SOON), strict=True):
            here = box + moved
            if segment_clear(end, pull, here[None], clear):
                continue
            at = here.mean(axis=0) + EDGES * (np.diff(here, axis=0)[0] / 2 + clear + BESIDE)
            inside = np.all((scene.bounds[0] <= at) & (at <= scene.bounds[1]), axis=1)
            seen = [segment_clear(end, at, boxes, clear) for boxes in (here[None], scene.tree)]
            first = at[inside & seen[0] & seen[1]]
            seen = [segment_clear(at, pull, boxes, clear) for boxes in (here[None], scene.tree)]
            last = at[inside & seen[0] & seen[1]]
            way = np.linalg.norm(first - end, axis=1)[:, None] + np.linalg.norm(pull - last, axis=1)
            way = way + np.linalg.norm(first[:, None] - last, axis=2)
            way[~segment_clear(first[:, None], last[None], here[None], clear)] = np.inf
            if not np.isfinite(way).any():
                return None
            one, two = np.unravel_index(int(way.argmin()), way.shape)
            near = np.linalg.norm(first[one] - end) < BESIDE
            return np.asarray(last[two] if near else first[one])
        return pull

    def touches(self, world: World, path: Array) -> bool:
        """Returns whether a plan's path (M, n + 1, 3) touches a moving box, exactly."""
        start = np.arange(len(path))[:, None] * world.slot
        moved = self.shifts(start + np.arange(path.shape[1]) * world.step)
        sensed = np.zeros(path[:, 1:].shape[:2], dtype=bool)
        return any(
            contacts(world.with_boxes(box[None, None]), path - shift, sensed).any()
            for box, shift in zip(self.boxes, moved, strict=True)
        )

    def scene(self, scene: Scene, q: Array) -> Scene:
        """Returns the scene with the a_max to count on and bounds in which q (3,) lies."""
        bounds = scene.bounds + np.array([[-OUTSIDE], [OUTSIDE]])
        bounds = np.stack([np.minimum(bounds[0], q - 1.0), np.maximum(bounds[1], q + 1.0)])
        other = copy.copy(scene)
        object.__setattr__(other, "unit", scene.unit)  # that of the whole a_max
        object.__setattr__(other, "a_max", self.a_max)
        object.__setattr__(other, "bounds", bounds)
        return other
