"""A tree of boxes against the same questions asked of all boxes in turn."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mjcollect.envs.batch import Simulations
from mjcollect.envs.course import Course
from mjcollect.envs.episode import Rules
from mjcollect.geometry import tree as trees
from mjcollect.geometry.among_boxes import (
    free_way,
    gap_to_boxes,
    in_sight,
    nearest_box,
    segment_clear,
)
from mjcollect.geometry.boxes import point_box_distance, segment_box_distance
from mjcollect.geometry.tree import FEW, LEAF, Tree, first_member, in_one_leaf
from mjcollect.geometry.turns import around, turned
from mjcollect.scene.scene import Scene

COUNTS = (0, 1, FEW, FEW + 1, 3 * FEW, 777)


def strewn(seed, count, yawed):
    """Boxes of all sizes, many of them overlapping, some with the same corners."""
    rng = np.random.default_rng(seed)
    low = rng.uniform(-100, 100, (count, 3)).round(rng.integers(0, 3))
    boxes = np.stack([low, low + rng.uniform(0.1, 20, (count, 3)) ** rng.uniform(0.3, 1)], axis=1)
    return turned(boxes, rng.uniform(-90, 90, count) if yawed else np.zeros(count))


def without_tree(boxes) -> Tree:
    """A tree that leaves nothing out."""
    everywhere = np.array([[[-np.inf] * 3, [np.inf] * 3]])
    return Tree(boxes.copy(), everywhere, np.arange(len(boxes)))


@pytest.mark.parametrize("yawed", [False, True])
@pytest.mark.parametrize("count", COUNTS)
def test_every_box_is_in_one_leaf_and_in_all_hulls_above_it(count, yawed):
    boxes = strewn(count, count, yawed)
    tree = Tree.of(boxes)
    leaves = (len(tree.nodes) + 1) // 2
    assert sorted(tree.members) == list(range(count))
    if count <= FEW:
        assert leaves == 1
        assert tree.members.tolist() == list(range(count))
    seen = 0
    for leaf in range(leaves):
        node = leaves - 1 + leaf
        begin, end = first_member(tree, node), first_member(tree, node + 1)
        assert begin == seen
        assert end - begin <= LEAF or leaves == 1
        seen = end
        hulls = around(boxes)[tree.members[begin:end]]
        while True:
            assert np.all(tree.nodes[node, 0] <= hulls[:, 0])
            assert np.all(tree.nodes[node, 1] >= hulls[:, 1])
            if node == 0:
                break
            node = (node - 1) // 2
    assert seen == count


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from(COUNTS), st.booleans())
def test_what_is_asked_of_a_tree_is_what_all_boxes_say(seed, count, yawed):
    boxes, rng = strewn(seed, count, yawed), np.random.default_rng(seed + 1)
    tree, linear = Tree.of(boxes), without_tree(boxes)
    start = rng.uniform(-120, 120, (40, 3))
    end = start + rng.normal(0.0, 1.0, (40, 3)) * rng.choice([0.0, 1.0, 30.0, 300.0], (40, 1))
    end[:10, :2] = start[:10, :2]  # straight up
    gap = segment_box_distance(start[:, None], end[:, None], boxes).min(axis=1, initial=np.inf)
    radius = float(rng.choice([0.0, 0.5, 5.0]))
    np.testing.assert_array_equal(segment_clear(start, end, tree, radius), gap >= radius)
    point = point_box_distance(start[:, None], boxes).min(axis=1, initial=np.inf)
    np.testing.assert_allclose(gap_to_boxes(start, tree), point, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(gap_to_boxes(start, tree, 7.0), gap_to_boxes(start, linear, 7.0))
    grow = rng.uniform(0.0, 2.0, count)
    offset, one, two = end - start, np.zeros(3), np.zeros(3)
    for q, way in zip(start, offset, strict=True):
        assert in_sight(tree, grow, 2.0, q, way) == in_sight(linear, grow, 2.0, q, way)
        unit = way / max(np.linalg.norm(way), 1e-9)
        assert free_way(tree, 0.5, q, unit) == free_way(linear, 0.5, q, unit)
        assert nearest_box(tree, q, np.inf, one) == nearest_box(linear, q, np.inf, two)
        assert np.linalg.norm(one) == pytest.approx(np.linalg.norm(two), abs=1e-12)


def test_boxes_beyond_the_tree_count_where_decisions_are_made():
    boxes = strewn(0, 100, False)
    tree = Tree.of(boxes)
    q, direction = np.array([0.0, 0.0, 500.0]), np.array([0.0, 0.0, 1.0])
    moving = np.array([[[-1.0, -1.0, 510.0], [1.0, 1.0, 512.0]]])
    more = tree._replace(boxes=np.concatenate([boxes, moving]))
    to = np.zeros(3)
    assert free_way(tree, 0.5, q, direction) == 1e6
    assert free_way(more, 0.5, q, direction) == pytest.approx(9.5)
    assert nearest_box(more, q, 50.0, to) == pytest.approx(10.0)
    np.testing.assert_allclose(to, [0.0, 0.0, 10.0])
    assert nearest_box(tree, q, 50.0, to) == 50.0


def town(yawed) -> Scene:
    """Three hundred buildings on streets, and a flight between them."""
    rng = np.random.default_rng(4)
    at = np.stack(np.meshgrid(np.arange(18), np.arange(18), indexing="ij"), -1).reshape(-1, 2)
    at = at[rng.permutation(len(at))[:300]] * 20.0 + 10.0
    half, height = rng.uniform(2.5, 6.0, (300, 2)), rng.uniform(5.0, 40.0, (300, 1))
    floor = np.zeros((300, 1))
    boxes = np.stack([np.hstack([at - half, floor]), np.hstack([at + half, height])], axis=1)
    yaw = rng.uniform(-30, 30, 300) if yawed else np.zeros(300)
    bounds = np.array([[0.0, 0.0, 0.0], [360.0, 360.0, 60.0]])
    depot, items = np.array([20.0, 20.0, 15.0]), np.array([[300.0, 240.0, 12.0]])
    return Scene("town", 0, bounds, depot, items, boxes, v_max=20.0, a_max=10.0, yaw=yaw)


@pytest.mark.parametrize("yawed", [False, True])
@pytest.mark.parametrize("observation", ["path", "guided"])
def test_slots_in_a_town_are_the_same_to_the_bit_without_the_tree(yawed, observation, monkeypatch):
    """Shield, contact, observation, law, starts and guidance: all of them ask the tree."""

    def flown():
        course = Course.segment(town(yawed), (0,), 0)
        sims = Simulations(
            [course], 16, rules=Rules(observation), start="spread",
            rng=np.random.default_rng(1), threads=1,
        )  # fmt: skip
        sims.reset()
        rng, made = np.random.default_rng(2), []
        for slot in range(40):
            action = rng.uniform(-1, 1, (16, 3)) if slot % 2 else sims.law()
            outcome = sims.step(action)
            made += [sims.state.copy(), sims.observe(), outcome.reward, outcome.shielded]
            sims.reset(np.flatnonzero(outcome.terminated))
        sims.close()
        return len(course.scene.tree.nodes), np.concatenate([each.ravel() for each in made])

    nodes, with_tree = flown()
    monkeypatch.setattr(trees, "FEW", 10**6)
    one, without = flown()
    assert (nodes > 1, one) == (True, 1)
    np.testing.assert_array_equal(with_tree, without)


@pytest.mark.parametrize("count", [1, 3])
def test_trees_of_every_origin_are_of_the_type_that_kernels_are_compiled_for(count):
    """A read-only or strided array would have them compiled anew, in the middle of a flight."""
    one = in_one_leaf(np.repeat(strewn(0, 2, True)[None], count, axis=0))
    for tree in (one, Tree.of(strewn(1, 5, False)), Tree.of(strewn(2, 100, True))):
        for array in tree:
            assert array.flags.c_contiguous
            assert array.flags.writeable
