"""Places cameras: one that frames a box, and a chase camera that stays out of boxes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d, minimum_filter1d

from mjcollect.geometry.compiled import Array
from mjcollect.geometry.turns import in_axes
from mjcollect.scene.scene import Scene

Picture = NDArray[np.uint8]  # (H, W, 3)
# When a box is in the way, the chase camera may turn and rise from straight behind (degrees).
SWING = np.array([0.0, -35.0, 35.0, -70.0, 70.0, -110.0, 110.0])
RAISE = np.array([0.0, 20.0, 40.0, 58.0, -30.0])
BEHIND_ELEVATION = 17.0  # From straight behind, the chase camera looks down by this (degrees).
TILT = np.radians([-25.0, 78.0])  # The chase camera's elevation stays in this range (rad).
BOOM = 24.0  # The chase camera follows a body of up to 0.5 m radius at this distance (m).
CHASE_FOVY = 55.0  # The chase camera has this field of view (degrees).
CLEARANCE = 0.9  # The line of sight keeps this share of the body's radius from boxes.
KEYFRAME = 0.2  # The chase camera decides anew after this time (s of video).


@dataclass(frozen=True)
class View:
    """Describes a pinhole camera without roll that looks neither straight up nor straight down.

    Attributes:
        eye, target: (3,) where it is and what it looks at, in metres.
        fovy: vertical field of view in degrees.
        size: width and height in pixels.
    """

    eye: Array
    target: Array
    fovy: float
    size: tuple[int, int]

    @cached_property
    def axes(self) -> Array:
        """Returns the unit vectors to the right, up and forward, (3, 3)."""
        forward = self.target - self.eye
        forward = forward / np.linalg.norm(forward)
        right = np.array([forward[1], -forward[0], 0.0])
        right = right / np.linalg.norm(right)
        x, y = right[:2]  # np.cross, which takes any axes, is slow for two vectors
        up = [y * forward[2], -x * forward[2], x * forward[1] - y * forward[0]]
        return np.array([right, up, forward])

    @property
    def pixel(self) -> float:
        """Returns how many metres a pixel shows at a depth of 1 m, in the picture's middle."""
        return 2 * float(np.tan(np.radians(self.fovy) / 2)) / self.size[1]

    def project(self, points: Array) -> tuple[Array, Array]:
        """Returns pixels (..., 2), x right and y down, and depth (...) in m, negative if behind."""
        along = (points - self.eye) @ self.axes.T
        right, up, depth = along[..., 0], along[..., 1], along[..., 2]
        width, height = self.size
        focal = height / 2 / np.tan(np.radians(self.fovy) / 2)
        scale = focal / np.where(np.abs(depth) < 1e-9, 1e-9, depth)
        return np.stack([width / 2 + right * scale, height / 2 - up * scale], axis=-1), depth

    def may_see(self, points: Array, radius: Array) -> Array:
        """Returns whether pieces of a path may be in the picture, (N - 1,).

        A piece is not if it lies all on the outer side of one edge of the picture, or behind.

        Args:
            points: (N, 3) the path in metres. radius: (N - 1,) how thick its pieces are, in m.
        """
        right, up, depth = self.axes @ (points - self.eye).T
        high = np.tan(np.radians(self.fovy) / 2)
        wide = high * self.size[0] / self.size[1]
        beyond = np.stack([
            (np.abs(right) - wide * depth) / np.hypot(1.0, wide),
            (np.abs(up) - high * depth) / np.hypot(1.0, high),
        ])  # fmt: skip
        sides = np.stack([np.sign(right), np.sign(up)])
        out = (beyond[:, :-1] > radius) & (beyond[:, 1:] > radius) & (sides[:, :-1] == sides[:, 1:])
        behind = (depth[:-1] < -radius) & (depth[1:] < -radius)
        return ~(out.any(axis=0) | behind)


def framing(
    bounds: Array, direction: Array, fovy: float, size: tuple[int, int], fill: float = 0.94
) -> View:
    """Returns the nearest view of a box along a direction that shows all of it.

    Args:
        bounds: (2, 3) the box. direction: (3,) from the camera to the box.
        fovy: vertical field of view in degrees. size: width and height in pixels.
        fill: the share of the picture's width and height that the box may take.
    """
    centre = bounds.mean(axis=0)
    unit = direction / np.linalg.norm(direction)
    corners = np.stack(np.meshgrid(*bounds.T), axis=-1).reshape(-1, 3) - centre
    right, up, forward = View(centre - unit, centre, fovy, size).axes @ corners.T
    tangent = np.tan(np.radians(fovy) / 2) * fill
    aspect = size[0] / size[1]
    back = np.maximum(np.abs(right) / (tangent * aspect), np.abs(up) / tangent) - forward
    return View(centre - unit * back.max(), centre, fovy, size)


def clear_distance(start: Array, direction: Array, boxes: Array, margin: float) -> Array:
    """Returns how far one can go before coming within a margin of a box; inf if never.

    A box that is already nearer than the margin counts with nine tenths of its distance instead,
    so that one can always move away from it; a box around the start is ignored.

    Args:
        start, direction: (..., 3), in m and of unit length. boxes: (M, 2, 3). margin: in m.

    Returns:
        (...) in metres.
    """
    start = in_axes(start[..., None, :], boxes)
    direction = in_axes(direction[..., None, :], boxes)
    # Along its axes, as the grown box has sharp corners.
    gap = np.abs(np.clip(start, boxes[:, 0], boxes[:, 1]) - start).max(axis=-1)
    grow = np.minimum(margin, 0.9 * gap)[..., None]
    step = np.where(np.abs(direction) < 1e-12, 1e-12, direction)
    one = (boxes[:, 0] - grow - start) / step
    two = (boxes[:, 1] + grow - start) / step
    enter = np.minimum(one, two).max(axis=-1)
    leave = np.maximum(one, two).min(axis=-1)
    hit = (enter <= leave) & (enter >= 0.0) & (gap > 0.0)
    return np.asarray(np.where(hit, enter, np.inf).min(axis=-1, initial=np.inf))


def chase_views(
    scene: Scene, x: Array, v: Array, goal: Array, fps: float, size: tuple[int, int]
) -> tuple[list[View], Array]:
    """Returns the chase camera in each frame and the headings (F,) in radians.

    Args:
        scene, x, v, goal, fps: as in `chase_eyes`. size: width and height in pixels.
    """
    boom = BOOM * max(1.0, scene.uav_radius / 0.5)
    eyes, heading = chase_eyes(scene, x, v, goal, fps, boom)
    eyes[:, 2] = np.maximum(eyes[:, 2], scene.bounds[0, 2] + 1.0)
    reach = np.linalg.norm(eyes - x, axis=1, keepdims=True)
    looks = x + 0.10 * reach * [0.0, 0.0, 1.0]
    views = [View(e, k, CHASE_FOVY, size) for e, k in zip(eyes, looks, strict=True)]
    return views, heading


def chase_eyes(
    scene: Scene, x: Array, v: Array, goal: Array, fps: float, distance: float
) -> tuple[Array, Array]:
    """Moves a camera that follows smoothly, behind and above, and never enters a box.

    The whole flight is known, so that filters look both ways and nothing lags. Per keyframe a
    direction is chosen among swings and raises (least total cost by dynamic programming); the
    boom along the smoothed direction is then shortened to what is clear.

    Args:
        scene: its boxes are avoided.
        x, v: (F, 3) position and velocity in each frame (m, m/s). goal: (F, 3) what it flies to.
        fps: frames per second of video. distance: length of the boom in metres.

    Returns:
        (F, 3) eyes and (F,) headings in radians.
    """
    heading, elevation = behind(scene, x, v, goal, fps)
    stride = max(1, round(KEYFRAME * fps))
    keys = np.arange(0, len(x), stride)
    swing, lift = _choose(scene, x[keys], heading[keys], elevation[keys], distance)
    frames = np.arange(len(x))
    sigma = 0.35 * fps
    azimuth = heading + np.pi + _smooth(np.interp(frames, keys, swing), sigma)
    tilt = _smooth(np.clip(elevation + np.interp(frames, keys, lift), *TILT), sigma)
    direction = _unit(azimuth, tilt)
    margin = CLEARANCE * scene.uav_radius
    reach = np.minimum(clear_distance(x, direction, scene.boxes, margin), distance)
    # A mean of window minima never exceeds the value in the window's centre.
    half = max(1, round(0.4 * fps))
    shortest = minimum_filter1d(reach, 2 * half + 1, mode="nearest")
    reach = gaussian_filter1d(shortest, half / 3, mode="nearest", radius=half)
    return x + reach[:, None] * direction, heading


def behind(scene: Scene, x: Array, v: Array, goal: Array, fps: float) -> tuple[Array, Array]:
    """Returns smooth heading (F,) and elevation (F,) of a camera straight behind, in radians.

    The quadrotor heads where this camera looks; see `chase_eyes` for the arguments.
    """
    ahead = goal - x
    length = np.linalg.norm(ahead, axis=1, keepdims=True)
    # At low speed look towards the goal: the direction of a vanishing velocity means nothing.
    course = v + 0.12 * scene.v_max * ahead / np.maximum(length, scene.epsilon)
    sideways = np.hypot(course[:, 0], course[:, 1])
    angle = np.arctan2(course[:, 1], course[:, 0])
    known = np.flatnonzero(sideways > 1e-3 * scene.v_max)
    if len(known):
        angle = angle[known[np.abs(np.arange(len(x))[:, None] - known).argmin(axis=1)]]
    heading = _smooth(np.unwrap(angle), 0.5 * fps)
    climb = np.arctan2(course[:, 2], np.maximum(sideways, 1e-9))
    tilt = np.radians(BEHIND_ELEVATION) - 0.6 * _smooth(climb, 0.6 * fps)
    return heading, np.clip(tilt, *TILT)


def _choose(
    scene: Scene, x: Array, heading: Array, elevation: Array, distance: float
) -> tuple[Array, Array]:
    """Returns the swing and raise (keys,) of least total cost in radians."""
    swing, lift = (grid.ravel() for grid in np.meshgrid(np.radians(SWING), np.radians(RAISE)))
    tilt = np.clip(elevation[:, None] + lift, *TILT)
    direction = _unit(heading[:, None] + np.pi + swing, tilt)
    margin = CLEARANCE * scene.uav_radius
    clear = clear_distance(x[:, None, :], direction, scene.boxes, margin)
    # Clipped tilts that would look up through the ground are as bad as a box.
    below = x[:, None, 2] + distance * direction[..., 2] < scene.bounds[0, 2] + 1.0
    short = 1.0 - np.minimum(clear / distance, 1.0)
    own = (
        (swing / 0.7) ** 2 + (lift / 0.5) ** 2 + 12.0 * short**2 + 30.0 * (short > 0.8) + 4 * below
    )
    change = (np.subtract.outer(swing, swing) ** 2 + np.subtract.outer(lift, lift) ** 2) / 0.15
    total, back = own[0], np.zeros(own.shape, dtype=int)
    for key in range(1, len(x)):
        path = total[:, None] + change
        back[key] = path.argmin(axis=0)
        total = path.min(axis=0) + own[key]
    best = np.empty(len(x), dtype=int)
    best[-1] = total.argmin()
    for key in range(len(x) - 1, 0, -1):
        best[key - 1] = back[key, best[key]]
    return swing[best], lift[best]


def _unit(azimuth: Array, elevation: Array) -> Array:
    flat = np.cos(elevation)
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1)


def _smooth(values: Array, sigma: float) -> Array:
    return np.asarray(gaussian_filter1d(values, sigma, mode="nearest"))
