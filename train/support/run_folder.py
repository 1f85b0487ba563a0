"""Opens run folders only when it is safe, writes them whole or not at all, and resumes them."""

from __future__ import annotations

import contextlib
import csv
import fcntl
import importlib.metadata
import json
import math
import os
import shlex
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from mjcollect.scene.scene import Scene
from train.support import checkpoint

VERSIONED = (
    "mjcollect",
    "mujoco",
    "numba",
    "clarabel",
    "dm-control",
    "torch",
    "torchrl",
    "tensordict",
    "numpy",
    "elkai",
)
PLANS = ("plan", "kml", "geojson")  # A mission at a real place is also written in these formats.
# A run writes all of these; --overwrite removes them and nothing else.
RUN_FILES = (
    "config.json", "command.txt", "scene.json", "segment.json", "mission.json", "trajectory.csv",
    "shield.csv", "segment.mp4", "mission.mp4", "path_3d.png", "path_top.png", "learning.png",
    "speed.png", "metrics.csv", "policy.pt", "checkpoint", "checkpoint.old", "segments", "attempts",
    "guidance", "report.md", "pool", "pool.json", "generalist.json", "policy.safetensors",
    "tracks.png", "air.json", "fleet.json", "fleet.mp4", "schedule.png", "uavs", "replay.html",
    "logs", *(f"mission.{kind}" for kind in PLANS),
)  # fmt: skip
BEGINNING = ("scene.json", "command.txt", ".part-")  # A folder holds these before config.json.
MEND = "put the file back as it was written, or start anew with --overwrite"
SPACE = 1_000_000  # A run is not begun with fewer free bytes.


class RunError(Exception):
    """Says that a run cannot start as asked; the message names field, value and fix."""


def check_writable(folder: Path, flag: str) -> None:
    """Refuses a folder, there or not yet, that cannot be written to, before any work.

    Raises:
        RunError: It cannot; the message names the `flag` that named the folder.
    """
    try:
        parent = folder
        while not parent.exists():
            parent = parent.parent
        with tempfile.TemporaryFile(dir=parent) as file:  # a full disk takes an empty file
            file.write(bytes(SPACE))
    except OSError as error:
        raise RunError(
            f"{flag}: {folder}: cannot be used ({error.strerror}); choose another folder"
        ) from None


class RunFolder:
    """Reads and writes one run's folder.

    Attributes:
        path: The folder.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        """Names a folder; nothing is touched yet."""
        self.path = Path(path)
        self._lock: int | None = None

    def segment(self, index: int) -> RunFolder:
        """Returns the folder of a mission's segment."""
        return RunFolder(self.path / "segments" / str(index))

    def check(
        self, config: dict[str, Any], *, resume: bool | None = None, overwrite: bool,
        inputs: Sequence[Path | None] = (),
    ) -> None:  # fmt: skip
        """Refuses an unusable folder before any work.

        Args:
            resume: whether to go on with what is there; None where the program cannot.
            inputs: what the program reads, which --overwrite must not remove.

        Raises:
            RunError: It is no folder, not empty without --resume or --overwrite, not writable,
                written to by another process, to be resumed with other settings, or to be
                overwritten with an input in it.
        """
        if resume and overwrite:
            raise RunError("--resume and --overwrite exclude each other: give one of them")
        if os.path.exists(self.path) and not os.path.isdir(self.path):
            raise RunError(f"--out: {self.path}: is a file; name a folder")
        check_writable(self.path, "--out")
        for path in filter(None, inputs if overwrite else ()):
            # The name of one of the package's own policies is no file.
            if path.exists() and path.resolve().is_relative_to(self.path.resolve()):
                raise RunError(
                    f"--overwrite: {path} is in --out {self.path}, whose files would be removed; "
                    "copy it elsewhere, or name another --out"
                )
        if self.path.is_dir():
            self.lock()  # Who writes there is told at once, not after the work before `create`.
            self.unlock()
        if self.path.is_dir() and any(self.path.iterdir()) and not overwrite:
            if not resume:
                go_on = "" if resume is None else "--resume to go on with it, "
                raise RunError(
                    f"--out: {self.path}: is not empty; give {go_on}--overwrite to start anew, or "
                    "another folder"
                )
            self._check_same(config)

    def _check_same(self, config: dict[str, Any]) -> None:
        saved = self.read_json("config.json")
        if saved is None:
            if all(entry.name.startswith(BEGINNING) for entry in self.path.iterdir()):
                return  # stopped before config.json, which `create` writes last
            raise RunError(
                f"--resume: {self.path}: holds no config.json of a run; name the run's folder"
            )
        if (found := _difference(saved, config)) is not None:
            key, old, new = found
            raise RunError(
                f"--resume: {key}: {new!r} differs from {old!r} in {self.path / 'config.json'}; "
                "give the same value, or another --out"
            )

    def check_scene(self, scene: Scene, name: str) -> None:
        """Refuses to resume with another scene than the folder's; the user gave it as `name`.

        Raises:
            RunError: They differ.
        """
        saved = self.path / "scene.json"
        if saved.is_file() and Scene.load(saved) != scene:
            raise RunError(f"--resume: {saved} differs from {name}; give the run's own scene")

    def create(
        self, config: dict[str, Any], scene: Scene | None, *, overwrite: bool,
        files: Sequence[str] = RUN_FILES,
    ) -> None:  # fmt: skip
        """Makes the folder with config.json, command.txt and, if there is one, scene.json.

        Args:
            overwrite: whether to remove the files of an earlier run: what `files` names.

        Raises:
            RunError: The folder cannot be made, or another process writes to it.
        """
        try:
            self.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise RunError(f"--out: {self.path}: cannot be made ({error.strerror})") from None
        self.lock()
        for left in self.path.glob(".part-*"):  # by a process that was killed
            remove(left)
        if overwrite:
            for target in [path for name in files for path in self.path.glob(name)]:
                remove(target)
        if scene is not None:
            self.write("scene.json", scene.save)
        # Arguments may be names of files that are no text; they come back as the same bytes.
        command = shlex.join([sys.executable, *sys.orig_argv[1:]]) + "\n"
        self.write("command.txt", lambda part: part.write_bytes(os.fsencode(command)))
        self.write_json("config.json", config)

    def lock(self) -> None:
        """Keeps other processes from writing here until `unlock` or the end of this one.

        The lock is the kernel's, on the folder itself: it ends with the process, also by SIGKILL.

        Raises:
            RunError: Another process writes here.
        """
        self._lock = os.open(self.path, os.O_RDONLY)
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            who = _holder(self._lock)
            self.unlock()
            raise RunError(
                f"--out: {self.path}: {who} is writing to it; wait for it or stop it"
            ) from None

    def unlock(self) -> None:
        """Lets other processes write here."""
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def __del__(self) -> None:
        """Lets other processes write here, also where an error ended the work."""
        self.unlock()

    def write(self, name: str, save: Callable[[Path], object]) -> None:
        """Writes a file through a temporary one and a rename: it is whole or not there."""
        target = self.path / name
        # Same ending as the target: some writers choose the format by it.
        part = target.with_name(f".part-{target.name}")
        try:
            save(part)
            os.replace(part, target)
        except OSError as error:
            # Where the disk is full Python does not say which file it was.
            raise OSError(error.errno, error.strerror or str(error), str(target)) from error
        finally:
            part.unlink(missing_ok=True)

    def write_text(self, name: str, text: str) -> None:
        """Writes a text file, whole or not at all."""
        self.write(name, lambda part: part.write_text(text, encoding="utf-8"))

    def write_json(self, name: str, document: dict[str, Any]) -> None:
        """Writes a JSON file, whole or not at all."""
        self.write_text(name, json.dumps(document, indent=1, allow_nan=False) + "\n")

    def read_json(self, name: str) -> dict[str, Any] | None:
        """Returns what a JSON file holds; None if it is not there.

        Raises:
            RunError: the file holds no JSON object.
        """
        path = self.path / name
        if not path.is_file():
            return None
        try:
            document = json.loads(path.read_text(encoding="utf-8"))
        except (ValueError, RecursionError) as error:
            raise RunError(f"{path}: is no JSON ({error}); {MEND}") from None
        if not isinstance(document, dict):
            raise RunError(f"{path}: holds no JSON object; {MEND}")
        return document

    def write_metrics(self, rows: Sequence[dict[str, float]]) -> None:
        """Writes metrics.csv, one row per evaluation; empty cells where a value is NaN."""

        def save(part: Path) -> None:
            with part.open("w", newline="", encoding="utf-8") as file:
                writer = csv.DictWriter(file, fieldnames=list(rows[0]))
                writer.writeheader()
                for row in rows:
                    writer.writerow({k: "" if v != v else v for k, v in row.items()})

        if rows:
            self.write("metrics.csv", save)

    def save_checkpoint(self, **components: Any) -> None:
        """Writes checkpoint/ beside the old one, then swaps: one of them is always whole."""
        new, old = self.path / ".part-checkpoint", self.path / "checkpoint.old"
        current = self.path / "checkpoint"
        for stale in self.path.glob(".*part-checkpoint*"):  # TorchRL's own staging folder too
            shutil.rmtree(stale, ignore_errors=True)
        try:
            checkpoint.save(new, components)
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(current)) from error
        if current.exists():
            shutil.rmtree(old, ignore_errors=True)
            current.rename(old)
        new.rename(current)
        shutil.rmtree(old, ignore_errors=True)

    def load_checkpoint(self, **components: Any) -> bool:
        """Restores the components from the last checkpoint; False if there is none.

        Raises:
            RunError: a file of it is damaged, or it would have to be unpickled.
        """
        for name in ("checkpoint", "checkpoint.old"):
            if (self.path / name).is_dir():
                try:
                    checkpoint.load(self.path / name, components)
                except checkpoint.DamagedCheckpoint as error:
                    raise RunError(f"--resume: {error}; {MEND}") from None
                return True
        return False


@contextlib.contextmanager
def as_written(path: Path) -> Iterator[None]:
    """Refuses a file of another run in which something is missing, or of another type.

    Raises:
        RunError: it is so.
    """
    try:
        yield
    except (LookupError, TypeError, AttributeError, ValueError) as error:
        raise RunError(f"--run: {path}: is not as a run leaves it ({error!r}); {MEND}") from None


def _difference(saved: dict[str, Any], config: dict[str, Any]) -> tuple[str, Any, Any] | None:
    """Returns the first key in which settings differ, also within groups, and both values."""
    for key in sorted(saved.keys() | config.keys()):
        old, new = saved.get(key), config.get(key)
        if isinstance(old, dict) and isinstance(new, dict):
            if (found := _difference(old, new)) is not None:
                return found
        elif old != new:
            return key, old, new
    return None


def _holder(descriptor: int) -> str:
    """Returns which process has a lock on an open folder, as far as Linux says so."""
    about = os.fstat(descriptor)
    device = f"{os.major(about.st_dev):02x}:{os.minor(about.st_dev):02x}:{about.st_ino}"
    with contextlib.suppress(OSError):
        for line in Path("/proc/locks").read_text(encoding="ascii").splitlines():
            words = line.split()
            if words[1:2] == ["FLOCK"] and words[5] == device:
                return f"another process ({words[4]})"
    return "another process"


def remove(path: Path) -> None:
    """Removes a file, a link, or a folder with all that is in it."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink()


def finite(value: float) -> float | None:
    """Returns None for NaN and infinity, which JSON cannot hold."""
    return value if math.isfinite(value) else None


def default_folder(kind: str, *parts: str) -> Path:
    """Returns `runs/<kind>/<parts joined by dashes>`, where a run goes without --out."""
    return Path("runs") / kind / "-".join(parts)


def versions() -> dict[str, str]:
    """Returns the versions of the packages that a result depends on."""
    found = {"python": sys.version.split()[0]}
    for package in VERSIONED:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found[package] = importlib.metadata.version(package)
    return found
