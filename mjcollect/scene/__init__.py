"""This room holds the collection problem: its file, order, lower bounds and MuJoCo model."""

from mjcollect.scene.bounds import detour_bound, mission_bound, segment_bound
from mjcollect.scene.file_format import SceneError
from mjcollect.scene.order import DEPOT, TourError, node_name, plan_order, tour_segments
from mjcollect.scene.scene import Scene

__all__ = [
    "DEPOT", "Scene", "SceneError", "TourError", "detour_bound", "mission_bound", "node_name",
    "plan_order", "segment_bound", "tour_segments",
]  # fmt: skip
