"""The scripts of examples/, in their quick modes and a small scene where they take one."""

from __future__ import annotations

import dataclasses
import importlib.util
import re
import sys
from pathlib import Path
from types import ModuleType

import pytest
import tyro

from mjcollect.envs.batch import Simulations
from mjcollect.envs.course import Course
from mjcollect.envs.episode import Rules
from mjcollect.scene.order import plan_order
from mjcollect.scene.scene import Scene
from mjcollect.scene.trajectory import Trajectory
from mjcollect.verify import verify

EXAMPLES = Path(__file__).parents[1] / "examples"
NAMES = sorted(path.stem for path in EXAMPLES.glob("*.py"))


def load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"example_{name}", EXAMPLES / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # tyro and dataclasses look their module up
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def small(corridor: Scene, tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("scene") / "corridor.json"
    corridor.save(path)
    return str(path)


@pytest.mark.parametrize("name", NAMES)
def test_every_example_is_short_listed_and_explains_its_flags(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (EXAMPLES / f"{name}.py").read_text(encoding="utf-8")
    assert len(text.splitlines()) < 120
    assert f"]({name}.py)" in (EXAMPLES / "README.md").read_text(encoding="utf-8")
    with pytest.raises(SystemExit):
        tyro.cli(load(name).Args, args=["--help"])
    assert "--quick" in capsys.readouterr().out
    for field in dataclasses.fields(load(name).Args):
        assert re.search(rf'^    {field.name}: .*\n    """', text, re.MULTILINE), field.name


def test_own_scene_is_flown_without_a_fault(tmp_path: Path) -> None:
    example = load("own_scene_to_mission")
    fine = example.main(example.Args(out=tmp_path, quick=True))
    assert fine == {"policy": True, "guidance law": True}
    scene = Scene.load(tmp_path / "yard.json")
    order = plan_order(scene, "lkh")
    for file in ("policy.csv", "guidance_law.csv"):
        assert verify(scene, Trajectory.load(tmp_path / file), order) == []


def test_own_scene_that_cannot_be_flown_is_refused_with_the_fix(tmp_path: Path) -> None:
    example = load("own_scene_to_mission")
    with pytest.raises(SystemExit, match=r"error: v_max: .* must be a positive"):
        example.main(example.Args(out=tmp_path, v_max=0.0))


@pytest.fixture
def own_reward(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    example = load("own_reward")
    monkeypatch.setitem(example.PRESETS, "progress", None)  # and have it removed afterwards
    return example


def test_own_reward_pays_for_the_way_that_got_shorter(
    own_reward: ModuleType, blocked_course: Course
) -> None:
    own_reward.PRESETS["progress"] = own_reward.Preset(own_reward.progress_reward, True)
    sims = Simulations([blocked_course], 1, rules=Rules(reward="progress"))
    sims.reset()
    guide, scene = blocked_course.guidance[0], blocked_course.scene
    begin = guide.query(sims.episodes.q)[0][0]
    paid, slots, outcome = 0.0, 0, None
    while outcome is None or not outcome.success[0]:
        outcome = sims.step(sims.law())
        paid, slots = paid + float(outcome.reward[0]), slots + 1
    gained = begin - guide.query(sims.path[:, -1])[0][0]
    sims.close()
    assert paid == pytest.approx(gained / scene.v_max - slots * scene.slot + 1.0, abs=1e-6)


def test_own_reward_learns_with_both_rewards(own_reward: ModuleType, small: str) -> None:
    best = own_reward.main(own_reward.Args(scene=small, segment=0, quick=True))
    assert set(best) == {"progress", "lost"}
    assert best["progress"].mean_return != best["lost"].mean_return


@pytest.mark.slow
def test_own_reward_teaches_to_arrive_from_everywhere(own_reward: ModuleType) -> None:
    best = own_reward.main(own_reward.Args())
    assert best["progress"].success_rate == 1.0


def test_own_learner_improves(small: str) -> None:
    example = load("own_learner")
    returns = example.main(example.Args(scene=small, segment=0, quick=True))
    assert max(returns[-2:]) > returns[0] + 1.0  # seconds lost by the elite


@pytest.mark.slow
def test_own_learner_learns_to_arrive(capsys: pytest.CaptureFixture[str]) -> None:
    example = load("own_learner")
    returns = example.main(example.Args())
    assert returns[-1] > -3.0
    arrive = re.findall(r"(\d+) of 128 arrive", capsys.readouterr().out)
    assert int(arrive[0]) == 0
    assert int(arrive[-1]) > 64
