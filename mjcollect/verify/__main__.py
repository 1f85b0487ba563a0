"""Judges the flight in a run folder: python -m mjcollect.verify DIR."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from mjcollect.scene.file_format import SceneError
from mjcollect.verify.fleet import Encounter, verify_fleet
from mjcollect.verify.flight import verify_run


def main(argv: list[str] | None = None) -> int:
    """Runs the command line; returns 0, 1 if the flight breaks a rule, or 2 if there is none."""
    parser = argparse.ArgumentParser(
        prog="python -m mjcollect.verify",
        description="Judges the flight in a run folder: limits, bounds, contact, stops, order.",
        usage=argparse.SUPPRESS,  # errors in one line
    )
    parser.add_argument("run", type=Path, help="Folder of a finished segment, mission or fleet.")
    args = parser.parse_args(argv)
    try:
        fleet = (args.run / "fleet.json").is_file()
        found = verify_fleet(args.run) if fleet else verify_run(args.run)
    except (OSError, SceneError, ValueError, LookupError, TypeError, AttributeError) as error:
        print(f"error: {args.run}: cannot be judged: {error}", file=sys.stderr)
        return 2
    for each in found:
        if isinstance(each, Encounter):
            one, other = each.uavs
            print(
                f"separation: {each.value:.6g} at {each.t:.2f} s of UAVs {one} and {other}, "
                f"limit {each.limit:.6g}"
            )
            continue
        value = "no number" if each.value is None else f"{each.value:.6g}"
        where = f"at {each.t:.2f} s in segment {each.segment}"
        print(f"{each.kind}: {value} {where}, limit {each.limit:.6g}")
    broken = f"{len(found)} rule{'s' if len(found) > 1 else ''} broken"
    print(broken if found else "no rule is broken")
    return 1 if found else 0


if __name__ == "__main__":
    raise SystemExit(main())
