"""Scene files changed at random are refused with the field named, or flown; nothing else."""

from __future__ import annotations

import contextlib
import json

import numpy as np
import pytest
from mutations import SceneFiles, no_hang

from mjcollect.envs.batch import Simulations
from mjcollect.envs.course import Course
from mjcollect.guidance.guidance import GuidanceError
from mjcollect.scene.file_format import SceneError
from mjcollect.scene.scene import Scene

FILES = 10_000
EVERY = 150  # So many accepted scenes are read again from what is saved, and flown, out of them.
SMALL = {
    "name": "small", "seed": 7, "bounds": {"min": [0, 0, 0], "max": [60, 20.0, 12]},
    "depot": [3, 3, 3], "items": [[50, 15, 6], [10, 16, 4]],
    "obstacles": [
        {"min": [25, 0, 0], "max": [30, 12, 10]}, {"min": [40, 15, 0], "max": [43, 20, 5]},
    ],
    "v_max": 50, "a_max": 20.0, "epsilon": 5.0, "slot": 0.2, "return_tolerance": 4.0,
}  # fmt: skip
RICH = SMALL | {
    "uav_radius": 0.5, "physics_step": 0.02, "clearance": 0.1, "separation": 2.5,
    "more_depots": [[55, 4, 4]],
    "moving": [{"size": [2, 2, 2], "path": [[35, 5, 5], [35, 9, 5]], "speed": 3.0}],
    "origin": {"latitude": 31.3, "longitude": 120.6, "altitude": 3.0, "crs": ""},
    "obstacles": [
        {"min": [25, 2, 0], "max": [30, 12, 10], "yaw": 20.0},
        {"min": [40, 15, 0], "max": [43, 20, 5], "no_fly": True},
    ],
}  # fmt: skip


def named(error, data):
    """Whether a refusal says which field, in one line that a terminal can show."""
    root = error.field.split("[")[0].split(".")[0]
    inside = root == "scene file" or root in {*RICH, *RICH["origin"]}
    text = json.dumps(error.field)[1:-1]  # of a key in the file, as JSON writes it
    return str(error).isprintable() and (
        inside or text.encode() in data or error.field.encode() in data
    )


def fly(scene):
    """Three slots by the guidance law, unless the guidance refuses the scene."""
    with contextlib.suppress(GuidanceError):
        course = Course.segment(scene, tuple(range(len(scene.items))), 0)
        simulations = Simulations([course], 1, threads=1)
        try:
            for _ in range(3):
                simulations.step(simulations.law())
                assert np.isfinite(simulations.observe()).all()
        finally:
            simulations.close()
        return True
    return False


def test_changed_files_are_refused_with_the_field_named_or_flown(tmp_path):
    assert fly(Scene.from_json(json.dumps(SMALL)))  # compiles what is compiled once
    files, path = SceneFiles([SMALL, RICH], seed=0), tmp_path / "scene.json"
    accepted = refused = flown = 0
    for number in range(FILES):
        data = files.draw()
        path.write_bytes(data)
        try:
            with no_hang():
                scene = Scene.load(path)
                accepted += 1
                if accepted % EVERY == 0:
                    assert Scene.from_json(json.dumps(scene.to_dict())) == scene
                    flown += fly(scene)
        except SceneError as error:
            refused += 1
            if not named(error, data):
                pytest.fail(f"file {number}: {error}: {data[:500]!r}")
        except Exception as error:
            pytest.fail(f"file {number}: {error!r}: {data[:500]!r}")
    assert accepted + refused == FILES
    # The changes are of both sorts, so that neither half of the promise is empty.
    assert accepted > FILES / 10
    assert refused > FILES / 2
    assert flown > accepted / EVERY / 3
