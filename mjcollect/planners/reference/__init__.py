"""Holds the reference planner, which plans the whole mission ahead in the fewest slots."""

from mjcollect.planners.reference.reference import NoFlight, Reference

__all__ = ["NoFlight", "Reference"]
