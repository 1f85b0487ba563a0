"""Every program says what it takes, every module imports, and every public name is there."""

from __future__ import annotations

import importlib
import importlib.metadata
import os
import pkgutil
import runpy
import signal
import subprocess
import sys
from pathlib import Path

import pytest

import mjcollect
import train
from train.__main__ import PROGRAMS
from train.__main__ import main as console

ROOT = Path(__file__).parents[1]
EXTRAS = ("gymnasium", "stable_baselines3", "ray")  # optional, see pyproject.toml
WITHOUT_ARGUMENTS = ("train.warm_up",)
FACES = ("mjcollect", "mjcollect.scene", "mjcollect.render", "mjcollect.planners.reference")


def programs():
    """All that `python -m` runs, by name."""
    for package in ("mjcollect", "train", "benchmarks"):
        for file in sorted((ROOT / package).rglob("*.py")):
            if '\nif __name__ == "__main__":\n' in file.read_text(encoding="utf-8"):
                name = ".".join(file.relative_to(ROOT).with_suffix("").parts)
                yield name.removesuffix(".__main__")


def modules():
    """All modules of the packages that are installed."""
    for package in (mjcollect, train):
        for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            yield found.name


def load(name):
    """A module; the test is skipped where it needs an extra that is not installed."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name not in EXTRAS:
            raise
        pytest.skip(f"needs {error.name}")


@pytest.mark.filterwarnings("ignore:.*found in sys.modules:RuntimeWarning")
@pytest.mark.parametrize("name", [name for name in programs() if name not in WITHOUT_ARGUMENTS])
def test_help_is_printed(name, monkeypatch, capsys):
    load(name)
    monkeypatch.setattr(sys, "argv", [name, "--help"])
    with pytest.raises(SystemExit) as ended:
        runpy.run_module(name, run_name="__main__", alter_sys=True)
    assert ended.value.code in (None, 0)
    output = capsys.readouterr()
    assert "--help" in output.out
    assert output.err == ""


@pytest.mark.parametrize("name", PROGRAMS)
def test_the_console_command_runs_it(name, capsys):
    with pytest.raises(SystemExit) as ended:
        console([name, "--help"])
    assert ended.value.code in (None, 0)
    assert "--help" in capsys.readouterr().out


def test_the_console_command_has_all_programs_of_the_packages():
    named = {module.removesuffix(".__main__") for module in PROGRAMS.values()}
    others = {"train", *WITHOUT_ARGUMENTS}  # itself, and what is not for users
    assert named | others == {name for name in programs() if not name.startswith("benchmarks.")}


def test_the_console_command_refuses_what_it_does_not_know(capsys):
    assert console(["swim"]) == console([]) == 2
    output = capsys.readouterr()
    assert "'swim'" in output.err
    assert output.out == ""


def test_the_console_command_says_its_version(capsys):
    assert console(["--version"]) == 0
    assert capsys.readouterr().out.strip() == importlib.metadata.version("mjcollect")


def test_ctrl_c_while_a_program_loads_is_one_line(monkeypatch, capsys):
    def stopped(name):
        raise KeyboardInterrupt

    monkeypatch.setattr("train.__main__.importlib.import_module", stopped)
    assert console(["fly"]) == 130
    assert capsys.readouterr().err == "interrupted\n"
    ran = subprocess.run(
        [sys.executable, "-c", "import train; raise KeyboardInterrupt"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert ran.returncode == -signal.SIGINT
    assert ran.stderr == "interrupted\n"


def test_a_backend_that_mujoco_does_not_know_is_refused_at_once():
    ran = subprocess.run(
        [sys.executable, "-m", "train.fly", "--scene", "scenario_1"],
        env={**os.environ, "MUJOCO_GL": "nonsense"}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert ran.returncode == 2
    assert ran.stderr.startswith("error: MUJOCO_GL: nonsense: must be egl, osmesa, glfw or disable")
    assert ran.stderr.count("\n") == 1


@pytest.mark.parametrize("name", ["mjcollect", "train", *modules()])
def test_every_module_has_the_public_names_that_it_lists(name):
    module = load(name)
    names = getattr(module, "__all__", [])
    assert len(set(names)) == len(names)
    for public in names:
        assert getattr(module, public) is not None


@pytest.mark.parametrize("name", FACES)
def test_faces_list_what_is_public(name):
    assert importlib.import_module(name).__all__
