"""A small scene for a fleet, two UAVs that meet in it, and how tests step many fleets."""

from __future__ import annotations

import numpy as np
import torch

from mjcollect.envs.episode import Rules
from mjcollect.scene.scene import Scene

UNSHIELDED = Rules(shield=False)
# Two UAVs 8 m apart that fly at each other, and one far away.
MEETING = np.array([[140.0, 40, 30], [148, 40, 30], [15, 15, 15]])
ASIDE = np.array([148.0, 70, 30])  # Here the second one would miss the first one.
SPEEDS = np.array([[10.0, 0, 0], [-10, 0, 0], [0, 0, 0]])
YARD = Scene(
    name="yard",
    seed=0,
    bounds=[[0, 0, 0], [200, 80, 60]],
    depot=[60, 40, 30],
    items=[[160, 60, 30], [120, 20, 40], [15, 40, 20], [60, 60, 30]],
    obstacles=[[[95, 40, 0], [110, 80, 50]]],
)


def stepped(env, action):
    """What FleetEnv returns for an action (N, M, 3)."""
    state = env.fake_tensordict().exclude("next")
    state["uavs", "action"] = torch.as_tensor(action).float().reshape(*env.batch_size, -1, 3)
    return env.step(state)["next"]


def place(env, q, v):
    """Puts the UAVs of a FleetEnv at positions and velocities (N M, 3)."""
    env.reset()
    env.simulations.place(np.arange(len(q)), q, v)


def rounded(action):
    """Actions as all environments take them exactly."""
    return np.asarray(action, dtype=np.float32)
