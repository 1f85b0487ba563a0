"""Shields disturbed flights: the rule of `shield`, with margins that grow with what is not known.

A backup is a command held for some slots, then braking, then a moment at rest. Along it the body
may lie off its foretold place by what its position is blurred, and by what the air does until the
command can answer: a distance that grows with the time. The margin is that distance at the
probability CHANCE. Moving boxes are met where they are believed to be by then.

A command's room is the share of this margin that its best backup keeps from boxes and bounds, at
most 1. It is flown if its room is what is asked for, which is 1. If it is not, the command is bent
towards braking, else the backup of the slot before or an escape along an axis is flown, whichever
has most room. Where nothing but creeping is left, less and less is asked for until there is a way
on: so the margin gives way gradually, and how much is left of it is reported. Before moving boxes
and bounds, beyond which no target lies, it never gives way.
"""

from __future__ import annotations

from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from mjcollect.flight.contact import MARGIN
from mjcollect.flight.deflection import TIMES, deflected
from mjcollect.flight.disturbance_estimate import Estimate
from mjcollect.flight.moving_boxes import STEPS
from mjcollect.flight.projection import project_row
from mjcollect.flight.shield import BENT, HELD, braking_row
from mjcollect.flight.world import World, scene_of, tree_of
from mjcollect.geometry.boxes import box_offset, segment_gap
from mjcollect.geometry.compiled import Array, Bools, Indices, compiled, plain
from mjcollect.geometry.tree import first_member, next_leaf
from mjcollect.geometry.turns import is_near
from mjcollect.geometry.vectors import hull, norm

CHANCE = 0.05  # A body that flies a backup to its end strays beyond the margin this often.
LAG = 0.8  # s; a gust is answered so late that it moves the body by spread * LAG * time.
BLURRED = 2.0  # The position is off by so many times the filter's standard deviation, since errors
# of its model last.
BRAKES = 6  # Braking is seen as so many straight pieces,
RESTS = (1.0, 2.0, 3.0)  # and the rest after it until so many seconds later.
SLOW = 3.0  # m/s; a slower body whose command is changed asks for less margin,
GIVE = 0.1  # by this share a slot, and for more again where its command is not changed.
LEAST = 0.0  # No less than this share is asked for.
SAG = 0.03  # metres; the flight is a little off the straight pieces that it is seen as


class Margins(NamedTuple):
    """Holds what N disturbed flights keep clear of, and how well they know where they will be.

    Attributes:
        spread: (N, 1) z times the spread of acceleration (m/s²). blur: (N, 1) that of position (m).
        braking: (N, 1) deceleration to count on (m/s²).
        boxes: (N, B, 2, 3) moving boxes (m). ahead: (N, B, T, 3) how far they are moved at STEPS.
        steps: (T,) s.
    """

    spread: Array
    blur: Array
    braking: Array
    boxes: Array
    ahead: Array
    steps: Array

    @classmethod
    def of(cls, known: Estimate, a_max: Array, v: Array, boxes: Array, ahead: Array) -> Margins:
        """Returns the margins at velocities v (N, 3) for estimates and moving boxes."""
        z = NormalDist().inv_cdf(1.0 - CHANCE)
        braking = known.braking(a_max, v)
        return cls(z * known.spread, z * BLURRED * known.blur, braking, boxes, plain(ahead), STEPS)


@compiled
def manoeuvre_row(
    world: World, w: int, braking: float, q: Array, v: Array, a: Array, more: int, path: Array,
    times: Array,
) -> int:  # fmt: skip
    """Writes a slot of `a`, `more` slots of it held, braking and rest to `path` (..., 3), `times`.

    Returns the number of points.
    """
    slot, count = world.slot, 1
    at, now, held, raw = q.copy(), v.copy(), a.copy(), np.empty(3)
    path[0], times[0] = q, 0.0
    for s in range(more + 1):
        if s > 0:
            for k in range(3):
                raw[k] = a[k] / world.a_max[w, 0]
            project_row(world, w, now, raw, held)
        for half in range(1, 3):
            t = half * slot / 2
            for k in range(3):
                path[count, k] = at[k] + t * (now[k] + held[k] * (t + world.step) / 2)
            times[count] = s * slot + t
            count += 1
        for k in range(3):
            at[k] = path[count - 1, k]
            now[k] += held[k] * slot
    whole, begun = norm(now) / braking, times[count - 1]
    for piece in range(1, BRAKES + 1):
        t = whole * piece / BRAKES
        for k in range(3):
            path[count, k] = at[k] + now[k] * (t - t * t / (2 * max(whole, 1e-9)))
        times[count] = begun + t
        count += 1
    for rest in RESTS:
        path[count] = path[count - 1]
        times[count] = begun + whole + rest
        count += 1
    return count


@compiled
def moved(ahead: Array, steps: Array, t: float, point: Array, out: Array) -> None:
    """Writes to `out` (3,) a point seen from a box that moves by `ahead` (T, 3) at `steps` (T,)."""
    at = min(t / steps[1], len(steps) - 1.0)
    k = min(int(at), len(steps) - 2)
    share = at - k
    for i in range(3):
        out[i] = point[i] - (ahead[k, i] * (1.0 - share) + ahead[k + 1, i] * share)


@compiled
def share(gap: float, margin: float) -> float:
    """Returns the share of a margin that a gap (m) keeps; -1 is where the body touches."""
    return (gap - SAG) / (margin if gap >= SAG else SAG)


@compiled
def room_row(
    world: World, w: int, margins: Margins, i: int, path: Array, times: Array, count: int,
    asked: float, least: float,
) -> float:  # fmt: skip
    """Returns the room of a path of `count` points: at most 1, and any number below `least`.

    What is asked for gives way before boxes that stand only: before moving boxes and bounds the
    whole margin is.
    """
    tree, radius, room = tree_of(world, w), world.radius[w, 0], 1.0
    spread, blur = margins.spread[i, 0] * LAG, margins.blur[i, 0]
    stopped = count - len(RESTS)  # At rest it is held where it is: the margin grows no more.
    low, high, offset = np.empty(3), np.empty(3), np.empty(3)
    begin, end = np.empty(3), np.empty(3)
    hull(path, count, low, high)
    most = max(blur + spread * times[stopped - 1], SAG)
    for p in range(1, stopped):
        margin = max(blur + spread * times[p], SAG)
        for k in range(3):
            inside = min(path[p, k] - world.bounds[w, 0, k], world.bounds[w, 1, k] - path[p, k])
            room = min(room, share(inside + MARGIN, margin) - 1.0 + asked)
        if room < least:
            return room
    leaf = next_leaf(tree, -1, low, high, radius + most)
    while leaf >= 0:
        for m in range(first_member(tree, leaf), first_member(tree, leaf + 1)):
            box = tree.boxes[tree.members[m]]
            if not is_near(low, high, radius + most, box):
                continue
            for p in range(1, stopped):
                margin = max(blur + spread * times[p], SAG)
                gap = segment_gap(path[p - 1], path[p], box)
                if p == 1 and gap >= box_offset(path[0], box, offset) - 1e-9:
                    gap = box_offset(path[1], box, offset)  # What is now cannot be helped.
                room = min(room, share(gap - radius, margin))
            if room < least:
                return room
        leaf = next_leaf(tree, leaf, low, high, radius + most)
    for b in range(margins.boxes.shape[1]):
        box = margins.boxes[i, b]
        if box[0, 0] > 1e8:
            continue
        begin[:] = path[0]
        for p in range(1, count):
            margin = max(blur + spread * times[min(p, stopped - 1)], SAG)
            moved(margins.ahead[i, b], margins.steps, times[p], path[p], end)
            gap = segment_gap(begin, end, box)
            if p == 1 and gap >= box_offset(path[0], box, offset) - 1e-9:
                gap = box_offset(end, box, offset)
            room = min(room, share(gap - radius, margin) - 1.0 + asked)
            begin[:] = end
        if room < least:
            return room
    return room


@compiled
def best_backup(
    world: World, w: int, margins: Margins, i: int, q: Array, v: Array, a: Array, enough: float,
    least: float, path: Array, times: Array,
) -> tuple[float, int]:  # fmt: skip
    """Returns the room of a command and the slots for which its best backup holds it."""
    best, slots = -np.inf, 0
    for more in HELD:
        count = manoeuvre_row(world, w, margins.braking[i, 0], q, v, a, more, path, times)
        room = room_row(world, w, margins, i, path, times, count, enough, max(least, best))
        if room > best:
            best, slots = room, more
        if best >= enough:
            break
    return best, slots


@compiled
def disturbed_row(
    world: World, w: int, margins: Margins, i: int, q: Array, v: Array, a: Array, held: Array,
    left: int, asked: float, path: Array, times: Array,
) -> tuple[int, float, bool]:  # fmt: skip
    """Bends the command `a` (3,) until there is the room that is asked for, or as much as can be.

    Returns the slots of the new backup, its room, and whether the command was changed.
    """
    best, slots = best_backup(world, w, margins, i, q, v, a, asked, -np.inf, path, times)
    if best >= asked:
        held[:] = a
        return slots, best, False
    braking, tried, raw, chosen = np.empty(3), np.empty(3), np.empty(3), a.copy()
    braking_row(world, w, v, braking)
    changed = False
    moving, drift = margins.boxes[i], margins.ahead[i, :, 1] / margins.steps[1]
    reach, spread = np.empty(len(times)), margins.spread[i, 0] * LAG
    tried[:] = a
    for _ in range(TIMES):
        count = manoeuvre_row(world, w, margins.braking[i, 0], q, v, tried, 0, path, times)
        for p in range(count):
            margin = margins.blur[i, 0] + spread * times[min(p, count - len(RESTS) - 1)]
            reach[p] = world.radius[w, 0] + max(margin * asked, SAG)
        if not deflected(
            world, w, v, margins.braking[i, 0], path, times, reach, count, moving, drift, tried
        ):
            break
        room, more = best_backup(world, w, margins, i, q, v, tried, asked, best, path, times)
        if room > best:
            best, slots, changed = room, more, True
            chosen[:] = tried
        if best >= asked:
            break
    for n in range(len(BENT) + 8):
        if best >= asked:
            break
        if n < len(BENT):
            for k in range(3):
                tried[k] = braking[k] + BENT[n] * (a[k] - braking[k])
        elif n == len(BENT):
            tried[:] = braking
        elif n == len(BENT) + 1:
            if left <= 0:
                continue
            for k in range(3):
                raw[k] = held[k] / world.a_max[w, 0]
            project_row(world, w, v, raw, tried)
        else:
            axis = n - len(BENT) - 2
            raw[:] = 0.0
            raw[axis // 2] = 1.0 if axis % 2 == 0 else -1.0
            project_row(world, w, v, raw, tried)
        room, more = best_backup(world, w, margins, i, q, v, tried, asked, best, path, times)
        if room > best:
            best, slots, changed = room, more, True
            chosen[:] = tried
    a[:] = chosen
    held[:] = chosen
    return slots, best, changed


@compiled
def disturbed_rows(
    world: World, margins: Margins, q: Array, v: Array, a: Array, stop: Bools, held: Array,
    left: Indices, asked: Array, room: Array, acted: Bools,
) -> None:  # fmt: skip
    """Compiled loop of `disturbed_shield` over N simulations."""
    most = 2 * (max(HELD) + 1) + BRAKES + len(RESTS) + 1
    path, times = np.empty((most, 3)), np.empty(most)
    for i in range(len(v)):
        before = stop[i]
        left[i], room[i], acted[i] = disturbed_row(
            world, scene_of(world, i), margins, i, q[i], v[i], a[i], held[i], left[i], asked[i],
            path, times,
        )  # fmt: skip
        stop[i] = before and not acted[i]
        creeping = acted[i] and norm(v[i]) < SLOW
        asked[i] = max(asked[i] - GIVE, LEAST) if creeping else min(asked[i] + GIVE, 1.0)


def disturbed_shield(
    world: World, margins: Margins, q: Array, v: Array, a: Array, stop: Bools, held: Array,
    left: Indices, asked: Array, room: Array, acted: Bools,
) -> None:  # fmt: skip
    """Bends commands that leave too little room, as `shield.shield` does in calm air.

    Args:
        world: the world with the a_max to count on. q, v: (N, 3). a: (N, 3) in m/s², accelerations
            as they will be flown; changed where the shield acts.
        stop, held, left, acted: as in `shield`. asked: (N,) share of the margin that is asked for;
            overwritten with that of the next slot. room: (N,), written: share that is kept.
    """
    disturbed_rows(world, margins, plain(q), plain(v), a, stop, held, left, asked, room, acted)
