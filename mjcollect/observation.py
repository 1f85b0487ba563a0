"""The two named observations, vectorised over N simulations.

`guided`, the default, works for any number of obstacles and items. `paper` is the state
S = {q, v, l, m, p} of the paper's section IV-B. Both return named parts, each (N, d), in order.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mjcollect.flight import Bools, World
from mjcollect.geometry import FAR, Array, nearest_point_offset
from mjcollect.reward import Approach

NEAREST_BOXES = 4
REACH = 30.0  # metres at which boxes and walls begin to matter to the `guided` observation
Parts = dict[str, Array]


@dataclass(frozen=True)
class State:
    """What an observation is made of.

    Attributes:
        q, v: (N, 3). approach: the way to the current target.
        items: (N, K, 3), as padded. collected: (N, K).
        depot: (N, 3).
    """

    q: Array
    v: Array
    approach: Approach
    items: Array
    collected: Bools
    depot: Array


def guided(world: World, state: State) -> Parts:
    """Velocity, shortest-path guidance, goal offset at three scales, nearest boxes and walls."""
    approach = state.approach
    distance = approach.distance[:, None]
    stopping = np.sqrt(2 * world.a_max * distance)
    speed = np.linalg.norm(state.v, axis=-1, keepdims=True)
    closing = approach.closing[:, None]
    return {
        "velocity": state.v / world.v_max,
        "guide_direction": approach.direction,
        "guide_ahead": (approach.ahead[:, 1:] / 100).reshape(len(state.q), -1),
        "guide_distance": np.concatenate(
            [distance / 300, np.tanh(distance / 60), np.tanh(distance / 12)], axis=-1
        ),
        "goal_offset": np.concatenate(
            [approach.offset / 300, np.tanh(approach.offset / 60), np.tanh(approach.offset / 12)],
            axis=-1,
        ),
        # Along the path, across it, and how much faster than one can still stop.
        "speeds": np.concatenate(
            [
                closing / world.v_max,
                np.sqrt(np.maximum(speed**2 - closing**2, 0.0)) / world.v_max,
                np.tanh((closing - np.minimum(stopping, world.v_max)) / 10),
            ],
            axis=-1,
        ),
        "boxes": _nearest_boxes(world, state.q),
        "walls": np.concatenate(
            [
                np.tanh((state.q - world.bounds[:, 0]) / REACH),
                np.tanh((world.bounds[:, 1] - state.q) / REACH),
            ],
            axis=-1,
        ),
    }


def _nearest_boxes(world: World, q: Array) -> Array:
    """Direction times closeness to the nearest boxes, nearest first: (N, 3 * NEAREST_BOXES)."""
    offset = nearest_point_offset(q[:, None], world.boxes)
    gap = np.linalg.norm(offset, axis=-1)
    if gap.shape[1] < NEAREST_BOXES:
        missing = NEAREST_BOXES - gap.shape[1]
        offset = np.concatenate([offset, np.full((len(q), missing, 3), FAR)], axis=1)
        gap = np.concatenate([gap, np.full((len(q), missing), FAR)], axis=1)
    nearest = np.argsort(gap, axis=1, kind="stable")[:, :NEAREST_BOXES]
    offset = np.take_along_axis(offset, nearest[..., None], axis=1)
    gap = np.take_along_axis(gap, nearest, axis=1)[..., None]
    # One metre away reads close to 1, REACH away 1/2, far away 0; padding exactly 0, so that an
    # observation does not depend on how many boxes other simulations have.
    closeness = np.where(gap < FAR / 2, 1.0 / (1.0 + gap / REACH), 0.0)
    return (offset / np.maximum(gap, 1e-9) * closeness).reshape(len(q), -1)


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


OBSERVATIONS = {"guided": guided, "paper": paper}
