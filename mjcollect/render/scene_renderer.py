"""The MuJoCo side of a video: one off-screen renderer for stills and for the chase view.

Physics is not stepped: the quadrotor is put where the trajectory says, tilted along its thrust.
Import this only with MUJOCO_GL set, as mujoco reads it when it is imported.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np

from mjcollect.geometry.compiled import Array
from mjcollect.render.arrivals import Progress
from mjcollect.render.camera import Picture, View
from mjcollect.scene.mjcf import DEPOT_RGBA, ITEM_RGBA, JOINTS, UAV_BODY, build
from mjcollect.scene.scene import Scene

COLLECTED_RGBA = (0.0, 0.70, 0.50, 0.35)  # see-through: the flight goes on from inside it
TARGET_RGBA = (0.95, 0.25, 0.60, 1.0)
FULL_WIDTH = 20.0  # metres from the camera, from which the trail has its full width
MAX_TRAIL = 600  # capsules
GRAVITY = 9.81
ROTOR_STEP = 0.9  # rad a frame; cosmetic


class Stage:
    """A compiled scene with a renderer. Use as a context manager, or call `close`."""

    def __init__(
        self, scene: Scene, size: tuple[int, int], *, scale: float = 8.0, samples: int = 0
    ) -> None:
        """Compile and open the renderer.

        Args:
            scene: what to show. size: width and height in pixels.
            scale: enlargement of the quadrotor, which is 0.6 m wide.
            samples: multisampling; 4 looks best, 0 takes less than half the time.
        """
        root = build(scene, visual_scale=scale)
        self.model = mujoco.MjModel.from_xml_string(root.to_xml_string(), root.get_assets())
        self.model.vis.quality.offsamples = samples
        self.model.vis.global_.offwidth, self.model.vis.global_.offheight = size
        self.data = mujoco.MjData(self.model)
        self._scene = scene
        self._body = self.model.body(UAV_BODY).id
        self._qpos = [int(self.model.joint(name).qposadr[0]) for name in JOINTS]
        self._boxes = [self.model.geom(f"obstacle_{i}").id for i in range(len(scene.obstacles))]
        self._items = [self.model.site(f"item_{i}").id for i in range(len(scene.items))]
        self._depot = self.model.site("depot").id
        self._blades = [
            self.model.geom(f"quadrotor/blade_{corner}").id for corner in ("fl", "fr", "bl", "br")
        ]
        self._camera = mujoco.MjvCamera()
        self._without_uav = mujoco.MjvOption()
        self._without_uav.geomgroup[2] = 0
        geoms = self.model.ngeom + self.model.nsite + MAX_TRAIL + 200
        self._renderer = mujoco.Renderer(self.model, size[1], size[0], max_geom=geoms)

    def __enter__(self) -> Stage:
        """The stage itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the renderer."""
        self.close()

    def close(self) -> None:
        """Free the GL context."""
        self._renderer.close()

    def mark(self, progress: Progress, reached: int) -> None:
        """Colour items and depot for the moment when `reached` targets were reached."""
        rgba = self.model.site_rgba
        rgba[self._items] = ITEM_RGBA
        rgba[self._depot] = DEPOT_RGBA
        for node in progress.collected(reached):
            rgba[self._items[node]] = COLLECTED_RGBA
        if reached < len(progress.targets):
            node = progress.targets[reached]
            rgba[self._depot if node < 0 else self._items[node]] = TARGET_RGBA

    def still(self, view: View) -> Picture:
        """Picture (H, W, 3) uint8 of the whole scene with see-through boxes, no quadrotor.

        Stills are few, so they are smoothed whatever the renderer's multisampling: the mean of
        four pictures from places less than a pixel apart.
        """
        self.model.geom_rgba[self._boxes, 3] = 0.55
        mujoco.mj_forward(self.model, self.data)
        right, up, _ = view.axes
        tangent = 2 * np.tan(np.radians(view.fovy) / 2) / view.size[1]
        pixel = float(np.linalg.norm(view.target - view.eye)) * tangent
        total = np.zeros((view.size[1], view.size[0], 3), dtype=np.uint16)
        for u, v in ((-0.375, -0.125), (0.125, -0.375), (0.375, 0.125), (-0.125, 0.375)):
            shift = pixel * (u * right + v * up)
            self._aim(
                replace(view, eye=view.eye + shift, target=view.target + shift), self._without_uav
            )
            self._add_frame()
            total += self._renderer.render()
        return (total // 4).astype(np.uint8)

    def _add_frame(self) -> None:
        """Lines from items to the ground and along the bounds, for depth."""
        low, high = self._scene.bounds
        for node in (-1, *range(len(self._items))):
            foot = self._scene.point(node).copy()
            foot[2] = low[2]
            self._capsule(self._scene.point(node), foot, 1.0, (0.95, 0.95, 0.95, 0.7))
        for a, b in _edges(low, high):
            self._capsule(a, b, 0.8, (0.30, 0.34, 0.38, 0.6))

    def place(self, x: Array, a: Array, heading: float, frame: int) -> None:
        """Put the quadrotor at `x` (3,), tilted as acceleration `a` (3,) needs, rotors turned."""
        rotation = attitude(a, heading)
        quaternion = np.empty(4)
        mujoco.mju_mat2Quat(quaternion, rotation.ravel())
        # The slide joints turn with the body, so their positions are world ones turned back.
        self.model.body_quat[self._body] = quaternion
        self.data.qpos[self._qpos] = rotation.T @ x
        for index, blade in enumerate(self._blades):
            turn = (1 if index in (0, 3) else -1) * ROTOR_STEP * frame / 2
            self.model.geom_quat[blade] = (np.cos(turn), 0.0, 0.0, np.sin(turn))
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)

    def chase(self, view: View, trail: Array, colours: Array, width: float, goal: Array) -> Picture:
        """Picture (H, W, 3) uint8 from the chase camera.

        Args:
            view: the camera.
            trail: (N, 3) flown path up to now; its last MAX_TRAIL pieces are shown.
            colours: (N - 1, 3) of its pieces. width: radius of the trail, in metres.
            goal: (3,) where the thin straight line from the quadrotor leads.
        """
        self.model.geom_rgba[self._boxes, 3] = 1.0
        self._aim(view, None)
        first = max(0, len(trail) - 1 - MAX_TRAIL)
        for a, b, colour in zip(trail[first:-1], trail[first + 1 :], colours[first:], strict=True):
            # Thinner near the camera, which the path may pass closely; never under a pixel afar.
            away = float(np.linalg.norm(a - view.eye))
            radius = max(width * min(1.0, away / FULL_WIDTH), away / view.size[1])
            self._capsule(a, b, radius, (*colour, 1.0), emission=0.45)
        self._capsule(trail[-1], goal, 0.12, (1.0, 1.0, 1.0, 0.35), emission=0.5)
        return self._renderer.render()

    def _aim(self, view: View, option: mujoco.MjvOption | None) -> None:
        offset = view.target - view.eye
        distance = float(np.linalg.norm(offset))
        self._camera.lookat[:] = view.target
        self._camera.distance = distance
        self._camera.azimuth = np.degrees(np.arctan2(offset[1], offset[0]))
        self._camera.elevation = np.degrees(np.arcsin(offset[2] / distance))
        self.model.vis.global_.fovy = view.fovy
        self._renderer.update_scene(self.data, self._camera, option)

    def _capsule(
        self, a: Array, b: Array, radius: float, rgba: Sequence[float], emission: float = 0.3
    ) -> None:
        scene = self._renderer.scene
        if scene.ngeom >= scene.maxgeom:
            return
        geom = scene.geoms[scene.ngeom]
        mujoco.mjv_initGeom(
            geom, mujoco.mjtGeom.mjGEOM_CAPSULE, np.zeros(3), np.zeros(3), np.zeros(9),
            np.asarray(rgba, dtype=np.float32),
        )  # fmt: skip
        mujoco.mjv_connector(geom, mujoco.mjtGeom.mjGEOM_CAPSULE, radius, a, b)
        geom.emission = emission
        scene.ngeom += 1


def attitude(a: Array, heading: float) -> Array:
    """Rotation (3, 3) of a quadrotor whose thrust gives acceleration `a` (3,) against gravity.

    Its nose points to `heading` (radians) as far as the tilt allows.
    """
    up = a + np.array([0.0, 0.0, GRAVITY])
    # A point mass may brake its climb harder than gravity does; a picture on its back confuses.
    up[2] = max(up[2], 0.6 * GRAVITY)
    up = up / np.linalg.norm(up)
    side = np.cross(up, [np.cos(heading), np.sin(heading), 0.0])
    side = side / np.linalg.norm(side)
    return np.stack([np.cross(side, up), side, up], axis=1)


def _edges(low: Array, high: Array) -> list[tuple[Array, Array]]:
    """The twelve edges of a box."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    points = low + corners * (high - low)
    return [
        (points[i], points[j])
        for i in range(8)
        for j in range(i + 1, 8)
        if np.abs(corners[i] - corners[j]).sum() == 1
    ]
