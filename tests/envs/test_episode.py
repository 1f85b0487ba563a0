from __future__ import annotations

import pytest

from mjcollect.envs.episode import Episodes, Rules


@pytest.mark.parametrize(
    ("fields", "named"),
    [
        ({"observation": "guide"}, "observation: 'guide': must be one of guided, path, paper"),
        ({"reward": "fast"}, "reward: 'fast': must be one of time, lost, careful, paper"),
        ({"gamma": 1.0}, "gamma: 1.0"),
    ],
)
def test_unknown_rules_are_refused(fields, named):
    with pytest.raises(ValueError, match=named):
        Rules(**fields)


def test_courses_must_be_one_or_one_each(free_course):
    with pytest.raises(ValueError, match="courses: 2: must be 1 or the batch size 3"):
        Episodes([free_course] * 2, 3, Rules())
