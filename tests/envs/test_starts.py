from __future__ import annotations

import numpy as np
import pytest

from mjcollect.geometry.boxes import segment_box_distance


@pytest.mark.parametrize("kind", ["point", "ball", "spread"])
def test_starts_are_in_bounds_clear_of_boxes_and_of_their_kind(blocked_course, kind):
    scene = blocked_course.scene
    q, v = blocked_course.starts(kind, 400, np.random.default_rng(0))
    assert np.all((q >= scene.bounds[0]) & (q <= scene.bounds[1]))
    for box in scene.obstacles:
        over = np.maximum(np.maximum(box[0] - q, q - box[1]), 0.0)
        assert np.all(np.linalg.norm(over, axis=1) >= scene.uav_radius)
    speed, away = np.linalg.norm(v, axis=1), np.linalg.norm(q - scene.depot, axis=1)
    assert speed.max() <= (scene.v_max if kind == "spread" else 0.0)
    if kind == "point":
        assert away.max() == 0.0
    if kind == "ball":
        assert 4.0 < away.max() <= 5.0
        assert np.mean(away < 2.5) == pytest.approx(1 / 8, abs=0.06)  # uniform in volume
    if kind == "spread":
        assert 0.2 < np.mean(away <= 5.0) < 0.4
        assert q[:, 0].max() > 300.0
        # Some are about as fast as can still be stopped in the goal's ball.
        goal = blocked_course.guidance[0].goal
        left = np.linalg.norm(goal - q, axis=1)
        share = speed**2 / (2 * scene.a_max) / left
        assert np.mean((share > 0.7) & (share < 1.2)) > 0.05
    stop = q + v * speed[:, None] / (2 * scene.a_max)
    for box in scene.obstacles:
        assert segment_box_distance(q, stop, box).min() >= scene.uav_radius
