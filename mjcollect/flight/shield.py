"""Shields flights: a command is flown only if it leaves a way to stop without touching anything.

A backup is a manoeuvre known to be free: the last command held for some more slots, then full
braking in a straight line. A command is allowed if some backup is free after its slot. If none is,
the command is bent towards braking. If nothing bent is allowed either, the backup of the slot
before is flown, which was free then and still is. So from rest, or from any state whose braking is
free, no undisturbed flight ever touches a box or leaves the bounds. This is model predictive
shielding (Bastani 2019; Li and Bastani 2020). In a fleet a backup is free only if it also keeps
apart from the backups of all others, see `separation`.
"""

from __future__ import annotations

import numpy as np

from mjcollect.flight.deflection import TIMES, deflected
from mjcollect.flight.projection import project_row
from mjcollect.flight.separation import (
    aside_row,
    keeps_apart,
    longest_plan,
    plan_row,
    sides_row,
)
from mjcollect.flight.world import World, scene_of, tree_of
from mjcollect.geometry.boxes import box_offset, segment_gap, slab
from mjcollect.geometry.compiled import Array, Bools, Indices, compiled, plain
from mjcollect.geometry.tree import first_member, next_leaf
from mjcollect.geometry.turns import is_near
from mjcollect.geometry.vectors import norm

OUTSIDE = 1e-6  # metres; rounding leads undisturbed flights no farther beyond a bound
MARGIN = 1e-6  # metres kept from boxes beyond the body's radius; rounding errors are far smaller
HELD = (0, 2, 4, 8)  # A backup holds a command for so many slots before it brakes.
BENT = (0.75, 0.5, 0.25)  # These shares of a command, else full braking, are tried in turn.


@compiled
def braking_row(world: World, w: int, v: Array, a: Array) -> None:
    """Writes full braking to `a` (3,) in m/s^2: a_max, or less if that is rest within the slot."""
    speed = norm(v)
    size = min(world.a_max[w, 0], speed / world.slot) / max(speed, 1e-12)
    for k in range(3):
        a[k] = -v[k] * size


@compiled
def roll_row(world: World, w: int, q: Array, v: Array, a: Array, more: int, path: Array) -> int:
    """Writes to `path` (..., 3) a slot of `a`, `more` slots of it held, and full braking.

    Returns the number of points: MuJoCo's physics steps, and one for braking, which is a straight
    piece that is never shorter than it would be flown.
    """
    slot, step, count = world.slot, world.step, 1
    at, now, held, raw = q.copy(), v.copy(), a.copy(), np.empty(3)
    path[0] = q
    for s in range(more + 1):
        if s > 0:  # a held command is projected anew, to keep to v_max
            for k in range(3):
                raw[k] = a[k] / world.a_max[w, 0]
            project_row(world, w, now, raw, held)
        for p in range(1, world.substeps + 1):
            for k in range(3):
                path[count, k] = at[k] + p * step * (now[k] + held[k] * step * (p + 1) / 2)
            count += 1
        for k in range(3):
            at[k] = path[count - 1, k]
            now[k] += held[k] * slot
    # Of the last slot of braking only a part is needed: that takes longer and leads farther.
    speed, a_max = norm(now), world.a_max[w, 0]
    part = speed / (a_max * slot) % 1.0
    reach = speed / (2 * a_max) + part * (1.0 - part) * a_max * slot**2 / 2 / max(speed, 1e-9)
    for k in range(3):
        path[count, k] = at[k] + now[k] * reach
    return count + 1


@compiled
def is_free(world: World, w: int, q: Array, v: Array, path: Array, count: int) -> bool:
    """Returns whether `count` points of a path from q stay within bounds and clear of boxes."""
    tree, bounds, radius = tree_of(world, w), world.bounds[w], world.radius[w, 0]
    hull = np.empty((2, 3))
    low, high, last, offset = path[0].copy(), path[0].copy(), np.empty(3), np.empty(3)
    for k in range(3):
        for p in range(1, count - 1):
            low[k], high[k] = min(low[k], path[p, k]), max(high[k], path[p, k])
        least, most = bounds[0, k], bounds[1, k]
        if least - q[k] > OUTSIDE:  # Blown over a bound, it may go on for one slot.
            least = q[k] + min(v[k], 0.0) * world.slot
        if q[k] - most > OUTSIDE:
            most = q[k] + max(v[k], 0.0) * world.slot
        # Outside by rounding it may go no farther; nothing would be allowed if it had to be inside.
        least, most = min(least, q[k]), max(most, q[k])
        end = path[count - 1, k]
        if min(low[k], end) < least or max(high[k], end) > most:
            return False
        last[k] = end - path[count - 2, k]
        hull[0, k], hull[1, k] = min(low[k], end), max(high[k], end)
    reach = radius + MARGIN
    leaf = next_leaf(tree, -1, hull[0], hull[1], reach)
    while leaf >= 0:
        for m in range(first_member(tree, leaf), first_member(tree, leaf + 1)):
            box = tree.boxes[tree.members[m]]
            near = is_near(low, high, reach, box)
            if not near:
                enter, leave = slab(path[count - 2], last, box, reach, 1e-12)
                near = enter <= leave and leave >= 0.0 and enter <= 1.0
            if near:
                # A body nearer than that, as at a start, must come no nearer and soon be away.
                here = box_offset(q, box, offset)
                for p in range(1, count):
                    distance = segment_gap(path[p - 1], path[p], box)
                    if distance < (min(reach, here) if p == 1 else reach):
                        return False
        leaf = next_leaf(tree, leaf, hull[0], hull[1], reach)
    return True


@compiled
def backup_row(
    world: World, w: int, q: Array, v: Array, a: Array, path: Array, plans: Array, counts: Indices,
    me: int,
) -> int:  # fmt: skip
    """Returns for how many slots a free backup holds `a` after its slot; -1 if none is free."""
    for more in HELD:
        count = roll_row(world, w, q, v, a, more, path)
        if is_free(world, w, q, v, path, count) and keeps_apart(
            world, w, plans, counts, me, q, v, a, more + 1
        ):
            return more
    return -1


@compiled
def shield_row(
    world: World, w: int, q: Array, v: Array, a: Array, held: Array, path: Array, left: int,
    plans: Array, counts: Indices, me: int,
) -> tuple[int, bool]:  # fmt: skip
    """Bends the command `a` (3,) until a backup is free after it.

    Args:
        held: (3,), the command that the backup so far holds for `left` slots more; written anew.
        path: memory for the points of a backup.
        plans, counts, me: where the fleet will be, and which of its UAVs this is, see `separation`.

    Returns:
        The slots of the new backup, and whether the command was changed.
    """
    more = backup_row(world, w, q, v, a, path, plans, counts, me)
    if more >= 0:
        held[:] = a
        return more, False
    braking, tried, none = np.empty(3), a.copy(), np.empty((0, 3))
    times, reach = np.zeros(len(path)), np.full(len(path), world.radius[w, 0] + MARGIN)
    for _ in range(TIMES):
        count = roll_row(world, w, q, v, tried, 0, path)
        if not deflected(
            world, w, v, world.a_max[w, 0], path, times, reach, count, world.boxes[w, :0], none,
            tried,
        ):  # fmt: skip
            break
        more = backup_row(world, w, q, v, tried, path, plans, counts, me)
        if more >= 0:
            a[:] = tried
            held[:] = a
            return more, True
    if len(counts) > 1:
        sides = np.empty((6, 3))
        if sides_row(world, w, plans, counts, me, q, v, a, sides):
            for side in range(1, len(sides)):
                aside_row(world, w, v, a, sides[0], sides[side], tried)
                more = backup_row(world, w, q, v, tried, path, plans, counts, me)
                if more >= 0:
                    a[:] = tried
                    held[:] = a
                    return more, True
    braking_row(world, w, v, braking)
    for share in BENT:
        for k in range(3):
            tried[k] = braking[k] + share * (a[k] - braking[k])
        more = backup_row(world, w, q, v, tried, path, plans, counts, me)
        if more >= 0:
            a[:] = tried
            held[:] = a
            return more, True
    changed = False
    if left > 0:
        for k in range(3):
            tried[k] = held[k] / world.a_max[w, 0]
        project_row(world, w, v, tried, braking)
    for k in range(3):
        changed = changed or a[k] != braking[k]
        a[k] = braking[k]
    return max(left - 1, 0), changed


@compiled
def shield_rows(
    world: World, uavs: int, q: Array, v: Array, a: Array, stop: Bools, held: Array,
    left: Indices, acted: Bools,
) -> None:  # fmt: skip
    """Compiled loop of `shield` over N simulations."""
    path = np.empty((world.substeps * (max(HELD) + 1) + 2, 3))
    plans = np.empty((uavs + 1, longest_plan(world, max(HELD) + 1) if uavs > 1 else 1, 3))
    counts = np.empty(uavs, dtype=np.intp)
    for i in range(len(v)):
        w, me, before = scene_of(world, i), i % uavs, stop[i]
        if uavs > 1 and me == 0:
            for j in range(uavs):
                counts[j] = plan_row(
                    world, w, q[i + j], v[i + j], held[i + j], left[i + j], plans[j]
                )
        left[i], acted[i] = shield_row(
            world, w, q[i], v[i], a[i], held[i], path, left[i], plans, counts, me
        )
        stop[i] = before and not acted[i]
        if uavs > 1 and np.array_equal(held[i], a[i]):  # else it flies on as planned before
            counts[me] = plan_row(world, w, q[i], v[i], a[i], 1 + left[i], plans[me])


def shield(
    world: World, q: Array, v: Array, a: Array, stop: Bools, held: Array, left: Indices,
    acted: Bools, uavs: int = 1,
) -> None:  # fmt: skip
    """Bends commands that leave no way to stop without touching anything.

    Args:
        q, v: (N, 3). a: (N, 3) in m/s^2, feasible commands; changed where the shield acts.
        stop: (N,), whether they are the stop that collects; cleared where the shield acts.
        held, left: (N, 3), (N,), the backup of the slot before; overwritten with that of this one.
        acted: (N,), written: whether the command was changed.
        uavs: number of UAVs in a fleet; those of a fleet follow each other, the first one first.
    """
    shield_rows(world, uavs, plain(q), plain(v), a, stop, held, left, acted)
