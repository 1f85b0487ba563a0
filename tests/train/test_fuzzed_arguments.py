"""Command lines at random end with exit code 0, 1 or 2 and a message that names what is wrong."""

from __future__ import annotations

import importlib
import json
import os
import re
import signal

import numpy as np
import pytest
from mutations import no_hang

from train.__main__ import PROGRAMS
from train.support.run_folder import RunFolder

FEW, MANY = 57, 110  # lists for programs of which one takes long, and for others: 1002 in all
BASE = {
    "segment": (FEW, "--scene hop.json --out out"),
    "mission": (FEW, "--scene hop.json --out out"),
    "fly": (FEW, "--scene hop.json --out out"),
    "generalist": (FEW, "--out out"),
    "assign": (FEW, "--scene hop.json --uavs 2"),
    "reproduce": (FEW, "--quick --out out"),
    "scene": (MANY, "hop.json"),
    "generate": (MANY, "--seed 1 --items 3 --obstacles 5 --out new.json"),
    "import": (MANY, "map.geojson --center 31.3 120.6 --random-items 3 --out new.json"),
    "render": (MANY, "--run run"),
    "replay": (MANY, "run --out new.html"),
    "view": (MANY, "--run run"),
    "verify": (MANY, "run"),
    "export": (MANY, "--run run --format csv"),
}
VALUES = (
    "", " ", "nan", "inf", "-inf", "-1", "0", "1", "7", "0.5", "1e400", "1e-400", "9" * 400,
    "9" * 5000, "0x10", "1_000", "é", "a\x00b", "x" * 5000, "/", "/dev/null", ".", "None",
    "nowhere/none.json", "hop.json", "hop.json/below", "run", "odd0", "odd1", "odd2", "map.geojson",
    "true", "--", "-", "=", "[1,2]", "0,1", "1,0", "0,0", "shipped", "none", "cuda", "cpu", "lkh",
    "exact", "random", "paper", "--scene", "policy.pt",
)  # fmt: skip
MAP = {
    "type": "Feature",
    "properties": {"height": 20},
    "geometry": {
        "type": "Polygon",
        "coordinates": [[[120.6, 31.3], [120.6002, 31.3], [120.6002, 31.3002], [120.6, 31.3]]],
    },
}


class Accepted(Exception):
    """Says that arguments were accepted, in place of hours of work."""


@pytest.fixture
def place(tmp_path, monkeypatch, scene_file):
    """A folder to stand in, with what the lists name; programs stop where work begins."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "hop.json").write_bytes(scene_file.read_bytes())
    (tmp_path / "map.geojson").write_text(json.dumps(MAP))
    (tmp_path / "policy.pt").write_bytes(b"PK\x03\x04")
    for number, text in enumerate(("[]", "{}", '{"order": 5, "success": true, "uavs": "x"}')):
        folder = tmp_path / f"odd{number}"
        folder.mkdir()
        (folder / "scene.json").write_bytes(scene_file.read_bytes())
        (folder / "trajectory.csv").write_text("t,x,y,z,vx,vy,vz,ax,ay,az\n" + "0," * 9 + "0\n")
        for name in ("mission.json", "segment.json", "config.json", "air.json"):
            (folder / name).write_text(text)
        if number == 2:
            (folder / "fleet.json").write_text(text)
    (tmp_path / "run").mkdir()

    def accept(*_, **__):
        raise Accepted

    for name in ("train.segment", "train.mission", "train.fly"):
        module = importlib.import_module(name)
        monkeypatch.setattr(module.Course, "segment", accept)
        monkeypatch.setattr(module.Course, "mission", accept)
    for name in ("train.mission", "train.fly"):
        monkeypatch.setattr(f"{name}.share_scene", accept)
    for name in ("train.mission", "train.generalist", "train.reproduce"):
        monkeypatch.setattr(f"{name}.connect_ray", accept)
    monkeypatch.setattr("train.assign.travel_times", lambda scene, depots: np.ones((3, 3)))
    monkeypatch.setattr(RunFolder, "create", accept)
    monkeypatch.setattr("mjcollect.guidance.travel_times.travel_times", accept)
    kept = dict(os.environ), signal.getsignal(signal.SIGTERM)
    yield tmp_path
    os.environ.clear()
    os.environ.update(kept[0])
    signal.signal(signal.SIGTERM, kept[1])


def flags_of(main, capsys):
    with pytest.raises(SystemExit):
        main(["--help"])
    return sorted(set(re.findall(r"(?<![\w-])--[a-z][a-z0-9-]+", capsys.readouterr().out)))


def changed(base, flags, rng):
    """A command line with a few things added, dropped, doubled or in each other's place."""
    words = list(base)

    def pick(choices):
        return choices[int(rng.integers(len(choices)))]

    for _ in range(int(rng.choice([1, 1, 2, 3]))):
        kind = int(rng.integers(7))
        if kind <= 2:
            words += [pick(flags), pick(VALUES)]
        elif kind == 3 and words:
            words[int(rng.integers(len(words)))] = pick(VALUES)
        elif kind == 4 and words:
            del words[int(rng.integers(len(words)))]
        elif kind == 5:
            words.append(pick(("--unknown", pick(VALUES), pick(flags), pick(flags) + "=")))
        else:
            words.insert(int(rng.integers(len(words) + 1)), pick(VALUES))
    return words


def says(error, words):
    """Whether a message names one of the words, or what is missing or too much.

    An empty word that is too much has no name.
    """

    def plain(text):
        return re.sub(r"[\s_│-]+", "", text.lower())

    parts = [plain(part)[:20] for word in words for part in (word, *word.split("="))]
    named = any(part in plain(error) for part in parts if part)
    named = named or any(f"error: {word or '.'}: " in error for word in words)
    missing = "required|is missing|unrecognized|error: scene file: "
    return named or re.search(missing, error, re.IGNORECASE)


@pytest.mark.parametrize("name", BASE)
def test_command_lines_are_refused_with_what_is_wrong_named(name, place, capsys):
    main = importlib.import_module(PROGRAMS[name]).main
    count, base = BASE[name]
    flags, rng = flags_of(main, capsys), np.random.default_rng(list(BASE).index(name))
    codes = set()
    for number in range(count):
        words = changed(base.split(), flags, rng)
        if {"--help", "-h"} & set(words):
            words = base.split()
        try:
            with no_hang():
                code = main(list(words))
        except Accepted:
            code = 0
        except SystemExit as end:
            code = end.code or 0
        except Exception as error:
            pytest.fail(f"{name} {number}: {words}: {error!r}")
        said = capsys.readouterr()
        assert code in (0, 1, 2), (number, words, code)
        assert "Traceback" not in said.err, (number, words)
        if code == 2:
            assert says(said.err + said.out, words), (number, words, said.err)
        codes.add(code)
    assert 2 in codes or name == "render"


def test_there_are_a_thousand_lists():
    assert sum(count for count, _ in BASE.values()) >= 1000
    assert set(BASE) == set(PROGRAMS)
