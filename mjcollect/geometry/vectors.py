"""Computes with vectors (3,), in compiled functions."""

from __future__ import annotations

import math

from mjcollect.geometry.compiled import Array, compiled


@compiled
def dot(a: Array, b: Array) -> float:
    """Returns the scalar product of two vectors."""
    return float(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


@compiled
def norm(a: Array) -> float:
    """Returns the length of a vector."""
    return math.sqrt(dot(a, a))


@compiled
def unit(vector: Array, to: Array) -> float:
    """Returns the length of a vector; writes its direction to `to`, zero if it has none."""
    size = norm(vector)
    for k in range(3):
        to[k] = vector[k] / size if size > 1e-9 else 0.0
    return size


@compiled
def into_ball(vector: Array, radius: float) -> None:
    """Shortens a vector to `radius` if it is longer."""
    size = norm(vector)
    if size > radius:
        for k in range(3):
            vector[k] = vector[k] * (radius / size)


@compiled
def from_ball(normal: Array, share: float, vector: Array) -> None:
    """Writes a point of the unit ball to `vector`: uniform for N(0, 1) normals, U(0, 1) shares."""
    size = norm(normal)
    for k in range(3):
        vector[k] = normal[k] / size * share ** (1 / 3)


@compiled
def lerp(a: float, b: float, share: float) -> float:
    """Returns the value that lies `share` of the way from `a` to `b`."""
    return a + share * (b - a)


@compiled
def hull(points: Array, count: int, low: Array, high: Array) -> None:
    """Writes the least and greatest coordinates (3,) of the first `count` points (..., 3)."""
    low[:], high[:] = points[0], points[0]
    for p in range(1, count):
        for k in range(3):
            low[k], high[k] = min(low[k], points[p, k]), max(high[k], points[p, k])
