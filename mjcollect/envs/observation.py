"""Defines the named observations, vectorised over N simulations.

`guided`, the environments' default, works for any number of boxes and items. `path`, from which
policies learn by default, is the same in the frame of the path, and so are the actions. `robust`
adds to `path` what is known of disturbances, and moving boxes; `fleet` adds the other UAVs to it.
`paper` is the state
S = {q, v, l, m, p} of the paper's section IV-B. All return named parts, each (N, d), in order.
"""

from __future__ import annotations

import math
from collections import namedtuple
from typing import Any, NamedTuple

import numpy as np

from mjcollect.flight.disturbance_estimate import Estimate
from mjcollect.flight.world import World, scene_of, tree_of
from mjcollect.geometry.boxes import FAR, box_offset, nearest_point_offset
from mjcollect.geometry.compiled import Array, Bools, Indices, compiled, plain
from mjcollect.geometry.tree import Tree, first_member, next_leaf
from mjcollect.geometry.vectors import dot, norm
from mjcollect.guidance.approach import LOOK_AHEAD, Approach

NEAREST_BOXES = 4  # `guided` shows this many boxes.
# Distances are in units of the scene, see `Scene.unit`.
REACH = 30.0  # Boxes and walls begin to show in `guided` at about this distance.
FARTHEST = 8.0  # No distance shows as more than so many times five stopping distances.
# Widths of the parts of `guided`, in units of v_max, a_max and the stopping distance from v_max.
WIDTHS = {
    "velocity": 3,
    "slowness": 3,  # The velocity again, magnified where it is small.
    "guide_direction": 3,
    "guide_ahead": 3 * (len(LOOK_AHEAD) - 1),  # The first point lies straight ahead: left out.
    "guide_distance": 3,
    "goal_offset": 9,
    "braking": 8,
    "boxes": 3 * NEAREST_BOXES,
    "walls": 6,
    "rest": 6,  # Where full braking would end, relative to the goal.
    "next_direction": 3,
}
Parts = dict[str, Array]
# Each part of `guided` begins at this column: compiled code writes there, and parts are cut there.
AT: Any = namedtuple("Offsets", WIDTHS)(*np.cumsum([0, *WIDTHS.values()])[:-1].tolist())
SIZE = sum(WIDTHS.values())


class State(NamedTuple):
    """Holds what an observation is made of.

    Attributes:
        q, v: (N, 3) positions (m), velocities (m/s). approach: the way to the current target.
        items: (N, K, 3) m, padded with points far away. collected: (N, K) flags.
        known: what is known of disturbances. asked: (N,) share of its margin that the shield asks
            for. movers: (N, ...) what `MovingBoxes.seen` shows. met: (N, ...) what its `met` shows.
        others: (N, ...) what `separation.others_seen` shows.
    """

    q: Array
    v: Array
    approach: Approach
    items: Array
    collected: Bools
    known: Estimate
    asked: Array
    movers: Array
    met: Array
    others: Array

    def rows(self, which: Indices) -> State:
        """Returns the state of the simulations `which` (n,) only."""
        known = Estimate._make(part[which] for part in self.known)
        parts = self._replace(approach=self.approach.rows(which), known=known)
        arrays = ("q", "v", "items", "collected", "asked", "movers", "met", "others")
        return parts._replace(**{name: getattr(self, name)[which] for name in arrays})


@compiled
def add_if_near(gap: float, offset: Array, reach: float, gaps: Array, out: Array) -> None:
    """Adds a box to the nearest in `gaps`, `out`, see `nearest_boxes`, if it is one of them."""
    slot = len(gaps) - 1
    if gap >= gaps[slot]:
        return
    while slot > 0 and gaps[slot - 1] > gap:
        gaps[slot] = gaps[slot - 1]
        for k in range(3):
            out[3 * slot + k] = out[3 * slot - 3 + k]
        slot -= 1
    gaps[slot] = gap
    for k in range(3):
        out[3 * slot + k] = offset[k] / max(gap, 1e-9) / (1.0 + gap / reach)


@compiled
def nearest_boxes(
    tree: Tree, q: Array, reach: float, far: float, gaps: Array, offset: Array, out: Array
) -> None:
    """Writes direction times closeness of the nearest boxes, nearest first.

    Closeness is near 1 at 1 m, 1/2 at `reach` (m) and 0 far away. Padding, beyond `far` / 2, gives
    exactly 0, so that an observation does not depend on how many boxes other simulations have.

    Args:
        tree: of the boxes, moving ones besides. q: (3,) m. gaps, offset: (n,) and (3,) scratch.
            out: (3 n,).
    """
    count = len(gaps)
    around = reach if len(tree.nodes) > 1 else far / 2
    while True:  # in wider and wider surroundings, until as many are found as are wanted
        gaps[:], out[:] = far / 2, 0.0
        leaf = next_leaf(tree, -1, q, q, around)
        while leaf >= 0:
            for m in range(first_member(tree, leaf), first_member(tree, leaf + 1)):
                gap = box_offset(q, tree.boxes[tree.members[m]], offset)
                add_if_near(gap, offset, reach, gaps, out)
            leaf = next_leaf(tree, leaf, q, q, min(around, gaps[count - 1]))
        if gaps[count - 1] <= around or around >= far / 2:
            break
        around = min(4 * around, far / 2)
    for b in range(len(tree.members), len(tree.boxes)):
        add_if_near(box_offset(q, tree.boxes[b], offset), offset, reach, gaps, out)


@compiled
def seen_from(frame: Array, vector: Array, scale: float, to: Array) -> None:
    """Writes a vector (3,), divided by a scale, in a frame (3, 3) of unit rows."""
    for k in range(3):
        to[k] = dot(frame[k], vector) / scale


@compiled
def squash(vector: Array) -> None:
    """Replaces each component by its tanh."""
    for k in range(len(vector)):
        vector[k] = math.tanh(vector[k])


@compiled
def braking_part(
    near: float,
    far: float,
    closing: float,
    a_max: float,
    v_max: float,
    slot: float,
    unit: float,
    out: Array,
) -> None:
    """Writes how a stop at the target stands, `out` (8,).

    The numbers are the excess over the speed that can still be stopped; the share of a_max that a
    stop takes at the near and the far end of the ball; the time until it must begin, for either
    end; and the slots to rest as an angle, since only whole slots are flown.

    Args:
        near, far: distances to these ends (m). closing: speed towards the target (m/s).
        a_max: m/s^2. v_max: m/s. slot: s. unit: m.
    """
    speed, change = max(closing, 0.0), a_max * slot
    braking = speed**2 / (2 * a_max)
    fastest = min(math.sqrt(2 * a_max * near), v_max)
    stride, turn = max(speed, change) * slot, 2 * math.pi * speed / change
    out[0] = math.tanh((closing - fastest) / (2.5 * change))
    out[1] = min(braking / max(near, 0.1 * unit), 2.0)
    out[2] = min(braking / max(far, 0.1 * unit), 2.0)
    out[3] = math.tanh((near - braking) / (4 * stride))
    out[4] = math.tanh((near - braking) / stride)
    out[5] = math.tanh((far - braking) / stride)
    out[6] = math.sin(turn)
    out[7] = math.cos(turn)


@compiled
def guided_rows(
    world: World, q: Array, v: Array, approach: Approach, frame: Array, out: Array
) -> None:
    """Writes rows (N, SIZE) of `guided` with vectors in frames (N, 3, 3), each part at its AT."""
    gaps, offset = np.empty(NEAREST_BOXES), np.empty(3)
    boxes, rest = np.empty(3 * NEAREST_BOXES), np.empty(3)
    for i in range(len(q)):
        w, row, axes, goal = scene_of(world, i), out[i], frame[i], approach.offset[i]
        a_max, v_max, bounds = world.a_max[w, 0], world.v_max[w, 0], world.bounds[w]
        stopping, near, unit = v_max**2 / (2 * a_max), approach.near[i], world.unit[w, 0]
        seen_from(axes, v[i], v_max, row[AT.velocity :])
        seen_from(axes, v[i], 2 * (a_max * world.slot), row[AT.slowness :])
        squash(row[AT.slowness : AT.slowness + 3])
        row[AT.guide_direction : AT.guide_direction + 3] = approach.direction[i]
        for a in range(1, approach.ahead.shape[1]):
            to = AT.guide_ahead + 3 * (a - 1)
            seen_from(axes, approach.ahead[i, a], 1.6 * stopping, row[to:])
        row[AT.guide_distance] = min(near / (5 * stopping), FARTHEST)
        row[AT.guide_distance + 1] = math.tanh(near / stopping)
        row[AT.guide_distance + 2] = math.tanh(5 * near / stopping)
        far = max(norm(goal) / FARTHEST, 5 * stopping)
        seen_from(axes, goal, far, row[AT.goal_offset :])
        seen_from(axes, goal, stopping, row[AT.goal_offset + 3 :])
        seen_from(axes, goal, stopping / 5, row[AT.goal_offset + 6 :])
        squash(row[AT.goal_offset + 3 : AT.goal_offset + 9])
        braking_part(
            near, approach.far[i], approach.closing[i], a_max, v_max, world.slot, unit,
            row[AT.braking :],
        )  # fmt: skip
        nearest_boxes(tree_of(world, w), q[i], REACH * unit, FAR, gaps, offset, boxes)
        for b in range(NEAREST_BOXES):
            seen_from(axes, boxes[3 * b : 3 * b + 3], 1.0, row[AT.boxes + 3 * b :])
        for k in range(3):
            row[AT.walls + k] = math.tanh((q[i, k] - bounds[0, k]) / (REACH * unit))
            row[AT.walls + 3 + k] = math.tanh((bounds[1, k] - q[i, k]) / (REACH * unit))
        size = norm(v[i])
        for k in range(3):
            rest[k] = v[i, k] * (size / (2 * a_max)) - goal[k]
        seen_from(axes, rest, 20.0 * unit, row[AT.rest :])
        seen_from(axes, rest, 4.0 * unit, row[AT.rest + 3 :])
        squash(row[AT.rest : AT.rest + 6])
        seen_from(axes, approach.next_direction[i], 1.0, row[AT.next_direction :])


def guided(world: World, state: State) -> Parts:
    """Returns velocity, guidance, goal, braking, nearest boxes and walls in the parts of WIDTHS."""
    return _guided_parts(world, state, np.broadcast_to(np.eye(3), (len(state.q), 3, 3)))


def path(world: World, state: State) -> Parts:
    """Returns `guided` in the frame of the path, except `guide_direction` and `walls`.

    With this observation actions are in that frame too, which is `Approach.frame`.
    """
    return _guided_parts(world, state, state.approach.frame)


def _guided_parts(world: World, state: State, frame: Array) -> Parts:
    """Returns the parts of `guided` with vectors in frames (N, 3, 3)."""
    flat = np.empty((len(state.q), SIZE))
    guided_rows(world, state.q, state.v, state.approach, plain(frame), flat)
    return {
        name: flat[:, at : at + width] for (name, width), at in zip(WIDTHS.items(), AT, strict=True)
    }


def paper(world: World, state: State) -> Parts:
    """Returns the paper's S = {q, v, l, m, p}, scaled by the size of the scene or by v_max."""
    low, size = world.bounds[:, 0], world.bounds[:, 1] - world.bounds[:, 0]
    to_boxes = nearest_point_offset(state.q[:, None], world.boxes)
    to_boxes = np.clip(to_boxes / size[:, None], -1.0, 1.0)
    to_items = np.clip((state.items - state.q[:, None]) / size[:, None], -1.0, 1.0)
    count = len(state.q)
    return {
        "q": (state.q - low) / size,
        "v": state.v / world.v_max,
        "l": to_boxes.reshape(count, -1),
        "m": to_items.reshape(count, -1),
        "p": state.collected.astype(np.float64),
    }


def robust(world: World, state: State) -> Parts:
    """Returns `path`, estimates of what disturbs and how sure they are, moving boxes and bounds.

    Vectors are in the frame of the path. The a_max in whose unit they are is what is left of it.
    """
    known, frame = state.known, state.approach.frame
    turned = np.einsum("n...j,nkj->n...k", state.movers, frame)
    met = np.einsum("n...j,nkj->n...k", state.met[..., :3], frame)
    met = np.concatenate([met, state.met[..., 3:]], axis=-1)
    doubts = (
        known.gain,
        known.late / world.slot,
        known.spread / world.a_max,
        known.blur,
        state.asked[:, None],
    )
    return {
        **path(world, state),
        "push": np.einsum("nj,nkj->nk", known.push / world.a_max, frame),
        "doubts": np.concatenate(doubts, axis=1),
        "movers": turned.reshape(len(turned), math.prod(turned.shape[1:])),
        "met": met.reshape(len(met), math.prod(met.shape[1:])),
        "bounds": nearest_bounds(world, state.q, frame),
    }


def fleet(world: World, state: State) -> Parts:
    """Returns `path` and the nearest other UAVs, as `others_seen` shows them in its frame."""
    seen, frame = state.others, state.approach.frame
    vectors = seen[..., :6].reshape(*seen.shape[:-1], 2, 3)
    turned = np.einsum("n...j,nkj->n...k", vectors, frame).reshape(*seen.shape[:-1], 6)
    shown = np.concatenate([turned, seen[..., 6:]], axis=-1)
    return {**path(world, state), "others": shown.reshape(len(shown), -1)}


def nearest_bounds(world: World, q: Array, frame: Array) -> Array:
    """Returns closeness times direction of the two nearest bounds, in frames (N, 3, 3)."""
    gaps = np.concatenate([q - world.bounds[:, 0], world.bounds[:, 1] - q], axis=1)
    first = np.argsort(gaps, axis=1, kind="stable")[:, :2]
    gap = np.maximum(np.take_along_axis(gaps, first, axis=1), 0.0)
    side = np.where(first < 3, -1.0, 1.0) / (1.0 + gap / (REACH * world.unit))
    axes = np.take_along_axis(frame, (first % 3)[:, None, :], axis=2)  # (N, 3, 2)
    return np.asarray((side[:, None] * axes).transpose(0, 2, 1).reshape(len(q), 6))


def places(world: World, q: Array, v: Array, approach: Approach, times: Array) -> Array:
    """Returns where a body would be after `times` (T,) s, (N, 2, T, 3) m.

    First it would fly along its path as fast as it can, and then as it flies now.
    """
    marks = np.concatenate([np.zeros((len(q), 1, 3)), approach.ahead, approach.offset[:, None]], 1)
    pieces = np.diff(marks, axis=1)
    size = np.maximum(np.linalg.norm(pieces, axis=2), 1e-9)
    a_max, v_max = world.a_max, world.v_max
    speed = np.clip(approach.closing, 0.0, v_max[:, 0])[:, None]
    faster = np.minimum(times, (v_max - speed) / a_max)  # (N, T) s, how long it accelerates
    gone = speed * times + a_max * faster * (times - faster / 2)
    along = np.zeros((len(q), len(times), 3))
    for k in range(pieces.shape[1]):
        share = np.clip(gone / size[:, k : k + 1], 0.0, 1.0)
        gone = np.maximum(gone - size[:, k : k + 1], 0.0)
        along += share[..., None] * pieces[:, k : k + 1]
    return np.asarray(q[:, None, None] + np.stack([along, v[:, None] * times[:, None]], axis=1))


OBSERVATIONS = {"guided": guided, "path": path, "paper": paper, "robust": robust, "fleet": fleet}
FRAMED = ("path", "robust", "fleet")  # With these, actions are in the frame of the path as well.
SHOW_DISTURBANCES = ("robust",)
SHOW_OTHERS = ("fleet",)
