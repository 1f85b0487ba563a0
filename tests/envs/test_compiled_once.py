"""Every compiled function is compiled once, whoever calls it."""

from __future__ import annotations

import importlib
import json
import pkgutil
import subprocess
import sys

import numba
import numpy as np

from mjcollect.envs.batch import Simulations
from mjcollect.envs.course import Course
from mjcollect.envs.dm_env import make_environment
from mjcollect.geometry.among_boxes import segment_clear
from mjcollect.geometry.boxes import segment_box_distance
from mjcollect.scene.scene import Scene

ROOMS = tuple(f"mjcollect.{room}" for room in ("geometry", "flight", "guidance", "envs"))


def call_all(course: Course) -> None:
    """Calls kernels single and batched, with read-only and strided arrays."""
    environment = make_environment(course, start="spread", random=0)
    environment.reset()
    sims = Simulations([course] * 3, 3, start="spread", threads=1)
    sims.reset()
    for _ in range(3):
        environment.step(np.zeros(3))
        sims.step(np.zeros((3, 3), dtype=np.float32))
        sims.observe()
        sims.episodes.guidance_action()
    scene = course.scene
    course.guidance[0].query(scene.items[:1])
    course.guidance[0].query(np.asfortranarray(np.ones((4, 3)))[::2])
    segment_box_distance(scene.depot, scene.items, scene.obstacles[:, None])
    segment_clear(scene.depot, scene.items, scene.obstacles, scene.uav_radius)
    environment.close()
    sims.close()


def signatures() -> dict[str, int]:
    """How many kinds of arguments each kernel was compiled for, or loaded, in this process."""
    return {
        name: len(kernel.signatures)
        for room in ROOMS
        for module in pkgutil.iter_modules(importlib.import_module(room).__path__, f"{room}.")
        for name, kernel in vars(importlib.import_module(module.name)).items()
        if isinstance(kernel, numba.core.dispatcher.Dispatcher)
    }


def test_every_kernel_is_compiled_for_one_kind_of_arrays_only(corridor, tmp_path):
    """Else it would be compiled anew, at a second each.

    In a process of its own, where no other test has called any. The first such process compiles
    what is in no cache yet, and then also knows kernels that others call inside.
    """
    corridor.save(tmp_path / "scene.json")
    for _ in range(2):
        done = subprocess.run(
            [sys.executable, __file__, tmp_path / "scene.json"], capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
    counts = json.loads(done.stdout.splitlines()[-1])
    for name in ("event_rows", "approach_rows", "guided_rows", "segment_gaps"):
        assert counts[name] == 1, name
    assert max(counts.values()) == 1, counts


if __name__ == "__main__":
    call_all(Course.segment(Scene.load(sys.argv[1]), (0, 1), 0))
    print(json.dumps(signatures()))
