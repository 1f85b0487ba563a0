"""Keeps the UAVs of a fleet apart: where each will be if it flies its backup, and who met whom.

A fleet's rows lie one after the other, M to a fleet. All know each other's backups, and decide one
after the other, the first one first. A command is flown only if its backup keeps apart from the
backups of all others at every instant: new ones of those before, and those of the slot before of
those behind. So the backup that each has flies on, if nothing else can, and nobody ever meets: a
chain of commitments as in decentralised receding-horizon control (Schouwenaars, How and Feron
2004).
"""

from __future__ import annotations

import math

import numpy as np

from mjcollect.flight.projection import project_row
from mjcollect.flight.world import World, scene_of
from mjcollect.geometry.compiled import Array, Bools, Indices, compiled, plain
from mjcollect.geometry.vectors import dot, norm, unit

SIGHT = 150.0  # units of the scene within which UAVs see each other
SHOWN = 3  # So many others are shown to a policy, the nearest ones,
SEEN = 7  # each by so many numbers.
NEAR = 1e-6  # metres by which rounding may bring two UAVs nearer than they keep apart
SURE_SIDE = 0.1  # A plan passes on a side if it passes by this share of what they keep apart.
SHARE_AHEAD = 0.7  # Going past, at most this share of a_max brakes.


@compiled
def longest_plan(world: World, slots: int) -> int:
    """Returns the greatest number of points of a `plan_row` that flies `slots` slots first."""
    most = 0
    for w in range(len(world.v_max)):
        braking = math.ceil(world.v_max[w, 0] / (world.a_max[w, 0] * world.slot) + 1e-9)
        most = max(most, int(braking) + 1)
    return (slots + most) * world.substeps + 1


@compiled
def plan_row(world: World, w: int, q: Array, v: Array, a: Array, slots: int, path: Array) -> int:
    """Writes `slots` slots of the command `a` (3,) and full braking to `path` (..., 3).

    Returns the number of points: q, and one after each of MuJoCo's physics steps until rest.
    """
    slot, step, a_max, count = world.slot, world.step, world.a_max[w, 0], 1
    at, now, held, raw = q.copy(), v.copy(), np.empty(3), np.empty(3)
    path[0] = q
    while count + world.substeps <= len(path):
        slots -= 1
        speed = norm(now)
        if slots >= 0:
            for k in range(3):
                raw[k] = a[k] / a_max
            project_row(world, w, now, raw, held)
        elif speed > 1e-9:
            for k in range(3):
                held[k] = -now[k] * min(a_max, speed / slot) / speed
        else:
            break
        for p in range(1, world.substeps + 1):
            for k in range(3):
                path[count, k] = at[k] + p * step * (now[k] + held[k] * step * (p + 1) / 2)
            count += 1
        for k in range(3):
            at[k] = path[count - 1, k]
            now[k] += held[k] * slot
    return count


@compiled
def piece_gap(before: Array, after: Array) -> float:
    """Returns the least distance (m) of two points that move from one offset (3,) to another."""
    along, square = 0.0, 0.0
    for k in range(3):
        along -= before[k] * (after[k] - before[k])
        square += (after[k] - before[k]) ** 2
    share = min(max(along / square, 0.0), 1.0) if square > 0.0 else 0.0
    gap = 0.0
    for k in range(3):
        gap += (before[k] + share * (after[k] - before[k])) ** 2
    return math.sqrt(gap)


@compiled
def first_meeting(
    one: Array, count: int, other: Array, counts: int, apart: float, stride: float
) -> int:
    """Returns the first physics step in which two plans come nearer than `apart` m, -1 for none.

    Where they are nearer at first, they come no nearer still. A plan goes on at its last point.

    Args:
        one, other: (..., 3), `count` and `counts` points of them.
        stride: metres by which the distance changes at most in a step.
    """
    before, after = np.empty(3), np.empty(3)
    p, most = 0, max(count, counts)
    for k in range(3):
        before[k] = other[0, k] - one[0, k]
    apart = min(apart, norm(before) - 1e-10)
    while p < most - 1:
        skipped = int((norm(before) - apart) / stride) - 1
        if skipped > 0:  # So soon they cannot meet.
            p += skipped
            if p >= most - 1:
                break
            for k in range(3):
                before[k] = other[min(p, counts - 1), k] - one[min(p, count - 1), k]
            continue
        p += 1
        for k in range(3):
            after[k] = other[min(p, counts - 1), k] - one[min(p, count - 1), k]
        if piece_gap(before, after) < apart:
            return p
        before[:] = after
    return -1


@compiled
def met_by(
    world: World, w: int, plans: Array, counts: Indices, me: int, count: int
) -> tuple[int, int]:
    """Returns which other UAV the plan of `me` comes too near to and in which step, -1 for none.

    Args:
        plans, counts: (M + 1, ..., 3), (M,), where all will be; the plan to judge is the last.
    """
    apart, stride = world.apart[w, 0] + NEAR, 2 * world.v_max[w, 0] * world.step
    for j in range(len(counts)):
        if j != me:
            p = first_meeting(plans[-1], count, plans[j], counts[j], apart, stride)
            if p >= 0:
                return j, p
    return -1, -1


@compiled
def keeps_apart(
    world: World, w: int, plans: Array, counts: Indices, me: int, q: Array, v: Array, a: Array,
    slots: int,
) -> bool:  # fmt: skip
    """Returns whether `slots` slots of a command and braking keep `me` apart from all others."""
    if len(counts) < 2:
        return True
    count = plan_row(world, w, q, v, a, slots, plans[-1])
    return met_by(world, w, plans, counts, me, count)[0] < 0


@compiled
def sides_row(
    world: World, w: int, plans: Array, counts: Indices, me: int, q: Array, v: Array, a: Array,
    sides: Array,
) -> bool:  # fmt: skip
    """Writes to `sides` (6, 3) ways past the UAV that a command leads too near to, if to any.

    The first row leads to that UAV. Then come unit vectors across it: on the side on which the
    plan passes it anyway; to the right, as the rules of the air have it; up, left and down.
    """
    count = plan_row(world, w, q, v, a, 1, plans[-1])
    j, p = met_by(world, w, plans, counts, me, count)
    if j < 0:
        return False
    ahead, passes, right, above = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for k in range(3):
        above[k] = plans[j, 0, k] - q[k]
        passes[k] = plans[-1, min(p, count - 1), k] - plans[j, min(p, counts[j] - 1), k]
    unit(above, ahead)
    aside = dot(passes, ahead)
    for k in range(3):
        passes[k] -= aside * ahead[k]
    right[0], right[1], right[2] = ahead[1], -ahead[0], 0.0
    if norm(right) < 1e-3:
        right[0] = 1.0
    unit(right, right)
    for k in range(3):
        above[k] = right[(k + 1) % 3] * ahead[(k + 2) % 3] - right[(k + 2) % 3] * ahead[(k + 1) % 3]
    sides[0] = ahead
    if unit(passes, sides[1]) < SURE_SIDE * world.apart[w, 0]:
        sides[1] = right
    for k in range(3):
        sides[2, k], sides[3, k], sides[4, k], sides[5, k] = (
            right[k],
            above[k],
            -right[k],
            -above[k],
        )
    return True


@compiled
def aside_row(
    world: World, w: int, v: Array, a: Array, ahead: Array, side: Array, tried: Array
) -> None:
    """Writes to `tried` the command `a` (3,) no nearer to what is ahead, else along `side`."""
    a_max, raw = world.a_max[w, 0], np.empty(3)
    towards = min(dot(a, ahead), max(-dot(v, ahead) / world.slot, -SHARE_AHEAD * a_max))
    towards = max(towards, -a_max)
    left = math.sqrt(max(a_max**2 - towards**2, 0.0))
    for k in range(3):
        raw[k] = (towards * ahead[k] + left * side[k]) / a_max
    project_row(world, w, v, raw, tried)


@compiled
def together_rows(world: World, uavs: int, path: Array, touch: Bools) -> None:
    """Adds to `touch` (N, n) the steps of paths (N, n + 1, 3) in which UAVs are not kept apart."""
    before, after = np.empty(3), np.empty(3)
    for i in range(len(path)):
        first = i - i % uavs
        apart = world.apart[scene_of(world, i), 0] - NEAR
        for j in range(first, i):
            for s in range(touch.shape[1]):
                for k in range(3):
                    before[k] = path[j, s, k] - path[i, s, k]
                    after[k] = path[j, s + 1, k] - path[i, s + 1, k]
                if piece_gap(before, after) < apart:
                    touch[i, s] = touch[j, s] = True


def too_near(world: World, uavs: int, path: Array) -> Bools:
    """Returns which physics steps (N, n) bring two UAVs of a fleet nearer than they keep apart.

    Args:
        uavs: M, number of UAVs in a fleet; rows of a fleet follow each other.
        path: (N, n + 1, 3) m, positions at the slot's start and after each physics step.
    """
    touch = np.zeros((len(path), path.shape[1] - 1), dtype=bool)
    if uavs > 1:
        together_rows(world, uavs, plain(path), touch)
    return touch


def clashes(world: World, uavs: int, q: Array, v: Array) -> Bools:
    """Returns which UAVs (N,) of fleets cannot brake at once without coming too near to another.

    Args:
        uavs: M, number of UAVs in a fleet. q, v: (N, 3) m and m/s.
    """
    clash = np.zeros(len(q), dtype=bool)
    clash_rows(world, uavs, plain(q), plain(v), clash)
    return clash


@compiled
def clash_rows(world: World, uavs: int, q: Array, v: Array, clash: Bools) -> None:
    """Compiled loop of `clashes`."""
    plans, counts = np.empty((uavs, longest_plan(world, 0), 3)), np.empty(uavs, dtype=np.intp)
    for first in range(0, len(q), uavs):
        w = scene_of(world, first)
        apart, stride = world.apart[w, 0], 2 * world.v_max[w, 0] * world.step
        for j in range(uavs):
            counts[j] = plan_row(world, w, q[first + j], v[first + j], q[first], 0, plans[j])
            for i in range(j):
                # `first_meeting` lets those who are too near at first be so.
                gap = 0.0
                for k in range(3):
                    gap += (q[first + i, k] - q[first + j, k]) ** 2
                if gap < apart**2 or (
                    first_meeting(plans[i], counts[i], plans[j], counts[j], apart, stride) >= 0
                ):
                    clash[first + i] = clash[first + j] = True


def others_seen(world: World, uavs: int, q: Array, v: Array) -> Array:
    """Returns (N, SHOWN, SEEN) of the nearest other UAVs of each fleet, the nearest first.

    They are the direction there times nearness, the relative velocity in units of v_max, and 1 for
    one that has right of way, else -1. Nearness is 1 where UAVs keep just apart and 0 from SIGHT
    on; a UAV out of sight is all zero.

    Args:
        uavs: M, number of UAVs in a fleet. q, v: (N, 3) m and m/s.
    """
    out = np.zeros((len(q), SHOWN, SEEN))
    if uavs == 1:
        return out
    place, speed = q.reshape(-1, uavs, 3), v.reshape(-1, uavs, 3)
    offset, drift = place[:, None] - place[:, :, None], speed[:, None] - speed[:, :, None]
    offset, drift = offset.reshape(len(q), uavs, 3), drift.reshape(len(q), uavs, 3)
    gap = np.linalg.norm(offset, axis=2)
    me = np.arange(len(q)) % uavs
    gap[np.arange(len(q)), me] = np.inf
    near = np.argsort(gap, axis=1, kind="stable")[:, : min(SHOWN, uavs - 1)]
    gap = np.take_along_axis(gap, near, axis=1)[..., None]
    sight, apart = SIGHT * world.unit[:, :, None], world.apart[:, :, None]
    nearness = np.clip((sight - gap) / (sight - apart), 0.0, 1.0)
    there = nearness > 0.0
    shown = near.shape[1]
    towards = np.take_along_axis(offset, near[..., None], axis=1) / np.maximum(gap, 1e-9)
    out[:, :shown, :3] = towards * nearness
    relative = np.take_along_axis(drift, near[..., None], axis=1) / world.v_max[:, :, None]
    out[:, :shown, 3:6] = np.where(there, relative, 0.0)
    first = np.where(near < me[:, None], 1.0, -1.0)[..., None]
    out[:, :shown, 6:] = np.where(there, first, 0.0)
    return out
