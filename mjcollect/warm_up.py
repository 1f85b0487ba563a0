"""Compiles everything that numba compiles, so that no flight has to wait for it.

    python -m mjcollect.warm_up

Else it happens at the first use, once for each version of the code. `train.warm_up` does the same
for what learning needs as well; `scripts/setup` runs that.
"""

from __future__ import annotations

import numpy as np

from mjcollect.batch import Simulations
from mjcollect.course import Course
from mjcollect.geometry import segment_box_distance
from mjcollect.scene import Scene


def main() -> None:
    """Fly a small scene."""
    scene = Scene(
        name="warm-up",
        seed=0,
        bounds=np.array([[0.0, 0.0, 0.0], [120.0, 40.0, 40.0]]),
        depot=np.array([10.0, 20.0, 20.0]),
        items=np.array([[110.0, 20.0, 20.0]]),
        obstacles=np.array([[[50.0, 0.0, 0.0], [60.0, 30.0, 40.0]]]),
    )
    course = Course.mission(scene, (0,))
    simulations = Simulations([course], 2, start="spread", threads=1)
    simulations.reset()
    simulations.step(simulations.episodes.guidance_action())
    simulations.observe()
    simulations.close()
    course.guidance[0].query(scene.items)
    segment_box_distance(scene.depot, scene.items[0], scene.obstacles)


if __name__ == "__main__":
    main()
