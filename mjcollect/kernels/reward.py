"""The least time to go, see `mjcollect.reward`."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from mjcollect.compiled import Array, compiled
from mjcollect.kernels.flight import scene_of

if TYPE_CHECKING:
    from mjcollect.flight import World


@compiled
def time_to_go(
    world: World, distance: Array, closing: Array, slack: Array, cap: float, time: Array
) -> None:
    """See `reward.time_to_go`."""
    for i in range(len(time)):
        w = scene_of(world, i)
        a, top = world.a_max[w, 0], world.v_max[w, 0]
        away = min(closing[i], 0.0)  # first brake the receding motion
        left = distance[i] + away**2 / (2 * a)
        speed = min(max(closing[i], 0.0), top)
        braking = speed**2 / (2 * a)
        near, far = max(left - slack[i], 0.0), left + slack[i]
        if braking >= near:
            # If too fast to stop before the far end: brake, then come back.
            time[i] = speed / a + 2 * math.sqrt(max(braking - far, 0.0) / a)
        else:
            peak = math.sqrt(a * near + speed**2 / 2)
            cruise = max(near - (2 * top**2 - speed**2) / (2 * a), 0.0) / top
            time[i] = (2 * min(peak, top) - speed) / a + cruise
        time[i] = min(time[i] - away / a, cap)
