"""Proposes other ways to fly a segment, past another side of a box than the present way.

A planner that improves a path by small steps never takes it to the other side of a box, and the
shortest way is not the fastest where it turns sharply. The proposals are first guesses that lead
through a point beside a box; they may cross other boxes.
"""

from __future__ import annotations

import numpy as np

from mjcollect.geometry.boxes import point_box_distance, segment_box_distance
from mjcollect.geometry.compiled import Array
from mjcollect.geometry.polyline import path_length
from mjcollect.scene.scene import Scene

BESIDE = 1.0  # The body keeps this clearance to the box at the point beside it (m).
AT = 2.0  # A corner of the way belongs to a box within this clearance of the body (m).
LONGER = 1.1  # A detour of more than this many times the present length is not worth a try.
MOST = 24  # At most this many detours are proposed.


def detours(scene: Scene, way: Array, length: float) -> list[Array]:
    """Returns polylines (P, 3) in m between the ends of `way`, the shortest first.

    Args:
        way: (P, 3) present way, tightened (m). length: what a detour must come near to or beat (m).
    """
    begin, end, corners = way[0], way[-1], way[1:-1]
    boxes = scene.obstacles
    if not len(boxes):
        return []
    at_box = point_box_distance(corners[:, None], boxes) < scene.uav_radius + AT  # (P - 2, M)
    in_between = segment_box_distance(begin, end, boxes) < scene.uav_radius
    found = []
    for box in np.flatnonzero(in_between | at_box.any(axis=0)):
        mine = np.flatnonzero(at_box[:, box])
        for point in _beside(scene, begin, end, boxes[box]):
            found.append(np.stack([begin, point, end]))
            if len(mine) and len(mine) < len(corners):
                rest = corners[: mine[0]], point[None], corners[mine[-1] + 1 :]
                found.append(np.concatenate([begin[None], *rest, end[None]]))
    worth = [detour for detour in found if path_length(detour) < LONGER * length]
    return sorted(worth, key=path_length)[:MOST]


def _beside(scene: Scene, begin: Array, end: Array, box: Array) -> list[Array]:
    """Returns points (3,) beside each face of a box, where the line from begin to end passes it."""
    step = end - begin
    share = (box.mean(axis=0) - begin) @ step / max(float(step @ step), 1e-12)
    nearest = np.clip(begin + np.clip(share, 0.0, 1.0) * step, box[0], box[1])
    points = []
    for side, sign in enumerate((-1.0, 1.0)):
        for axis in range(3):
            point = nearest.copy()
            point[axis] = box[side, axis] + sign * (scene.uav_radius + BESIDE)
            if np.all((point > scene.bounds[0]) & (point < scene.bounds[1])):
                points.append(point)
    return points
