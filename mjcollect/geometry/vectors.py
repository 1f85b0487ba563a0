"""Compiled functions of vectors (3,)."""

from __future__ import annotations

import math

from mjcollect.geometry.compiled import Array, compiled


@compiled
def dot(a: Array, b: Array) -> float:
    """Scalar product."""
    return float(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


@compiled
def norm(a: Array) -> float:
    """Length."""
    return math.sqrt(dot(a, a))


@compiled
def unit(vector: Array, to: Array) -> float:
    """Length of a vector; `to` becomes its direction, or zero."""
    size = norm(vector)
    for k in range(3):
        to[k] = vector[k] / size if size > 1e-9 else 0.0
    return size


@compiled
def into_ball(vector: Array, radius: float) -> None:
    """Shorten a vector to `radius`."""
    size = norm(vector)
    if size > radius:
        for k in range(3):
            vector[k] = vector[k] * (radius / size)


@compiled
def from_ball(normal: Array, share: float, vector: Array) -> None:
    """A point of the unit ball, uniform if `normal` (3,) and `share` come from N(0, 1), U(0, 1)."""
    size = norm(normal)
    for k in range(3):
        vector[k] = normal[k] / size * share ** (1 / 3)


@compiled
def lerp(a: float, b: float, share: float) -> float:
    """From `a` to `b`."""
    return a + share * (b - a)
