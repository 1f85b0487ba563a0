"""Shows a scene, or plays a run's flight, in a window: `python -m mjcollect.view --run DIR`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from mjcollect.render.runs import FlownRun, load_run
from mjcollect.scene.file_format import SceneError
from mjcollect.scene.scene import Scene
from mjcollect.view.display import DisplayError, require_display
from mjcollect.view.playback import FASTEST, KEYS, SLOWEST


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command line; returns 0, 2 (bad scene or run, no display) or 130 (Ctrl-C)."""
    keys = "; ".join(f"{key}: {meaning}" for key, meaning in KEYS)
    parser = argparse.ArgumentParser(
        prog="python -m mjcollect.view",
        description="Shows a scene, or plays a run's flight, in MuJoCo's viewer.",
        epilog=f"Keys: {keys}.",
    )
    parser.add_argument("--scene", help="Scene file, or the name of a bundled scene.")
    parser.add_argument("--run", type=Path, help="Folder of a finished segment, mission or fleet.")
    parser.add_argument(
        "--speed", type=float, default=1.0, help="Seconds of flight per second (1)."
    )
    parser.add_argument(
        "--seconds", type=float, help="Closes the window after so many seconds; else you do."
    )
    args = parser.parse_args(argv)
    try:
        if args.scene is None and args.run is None:
            raise ValueError("--scene: is missing: name a scene, or a run with --run")
        if not SLOWEST <= args.speed <= FASTEST:
            raise ValueError(f"--speed: {args.speed}: must lie in {SLOWEST:g}..{FASTEST:g}")
        if args.seconds is not None and not args.seconds > 0:
            raise ValueError(f"--seconds: {args.seconds}: must be positive")
        scene = None if args.scene is None else Scene.find(args.scene)
        run = None if args.run is None else _read(args.run, scene)
        require_display()
    except (SceneError, DisplayError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    from mjcollect.view.viewer import show_flight, show_scene  # It needs a display.

    try:
        if run is not None:
            show_flight(run.fleet, run.air, args.speed, args.seconds)
        elif scene is not None:
            show_scene(scene, args.seconds)
    except KeyboardInterrupt:
        return 130
    return 0


def _read(folder: Path, scene: Scene | None) -> FlownRun:
    """Reads a run, which must be of that scene if there is one."""
    try:
        run = load_run(folder)
    except ValueError as error:
        raise ValueError(f"--run: {error}") from None
    if scene is not None and (difference := run.fleet.scene.difference(scene)):
        raise ValueError(
            f"--scene: {scene.name}: is not the scene of the run {folder}: {difference}; "
            "leave --scene out"
        )
    return run


if __name__ == "__main__":
    raise SystemExit(main())
