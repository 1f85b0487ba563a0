"""Defines the reward presets, vectorised over N simulations.

`lost`, from which policies learn by default, is minus the time lost against the least time to go.
`time` is minus the time flown, shaped by a discount-consistent potential of the least time to go.
`careful` is `lost` with a costlier crash, for disturbed flights. `paper` is r1 to r6 of the
paper's section V-A to the letter.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from mjcollect.flight.contact import Slot
from mjcollect.flight.world import World
from mjcollect.geometry.compiled import Array
from mjcollect.guidance.approach import Approach

CRASH = -2.0  # A crash earns this reward in `time` and `lost`, with no potential term.
CAREFUL_CRASH = -10.0  # Who pays 2 risks a crash rather than wait for 3 s behind a moving box.
R2, R4, R5, R6 = 100.0, 100.0, -100.0, -200.0  # The paper's section V-A sets these rewards.


def potential(world: World, approach: Approach, gamma: float) -> Array:
    """Returns minus the discounted time to go (N,) in s, the return of arriving on time."""
    slots = approach.time_to_go(world) / world.slot
    return np.asarray(-world.slot * (1.0 - gamma**slots) / (1.0 - gamma))


def time_reward(
    world: World,
    before: Approach,
    after: Approach,
    slot: Slot,
    gamma: float,
) -> Array:
    """Returns -slot + gamma Phi' - Phi, or CRASH for a crash, (N,).

    On arrival Phi' is minus the time that the place of the stop costs on the next segment.
    """
    stopped = -after.next_excess / world.v_max[..., 0]
    ahead = np.where(slot.arrived, stopped, potential(world, after, gamma))
    shaped = -world.slot + gamma * ahead - potential(world, before, gamma)
    return np.where(slot.crashed, CRASH, shaped)


def lost_reward(
    world: World,
    before: Approach,
    after: Approach,
    slot: Slot,
    gamma: float,
    crash: float = CRASH,
) -> Array:
    """Returns minus the time lost in the slot (N,): the slot less the fall of the time to go, in s.

    It is `time_reward` without the discount in its potential: a second counts the same wherever it
    is lost, and a short horizon sees what an action costs. Arrivals are treated the same.
    """
    stopped = after.next_excess / world.v_max[..., 0]
    left = np.where(slot.arrived, stopped, after.time_to_go(world))
    lost = world.slot + left - before.time_to_go(world)
    return np.where(slot.crashed, crash, -lost)


def paper_reward(
    world: World, before: Approach, after: Approach, slot: Slot, gamma: float
) -> Array:
    """Returns the paper's reward (N,) of section V-A, with r5 and r6 charged per slot.

    It is r1 + r2 on the way to an item and r3 + r4 on the way home.
    """
    reward = -np.linalg.norm(after.offset, axis=-1)
    reward = reward + np.where(slot.arrived, np.where(before.returning, R4, R2), 0.0)
    return np.asarray(reward + R5 * slot.contact + R6 * slot.outside)


@dataclass(frozen=True)
class Preset:
    """Holds a reward function and whether a crash ends the episode under it."""

    reward: Callable[[World, Approach, Approach, Slot, float], Array]
    crash_ends: bool


# Under `paper` r1 costs hundreds per slot, so a crash that ended the episode would be the best
# policy. There a crash is charged per slot, and motion goes on by (2)-(3).
PRESETS = {
    "time": Preset(time_reward, True),
    "lost": Preset(lost_reward, True),
    "careful": Preset(partial(lost_reward, crash=CAREFUL_CRASH), True),
    "paper": Preset(paper_reward, False),
}
