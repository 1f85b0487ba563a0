"""Builds the MJCF model of a scene and assets/quadrotor.xml, through dm_control.mjcf.

The quadrotor hangs on three slide joints, whose positions are world coordinates. Three actuators
drive it; their controls are accelerations in m/s^2. Only its collision sphere and the obstacle
boxes collide: ground, items, depot and every other geom are only there to be looked at.
"""

from __future__ import annotations

import mujoco
import numpy as np
from dm_control import mjcf

from mjcollect.geometry.compiled import Array
from mjcollect.scene.assets import asset_path
from mjcollect.scene.order import node_name
from mjcollect.scene.scene import Scene

# These are names in the compiled model.
UAV_BODY, UAV_GEOM, HIT_SENSOR = "quadrotor/uav", "quadrotor/body", "quadrotor/hit"
JOINTS = ("quadrotor/x", "quadrotor/y", "quadrotor/z")
ACTUATORS = ("quadrotor/ax", "quadrotor/ay", "quadrotor/az")
NEVER = 1e6  # metres; no contact is so deep, since no scene is so wide
OBSTACLE_RGBA = np.array(
    [[0.62, 0.70, 0.80, 1.0], [0.78, 0.74, 0.66, 1.0], [0.54, 0.65, 0.70, 1.0]]
)
NO_FLY_RGBA = (0.85, 0.25, 0.20, 0.35)
# These are bright on the grey-blue world, and the colour-blind can tell them apart (Okabe and Ito).
ITEM_RGBA = (0.95, 0.65, 0.0, 1.0)
DEPOT_RGBA = (0.10, 0.45, 0.85, 1.0)


def build(
    scene: Scene, *, solid: bool = True, visual_scale: float = 1.0, uavs: int = 1
) -> mjcf.RootElement:
    """Returns the MJCF of a scene with quadrotors, whose joints are at the coordinates' origin.

    Args:
        scene: what to build. uavs: number of quadrotors, named as `uav_name` says.
        solid: whether contacts stop the body. If not, they are sensed but motion goes on by
            eq. (2)-(3), as the `paper` reward preset needs.
        visual_scale: factor on the quadrotor's visual geoms, for pictures of a 1 km scene; the
            collision sphere keeps its true size. It is 1 for simulation.
    """
    root = mjcf.RootElement(model="mjcollect")
    root.option.timestep = scene.physics_step
    root.option.integrator = "Euler"
    root.option.gravity = (0.0, 0.0, 0.0)
    # Without warm start a step depends on the state alone, so that batched and single stepping
    # agree bit for bit through a contact.
    root.option.flag.warmstart = "disable"
    _add_surroundings(root, scene)
    for index, (box, yaw) in enumerate(zip(scene.obstacles, scene.yaw, strict=True)):
        half = np.radians(yaw) / 2
        turn = {"quat": (np.cos(half), 0.0, 0.0, np.sin(half))} if yaw else {}
        root.worldbody.add(
            "geom",
            name=f"obstacle_{index}",
            type="box",
            pos=(box[0] + box[1]) / 2,
            size=(box[1] - box[0]) / 2,
            **turn,
            contype=0,
            conaffinity=1,
            **(
                {"rgba": NO_FLY_RGBA}
                if index in scene.no_fly
                else {"material": "obstacle", "rgba": OBSTACLE_RGBA[index % len(OBSTACLE_RGBA)]}
            ),
        )
    for index, item in enumerate(scene.items):
        root.worldbody.add(
            "site",
            name=site_name(index),
            pos=item,
            size=(scene.epsilon,),
            material="glow",
            rgba=ITEM_RGBA,
        )
    for index, depot in enumerate(scene.depots):
        root.worldbody.add(
            "site",
            name=site_name(-1 - index),
            type="cylinder",
            pos=depot,
            size=(scene.return_tolerance, 0.3),
            material="glow",
            rgba=DEPOT_RGBA,
        )
    for number in range(uavs):
        name = uav_name(number, uavs)
        _add_quadrotor(root, scene, visual_scale, name)
        body = root.find("geom", f"{name}/body")
        if uavs > 1:  # They touch each other as well.
            body.conaffinity = 1
        if not solid:
            # MuJoCo senses contacts nearer than margin + gap = 0 and resolves those nearer than
            # margin, which is none. With constraints disabled it would not look for contacts.
            body.margin, body.gap = -NEVER, NEVER
    return root


def site_name(node: int) -> str:
    """Returns the name in the model of a node's site: item_3, depot for -1, depot_1 for -2."""
    return node_name(node).replace(" ", "_")


def uav_name(number: int, uavs: int) -> str:
    """Returns the name in the model of one of so many quadrotors, before `/uav` and the like."""
    return "quadrotor" if uavs == 1 else f"quadrotor_{number}"


def compile_model(scene: Scene, *, solid: bool = True, uavs: int = 1) -> mujoco.MjModel:
    """Returns the scene as a plain MuJoCo model, with arguments as in `build`."""
    root = build(scene, solid=solid, uavs=uavs)
    return mujoco.MjModel.from_xml_string(root.to_xml_string(), root.get_assets())


def let_boxes_sleep(model: mujoco.MjModel) -> None:
    """Has MuJoCo compute where boxes stand once, not in every step; the body never sleeps.

    Steps stay the same to the bit. Every MjData then belongs to this model alone: in one that
    another model has used before, the boxes would stand where that model's stood.
    """
    model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_SLEEP
    model.tree_sleep_policy[:] = mujoco.mjtSleepPolicy.mjSLEEP_NEVER


def _add_quadrotor(root: mjcf.RootElement, scene: Scene, visual_scale: float, name: str) -> None:
    quadrotor = mjcf.from_path(str(asset_path("quadrotor.xml")))
    quadrotor.model = name
    quadrotor.find("geom", "body").size = (scene.uav_radius,)
    if visual_scale != 1.0:
        for geom in quadrotor.find_all("geom"):
            if geom.name != "body":
                _scale(geom, visual_scale)
        visual = quadrotor.find("default", "visual")
        for default in visual.all_children():
            if default.tag == "default":
                _scale(default.geom, visual_scale)
    physics = mjcf.Physics.from_mjcf_model(quadrotor)
    mass = float(physics.bind(quadrotor.find("body", "uav")).subtreemass)
    physics.free()
    for actuator in quadrotor.find_all("actuator"):
        actuator.gear = (mass,)
    behind = np.array([-60.0, -30.0, 35.0])
    quadrotor.find("body", "uav").add(
        "camera",
        name="chase",
        mode="track",
        pos=behind,
        xyaxes=_look_at(behind, np.zeros(3)),
        fovy=60,
    )
    root.attach(quadrotor)


def _scale(geom: mjcf.Element, factor: float) -> None:
    for attribute in ("pos", "size", "fromto"):
        value = getattr(geom, attribute)
        if value is not None:
            setattr(geom, attribute, np.asarray(value) * factor)


def _add_surroundings(root: mjcf.RootElement, scene: Scene) -> None:
    """Adds sky, ground, lights and cameras, sized to the scene."""
    low, high = scene.bounds
    extent = float(np.max(high - low))
    centre = (low + high) / 2
    root.statistic.extent = extent
    root.statistic.center = centre
    root.visual.map.znear = 0.0002
    root.visual.map.zfar = 6.0
    root.visual.quality.offsamples = 0
    root.visual.quality.shadowsize = 0
    getattr(root.visual, "global").offwidth = 1920
    getattr(root.visual, "global").offheight = 1080
    root.visual.headlight.ambient = (0.50, 0.50, 0.50)
    root.visual.headlight.diffuse = (0.30, 0.30, 0.30)
    root.visual.headlight.specular = (0.0, 0.0, 0.0)
    root.asset.add(
        "texture", name="sky", type="skybox", builtin="gradient", width=256, height=256,
        rgb1=(0.55, 0.71, 0.88), rgb2=(0.90, 0.94, 0.98),
    )  # fmt: skip
    # Cells of 50 m on the ground and of 20 m on the boxes show speed and size.
    root.asset.add(
        "texture", name="ground", type="2d", builtin="checker", width=512, height=512,
        rgb1=(0.52, 0.57, 0.53), rgb2=(0.56, 0.61, 0.57), mark="edge", markrgb=(0.66, 0.71, 0.67),
    )  # fmt: skip
    root.asset.add(
        "material", name="ground", texture="ground", texuniform=True, texrepeat=(0.01, 0.01),
        specular=0,
    )  # fmt: skip
    root.asset.add(
        "texture", name="obstacle", type="2d", builtin="checker", width=256, height=256,
        rgb1=(0.90, 0.90, 0.90), rgb2=(1.0, 1.0, 1.0), mark="edge", markrgb=(0.72, 0.74, 0.76),
    )  # fmt: skip
    root.asset.add(
        "material", name="obstacle", texture="obstacle", texuniform=True, texrepeat=(0.025, 0.025),
        specular=0,
    )  # fmt: skip
    root.asset.add("material", name="glow", emission=0.5, specular=0.2)
    # The third size is how finely the plane is cut for shading, which sun and headlight, both
    # without place, do not need: 40,000 squares would take a third of a picture's time.
    root.worldbody.add(
        "geom", name="ground", type="plane", pos=(centre[0], centre[1], low[2]),
        size=(extent, extent, extent), material="ground", contype=0, conaffinity=0,
    )  # fmt: skip
    root.worldbody.add(
        "light", name="sun", directional=True, castshadow=False,
        pos=(centre[0], centre[1], high[2]), dir=(0.4, 0.3, -0.85),
        diffuse=(0.55, 0.55, 0.52), specular=(0.1, 0.1, 0.1),
    )  # fmt: skip
    root.worldbody.add(
        "camera", name="top", pos=(centre[0], centre[1], high[2] + 1.3 * extent),
        xyaxes=(1, 0, 0, 0, 1, 0), fovy=48,
    )  # fmt: skip
    _add_overview(root, centre, extent)


def _add_overview(root: mjcf.RootElement, centre: Array, extent: float) -> None:
    """Adds a camera that looks at the centre from above one corner."""
    position = centre + extent * np.array([-1.1, -1.1, 0.8])
    root.worldbody.add(
        "camera", name="overview", pos=position, xyaxes=_look_at(position, centre), fovy=43
    )


def _look_at(position: Array, target: Array) -> Array:
    """Returns `xyaxes` (6,) of a camera at `position` that sees `target` and a level horizon."""
    forward = target - position
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right = right / np.linalg.norm(right)
    up = np.cross(right, forward)
    return np.concatenate([right, up / np.linalg.norm(up)])
