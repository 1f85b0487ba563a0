"""Takes the fields of a scene as what they must be: arrays, limits, moving boxes."""

from __future__ import annotations

from collections.abc import Mapping
from numbers import Real

import numpy as np

from mjcollect.geometry.compiled import Array
from mjcollect.scene.file_format import SceneError
from mjcollect.scene.moving import MovingBox

LIMIT_RANGE = (1e-6, 1e6)  # SI units; squares and sums of limits outside lose their digits


def array_of(field: str, value: object, shape: tuple[int, ...]) -> Array:
    """Returns a fresh, finite array; -1 in `shape` stands for any length, also 0.

    Raises:
        SceneError: it is not that, which names `field`.
    """
    try:
        array = np.array(value, dtype=np.float64)
        if array.size == 0 and shape[0] < 0:
            array = array.reshape(0, *shape[1:])
        if array.shape != tuple(
            have if want < 0 else want for want, have in zip(shape, array.shape, strict=True)
        ):
            raise ValueError
    except (TypeError, ValueError):
        wanted = " x ".join("N" if size < 0 else str(size) for size in shape)
        raise SceneError(field, value, f"needs {wanted} numbers") from None
    if not np.all(np.isfinite(array)):
        raise SceneError(field, array.tolist(), "must be finite numbers")
    return array


def moving_box_of(value: object) -> MovingBox:
    """Returns a moving box, which may be given as a document.

    Raises:
        SceneError: it is neither.
    """
    if isinstance(value, MovingBox):
        return value
    if isinstance(value, Mapping):
        try:
            return MovingBox.from_dict(value)
        except (TypeError, ValueError, KeyError):
            pass
    raise SceneError("moving", value, "needs boxes with size, path and speed")


def limit_of(field: str, value: object) -> float:
    """Returns a limit in SI units.

    Raises:
        SceneError: it is no number within LIMIT_RANGE, which names `field`.
    """
    low, high = LIMIT_RANGE
    if isinstance(value, bool) or not isinstance(value, Real) or not low <= float(value) <= high:
        raise SceneError(field, value, f"must be a positive number from {low:g} to {high:g}")
    return float(value)
