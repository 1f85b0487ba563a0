from __future__ import annotations

import math

import numpy as np
import pytest

from mjcollect.envs.course import Course
from mjcollect.envs.episode import Episodes, Rules
from mjcollect.envs.observation import NEAREST_BOXES, OBSERVATIONS, REACH, places
from mjcollect.flight.world import World
from mjcollect.scene.scene import Scene

LOW, HIGH = [0.0, -20.0, 5.0], [400.0, 40.0, 65.0]  # not a cube, not at the origin


def scene(boxes, items=1) -> Scene:
    """Boxes along one side, none in the way."""
    obstacles = [[[40.0 * k + 20, -20, 5], [40.0 * k + 45, 0, 30]] for k in range(boxes)]
    goals = [[380.0 - 40 * k, 20, 50] for k in range(items)]
    return Scene("t", 0, [LOW, HIGH], [10, 20, 50], goals, obstacles)


@pytest.fixture(scope="module")
def courses():
    return {
        (boxes, items): Course.mission(scene(boxes, items), tuple(range(items)))
        for boxes, items in [(0, 1), (1, 2), (7, 1)]
    }


def observed(course, name, q, v, collected=None):
    episodes = Episodes([course], len(q), Rules(name))
    episodes.reset(np.arange(len(q)), q, v)
    if collected is not None:
        episodes.collected[:] = collected
    return episodes.observe()


def states(count=50, seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform(LOW, HIGH, (count, 3)), rng.uniform(-28, 28, (count, 3))


def test_guided_has_one_width_for_any_number_of_boxes_and_items(courses):
    q, v = states()
    widths = []
    for course in courses.values():
        parts = observed(course, "guided", q, v)
        assert all(part.shape[0] == len(q) for part in parts.values())
        assert all(part.dtype == np.float64 for part in parts.values())
        widths.append({name: part.shape[1] for name, part in parts.items()})
    assert widths[0] == widths[1] == widths[2]
    known = {"velocity": 3, "guide_direction": 3, "guide_distance": 3, "goal_offset": 9}
    known |= {"braking": 8, "boxes": 3 * NEAREST_BOXES, "walls": 6}
    assert known.items() <= widths[0].items()


@pytest.mark.parametrize("key", [(0, 1), (1, 2), (7, 1)])
def test_paper_widths_and_order(courses, key):
    boxes, items = key
    parts = observed(courses[key], "paper", *states())
    assert list(parts) == ["q", "v", "l", "m", "p"]
    widths = [part.shape[1] for part in parts.values()]
    assert widths == [3, 3, 3 * max(boxes, 1), 3 * items, items]  # an empty scene has one padding


@pytest.mark.parametrize("name", OBSERVATIONS)
def test_observations_are_finite_and_of_the_order_of_one(courses, name):
    q, v = states(200)
    q[0], v[0] = courses[7, 1].scene.items[0], 0.0  # right at the goal, at rest
    q[1] = [30.0, 0.0, 30.0]  # on a box's edge
    q[2] = [30.0, -10.0, 10.0]  # inside
    q[3], q[4] = LOW, HIGH
    for course in courses.values():
        for part, values in observed(course, name, q, v).items():
            assert np.all(np.isfinite(values)), part
            assert np.all(np.abs(values) <= 3.0), part


def test_paper_parts_by_hand(courses):
    course = courses[1, 2]
    box, items = course.scene.obstacles[0], course.scene.items
    size = [high - low for low, high in zip(LOW, HIGH, strict=True)]
    q, v = states(40)
    flags = np.random.default_rng(2).random((40, 2)) < 0.5
    parts = observed(course, "paper", q, v, flags)
    for i in range(len(q)):
        for k in range(3):
            x = float(q[i, k])
            assert parts["q"][i, k] == pytest.approx((x - LOW[k]) / size[k], abs=1e-12)
            assert parts["v"][i, k] == pytest.approx(float(v[i, k]) / 50.0, abs=1e-12)
            nearest = min(max(x, float(box[0, k])), float(box[1, k]))
            assert parts["l"][i, k] == pytest.approx((nearest - x) / size[k], abs=1e-12)
            for item in range(2):
                way = (float(items[item, k]) - x) / size[k]
                assert parts["m"][i, 3 * item + k] == pytest.approx(way, abs=1e-12)
        assert parts["p"][i].tolist() == [float(flag) for flag in flags[i]]


def stretch(guide, q, unit):
    """Metres to where a ray enters and leaves the goal's ball, by the quadratic."""
    offset, radius = q - guide.goal, 0.98 * guide.tolerance
    roots = np.roots([1.0, 2 * unit @ offset, offset @ offset - radius**2])
    assert np.isreal(roots).all()
    return max(roots.real.min(), 0.0), roots.real.max()


def test_guided_parts_by_hand(courses):
    course = courses[7, 1]
    guide = course.guidance[0]
    aim = guide.aim  # the first target is the item, in free sight of all these
    q = np.array([[10.0, 20, 50], [200, 15, 45], [377, 21, 50]])
    to_aim = (aim - q) / np.linalg.norm(aim - q, axis=1, keepdims=True)
    v = to_aim * [[12.0], [0.0], [5.0]]  # along the path: seen along it
    parts = observed(course, "guided", q, v)
    for i in range(3):
        enter, leave = stretch(guide, q[i], to_aim[i])
        near = [enter / 312.5, math.tanh(enter / 62.5), math.tanh(enter / 12.5)]
        np.testing.assert_allclose(parts["guide_distance"][i], near, rtol=1e-6)
        np.testing.assert_allclose(parts["guide_direction"][i], to_aim[i], rtol=1e-9)
        np.testing.assert_allclose(parts["velocity"][i], v[i] / 50, rtol=1e-12)
        np.testing.assert_allclose(parts["slowness"][i], np.tanh(v[i] / 8), rtol=1e-12)
        rest = v[i] * np.linalg.norm(v[i]) / 40 - (guide.goal - q[i])
        np.testing.assert_allclose(parts["rest"][i], np.tanh([*rest / 20, *rest / 4]), rtol=1e-9)
        to_goal = guide.goal - q[i]
        scales = [*(to_goal / 312.5), *np.tanh(to_goal / 62.5), *np.tanh(to_goal / 12.5)]
        np.testing.assert_allclose(parts["goal_offset"][i], scales, rtol=1e-12)
        speed = float(np.linalg.norm(v[i]))
        stop, stride = speed**2 / 40, max(speed, 4.0) * course.scene.slot
        braking = [math.tanh((speed - min(math.sqrt(40 * enter), 50)) / 10)]
        braking += [min(stop / max(enter, 0.1), 2.0), min(stop / max(leave, 0.1), 2.0)]
        braking += [math.tanh((enter - stop) / slots / stride) for slots in (4, 1)]
        braking += [math.tanh((leave - stop) / stride)]
        turn = 2 * math.pi * speed / 4.0  # full braking takes 4 m/s a slot
        braking += [math.sin(turn), math.cos(turn)]
        np.testing.assert_allclose(parts["braking"][i], braking, rtol=0, atol=1e-6)
        walls = [math.tanh((q[i, k] - LOW[k]) / 30) for k in range(3)]
        walls += [math.tanh((HIGH[k] - q[i, k]) / 30) for k in range(3)]
        np.testing.assert_allclose(parts["walls"][i], walls, rtol=0, atol=1e-12)


def approached(course, q, v):
    episodes = Episodes([course], len(q), Rules())
    episodes.reset(np.arange(len(q)), q, v)
    return episodes.approach


def near_goal(course, count, seed=0):
    """Places within 40 m of the goal, most of them inside its free sight, and velocities."""
    rng = np.random.default_rng(seed)
    q = course.guidance[0].goal + rng.normal(0.0, 10.0, (count, 3))
    return np.clip(q, np.array(LOW) + 1, np.array(HIGH) - 1), rng.normal(0.0, 8.0, (count, 3))


def test_a_flight_is_seen_along_its_velocity_where_that_ends_in_the_goal(courses):
    """And along the path far away, where it still turns, and at rest, whatever its velocity was."""
    course = courses[0, 1]
    goal, towards = course.guidance[0].goal, np.array([-1.0, 0.0, 0.0])
    away = np.array([[10.0], [10.0], [300.0]])
    q = goal + away * towards
    aside = np.array([0.0, 0.3, 0.0])  # passes the goal's middle by 3 m
    v = np.array([[14.0], [0.0], [14.0]]) * (-towards + aside) / np.linalg.norm(-towards + aside)
    seen = approached(course, q, v)
    angle = np.arccos(np.clip(seen.heading @ (v[0] / 14.0), -1.0, 1.0))
    assert angle[0] < 0.1 + 1e-9
    assert seen.closing[0] > 13.9
    for i in (1, 2):
        off = np.linalg.norm(np.cross(seen.heading[i], (goal - q[i]) / away[i]))
        assert off < (0.02 if i == 2 else 1e-6)


def test_the_way_into_the_goal_leads_into_it_and_has_no_jumps(courses):
    course = courses[0, 1]
    guide, (q, v) = course.guidance[0], near_goal(course, 2000)
    seen = approached(course, q, v)
    np.testing.assert_allclose(np.linalg.norm(seen.heading, axis=1), 1.0, atol=1e-9)
    middle = q + seen.heading * ((seen.near + seen.far) / 2)[:, None]
    assert np.all(np.linalg.norm(middle - guide.goal, axis=1) <= guide.tolerance + 1e-9)
    hair, rng = 1e-7, np.random.default_rng(1)
    other = approached(
        course, q + hair * rng.normal(size=q.shape), v + hair * rng.normal(size=v.shape)
    )
    went = np.abs(
        other.time_to_go(World.stack([course.scene])) - seen.time_to_go(World.stack([course.scene]))
    )
    assert np.mean(went > 1e-3) < 0.002  # at the goal itself every direction leads there


@pytest.mark.parametrize("key", [(0, 1), (1, 2), (7, 1)])
def test_the_path_s_frame_turns_vectors_and_actions_alike(courses, key):
    """Against `guided` and the world's axes, turned here; the command flown is the same."""
    course, (q, v) = courses[key], states(80, seed=9)
    plain, turned = (Episodes([course], len(q), Rules(name)) for name in ("guided", "path"))
    for episodes in (plain, turned):
        episodes.reset(np.arange(len(q)), q, v)
    axes = turned.approach.frame
    np.testing.assert_allclose(
        axes @ axes.transpose(0, 2, 1), np.tile(np.eye(3), (80, 1, 1)), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(axes), 1.0)
    np.testing.assert_allclose(axes[:, 1, 2], 0.0, atol=0.06)  # level, where the path is not steep
    ours, theirs = turned.observe(), plain.observe()
    for part, size in (("velocity", 3), ("next_direction", 3), ("guide_ahead", 6), ("boxes", 12)):
        vectors = theirs[part].reshape(80, size // 3, 3)
        seen = np.einsum("nij,nvj->nvi", axes, vectors).reshape(80, size)
        np.testing.assert_allclose(ours[part], seen, rtol=0, atol=1e-12)
    for part in ("guide_direction", "guide_distance", "braking", "walls"):
        np.testing.assert_array_equal(ours[part], theirs[part])
    law, action = plain.guidance_action(), turned.guidance_action()
    np.testing.assert_allclose(np.einsum("nji,nj->ni", axes, action), law, rtol=0, atol=1e-12)
    flown = plain.begin_slot(law)
    np.testing.assert_allclose(turned.begin_slot(action), flown, rtol=0, atol=1e-9)


def test_braking_tells_what_share_of_full_braking_a_stop_takes(courses):
    """At 1 the stop is just at the near (far) end of what will do; beyond it is too late."""
    course = courses[0, 1]
    guide, share = course.guidance[0], np.array([0.25, 0.5, 0.8, 1.0, 1.1])
    q = guide.goal - 40.0 * np.tile([0.8, 0.36, 0.48], (5, 1))
    along = (guide.aim - q[0]) / np.linalg.norm(guide.aim - q[0])
    for part, stop in zip((1, 2), stretch(guide, q[0], along), strict=True):
        v = np.sqrt(2 * 20.0 * stop * share)[:, None] * along
        seen = observed(course, "guided", q, v)["braking"]
        np.testing.assert_allclose(seen[:, part], share, rtol=1e-6)
        if part == 1:
            spare = (1 - share) * stop / np.linalg.norm(v, axis=1) / 0.2  # slots of that speed
            np.testing.assert_allclose(np.arctanh(seen[:, 4]), spare, atol=1e-6)
            np.testing.assert_allclose(np.arctanh(seen[:, 3]) * 4, spare, atol=1e-6)
    resting = observed(course, "guided", q, 0 * v)["braking"]
    assert np.all(resting[:, 1:3] == 0.0)


def test_nearest_boxes_come_first_and_fade_with_distance(courses):
    course = courses[7, 1]
    q, v = states(60, seed=5)
    boxes = observed(course, "guided", q, v)["boxes"].reshape(-1, NEAREST_BOXES, 3)
    for i, point in enumerate(q):
        ways = [np.clip(point, *box) - point for box in course.scene.obstacles]
        ways = sorted(ways, key=lambda way: float(np.linalg.norm(way)))[:NEAREST_BOXES]
        for found, way in zip(boxes[i], ways, strict=True):
            gap = float(np.linalg.norm(way))
            expected = way / max(gap, 1e-9) / (1 + gap / 30)
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)
    fewer = observed(courses[1, 2], "guided", q, v)["boxes"].reshape(-1, NEAREST_BOXES, 3)
    low, high = courses[1, 2].scene.obstacles[0]
    within = np.all((q >= low) & (q <= high), axis=1)
    np.testing.assert_array_equal(fewer[:, 0].any(axis=1), ~within)
    np.testing.assert_array_equal(fewer[:, 1:], 0.0)


@pytest.mark.parametrize("name", OBSERVATIONS)
def test_neighbours_with_more_boxes_and_items_do_not_show(courses, name):
    """What a simulation sees of its own scene is the same, alone or beside larger ones."""
    mixed = [courses[0, 1], courses[1, 2], courses[7, 1]]
    q, v = states(3)
    episodes = Episodes(mixed, 3, Rules(name))
    episodes.reset(np.arange(3), q, v)
    together = episodes.observe()
    for i, course in enumerate(mixed):
        alone = observed(course, name, q[i : i + 1], v[i : i + 1])
        for part, values in alone.items():
            width = values.shape[1]
            np.testing.assert_array_equal(together[part][i, :width], values[0])
            # Padded boxes and items look as far as can be, flags stay down.
            assert np.all(np.isin(together[part][i, width:], [0.0, 1.0]))


def test_p_tells_what_is_collected(courses):
    course = courses[1, 2]
    episodes = Episodes([course], 1, Rules("paper"))
    seen = []
    for node in course.nodes[1:]:
        q = course.scene.point(node)[None]
        episodes.truth, episodes.v = q.copy(), np.zeros((1, 3))
        episodes.begin_slot(np.zeros((1, 3)))
        episodes.end_slot(
            np.repeat(q[:, None], 10, axis=1), np.zeros((1, 3)), np.zeros((1, 10), bool)
        )
        seen.append(episodes.observe()["p"][0].tolist())
    assert seen == [[1.0, 0.0], [1.0, 1.0], [1.0, 1.0]]


def test_p_of_a_segment_knows_the_items_before_it(courses):
    """In the mission its policy sees what it saw in training."""
    course = Course.segment(courses[1, 2].scene, (1, 0), 1)
    assert observed(course, "paper", *states(3))["p"].tolist() == [[0.0, 1.0]] * 3


def test_the_two_nearest_bounds_are_shown_in_the_path_s_frame(courses):
    course, (q, v) = courses[0, 1], states(40, seed=3)
    episodes = Episodes([course], len(q), Rules("robust"))
    episodes.reset(np.arange(len(q)), q, v)
    seen = episodes.observe()["bounds"].reshape(len(q), 2, 3)
    for k in range(len(q)):
        walls = [(q[k, a] - LOW[a], -np.eye(3)[a]) for a in range(3)]
        walls += [(HIGH[a] - q[k, a], np.eye(3)[a]) for a in range(3)]
        for shown, (gap, out) in zip(
            seen[k], sorted(walls, key=lambda wall: wall[0]), strict=False
        ):
            back = episodes.approach.frame[k].T @ shown
            np.testing.assert_allclose(back, out / (1 + gap / REACH), rtol=0, atol=1e-12)


def test_a_body_is_foretold_along_its_path_at_full_speed_and_along_its_velocity():
    goal, times = np.array([390.0, 10.0, 35.0]), np.array([0.0, 1.0, 2.5, 4.0, 60.0])
    course = Course.segment(Scene("room", 0, [LOW, HIGH], [10, 10, 35], [goal], []), (0,), 0)
    q, v = np.array([[20.0, 10, 35]]), np.array([[0.0, 3, 0]])
    episodes = Episodes([course], 1, Rules("guided"))
    episodes.reset(np.array([0]), q, v)
    along, straight = places(episodes.world, q, v, episodes.approach, times)[0]
    # From rest at 20 m/s² to 50 m/s, after 62.5 m, and no farther than the goal 370 m ahead.
    np.testing.assert_allclose(along[:, 0] - 20, [0, 10, 62.5, 137.5, 370], atol=1e-3)
    np.testing.assert_allclose(straight, q + times[:, None] * v, atol=1e-12)
