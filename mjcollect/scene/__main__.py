"""Validates a scene and prints its order and segments: `python -m mjcollect.scene FILE`."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Sequence

from mjcollect.scene.bounds import mission_bound
from mjcollect.scene.file_format import SceneError
from mjcollect.scene.order import (
    ORDER_METHODS,
    TourError,
    order_label,
    plan_order,
    segments_table,
    tour_length,
)
from mjcollect.scene.scene import Scene


def main(argv: list[str] | None = None) -> int:
    """Runs the command line and returns the exit code: 2 if the scene or the order is refused."""
    parser = argparse.ArgumentParser(
        prog="python -m mjcollect.scene",
        description="Validate a scene file; print the order and its segments.",
        usage=argparse.SUPPRESS,  # so that an error is one line
    )
    parser.add_argument("file", help="The scene file, or the name of a bundled scene.")
    parser.add_argument("--json", action="store_true", help="Print JSON instead of a table.")
    methods = ", ".join(ORDER_METHODS)
    order_help = f"The visiting order: {methods}, or indices as in 2,0,1 (lkh)."
    parser.add_argument("--order", default="lkh", help=order_help)
    parser.add_argument(
        "--seed", type=int, default=0, help="The seed of the orders search and random (0)."
    )
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
        text = json.dumps(document, indent=1)
    else:
        text = _report(scene, order, order_label(args.order))
    try:
        print(text, flush=True)
    except BrokenPipeError:  # `| head` has read enough; Python must not flush again at its end
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
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
        start, end = (str(node) if node >= 0 else "depot" for node in (row["from"], row["to"]))
        state = "blocked" if row["blocked"] else "free"
        lines.append(f"{row['index']:>7}  {start:>5}  {end:>5}  {row['distance']:>8.1f} m  {state}")
    return "\n".join(lines)


if __name__ == "__main__":
    raise SystemExit(main())
