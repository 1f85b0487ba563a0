"""Makes the MuJoCo model of a flown scene, in which quadrotors are put where they were.

Physics is not stepped: quadrotors are tilted along their thrust.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from mjcollect.geometry.compiled import Array
from mjcollect.render.fleet import FleetProgress
from mjcollect.render.overlay import node_look, uav_colour
from mjcollect.scene.mjcf import DEPOT_RGBA, ITEM_RGBA, build, site_name, uav_name

# Nodes have these colours by `Progress.state`.
NODES_RGBA = {
    "target": (0.95, 0.25, 0.60, 1.0),
    "collected": (0.0, 0.70, 0.50, 0.35),  # see-through: the flight goes on from inside it
    "depot": DEPOT_RGBA,
    "item": ITEM_RGBA,
}
ITEM_SHADE = 0.8  # Items shine, so that the colours of UAVs on them must be darker.
COLLECTED_ALPHA = 0.5  # So opaque is an item in the colour of the UAV that collected it.
GRAVITY = 9.81  # A hovering quadrotor pushes against this (m/s^2).
ROTOR_STEP = 0.9  # Rotors turn by this angle (rad) from frame to frame, to look alive.


class Pose(NamedTuple):
    """Holds where a quadrotor is in a picture.

    Attributes:
        x: (3,) its position in metres. a: (3,) its acceleration in m/s^2, which it tilts for.
        heading: direction of its nose in radians.
    """

    x: Array
    a: Array
    heading: float


class FlownModel:
    """Is the model of a scene with a quadrotor for each flight.

    Attributes:
        model, data: MuJoCo's.
    """

    def __init__(self, fleet: FleetProgress) -> None:
        """Compiles the scene."""
        scene, count = fleet.scene, len(fleet.flights)
        root = build(scene, visual_scale=fleet.uav_scale, uavs=count)
        self.model = mujoco.MjModel.from_xml_string(root.to_xml_string(), root.get_assets())
        self.data = mujoco.MjData(self.model)
        self._fleet = fleet
        names = [uav_name(number, count) for number in range(count)]
        self._bodies = [self.model.body(f"{name}/uav").id for name in names]
        self._qpos = [
            [int(self.model.joint(f"{name}/{axis}").qposadr[0]) for axis in "xyz"] for name in names
        ]
        if not fleet.is_alone:
            for m, name in enumerate(names):
                self.model.geom(f"{name}/hull").rgba[:3] = np.divide(uav_colour(fleet, m), 255)
        self._sites = {node: self.model.site(site_name(node)).id for node in scene.nodes}
        self._blades = [
            self.model.geom(f"{name}/blade_{corner}").id
            for name in names
            for corner in ("fl", "fr", "bl", "br")
        ]

    def mark(self, reached: Sequence[int]) -> None:
        """Colours items and depot for the moment when so many targets were reached, (M,)."""
        for node, site in self._sites.items():
            state, _ = self._fleet.state(node, reached)
            rgba: Sequence[float] = NODES_RGBA[state]
            if not self._fleet.is_alone:
                alpha = COLLECTED_ALPHA if state == "collected" else 1.0
                fill = node_look(self._fleet, node, reached).fill
                rgba = (*np.multiply(fill, ITEM_SHADE / 255), alpha)
            self.model.site_rgba[site] = rgba

    def place(self, poses: Sequence[Pose], frame: int) -> None:
        """Puts the quadrotors where they are in a frame.

        Args:
            poses: one for each flight.
            frame: number of the frame, from which the rotors' angles follow.
        """
        for body, qpos, pose in zip(self._bodies, self._qpos, poses, strict=True):
            rotation = attitude(pose.a, pose.heading)
            # The slide joints turn with the body, so their positions are world ones turned back.
            mujoco.mju_mat2Quat(self.model.body_quat[body], rotation.ravel())
            self.data.qpos[qpos] = rotation.T @ pose.x
        for index, blade in enumerate(self._blades):
            turn = (1 if index % 4 in (0, 3) else -1) * ROTOR_STEP * frame / 2
            self.model.geom_quat[blade] = (np.cos(turn), 0.0, 0.0, np.sin(turn))
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)


def attitude(a: Array, heading: float) -> Array:
    """Returns the rotation (3, 3) of a quadrotor that accelerates by `a` (3,), in m/s^2.

    Its thrust also carries it against gravity; its nose points to `heading` (rad) as far as the
    tilt allows.
    """
    up = a + np.array([0.0, 0.0, GRAVITY])
    # A point mass may brake its climb harder than gravity does; a picture on its back confuses.
    up[2] = max(up[2], 0.6 * GRAVITY)
    up = up / np.linalg.norm(up)
    side = np.cross(up, [np.cos(heading), np.sin(heading), 0.0])
    side = side / np.linalg.norm(side)
    return np.stack([np.cross(side, up), side, up], axis=1)
