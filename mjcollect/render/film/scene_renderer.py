"""Renders a scene off-screen by MuJoCo, for stills and for the chase view.

Import this only with MUJOCO_GL set, as mujoco reads it when it is imported.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations, product

import mujoco
import numpy as np

from mjcollect.geometry.compiled import Array
from mjcollect.render.camera import Picture, View
from mjcollect.render.film.track import MAX_TRAIL
from mjcollect.render.fleet import FleetProgress
from mjcollect.render.flown_model import FlownModel
from mjcollect.render.settings import VideoSettings

MOVING_RGBA = (0.50, 0.36, 0.86, 1.0)
TRAIL_RADIUS = 0.09  # The flown path is a tube of this radius (m).
FULL_WIDTH = 20.0  # Nearer to the camera than this (m), the path is thinner.
GROUND = 5  # The ground is in this group of geoms, which MuJoCo does not show by itself.
LINE_RGBA = (1.0, 1.0, 1.0, 0.35)
# A still is the mean of pictures from places so many pixels beside the camera's.
SUBPIXELS = ((-0.375, -0.125), (0.125, -0.375), (0.375, 0.125), (-0.125, 0.375))


class Stage:
    """Shows a compiled scene; call `close` at the end."""

    def __init__(self, fleet: FleetProgress, settings: VideoSettings) -> None:
        """Compiles the scene with a quadrotor for each flight, and opens the renderer."""
        scene, count = fleet.scene, len(fleet.flights)
        flown = FlownModel(fleet)
        self.model, self.data = flown.model, flown.data
        self.mark, self.place = flown.mark, flown.place
        self.model.vis.quality.offsamples = settings.samples
        self.model.vis.global_.offwidth, self.model.vis.global_.offheight = settings.size
        self._scene, self._fleet = scene, fleet
        # Colours that shine by themselves are paler; those of UAVs are not to be mixed up.
        self._glow = 0.45 if fleet.is_alone else 0.15
        solid = [i for i in range(len(scene.obstacles)) if i not in scene.no_fly]
        self._boxes = [self.model.geom(f"obstacle_{i}").id for i in solid]
        self._camera = mujoco.MjvCamera()
        # The ground is drawn last, as most of it is behind something: hidden pixels cost little.
        self.model.geom_group[self.model.geom("ground").id] = GROUND
        self._ground = mujoco.MjvOption()
        self._ground.geomgroup[:] = self._ground.sitegroup[:] = 0
        self._ground.geomgroup[GROUND] = 1
        self._without_uav = mujoco.MjvOption()
        self._without_uav.geomgroup[2] = 0
        geoms = self.model.ngeom + self.model.nsite + MAX_TRAIL * count + 200
        width, height = settings.size
        self._renderer = mujoco.Renderer(self.model, height, width, max_geom=geoms)
        self.close = self._renderer.close
        self._filter_less()

    def _filter_less(self) -> None:
        """Takes each pixel from one size of a texture, not two: in software a sixth of GL's time.

        Ground and boxes differ by 0.04 of a grey level in the mean. Points of the sky's texture,
        which is always enlarged, are so alike that a pixel needs one, not four. Only EGL and OSMesa
        are sure to be the GL that PyOpenGL speaks to.
        """
        if os.environ.get("PYOPENGL_PLATFORM") not in ("egl", "osmesa"):
            return
        from OpenGL import GL

        context = self._renderer._mjr_context
        for k in range(context.ntexture):
            sky = context.textureType[k] == mujoco.mjtTexture.mjTEXTURE_SKYBOX
            target = GL.GL_TEXTURE_CUBE_MAP if sky else GL.GL_TEXTURE_2D
            GL.glBindTexture(target, int(context.texture[k]))
            if sky:
                GL.glTexParameteri(target, GL.GL_TEXTURE_MAG_FILTER, GL.GL_NEAREST)
                GL.glTexParameteri(target, GL.GL_TEXTURE_MIN_FILTER, GL.GL_NEAREST)
            else:
                GL.glTexParameteri(target, GL.GL_TEXTURE_MIN_FILTER, GL.GL_LINEAR_MIPMAP_NEAREST)
            GL.glBindTexture(target, 0)

    def still(self, view: View, reached: Sequence[int]) -> Picture:
        """Returns a picture (H, W, 3) uint8 of the whole scene, boxes see-through, no quadrotor.

        Items and depot are coloured for the moment when so many targets were reached, (M,).

        Stills are few, so they are smoothed whatever the renderer's multisampling: the mean of
        four pictures from places less than a pixel apart.
        """
        self.mark(reached)
        self.model.geom_rgba[self._boxes, 3] = 0.55
        mujoco.mj_forward(self.model, self.data)
        right, up, _ = view.axes
        tangent = 2 * np.tan(np.radians(view.fovy) / 2) / view.size[1]
        pixel = float(np.linalg.norm(view.target - view.eye)) * tangent
        total = np.zeros((view.size[1], view.size[0], 3), dtype=np.uint16)
        for u, v in SUBPIXELS:
            shift = pixel * (u * right + v * up)
            moved = replace(view, eye=view.eye + shift, target=view.target + shift)
            self._aim(moved, self._without_uav)
            self._add_frame()
            total += self._renderer.render()
        return (total // 4).astype(np.uint8)

    def _add_frame(self) -> None:
        """Draws lines from items to the ground and along the bounds, for depth."""
        for node in self._scene.nodes:
            point = self._scene.point(node)
            foot = np.array([*point[:2], self._scene.bounds[0, 2]])
            self._capsule(point, foot, 1.0, (0.95, 0.95, 0.95, 0.7))
        corners = [np.array(corner) for corner in product(*self._scene.bounds.T)]
        for a, b in combinations(corners, 2):
            if np.sum(a != b) == 1:  # an edge
                self._capsule(a, b, 0.8, (0.30, 0.34, 0.38, 0.6))

    def chase(
        self, view: View, reached: Sequence[int], trails: Sequence[tuple[Array, Array]],
        goal: Array, moving: Sequence[Array] = (),
    ) -> Picture:  # fmt: skip
        """Returns a picture (H, W, 3) uint8 from the chase camera.

        Args:
            view: the camera. reached: (M,) the targets reached, for the colours of items and depot.
            trails: of each flight (N, 3) its path up to now, whose last MAX_TRAIL pieces are shown,
                and (N - 1, 3) RGB in 0..1 of its pieces.
            goal: (3,) where the thin straight line from the lead leads.
            moving: (2, 3) corners of each moving box.
        """
        self.mark(reached)
        self.model.geom_rgba[self._boxes, 3] = 1.0
        self._aim(view, None)
        for trail, colours in trails:
            self._trail(view, trail, colours)
        self._capsule(trails[self._fleet.lead][0][-1], goal, 0.12, LINE_RGBA, emission=0.5)
        for box in moving:
            self._box(box)
        return self._renderer.render()

    def _trail(self, view: View, trail: Array, colours: Array) -> None:
        first = max(0, len(trail) - 1 - MAX_TRAIL)
        trail, colours = trail[first:], colours[first:]
        # Thinner near the camera, which the path may pass closely; never under a pixel afar.
        away = np.linalg.norm(trail[:-1] - view.eye, axis=1)
        radius = np.maximum(TRAIL_RADIUS * np.minimum(1.0, away / FULL_WIDTH), away / view.size[1])
        for k in np.flatnonzero(view.may_see(trail, radius)):
            self._capsule(
                trail[k], trail[k + 1], float(radius[k]), (*colours[k], 1.0), emission=self._glow
            )

    def _aim(self, view: View, option: mujoco.MjvOption | None) -> None:
        offset = view.target - view.eye
        distance = float(np.linalg.norm(offset))
        self._camera.lookat[:] = view.target
        self._camera.distance = distance
        self._camera.azimuth = np.degrees(np.arctan2(offset[1], offset[0]))
        self._camera.elevation = np.degrees(np.arcsin(offset[2] / distance))
        self.model.vis.global_.fovy = view.fovy
        self._renderer.update_scene(self.data, self._camera, option)
        mujoco.mjv_addGeoms(
            self.model, self.data, self._ground, mujoco.MjvPerturb(),
            mujoco.mjtCatBit.mjCAT_ALL.value, self._renderer.scene,
        )  # fmt: skip

    def _capsule(
        self, a: Array, b: Array, radius: float, rgba: Sequence[float], emission: float = 0.3
    ) -> None:
        scene = self._renderer.scene
        geom, capsule = scene.geoms[scene.ngeom], mujoco.mjtGeom.mjGEOM_CAPSULE
        colour = np.asarray(rgba, dtype=np.float32)
        mujoco.mjv_initGeom(geom, capsule, np.zeros(3), np.zeros(3), np.zeros(9), colour)
        mujoco.mjv_connector(geom, capsule, radius, a, b)
        # mjv_initGeom keeps the type of what was last in this place, which the renderer reads:
        # pictures would depend on those drawn before.
        geom.objtype = mujoco.mjtObj.mjOBJ_UNKNOWN
        geom.emission = emission
        scene.ngeom += 1

    def _box(self, box: Array) -> None:
        """Draws a moving box (2, 3), which is no part of the model."""
        scene = self._renderer.scene
        geom, kind = scene.geoms[scene.ngeom], mujoco.mjtGeom.mjGEOM_BOX
        turn, colour = np.eye(3).ravel(), np.asarray(MOVING_RGBA, dtype=np.float32)
        mujoco.mjv_initGeom(geom, kind, (box[1] - box[0]) / 2, box.mean(axis=0), turn, colour)
        geom.objtype = mujoco.mjtObj.mjOBJ_UNKNOWN
        geom.emission = 0.15
        scene.ngeom += 1
