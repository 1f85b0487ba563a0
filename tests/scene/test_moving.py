"""Boxes that move: where they are, and which of them a scene may hold."""

from __future__ import annotations

import json
from copy import deepcopy

import numpy as np
import pytest
from scene_files import VALID

from mjcollect.flight.moving_boxes import MovingBoxes
from mjcollect.scene.file_format import SceneError
from mjcollect.scene.moving import MovingBox
from mjcollect.scene.scene import Scene

BOX = {"size": [4, 4, 4], "path": [[70, 10, 20], [70, 50, 20], [90, 50, 20]], "speed": 3.0}


def with_box(**changes: object) -> str:
    document = deepcopy(VALID)
    document["moving"] = [{k: v for k, v in (BOX | changes).items() if v is not None}]
    return json.dumps(document)


def test_a_box_moves_to_and_fro_as_in_flight() -> None:
    box = MovingBox.from_dict(BOX | {"phase": 0.3})
    movers = MovingBoxes(1, 1, 3)
    movers.path[0, 0], movers.phase[0, 0], movers.speed[0, 0] = box.path, 0.3, box.speed
    t = np.linspace(0.0, 100.0, 777)
    np.testing.assert_allclose(box.centres(t), movers.centres(t)[0, 0], atol=1e-9)
    start = MovingBox.from_dict(BOX)
    np.testing.assert_allclose(start.centres(np.array([0.0, 40 / 3, 20.0])),
                               [[70, 10, 20], [70, 50, 20], [90, 50, 20]])  # fmt: skip
    np.testing.assert_allclose(start.box_at(40.0), [[68, 8, 18], [72, 12, 22]])


def test_a_scene_keeps_its_moving_boxes_and_one_without_is_written_as_before(tmp_path) -> None:
    scene = Scene.from_json(with_box())
    scene.save(tmp_path / "scene.json")
    assert Scene.load(tmp_path / "scene.json") == scene
    assert scene.moving[0].speed == 3.0
    assert scene != Scene.from_json(json.dumps(VALID))
    assert "moving" not in Scene.from_json(json.dumps(VALID)).to_dict()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"size": [4, 0, 4]}, r"moving\[0\].size"),
        ({"size": [4, 4]}, r"moving\[0\].size.*three numbers"),
        ({"size": [4, 4, True]}, r"moving\[0\].size\[2\]"),
        ({"path": [[70, 10, 20]]}, r"moving\[0\].path.*two points"),
        ({"path": [[70, 10, 20], [70, 10, 20]]}, r"moving\[0\].path\[1\].*before it"),
        ({"path": [[70, 10, 20], [70, 200, 20]]}, r"moving\[0\].path\[1\].*outside the bounds"),
        ({"path": [[1, 1, 1], [70, 10, 20]]}, r"moving\[0\].path\[0\].*depot"),
        ({"speed": 0.0}, r"moving\[0\].speed"),
        ({"speed": -1.0}, r"moving\[0\].speed"),
        ({"speed": None}, r"moving\[0\].speed.*missing"),
        ({"phase": 0.5}, r"moving\[0\].phase.*not a known key"),
    ],
)
def test_boxes_that_cannot_move_are_refused(changes, message) -> None:
    with pytest.raises(SceneError, match=message):
        Scene.from_json(with_box(**changes))


def test_something_else_than_a_box_is_refused() -> None:
    fields = {k: v for k, v in VALID.items() if k not in ("bounds", "obstacles")}
    with pytest.raises(SceneError, match=r"moving.*needs boxes"):
        Scene(**fields, bounds=[[0, 0, 0], [100, 100, 50]], obstacles=[], moving=[3])
