"""Reward presets, vectorised over N simulations.

`lost`, what policies learn from by default: minus the time lost against the least time to go.
`time`: minus the time flown, shaped by a discount-consistent potential of the least
time to go. `careful`: the same with a crash that costs more, for flights that are disturbed.
`paper`: r1..r6 of the paper's section V-A to the letter.
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

CRASH = -2.0  # `time`: flat, with no potential term
CAREFUL_CRASH = -10.0  # at -2 a policy in wind risks crashes for tenths of a second
R2, R4, R5, R6 = 100.0, 100.0, -100.0, -200.0  # paper, section V-A


def potential(world: World, approach: Approach, gamma: float) -> Array:
    """Minus the discounted time to go (N,): the return of flying on and arriving on time."""
    slots = approach.time_to_go(world) / world.slot
    return np.asarray(-world.slot * (1.0 - gamma**slots) / (1.0 - gamma))


def time_reward(
    world: World,
    before: Approach,
    after: Approach,
    slot: Slot,
    gamma: float,
    crash: float = CRASH,
) -> Array:
    """-slot + gamma Phi' - Phi; `crash` flat for a crash. Shape (N,).

    On arrival Phi' is minus the time that the place of the stop costs on the next leg.
    """
    stopped = -after.next_excess / world.v_max[..., 0]
    ahead = np.where(slot.arrived, stopped, potential(world, after, gamma))
    shaped = -world.slot + gamma * ahead - potential(world, before, gamma)
    return np.where(slot.crashed, crash, shaped)


def lost_reward(world: World, before: Approach, after: Approach, slot: Slot, gamma: float) -> Array:
    """Minus the seconds lost in the slot: flown, less what the least time to go fell by. (N,).

    `time` without the discount in its potential, so that a second counts the same wherever it is
    lost, and a short horizon sees what an action costs. On arrival as `time`.
    """
    stopped = after.next_excess / world.v_max[..., 0]
    left = np.where(slot.arrived, stopped, after.time_to_go(world))
    lost = world.slot + left - before.time_to_go(world)
    return np.where(slot.crashed, CRASH, -lost)


def paper_reward(
    world: World, before: Approach, after: Approach, slot: Slot, gamma: float
) -> Array:
    """r1 + r2 on the way to an item, r3 + r4 on the way home, r5 and r6 charged per slot. (N,)."""
    reward = -np.linalg.norm(after.offset, axis=-1)
    reward = reward + np.where(slot.arrived, np.where(before.returning, R4, R2), 0.0)
    return np.asarray(reward + R5 * slot.contact + R6 * slot.outside)


@dataclass(frozen=True)
class Preset:
    """A reward and whether a crash ends the episode under it."""

    reward: Callable[[World, Approach, Approach, Slot, float], Array]
    crash_ends: bool


# Under `paper` a crash that ended the episode would be the best policy, since r1 costs hundreds
# a slot: there it is charged per slot and motion goes on by (2)-(3).
PRESETS = {
    "time": Preset(time_reward, True),
    "lost": Preset(lost_reward, True),
    "careful": Preset(partial(time_reward, crash=CAREFUL_CRASH), True),
    "paper": Preset(paper_reward, False),
}
