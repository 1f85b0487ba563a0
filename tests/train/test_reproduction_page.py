"""The page holds the tables, and no number that its JSON does not."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from reproduction_cells import SIZES, plan_of_all, synthetic

from mjcollect.scene.trajectory import Trajectory
from train.reproduction.figures import draw, flights_of
from train.reproduction.page import page
from train.reproduction.plan import Sizes, make_plan
from train.reproduction.tables import tables

FACTORS = {"policy": 1.02, "mpc": 1.03, "guidance": 1.05, "reference": 1.005}


@pytest.fixture
def doc():
    found = {
        **synthetic(lambda cell: FACTORS[cell.planner] + 0.0001 * len(cell.scene)),
        "command": "python -m train.reproduce --workers 3",
        "quick": True,
        "seed": 0,
        "training": [],
        "machines": [{"processor": "some", "cpus": 2, "system": "Linux"}],
        "cell_versions": [{"python": "3"}],
        "sizes": {**vars(SIZES), "sweep": list(SIZES.sweep)},
        "not_flown": [],
        "errors": {},
        "figures": {"sweep": "some-sweep.png"},
    }
    return json.loads(json.dumps(found))


def numbers_in(value):
    if isinstance(value, dict):
        for key, entry in value.items():
            yield from (float(part) for part in re.findall(r"\d+", key))
            yield from numbers_in(entry)
    elif isinstance(value, list):
        yield float(len(value))
        for entry in value:
            yield from numbers_in(entry)
    elif isinstance(value, str):
        yield from (float(part) for part in re.findall(r"\d+", value))
    elif isinstance(value, (int, float)) and not isinstance(value, bool):
        yield float(value)


def test_every_number_of_the_page_is_in_its_json(doc):
    text = re.sub(r"`[^`]*`|!\[.*?\)", "", page(doc), flags=re.S)
    known = [*numbers_in(doc), float(len(doc["cells"]))]
    known += [20.0, 95.0]  # explanations: the generator's spacing, intervals and percentiles
    shown = {digits: {f"{abs(scale * number):.{digits}f}" for number in known for scale in (1, 100)}
             for digits in range(4)}  # fmt: skip
    words = re.findall(r"(?<![\w.])\d+(?:\.\d+)?", text)
    assert len(words) > 500
    for word in words:
        assert word in shown[len(word.partition(".")[2])], f"{word} is nowhere in the JSON"


def test_every_table_has_its_rows(doc):
    lines = page(doc).splitlines()
    found = doc["tables"]
    schemes = {(row["method"], row["planner"]) for entry in found["sweep"]
               for row in entry["schemes"]}  # fmt: skip
    pairs = [pair for name in ("order_saving", "time_order_saving", "policy_saving")
             for pair in found[name].values()]  # fmt: skip
    rows = [len(rows) for rows in found["scenarios"].values()]
    rows += [len(schemes) + 3 + 3]  # with the paper's three schemes, and three on all orders
    rows += [len(found["random"]), len(pairs), len(doc["orders"]["items"])]
    assert sum(line.startswith("|") for line in lines) == sum(rows) + 2 * len(rows)


def test_failures_errors_and_figures_are_listed(doc):
    first, second = list(doc["cells"])[:2]
    assert first not in page(doc)
    doc["cells"][first] |= {"success": False, "violations": ["contact"]}
    doc["errors"][second] = "exit code 2"
    text = page(doc)
    assert f"`{first}`: contact" in text
    assert f"`{second}`: exit code 2" in text
    assert "(some-sweep.png)" in text


def test_a_run_without_a_flight_has_a_page(doc):
    empty = {**doc, "cells": {}, "tables": tables(doc["uses"], {}), "figures": {}}
    lines = page(empty).splitlines()
    assert sum(line.startswith("|") for line in lines) == 2 + len(doc["orders"]["items"])


def test_figures_are_drawn_of_what_was_flown(doc, tmp_path):
    """A flight of scenario 1 by its second training seed, and none of scenario 2."""
    plan = plan_of_all()
    (cell,) = [plan.cells[use.cell] for use in plan.uses
               if (use.scene, use.method, use.planner, use.seed)
               == ("scenario_1", "lkh", "policy", 1)]  # fmt: skip
    (tmp_path / "cells" / cell.name).mkdir(parents=True)
    x = np.cumsum(np.ones((5, 3)), axis=0)
    flight = Trajectory(np.arange(5) * 0.02, x, np.zeros((5, 3)), np.zeros((5, 3)))
    flight.save(tmp_path / "cells" / cell.name / "trajectory.csv")
    (found,) = flights_of(tmp_path, plan, "scenario_1").values()
    assert found[0] == cell.order
    assert found[1].duration == flight.duration
    drawn = draw(tmp_path, plan, doc)
    assert set(drawn) == {"scenario_1", "sweep", "ablation", "savings"}
    assert all((tmp_path / name).stat().st_size > 10_000 for name in drawn.values())


def test_the_committed_page_follows_from_the_committed_flights():
    """Its tables too, whatever was edited since."""
    folder = Path(__file__).parents[2] / "docs" / "results"
    doc = json.loads((folder / "results.json").read_text())
    assert page(doc) == (folder / "reproduction.md").read_text()
    assert json.loads(json.dumps(tables(doc["uses"], doc["cells"]))) == doc["tables"]
    assert (doc["quick"], doc["not_flown"], doc["errors"]) == (False, [], {})
    planned = make_plan(Sizes(), 0, {})  # without the orders at obstacle-aware cost
    assert planned.cells.keys() <= doc["cells"].keys()
    assert all((folder / name).is_file() for name in doc["figures"].values())
