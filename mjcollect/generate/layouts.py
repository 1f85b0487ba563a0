"""Draws scenes from a seed: floating boxes, or a 'city' of boxes on the ground.

The cube and the depot are the paper's (section V): 1000 m, depot in its corner. Same seed, same
obstacles; the first K items of a seed are the same for every K.
"""

from __future__ import annotations

import numpy as np

from mjcollect.geometry.boxes import point_box_distance
from mjcollect.geometry.compiled import Array
from mjcollect.scene.scene import Scene

LAYOUTS = ("floating", "city")
EXTENT = 1000.0  # The cube has edges of this length (m).
SIDES = (50.0, 200.0)  # Floating boxes and a city box's footprint have sides in this range (m).
HEIGHTS = (100.0, 600.0)  # City boxes are as high as this (m).
# Boxes keep the first distance (m) from each other and the second from the depot; items keep the
# third from boxes and the fourth from each other and the depot.
BOX_GAP, DEPOT_GAP, ITEM_BOX_GAP, ITEM_GAP = 5.0, 30.0, 10.0, 20.0
_REFUSALS = 300  # After so many refused draws in a row, boxes get smaller,
_SHRINK = 0.9  # by this factor,
_LEAST_SCALE = 0.1  # down to this share of their ranges.
_ITEM_DRAWS = 20_000  # After so many refused draws, there is no room for an item.


class GenerateError(ValueError):
    """Says that no such scene can be made; the message names argument, value and fix."""


def generate(seed: int, items: int, obstacles: int = 20, layout: str = "floating") -> Scene:
    """Draws a scene, which is called '<layout>_<K>_seed<seed>'.

    Sides are uniform in 50-200 m (heights in a city 100-600 m). Where 300 draws in a row find no
    room, all further boxes are drawn from ranges 0.9 times as large, and so on: 200 boxes fit.
    Boxes keep 5 m from each other and 30 m from the depot, items 10 m from boxes and 20 m from
    each other and the depot. Everything is rounded to millimetres.

    Args:
        seed: 0 <= seed < 2^63.
        items: K >= 1.
        obstacles: M >= 0.
        layout: 'floating' or 'city'.

    Raises:
        GenerateError: an argument is out of range, or there is no room for so many.
    """
    if layout not in LAYOUTS:
        raise GenerateError(f"layout: {layout!r}: must be one of {', '.join(LAYOUTS)}")
    for name, value, least in (("seed", seed, 0), ("items", items, 1), ("obstacles", obstacles, 0)):
        if not least <= value < 2**63:
            raise GenerateError(f"{name}: {value}: must be at least {least} and below 2^63")
    # Two streams, so that neither number changes what the other draws.
    boxes = _draw_boxes(np.random.default_rng([seed, 0]), obstacles, layout)
    points = _draw_items(np.random.default_rng([seed, 1]), items, boxes)
    # No item can be walled in: boxes 5 m apart leave the body room between any two, and one alone
    # is too small to cut the cube in two.
    return Scene(
        name=f"{layout}_{items}_seed{seed}",
        seed=seed,
        bounds=np.array([[0.0] * 3, [EXTENT] * 3]),
        depot=np.zeros(3),
        items=points,
        obstacles=boxes,
    )


def _draw_boxes(rng: np.random.Generator, count: int, layout: str) -> Array:
    """Draws boxes (M, 2, 3)."""
    boxes, corner = np.empty((count, 2, 3)), np.zeros(3)
    least, most = np.array([SIDES] * 3).T
    if layout == "city":
        least[2], most[2] = HEIGHTS
    scale, placed, refused = 1.0, 0, 0
    while placed < count:
        size = np.round(scale * rng.uniform(least, most), 3)
        low = np.round(rng.uniform(0.0, EXTENT - size), 3)
        if layout == "city":
            low[2] = 0.0
        box = np.array([low, np.round(low + size, 3)])
        # Two boxes are as far apart as the origin is from the box of their points' differences.
        gaps = point_box_distance(corner, boxes[:placed] - box[::-1])
        if point_box_distance(corner, box) >= DEPOT_GAP and np.all(gaps >= BOX_GAP):
            boxes[placed] = box
            placed, refused = placed + 1, 0
            continue
        refused += 1
        if refused == _REFUSALS:
            scale, refused = scale * _SHRINK, 0
        if scale < _LEAST_SCALE:
            raise GenerateError(
                f"obstacles: {count}: only {placed} fit into the cube; ask for fewer"
            )
    return boxes


def _draw_items(rng: np.random.Generator, count: int, boxes: Array) -> Array:
    """Draws items (K, 3) that keep their distance from the boxes (M, 2, 3)."""
    points = np.zeros((count + 1, 3))  # the depot first
    for placed in range(1, count + 1):
        for _ in range(_ITEM_DRAWS):
            point = np.round(rng.uniform(0.0, EXTENT, 3), 3)
            spacing = np.linalg.norm(points[:placed] - point, axis=1)
            if np.all(spacing >= ITEM_GAP) and np.all(
                point_box_distance(point, boxes) >= ITEM_BOX_GAP
            ):
                points[placed] = point
                break
        else:
            raise GenerateError(
                f"items: {count}: only {placed - 1} fit among the obstacles; ask for fewer"
            )
    return points[1:]
