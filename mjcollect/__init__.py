"""mjcollect: a MuJoCo suite for UAV item collection among box obstacles.

Importing the package is light: names load on first use, and no GL is touched.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

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

if TYPE_CHECKING:  # what type checkers and editors see of the names above
    from mjcollect.envs.batch import (
        BatchedFlightEnv as BatchedFlightEnv,
    )
    from mjcollect.envs.batch import (
        Simulations as Simulations,
    )
    from mjcollect.envs.course import Course as Course
    from mjcollect.envs.disturbed import fly_disturbed as fly_disturbed
    from mjcollect.envs.dm_env import load as load
    from mjcollect.fleet.pettingzoo_env import FleetParallelEnv as FleetParallelEnv
    from mjcollect.fleet.torchrl_env import FleetEnv as FleetEnv
    from mjcollect.flight.disturbance import Disturbance as Disturbance
    from mjcollect.learning.config import LearnConfig as LearnConfig
    from mjcollect.learning.policy import TrainedPolicy as TrainedPolicy
    from mjcollect.learning.trainer import Trainer as Trainer
    from mjcollect.learning.trainer import segment_trainer as segment_trainer
    from mjcollect.planners.fleets import fleet_courses as fleet_courses
    from mjcollect.planners.mpc import Mpc as Mpc
    from mjcollect.planners.reference import Reference as Reference
    from mjcollect.scene import Scene as Scene
    from mjcollect.scene import SceneError as SceneError
    from mjcollect.scene import plan_order as plan_order
    from mjcollect.scene.assets import asset_path as asset_path
    from mjcollect.scene.trajectory import Trajectory as Trajectory


def __getattr__(name: str) -> Any:
    """Import a public name where it lives."""
    if name in _HOME:
        return getattr(importlib.import_module(_HOME[name]), name)
    raise AttributeError(f"module 'mjcollect' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOME})
