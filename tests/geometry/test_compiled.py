"""How kernels are compiled and where the machine code is cached."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable
from pathlib import Path

import numba
import numpy as np
import pytest

from mjcollect.geometry import compiled
from mjcollect.geometry.compiled import plain, rows

INNER = """
from mjcollect.geometry.compiled import compiled
@compiled
def inner(x):
    return {} * x
"""
OUTER = """
from mjcollect.geometry.compiled import compiled
from two_kernels_inner import inner
@compiled
def outer(x):
    return inner(x) + 1
"""


def forget() -> None:
    """What a process has read of the files so far."""
    compiled.cache_folders.cache_clear()
    compiled._files_with_kernels.cache_clear()


@pytest.fixture
def package(tmp_path, monkeypatch) -> Path:
    """Stands for the package's folder: two kernels in two files, and a cache of the user's."""
    package = tmp_path / "package"
    (package / "kernels").mkdir(parents=True)
    (package / "kernels" / "inner.py").write_text(INNER.format(2))
    (package / "kernels" / "outer.py").write_text(OUTER)
    monkeypatch.setattr(compiled, "_PACKAGE", package)
    monkeypatch.setattr(compiled, "user_cache_dir", lambda name: str(tmp_path / "user" / name))
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    forget()
    yield package
    forget()


def fresh(package: Path, monkeypatch) -> Callable[[int], int]:
    """The kernel `outer` as a new process has it."""
    forget()
    for name in ("inner", "outer"):
        file = package / "kernels" / f"{name}.py"
        spec = importlib.util.spec_from_file_location(f"two_kernels_{name}", file)
        module = importlib.util.module_from_spec(spec)
        monkeypatch.setitem(sys.modules, spec.name, module)
        # Not by the loader: its own cache goes by the second in which a file was written.
        exec(compile(file.read_text(), str(file), "exec"), vars(module))
    return module.outer


def cached(root: Path) -> list[Path]:
    return [folder for folder in root.glob("mjcollect-*") if list(folder.rglob("outer*.nbc"))]


def test_a_change_in_a_file_that_is_called_is_noticed(package, monkeypatch):
    """By numba alone it is not: it would load the kernel that still doubles."""
    found = []
    for factor in (2, 2, 3, 2):
        (package / "kernels" / "inner.py").write_text(INNER.format(factor))
        outer = fresh(package, monkeypatch)
        found.append((outer(10), sum(outer.stats.cache_hits.values())))
    assert found == [(21, 0), (21, 1), (31, 0), (21, 1)]
    assert len(cached(package / "__pycache__")) == 2
    assert not list((package / "kernels").rglob("*.nbi"))


def test_the_folder_follows_every_kernel_and_the_own_file(package, tmp_path):
    kernel, other = package / "kernels" / "outer.py", tmp_path / "other.py"
    other.write_text("")

    def folder(file=kernel):
        forget()
        return compiled.cache_folders(str(file))[0]

    seen = [folder()]
    assert folder(package / "kernels" / "inner.py") == seen[0]  # one for all of the folder's
    for change in (
        lambda: (package / "kernels" / "inner.py").write_text(INNER.format(4)),
        lambda: kernel.write_text(OUTER + "\n"),
        lambda: (package / "kernels" / "new.py").write_text("@compiled"),
        lambda: (package / "kernels" / "new.py").rename(package / "kernels" / "renamed.py"),
    ):
        change()
        seen.append(folder())
    seen += [folder(other)]
    other.write_text("# changed")
    seen += [folder(other)]
    assert len(set(seen)) == len(seen)
    (package / "without_kernels.py").touch()
    assert folder(other) == seen[-1]


def test_names_do_not_run_into_contents(tmp_path):
    digests = set()
    for index, names in enumerate([("a", "bc"), ("ab", "c"), ("bc", "a")]):
        for content, name in zip(("1", "2"), names, strict=True):
            (tmp_path / str(index)).mkdir(exist_ok=True)
            (tmp_path / str(index) / name).write_text(content)
        files = list((tmp_path / str(index)).iterdir())
        digests |= {compiled.digest(files), compiled.digest(files[::-1])}
    assert len(digests) == 3


def test_the_user_s_cache_is_next_then_none(package, tmp_path, monkeypatch):
    (package / "__pycache__").write_text("no folder can be made here")
    assert fresh(package, monkeypatch)(10) == 21
    assert len(cached(tmp_path / "user" / "numba")) == 1
    monkeypatch.setattr(compiled, "user_cache_dir", lambda name: str(package / "__pycache__"))
    outer = fresh(package, monkeypatch)
    assert (outer(10), outer.stats.cache_path) == (21, None)


def test_a_folder_that_is_asked_for_is_used_and_numba_s_settings_stay(
    package, tmp_path, monkeypatch
):
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "asked"))
    before = numba.config.CACHE_DIR, numba.config.CACHE_LOCATOR_CLASSES
    assert fresh(package, monkeypatch)(10) == 21
    assert len(cached(tmp_path / "asked")) == 1
    assert not (package / "__pycache__").exists()
    assert before == (numba.config.CACHE_DIR, numba.config.CACHE_LOCATOR_CLASSES)


def test_without_a_folder_for_the_cache_it_compiles_all_the_same(monkeypatch):
    njit = numba.njit

    def no_folder(**options):
        if options.pop("cache", False):
            raise RuntimeError("no locator available")
        return njit(**options)

    monkeypatch.setattr(numba, "njit", no_folder)
    assert compiled.compiled(lambda x: x + 1)(2) == 3


def test_arrays_are_made_plain():
    fixed = np.ones((2, 3))
    fixed.setflags(write=False)
    for array in (fixed, np.ones((4, 3))[::2], np.ones((3, 2)).T, [[1, 1, 1], [1, 1, 1]]):
        made = plain(array)
        assert made.flags.c_contiguous
        assert made.flags.writeable
        np.testing.assert_array_equal(made, 1.0)
    assert plain(made) is made
    assert rows(np.arange(3.0), (2, 4), (3,)).shape == (8, 3)
