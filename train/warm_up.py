"""Compiles everything that numba compiles, so that neither flight nor learning has to wait for it.

    python -m train.warm_up

Otherwise that happens at the first use, once for each version of the code. `scripts/setup` runs it.
"""

from __future__ import annotations

import numpy as np
import torch

from mjcollect.envs.batch import Simulations
from mjcollect.envs.course import Course
from mjcollect.envs.episode import Rules
from mjcollect.flight.disturbance import Disturbance, Disturbances
from mjcollect.geometry.boxes import segment_box_distance
from mjcollect.learning.norm_relu import norm_relu_backward
from mjcollect.scene.scene import Scene


def main() -> None:
    """Computes one backward pass and flies one slot of a small scene."""
    d, h, z = (torch.ones(2, 4) for _ in range(3))
    mean, rstd, scale = torch.zeros(2, 1), torch.ones(2, 1), torch.ones(4)
    out = torch.empty(4), torch.empty(4), torch.empty(4)
    norm_relu_backward(d, h, z, mean, rstd, scale, 2, out)
    scene = Scene(
        name="warm-up",
        seed=0,
        bounds=np.array([[0.0, 0.0, 0.0], [120.0, 40.0, 40.0]]),
        depot=np.array([10.0, 20.0, 20.0]),
        items=np.array([[110.0, 20.0, 20.0]]),
        obstacles=np.array([[[50.0, 0.0, 0.0], [60.0, 30.0, 40.0]]]),
    )
    course = Course.mission(scene, (0,))
    air = Disturbances(Disturbance(mover=1.0), 2, np.random.default_rng(0))
    for observation, disturbances in (("path", None), ("robust", air)):
        simulations = Simulations(
            [course], 2, rules=Rules(observation), start="spread", threads=1,
            disturbances=disturbances,
        )  # fmt: skip
        simulations.reset()
        simulations.step(simulations.episodes.guidance_action())
        simulations.observe()
        simulations.close()
    course.guidance[0].query(scene.items)
    segment_box_distance(scene.depot, scene.items[0], scene.obstacles)


if __name__ == "__main__":
    main()
