"""Rules and files of scenes with several depots."""

from __future__ import annotations

import json
from copy import deepcopy

import numpy as np
import pytest
from scene_files import BUNDLED, VALID

from mjcollect.scene.file_format import SceneError
from mjcollect.scene.order import node_name
from mjcollect.scene.scene import Scene

MORE = [[100, 100, 50], [0, 100, 0.5]]


def scene(more=MORE, **changes) -> Scene:
    return Scene.from_json(json.dumps(deepcopy(VALID) | {"more_depots": more} | changes))


def test_the_depot_comes_first_and_files_keep_the_others(tmp_path):
    made = scene()
    assert made.depots.tolist() == [VALID["depot"], *MORE]
    assert [made.point(node).tolist() for node in (-1, -2, -3)] == made.depots.tolist()
    assert made.tolerance(-3) == made.return_tolerance
    assert [node_name(node) for node in (-3, -2, -1, 0)] == [
        "depot 2",
        "depot 1",
        "depot",
        "item 0",
    ]
    made.save(tmp_path / "two.json")
    assert Scene.load(tmp_path / "two.json") == made
    assert made != scene(MORE[:1])


@pytest.mark.parametrize("name", BUNDLED)
def test_a_scene_of_one_depot_is_written_as_ever(name):
    made = Scene.find(name)
    assert made.depots.tolist() == [made.depot.tolist()]
    assert "more_depots" not in made.to_dict()
    assert scene([]).to_dict() == Scene.from_json(json.dumps(VALID)).to_dict()


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ([[10, 20, 50.1]], r"more_depots\[0\]: .*lies outside the bounds"),
        ([MORE[0], [-1, 20, 5]], r"more_depots\[1\]: .*lies outside the bounds"),
        ([MORE[0], [29.6, 40, 20]], r"more_depots\[1\]: .*0.4 m from obstacles\[0\]"),
        ([[40, 40, 20]], r"more_depots\[0\]: .*closer than the body"),
        ([[1, 2]], r"more_depots\[0\]: .*three numbers"),
        ([[1, 2, "3"]], r"more_depots\[0\]\[2\]: "),
        ([1, 2, 3], r"more_depots\[0\]: "),
        (None, "more_depots: null"),
    ],
)
def test_each_depot_keeps_the_rules_of_the_first(more, said):
    with pytest.raises(SceneError, match=said):
        scene(more)


def test_clearance_counts_at_every_depot():
    scene([[29, 40, 20]])
    with pytest.raises(SceneError, match=r"more_depots\[0\]: .*and clearance 0.6 m"):
        scene([[29, 40, 20]], clearance=0.6)


def test_a_moving_box_stands_on_no_depot_at_first():
    moving = [{"size": [2, 2, 2], "path": [[100, 100, 49], [50, 90, 40]], "speed": 1.0}]
    with pytest.raises(SceneError, match=r"moving\[0\].path\[0\]: .*stands on the depot at first"):
        scene(moving=moving)


def cage(centre, half, thick=2.0):
    """Six plates round a centre."""
    boxes = []
    for axis in range(3):
        for low, high in ((-half - thick, -half), (half, half + thick)):
            box = np.array([centre - half - thick, centre + half + thick])
            box[:, axis] = centre[axis] + low, centre[axis] + high
            boxes.append(box)
    return boxes


def test_a_depot_walled_in_from_every_item_is_refused():
    bounds, centre = [[0, 0, 0], [200, 200, 200]], np.full(3, 100.0)
    items, boxes = [[20, 20, 20], [180, 180, 150]], cage(centre, 20.0)
    Scene("open", 0, bounds, [10, 10, 10], items, boxes, more_depots=[[190, 10, 10]])
    with pytest.raises(
        SceneError, match=r"more_depots\[1\]: .*off from every item; open a passage"
    ):
        Scene("caged", 0, bounds, [10, 10, 10], items, boxes, more_depots=[[190, 10, 10], centre])
    # It may have the greater part of space, without any item.
    with pytest.raises(SceneError, match=r"more_depots\[0\]: .*off from every item"):
        Scene("out", 0, bounds, centre, [centre + 15], boxes, more_depots=[[190, 10, 10]])
