"""Builds sdist and wheel, installs the wheel into an empty environment, and runs programs there.

    .venv/bin/python scripts/check_package.py

The wheel is built from the sdist, so that what the sdist lacks is missed. Both must hold every file
that they should and no other. Nothing of the checkout is in reach of the programs.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tarfile
import tempfile
import time
import tomllib
import venv
import zipfile
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SCENE = "scenario_1"
LOOK = """
import importlib.metadata, pathlib, sys, mjcollect
version, here = importlib.metadata.version("mjcollect"), pathlib.Path(mjcollect.__file__)
assert version == mjcollect.__version__ == sys.argv[1], version
assert here.is_relative_to(sys.prefix), here
assert here.with_name("py.typed").is_file()
assert mjcollect.asset_path("scenes", "scenario_1.json").is_relative_to(here.parent)
for name in mjcollect.__all__:
    if name != "FleetParallelEnv":  # of the extra fleet
        getattr(mjcollect, name)
"""


class PackageError(Exception):
    """Says what is wrong with the package."""


def run(*command: str | Path, where: Path, code: int = 0) -> str:
    """Runs a command as a user would who has no checkout; returns what it printed.

    Raises:
        PackageError: it ended with another exit code.
    """
    kept = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    done = subprocess.run(
        [str(part) for part in command],
        cwd=where,
        env=kept | {"MUJOCO_GL": "disable"},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode != code:
        said = f"{done.stdout[-2000:]}{done.stderr[-4000:]}"
        raise PackageError(f"{' '.join(done.args)}: exit code {done.returncode}\n{said}")
    return done.stdout + done.stderr


def tracked(*folders: str) -> set[str]:
    """Returns the files of the checkout that git knows."""
    found = run("git", "ls-files", *folders, where=ROOT).splitlines()
    return {name for name in found if (ROOT / name).is_file()}


def same(what: str, found: set[str], expected: set[str]) -> None:
    """Compares the files of an archive.

    Raises:
        PackageError: there are others, or some are missing.
    """
    if found != expected:
        lacks, has = sorted(expected - found), sorted(found - expected)
        raise PackageError(f"{what}: lacks {lacks}, has beyond what git tracks {has}")


def check_files(sdist: Path, wheel: Path) -> None:
    """Compares the files of both archives with those of the checkout.

    Raises:
        PackageError: there are others, or some are missing.
    """
    with tarfile.open(sdist) as archive:
        found = {name.split("/", 1)[1] for name in archive.getnames()}
    same("sdist", found - {"PKG-INFO"}, tracked())
    library = tracked("mjcollect", "train") | {f"mjcollect/{name}" for name in tracked("assets")}
    with zipfile.ZipFile(wheel) as archive:
        found = set(archive.namelist())
    about = {name for name in found if ".dist-info/" in name}
    same("wheel", found - about, library)
    parts = {name.split("/", 1)[1] for name in about}
    same("wheel's dist-info", parts, {
        "METADATA", "WHEEL", "RECORD", "entry_points.txt", "licenses/LICENSE",
        "licenses/mjcollect/replay/assets/three.LICENSE",
    })  # fmt: skip


def check_programs(python: Path, where: Path) -> None:
    """Runs programs of an installed mjcollect in an empty folder.

    Raises:
        PackageError: one does not do what it should.
    """
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    run(python, "-c", LOOK, version, where=where)
    console = python.with_name("mjcollect")
    if "programs: segment" not in run(console, "--help", where=where):
        raise PackageError("mjcollect --help: names no programs")
    run(console, "generate", "--seed", "7", "--items", "3", "--out", "my.json", where=where)
    for scene, more in ((SCENE, ()), ("my.json", ("--planner", "guidance", "--no-plots"))):
        out = ("--no-video", "--out", f"run-{scene}")
        run(python, "-m", "train.fly", "--scene", scene, *more, *out, where=where)
        said = run(python, "-m", "mjcollect.verify", f"run-{scene}", where=where)
        if "no rule is broken" not in said:
            raise PackageError(f"mjcollect.verify: {said}")


def check_without_lkh(python: Path, where: Path) -> None:
    """Removes elkai; orders must be had by the free search, and by LKH with a clear error only.

    Raises:
        PackageError: that is not so.
    """
    run(python, "-m", "pip", "uninstall", "--quiet", "--yes", "elkai", where=where)
    fly = ("--order", "search", "--planner", "guidance", "--no-plots", "--no-video")
    run(python, "-m", "train.fly", "--scene", SCENE, *fly, where=where)
    said = run(python, "-m", "mjcollect.scene", SCENE, where=where, code=2)
    if "--order search" not in said:
        raise PackageError(f"without elkai: {said}")


def check(folder: Path, step: Callable[[str], None]) -> None:
    """Checks everything, in folders below an empty one; `step` is told what is done.

    Raises:
        PackageError: something is wrong.
    """
    dist, empty, home = folder / "dist", folder / "empty", folder / "venv"
    run(sys.executable, "-m", "build", "--outdir", dist, ROOT, where=ROOT)
    (sdist,), (wheel,) = dist.glob("*.tar.gz"), dist.glob("*.whl")
    run(sys.executable, "-m", "twine", "check", "--strict", sdist, wheel, where=ROOT)
    check_files(sdist, wheel)
    step(f"built {sdist.name} ({size(sdist)}) and {wheel.name} ({size(wheel)})")
    empty.mkdir()
    venv.create(home, with_pip=True)
    python = home / "bin" / "python"
    # Only what is imported is compiled to bytecode, later: torch has many files.
    options = ("--quiet", "--disable-pip-version-check", "--no-compile")
    run(python, "-m", "pip", "install", *options, wheel, where=empty)
    run(python, "-m", "pip", "check", where=empty)
    step("installed it with its dependencies")
    check_programs(python, empty)
    step("ran its programs in an empty folder")
    check_without_lkh(python, empty)
    step("did without elkai")


def size(file: Path) -> str:
    """Returns a file's size for people."""
    return f"{file.stat().st_size / 1e6:.1f} MB"


def main() -> int:
    """Checks the package; returns the exit code, 1 if something is wrong."""
    begun = time.monotonic()

    def step(done: str) -> None:
        print(f"{time.monotonic() - begun:5.0f} s: {done}", flush=True)

    try:
        with tempfile.TemporaryDirectory() as folder:
            check(Path(folder), step)
    except PackageError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
