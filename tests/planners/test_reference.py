"""The reference: no fewer slots are possible where that can be told, never more than the MPC's."""

from __future__ import annotations

import itertools
import json
from collections import Counter

import numpy as np
import pytest
from crowds import FLAT, crowded, gaps
from scipy.optimize import linprog, minimize

from mjcollect.envs.course import Course
from mjcollect.envs.recording import record
from mjcollect.planners.mpc import Mpc
from mjcollect.planners.reference import reference
from mjcollect.planners.reference.reference import NoFlight, Reference, rehearse
from mjcollect.planners.reference.slot_allotment import Allotments, reach
from mjcollect.scene.scene import Scene
from mjcollect.verify import verify
from train.fly import main as fly


def flat(items, depot=(10, 30, 30), boxes=(), name="flat", bounds=FLAT):
    return Scene(name, 0, bounds, depot, items, list(boxes))


def farthest(scene, slots):
    """Metres on a line from rest to rest in whole slots: a linear program over accelerations."""
    n, dt = scene.substeps, scene.physics_step
    step = np.kron(np.eye(slots), np.ones((n, 1)))  # acceleration of each physics step
    speed = np.tril(np.ones((slots * n, slots * n))) @ step * dt
    inner = speed[n - 1 :: n]
    bound = np.full(slots, scene.v_max)
    best = linprog(
        -(speed.sum(axis=0) * dt),
        A_ub=np.concatenate([inner, -inner]),
        b_ub=np.concatenate([bound, bound]),
        A_eq=inner[-1:],
        b_eq=[0.0],
        bounds=(-scene.a_max, scene.a_max),
    )
    return -best.fun


def flown(scene, order, planner, course):
    """The planner's flight in MuJoCo, which must break no rule; its slots."""
    flight = record(course, lambda _, task: planner.action(task.episodes))
    assert flight.success
    assert verify(scene, flight.trajectory, order) == []
    return flight, round(flight.trajectory.duration / scene.slot)


@pytest.fixture(scope="module")
def planned(mission_course):
    reference = Reference(mission_course)
    return reference, reference.plan()


@pytest.mark.parametrize("slots", [1, 2, 3, 7, 24, 25, 26, 40])
def test_reach_is_the_best_of_all_accelerations(corridor, slots):
    assert reach(corridor, slots) == pytest.approx(farthest(corridor, slots), abs=1e-6)


@pytest.mark.parametrize("far", [5.7, 371.0])
def test_straight_legs_take_the_least_number_of_slots(far):
    scene = flat([[10 + far, 30, 30]])
    course = Course.mission(scene, (0,))
    # Out and back on a line: the stop nearest to the depot is best for both segments.
    least = 0
    for distance in (far - 5.0, far - 10.0):
        enough = (m for m in itertools.count(1) if farthest(scene, m) > distance + 2e-3)
        least += next(enough)
    assert flown(scene, (0,), Reference(course), course)[1] == least


def test_margins_and_fewer_slots_agree_with_a_search_over_everything():
    scene = flat([[60, 50, 30], [110, 10, 40]])
    balls = [(scene.items[0], 5.0), (scene.items[1], 5.0), (scene.depot, 5.0)]
    corner = np.array([80.0, 40.0, 50.0])
    nodes = [scene.depot, *scene.items, scene.depot]
    ways = [np.array(nodes[:2]), np.array([nodes[1], corner, nodes[2]]), np.array(nodes[2:])]
    flown = (17, 21, 23)
    allotments = Allotments(scene, balls, ways, flown, Counter())
    turning = reach(scene, 20) - np.linalg.norm(np.diff(ways[1], axis=0), axis=1).sum()
    assert turning > 1.0
    for way, slots in zip(ways[::2], flown[::2], strict=True):
        assert reach(scene, slots - 1) < np.linalg.norm(way[1] - way[0])

    def margin(slots):
        """The same by a general optimiser, over stops and the margin itself."""

        def spare(z):
            a, b, c = z[:9].reshape(3, 3)
            bent = np.linalg.norm(corner - a) + np.linalg.norm(b - corner) + turning
            lengths = [np.linalg.norm(a - scene.depot), bent, np.linalg.norm(c - b)]
            return np.array([reach(scene, m) for m in slots]) - lengths - z[9]

        def inside(z):
            centres = np.array([ball[0] for ball in balls])
            return 25.0 - np.sum((z[:9].reshape(3, 3) - centres) ** 2, axis=1)

        begin = np.append(np.concatenate([ball[0] + 0.1 for ball in balls]), -50.0)
        rules = [{"type": "ineq", "fun": spare}, {"type": "ineq", "fun": inside}]
        return -minimize(lambda z: -z[9], begin, method="SLSQP", constraints=rules).fun

    for slots in [(18, 19, 25), (20, 18, 22), (16, 16, 21)]:
        assert allotments.margin(slots) == pytest.approx(margin(slots), abs=1e-3)
    best = allotments.fewer((20, 20, 24))[0]
    everything = [s for s in itertools.product(range(12, 32), repeat=3) if sum(s) == 63]
    assert allotments.margin(best) == pytest.approx(max(map(allotments.margin, everything)))
    assert sum(best) == 63


def test_commands_keep_limits_boxes_and_bounds(planned, mission_course):
    _, commands = planned
    scene = mission_course.scene
    assert np.linalg.norm(commands, axis=1).max() <= scene.a_max
    dt, v, x = scene.physics_step, np.zeros(3), np.array(scene.depot)
    points = [x]
    for a in np.repeat(commands, scene.substeps, axis=0):
        v = v + a * dt
        x = x + v * dt
        assert np.linalg.norm(v) <= scene.v_max + 1e-9
        points.append(x)
    points = np.array(points)
    between = points[:-1, None] + np.linspace(0, 1, 5)[:, None] * np.diff(points, axis=0)[:, None]
    assert gaps(between.reshape(-1, 3), scene.obstacles).min() >= scene.uav_radius
    assert np.all((points >= scene.bounds[0] - 1e-6) & (points <= scene.bounds[1] + 1e-6))
    assert np.linalg.norm(v) <= 1e-9
    assert np.linalg.norm(x - scene.depot) <= scene.return_tolerance


def test_a_mission_among_boxes_is_flown_as_planned_and_again_the_same(planned, mission_course):
    reference, commands = planned
    scene = mission_course.scene
    flight, slots = flown(scene, (0, 1), reference, mission_course)
    assert slots == len(commands) <= reference.mpc_slots
    assert np.allclose(flight.trajectory.a[: -1 : scene.substeps], commands, rtol=0, atol=1e-9)
    assert np.array_equal(Reference(mission_course).plan(), commands)


@pytest.mark.parametrize("seed", [0, 1])
def test_never_slower_than_the_mpc_among_boxes(seed):
    scene = crowded(seed, 8)
    course = Course.mission(scene, (0,))
    mpc = flown(scene, (0,), Mpc(course), course)[1]
    reference = Reference(course)
    assert flown(scene, (0,), reference, course)[1] <= mpc
    assert reference.mpc_slots == mpc


def test_stops_anywhere_in_their_balls_save_slots():
    scene = flat([[17, 30, 30], [26, 30, 30], [31, 31, 31], [300, 10, 10]])
    course = Course.mission(scene, (0, 1, 2, 3))
    reference = Reference(course)
    assert flown(scene, (0, 1, 2, 3), reference, course)[1] < reference.mpc_slots


def test_without_any_solution_the_mpc_is_flown(mission_course, monkeypatch):
    monkeypatch.setattr(
        "mjcollect.planners.reference.mission_program.Program._solve", lambda *_: None
    )
    mpc = rehearse(mission_course, Mpc(mission_course).action)
    assert mpc is not None  # by the guidance law, every slot of it
    reference = Reference(mission_course)
    assert np.array_equal(reference.plan(), mpc.commands)
    assert "whose flight this is" in reference.summary()


def test_it_needs_no_flight_of_the_mpc(mission_course, planned, monkeypatch):
    first = iter([None])
    monkeypatch.setattr(reference, "rehearse", lambda *args: next(first, False) or rehearse(*args))
    monkeypatch.setattr(reference, "Mpc", lambda course: Grounded())
    planner = Reference(mission_course)
    flown(mission_course.scene, (0, 1), planner, mission_course)
    assert planner.mpc_slots is None
    assert len(planner.plan()) <= 1.01 * len(planned[1])


class Grounded:
    """A planner that never leaves."""

    def action(self, episodes):
        return np.zeros(3)


def test_what_cannot_be_flown_is_refused_with_nothing_written(
    free_scene, free_mission, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(reference, "rehearse", lambda *_: None)
    monkeypatch.setattr(reference, "DETOUR_FACTORS", (2.0,))
    with pytest.raises(NoFlight, match="no flight through nodes"):
        Reference(free_mission).plan()
    scene, out = tmp_path / "scene.json", tmp_path / "out"
    free_scene.save(scene)
    line = ["--scene", str(scene), "--planner", "reference", "--order", "given"]
    assert fly([*line, "--out", str(out), "--no-video"]) == 2
    assert "no flight through nodes" in capsys.readouterr().err
    assert not out.exists()


def test_the_program_flies_it(corridor, tmp_path):
    scene, out = tmp_path / "scene.json", tmp_path / "out"
    corridor.save(scene)
    line = ["--scene", str(scene), "--planner", "reference", "--order", "given"]
    assert fly([*line, "--out", str(out), "--no-video"]) == 0
    result = json.loads((out / "mission.json").read_text())
    assert (result["success"], result["planner"]) == (True, "reference")
    assert result["mission_time"] < 1.06 * result["detour_time"]
