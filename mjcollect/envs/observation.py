"""The named observations, vectorised over N simulations.

`guided`, the default of the environments, works for any number of obstacles and items. `path`, what
policies learn from by default, is the same as seen from the path, and so are the actions. `robust`
adds what kept the flight from its commands. `paper` is the state S = {q, v, l, m, p} of the paper's
section IV-B. All return named parts, each (N, d), in order.
"""

from __future__ import annotations

import math
from collections import namedtuple
from typing import Any, NamedTuple

import numpy as np

from mjcollect.flight.world import World, scene_of
from mjcollect.geometry.boxes import FAR, box_offset, nearest_point_offset
from mjcollect.geometry.compiled import Array, Bools, Indices, compiled, plain
from mjcollect.geometry.vectors import dot, norm
from mjcollect.guidance.approach import LOOK_AHEAD, Approach

NEAREST_BOXES = 4
REACH = 30.0  # metres at which boxes and walls begin to matter to the `guided` observation
WIDTHS = {  # parts of `guided`, in natural units: v_max, a_max, the distance of a stop from v_max
    "velocity": 3,
    "slowness": 3,  # the velocity where it is small
    "guide_direction": 3,
    "guide_ahead": 3 * (len(LOOK_AHEAD) - 1),  # the first point lies straight ahead
    "guide_distance": 3,
    "goal_offset": 9,
    "braking": 8,
    "boxes": 3 * NEAREST_BOXES,
    "walls": 6,
    "rest": 6,  # where full braking would end, as seen from the goal
    "next_direction": 3,
}
Parts = dict[str, Array]
# Where each part begins in a row of `guided`: compiled code writes there, and parts are cut there.
AT: Any = namedtuple("Offsets", WIDTHS)(*np.cumsum([0, *WIDTHS.values()])[:-1].tolist())
SIZE = sum(WIDTHS.values())


class State(NamedTuple):
    """What an observation is made of.

    Attributes:
        q, v: (N, 3). approach: the way to the current target.
        items: (N, K, 3), as padded. collected: (N, K).
        commanded, drift: (N, 3) m/s^2, the last slot's command, and by how much the slot differed
            from it. gain, push: (N, 1), (N, 3), see `flight.disturbance_estimate`.
        mover: (N, 6), see `MovingBoxes.seen`.
    """

    q: Array
    v: Array
    approach: Approach
    items: Array
    collected: Bools
    commanded: Array
    drift: Array
    gain: Array
    push: Array
    mover: Array

    def rows(self, which: Indices) -> State:
        """The state of the simulations `which` (n,) only."""
        return State._make(
            part.rows(which) if isinstance(part, Approach) else part[which] for part in self
        )


@compiled
def nearest_boxes(
    boxes: Array, q: Array, reach: float, far: float, gaps: Array, offset: Array, out: Array
) -> None:
    """Direction times closeness to the nearest boxes, nearest first: `out` (3 * len(gaps),).

    One metre away reads close to 1, `reach` away 1/2, far away 0; padding exactly 0, so that an
    observation does not depend on how many boxes other simulations have.
    """
    count = len(gaps)
    gaps[:], out[:] = far, 0.0
    for b in range(len(boxes)):
        gap = box_offset(q, boxes[b], offset)
        if gap >= gaps[count - 1] or gap >= far / 2:
            continue
        slot = count - 1
        while slot > 0 and gaps[slot - 1] > gap:
            gaps[slot] = gaps[slot - 1]
            for k in range(3):
                out[3 * slot + k] = out[3 * slot - 3 + k]
            slot -= 1
        gaps[slot] = gap
        for k in range(3):
            out[3 * slot + k] = offset[k] / max(gap, 1e-9) / (1.0 + gap / reach)


@compiled
def seen_from(frame: Array, vector: Array, scale: float, to: Array) -> None:
    """A vector over a scale, in a frame."""
    for k in range(3):
        to[k] = dot(frame[k], vector) / scale


@compiled
def squash(vector: Array) -> None:
    """tanh of each component."""
    for k in range(len(vector)):
        vector[k] = math.tanh(vector[k])


@compiled
def braking_part(
    near: float, far: float, closing: float, a_max: float, v_max: float, slot: float, out: Array
) -> None:
    """How a stop stands: `out` (8,).

    How much faster than one can still stop; share of a_max that a stop takes at the near and the
    far end of what will do; slots until it must begin, for either; and slots to rest as an angle:
    only whole ones are flown.
    """
    speed, change = max(closing, 0.0), a_max * slot
    braking = speed**2 / (2 * a_max)
    fastest = min(math.sqrt(2 * a_max * near), v_max)
    stride, turn = max(speed, change) * slot, 2 * math.pi * speed / change
    out[0] = math.tanh((closing - fastest) / (2.5 * change))
    out[1] = min(braking / max(near, 0.1), 2.0)
    out[2] = min(braking / max(far, 0.1), 2.0)
    out[3] = math.tanh((near - braking) / (4 * stride))
    out[4] = math.tanh((near - braking) / stride)
    out[5] = math.tanh((far - braking) / stride)
    out[6] = math.sin(turn)
    out[7] = math.cos(turn)


@compiled
def guided_rows(
    world: World, q: Array, v: Array, approach: Approach, frame: Array, out: Array
) -> None:
    """Rows (N, SIZE) of `guided` with vectors in frames (N, 3, 3); each part at its place in AT."""
    gaps, offset = np.empty(NEAREST_BOXES), np.empty(3)
    boxes, rest = np.empty(3 * NEAREST_BOXES), np.empty(3)
    for i in range(len(q)):
        w, row, axes, goal = scene_of(world, i), out[i], frame[i], approach.offset[i]
        a_max, v_max, bounds = world.a_max[w, 0], world.v_max[w, 0], world.bounds[w]
        stopping, near = v_max**2 / (2 * a_max), approach.near[i]
        seen_from(axes, v[i], v_max, row[AT.velocity :])
        seen_from(axes, v[i], 2 * (a_max * world.slot), row[AT.slowness :])
        squash(row[AT.slowness : AT.slowness + 3])
        row[AT.guide_direction : AT.guide_direction + 3] = approach.direction[i]
        for a in range(1, approach.ahead.shape[1]):
            to = AT.guide_ahead + 3 * (a - 1)
            seen_from(axes, approach.ahead[i, a], 1.6 * stopping, row[to:])
        row[AT.guide_distance] = near / (5 * stopping)
        row[AT.guide_distance + 1] = math.tanh(near / stopping)
        row[AT.guide_distance + 2] = math.tanh(5 * near / stopping)
        seen_from(axes, goal, 5 * stopping, row[AT.goal_offset :])
        seen_from(axes, goal, stopping, row[AT.goal_offset + 3 :])
        seen_from(axes, goal, stopping / 5, row[AT.goal_offset + 6 :])
        squash(row[AT.goal_offset + 3 : AT.goal_offset + 9])
        braking_part(
            near, approach.far[i], approach.closing[i], a_max, v_max, world.slot, row[AT.braking :]
        )
        nearest_boxes(world.boxes[w], q[i], REACH, FAR, gaps, offset, boxes)
        for b in range(NEAREST_BOXES):
            seen_from(axes, boxes[3 * b : 3 * b + 3], 1.0, row[AT.boxes + 3 * b :])
        for k in range(3):
            row[AT.walls + k] = math.tanh((q[i, k] - bounds[0, k]) / REACH)
            row[AT.walls + 3 + k] = math.tanh((bounds[1, k] - q[i, k]) / REACH)
        size = norm(v[i])
        for k in range(3):
            rest[k] = v[i, k] * (size / (2 * a_max)) - goal[k]
        seen_from(axes, rest, 20.0, row[AT.rest :])
        seen_from(axes, rest, 4.0, row[AT.rest + 3 :])
        squash(row[AT.rest : AT.rest + 6])
        seen_from(axes, approach.next_direction[i], 1.0, row[AT.next_direction :])


def guided(world: World, state: State) -> Parts:
    """Velocity, shortest-path guidance, the goal, braking, nearest boxes and walls; see WIDTHS."""
    return _seen(world, state, np.broadcast_to(np.eye(3), (len(state.q), 3, 3)))


def path(world: World, state: State) -> Parts:
    """`guided` with vectors in the frame of the path; `guide_direction` and walls stay as they are.

    With it actions are in that frame too, see `Approach.frame`.
    """
    return _seen(world, state, state.approach.frame)


def _seen(world: World, state: State, frame: Array) -> Parts:
    """The parts of `guided` with vectors in frames (N, 3, 3)."""
    flat = np.empty((len(state.q), SIZE))
    guided_rows(world, state.q, state.v, state.approach, plain(frame), flat)
    return {
        name: flat[:, at : at + width] for (name, width), at in zip(WIDTHS.items(), AT, strict=True)
    }


def paper(world: World, state: State) -> Parts:
    """S = {q, v, l, m, p}, each normalised by the size of the scene or by v_max."""
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
    """`guided`, a moving box, the last slot's command and drift and estimates of it.

    Accelerations are in units of what is left of a_max, see `disturbance_estimate.usable`.
    """
    parts = guided(world, state)
    return {
        **parts,
        "command": state.commanded / world.a_max,
        "mover": state.mover,
        "drift": state.drift / world.a_max,
        "gain": state.gain,
        "push": state.push,
    }


OBSERVATIONS = {"guided": guided, "path": path, "paper": paper, "robust": robust}
FRAMED = ("path",)  # actions are in the frame of the path as well
ADAPTIVE = ("robust",)  # the guidance law adapts to the disturbances that they show
