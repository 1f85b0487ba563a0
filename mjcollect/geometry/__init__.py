"""This room computes with points, segments, boxes, polylines and grids, all given as arrays."""
