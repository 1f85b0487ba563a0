"""Compiles functions with numba, caches them, and names the arrays that they are compiled for.

Numba's cache goes by the content of the file in which a function is written; it does not notice
that a function it calls has changed in another file. So machine code is cached in a folder named by
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
    """Compiles a function at its first call, and caches it on disk where a folder can be written.

    Fast-math is off unless `options` for numba.njit ask for it: the same operations in the same
    order give the same bits. Divisions by zero give inf or NaN. The function may use functions and
    constants of its own file and of the package's other files with compiled functions only: the
    digest does not cover any more.
    """
    options = {"nogil": True, "error_model": "numpy", **options}
    for folder in cache_folders(inspect.getfile(function)):
        try:
            with _caching_in(folder):
                return cast(F, numba.njit(cache=True, **options)(function))
        except RuntimeError:  # the folder cannot be written
            continue
    return cast(F, numba.njit(**options)(function))  # compiled anew in every process


@cache
def cache_folders(file: str) -> tuple[Path, ...]:
    """Returns the folders for the machine code of a file's functions, to be tried in this order.

    They lie below NUMBA_CACHE_DIR if that is set, else next to the package or in the user's cache.
    """
    try:
        name = "mjcollect-" + digest({*_files_with_kernels(), Path(file)})
    except OSError:  # the function stands in no file, as at a prompt
        return ()
    if _settings.CACHE_DIR:
        return (Path(_settings.CACHE_DIR) / name,)
    return (_PACKAGE / "__pycache__" / name, Path(user_cache_dir("numba")) / name)


@cache  # They are asked for once for each file with compiled functions, whenever mjcollect starts.
def _files_with_kernels() -> list[Path]:
    return [path for path in _PACKAGE.glob("*/*.py") if b"@compiled" in path.read_bytes()]


def digest(sources: Iterable[Path]) -> str:
    """Returns a hash of the names and contents of some files, whatever their order.

    Raises:
        OSError: a file cannot be read.
    """
    whole = hashlib.sha256()
    for path in sorted(sources):
        whole.update(path.name.encode() + hashlib.sha256(path.read_bytes()).digest())
    return whole.hexdigest()[:16]


@contextmanager
def _caching_in(folder: Path) -> Iterator[None]:
    """Has numba cache in `folder`, and nowhere else, the functions that are decorated meanwhile."""
    before = _settings.CACHE_DIR, _settings.CACHE_LOCATOR_CLASSES
    _settings.CACHE_DIR = str(folder)
    _settings.CACHE_LOCATOR_CLASSES = "UserProvidedCacheLocator"
    try:
        yield
    finally:
        _settings.CACHE_DIR, _settings.CACHE_LOCATOR_CLASSES = before


def plain(values: Any) -> Array:
    """Returns contiguous, writable float64, since any other array would be compiled for anew."""
    array = np.ascontiguousarray(values, dtype=np.float64)
    return array if array.flags.writeable else array.copy()


def rows(values: Array, leading: tuple[int, ...], row: tuple[int, ...]) -> Array:
    """Returns values broadcast to (*leading, *row), flat over the leading axes, and `plain`."""
    whole = values if values.shape == leading + row else np.broadcast_to(values, leading + row)
    return plain(whole).reshape(-1, *row)
