from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from mjcollect.envs.course import Course
from mjcollect.guidance import cache
from mjcollect.guidance.guidance import Guidance


@pytest.fixture
def built(blocked_course) -> Guidance:
    return blocked_course.guidance[0]


def leg(guide):
    return guide.scene, guide.node, guide.start, guide.next_goal


def test_a_loaded_guidance_is_the_built_one_bit_for_bit(built, tmp_path):
    path = cache.save(built, tmp_path / "new" / "folder")
    assert [file.name for file in path.parent.iterdir()] == [path.name]
    loaded = cache.load(path.parent, *leg(built))
    assert len(loaded.way.first) > 1  # blocked: several fields
    numbers = built.way._asdict()
    assert numbers.pop("tree") is built.scene.tree
    assert loaded.way.tree is built.scene.tree
    for name, values in numbers.items():
        other = getattr(loaded.way, name)
        np.testing.assert_array_equal(other, values)
        assert (other.dtype, other.flags.c_contiguous) == (values.dtype, True)
    q = np.random.default_rng(0).uniform(*built.scene.bounds, (500, 3))
    for ours, theirs in zip(loaded.query(q), built.query(q), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    for name in ("goal", "aim", "tolerance", "slack", "path", "length"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(built, name))


def test_another_scene_leg_or_code_does_not_find_it(built, tmp_path, monkeypatch):
    cache.save(built, tmp_path)
    scene, node, start, next_goal = leg(built)
    assert cache.load(tmp_path, scene, node, start, next_goal) is not None
    moved = dataclasses.replace(scene, obstacles=scene.obstacles + np.array([1.0, 0.0, 0.0]))
    for other in (
        (moved, node, start, next_goal),
        (dataclasses.replace(scene, uav_radius=0.4), node, start, next_goal),
        (scene, 1, start, next_goal),
        (scene, node, start + 1e-9, next_goal),
        (scene, node, start, None if next_goal is not None else start),
    ):
        assert cache.load(tmp_path, *other) is None
    monkeypatch.setattr(cache, "_code", lambda: "another version")
    assert cache.load(tmp_path, scene, node, start, next_goal) is None


@pytest.mark.parametrize("keep", [0, 100, 0.5, 0.999])
def test_what_is_left_of_a_file_is_not_loaded(built, tmp_path, keep):
    path = cache.save(built, tmp_path)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(keep if keep >= 1 else keep * len(whole))])
    assert cache.load(tmp_path, *leg(built)) is None


def test_a_course_loads_what_is_there_and_builds_the_rest(mission_course, tmp_path, monkeypatch):
    scene, order = mission_course.scene, mission_course.nodes[1:-1]
    first = mission_course.guidance[0]
    cache.save(first, tmp_path)
    builds = []
    build = Guidance._coarse_fields
    monkeypatch.setattr(
        Guidance,
        "_coarse_fields",
        lambda self, start: builds.append(self.node) or build(self, start),
    )
    again = Course.mission(scene, order, folder=tmp_path)
    assert builds == list(mission_course.nodes[2:])
    again.save_guidance(tmp_path)
    builds.clear()
    Course.mission(scene, order, folder=tmp_path)
    segments = [Course.segment(scene, order, index, folder=tmp_path) for index in range(3)]
    assert builds == []
    assert again.step_limit == mission_course.step_limit
    for segment, guide in zip(segments, mission_course.guidance, strict=True):
        np.testing.assert_array_equal(segment.guidance[0].path, guide.path)
        np.testing.assert_array_equal(segment.guidance[0].way.values, guide.way.values)
    for guide in again.guidance:
        # Writing again is no work: the files are there.
        path = cache.save(guide, tmp_path)
        before = path.stat().st_mtime_ns
        assert cache.save(guide, tmp_path).stat().st_mtime_ns == before
