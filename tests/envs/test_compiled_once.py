"""Every compiled function is compiled once, whoever calls it."""

from __future__ import annotations

import importlib
import pkgutil

import numba
import numpy as np

from mjcollect.envs.batch import Simulations
from mjcollect.envs.dm_env import make_environment
from mjcollect.geometry.among_boxes import segment_clear
from mjcollect.geometry.boxes import segment_box_distance

ROOMS = tuple(f"mjcollect.{room}" for room in ("geometry", "flight", "guidance", "envs"))


def test_every_kernel_is_compiled_for_one_kind_of_arrays_only(blocked_course):
    """Single or batched, read-only or strided: else it would be compiled anew, at a second each."""
    environment = make_environment(blocked_course, start="spread", random=0)
    environment.reset()
    sims = Simulations([blocked_course] * 3, 3, start="spread", threads=1)
    sims.reset()
    for _ in range(3):
        environment.step(np.zeros(3))
        sims.step(np.zeros((3, 3), dtype=np.float32))
        sims.observe()
        sims.episodes.guidance_action()
    scene = blocked_course.scene
    blocked_course.guidance[0].query(scene.items[:1])
    blocked_course.guidance[0].query(np.asfortranarray(np.ones((4, 3)))[::2])
    segment_box_distance(scene.depot, scene.items, scene.obstacles[:, None])
    segment_clear(scene.depot, scene.items, scene.obstacles, scene.uav_radius)
    environment.close()
    sims.close()
    counts = {
        name: len(kernel.signatures)
        for room in ROOMS
        for module in pkgutil.iter_modules(importlib.import_module(room).__path__, f"{room}.")
        for name, kernel in vars(importlib.import_module(module.name)).items()
        if isinstance(kernel, numba.core.dispatcher.Dispatcher)
    }
    assert (
        counts["event_rows"]
        == counts["approach_rows"]
        == counts["guided_rows"]
        == counts["segment_gaps"]
        == 1
    )
    assert max(counts.values()) == 1, counts
