"""`benchmarks.deviations`: what it runs and what it makes of the results; nothing is learned."""

import dataclasses
import json
import re
from pathlib import Path
from types import SimpleNamespace

import pytest
import tyro

from benchmarks import deviations
from benchmarks.deviations import CHANGES, OURS, Args, plan, row, table
from mjcollect.learning.config import LearnConfig
from train.jobs.workers import Done
from train.segment import Args as SegmentArgs
from train.support.presets import PAPER, with_preset

BUT_ONE = ("all but 13",)
PAGE = Path(__file__).parents[2] / "docs" / "deviations.md"


def settings(change):
    cell = deviations.Cell(change, "scenario_1", 3, 0, 2500)
    defaults = with_preset(SegmentArgs, cell.arguments)
    return tyro.cli(SegmentArgs, args=cell.arguments, default=defaults)


def differing(change):
    ours, theirs = settings(OURS), settings(change)
    names = [field.name for field in dataclasses.fields(LearnConfig)]
    found = {n for n in names if getattr(ours.learn, n) != getattr(theirs.learn, n)}
    return found | ({"slot"} if ours.slot != theirs.slot else set())


def test_one_thing_is_changed_at_a_time():
    single = [change for change in CHANGES if change.number not in ("", "all", *BUT_ONE)]
    for change in single:
        fields = differing(change)
        flags = (part for part in change.flags if part.startswith("--"))
        named = {flag.removeprefix("--").removeprefix("no-").replace("-", "_") for flag in flags}
        assert fields == named | ({"slot"} if change.slot else set())
        for field in fields - {"slot"}:
            assert getattr(settings(change).learn, field) == PAPER[field]
    sets = [frozenset(differing(change)) for change in single]
    assert len(set(sets)) == len(sets)


def test_all_at_once_is_the_preset():
    whole = [change for change in CHANGES if change.number == "all"]
    assert [settings(change).slot for change in whole] == [0.2, 1.0]
    for change in whole:
        learn = settings(change).learn
        assert {name: getattr(learn, name, 0) for name in PAPER} == PAPER


def test_all_but_the_shield_is_the_preset_with_it():
    (change,) = [change for change in CHANGES if change.number in BUT_ONE]
    (whole,) = [each for each in CHANGES if each.number == "all" and each.slot == change.slot]
    assert settings(change).learn == dataclasses.replace(settings(whole).learn, shield=True)


def test_numbers_are_those_of_the_page():
    numbered = set(re.findall(r"^(\d+)\. ", PAGE.read_text(), flags=re.MULTILINE))
    for change in CHANGES:
        if change.number not in ("", "all", *BUT_ONE):
            assert set(change.number.split(", ")) <= numbered


def test_the_default_plan_is_affordable_and_has_no_cell_twice():
    cells = plan(Args())
    assert len(cells) <= 70
    assert len({cell.command for cell in cells}) == len(cells)
    assert {cell.segment for cell in cells if cell.scene == "scenario_1"} == {3}  # first blocked


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (Args(segments=("scenario_1:9",)), "scenario_1:9.*0 to 4"),
        (Args(segments=("scenario_1:x",)), "scenario_1:x"),
        (Args(only=(99,)), "only"),
        (Args(segments=("nowhere",)), "nowhere"),
    ],
)
def test_bad_arguments_are_named(args, message):
    with pytest.raises(ValueError, match=message):
        plan(args)


def result(success, time, rate=1.0):
    found = dict.fromkeys(deviations.KEPT, 0)
    return found | {
        "success": success, "time": time, "detour_time": 10.0, "success_rate": rate,
        "updates": 100, "train_seconds": 3.0,
    }  # fmt: skip


def test_table_pairs_segments_and_seeds():
    times = {  # by change, then seed
        OURS: [result(True, 10.0), result(True, 20.0), result(False, None, 0.5)],
        CHANGES[2]: [result(True, 11.0), result(False, None, 0.0), result(True, 40.0)],
        CHANGES[3]: [result(False, None, 0.0)] * 3,
    }
    rows = [
        row(deviations.Cell(change, "scenario_1", 3, seed, 100), each)
        for change, results in times.items()
        for seed, each in enumerate(results)
    ]
    lines = table(rows)[2:]
    assert [re.split(r" *\| *", line)[1:-1] for line in lines] == [
        ["-", "our settings", "2 of 3", "0.83", "1.500", "+0.0 %", "100", "3"],
        # Only seed 0 arrived with both: 11 s against 10 s.
        ["7", "paper's reward", "2 of 3", "0.67", "2.550", "+10.0 %", "100", "3"],
        ["8", CHANGES[3].name, "0 of 3", "0.00", "-", "-", "100", "3"],
    ]


def test_goes_on_where_it_stopped(tmp_path, monkeypatch):
    """An error leaves its cell out, which is run again; nothing else is."""
    asked = []

    def run_jobs(workers, jobs, finished):
        for job in jobs:
            asked.append(job.arguments)
            job.folder.mkdir()
            if len(asked) != 2:
                (job.folder / "segment.json").write_text(json.dumps(result(True, 12.0)))
            finished(Done(job, 0, "message"))
        return True

    monkeypatch.setattr(deviations, "run_jobs", run_jobs)
    course = SimpleNamespace(save_guidance=lambda folder: None)
    monkeypatch.setattr(
        deviations, "Course", SimpleNamespace(segment=lambda scene, order, index: course)
    )
    args = Args(segments=("scenario_1",), only=(0, 2), out=tmp_path / "all.json")
    assert deviations.main(args) == 1
    assert len(asked) == 4
    assert len(json.loads(args.out.read_text())["results"]) == 3
    assert deviations.main(args) == 0
    assert len(asked) == 5
    assert asked[4][:-1] == asked[1][:-1]  # the last is in a temporary folder
    assert len(json.loads(args.out.read_text())["results"]) == 4
