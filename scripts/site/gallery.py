"""Flies bundled scenes by the shipped policy and writes their replays, which the gallery links to.

Replays that are in build/replays already are left as they are: remove them to fly anew. Where
`mjcollect.replay` is not there, none is written, and the gallery has its pictures only.
"""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path

BUILD = Path(__file__).resolve().parents[2] / "build"
FLIGHTS = {
    "scenario_1": ["--scene", "scenario_1"],
    "city": ["--scene", "city_6"],
    "three_UAVs": ["--scene", "sweep_8", "--uavs", "3"],
    "in_wind_beside_a_moving_box": [
        *("--scene", "sweep_8", "--flights", "1"),
        *("--wind", "5", "--gusts", "2.5", "--mover", "10"),
    ],
}


def main() -> int:
    """Flies and writes what is missing; returns the exit code of the first program that fails."""
    if importlib.util.find_spec("mjcollect.replay") is None:
        print("no replays: mjcollect.replay is not there", file=sys.stderr)
        return 0
    (BUILD / "replays").mkdir(parents=True, exist_ok=True)
    for name, flags in FLIGHTS.items():
        replay, run = BUILD / "replays" / f"{name}.html", BUILD / "flights" / name
        if replay.exists():
            continue
        quiet = ["--no-video", "--no-plots", "--overwrite", "--out", str(run)]
        for program in (
            ["train.fly", *flags, *quiet],
            ["mjcollect.replay", str(run), "--out", str(replay)],
        ):
            done = subprocess.run([sys.executable, "-m", *program], cwd=BUILD.parent, check=False)
            if done.returncode:
                return done.returncode
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
