"""`python -m train.generalist` with tiny budgets, and the pool of segments it learns on."""

import contextlib
import json
import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from mjcollect.envs.course import Course
from mjcollect.envs.observation import SIZE as PATH
from mjcollect.learning.ddpg import make_actor
from mjcollect.learning.policy import TrainedPolicy, policy_digest
from train import generalist
from train.jobs import lessons
from train.jobs.segment_pool import ITEMS, OBSTACLES, SCALE, build, draw_segment
from train.support import training_loop
from train.support.mission_report import read_metrics
from train.support.run_folder import RunFolder

TINY = (  # noqa: SIM905 - reads like the command line
    "--segments 5 --held-out 2 --courses 4 --rotate 16 --workers 1 --checkpoint-every 8 "
    "--updates 48 --least-updates 48 --patience 48 --envs 8 --batch 16 --buffer 2000 --width 8 "
    "--u2 4 --demonstrations 64 --actor-delay 8 --eval-every 16"
).split()


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    out = tmp_path_factory.mktemp("runs") / "whole"
    assert generalist.main(["--out", str(out), *TINY]) == 0
    return out


def test_leaves_a_policy_that_loads_and_what_it_came_from(finished):
    policy = TrainedPolicy.load(finished / "policy.safetensors")
    config = json.loads((finished / "config.json").read_text())
    assert policy.observation == config["learn"]["observation"]
    size = next(policy.actor.parameters()).shape[1]
    actions = policy(np.zeros((3, size), dtype=np.float32))
    assert actions.shape == (3, 3)
    assert np.isfinite(actions).all()
    result = json.loads((finished / "generalist.json").read_text())
    assert result["updates"] == 48
    assert result["segments"] + result["held_out_segments"] == 7
    names = {path.name for path in finished.iterdir()}
    assert {"config.json", "command.txt", "metrics.csv", "learning.png", "checkpoint"} <= names


def test_the_best_on_held_out_segments_is_kept(finished):
    result = json.loads((finished / "generalist.json").read_text())
    best, rows = result["held_out"], read_metrics(finished / "metrics.csv")
    assert [row["update"] for row in rows] == [16, 32, 48]
    chosen = next(row for row in rows if row["update"] == result["best_update"])
    assert best["success_rate"] == chosen["eval_success_rate"]
    assert best["shield_share"] == chosen["eval_shield_share"]
    np.testing.assert_equal(best["mean_time"] or math.nan, chosen["eval_mean_time"])


def test_the_law_is_evaluated_on_the_same_starts(finished):
    law = json.loads((finished / "generalist.json").read_text())["law"]
    assert 0.0 < law["success_rate"] <= 1.0
    assert law["point_rate"] == 1.0  # calm
    assert law["point_time"] > 0.0


def test_stopped_anywhere_it_goes_on_to_the_same_policy(finished, tmp_path, monkeypatch):
    """Ctrl-C before, at and after a change of segments."""
    out = tmp_path / "stopped"
    stops = iter((4, 16, 28, 10_000))
    goal = [0]

    class Pressed:
        def __enter__(self):
            goal[0] = next(stops)
            return lambda: made[0] >= goal[0]

        def __exit__(self, *_):
            return False

    made = [-1]
    run = generalist.Trainer.run

    def counted(trainer):
        for updates in run(trainer):
            made[0] = updates
            yield updates

    monkeypatch.setattr(generalist.Trainer, "run", counted)
    share_pool(finished, out, monkeypatch)
    monkeypatch.setattr(training_loop, "stop_on_ctrl_c", Pressed)
    logged = [*TINY, "--logger", "csv"]
    codes = [generalist.main(["--out", str(out), *logged])]
    codes += [generalist.main(["--out", str(out), "--resume", *logged]) for _ in range(3)]
    assert codes == [130, 130, 130, 0]
    same(out, finished)
    log = (out / "logs/csv/scalars/training/update.csv").read_text()
    assert log == "16,16.0\n32,32.0\n48,48.0\n"


@pytest.mark.slow
def test_learns_with_shards_and_goes_on_after_a_stop(finished, tmp_path, monkeypatch):
    """Two processes that simulate; stopped in the middle, the same policy comes out."""
    more = [*TINY, "--shards", "2", "--updates", "32", "--least-updates", "32", "--eval-every", "8"]
    share_pool(finished, tmp_path, monkeypatch)
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    assert generalist.main(["--out", str(whole), *more]) == 0
    cut_short(["--out", str(parts), *more], monkeypatch)
    assert generalist.main(["--out", str(parts), *more, "--resume"]) == 0
    same(whole, parts)


@pytest.mark.slow
def test_learns_from_lessons_and_goes_on_after_a_stop(finished, tmp_path, monkeypatch, capsys):
    """Stopped among the lessons and in training, the same policy comes out, and another without."""
    monkeypatch.setattr(lessons, "importing_pool", lambda _: ThreadPoolExecutor(1))
    for name in ("SEGMENTS", "FLIGHTS", "AT_ONCE"):
        monkeypatch.setattr(lessons, name, 1)
    more = [*TINY, "--updates", "32", "--least-updates", "32", "--flown", "last"]
    taught = [*more, "--lessons", "60", "--imitation", "5"]
    share_pool(finished, tmp_path, monkeypatch)
    whole, parts, plain = (tmp_path / name for name in ("whole", "parts", "plain"))
    assert generalist.main(["--out", str(whole), *taught]) == 0
    assert generalist.main(["--out", str(plain), *more]) == 0
    assert (whole / "policy.safetensors").read_bytes() != (
        plain / "policy.safetensors"
    ).read_bytes()
    files = sorted((whole / "lessons").iterdir())
    assert len(files) >= 1
    give = generalist.give_lessons

    def stop_at_once(*args):
        yield next(give(*args)) * 0

    monkeypatch.setattr(generalist, "give_lessons", stop_at_once)
    assert generalist.main(["--out", str(parts), *taught]) == 130
    assert "--resume" in capsys.readouterr().err
    monkeypatch.setattr(generalist, "give_lessons", give)
    cut_short(["--out", str(parts), *taught, "--resume"], monkeypatch)
    assert generalist.main(["--out", str(parts), *taught, "--resume"]) == 0
    same(whole, parts)


def share_pool(finished, out, monkeypatch):
    """Lets further runs use the pool of the finished one."""
    built = generalist._build(RunFolder(finished), args_of(out))

    def link(folder, args):
        if not (folder.path / "pool").exists():
            (folder.path / "pool").symlink_to(finished / "pool")
        return built

    monkeypatch.setattr(generalist, "_build", link)


def cut_short(argv, monkeypatch):
    """Starts the program and ends it after 20 updates, when it has a checkpoint of 16."""
    run = generalist.Trainer.run

    def cut(trainer):
        for updates in run(trainer):
            yield updates
            if updates == 20:
                raise KeyboardInterrupt

    monkeypatch.setattr(generalist.Trainer, "run", cut)
    with contextlib.suppress(KeyboardInterrupt):
        generalist.main(argv)
    monkeypatch.setattr(generalist.Trainer, "run", run)


def same(one, other):
    """Runs that went the same way."""
    for name in ("metrics.csv", "policy.safetensors"):
        assert (one / name).read_bytes() == (other / name).read_bytes()


def test_a_pool_without_a_way_is_refused(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(
        generalist, "build_all", lambda _, wanted, *__: [(n, False) for n in wanted]
    )
    assert generalist.main(["--out", str(tmp_path / "out"), *TINY]) == 2
    assert "--segments: the guidance finds no way" in capsys.readouterr().err


def test_a_policy_that_never_arrives_is_reported_too(finished, tmp_path, capsys):
    folder = RunFolder(tmp_path)
    result = json.loads((finished / "generalist.json").read_text())
    result["held_out"] |= {"success_rate": 0.0, "point_rate": 0.0, "point_time": None}
    folder.write_json("generalist.json", result)
    assert generalist.report(folder) == 0
    assert capsys.readouterr().out


def args_of(out):
    import tyro

    return tyro.cli(generalist.Args, args=["--out", str(out), *TINY])


def test_segments_depend_on_seed_and_number_alone(tmp_path):
    one, again, other = draw_segment(3, 7), draw_segment(3, 7), draw_segment(4, 7)
    assert one == again
    assert one[0] != other[0]
    assert build(3, tmp_path, 7)
    assert list(tmp_path.glob("guidance-*.npz"))
    built, anew = Course.segment(*one, tmp_path), Course.segment(*one)
    np.testing.assert_array_equal(built.guidance[0].path, anew.guidance[0].path)


def test_segments_are_of_all_kinds():
    segments = [draw_segment(0, number) for number in range(60)]
    for scene, order, index in segments:
        assert ITEMS[0] <= len(scene.items) <= ITEMS[1]
        assert OBSTACLES[0] <= len(scene.obstacles) <= OBSTACLES[1]
        assert 0 <= index <= len(order)
    sizes = [np.ptp(scene.bounds) for scene, _, _ in segments]
    assert min(sizes) < 1000 * (SCALE[0] + 0.1)
    assert max(sizes) > 1000 * (SCALE[1] - 0.1)
    grounded = [scene.name.startswith("city") for scene, _, _ in segments]
    assert 10 < sum(grounded) < 50
    assert draw_segment(0, 1, "floating")[0].name.startswith("floating")


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--seed", "-1"], "--seed: -1"),
        (["--disturbed", "1.5"], "--disturbed: 1.5"),
        (["--held-out", "0"], "--held-out: 0"),
        (["--observation", "paper"], "--observation: paper"),
        (["--disturbed", "0.5", "--observation", "guided"], "--observation: guided"),
        (["--wind", "-2"], "wind: -2.0"),
        (["--shards", "-1"], "--shards: -1"),
        (["--ray", "local"], "--ray: needs --shards"),
    ],
)
def test_bad_settings_are_refused_before_anything_is_written(arguments, named, tmp_path, capsys):
    out = tmp_path / "out"
    assert generalist.main(["--out", str(out), *arguments]) == 2
    assert named in capsys.readouterr().err
    assert not out.exists()


def test_what_fails_is_drawn_more_often():
    args, numbers = generalist.Args(courses=2), list(range(10))
    chance = np.ones(10)
    chance[3] = generalist.HARDER
    drawn = [
        generalist.drawn(args, numbers, chance / chance.sum(), rotation, 0)
        for rotation in range(600)
    ]
    assert all(len(set(own)) == 2 for own in drawn)
    count = np.bincount(np.concatenate(drawn), minlength=10)
    others = np.delete(count, 3).mean()
    assert 2.5 < count[3] / others < 4.0


def test_learns_on_from_a_policy_in_disturbed_air(tmp_path):
    """And remembers which segments fail."""
    TrainedPolicy(make_actor(PATH, 8), "path").save(tmp_path / "calm.safetensors")
    out = tmp_path / "out"
    more = ["--observation", "robust", "--reward", "careful", "--disturbed", "0.5", "--policy"]
    argv = ["--out", str(out), *TINY, *more, str(tmp_path / "calm.safetensors")]
    assert generalist.main(argv) == 0
    config = json.loads((out / "config.json").read_text())
    assert config["policy"] == policy_digest(tmp_path / "calm.safetensors")
    assert TrainedPolicy.load(out / "policy.safetensors").observation == "robust"
