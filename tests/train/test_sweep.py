"""`python -m examples.sweep`, with tiny trainings: mostly in this process, and once in others."""

import csv
import json
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import optuna
import pytest

from examples.sweep import __main__ as sweep
from examples.sweep import training as sweep_training
from examples.sweep.report import Result, ranked, verdict
from mjcollect.learning.config import LearnConfig

TINY = (  # noqa: SIM905 - reads like the command line
    "--trials 3 --seeds 2 --again 1 --updates 32 --evaluations 2 --judged 2 --envs 8 "
    "--demonstrations 300 --jobs 1"
).split()


@pytest.fixture(scope="module", autouse=True)
def _small_evaluations():
    """Trainings that evaluate from two starts; `LearnConfig` has no smaller networks by itself."""
    with pytest.MonkeyPatch.context() as patch:
        usual = LearnConfig

        def small(**settings):
            return usual(**{"eval_episodes": 2, "width": 8, "buffer": 2_500, **settings})

        patch.setattr(sweep, "LearnConfig", small)
        yield


def run(scene_file, out, *more):
    return sweep.main(["--scene", str(scene_file), "--out", str(out), *TINY, *more])


def rows(out):
    return list(csv.DictReader((out / "sweep.csv").open()))


def but_seconds(out):
    return [{key: value for key, value in row.items() if key != "seconds"} for row in rows(out)]


@pytest.fixture(scope="module")
def in_process():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sweep_training, "importing_pool", lambda _: ThreadPoolExecutor(1))
        yield


@pytest.fixture(scope="module")
def finished(scene_file, tmp_path_factory, in_process):
    out = tmp_path_factory.mktemp("runs") / "sweep"
    assert run(scene_file, out) == 0
    return out


def test_the_table_says_what_the_study_holds(finished):
    journal = optuna.storages.journal.JournalFileBackend(str(finished / "study.journal"))
    study = optuna.load_study(study_name="sweep", storage=optuna.storages.JournalStorage(journal))
    found = {int(row["trial"]): row for row in rows(finished)}
    assert sorted(found) == [0, 1, 2]
    for trial in study.trials:
        row = found[trial.number]
        assert {name: float(row[name]) for name in trial.params} == trial.params
        scores = [float(row["score_0"]), float(row["score_1"])]
        assert scores[0] != scores[1] or scores[0] == 3.0  # the seeds differ
        assert float(row["mean"]) == pytest.approx(trial.value) == pytest.approx(np.mean(scores))
        assert float(row["spread"]) == pytest.approx(np.std(scores, ddof=1))
    assert {name: float(found[0][name]) for name in sweep.USUAL} == sweep.USUAL
    assert len({row["alpha_actor"] for row in found.values()}) == 3
    means = [float(row["mean"]) for row in rows(finished)]
    assert means == sorted(means)
    text = (finished / "sweep.md").read_text()
    assert text.count("\n| ") == 3
    assert "0 (usual)" in text
    assert (finished / "sweep.png").stat().st_size > 10_000


def test_stopped_twice_it_goes_on_to_the_same_table(finished, scene_file, tmp_path, monkeypatch):
    """Ctrl-C in trial 0 and in trial 2; the seconds differ."""
    out = tmp_path / "out"
    try_settings, calls = sweep.try_settings, []

    def stopped(study, crew, task, args):
        calls.append(1)
        if len(calls) in (1, 4):
            study.ask()
            raise KeyboardInterrupt
        try_settings(study, crew, task, args)

    monkeypatch.setattr(sweep, "try_settings", stopped)
    assert run(scene_file, out) == 130
    assert run(scene_file, out) == 2  # not empty
    assert run(scene_file, out, "--resume") == 130
    assert not (out / "sweep.csv").exists()
    assert run(scene_file, out, "--resume") == 0
    assert but_seconds(out) == but_seconds(finished)
    assert (out / "sweep.md").read_text().split("\n\n")[1:] == (
        (finished / "sweep.md").read_text().split("\n\n")[1:]
    )


def test_it_does_not_go_on_with_other_updates(finished, scene_file, capsys):
    assert run(scene_file, finished, "--resume", "--updates", "64") == 2
    assert "--resume: updates: 64 differs from 32" in capsys.readouterr().err


def test_a_pruned_trial_stops_and_is_ranked_last(scene_file, tmp_path, monkeypatch, in_process):
    """The pruner says so at the first evaluation of the last trial."""
    monkeypatch.setattr(optuna.Trial, "should_prune", lambda trial: trial.number == 1)
    assert run(scene_file, tmp_path / "out", "--trials", "2") == 0
    last = rows(tmp_path / "out")[-1]
    assert (last["trial"], last["pruned"], last["success"]) == ("1", "1", "")
    assert "pruned at evaluation 1" in (tmp_path / "out/sweep.md").read_text()


def result(number, scores, pruned=None):
    return Result(number, {"gamma": 0.9}, scores, 1.0, pruned, 1.0)


def test_the_verdict_weighs_the_gain_against_its_standard_error():
    found = ranked([result(0, [1.2, 1.2]), result(1, [1.1, 1.1]), result(2, [1.0, 1.0], pruned=3)])
    assert [row.number for row in found] == [1, 0, 2]

    def said(best, usual):
        return " ".join(verdict(found, {1: best, 0: usual}, 1.0))

    assert "a clear difference" in said([1.10, 1.11, 1.12], [1.20, 1.21, 1.22])
    unclear = said([1.0, 1.2, 1.4], [1.1, 1.3, 1.5])
    # Each mean has the standard error 0.2 / sqrt(3).
    assert "gains +0.100 with a standard error of 0.163: no clear difference" in unclear
    assert "a clear difference" in said([1.20, 1.21, 1.22], [1.10, 1.11, 1.12])  # for the worse
    assert "Nothing was better" in verdict(found[1:], {}, 1.0)[-1]


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--trials", "0"], "--trials: 0: must be at least 1"),
        (["--seeds", "1"], "--seeds: 1: must be at least 2"),
        (["--segment", "9"], "--segment: 9: must be 0 to 2"),
        (["--evaluations", "33"], "--evaluations: 33"),
    ],
)
def test_bad_arguments_write_nothing(scene_file, tmp_path, capsys, more, message):
    assert run(scene_file, tmp_path / "out", *more) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_quick_in_processes_is_the_same_however_many(tmp_path):
    one, two = tmp_path / "one", tmp_path / "two"
    for out, jobs in ((one, "1"), (two, "2")):
        assert sweep.main(["--quick", "--out", str(out), "--jobs", jobs]) == 0
    assert but_seconds(one) == but_seconds(two)
    assert json.loads((one / "config.json").read_text())["updates"] == sweep.QUICK.updates
