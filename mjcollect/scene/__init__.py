"""The collection problem: its file, its order, its lower bounds, and its MuJoCo model."""

from mjcollect.scene.bounds import detour_bound, mission_bound, segment_bound
from mjcollect.scene.file_format import SceneError
from mjcollect.scene.order import DEPOT, TourError, legs, node_name, plan_order
from mjcollect.scene.scene import Scene

__all__ = [
    "DEPOT", "Scene", "SceneError", "TourError", "detour_bound", "legs", "mission_bound",
    "node_name", "plan_order", "segment_bound",
]  # fmt: skip
