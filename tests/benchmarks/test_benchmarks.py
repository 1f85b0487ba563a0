"""What benchmarks make of flights, and which ones they take over from an earlier call."""

import dataclasses
import json

import numpy as np
import pytest

from benchmarks import missions, robustness, unseen
from mjcollect.flight.moving_boxes import MovingBoxes


def row(pilot, segment, home, level=1.0, time=1.1):
    times = [time] * home + [None] * (4 - home)
    ends = dict.fromkeys(robustness.ENDS, 0) | {"home": home, "too late": 4 - home}
    return {"pilot": pilot, "kind": "wind", "level": level, "segment": segment, "flights": 4,
            **ends, "times": times, "gave_way": 0.0, "unavoidable": 0}  # fmt: skip


def test_a_difference_is_that_of_the_rates_on_the_same_segments():
    rows = [row("policy", k, 4) for k in range(30)] + [row("adaptive law", k, 1) for k in range(30)]
    (found,) = robustness.differences(rows)
    assert (found["more"], found["low"], found["high"]) == (0.75, 0.75, 0.75)
    mixed = [row("policy", k, k % 2) for k in range(40)] + [
        row("adaptive law", k, 0) for k in range(40)
    ]
    (found,) = robustness.differences(mixed)
    # 20 of 40 at a quarter: a standard error of 0.125 / sqrt(40).
    assert found["more"] == 0.125
    assert found["high"] - found["low"] == pytest.approx(2 * 1.96 * 0.125 / 40**0.5, rel=0.15)


def test_times_are_compared_over_flights_that_both_finish():
    assert robustness.time_ratio([1.2, None, 2.0], [1.0, 1.0, None]) == pytest.approx(1.2)
    assert robustness.time_ratio([1.2, None, 2.0], [None, 1.0, None]) is None
    assert robustness.time_ratio([1.0, 1.2, None], [1.1]) == pytest.approx(1.0)  # other draws
    rows = [row("policy", 0, 3, time=1.2), row("adaptive law", 0, 2, time=1.0)]
    (found,) = robustness.differences(rows)
    assert found["slower"] == pytest.approx(1.2)


def test_each_segment_counts_once_in_the_time():
    rows = [row("law", 0, 4), row("law", 1, 1)]
    rows[0]["times"] = [1.2] * 4
    (found,) = robustness.summary(rows)
    assert found["home"] == 5 / 8
    assert found["too late"] == 3 / 8
    assert found["time"] == pytest.approx(1.15)


def test_flights_of_another_policy_are_not_taken_over(tmp_path):
    every = tmp_path / "found.flights.json"
    args = robustness.Args(segments=2)
    kept = [row(name, robustness.FIRST, 4) for name in ("law", "policy")]
    saved = robustness.settings(args) | {"policies": {"policy": "another"}, "flights": kept}
    every.write_text(json.dumps(saved))
    assert [r["pilot"] for r in robustness.flown_before(every, args)] == ["law"]
    every.write_text(json.dumps(saved | {"policies": robustness.policies(["policy"])}))
    assert robustness.flown_before(every, args) == kept
    assert robustness.flown_before(every, dataclasses.replace(args, pilots=("mpc",))) == []
    with pytest.raises(SystemExit, match="--draws: 3"):
        robustness.flown_before(every, dataclasses.replace(args, draws=3))


def test_missions_of_another_shipped_policy_are_flown_anew(monkeypatch):
    """One mission each; its program is replaced."""
    flown = []

    def run(scene, order, program, args):
        flown.append(program[0])
        return dict.fromkeys(missions.SHOWN, 1.0), {"updates": []}

    monkeypatch.setattr(missions, "run", run)
    args = missions.Args(floating=1, city=0, items=2, planners=("policy", "shipped"))
    rows = []
    missions.missions(args, rows)
    missions.missions(args, rows)
    assert flown == ["train.mission", "train.fly"]
    for other in ("another", None):  # rows of before the digest was kept have none
        rows[1]["shipped"] = other
        flown.clear()
        missions.missions(args, rows)
        assert flown == ["train.fly"]
    assert [r["planner"] for r in rows] == ["policy", "shipped"]


def test_where_nothing_arrives_there_is_no_time():
    lost = {"success": False, "contact": True, "time": None}
    won = {"success": True, "contact": False, "time": 3.0}
    policy, law = unseen.summary(
        [{"layout": "city", "detour_time": 2.0, "policy": lost, "law": won}]
    )
    assert (policy["arrived"], policy["median"], policy["contacts"]) == (0, None, 1)
    assert (law["median"], law["worst"]) == (1.5, 1.5)


def test_a_box_that_passes_the_start_is_found():
    """Against a fine clock; elsewhere a body that waits at its start is never touched."""
    rng, count = np.random.default_rng(0), 300
    movers = MovingBoxes(count, 2)
    start, goal = np.zeros((count, 3)), np.tile([260.0, 0.0, 0.0], (count, 1))
    movers.begin(np.arange(count), start, goal, rng.choice([0.0, 15.0], (count, 2)), rng, 0.7)
    point = np.array([105.0, 75.0, 18.0])
    found = robustness.reached_by_a_box(point, 0.5, movers)
    centres = movers.centres(np.linspace(0.0, 40.0, 4001))
    off = np.maximum(np.abs(point - centres) - movers.half[:, :, None], 0.0)
    touched = ((np.linalg.norm(off, axis=3) <= 0.5).any(axis=2) & (movers.speed > 0)).any(axis=1)
    assert 20 < found.sum() < 280
    assert (found >= touched).all()
    assert (found != touched).sum() <= 2, "grazes between two ticks"
    assert not robustness.reached_by_a_box(start[0], 0.5, movers).any()
