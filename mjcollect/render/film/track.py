"""Holds where a UAV is in each frame of a film, and the path that is drawn behind it."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from mjcollect.geometry.compiled import Array
from mjcollect.geometry.polyline import interpolate, marks
from mjcollect.render.camera import View
from mjcollect.render.fleet import FleetProgress
from mjcollect.render.overlay import speed_colours, uav_colour

SPACING = 3.0  # Points of the drawn path are so far apart (m);
# farther than this from the camera (m), so many pieces are drawn as one: those of UAVs that are not
# followed always, those of the one that is if they bend by less than this share of a pixel and
# their colours differ by less than this (of 1).
NEAR, COARSE = 120.0, 4
UNSEEN, ALIKE = 0.25, 0.04
MAX_TRAIL = 600  # Only so many pieces of a path are shown, to bound the renderer's memory.
TURN = 0.12  # A quadrotor turns in about this time (s); recorded commands jump from slot to slot.


class Track:
    """Holds where one UAV is in each frame, and points along its path.

    Attributes:
        x, v, a: (F, 3) position, velocity and acceleration in m and s.
        shields: (F,) whether the shield acts. reached: (F,) number of targets reached.
        goals: (F, 3) what it flies to, in metres.
        trail: (N, 3) points at equal distances along its path. trail_time: (N,) when it was there.
    """

    def __init__(self, fleet: FleetProgress, m: int, t: Array, span: float) -> None:
        """Finds the state of flight `m` at times t (F,), between rows where needed.

        Each frame stands for the `span` seconds up to the next one, so that no slot is lost.
        """
        done, shielded = fleet.flights[m], fleet.shielded[m]
        flown, step = done.trajectory, done.scene.physics_step
        # Who is home rests until the last one is.
        rest = max(0, math.ceil((t[-1] - flown.t[-1]) / step - 1e-6))
        rows = np.append(flown.t, flown.t[-1] + step * np.arange(1, rest + 1))
        x = np.concatenate([flown.x, np.tile(flown.x[-1], (rest, 1))])
        v, a = (np.concatenate([part, np.zeros((rest, 3))]) for part in (flown.v, flown.a))
        smooth = gaussian_filter1d(a, TURN / step, axis=0, mode="nearest")
        self.x, self.v, self.a = (interpolate(part, rows, t) for part in (x, v, smooth))
        begin, end = (t[:, None] + off for off in (1e-9, span - 1e-9))
        acts = (shielded[:, 0] < end) & (shielded[:, 1] > begin)
        self.shields = np.asarray(acts.any(axis=1))
        at = np.searchsorted(rows, t + 1e-9, side="right") - 1
        self.reached = np.searchsorted(done.rows, at, side="right")
        self.goals = np.array([done.scene.point(done.goal(count)) for count in self.reached])

        travelled = marks(flown.x)
        pieces = max(1, math.ceil(travelled[-1] / SPACING))
        places = np.linspace(0.0, travelled[-1], pieces + 1)
        self.trail = interpolate(flown.x, travelled, places)
        self.trail_time = np.interp(places, travelled, flown.t)
        speed = np.interp(places, travelled, np.linalg.norm(flown.v, axis=1))
        self.colours = speed_colours(speed, fleet.scene.v_max)
        if not fleet.is_alone:
            self.colours = np.tile(np.divide(uav_colour(fleet, m), 255), (len(places), 1))
        self._followed = m == fleet.lead
        blocks = pieces // COARSE
        parts = np.arange(blocks)[:, None] * COARSE + np.arange(COARSE + 1)
        path, shades = self.trail[parts], self.colours[parts[:, :COARSE]]  # (blocks, ., 3)
        chord = np.linspace(path[:, 0], path[:, -1], COARSE + 1, axis=1)
        self._bend = np.linalg.norm(path - chord, axis=2).max(axis=1, initial=0.0)
        self._varied = np.ptp(shades, axis=1).max(axis=1, initial=0.0) > ALIKE

    def point(self, time: Array) -> NDArray[np.int_]:
        """Returns the last point of the trail that was passed at times (...) in s."""
        # A UAV that rests at first leaves its first point later than at the beginning.
        return np.maximum(np.searchsorted(self.trail_time, time, side="right") - 1, 0)

    def flown(self, frame: int, last: int, view: View) -> tuple[Array, Array]:
        """Returns the path (P, 3) up to a frame, which passed the point `last`; RGB of its pieces.

        Far from the camera `view`, pieces are put together; on the path of the UAV that is followed
        only where that cannot be seen.
        """
        whole = last // COARSE  # blocks of pieces that are flown to their end
        firsts = self.trail[: whole * COARSE : COARSE]
        away = np.linalg.norm(firsts - view.eye, axis=1) - COARSE * SPACING
        fine = away < NEAR
        if self._followed:
            fine |= self._varied[:whole] | (self._bend[:whole] > UNSEEN * view.pixel * away)
        shown = np.ones(last + 1, dtype=bool)
        shown[: whole * COARSE] = np.repeat(fine, COARSE)
        shown[::COARSE] = True
        if self._followed:
            shown[: max(0, last + 1 - MAX_TRAIL)] = False
        kept = np.flatnonzero(shown)
        return np.concatenate([self.trail[kept], self.x[frame, None]]), self.colours[kept]
