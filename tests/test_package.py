"""What an installation promises: light import, pinned dependencies, licences, no need of LKH.

`make package` builds and installs the package itself.
"""

from __future__ import annotations

import ast
import runpy
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement

import mjcollect
from mjcollect.generate import generate
from mjcollect.generate.buildings import read_buildings
from mjcollect.planners.assignment import assign
from mjcollect.scene.file_format import SceneError
from mjcollect.scene.order import distances
from mjcollect.scene.place import Frame, Origin
from mjcollect.scene.scene import Scene
from train.__main__ import main as console
from train.jobs.segment_pool import draw_segment
from train.jobs.workers import connect_ray
from train.support.run_folder import RunError

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
LICENCES = runpy.run_path(str(ROOT / "scripts" / "licences.py"))
HEAVY = {"torch", "torchrl", "tensordict", "mujoco", "dm_control", "numba", "scipy", "numpy",
         "matplotlib", "OpenGL", "glfw", "ray", "elkai", "pyvrp"}  # fmt: skip


def test_importing_the_package_imports_nothing_heavy():
    def after(code: str) -> set[str]:
        command = [sys.executable, "-c", f"import sys, mjcollect; {code}; print(*sys.modules)"]
        told = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
        return {name.split(".")[0] for name in told.stdout.split()}

    assert not after("dir(mjcollect)") & HEAVY
    assert after("mjcollect.Scene") & HEAVY  # so the names are right


def test_type_checkers_see_the_names_that_load_lazily():
    tree = ast.parse((ROOT / "mjcollect" / "__init__.py").read_text(encoding="utf-8"))
    (block,) = (node for node in tree.body if isinstance(node, ast.If))
    seen = {
        alias.asname: node.module
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert seen == mjcollect._HOME
    assert set(seen) <= set(dir(mjcollect))


def test_the_version_is_the_same_everywhere():
    assert PROJECT["version"] == mjcollect.__version__


def test_every_dependency_is_pinned():
    extras = PROJECT["optional-dependencies"].values()
    for line in [*PROJECT["dependencies"], *(line for extra in extras for line in extra)]:
        (pin,) = Requirement(line).specifier
        assert pin.operator == "==", line


def test_extras_and_development_pin_the_same_versions():
    lines = [*PROJECT["dependencies"]]
    for extra in PROJECT["optional-dependencies"].values():
        lines += extra
    pins = {}
    for requirement in map(Requirement, lines):
        assert pins.setdefault(requirement.name, requirement.specifier) == requirement.specifier


def test_the_page_of_licences_is_up_to_date():
    page = LICENCES["PAGE"].read_text(encoding="utf-8")
    assert LICENCES["page"](page) == page, "run: python scripts/licences.py --write"


def test_only_elkai_has_terms_of_its_own():
    free = ("MIT", "BSD", "Apache", "Python Software Foundation", "PSF", "MPL", "ISC", "0BSD")
    terms = {name: terms for name, _, terms in LICENCES["rows"](LICENCES["all_needed"]())}
    assert len(terms) > 50
    others = {name for name, text in terms.items() if not any(word in text for word in free)}
    # Two leave the field blank: ptyprocess is under the ISC licence, mergedeep under MIT's.
    assert others - {"ptyprocess", "mergedeep"} == {"elkai"}


def test_without_lkh_all_but_its_order_works(monkeypatch, tmp_path, capsys):
    """`make package` takes elkai away for good."""
    monkeypatch.setitem(sys.modules, "elkai", None)
    many = tmp_path / "many.json"
    generate(0, 14, 2, "floating").save(many)
    for arguments, code in (
        (["scene", "scenario_1"], 2),
        (["scene", "scenario_1", "--order", "exact"], 0),
        (["scene", str(many), "--order", "exact"], 2),
        (["scene", str(many), "--order", "search"], 0),
        (["fly", "--scene", "scenario_1"], 2),
    ):
        assert console(arguments) == code
        error = capsys.readouterr().err
        assert ("--order" in error and "search" in error) == (code == 2)
    cost = distances(Scene.find(str(many)))
    for uavs in (1, 3):
        tours = assign(cost, uavs)
        assert sorted(item for tour in tours for item in tour) == list(range(14))
    draw_segment(0, 0)


def test_a_missing_extra_is_named(monkeypatch, tmp_path, capsys):
    """The fleet's has a test beside its environment."""
    for package in ("ray", "pyproj", "osmium", "shapely"):
        monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(RunError, match=r"--ray: .*'mjcollect\[ray\]'"):
        connect_ray("local")
    with pytest.raises(SceneError, match=r"pyproj.*'mjcollect\[geo\]'"):
        Frame(Origin(1.0, 2.0, 0.0))
    city = tmp_path / "city.osm"
    city.write_text("<osm/>")
    with pytest.raises(SceneError, match=r"osmium.*'mjcollect\[geo\]'"):
        list(read_buildings(city))
    monkeypatch.delitem(sys.modules, "mjcollect.generate.import_place", raising=False)
    assert console(["import", str(city), "--center", "1", "2", "--out", str(tmp_path)]) == 2
    assert "error: import: real places need" in capsys.readouterr().err
