"""Runs any program as `mjcollect PROGRAM ...`, the same as `python -m train.PROGRAM ...`."""

from __future__ import annotations

import importlib
import importlib.metadata
import sys

PROGRAMS = {
    "segment": "train.segment",
    "mission": "train.mission",
    "fly": "train.fly",
    "generalist": "train.generalist",
    "assign": "train.assign",
    "reproduce": "train.reproduce",
    "scene": "mjcollect.scene.__main__",
    "generate": "mjcollect.generate.__main__",
    "render": "mjcollect.render.__main__",
    "replay": "mjcollect.replay.__main__",
    "view": "mjcollect.view.__main__",
    "verify": "mjcollect.verify.__main__",
    "export": "mjcollect.export.__main__",
    "import": "mjcollect.generate.import_place",
}


def main(argv: list[str] | None = None) -> int:
    """Runs a program by its name; returns its exit code, or 2 if there is no such program."""
    given = sys.argv[1:] if argv is None else argv
    if not given or given[0] not in PROGRAMS:
        if given == ["--version"]:
            print(importlib.metadata.version("mjcollect"))
            return 0
        asked = bool(given) and given[0] in ("-h", "--help", "help")
        names = ", ".join(PROGRAMS)
        said = f"usage: mjcollect PROGRAM [...]; mjcollect PROGRAM --help\nprograms: {names}"
        wrong = f"error: program: {given[0]!r}: must be one of {names}" if given else said
        print(said if asked else wrong, file=sys.stdout if asked else sys.stderr)
        return 0 if asked else 2
    try:
        try:
            module = importlib.import_module(PROGRAMS[given[0]])
        except ImportError as error:  # an extra is not installed
            print(f"error: {given[0]}: {error}", file=sys.stderr)
            return 2
        return int(module.main(given[1:]))
    except KeyboardInterrupt:  # while it is still loading
        print("interrupted", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
