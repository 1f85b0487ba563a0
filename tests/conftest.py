"""Small scenes, flat and long: the grids of their guidance fields have few cells."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from pupils import pupil

from mjcollect.envs.course import Course
from mjcollect.scene.scene import Scene

FLAT = [[0.0, 0.0, 0.0], [400.0, 60.0, 60.0]]


torch.set_num_threads(1)  # two busy threads wait for each other on a busy machine


BOXES = [
    [[190.0, 0.0, 0.0], [210.0, 40.0, 55.0]],  # in the way from the depot to item 0
    [[60.0, 0.0, 0.0], [80.0, 20.0, 20.0]],
    [[120.0, 45.0, 45.0], [130.0, 60.0, 60.0]],
    [[300.0, 40.0, 0.0], [330.0, 60.0, 20.0]],
]


@pytest.fixture(scope="session")
def corridor() -> Scene:
    """Four boxes, two items; the segment to item 0 and the way back are blocked."""
    return Scene(
        name="corridor",
        seed=0,
        bounds=FLAT,
        depot=[10, 30, 30],
        items=[[380, 30, 30], [250, 20, 40]],
        obstacles=BOXES,
    )


@pytest.fixture(scope="session")
def free_scene() -> Scene:
    """No box; items 0 and 1 lie within each other's tolerance."""
    return Scene(
        name="free",
        seed=0,
        bounds=FLAT,
        depot=[10, 30, 30],
        items=[[100, 30, 30], [103, 30, 30]],
        obstacles=[],
    )


@pytest.fixture(scope="session")
def blocked_course(corridor: Scene) -> Course:
    return Course.segment(corridor, (0, 1), 0)


@pytest.fixture(scope="session")
def mission_course(corridor: Scene) -> Course:
    return Course.mission(corridor, (0, 1))


@pytest.fixture(scope="session")
def free_course(free_scene: Scene) -> Course:
    return Course.segment(free_scene, (0, 1), 0)


@pytest.fixture(scope="session")
def free_mission(free_scene: Scene) -> Course:
    return Course.mission(free_scene, (0, 1))


@pytest.fixture(scope="session")
def scene_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two items in a flat room, with room around the depot and a box in the way of segment 1."""
    path = tmp_path_factory.mktemp("scene") / "hop.json"
    Scene(
        name="hop",
        seed=0,
        bounds=[[0, 0, 0], [150, 150, 30]],
        depot=[75, 20, 15],
        items=[[75, 120, 15], [120, 60, 15]],
        obstacles=[[[85, 80, 0], [105, 100, 30]]],
    ).save(path)
    return path


@pytest.fixture(scope="session", params=["path"])
def pupil_file(
    request: pytest.FixtureRequest, scene_file: Path, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """A policy that flies all segments of `scene_file`; parametrise it to have another one."""
    scene = Scene.load(scene_file)
    courses = [Course.segment(scene, (0, 1), index) for index in range(3)]
    path = tmp_path_factory.mktemp("pupil") / "pupil.safetensors"
    pupil(courses, request.param).save(path)
    return path


@pytest.fixture(scope="session")
def egl() -> dict[str, str]:
    """The environment of a process that renders by EGL; without that, tests are skipped."""
    environment = {**os.environ, "MUJOCO_GL": "egl", "PYOPENGL_PLATFORM": "egl"}
    probe = (
        "import mujoco; mujoco.Renderer(mujoco.MjModel.from_xml_string('<mujoco/>'), 9, 9).close()"
    )
    ran = subprocess.run(
        [sys.executable, "-c", probe], env=environment, capture_output=True, check=False
    )
    if ran.returncode:
        pytest.skip("no EGL here: apt-get install libegl1 libgl1-mesa-dri")
    return environment
