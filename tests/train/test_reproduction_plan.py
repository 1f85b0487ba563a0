"""What a reproduction flies, what it counts, and what it computes without flying."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from reproduction_cells import SIZES, TIME_ORDERS, plan_of_all

from mjcollect.generate import generate
from mjcollect.scene.bounds import mission_bound
from mjcollect.scene.order import plan_order, tour_length
from mjcollect.scene.scene import Scene
from train.reproduction import orders
from train.reproduction.plan import Cell, Plan, Sizes, first_items, make_plan
from train.reproduction.running import arguments_of
from train.reproduction.tables import paired, rate, scene_table, summary


def test_equal_orders_share_a_cell():
    plan = plan_of_all()
    uses = [use for use in plan.uses if use.scene == "sweep_2"]
    assert len({use.method for use in uses}) == 3
    assert {use.cell for use in uses if use.planner == "mpc"} == {"sweep_2-mpc-0.1"}
    for use in plan.uses:
        cell = plan.cells[use.cell]
        assert cell.name == use.cell
        assert use.scene != "sweep_2" or cell.order == (0, 1)
        assert cell.planner == use.planner
        assert cell.seed == use.seed


def test_the_sweep_at_four_flies_scenario_2():
    plan = plan_of_all()
    cells = [plan.cells[use.cell] for use in plan.uses if use.scene == "sweep_4"]
    assert {cell.scene for cell in cells} == {"scenario_2"}
    assert "sweep_4" not in plan.scenes
    used = {use.cell for use in plan.uses if use.scene == "scenario_2"}
    assert {cell.name for cell in cells} <= used


def test_scenes_that_differ_in_anything_do_not_share():
    scene, plan = Scene.find("scenario_1"), Plan()
    assert plan.add_scene("a", scene) == "a"
    assert plan.add_scene("b", replace(scene, name="other", seed=9)) == "a"
    assert plan.add_scene("c", replace(scene, epsilon=4.0)) == "c"
    assert plan.add_scene("d", first_items(scene, 3)) == "d"


def test_the_full_plan_has_what_the_paper_has():
    plan = make_plan(Sizes(), 5, {})
    random = {use.scene for use in plan.uses if use.part == "random"}
    assert len(random) >= 20
    assert {use.scene for use in plan.uses if use.part == "sweep"} == {
        f"sweep_{k}" for k in range(1, 9)
    }
    seeds = {use.seed for use in plan.uses if use.scene == "scenario_1"
             and use.planner == "policy"}  # fmt: skip
    assert seeds == {5, 6, 7}
    assert len(plan.cells) < len(plan.uses)


def test_lkh_orders_are_the_scene_s_and_time_orders_are_taken():
    plan = plan_of_all()
    for use in plan.uses:
        cell = plan.cells[use.cell]
        if use.method == "lkh":
            assert cell.order == plan_order(plan.scenes[cell.scene], "lkh")
    timed = [use for use in plan.uses if use.method == "lkh-time"]
    assert {use.scene for use in timed} == set(TIME_ORDERS)
    assert all(plan.cells[use.cell].order == TIME_ORDERS[use.scene] for use in timed)


def test_names_tell_cells_apart():
    cell = Cell("s", (1, 0), "policy", 3)
    others = [replace(cell, order=(0, 1)), replace(cell, seed=4), replace(cell, planner="mpc")]
    assert cell.name == "s-policy-1.0-seed3"
    assert len({cell.name, *(other.name for other in others)}) == 4


def test_arguments_fly_the_cell(tmp_path):
    updates = ["--updates", "9"]
    program, words = arguments_of(Cell("s", (1, 0), "policy", 3), tmp_path, updates, keep=False)
    assert program == "train.mission"
    assert words[words.index("--order") + 1] == "1,0"
    assert words[words.index("--seed") + 1] == "3"
    assert {"--resume", "--no-video", "--no-plots", "--updates"} <= set(words)
    assert words[words.index("--policy") + 1] == "none"
    program, words = arguments_of(Cell("s", (1, 0), "mpc", 0), tmp_path, updates, keep=True)
    assert program == "train.fly"
    assert words[words.index("--planner") + 1] == "mpc"
    assert not {"--updates", "--no-plots"} & set(words)


def test_bounds_of_all_orders_agree_with_one_by_one():
    scene = generate(3, 4)
    each = [orders.order_bound(scene, order) for order in itertools.permutations(range(4))]
    np.testing.assert_allclose(orders.all_bounds(scene), sorted(each))
    assert orders.all_bounds(scene)[0] == pytest.approx(mission_bound(scene)[0])
    order = (2, 0, 3, 1)
    spread = orders.spread(scene, order)
    assert spread["worst"] == pytest.approx(max(each))
    assert spread["mean"] == pytest.approx(np.mean(each))
    as_long = np.array(each) >= orders.order_bound(scene, order) - 1e-6
    assert spread["share_as_long"] == pytest.approx(np.mean(as_long))
    assert 0 < np.mean(as_long) < 1


def test_all_instances_at_once_agree_with_each_alone():
    scenes = [generate(seed, 5, obstacles=0) for seed in range(4)]
    points = np.array([np.concatenate([[s.depot], s.items]) for s in scenes])
    cost = orders.leg_costs(points)
    best, given = orders.nested_best(cost), orders.nested_given(cost)
    for number, scene in enumerate(scenes):
        for count in range(1, 6):
            part = first_items(scene, count)
            assert best[number, count - 1] == pytest.approx(mission_bound(part)[0])
            bound = orders.order_bound(part, tuple(range(count)))
            assert given[number, count - 1] == pytest.approx(bound)


def test_the_study_finds_what_is_known():
    """DESIGN, section 6: 1.08 to 1.39 at K = 3 to 8 with free stops, 27% on average at K = 8."""
    study = orders.study(2_000, 1, 0.457)
    assert study["items"][0]["saving"] == 0.0
    assert study["items"][1]["saving"] < 1e-4
    assert study["items"][7]["ratio"] == pytest.approx(1.39, abs=0.02)
    assert study["items"][7]["saving"] == pytest.approx(0.27, abs=0.01)
    assert study["share_paper_saving"] < 0.01
    assert study["rise_6_to_8"]["least"] > 2.0
    assert sum(study["histogram"]["counts"]) == study["instances"] <= 2_000


def test_intervals_by_hand():
    """t(0.975, 4) = 2.776; the exact interval of 0 of 10 ends at 1 - 0.025^(1/10)."""
    found = summary([1.0, 2.0, 3.0, 4.0, 5.0])
    assert found["mean"] == 3.0
    assert found["high"] - 3.0 == pytest.approx(2.776 * np.sqrt(2.5 / 5), abs=1e-3)
    assert summary([4.0]) == {"n": 1, "mean": 4.0, "low": None, "high": None}
    assert summary([])["mean"] is None
    assert rate(0, 10)["high"] == pytest.approx(1 - 0.025 ** (1 / 10))
    assert rate(10, 10)["low"] == pytest.approx(0.025 ** (1 / 10))


def use(part, scene, method, planner, cell):
    return {"part": part, "scene": scene, "method": method, "planner": planner, "cell": cell}


def cell_entry(time, order=(0,), **more):
    return {"order": list(order), "success": time is not None, "mission_time": time,
            "contacts": 0, "train_seconds": None, "order_bound": 9.0, **more}  # fmt: skip


def test_paired_savings_by_hand():
    """Scene c lacks one flight and d one success: both are left out."""
    times = {"a": (8.0, 10.0), "b": (9.0, 10.0), "c": (5.0, 0.0), "d": (5.0, None)}
    uses, cells = [], {}
    for scene, (first, second) in times.items():
        uses.append(use("random", scene, "lkh", "mpc", f"{scene}1"))
        uses.append(use("random", scene, "random", "mpc", f"{scene}2"))
        cells[f"{scene}1"] = cell_entry(first, (0, 1))
        if scene != "c":
            cells[f"{scene}2"] = cell_entry(second, (0, 1) if scene == "a" else (1, 0))
    found = paired(uses, cells, ("lkh", "mpc"), ("random", "mpc"))
    assert found["scenes"] == ["a", "b"]
    assert found["savings"] == pytest.approx([0.2, 0.1])
    assert found["saving"]["mean"] == pytest.approx(0.15)
    assert found["changed"] == 1
    assert paired(uses, {}, ("lkh", "mpc"), ("random", "mpc"))["saving"]["n"] == 0


def test_scenario_rows_by_hand():
    uses = [use("scenarios", "scenario_1", "lkh", "policy", name) for name in "abc"]
    uses.append(use("scenarios", "scenario_1", "lkh", "guidance", "missing"))
    cells = {"a": cell_entry(72.0, train_seconds=10.0), "b": cell_entry(74.0, train_seconds=30.0),
             "c": cell_entry(None, contacts=2)}  # fmt: skip
    (row,) = scene_table(uses, cells, "scenario_1")
    assert row["paper"] == [71.8, 71.8]
    assert row["time"]["mean"] == 73.0
    assert (row["shortest"], row["longest"]) == (72.0, 74.0)
    assert (row["success"]["successes"], row["success"]["n"]) == (2, 3)
    assert row["contacts"] == 2
    assert row["train_seconds"] == 20.0


def test_the_look_alike_orders_are_as_long_as_they_should_be():
    """DESIGN, section 6: about 85.7, 92.8 and 177.0 s."""
    plan = make_plan(SIZES, 0, {})
    for label, time in (("scenario_1", 85.7), ("scenario_2", 92.8), ("sweep_8", 177.0)):
        name = next(u.cell for u in plan.uses if u.scene == label and u.method == "random")
        cell = plan.cells[name]
        bound = orders.order_bound(plan.scenes[cell.scene], cell.order)
        assert bound == pytest.approx(time, abs=0.8)
        assert tour_length(plan.scenes[cell.scene], cell.order) > 0
