"""The scene's key `separation`: what two UAVs keep apart."""

from __future__ import annotations

import json
from copy import deepcopy

import pytest
from scene_files import VALID

from mjcollect.scene.__main__ import main
from mjcollect.scene.file_format import SceneError
from mjcollect.scene.scene import Scene


def text(**fields) -> str:
    return json.dumps(deepcopy(VALID) | fields)


def test_it_is_read_and_written():
    scene = Scene.from_json(text(separation=3.5))
    assert (scene.separation, scene.apart) == (3.5, 3.5)
    document = scene.to_dict()
    assert document["separation"] == 3.5
    assert Scene.from_json(json.dumps(document)) == scene
    assert Scene.from_json(text(separation=4)).apart == 4.0


@pytest.mark.parametrize("fields", [{}, {"separation": 0}])
def test_without_it_they_keep_four_radii_apart(fields):
    scene = Scene.from_json(text(uav_radius=0.3, **fields))
    assert scene.apart == pytest.approx(1.2)
    assert "separation" not in scene.to_dict()


def test_scenes_that_differ_in_it_are_not_equal():
    one, other = Scene.from_json(text()), Scene.from_json(text(separation=3.5))
    assert one != other
    assert Scene.from_json(text(separation=3.5)) == other


@pytest.mark.parametrize("radius", [0.5, 0.2])
def test_the_least_is_twice_the_radius(radius):
    least = 2 * radius
    assert Scene.from_json(text(uav_radius=radius, separation=least)).apart == least
    with pytest.raises(SceneError) as refused:
        Scene.from_json(text(uav_radius=radius, separation=0.99 * least))
    message = str(refused.value)
    assert message.startswith(f"separation: {0.99 * least}: ")
    assert f"must lie from 2 * uav_radius = {least:g} to" in message


@pytest.mark.parametrize("value", [-1, 1e7, True, "3", None, [3], "NaN", "Infinity", "1e400"])
def test_what_is_no_distance_is_refused(value):
    raw = text(separation=3.5).replace(
        "3.5", value if value in ("NaN", "Infinity", "1e400") else json.dumps(value)
    )
    with pytest.raises(SceneError) as refused:
        Scene.from_json(raw)
    assert str(refused.value).startswith("separation")


def test_the_message_for_too_great_a_distance_does_not_ask_for_a_greater_one():
    with pytest.raises(SceneError) as refused:
        Scene.from_json(text(separation=1e7))
    assert "must be at least" not in str(refused.value)


def test_the_command_that_checks_scenes_knows_it(tmp_path, capsys):
    good, bad = tmp_path / "good.json", tmp_path / "bad.json"
    good.write_text(text(separation=2.5))
    bad.write_text(text(separation=0.5))
    assert main([str(good)]) == 0
    assert main([str(bad)]) == 2
    assert "separation: 0.5: must lie from" in capsys.readouterr().err
