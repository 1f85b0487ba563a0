"""The named observations, vectorised over N simulations.

`guided`, the default of the environments, works for any number of obstacles and items. `path`, what
policies learn from by default, is the same as seen from the path, and so are the actions. `robust`
adds what kept the flight from its commands. `paper` is the state S = {q, v, l, m, p} of the paper's
section IV-B. All return named parts, each (N, d), in order.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from mjcollect.flight.world import World, scene_of
from mjcollect.geometry.boxes import FAR, box_offset, nearest_point_offset
from mjcollect.geometry.compiled import Array, Bools, compiled, plain
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


@dataclass(frozen=True)
class State:
    """What an observation is made of.

    Attributes:
        q, v: (N, 3). approach: the way to the current target.
        items: (N, K, 3), as padded. collected: (N, K).
        depot: (N, 3). commanded, drift: (N, 3) m/s^2, the last slot's command, and by how much the
            slot differed from it. gain, push: (N, 1), (N, 3) estimates, see `adaptation`.
        mover: (N, 6), see `Movers.seen`.
    """

    q: Array
    v: Array
    approach: Approach
    items: Array
    collected: Bools
    depot: Array
    commanded: Array
    drift: Array
    gain: Array
    push: Array
    mover: Array

    def rows(self, which: NDArray[np.intp]) -> State:
        """The state of the simulations `which` (n,) only."""
        approach = Approach(
            **{field.name: getattr(self.approach, field.name)[which] for field in fields(Approach)}
        )
        arrays = {
            field.name: getattr(self, field.name)[which]
            for field in fields(State)
            if field.name != "approach"
        }
        return State(approach=approach, **arrays)


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
def guided_rows(
    world: World, q: Array, v: Array, goal_offset: Array, direction: Array, closing: Array,
    near: Array, far: Array, ahead: Array, after: Array, frame: Array,
    nearest: int, reach: float, beyond: float, out: Array,
) -> None:  # fmt: skip
    """See `observation.guided`; the parts one after another, in the order of `GUIDED`."""
    gaps, offset, boxes, rest = np.empty(nearest), np.empty(3), np.empty(3 * nearest), np.empty(3)
    for i in range(len(q)):
        w, row, at, axes = scene_of(world, i), out[i], 0, frame[i]
        a_max, v_max, bounds = world.a_max[w, 0], world.v_max[w, 0], world.bounds[w]
        stopping, change = v_max**2 / (2 * a_max), a_max * world.slot
        seen_from(axes, v[i], v_max, row[0:3])
        seen_from(axes, v[i], 2 * change, row[3:6])
        squash(row[3:6])
        for k in range(3):
            row[6 + k] = direction[i, k]
        at = 9
        for a in range(1, ahead.shape[1]):
            seen_from(axes, ahead[i, a], 1.6 * stopping, row[at : at + 3])
            at += 3
        row[at] = near[i] / (5 * stopping)
        row[at + 1] = math.tanh(near[i] / stopping)
        row[at + 2] = math.tanh(5 * near[i] / stopping)
        at += 3
        seen_from(axes, goal_offset[i], 5 * stopping, row[at : at + 3])
        seen_from(axes, goal_offset[i], stopping, row[at + 3 : at + 6])
        seen_from(axes, goal_offset[i], stopping / 5, row[at + 6 : at + 9])
        squash(row[at + 3 : at + 9])
        at += 9
        # How much faster than one can still stop; share of a_max that a stop takes at the near
        # and the far end of what will do; slots until it must begin, for either; and slots to
        # rest: only whole ones are flown.
        speed = max(closing[i], 0.0)
        braking = speed**2 / (2 * a_max)
        first, last = near[i], far[i]
        fastest = min(math.sqrt(2 * a_max * first), v_max)
        stride, turn = max(speed, change) * world.slot, 2 * math.pi * speed / change
        row[at] = math.tanh((closing[i] - fastest) / (2.5 * change))
        row[at + 1] = min(braking / max(first, 0.1), 2.0)
        row[at + 2] = min(braking / max(last, 0.1), 2.0)
        row[at + 3] = math.tanh((first - braking) / (4 * stride))
        row[at + 4] = math.tanh((first - braking) / stride)
        row[at + 5] = math.tanh((last - braking) / stride)
        row[at + 6] = math.sin(turn)
        row[at + 7] = math.cos(turn)
        at += 8
        nearest_boxes(world.boxes[w], q[i], reach, beyond, gaps, offset, boxes)
        for b in range(nearest):
            seen_from(axes, boxes[3 * b : 3 * b + 3], 1.0, row[at : at + 3])
            at += 3
        for k in range(3):
            row[at + k] = math.tanh((q[i, k] - bounds[0, k]) / reach)
            row[at + 3 + k] = math.tanh((bounds[1, k] - q[i, k]) / reach)
        at += 6
        # Where full braking from now on would end, as seen from the goal; where the tour goes on.
        size = norm(v[i])
        for k in range(3):
            rest[k] = v[i, k] * (size / (2 * a_max)) - goal_offset[i, k]
        seen_from(axes, rest, 20.0, row[at : at + 3])
        seen_from(axes, rest, 4.0, row[at + 3 : at + 6])
        squash(row[at : at + 6])
        seen_from(axes, after[i], 1.0, row[at + 6 : at + 9])


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
    approach = state.approach
    flat = np.empty((len(state.q), sum(WIDTHS.values())))
    guided_rows(
        world,
        state.q,
        state.v,
        approach.offset,
        approach.direction,
        approach.closing,
        approach.near,
        approach.far,
        approach.ahead,
        approach.after,
        plain(frame),
        NEAREST_BOXES,
        REACH,
        FAR,
        flat,
    )
    parts, end = {}, 0
    for name, width in WIDTHS.items():
        parts[name] = flat[:, end : end + width]
        end += width
    return parts


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

    Accelerations are in units of what is left of a_max, see `adaptation.usable`.
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
