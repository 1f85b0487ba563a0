"""How kernels are compiled, and the arrays that they are compiled for."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
F = TypeVar("F", bound=Callable[..., Any])


def compiled(function: F, **options: Any) -> F:
    """Compile at the first call, cached on disk where there is a folder that can be written.

    Without fast-math, unless `options` for numba.njit ask for it: the same operations in the same
    order, so the same bits. Divisions by zero give inf or NaN.
    """
    try:
        made = numba.njit(cache=True, nogil=True, error_model="numpy", **options)(function)
    except RuntimeError:  # no such folder: compiled anew in every process
        made = numba.njit(nogil=True, error_model="numpy", **options)(function)
    return cast(F, made)


def plain(values: Any) -> Array:
    """Contiguous and writable float64: anything else would be compiled for once more."""
    array = np.ascontiguousarray(values, dtype=np.float64)
    return array if array.flags.writeable else array.copy()


def rows(values: Array, leading: tuple[int, ...], row: tuple[int, ...]) -> Array:
    """Broadcast to shape (*leading, *row), then flat over the leading axes, as `plain` has it."""
    whole = values if values.shape == leading + row else np.broadcast_to(values, leading + row)
    return plain(whole).reshape(-1, *row)
