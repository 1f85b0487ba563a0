"""Racing lines: planned flights round corners, for the guidance law to follow.

The law turns from one straight piece of a way into the next and keeps to a speed from which it can
stop in a straight line. In sharp turns between boxes that costs seconds. The MPC, which plans
curves, flies such a leg once, when its guidance is built; the law then follows the states of that
flight. A line is kept only if the law was rehearsed along it from all over the start's ball, always
arrived, and was quicker than without it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mjcollect import kernels
from mjcollect.compiled import plain
from mjcollect.flight import World, command, judge, slot_path
from mjcollect.geometry import Array, segment_box_distance
from mjcollect.guidance import Guidance, room_at
from mjcollect.planners.mpc import Mpc
from mjcollect.reward import time_to_go
from mjcollect.scene import Scene

BODIES = (4.0, 3.0, 5.0)  # metres of clearance to plan with, tried in turn
GAP = 0.1  # seconds beyond the least time, on average, from which a line is looked for
MOST_ROOM = 8.0  # metres beside a line that count
SPARED = 0.1  # metres of the room to boxes that are not counted on
STARTS = 16  # of a rehearsal
MOST_SLOTS = 600  # of a rehearsal or a plan


@dataclass(frozen=True)
class _Leg:
    """The one leg that the MPC flies."""

    scene: Scene
    guidance: tuple[Guidance, ...]


def racing_line(guide: Guidance) -> Array:
    """The best line (L, 7) for a guidance from its start; L = 0 where it would bring nothing.

    A row is the state at a slot's start, position (3,) in m and velocity (3,) in m/s, and the room
    beside the slot's piece in m. The line ends where the law does as well without it.
    """
    q = _starts(guide)
    least = float(least_slots(guide, q).mean())
    best, line = float(rehearse(guide, q).mean()), np.empty((0, 7))
    gap = GAP / guide.scene.slot
    for body in BODIES:
        if best <= least + gap:
            break
        tried = _planned(guide, body)
        if tried is None:
            continue
        left = rehearse(guide, tried[:, :3], tried[:, 3:6])
        tried = tried[: int(np.argmin(np.arange(len(tried)) + left)) + 2]
        slots = float(rehearse(guide, q, line=tried).mean())
        if slots < best:
            best, line = slots, tried
    return line


def least_slots(guide: Guidance, q: Array) -> Array:
    """Estimate (N,) of the least slots from rest at q (N, 3): along the way, into the ball."""
    world = World.stack([guide.scene])
    beside = float(np.linalg.norm(guide.aim - guide.goal))
    distance, _ = guide.query(q)
    distance = np.maximum(distance - max(guide.tolerance - beside, 0.0), 0.0)
    time = time_to_go(world, distance, np.zeros(len(q)))
    return np.asarray(np.ceil(time / world.slot - 1e-6))


def rehearse(guide: Guidance, q: Array, v: Array | None = None, line: Array | None = None) -> Array:
    """Slots (N,) that the law takes to the goal from states q, v (N, 3); inf where it fails.

    In the model of `flight.slot_path`.

    Args:
        v: at rest if not given. line: (L, 7) to follow instead of the guidance's own.
    """
    count, world = len(q), World.stack([guide.scene])
    way = guide.way if line is None else guide.way._replace(line=np.ascontiguousarray(line))
    q, v = q.copy(), np.zeros((count, 3)) if v is None else v.copy()
    goal, tolerance = np.tile(guide.goal, (count, 1)), np.full(count, guide.tolerance)
    law, strides = np.empty((count, 3)), np.zeros(1)
    offset, direction, ahead = np.empty((count, 3)), np.empty((count, 3)), np.empty((count, 1, 3))
    view = offset, np.empty(count), direction, np.empty(count), ahead
    slots, running = np.full(count, np.inf), np.ones(count, dtype=bool)
    for slot in range(1, MOST_SLOTS + 1):
        which = np.flatnonzero(running)
        if not len(which):
            break
        kernels.look(world, way, guide.slack, which, plain(guide.goal), strides, q, v, *view, law)
        a, stop = command(world, q, v, law, goal, tolerance)
        path, end = slot_path(world, q, v, a)
        judged = judge(world, q, path[:, 1:], np.zeros(path[:, 1:, 0].shape, bool), stop)
        q[which], v[which] = path[which, -1], end[which]
        slots[running & judged.arrived] = slot
        running &= ~(judged.arrived | judged.crashed)
    return slots


def _starts(guide: Guidance) -> Array:
    """Where a rehearsal begins: the start and points of the ball round it, clear of boxes."""
    rng, scene = np.random.default_rng(0), guide.scene
    strewn = rng.standard_normal((4 * STARTS, 3))
    strewn *= rng.random((len(strewn), 1)) ** (1 / 3) / np.linalg.norm(strewn, axis=1)[:, None]
    strewn = guide.start + scene.epsilon * strewn
    clear = strewn[room_at(scene, strewn) >= 0.0]
    return np.concatenate([guide.start[None], clear[: STARTS - 1]])


def _planned(guide: Guidance, body: float) -> Array | None:
    """The MPC's flight from rest at the guidance's start, as a line (L, 7); None if it fails."""
    scene = guide.scene
    mpc, world = Mpc(_Leg(scene, (guide,)), body=body), World.stack([scene])
    q, v = guide.start.copy(), np.zeros(3)
    states = [np.append(q, v)]
    for _ in range(MOST_SLOTS):
        plan = mpc.plan(q, v, 0)
        if plan is None:
            return None
        path, end = slot_path(world, q[None], v[None], plan.a[:1])
        q, v = path[0, -1], end[0]
        states.append(np.append(q, v))
        if plan.arrives and plan.slots == 1:
            break
    else:
        return None
    line = np.array(states)
    room = np.full(len(line), MOST_ROOM)
    if len(scene.obstacles):
        gap = segment_box_distance(line[:-1, None, :3], line[1:, None, :3], scene.obstacles)
        room[:-1] = np.minimum(room[:-1], gap.min(axis=1) - scene.uav_radius - SPARED)
    low, high = scene.bounds
    walls = np.minimum(line[:, :3] - low, high - line[:, :3]).min(axis=1)
    room[1:] = np.minimum(room, walls)[1:]  # the start may lie on a bound
    return np.column_stack([line, np.maximum(room, 0.0)])
