"""Kills runs by SIGKILL at random times, goes on with --resume, and compares the ends.

python -m benchmarks.reliability.kills --out docs/results/kills.json

Segments, missions of two workers and generalists are begun, killed and gone on with until they end
by themselves; then they begin anew, until all kills are done. Every end must have the bytes of a
run that was left alone, but for the wall-clock times in its JSON files. After every kill no process
of the run may live on, and at the end its temporary folder must be empty.

Programs are forked from a server that has imported everything, as missions start their segments;
otherwise most kills would hit imports. The first of each kind are started by `python -m`.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from multiprocessing import forkserver, resource_tracker
from multiprocessing.util import Finalize
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from benchmarks.common import Row
from mjcollect.scene.scene import Scene
from train.jobs.processes import Program, ended
from train.support.markdown import markdown_table
from train.support.run_folder import RunFolder, versions

MARK = "MJCOLLECT_KILLS"  # Every process of the campaign has this in its environment.
CLOCK = ("train_seconds", "seconds")  # Wall-clock times differ from run to run.
UNEQUAL = ("command.txt", "report.md", "manifest.json", "state.json", "SHA256SUMS")  # hold times
TINY = (
    "--extra-updates 0 --envs 8 --batch 16 --buffer 1000 --width 8 --u2 4 --demonstrations 64 "
    "--eval-every 8 --eval-episodes 2 --threads 1 --checkpoint-every 4"
)
CASES = {
    "segment": ("train.segment", f"--updates 80 --no-video --no-plots {TINY}"),
    "generalist": (
        "train.generalist",
        "--segments 3 --held-out 1 --courses 2 --rotate 16 --workers 1 --updates 80 "
        f"--least-updates 80 --patience 80 --actor-delay 8 {TINY}",
    ),
    "mission": (
        "train.mission",
        f"--updates 24 --no-video --no-plots --policy none --retries 0 --workers 2 {TINY}",
    ),
}
SHARES = {"segment": 0.55, "generalist": 0.3, "mission": 0.15}  # of the kills


@dataclass(frozen=True)
class Args:
    """Kills runs at random times, goes on with them, and compares the ends."""

    kills: int = 100
    """Sets the number of kills, shared out as `SHARES` says."""
    seed: int = 0
    """Sets the seed of the times."""
    cases: tuple[str, ...] = tuple(SHARES)
    """Names the kinds of runs."""
    longest: float = 0.5
    """Kills at a random time up to this share of the seconds of a run that is left alone."""
    fresh: int = 1
    """Starts the first so many of each kind by python -m."""
    out: Path | None = None
    """JSON file for the results; what it has of other kinds of runs is kept."""


@dataclass
class Campaign:
    """Holds one kind of run, and what was seen of it."""

    name: str
    program: str
    arguments: list[str]
    folder: Path

    def start(self, out: Path, fresh: bool) -> tuple[int, Any]:
        """Starts or goes on with a run in `out`; returns its process id and a handle."""
        arguments = [*self.arguments, "--out", str(out), "--resume"]
        if not fresh:
            program = Program(self.program, arguments)
            assert program._process.pid is not None
            return program._process.pid, program
        process = subprocess.Popen(
            [sys.executable, "-m", self.program, *arguments], start_new_session=True,
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        return process.pid, process


def wait_for(handle: Any, timeout: float | None) -> bool:
    """Waits for the end of a run; returns whether it came within `timeout` seconds."""
    if isinstance(handle, Program):
        if timeout is None:
            handle._process.join()
            return True
        return bool(ended([handle], timeout))
    with contextlib.suppress(subprocess.TimeoutExpired):
        handle.wait(timeout)
        return True
    return False


def outcome(handle: Any) -> tuple[int, str]:
    """Returns exit code and output of a run that has ended."""
    return handle.result() if isinstance(handle, Program) else (handle.returncode, "")


def living() -> list[int]:
    """Returns the processes of the campaign that belong to no running program."""
    own = {os.getpid(), forkserver._forkserver._forkserver_pid}
    own.add(resource_tracker._resource_tracker._pid)
    found = []
    for path in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            words = (path / "environ").read_bytes().split(b"\0")
            marked = f"{MARK}={os.getpid()}".encode() in words
            zombie = (path / "stat").read_text().rpartition(")")[2].split()[0] == "Z"
            if marked and not zombie and int(path.name) not in own:
                found.append(int(path.name))
    return found


def orphans(patience: float = 60.0) -> int:
    """Returns how many processes of a killed run still live after `patience` seconds."""
    until = time.monotonic() + patience
    while (left := living()) and time.monotonic() < until:
        time.sleep(0.2)
    return len(left)


def content(out: Path) -> dict[str, bytes]:
    """Returns the files of a finished run by name, without what holds wall-clock times.

    The replay buffer is left out too: the rows not written yet hold whatever was in the memory.
    """
    found = {}
    for path in sorted(out.rglob("*")):
        if path.is_file() and path.name not in UNEQUAL and not path.parent.name.endswith("-buffer"):
            data = path.read_bytes()
            if path.suffix == ".json":
                data = json.dumps(timeless(json.loads(data))).encode()
            found[str(path.relative_to(out))] = data
    return found


def differing(one: dict[str, bytes], other: dict[str, bytes]) -> list[str]:
    """Returns the names of the files in which two runs differ."""
    return sorted(name for name in {*one, *other} if one.get(name) != other.get(name))


def timeless(document: Any) -> Any:
    """Returns a JSON document without wall-clock times."""
    if isinstance(document, dict):
        return {k: timeless(v) for k, v in document.items() if k not in CLOCK}
    return [timeless(entry) for entry in document] if isinstance(document, list) else document


def undisturbed(campaign: Campaign) -> dict[str, bytes]:
    """Returns the content of a run that is left alone."""
    _, handle = campaign.start(campaign.folder / "alone", fresh=False)
    wait_for(handle, None)
    code, output = outcome(handle)
    if code not in (0, 1):
        raise SystemExit(f"{campaign.name}: exit code {code}: {output[-2000:]}")
    return content(campaign.folder / "alone")


def run(campaign: Campaign, args: Args, kills: int, fresh: int) -> Row:
    """Kills runs of one kind so many times; returns what was found."""
    rng = np.random.default_rng([args.seed, list(CASES).index(campaign.name)])
    wanted = undisturbed(campaign)
    begun = time.monotonic()
    again = undisturbed(replace(campaign, folder=campaign.folder / "again"))
    longest = args.longest * (time.monotonic() - begun)  # All that is compiled once is by now.
    if other := differing(again, wanted):
        raise SystemExit(f"{campaign.name}: differs without a kill: {other}")
    row: Row = {"case": campaign.name, "kills": 0, "runs": 0, "equal": 0, "orphans": 0}
    row |= {"by_python_m": fresh, "longest": longest, "refused": [], "unequal": []}
    out, done = campaign.folder / "0", False
    while row["kills"] < kills or not done:
        new = row["kills"] < fresh
        pid, handle = campaign.start(out, new)
        wait = float(rng.uniform(0.0, longest)) if row["kills"] < kills else None
        done = wait_for(handle, wait)
        if not done:
            os.kill(pid, signal.SIGKILL)
            wait_for(handle, None)
            outcome(handle)
            row["kills"] += 1
            row["orphans"] += orphans()
            print(f"{campaign.name}: {row['kills']} kills", flush=True)
            continue
        code, output = outcome(handle)
        if code not in (0, 1):
            row["refused"].append(f"exit code {code}: {output.strip()[-500:]}")
        found, row["runs"] = content(out), row["runs"] + 1
        other = differing(found, wanted)
        row["equal"] += not other
        row["unequal"] += other
        row["orphans"] += orphans()
        out = campaign.folder / str(row["runs"])
        print(f"{campaign.name}: {row['kills']} kills, {row['equal']}/{row['runs']}", flush=True)
    return row


def main(argv: list[str] | None = None) -> int:
    """Runs the campaign; returns 1 if anything was found."""
    args = tyro.cli(Args, args=argv, prog="python -m benchmarks.reliability.kills")
    os.environ[MARK] = str(os.getpid())
    rows = []
    place = Path(tempfile.mkdtemp(prefix="kills-"))
    Finalize(
        None, shutil.rmtree, (place, True), exitpriority=-200
    )  # after the fork server's folder
    temporary = place / "temporary"
    temporary.mkdir()
    os.environ["TMPDIR"] = tempfile.tempdir = str(temporary)
    scene = place / "hop.json"
    Scene(
        name="hop", seed=0, bounds=[[0, 0, 0], [150, 150, 30]], depot=[75, 20, 15],
        items=[[75, 120, 15], [120, 60, 15]], obstacles=[[[85, 80, 0], [105, 100, 30]]],
    ).save(scene)  # fmt: skip
    for name in args.cases:
        program, flags = CASES[name]
        given = [] if name == "generalist" else ["--scene", str(scene)]
        own = Campaign(name, program, [*given, *flags.split()], place / name)
        share = round(args.kills * SHARES[name])
        rows.append(run(own, args, share, min(args.fresh, share)))
        print(rows[-1], flush=True)
    mine = {Path(forkserver._forkserver._forkserver_address).parent}
    left = sorted(path.name for path in temporary.iterdir() if path not in mine)
    for row in rows:
        row["left"] = left
    heads = ("case", "kills", "runs", "equal", "orphans")
    print("\n".join(markdown_table(heads, [[str(row[h]) for h in heads] for row in rows])))
    print(f"left in the temporary folder: {left or 'nothing'}")
    if args.out is not None:
        folder = RunFolder(args.out.parent)
        before = (folder.read_json(args.out.name) or {"results": []})["results"]
        kept = [row for row in before if row["case"] not in args.cases]
        folder.write_json(args.out.name, {"results": [*kept, *rows], "versions": versions()})
    good = all(row["equal"] == row["runs"] and not row["orphans"] for row in rows)
    return 0 if good and not left else 1


if __name__ == "__main__":
    sys.exit(main())
