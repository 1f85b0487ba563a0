"""The least time to go, see `mjcollect.reward`."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from mjcollect.compiled import Array, compiled
from mjcollect.kernels.flight import scene_of

if TYPE_CHECKING:
    from mjcollect.flight import World


@compiled
def time_to_rest(distance: float, closing: float, slack: float, a_max: float, top: float) -> float:
    """See `reward.time_to_go`; without its cap."""
    away = min(closing, 0.0)  # first brake the receding motion
    left = distance + away**2 / (2 * a_max)
    speed = min(max(closing, 0.0), top)
    braking = speed**2 / (2 * a_max)
    near, far = max(left - slack, 0.0), left + slack
    if braking >= near:
        # If too fast to stop before the far end: brake, then come back.
        time = speed / a_max + 2 * math.sqrt(max(braking - far, 0.0) / a_max)
    else:
        peak = math.sqrt(a_max * near + speed**2 / 2)
        cruise = max(near - (2 * top**2 - speed**2) / (2 * a_max), 0.0) / top
        time = (2 * min(peak, top) - speed) / a_max + cruise
    return time - away / a_max


@compiled
def time_to_go(
    world: World, distance: Array, closing: Array, slack: Array, cap: float, time: Array
) -> None:
    """See `reward.time_to_go`."""
    for i in range(len(time)):
        w = scene_of(world, i)
        a_max, top = world.a_max[w, 0], world.v_max[w, 0]
        time[i] = min(time_to_rest(distance[i], closing[i], slack[i], a_max, top), cap)
