"""Flights and slots come out as they did: what is quick of the fingerprint.

Figures are compared with those of `fingerprint.json`, digests are not: other machines round
otherwise. After a change that is meant to move them, `python -m tests.fingerprint --out
tests/fingerprint.json` writes them anew, with all the other parts, which are not read here.
"""

from __future__ import annotations

import json
from pathlib import Path

import fingerprint
import pytest

STORED = json.loads(Path(__file__).with_name("fingerprint.json").read_text(encoding="utf-8"))
FLIGHTS = ("scenario_1 law", "scenario_1 policy", "city_6 law", "city_6 policy")
PARTS = {
    name: make for name, make in fingerprint.parts() if name.startswith("slots ") or name in FLIGHTS
}


@pytest.fixture(scope="module", autouse=True)
def courses_are_built_once():
    """All parts are in the same two scenes, whose guidance takes nearly all of the time."""
    mission, built = fingerprint.Course.mission, {}

    def once(scene, order):
        if scene.name not in built:
            built[scene.name] = mission(scene, order)
        return built[scene.name]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fingerprint.Course, "mission", once)
        yield


@pytest.mark.parametrize("name", PARTS)
def test_it_comes_out_as_before(name):
    found, stored = PARTS[name](), STORED[name]
    assert set(found) == set(stored)
    for key in set(stored) - {"digest"}:
        assert found[key] == pytest.approx(stored[key], rel=1e-6), key
