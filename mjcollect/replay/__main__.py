"""Writes a page that replays runs in a browser: `python -m mjcollect.replay RUN [RUN ...]`."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from mjcollect.render.runs import UnreadableRun
from mjcollect.replay.page import FILE, write_replay
from mjcollect.replay.payload import ReplayError


def main(argv: list[str] | None = None) -> int:
    """Runs the command line and returns the exit code: 2 if the runs cannot be shown."""
    parser = argparse.ArgumentParser(
        prog="python -m mjcollect.replay",
        description="Writes a page that replays a run in a browser, or several of one scene.",
        usage=argparse.SUPPRESS,  # errors in one line
    )
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN", help="Folder of a run.")
    parser.add_argument(
        "--out", type=Path, help=f"File to write; RUN/{FILE} by default, if there is one run."
    )
    parser.add_argument("--overwrite", action="store_true", help="Replaces an existing file.")
    args = parser.parse_args(argv)
    try:
        if args.out is None and len(args.runs) > 1:
            raise ReplayError(f"--out: is missing: {len(args.runs)} runs need a file of their own")
        out = args.out or args.runs[0] / FILE
        if os.path.exists(out) and not args.overwrite:
            raise ReplayError(f"--out: {out}: exists; add --overwrite or name another file")
        if os.path.isdir(out):
            raise ReplayError(f"--out: {out}: is a folder; name a file")
        if args.out is not None:
            out.parent.mkdir(parents=True, exist_ok=True)
        write_replay(args.runs, out)
    except (ReplayError, UnreadableRun) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"error: --out: {out}: cannot be written: {error.strerror}", file=sys.stderr)
        return 2
    print(out)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
