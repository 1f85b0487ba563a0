"""The judge of fleets, on flights made by hand: how near UAVs came, and whose items are whose."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from straight_flights import STEP, cut, fly

from mjcollect.fleet.share import parts
from mjcollect.scene.scene import Scene
from mjcollect.scene.trajectory import Trajectory
from mjcollect.verify import Encounter, least_gaps, verify_fleet, verify_separation
from mjcollect.verify.__main__ import main

ITEMS = [[300.0, 20, 40], [300, 400, 40], [20, 400, 300]]
TOURS = ((2, 1), (0,))
WALL = [[[600.0, 100, 0], [650, 150, 50]]]
SPEED = 40.0  # m/s, of flights that cross: 0.8 m between two rows


def scene(**fields) -> Scene:
    return Scene("t", 0, [[0] * 3, [1000] * 3], [10.0] * 3, ITEMS, WALL, **fields)


def steady(start, velocity, rows=101) -> Trajectory:
    """A straight flight without a push, as the air would not let anyone fly."""
    t = np.arange(rows) * STEP
    v = np.tile(np.asarray(velocity, dtype=float), (rows, 1))
    return Trajectory(t, np.asarray(start, dtype=float) + t[:, None] * v, v, np.zeros((rows, 3)))


def crossing(aside: float, late: float) -> tuple[Trajectory, Trajectory]:
    """Two flights at right angles, one `aside` metres above the other, `late` rows behind it."""
    one = steady([500 - SPEED, 500, 500], [SPEED, 0, 0])
    other = steady([500, 500 - SPEED * (1 + late * STEP), 500 + aside], [0, SPEED, 0])
    return one, other


# Distances


@pytest.mark.parametrize("aside", [0.0, 1.5, 1.99])
@pytest.mark.parametrize("late", [0.0, 1.0, 0.37])
def test_the_least_distance_is_found_between_rows(aside, late):
    one, other = crossing(aside, late)
    # They are at (SPEED (t - 1), 0, 0) and (0, SPEED (t - 1) - late * 0.8 m, aside).
    least = np.hypot(late * SPEED * STEP / np.sqrt(2), aside)
    assert least_gaps(one, other).min() == pytest.approx(least, abs=1e-9)
    assert least_gaps(other, one).min() == pytest.approx(least, abs=1e-9)
    begin, end = (one.x - other.x)[:-1], (one.x - other.x)[1:]
    shares = np.linspace(0, 1, 2001)[:, None, None]
    sampled = np.linalg.norm(begin + shares * (end - begin), axis=2).min(axis=0)
    np.testing.assert_allclose(least_gaps(one, other)[:-1], sampled, rtol=0, atol=1e-3)
    assert least_gaps(one, other)[-1] == pytest.approx(np.linalg.norm(one.x[-1] - other.x[-1]))


def test_an_encounter_between_two_rows_is_found():
    """No row shows it: they are 1.6 m farther apart there."""
    one, other = steady([460.5, 500, 500], [50, 0, 0]), steady([540, 500, 500.3], [-50, 0, 0])
    at_rows = np.linalg.norm(one.x - other.x, axis=1).min()
    limit = 0.5 * (0.3 + at_rows)
    assert at_rows > limit + 0.05
    place = scene(separation=limit, uav_radius=0.1)
    (found,) = verify_separation(place, [one, other])
    assert found.value == pytest.approx(0.3)
    assert (found.uavs, found.limit) == ((0, 1), limit)
    assert found.t == pytest.approx(79.5 / 100, abs=STEP)
    assert verify_separation(scene(separation=0.29, uav_radius=0.1), [one, other]) == []


@pytest.mark.parametrize(("aside", "near"), [(1.9999, True), (2.0, False), (2.0001, False)])
def test_the_limit_is_what_they_keep_apart_with_a_hair(aside, near):
    found = verify_separation(scene(), list(crossing(aside, 0.0)))
    assert bool(found) == near
    just = verify_separation(scene(), list(crossing(2.0 - 5e-7, 0.0)))
    assert just == []


def test_who_is_home_is_flown_past_too():
    """Its flight is over long before."""
    home = fly([[500, 499, 500], [500, 500.5, 500]])
    past = steady([440, 500, 500], [SPEED, 0, 0])
    assert home.duration < 0.7 < 1.5 < past.duration
    gaps = least_gaps(home, past)
    assert len(gaps) == len(past)
    assert gaps.min() == pytest.approx(0.5)
    for flights, uavs in (([home, past], (0, 1)), ([past, home], (0, 1))):
        (found,) = verify_separation(scene(), flights)
        assert (found.uavs, found.value) == (uavs, pytest.approx(0.5))
        half = np.sqrt(2.0**2 - 0.5**2) / SPEED  # s during which it is nearer than 2 m
        assert found.t == pytest.approx(1.5 - half, abs=STEP)


def test_every_stretch_and_every_pair_counts_once():
    """Back and forth past one that hovers; the third stands by at the turn."""
    there = fly([[400.0, 500, 500], [500, 500, 500]])
    whole = fly([[400.0, 500, 500], [500, 500, 500], [400, 500, 500]])
    hovers = steady([450, 501, 500], [0, 0, 0], rows=3)
    third = steady([500, 500, 501.5], [0, 0, 0], rows=1)
    found = verify_separation(scene(), [hovers, whole, third])
    assert [each.uavs for each in found] == [(0, 1), (1, 2), (0, 1)]
    assert [each.value for each in found] == pytest.approx([1.0, 1.5, 1.0])
    assert found[0].t < there.duration < found[2].t
    assert [each.t for each in found] == sorted(each.t for each in found)
    assert found[0].to_dict() == {
        "kind": "separation", "t": found[0].t, "uavs": [0, 1], "value": found[0].value,
        "limit": 2.0,
    }  # fmt: skip
    json.dumps(found[0].to_dict())
    assert verify_separation(scene(), [whole]) == []


def test_rows_at_other_times_are_refused():
    one, other = crossing(5.0, 0.0)
    for t in (other.t + STEP, other.t * 1.01, np.where(other.t == other.t[7], 0.1401, other.t)):
        with pytest.raises(ValueError, match="same times"):
            least_gaps(one, replace(other, t=t))
        with pytest.raises(ValueError, match="same times"):
            verify_separation(scene(), [one, replace(other, t=t)])


# Folders


@pytest.fixture
def run(tmp_path):
    """The folder of a fleet's flight that breaks no rule."""
    return write(tmp_path / "run", parts(scene(), TOURS))


def write(folder, own):
    missions = []
    for uav, (part, tour) in enumerate(zip(own, TOURS, strict=True)):
        mine = folder / "uavs" / str(uav)
        mine.mkdir(parents=True)
        part.save(mine / "scene.json")
        fly([part.depot, *part.items, part.depot]).save(mine / "trajectory.csv")
        order = list(range(len(part.items)))
        (mine / "mission.json").write_text(json.dumps({"order": order}))
        missions.append({"uav": uav, "folder": f"uavs/{uav}", "items": list(tour)})
    scene().save(folder / "scene.json")
    (folder / "fleet.json").write_text(json.dumps({"uavs": 2, "missions": missions}))
    return folder


def edit(folder, change):
    document = json.loads((folder / "fleet.json").read_text())
    change(document["missions"])
    (folder / "fleet.json").write_text(json.dumps(document))


def judged(folder, capsys) -> tuple[int, str, str]:
    code = main([str(folder)])
    said = capsys.readouterr()
    return code, said.out, said.err


def test_an_unbroken_run_is_accepted(run, capsys):
    assert verify_fleet(run) == []
    assert judged(run, capsys) == (0, "no rule is broken\n", "")


def test_each_flight_is_judged_as_a_mission_of_its_part(run, capsys):
    path = run / "uavs" / "0" / "trajectory.csv"
    flown = Trajectory.load(path)
    cut(flown, 0, len(flown) - 20).save(path)
    kinds = {each.kind for each in verify_fleet(run)}
    assert "return" in kinds
    code, out, _ = judged(run, capsys)
    assert code == 1
    assert "return: " in out
    count = len(verify_fleet(run))
    assert f"{count} rule{'s' if count > 1 else ''} broken" in out


def test_who_comes_too_near_is_told(run, capsys):
    """The second UAV flies the first one's way home, 1 m beside it."""
    one = Trajectory.load(run / "uavs" / "0" / "trajectory.csv")
    two = Trajectory.load(run / "uavs" / "1" / "trajectory.csv")
    rows = len(two)
    above = one.x[:rows] + np.array([0, 0, 1.0])
    Trajectory(two.t, above, one.v[:rows], one.a[:rows]).save(run / "uavs" / "1" / "trajectory.csv")
    met = [each for each in verify_fleet(run) if isinstance(each, Encounter)]
    assert [each.uavs for each in met] == [(0, 1)]
    assert met[0].value == pytest.approx(1.0)
    code, out, _ = judged(run, capsys)
    assert code == 1
    assert "separation: 1 at 0.00 s of UAVs 0 and 1, limit 2" in out


def test_an_item_in_two_parts_is_refused(run, capsys):
    other = parts(scene(), ((2, 1), (1,)))[1]
    other.save(run / "uavs" / "1" / "scene.json")
    edit(run, lambda missions: missions[1].update(items=[1]))
    with pytest.raises(ValueError, match="each of 3 must be in one part"):
        verify_fleet(run)
    code, out, err = judged(run, capsys)
    assert (code, out) == (2, "")
    assert "cannot be judged" in err
    assert "items: [1, 1, 2]" in err


def test_an_item_in_no_part_is_refused(run):
    edit(run, lambda missions: missions.pop())
    with pytest.raises(ValueError, match="each of 3 must be in one part"):
        verify_fleet(run)


def test_items_that_are_others_than_the_part_s_are_refused(run):
    edit(run, lambda missions: missions[0].update(items=[1, 2]))
    with pytest.raises(ValueError, match=r"uavs/0/scene\.json: is no part of"):
        verify_fleet(run)


@pytest.mark.parametrize(
    "fields",
    [
        {"obstacles": [[[600.0, 100, 0], [650, 150, 49]]]},
        {"obstacles": []},
        {"v_max": 60.0},
        {"a_max": 30.0},
        {"epsilon": 6.0},
        {"uav_radius": 0.4},
        {"separation": 1.5},
        {"clearance": 0.1},
        {"bounds": np.array([[0.0] * 3, [1001.0, 1000, 1000]])},
    ],
)
def test_a_part_with_another_box_or_limit_is_refused(run, capsys, fields):
    path = run / "uavs" / "1" / "scene.json"
    replace(Scene.load(path), **fields).save(path)
    with pytest.raises(ValueError, match=r"uavs/1/scene\.json: is no part of"):
        verify_fleet(run)
    code, _, err = judged(run, capsys)
    assert code == 2
    assert "is no part of" in err


@pytest.mark.parametrize(("more", "accepted"), [(0.0, True), (1e-3, False)])
def test_a_place_out_of_the_depot_s_tolerance_is_refused(tmp_path, more, accepted):
    """The farthest place is such that 3 m + 2 m = the scene's 5 m."""
    own = list(parts(scene(), TOURS))
    for uav, height in enumerate((3.0 + more, -3.0)):
        place = scene().depot + np.array([0, 0, height])
        own[uav] = replace(own[uav], depot=place, return_tolerance=2.0)
    folder = write(tmp_path / "run", own)
    if accepted:
        assert verify_fleet(folder) == []
    else:
        with pytest.raises(ValueError, match=r"uavs/0/scene\.json: is no part of"):
            verify_fleet(folder)


def test_a_wider_tolerance_at_the_place_is_refused(run):
    path = run / "uavs" / "0" / "scene.json"
    part = Scene.load(path)
    replace(part, return_tolerance=part.return_tolerance + 0.5).save(path)
    with pytest.raises(ValueError, match="is no part of"):
        verify_fleet(run)


@pytest.mark.parametrize("name", ["scene.json", "uavs/0/scene.json", "uavs/1/trajectory.csv"])
def test_a_run_that_lacks_a_file_is_no_run(run, capsys, name):
    (run / name).unlink()
    code, out, err = judged(run, capsys)
    assert (code, out) == (2, "")
    assert err.startswith(f"error: {run}: cannot be judged")


def test_a_run_without_missions_is_no_run(run, capsys):
    (run / "fleet.json").write_text("{}")
    assert judged(run, capsys)[0] == 2
    (run / "fleet.json").write_text("{")
    assert judged(run, capsys)[0] == 2


def test_an_item_that_is_not_there_is_refused(run, capsys):
    edit(run, lambda missions: missions[0].update(items=[7, 1]))
    assert judged(run, capsys)[0] == 2
