"""Writes a random scene file: `python -m mjcollect.generate --seed 0 --items 4 --out FILE`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from mjcollect.generate.layouts import LAYOUTS, GenerateError, generate
from mjcollect.scene.file_format import SceneError


def main(argv: list[str] | None = None) -> int:
    """Runs the command line and returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m mjcollect.generate",
        description="Writes a random scene file.",
        usage=argparse.SUPPRESS,  # errors in one line
    )
    parser.add_argument("--seed", type=int, required=True, help="number that decides the scene")
    parser.add_argument("--items", type=int, required=True, help="number of items K")
    parser.add_argument("--obstacles", type=int, default=20, help="number of boxes (20)")
    parser.add_argument(
        "--layout", choices=LAYOUTS, default="floating", help="where the boxes stand (floating)"
    )
    parser.add_argument("--out", type=Path, required=True, help="scene file to write")
    parser.add_argument("--overwrite", action="store_true", help="replace an existing file")
    args = parser.parse_args(argv)
    try:
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
