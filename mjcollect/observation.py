"""The named observations, vectorised over N simulations.

`guided`, the default of the environments, works for any number of obstacles and items. `path`, what
policies learn from by default, is the same as seen from the path, and so are the actions. `robust`
adds what kept the flight from its commands. `paper` is the state S = {q, v, l, m, p} of the paper's
section IV-B. All return named parts, each (N, d), in order.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from mjcollect import kernels
from mjcollect.compiled import plain
from mjcollect.flight import Bools, World
from mjcollect.geometry import FAR, Array, nearest_point_offset
from mjcollect.reward import LOOK_AHEAD, Approach

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
    kernels.guided(
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
