import errno
import os
import signal
import subprocess
import sys

import pytest
import safetensors.torch
import torch

from mjcollect.scene.scene import Scene
from train.support.command_line import stop_on_ctrl_c
from train.support.run_folder import PLANS, RunError, RunFolder

CONFIG = {"program": "test", "seed": 1}


@pytest.fixture(scope="module")
def scene():
    return Scene.find("scenario_1")


@pytest.fixture
def folder(tmp_path, scene):
    folder = RunFolder(tmp_path / "run")
    folder.check(CONFIG, resume=False, overwrite=False)
    folder.create(CONFIG, scene, overwrite=False)
    return folder


def test_check_touches_nothing(tmp_path):
    RunFolder(tmp_path / "a" / "b").check(CONFIG, resume=False, overwrite=False)
    assert list(tmp_path.iterdir()) == []


def test_a_full_folder_is_refused_and_left_alone(folder):
    before = (folder.path / "config.json").read_text()
    folder.unlock()
    with pytest.raises(RunError, match=r"is not empty.*--resume.*--overwrite"):
        folder.check(CONFIG, resume=False, overwrite=False)
    assert (folder.path / "config.json").read_text() == before


def test_resume_with_other_settings_names_the_difference(folder):
    folder.unlock()
    folder.check(CONFIG, resume=True, overwrite=False)
    with pytest.raises(RunError, match="seed: 2 differs from 1"):
        folder.check(CONFIG | {"seed": 2}, resume=True, overwrite=False)
    folder.write_json("config.json", CONFIG | {"learn": {"gamma": 0.9, "updates": 6000}})
    with pytest.raises(RunError, match="--resume: updates: 7000 differs from 6000 in"):
        folder.check(
            CONFIG | {"learn": {"gamma": 0.9, "updates": 7000}}, resume=True, overwrite=False
        )


def test_resume_of_a_strange_folder_is_refused(tmp_path):
    (tmp_path / "letter.txt").write_text("dear")
    with pytest.raises(RunError, match=r"no config\.json"):
        RunFolder(tmp_path).check(CONFIG, resume=True, overwrite=False)


def test_resume_of_a_run_killed_before_its_config_begins_it(tmp_path):
    for name in ("scene.json", ".part-command.txt"):
        (tmp_path / name).write_text("{}")
    RunFolder(tmp_path).check(CONFIG, resume=True, overwrite=False)


@pytest.mark.parametrize("name", ["x" * 300, "file/below"])
def test_impossible_folders_are_refused(tmp_path, name):
    (tmp_path / "file").write_text("")
    with pytest.raises(RunError, match="cannot be used"):
        RunFolder(tmp_path / name).check(CONFIG, resume=False, overwrite=False)


def test_resume_and_overwrite_exclude_each_other(tmp_path):
    with pytest.raises(RunError, match="exclude"):
        RunFolder(tmp_path).check(CONFIG, resume=True, overwrite=True)


def test_a_file_as_folder_is_refused(tmp_path):
    (tmp_path / "out").write_text("")
    with pytest.raises(RunError, match="is a file"):
        RunFolder(tmp_path / "out").check(CONFIG, resume=False, overwrite=False)


def test_overwrite_removes_only_a_run(folder, scene):
    (folder.path / "letter.txt").write_text("dear")
    (folder.path / "segment.json").write_text("{}")
    (folder.path / "checkpoint").mkdir()
    folder.unlock()
    folder.create(CONFIG, scene, overwrite=True)
    names = {path.name for path in folder.path.iterdir()}
    assert names == {"letter.txt", "config.json", "command.txt", "scene.json"}


@pytest.mark.parametrize("name", ["policy.pt", "segments/0/policy.pt", "."])
def test_overwrite_never_removes_what_the_program_reads(folder, name):
    path = folder.path / name
    path.parent.mkdir(parents=True, exist_ok=True)
    if name != ".":
        path.write_text("learned")
    folder.unlock()
    with pytest.raises(RunError, match=r"--overwrite: .* is in --out .*; copy it elsewhere"):
        folder.check(CONFIG, overwrite=True, inputs=[None, path])
    elsewhere = [folder.path.parent / "policy.pt", folder.path / "shipped"]  # a name, not there
    folder.check(CONFIG, overwrite=True, inputs=elsewhere)
    folder.check(CONFIG, resume=True, overwrite=False, inputs=[path])


def test_overwrite_removes_links_but_not_what_they_lead_to(folder, scene, tmp_path):
    (tmp_path / "kept").mkdir()
    (tmp_path / "kept" / "policy.pt").write_text("learned")
    (folder.path / "segments").symlink_to(tmp_path / "kept")
    folder.unlock()
    folder.create(CONFIG, scene, overwrite=True)
    assert not (folder.path / "segments").exists()
    assert (tmp_path / "kept" / "policy.pt").read_text() == "learned"


def test_overwrite_removes_plans_for_ground_stations(folder, scene):
    """An older plan beside a new flight would be flown by mistake."""
    for kind in PLANS:
        (folder.path / f"mission.{kind}").write_text("old")
    folder.unlock()
    folder.create(CONFIG, scene, overwrite=True)
    assert not [path for path in folder.path.iterdir() if path.name.startswith("mission.")]


def test_a_folder_in_use_is_refused(folder, scene):
    message = rf"--out: {folder.path}: another process \({os.getpid()}\) is writing to it"
    with pytest.raises(RunError, match=message):
        RunFolder(folder.path).create(CONFIG, scene, overwrite=True)
    for how in ({"resume": True, "overwrite": False}, {"resume": False, "overwrite": True}):
        with pytest.raises(RunError, match=message):
            RunFolder(folder.path).check(CONFIG, **how)
    folder.unlock()
    RunFolder(folder.path).create(CONFIG, scene, overwrite=True)


def test_a_killed_process_gives_its_folder_free(tmp_path):
    code = f"""
import time
from train.support.run_folder import RunFolder
folder = RunFolder({str(tmp_path)!r})
folder.lock()
print("locked", flush=True)
time.sleep(600)
"""
    holder = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE)
    assert holder.stdout.readline() == b"locked\n"
    with pytest.raises(RunError, match=rf"another process \({holder.pid}\)"):
        RunFolder(tmp_path).lock()
    holder.kill()
    holder.wait()
    RunFolder(tmp_path).lock()


@pytest.mark.parametrize("text", ["", "{", "[]", "5", "\x00", "[" * 100_000])
def test_a_damaged_result_is_refused_with_its_name(folder, text):
    for name in ("config.json", "segment.json"):
        (folder.path / name).write_text(text)
        with pytest.raises(RunError, match=str(folder.path / name)):
            folder.read_json(name)


def test_a_failed_write_leaves_the_old_file(folder):
    folder.write_text("note.txt", "old")

    def fail(part):
        part.write_text("half")
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        folder.write("note.txt", fail)
    assert (folder.path / "note.txt").read_text() == "old"
    assert not list(folder.path.glob(".part*"))


def test_metrics_leave_cells_empty_where_there_is_no_value(folder):
    folder.write_metrics(
        [{"update": 1, "eval_time": float("nan")}, {"update": 2, "eval_time": 3.5}]
    )
    assert (folder.path / "metrics.csv").read_text().split() == ["update,eval_time", "1,", "2,3.5"]


def test_checkpoint_survives_a_stop_between_the_renames(folder):
    source, target = torch.nn.Linear(2, 2), torch.nn.Linear(2, 2)
    assert not folder.load_checkpoint(net=target)
    folder.save_checkpoint(net=source)
    (folder.path / "checkpoint").rename(folder.path / "checkpoint.old")
    assert folder.load_checkpoint(net=target)
    assert torch.equal(source.weight, target.weight)
    folder.save_checkpoint(net=source)
    assert not (folder.path / "checkpoint.old").exists()


def test_the_old_checkpoint_stays_until_the_new_one_is_whole(folder, monkeypatch):
    source, target = torch.nn.Linear(2, 2), torch.nn.Linear(2, 2)
    folder.save_checkpoint(net=source)
    (folder.path / "checkpoint").rename(folder.path / "checkpoint.old")
    removed = []
    monkeypatch.setattr("shutil.rmtree", lambda path, **_: removed.append((path.name, where())))

    def where():
        return (folder.path / "checkpoint").exists()

    folder.save_checkpoint(net=source)
    assert ("checkpoint.old", False) not in removed
    assert folder.load_checkpoint(net=target)


def test_a_full_disk_keeps_the_old_checkpoint(folder, monkeypatch):
    source, target = torch.nn.Linear(2, 2), torch.nn.Linear(2, 2)
    folder.save_checkpoint(net=source)

    def fail(*_):
        raise safetensors.SafetensorError("I/O error: No space left on device (os error 28)")

    with monkeypatch.context() as patch:
        patch.setattr("safetensors.torch.save_file", fail)
        with pytest.raises(OSError, match=r"No space left on device: .*checkpoint") as caught:
            folder.save_checkpoint(net=target)
    assert caught.value.errno == errno.ENOSPC
    assert folder.load_checkpoint(net=target)
    assert torch.equal(source.weight, target.weight)


def test_first_ctrl_c_asks_second_one_ends():
    with stop_on_ctrl_c() as stopped:
        assert not stopped()
        signal.raise_signal(signal.SIGINT)
        assert stopped()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)


def test_resume_with_another_scene_is_refused(folder, scene):
    folder.check_scene(scene, "scenario_1")
    with pytest.raises(RunError, match="differs from other"):
        folder.check_scene(Scene.find("scenario_2"), "other")
