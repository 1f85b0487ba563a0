"""`python -m mjcollect.scene FILE`: the table of segments."""

import json

import numpy as np
import pytest
from scene_files import BUNDLED, VALID

from mjcollect.scene.__main__ import main
from mjcollect.scene.order import first_blocked, segments_table
from mjcollect.scene.scene import Scene


def sampled_blocked(scene, start, end):
    points = start + np.linspace(0, 1, 2001)[:, None] * (end - start)
    near = np.clip(points[:, None], scene.obstacles[:, 0], scene.obstacles[:, 1])
    return bool((np.linalg.norm(points[:, None] - near, axis=-1) < scene.uav_radius).any())


@pytest.mark.parametrize("name", BUNDLED)
def test_table_agrees_with_sampled_lines(name):
    scene = Scene.find(name)
    order = tuple(range(len(scene.items)))[::-1]
    nodes = [scene.depot, *scene.items[list(order)], scene.depot]
    table = segments_table(scene, order)
    assert [row["index"] for row in table] == list(range(len(order) + 1))
    assert [row["from"] for row in table] == [-1, *order]
    assert [row["to"] for row in table] == [*order, -1]
    for row in table:
        start, end = nodes[row["index"]], nodes[row["index"] + 1]
        assert row["distance"] == pytest.approx(np.linalg.norm(end - start))
        assert row["blocked"] is sampled_blocked(scene, start, end)
    blocked = [row["index"] for row in table if row["blocked"]]
    assert first_blocked(scene, order) == min(blocked, default=0)


def test_first_blocked_without_obstacles_is_zero():
    scene = Scene.from_json(json.dumps(VALID | {"obstacles": []}))
    assert first_blocked(scene, (0, 1, 2)) == 0
    assert not any(row["blocked"] for row in segments_table(scene, (0, 1, 2)))


def test_json_output(tmp_path, capsys):
    path = tmp_path / "scene.json"
    path.write_text(json.dumps(VALID))
    assert main([str(path), "--json", "--order", "2,0,1"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert set(document) == {"scene", "order", "order_method", "segments"}
    assert (document["scene"], document["order"]) == ("small", [2, 0, 1])
    assert document["segments"] == segments_table(Scene.load(path), (2, 0, 1))
    assert main([str(path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["order_method"] == "lkh"


def test_human_output_lists_every_segment(tmp_path, capsys):
    path = tmp_path / "scene.json"
    path.write_text(json.dumps(VALID))
    assert main([str(path), "--order", "given"]) == 0
    lines = capsys.readouterr().out.splitlines()
    rows = [line.split() for line in lines[-4:]]
    assert [row[:3] for row in rows] == [
        ["0", "depot", "0"],
        ["1", "0", "1"],
        ["2", "1", "2"],
        ["3", "2", "depot"],
    ]
    assert [row[-1] for row in rows] == ["blocked", "free", "blocked", "free"]
    assert rows[0][3] == f"{np.sqrt(80**2 + 80**2 + 20**2):.1f}"
