"""How kernels are compiled and cached, and the arrays that they are compiled for.

Numba's cache goes by the content of the file that a function is written in, and does not notice
that a function it calls has changed in another. So machine code is cached in a folder called by
a digest of all files of the package with compiled functions: another version never finds it.
"""

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numba.misc.appdirs import user_cache_dir
from numpy.typing import NDArray

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Indices = NDArray[np.intp]
F = TypeVar("F", bound=Callable[..., Any])
_PACKAGE = Path(__file__).parents[1]
_settings: Any = numba.config  # read when a function is decorated


def compiled(function: F, **options: Any) -> F:
    """Compile at the first call, cached on disk where there is a folder that can be written.

    Without fast-math, unless `options` for numba.njit ask for it: the same operations in the same
    order, so the same bits. Divisions by zero give inf or NaN. The function may call, and read
    constants of, files of the package that hold compiled functions, and its own: others are not in
    the digest.
    """
    options = {"nogil": True, "error_model": "numpy", **options}
    for folder in cache_folders(inspect.getfile(function)):
        try:
            with _caching_in(folder):
                return cast(F, numba.njit(cache=True, **options)(function))
        except RuntimeError:  # it cannot be written
            continue
    return cast(F, numba.njit(**options)(function))  # compiled anew in every process


@cache
def cache_folders(file: str) -> tuple[Path, ...]:
    """Where the machine code of a file's kernels may be cached, to be tried in this order.

    Below NUMBA_CACHE_DIR if that is set; else next to the package or in the user's cache.
    """
    try:
        name = "mjcollect-" + digest({*_files_with_kernels(), Path(file)})
    except OSError:  # not from a file, as at a prompt
        return ()
    if _settings.CACHE_DIR:
        return (Path(_settings.CACHE_DIR) / name,)
    return (_PACKAGE / "__pycache__" / name, Path(user_cache_dir("numba")) / name)


def _files_with_kernels() -> list[Path]:
    return [path for path in _PACKAGE.rglob("*.py") if b"@compiled" in path.read_bytes()]


def digest(sources: Iterable[Path]) -> str:
    """Of the names and the content of some files, in any order.

    Raises:
        OSError: one cannot be read.
    """
    whole = hashlib.sha256()
    for path in sorted(sources):
        whole.update(path.name.encode() + hashlib.sha256(path.read_bytes()).digest())
    return whole.hexdigest()[:16]


@contextmanager
def _caching_in(folder: Path) -> Iterator[None]:
    """Numba's cache is in `folder`, and nowhere else, for what is decorated meanwhile."""
    before = _settings.CACHE_DIR, _settings.CACHE_LOCATOR_CLASSES
    _settings.CACHE_DIR = str(folder)
    _settings.CACHE_LOCATOR_CLASSES = "UserProvidedCacheLocator"
    try:
        yield
    finally:
        _settings.CACHE_DIR, _settings.CACHE_LOCATOR_CLASSES = before


def plain(values: Any) -> Array:
    """Contiguous and writable float64: anything else would be compiled for once more."""
    array = np.ascontiguousarray(values, dtype=np.float64)
    return array if array.flags.writeable else array.copy()


def rows(values: Array, leading: tuple[int, ...], row: tuple[int, ...]) -> Array:
    """Broadcast to shape (*leading, *row), then flat over the leading axes, as `plain` has it."""
    whole = values if values.shape == leading + row else np.broadcast_to(values, leading + row)
    return plain(whole).reshape(-1, *row)
