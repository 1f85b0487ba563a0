"""mjcollect: a MuJoCo suite for UAV item collection among box obstacles.

Importing the package is light: names load on first use, and no GL is touched.
"""

from __future__ import annotations

import importlib
from typing import Any

__version__ = "0.3.0"

_HOME = {
    "BatchedFlightEnv": "mjcollect.envs.batch",
    "Course": "mjcollect.envs.course",
    "Disturbance": "mjcollect.flight.disturbance",
    "FleetEnv": "mjcollect.fleet.torchrl_env",
    "FleetParallelEnv": "mjcollect.fleet.pettingzoo_env",
    "LearnConfig": "mjcollect.learning.config",
    "Mpc": "mjcollect.planners.mpc",
    "Reference": "mjcollect.planners.reference",
    "Scene": "mjcollect.scene",
    "SceneError": "mjcollect.scene",
    "Simulations": "mjcollect.envs.batch",
    "TrainedPolicy": "mjcollect.learning.policy",
    "Trainer": "mjcollect.learning.trainer",
    "Trajectory": "mjcollect.scene.trajectory",
    "asset_path": "mjcollect.scene.assets",
    "fleet_courses": "mjcollect.planners.fleets",
    "fly_disturbed": "mjcollect.envs.disturbed",
    "load": "mjcollect.envs.dm_env",
    "plan_order": "mjcollect.scene",
    "segment_trainer": "mjcollect.learning.trainer",
}
__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    """Import a public name where it lives."""
    if name in _HOME:
        return getattr(importlib.import_module(_HOME[name]), name)
    raise AttributeError(f"module 'mjcollect' has no attribute {name!r}")
