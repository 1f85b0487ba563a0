"""Verdicts turn when the numbers turn, and the page says nothing that its JSON does not."""

import json
import re
from pathlib import Path

import pytest
from reproduction_cells import TIME_ORDERS, synthetic

from train.reproduction.claims import claims
from train.reproduction.page import page
from train.reproduction.plan import Sizes, make_plan
from train.reproduction.tables import tables
from train.reproduction.wording import FAILS, HOLDS, PARTLY, UNDECIDED, UNTESTED

FACTORS = {"policy": 1.02, "mpc": 1.03, "guidance": 1.05, "reference": 1.005}


def verdicts(doc):
    names = ["order", "eight", "mpc", "small", "plateau", "shortest", "knee", "safe", "learning",
             "aware"]  # fmt: skip
    found = claims(doc)
    assert len(found) == len(names)
    return dict(zip(names, (claim["verdict"] for claim in found), strict=True))


@pytest.fixture(scope="module")
def usual():
    return synthetic(lambda cell: FACTORS[cell.planner] + 0.0001 * len(cell.scene))


def test_verdicts_of_policies_that_beat_the_mpc(usual):
    found = verdicts(usual)
    assert found["mpc"] == HOLDS
    assert found["learning"] == HOLDS
    assert found["small"] == HOLDS
    assert found["safe"] == HOLDS
    assert found["plateau"] == FAILS
    assert found["eight"] == PARTLY
    assert found["knee"] == FAILS
    assert found["shortest"] == PARTLY  # the reference planner is shorter


def test_verdicts_turn_with_the_planners():
    slow = synthetic(lambda cell: 1.10 if cell.planner == "policy" else 1.03)
    found = verdicts(slow)
    assert found["mpc"] == FAILS
    assert found["learning"] == FAILS
    assert found["small"] == FAILS
    assert found["shortest"] == FAILS
    assert "the order's, not the learner's" in claims(slow)[2]["text"]
    best = synthetic(lambda cell: 1.001 if cell.planner == "policy" else 1.03)
    assert verdicts(best)["shortest"] == HOLDS


def test_no_verdict_where_scenes_disagree():
    def factor(cell):
        up = sum(map(ord, cell.scene)) % 2
        return {"policy": 1.02 + 0.1 * up, "guidance": 1.12 - 0.1 * up}.get(cell.planner, 1.03)

    assert verdicts(synthetic(factor))["learning"] == UNDECIDED


def test_the_order_s_gain_turns_with_the_times():
    def factor(cell):  # without LKH everything is as fast as with it, or faster
        return 0.5 if cell.planner == "policy" and cell.order[0] in (1, 2) else 1.02

    assert verdicts(synthetic(factor))["order"] == FAILS
    assert verdicts(synthetic(lambda cell: 1.02))["order"] in (HOLDS, PARTLY)


def test_contacts_and_knees_are_noticed():
    doc = synthetic(
        lambda cell: 1.4 if cell.planner == "mpc" and len(cell.order) >= 5 else 1.02,
        success=lambda cell: cell.planner != "policy" or cell.seed == 1,
    )
    found = verdicts(doc)
    assert found["knee"] == HOLDS
    assert found["safe"] == FAILS
    assert found["order"] in (HOLDS, PARTLY)  # by the other training seed
    assert found["learning"] == UNTESTED


def test_eight_and_plateau_turn_with_the_study(usual):
    orders = {**usual["orders"], "share_paper_saving": 0.3,
              "rise_6_to_8": {"least": 0.5, "mean": 2.0}}  # fmt: skip
    found = verdicts({**usual, "orders": orders})
    assert found["eight"] == HOLDS
    assert found["plateau"] == HOLDS


def test_an_aware_order_that_gains_is_named():
    def factor(cell):
        return 0.5 if cell.order == TIME_ORDERS.get(cell.scene) else 1.02

    found = verdicts(synthetic(factor))
    assert found["aware"] == FAILS


def test_a_few_scenes_decide_nothing(usual):
    """Four scenes, however clear; and any number in which the orders are the same."""
    few = {use["scene"] for use in usual["uses"] if use["part"] == "random"}
    few = sorted(few, reverse=True)[:4]
    uses = [use for use in usual["uses"] if use["part"] != "random" or use["scene"] in few]
    found = verdicts({**usual, "tables": tables(uses, usual["cells"])})
    assert found["learning"] == found["aware"] == UNDECIDED
    assert found["mpc"] == HOLDS  # by the scenarios
    same = [{**use, "method": "lkh-time"} for use in uses if use["method"] == "lkh"]
    found = verdicts({**usual, "tables": tables([*uses, *same], usual["cells"])})
    assert found["aware"] == UNDECIDED


def test_nothing_flown_nothing_judged(usual):
    empty = {**usual, "cells": {}, "tables": tables(usual["uses"], {})}
    found = verdicts(empty)
    untested = {name for name, verdict in found.items() if verdict == UNTESTED}
    assert untested == {"order", "mpc", "small", "shortest", "knee", "safe", "learning", "aware"}


def complete(doc):
    found = {
        **doc,
        "command": "python -m train.reproduce --workers 3",
        "quick": True,
        "seed": 0,
        "training": [],
        "machines": [{"processor": "some", "cpus": 2, "system": "Linux"}],
        "versions": {},
        "cell_versions": [{}],
        "sizes": {"floating": 5, "city": 2, "items": 3, "first_scene": 7000},
        "scenes": {"scenario_1": {}},
        "not_flown": [],
        "errors": {"cell": "exit code 2: some words"},
        "figures": {"sweep": "sweep.png"},
        "claims": claims(doc),
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
    elif isinstance(value, (int, float)) and not isinstance(value, bool):
        yield float(value)


def test_every_number_of_the_page_is_in_its_json(usual):
    doc = complete(usual)
    text = page(doc)
    text = re.sub(r"`[^`]*`|```.*?```|!\[.*?\)", "", text, flags=re.S)
    known = list(numbers_in({key: value for key, value in doc.items() if key != "claims"}))
    known += [float(len(doc["cells"]))]
    known += numbers_in([claim["numbers"] for claim in doc["claims"]])
    known += [1.0, 2.0, 4.0, 5.0, 6.0, 8.0, 95.0]  # K, scenarios, percentiles in the wording
    for claim in doc["claims"]:  # what the paper says, quoted
        text = text.replace(f"*{claim['paper']}*", "")
    shown = {digits: {f"{abs(scale * number):.{digits}f}" for number in known for scale in (1, 100)}
             for digits in range(4)}  # fmt: skip
    words = re.findall(r"(?<![\w.])\d+(?:\.\d+)?", text)
    assert len(words) > 500
    for word in words:
        assert word in shown[len(word.partition(".")[2])], f"{word} is nowhere in the JSON"


def test_the_page_shows_verdicts_failures_and_the_quick_notice(usual):
    doc = complete(usual)
    text = page(doc)
    for claim in doc["claims"]:
        assert claim["text"] in text
        assert f"**{claim['verdict'].capitalize()}.**" in text
    assert "quick run" in text
    assert "exit code 2: some words" in text
    assert "look-alikes" in text
    name = next(iter(doc["cells"]))
    doc["cells"][name] |= {"success": False, "violations": ["contact"]}
    doc["quick"] = False
    assert f"- `{name}`: contact" in page(doc)
    assert "quick run" not in page(doc)


def test_the_committed_page_follows_from_the_committed_flights():
    """Its tables and verdicts too, whatever was edited since."""
    folder = Path(__file__).parents[2] / "docs" / "results"
    doc = json.loads((folder / "results.json").read_text())
    assert page(doc) == (folder / "reproduction.md").read_text()
    assert json.loads(json.dumps(tables(doc["uses"], doc["cells"]))) == doc["tables"]
    assert json.loads(json.dumps(claims(doc))) == doc["claims"]
    assert (doc["quick"], doc["not_flown"], doc["errors"]) == (False, [], {})
    planned = make_plan(Sizes(), 0, {})  # without the orders at obstacle-aware cost
    assert planned.cells.keys() <= doc["cells"].keys()
    assert all((folder / name).is_file() for name in doc["figures"].values())
