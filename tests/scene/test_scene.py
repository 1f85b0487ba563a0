import json
import os
import re
import subprocess
import sys
from copy import deepcopy
from pathlib import Path

import numpy as np
import pytest
from scene_files import BUNDLED, VALID

from mjcollect.scene.__main__ import main
from mjcollect.scene.assets import asset_path
from mjcollect.scene.file_format import SceneError
from mjcollect.scene.order import segments_table
from mjcollect.scene.scene import Scene

HUGE = 10**400


def changed(path, value):
    """VALID as JSON text with one entry replaced; a value of `...` removes it."""
    document = deepcopy(VALID)
    place = document
    for key in path[:-1]:
        place = place[key]
    if value is ...:
        del place[path[-1]]
    else:
        place[path[-1]] = value
    return json.dumps(document)


def raw(old, new):
    """VALID as JSON text with a piece of the text replaced."""
    text = json.dumps(VALID)
    assert text.count(old) == 1
    return text.replace(old, new)


# (text, what the message must begin with)
BROKEN = {
    "empty file": ("", "scene file"),
    "white space": (" \n\t", "scene file"),
    "truncated": (json.dumps(VALID)[:200], "scene file"),
    "trailing text": (json.dumps(VALID) + "}", "scene file"),
    "list at the top": ("[]", "scene file"),
    "number at the top": ("3", "scene file"),
    "null at the top": ("null", "scene file"),
    "string at the top": ('"scene"', "scene file"),
    "empty object": ("{}", "name"),
    "nested deeply": ("[" * 100_000, "scene file"),
    "single quotes": ("{'name': 'a'}", "scene file"),
    "byte order mark": ("\ufeff" + json.dumps(VALID), "scene file"),
    "NaN in a point": (raw("[80, 80, 20]", "[80, NaN, 20]"), "items[0][1]"),
    "NaN in a limit": (raw('"a_max": 20.0', '"a_max": NaN'), "a_max"),
    "Infinity in bounds": (raw("[100, 100.0, 50]", "[100, Infinity, 50]"), "bounds.max[1]"),
    "minus Infinity": (raw('"epsilon": 5.0', '"epsilon": -Infinity'), "epsilon"),
    "1e400": (raw('"v_max": 50', '"v_max": 1e400'), "v_max"),
    "huge integer limit": (changed(["v_max"], HUGE), "v_max"),
    "huge integer point": (changed(["items", 1, 2], HUGE), "items[1][2]"),
    "huge integer seed": (changed(["seed"], HUGE), "seed"),
    "more digits than Python reads": (raw('"seed": 7', '"seed": ' + "7" * 5000), "seed"),
    "huge but finite limit": (changed(["v_max"], 1e300), "v_max"),
    "tiny limit": (changed(["a_max"], 1e-300), "a_max"),
    "boolean for a number": (changed(["epsilon"], True), "epsilon"),
    "boolean in a point": (changed(["depot", 0], False), "depot[0]"),
    "boolean seed": (changed(["seed"], True), "seed"),
    "string for a number": (changed(["slot"], "0.2"), "slot"),
    "string in a point": (changed(["items", 2, 0], "90"), "items[2][0]"),
    "null limit": (changed(["v_max"], None), "v_max"),
    "null item": (changed(["items", 0], None), "items[0]"),
    "null obstacles": (changed(["obstacles"], None), "obstacles"),
    "object for a list": (changed(["items"], {"a": [1, 2, 3]}), "items"),
    "list for bounds": (changed(["bounds"], [[0, 0, 0], [1, 1, 1]]), "bounds"),
    "list for an obstacle": (changed(["obstacles", 1], [[0] * 3, [1] * 3]), "obstacles[1]"),
    "nested too deep": (changed(["items", 0], [[80, 80, 20]]), "items[0][0]"),
    "one flat item": (changed(["items"], [80, 80, 20]), "items[0]"),
    "two coordinates": (changed(["items", 1], [10, 90]), "items[1]"),
    "four coordinates": (changed(["items", 1], [10, 90, 40, 1]), "items[1]"),
    "empty point": (changed(["depot"], []), "depot"),
    "unknown key": (changed(["wind"], 3), "wind"),
    "unknown key in a box": (changed(["obstacles", 0, "height"], 3), "obstacles[0].height"),
    "misspelt optional key": (changed(["uav_radios"], 0.5), "uav_radios"),
    "duplicate key": (raw('"seed": 7', '"seed": 7, "seed": 8'), "seed"),
    "duplicate key in a box": (raw('"max": [60,', '"min": [1, 1, 1], "max": [60,'), "min"),
    "box without max": (changed(["obstacles", 0, "max"], ...), "obstacles[0].max"),
    "bounds without min": (changed(["bounds", "min"], ...), "bounds.min"),
    "name is a number": (changed(["name"], 3), "name"),
    "name is empty": (changed(["name"], ""), "name"),
    "name is blank": (changed(["name"], "  "), "name"),
    "name with a line break": (changed(["name"], "a\nb"), "name"),
    "name is endless": (changed(["name"], "a" * 5000), "name"),
    "lone surrogate in the name": (raw('"small"', '"\\ud800"'), "scene file"),
    "seed is negative": (changed(["seed"], -1), "seed"),
    "seed is a fraction": (changed(["seed"], 1.5), "seed"),
    "seed is too large": (changed(["seed"], 2**63), "seed"),
    "no items": (changed(["items"], []), "items"),
    "bounds upside down": (changed(["bounds", "min", 2], 60), "bounds"),
    "flat bounds": (changed(["bounds", "max", 2], 0), "bounds"),
    "bounds beyond reason": (changed(["bounds", "max", 0], 1e9), "bounds"),
    "body does not fit": (changed(["uav_radius"], 30.0), "bounds"),
    "depot outside": (changed(["depot", 0], -0.1), "depot"),
    "depot in a box": (changed(["depot"], [40, 40, 20]), "depot"),
    "depot nearer to a box than the radius": (changed(["depot"], [29.6, 40, 20]), "depot"),
    "item outside": (changed(["items", 1, 2], 50.1), "items[1]"),
    "item in a box": (changed(["items", 1], [40, 40, 20]), "items[1]"),
    "item on a box's face": (changed(["items", 2], [40, 40, 40]), "items[2]"),
    "item on a box's corner": (changed(["items", 2], [60, 60, 40]), "items[2]"),
    "box upside down": (changed(["obstacles", 1, "min", 0], 21), "obstacles[1]"),
    "flat box": (changed(["obstacles", 1, "min", 0], 20), "obstacles[1]"),
    "box outside": (changed(["obstacles", 0, "max", 1], 100.5), "obstacles[0]"),
    "slot is no multiple": (changed(["physics_step"], 0.03), "physics_step"),
    "step longer than the slot": (changed(["physics_step"], 0.4), "physics_step"),
    "step far too small": (changed(["physics_step"], 1e-5), "physics_step"),
    "step of next to nothing": (changed(["physics_step"], 1e-300), "physics_step"),
    "epsilon wider than the scene": (changed(["epsilon"], 500), "epsilon"),
    "tolerance wider than the scene": (changed(["return_tolerance"], 500), "return_tolerance"),
}


for _key in VALID:
    BROKEN[f"no {_key}"] = (changed([_key], ...), _key)


for _key in ("v_max", "a_max", "epsilon", "slot", "return_tolerance", "uav_radius", "physics_step"):
    BROKEN[f"{_key} zero"] = (changed([_key], 0), _key)
    BROKEN[f"{_key} negative"] = (changed([_key], -1.0), _key)


@pytest.mark.parametrize("label", BROKEN)
def test_broken_file_is_refused(label, tmp_path, capsys):
    text, field = BROKEN[label]
    path = tmp_path / "scene.json"
    path.write_bytes(text.encode())
    with pytest.raises(SceneError) as caught:
        Scene.load(path)
    assert caught.value.field == field
    assert main([str(path)]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith(f"error: {field}: ")
    assert len(captured.err.splitlines()) == 1
    assert len(captured.err) < 400
    assert "Traceback" not in captured.err


@pytest.mark.parametrize(
    ("make", "word"),
    [
        (lambda path: path.mkdir(), "folder"),
        (lambda path: None, "does not exist"),
        (lambda path: path.write_bytes(bytes(range(256)) * 9), "UTF-8"),
        (lambda path: path.write_bytes(json.dumps(VALID).encode("utf-16")), "UTF-8"),
        (lambda path: path.symlink_to(path), "cannot be read"),
    ],
)
def test_unreadable_file_is_refused(make, word, tmp_path, capsys):
    path = tmp_path / "scene.json"
    make(path)
    assert main([str(path)]) == 2
    error = capsys.readouterr().err
    assert word in error
    assert str(path)[:40] in error
    assert len(error.splitlines()) == 1


def test_file_without_permission_is_refused(monkeypatch):
    def refuse(*args, **kwargs):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "read_text", refuse)
    with pytest.raises(SceneError, match=r"scene\.json.*Permission denied"):
        Scene.load("scene.json")


@pytest.mark.parametrize("path", ["a\0b", "x" * 5000, ""])
def test_impossible_path_is_refused(path):
    with pytest.raises(SceneError, match="scene file"):
        Scene.load(path)


def test_command_line_as_a_module(tmp_path):
    path = tmp_path / "scene.json"
    for text, code in ((json.dumps(VALID), 0), (changed(["items"], []), 2)):
        path.write_text(text)
        done = subprocess.run(
            [sys.executable, "-m", "mjcollect.scene", path],
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == code
        assert "Traceback" not in done.stderr
        assert (done.stderr == "") == (code == 0)


@pytest.mark.parametrize(
    "arguments", [[], ["--wrong"], ["FILE", "extra"], ["FILE", "--order", "x"]]
)
def test_bad_command_line_exits_2(arguments, tmp_path, capsys):
    path = tmp_path / "scene.json"
    path.write_text(json.dumps(VALID))
    try:
        code = main([str(path) if part == "FILE" else part for part in arguments])
    except SystemExit as end:
        code = end.code
    assert code == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1


def test_every_key_is_read():
    scene = Scene.from_json(json.dumps(VALID | {"uav_radius": 0.25, "physics_step": 0.05}))
    assert (scene.name, scene.seed) == ("small", 7)
    assert scene.bounds.tolist() == [[0, 0, 0], [100, 100, 50]]
    assert scene.depot.tolist() == [0, 0, 0]
    assert scene.items.tolist() == VALID["items"]
    assert scene.obstacles[1].tolist() == [[5, 5, 45], [20, 20, 50]]
    limits = (scene.v_max, scene.a_max, scene.epsilon, scene.slot, scene.return_tolerance)
    assert limits == (50, 20, 5, 0.2, 4)
    assert (scene.uav_radius, scene.physics_step, scene.substeps) == (0.25, 0.05, 4)


def test_optional_keys_have_defaults():
    scene = Scene.from_json(json.dumps(VALID))
    assert (scene.uav_radius, scene.physics_step, scene.substeps) == (0.5, 0.02, 10)


def test_no_obstacles_and_items_close_together_are_legal():
    scene = Scene.from_json(
        json.dumps(VALID | {"obstacles": [], "items": [[1, 1, 1], [1, 1, 1], [2, 1, 1], [0, 0, 0]]})
    )
    assert scene.obstacles.shape == (0, 2, 3)
    assert len(scene.items) == 4


def test_points_on_the_bounds_and_touching_boxes_are_legal():
    boxes = [{"min": [30, 30, 0], "max": [60, 60, 50]}, {"min": [60, 30, 0], "max": [70, 60, 50]}]
    Scene.from_json(json.dumps(VALID | {"items": [[100, 100, 50]], "obstacles": boxes}))
    Scene.from_json(json.dumps(VALID | {"depot": [29.5, 40, 20]}))


def test_one_second_slots():
    scene = Scene.from_json(json.dumps(VALID | {"slot": 1.0}))
    assert scene.substeps == 50


def test_round_trip(tmp_path):
    document = VALID | {"depot": [0.1 + 0.2, 1 / 3, 1e-17], "name": 'Zoë "π" / ..'}
    scene = Scene.from_json(json.dumps(document))
    scene.save(tmp_path / "a.json")
    again = Scene.load(tmp_path / "a.json")
    assert again == scene
    assert hash(again) == hash(scene)
    assert again.depot.tolist() == document["depot"]
    assert set(json.loads((tmp_path / "a.json").read_text())) == {
        *VALID,
        "uav_radius",
        "physics_step",
    }


def test_scenes_differ_by_any_key():
    scene = Scene.from_json(json.dumps(VALID))
    for path, value in [(["seed"], 8), (["items", 0, 0], 80.5), (["slot"], 0.4), (["name"], "b")]:
        assert Scene.from_json(changed(path, value)) != scene


def test_scene_is_immutable():
    items = np.array(VALID["items"], float)
    scene = Scene("t", 0, [[0] * 3, [100] * 3], [0] * 3, items, [])
    items[0] = 0  # a copy was taken
    assert scene.items[0].tolist() == VALID["items"][0]
    for field in ("bounds", "depot", "items", "obstacles"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(scene, field)[:] = 1
    with pytest.raises(AttributeError):
        scene.v_max = 3.0


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("items", [1.0, 2.0, 3.0]),
        ("items", [[1, 2], [3, 4], [5, 6]]),
        ("bounds", [0, 0, 0, 9, 9, 9]),
        ("bounds", [[0, 0], [0, 9], [9, 9]]),
        ("depot", [[0, 0, 0]]),
        ("depot", "here"),
        ("depot", [0, 0, np.nan]),
        ("obstacles", [[0, 0, 0], [1, 1, 1]]),
        ("v_max", "50"),
        ("v_max", None),
        ("a_max", True),
        ("a_max", np.inf),
        ("seed", "1"),
        ("name", 5),
    ],
)
def test_bad_values_from_python_are_refused(field, value):
    fields = {"name": "t", "seed": 0, "bounds": [[0] * 3, [100] * 3], "depot": [0] * 3}
    fields |= {"items": [[50] * 3], "obstacles": []}
    with pytest.raises(SceneError) as caught:
        Scene(**(fields | {field: value}))
    assert caught.value.field == field


def test_message_names_field_value_and_fix():
    with pytest.raises(SceneError) as caught:
        Scene.from_json(changed(["a_max"], -3.5))
    assert "a_max" in str(caught.value)
    assert "-3.5" in str(caught.value)
    assert "positive" in str(caught.value)


def test_points_and_tolerances_of_nodes():
    scene = Scene.from_json(json.dumps(VALID))
    assert scene.point(-1).tolist() == VALID["depot"]
    assert scene.point(2).tolist() == VALID["items"][2]
    assert (scene.tolerance(-1), scene.tolerance(0)) == (4.0, 5.0)


@pytest.mark.parametrize(
    ("name", "slug"),
    [
        ("city_6", "city_6"),
        ("../../etc", "_._.._etc"),
        ("a b/c", "a_b_c"),
        ("-x", "_x"),
        (".", "_"),
    ],
)
def test_slug_is_a_plain_file_name(name, slug):
    assert Scene.from_json(changed(["name"], name)).slug == slug


@pytest.mark.parametrize("name", BUNDLED)
def test_bundled_scenes_are_valid(name):
    scene = Scene.find(name)
    assert scene == Scene.load(asset_path("scenes", f"{name}.json"))
    assert Scene.from_json(json.dumps(scene.to_dict())) == scene


def test_find_prefers_a_file_and_names_what_is_missing(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SceneError, match="nowhere"):
        Scene.find("nowhere")
    for name in ("x" * 5000, "a\0b"):  # that no file can have
        with pytest.raises(SceneError, match="cannot be read"):
            Scene.find(name)
    (tmp_path / "scenario_1").write_text(json.dumps(VALID))
    assert Scene.find("scenario_1").name == "small"


def test_documented_example_is_valid():
    page = Path(__file__).parents[2] / "docs" / "scene-format.md"
    blocks = re.findall(r"```json\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    scene = Scene.from_json(blocks[0])
    moving = Scene.from_json(json.dumps(json.loads(blocks[0]) | json.loads(f"{{{blocks[1]}}}")))
    assert len(moving.moving) == 1
    shown = json.loads(blocks[2])
    row = segments_table(scene, shown["order"])[0]
    assert shown["segments"] == [row | {"distance": pytest.approx(row["distance"], abs=0.005)}]
    for key in moving.to_dict():
        assert f"| `{key}` |" in page.read_text(encoding="utf-8")


def test_control_characters_of_a_file_are_not_echoed():
    """They could rewrite the terminal's title, or what it showed before."""
    error = SceneError("\x1b]0;gone\x07", "a\x1b[2Jb\u202ec", "fix it")
    assert str(error).isprintable()
    assert "\\x1b[2J" in str(error)
    assert error.field == "\x1b]0;gone\x07"


def test_a_reader_that_has_read_enough_is_no_error():
    reading, writing = os.pipe()
    os.close(reading)
    command = [sys.executable, "-m", "mjcollect.scene", "scenario_2"]
    with os.fdopen(writing, "wb") as closed:
        run = subprocess.run(command, stdout=closed, stderr=subprocess.PIPE, check=False)
    assert run.returncode == 0
    assert b"Broken" not in run.stderr
    assert b"Traceback" not in run.stderr
