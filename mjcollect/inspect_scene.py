"""`python -m mjcollect.scene FILE`: validate a scene and say what its segments are like."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from typing import TypedDict

import numpy as np

from mjcollect.bounds import mission_bound
from mjcollect.geometry import segment_clear
from mjcollect.scene import Scene, SceneError
from mjcollect.tour import TourError, distances, legs, order_label, plan_order, tour_length

# `from` is a keyword, hence the functional form.
Segment = TypedDict(
    "Segment", {"index": int, "from": int, "to": int, "distance": float, "blocked": bool}
)


def segments_table(scene: Scene, order: Sequence[int]) -> list[Segment]:
    """The K+1 segments: nodes (depot -1), straight distance in metres, and whether it is blocked.

    Blocked: the body, flying straight from point to point, would touch a box.
    """
    pairs, between = legs(order), distances(scene)
    ends = np.array([[scene.point(frm), scene.point(to)] for frm, to in pairs])
    clear = segment_clear(ends[:, 0], ends[:, 1], scene.obstacles, scene.uav_radius)
    return [
        {
            "index": index,
            "from": frm,
            "to": to,
            "distance": float(between[frm + 1, to + 1]),
            "blocked": not bool(clear[index]),
        }
        for index, (frm, to) in enumerate(pairs)
    ]


def first_blocked(scene: Scene, order: Sequence[int]) -> int:
    """Number of the first blocked segment, 0 if none is."""
    return next((row["index"] for row in segments_table(scene, order) if row["blocked"]), 0)


def main(argv: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m mjcollect.scene",
        description="Validate a scene file; print the order and its segments.",
        usage=argparse.SUPPRESS,  # errors in one line
    )
    parser.add_argument("file", help="scene file, or the name of a bundled scene")
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    parser.add_argument(
        "--order", default="lkh", help="lkh (default), exact, random, given, or e.g. 2,0,1"
    )
    parser.add_argument("--seed", type=int, default=0, help="of the random order (0)")
    args = parser.parse_args(argv)
    try:
        scene = Scene.find(args.file)
        order = plan_order(scene, args.order, seed=args.seed)
    except (SceneError, TourError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    if args.json:
        document = {
            "scene": scene.name,
            "order": order,
            "order_method": order_label(args.order),
            "segments": segments_table(scene, order),
        }
        print(json.dumps(document, indent=1))
    else:
        print(_report(scene, order, order_label(args.order)))
    return 0


def _report(scene: Scene, order: Sequence[int], method: str) -> str:
    bound, bound_method = mission_bound(scene)
    lines = [
        f"{scene.name}: {len(scene.items)} items, {len(scene.obstacles)} obstacles",
        f"order ({method}): {' '.join(map(str, order))}",
        f"straight tour {tour_length(scene, order):.1f} m, "
        f"lower bound {bound:.2f} s ({bound_method})",
        "",
        f"{'segment':>7}  {'from':>5}  {'to':>5}  {'distance':>10}  straight line",
    ]
    for row in segments_table(scene, order):
        frm, to = (str(node) if node >= 0 else "depot" for node in (row["from"], row["to"]))
        state = "blocked" if row["blocked"] else "free"
        lines.append(f"{row['index']:>7}  {frm:>5}  {to:>5}  {row['distance']:>8.1f} m  {state}")
    return "\n".join(lines)
