"""A full disk is named, what was written stays whole, and the run goes on when there is room."""

from __future__ import annotations

import json
import os
import subprocess

import pytest

from mjcollect.render.video import render_in_child
from mjcollect.scene.trajectory import Trajectory
from train.fly import main as fly
from train.segment import main as segment
from train.support.run_folder import RunFolder

TINY = (  # noqa: SIM905 - reads like the command line
    "--updates 12 --extra-updates 0 --envs 8 --batch 16 --buffer 8000 --width 8 --u2 4 "
    "--demonstrations 64 --eval-every 4 --eval-episodes 1 --threads 1 --no-video --no-plots "
    "--checkpoint-every 4"
).split()


@pytest.fixture
def disk(tmp_path):
    """A disk of 2 MB of its own, which only root can have."""
    place = tmp_path / "disk"
    place.mkdir()
    mounted = ["mount", "-t", "tmpfs", "-o", "size=2m", "tmpfs", str(place)]
    if os.geteuid() != 0 or subprocess.run(mounted, check=False, capture_output=True).returncode:
        pytest.skip("no disk can be mounted here")
    yield place
    subprocess.run(["umount", "--lazy", str(place)], check=True)


def test_a_run_stops_at_a_full_disk_and_goes_on(disk, scene_file, tmp_path, capsys):
    """The replay buffer does not fit."""
    out, whole = disk / "run", tmp_path / "whole"
    arguments = ["--scene", str(scene_file), *TINY]
    assert segment(["--out", str(out), *arguments]) == 1
    said = capsys.readouterr().err
    assert f"No space left on device: '{out / 'checkpoint'}'" in said
    assert f"the disk at {disk} has" in said
    assert "--resume" in said
    assert "Traceback" not in said
    assert {path.name for path in out.iterdir()} <= {
        "config.json", "command.txt", "scene.json", "metrics.csv",
    }  # fmt: skip
    assert json.loads((out / "config.json").read_text())["program"] == "train.segment"
    subprocess.run(["mount", "-o", "remount,size=200m", str(disk)], check=True)
    assert segment(["--out", str(out), *arguments, "--resume"]) in (0, 1)
    segment(["--out", str(whole), *arguments])
    for name in ("policy.pt", "metrics.csv", "trajectory.csv"):
        assert (out / name).read_bytes() == (whole / name).read_bytes(), name


def test_a_flight_on_a_full_disk(disk, scene_file, monkeypatch, capsys):
    out, filler, create = disk / "run", disk / "filler", RunFolder.create

    def create_and_fill(folder, *arguments, **options):
        create(folder, *arguments, **options)
        there = os.statvfs(disk)
        filler.write_bytes(bytes(there.f_bavail * there.f_frsize - 8192))

    arguments = ["--scene", str(scene_file), "--planner", "guidance", "--out", str(out)]
    arguments += ["--no-video", "--no-plots", "--overwrite"]
    with monkeypatch.context() as patch:
        patch.setattr(RunFolder, "create", create_and_fill)
        assert fly(arguments) == 1
    said = capsys.readouterr().err
    assert f"No space left on device: '{out / 'trajectory.csv'}'" in said
    assert f"the disk at {disk} has" in said
    assert {path.name for path in out.iterdir()} == {"config.json", "command.txt", "scene.json"}
    filler.unlink()
    assert fly(arguments) == 0
    assert len(Trajectory.load(out / "trajectory.csv")) > 100


def test_a_video_on_a_full_disk(disk, scene_file, monkeypatch):
    out = disk / "run"
    arguments = ["--scene", str(scene_file), "--planner", "guidance", "--out", str(out)]
    assert fly([*arguments, "--no-video", "--no-plots"]) == 0
    before = {path.name for path in out.iterdir()}
    there = os.statvfs(disk)
    (disk / "filler").write_bytes(bytes(there.f_bavail * there.f_frsize - 65536))
    monkeypatch.setenv("MUJOCO_GL", "egl")
    reason = render_in_child(out)
    assert reason is not None
    if "off-screen rendering" in reason:
        pytest.skip("no EGL here: apt-get install libegl1 libgl1-mesa-dri")
    assert f"{out / 'mission.mp4'}: cannot be written" in reason
    assert "No space left on device" in reason
    assert {path.name for path in out.iterdir()} == before
