"""Draws segments of generated scenes, for a policy that is to fly all of them.

Segment k of a pool depends on its number and the pool's seed alone. Building a segment's guidance
takes a second or so; processes of their own do it once, into files.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from mjcollect.envs.course import Course
from mjcollect.generate import LAYOUTS, generate
from mjcollect.guidance.guidance import GuidanceError
from mjcollect.learning.random_streams import stream
from mjcollect.scene.order import plan_order
from mjcollect.scene.scene import Scene
from train.jobs.processes import importing_pool

# The least and greatest number of items and boxes in a scene, and size as a share of 1000 m.
ITEMS = (2, 8)
OBSTACLES = (5, 60)
SCALE = (0.3, 1.0)


def draw_segment(
    seed: int, number: int, layout: str | None = None
) -> tuple[Scene, tuple[int, ...], int]:
    """Returns segment `number` of the pool of a seed: scene, visiting order, and number in it.

    The layout is one of `generate.LAYOUTS`; None draws it, as size and place are drawn.
    """
    rng = np.random.default_rng(stream(seed, f"segment {number}"))
    layout = layout or str(rng.choice(LAYOUTS))
    items, obstacles = (int(rng.integers(low, high + 1)) for low, high in (ITEMS, OBSTACLES))
    scene = generate(int(rng.integers(2**62)), items, obstacles, layout)
    factor, fields = float(rng.uniform(*SCALE)), ("bounds", "depot", "items", "obstacles")
    lengths = {field: np.round(getattr(scene, field) * factor, 3) for field in fields}  # whole mm
    scene = dataclasses.replace(scene, name=f"{scene.name}_x{factor:.2f}", **lengths)
    order = plan_order(scene, "exact")  # so few items need no LKH
    return scene, order, int(rng.integers(len(order) + 1))


def build(seed: int, folder: Path, number: int) -> bool:
    """Builds a segment's guidance into `folder`; returns False where it finds no way."""
    try:
        Course.segment(*draw_segment(seed, number), folder).save_guidance(folder)
    except GuidanceError:
        return False
    return True


def build_all(
    seed: int, numbers: Sequence[int], folder: Path, workers: int
) -> Iterator[tuple[int, bool]]:
    """Builds segments in `workers` processes; yields each number and whether it went well."""
    with importing_pool(workers) as pool:
        try:
            yield from zip(numbers, pool.map(partial(build, seed, folder), numbers), strict=True)
        finally:
            pool.shutdown(cancel_futures=True)  # after Ctrl-C only what has begun is waited for
