"""Procedural scenes from a seed: floating boxes, or a 'city' of boxes on the ground.

The cube and the depot are the paper's (section V): 1000 m, depot in its corner. Same seed, same
obstacles; the first K items of a seed are the same for every K.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

from mjcollect.geometry.boxes import point_box_distance
from mjcollect.geometry.compiled import Array
from mjcollect.scene.file_format import SceneError
from mjcollect.scene.scene import Scene

LAYOUTS = ("floating", "city")
EXTENT = 1000.0
SIDES = (50.0, 200.0)  # m, of floating boxes and of a city box's footprint
HEIGHTS = (100.0, 600.0)  # m, of city boxes
BOX_GAP, DEPOT_GAP, ITEM_BOX_GAP, ITEM_GAP = 5.0, 30.0, 10.0, 20.0  # m, at least
_REFUSALS = 300  # refused draws in a row before boxes get smaller
_SHRINK = 0.9
_LEAST_SCALE = 0.1
_ITEM_DRAWS = 20_000


class GenerateError(ValueError):
    """No such scene can be made. The message names the argument, its value and the fix."""


def generate(
    seed: int,
    items: int,
    obstacles: int = 20,
    layout: str = "floating",
    name: str | None = None,
) -> Scene:
    """Draw a scene.

    Sides are uniform in 50-200 m (heights in a city 100-600 m). Where 300 draws in a row find no
    room, all further boxes are drawn from ranges 0.9 times as large, and so on: 200 boxes fit.
    Boxes keep 5 m from each other and 30 m from the depot, items 10 m from boxes and 20 m from
    each other and the depot. Everything is rounded to millimetres.

    Args:
        seed: 0 <= seed < 2^63.
        items: K >= 1.
        obstacles: M >= 0.
        layout: 'floating' or 'city'.
        name: of the scene; '<layout>_<K>_seed<seed>' if None.

    Raises:
        GenerateError: an argument is out of range, or there is no room for so many.
    """
    if layout not in LAYOUTS:
        raise GenerateError(f"layout: {layout!r}: must be one of {', '.join(LAYOUTS)}")
    if not 0 <= seed < 2**63:
        raise GenerateError(f"seed: {seed}: must be at least 0 and below 2^63")
    if items < 1:
        raise GenerateError(f"items: {items}: must be at least 1")
    if obstacles < 0:
        raise GenerateError(f"obstacles: {obstacles}: must be at least 0")
    # Two streams, so that neither number changes what the other draws.
    boxes = _draw_boxes(np.random.default_rng([seed, 0]), obstacles, layout)
    points = _draw_items(np.random.default_rng([seed, 1]), items, boxes)
    # No item can be walled in: boxes 5 m apart leave the body room between any two, and one alone
    # is too small to cut the cube in two.
    return Scene(
        name=name or f"{layout}_{items}_seed{seed}",
        seed=seed,
        bounds=np.array([[0.0] * 3, [EXTENT] * 3]),
        depot=np.zeros(3),
        items=points,
        obstacles=boxes,
    )


def _draw_boxes(rng: np.random.Generator, count: int, layout: str) -> Array:
    boxes = np.empty((count, 2, 3))
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
        depot_gap = point_box_distance(np.zeros(3), box)
        if depot_gap >= DEPOT_GAP and np.all(_box_gaps(box, boxes[:placed]) >= BOX_GAP):
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


def _box_gaps(box: Array, others: Array) -> Array:
    """Euclidean distance (N,) between one box (2, 3) and others (N, 2, 3)."""
    gap = np.maximum(np.maximum(others[:, 0] - box[1], box[0] - others[:, 1]), 0.0)
    return np.asarray(np.linalg.norm(gap, axis=1))


def _draw_items(rng: np.random.Generator, count: int, boxes: Array) -> Array:
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


def main(argv: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m mjcollect.generate",
        description="Generate a scene.",
        usage=argparse.SUPPRESS,  # errors in one line
    )
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--items", type=int, required=True, help="number of items K")
    parser.add_argument("--obstacles", type=int, default=20, help="number of boxes (20)")
    parser.add_argument("--layout", choices=LAYOUTS, default="floating", help="(floating)")
    parser.add_argument("--out", type=Path, required=True, help="scene file to write")
    parser.add_argument("--overwrite", action="store_true", help="replace an existing file")
    args = parser.parse_args(argv)
    try:
        if args.out.is_dir():
            raise GenerateError(f"out: {args.out}: is a folder; name a file in it")
        if args.out.exists() and not args.overwrite:
            raise GenerateError(f"out: {args.out}: exists; add --overwrite or name another file")
        scene = generate(args.seed, args.items, args.obstacles, args.layout)
        args.out.parent.mkdir(parents=True, exist_ok=True)
        scene.save(args.out)
    except (GenerateError, SceneError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"error: out: {args.out}: cannot be written: {error.strerror}", file=sys.stderr)
        return 2
    print(f"{args.out}: {args.items} items, {args.obstacles} obstacles")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
