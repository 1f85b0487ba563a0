import subprocess
import sys

import numpy as np
import pytest

from mjcollect.generate import GenerateError, generate
from mjcollect.generate.__main__ import main
from mjcollect.scene.scene import Scene


def box_gaps(boxes):
    """Euclidean gap of every pair of boxes."""
    first, second = np.triu_indices(len(boxes), 1)
    a, b = boxes[first], boxes[second]
    return np.linalg.norm(np.maximum(np.maximum(b[:, 0] - a[:, 1], a[:, 0] - b[:, 1]), 0), axis=1)


def gap(points, boxes):
    points = np.atleast_2d(points)[:, None]
    return np.linalg.norm(points - np.clip(points, boxes[:, 0], boxes[:, 1]), axis=-1)


@pytest.mark.parametrize("layout", ["floating", "city"])
@pytest.mark.parametrize(("items", "obstacles"), [(8, 20), (200, 200)])
def test_the_rules_hold(layout, items, obstacles):
    for seed in range(3):
        scene = generate(seed, items, obstacles, layout)
        assert (len(scene.items), len(scene.obstacles)) == (items, obstacles)
        assert scene.bounds.tolist() == [[0] * 3, [1000] * 3]
        assert scene.depot.tolist() == [0] * 3
        assert np.all(scene.obstacles >= 0)
        assert np.all(scene.obstacles <= 1000)
        assert box_gaps(scene.obstacles).min() >= 5
        assert gap(scene.depot, scene.obstacles).min() >= 30
        assert gap(scene.items, scene.obstacles).min() >= 10
        between = np.linalg.norm(scene.items[:, None] - scene.items, axis=-1)
        assert between[np.triu_indices(items, 1)].min() >= 20
        size = scene.obstacles[:, 1] - scene.obstacles[:, 0]
        if layout == "city":
            assert np.all(scene.obstacles[:, 0, 2] == 0)
        if obstacles == 20:
            sides = size[:, :2] if layout == "city" else size
            assert np.all((sides > 49.99) & (sides < 200.01))
            if layout == "city":
                assert np.all((size[:, 2] > 99.99) & (size[:, 2] < 600.01))


def test_sides_fill_their_range():
    sizes = np.concatenate(
        [np.diff(generate(seed, 1).obstacles, axis=1).ravel() for seed in range(30)]
    )
    assert 120 < sizes.mean() < 130
    assert sizes.min() < 55
    assert sizes.max() > 195


@pytest.mark.parametrize("layout", ["floating", "city"])
def test_items_and_obstacles_are_nested_in_k(layout):
    most = generate(5, 30, layout=layout)
    for count in (1, 2, 7):
        fewer = generate(5, count, layout=layout)
        assert np.array_equal(fewer.items, most.items[:count])
        assert np.array_equal(fewer.obstacles, most.obstacles)


def test_seed_decides_everything():
    assert generate(3, 5) == generate(3, 5)
    assert not np.array_equal(generate(3, 5).items, generate(4, 5).items)
    assert not np.array_equal(generate(3, 5).obstacles, generate(4, 5).obstacles)
    assert generate(3, 5).seed == 3
    assert generate(3, 5).name == "floating_5_seed3"


def test_no_obstacles():
    assert len(generate(0, 4, 0).obstacles) == 0


@pytest.mark.parametrize(
    ("arguments", "field"),
    [
        ((-1, 4), "seed"),
        ((2**63, 4), "seed"),
        ((0, 0), "items"),
        ((0, 4, -1), "obstacles"),
        ((0, 4, 20, "maze"), "layout"),
        ((0, 4, 5000, "city"), "obstacles"),
    ],
)
def test_bad_arguments_are_refused(arguments, field):
    with pytest.raises(GenerateError, match=f"^{field}"):
        generate(*arguments)


def test_command_writes_a_scene_and_refuses_to_overwrite(tmp_path, capsys):
    out = tmp_path / "new" / "s.json"
    command = ["--seed", "3", "--items", "4", "--obstacles", "6", "--out", str(out)]
    assert main(command) == 0
    assert Scene.load(out) == generate(3, 4, 6)
    before = out.read_text()
    assert main([*command, "--layout", "city"]) == 2
    assert out.read_text() == before
    assert "--overwrite" in capsys.readouterr().err
    assert main([*command, "--layout", "city", "--overwrite"]) == 0
    assert Scene.load(out) == generate(3, 4, 6, "city")


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"--items": "0"}, "items"),
        ({"--items": "four"}, "items"),
        ({"--items": None}, "items"),
        ({"--seed": "-1"}, "seed"),
        ({"--obstacles": "-3"}, "obstacles"),
        ({"--layout": "maze"}, "layout"),
        ({"--out": None}, "out"),
        ({"--out": "."}, "exists"),
        ({"--out": "/dev/null/x.json"}, "written"),
    ],
)
def test_bad_command_line_exits_2_with_one_line(tmp_path, capsys, monkeypatch, change, word):
    monkeypatch.chdir(tmp_path)
    options = {"--seed": "1", "--items": "2", "--out": "s.json"} | change
    command = [part for pair in options.items() if pair[1] is not None for part in pair]
    try:
        code = main(command)
    except SystemExit as end:
        code = end.code
    assert code == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert len(captured.err.strip().splitlines()) == 1
    assert word in captured.err
    assert list(tmp_path.iterdir()) == []


def test_as_a_module(tmp_path):
    out = tmp_path / "s.json"
    done = subprocess.run(
        [sys.executable, "-m", "mjcollect.generate", "--seed", "1", "--items", "2", "--out", out],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert Scene.load(out) == generate(1, 2)
