"""Many segments of many generated scenes, for a policy that is to fly all of them.

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

ITEMS = (2, 8)  # of a scene, both included
OBSTACLES = (5, 60)
SCALE = (0.3, 1.0)  # of the scene's size against the generator's 1000 m


@dataclasses.dataclass(frozen=True)
class DrawnSegment:
    """A segment: of which scene, tour and number."""

    scene: Scene
    order: tuple[int, ...]
    index: int

    def course(self, folder: Path) -> Course:
        """Its course, with guidance from the files in `folder` if it is there."""
        return Course.segment(self.scene, self.order, self.index, folder)


def draw_segment(seed: int, number: int, layout: str | None = None) -> DrawnSegment:
    """Segment `number` of the pool of a seed: layout, numbers, size and segment are drawn.

    Args:
        layout: one of `generate.LAYOUTS`; None draws it.
    """
    rng = np.random.default_rng(stream(seed, f"segment {number}"))
    layout = layout or str(rng.choice(LAYOUTS))
    items, obstacles = (int(rng.integers(low, high + 1)) for low, high in (ITEMS, OBSTACLES))
    scene = generate(int(rng.integers(2**62)), items, obstacles, layout)
    scene = scaled(scene, float(rng.uniform(*SCALE)))
    order = plan_order(scene, "lkh")
    return DrawnSegment(scene, order, int(rng.integers(len(order) + 1)))


def scaled(scene: Scene, factor: float) -> Scene:
    """The scene with all lengths of its layout times a factor, rounded to millimetres."""
    return dataclasses.replace(
        scene,
        name=f"{scene.name}_x{factor:.2f}",
        bounds=np.round(scene.bounds * factor, 3),
        depot=np.round(scene.depot * factor, 3),
        items=np.round(scene.items * factor, 3),
        obstacles=np.round(scene.obstacles * factor, 3),
    )


def build(seed: int, folder: Path, number: int) -> bool:
    """Build a segment's guidance into `folder`; False where no way was found."""
    leg = draw_segment(seed, number)
    try:
        leg.course(folder).save_guidance(folder)
    except GuidanceError:
        return False
    return True


def build_all(
    seed: int, numbers: Sequence[int], folder: Path, workers: int
) -> Iterator[tuple[int, bool]]:
    """`build` each of `numbers` in `workers` processes; yields number and success, in order."""
    with importing_pool(workers) as pool:
        try:
            yield from zip(numbers, pool.map(partial(build, seed, folder), numbers), strict=True)
        finally:
            pool.shutdown(cancel_futures=True)  # after Ctrl-C only what has begun is waited for
