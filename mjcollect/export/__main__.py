"""Writes a flown mission in a format: `python -m mjcollect.export --run DIR --format plan`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from mjcollect.export.formats import FORMATS
from mjcollect.export.mission import ExportError, FlownMission
from mjcollect.export.plan import CROSS_TRACK, HOVER, plan_text
from mjcollect.scene.file_format import SceneError


def main(argv: list[str] | None = None) -> int:
    """Runs the command line and returns the exit code: 2 if the run cannot be exported."""
    parser = argparse.ArgumentParser(
        prog="python -m mjcollect.export",
        description="Writes a flown mission of a real place for ground stations and maps.",
        usage=argparse.SUPPRESS,  # errors in one line
    )
    parser.add_argument("--run", type=Path, required=True, help="Folder of a finished mission.")
    parser.add_argument(
        "--format", choices=list(FORMATS), required=True,
        help="plan for QGroundControl; kml, geojson for maps; csv for tables.",
    )  # fmt: skip
    parser.add_argument("--out", type=Path, help="File to write; RUN/mission.FORMAT by default.")
    parser.add_argument(
        "--cross-track", type=float, default=CROSS_TRACK,
        help=f"Metres that the flown path may be off the plan's legs ({CROSS_TRACK}).",
    )  # fmt: skip
    parser.add_argument(
        "--hover",
        type=float,
        default=HOVER,
        help=f"Seconds that the plan stops at items ({HOVER}).",
    )
    parser.add_argument("--overwrite", action="store_true", help="Replaces an existing file.")
    args = parser.parse_args(argv)
    out = args.out or args.run / f"mission.{args.format}"
    try:
        if not 0.0 < args.cross_track <= 1e3:
            raise ExportError(f"--cross-track: {args.cross_track}: must be positive, up to 1000 m")
        if not 0.0 <= args.hover <= 3600.0:
            raise ExportError(f"--hover: {args.hover}: must lie between 0 and 3600 s")
        if out.exists() and not args.overwrite:
            raise ExportError(f"--out: {out}: exists; add --overwrite or name another file")
        mission = FlownMission.load(args.run)
        if args.format == "plan":
            text = plan_text(mission, args.cross_track, args.hover)
        else:
            text = FORMATS[args.format](mission)
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(text, encoding="utf-8")
    except (ExportError, SceneError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except ValueError as error:
        print(f"error: --run: {args.run}: cannot be read ({error})", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"error: --out: {out}: cannot be written: {error.strerror}", file=sys.stderr)
        return 2
    print(out)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
