"""Defines the dm-control environment of one UAV on a segment or mission, and its registry.

`mjcollect.load("segment", scene=..., segment=2)` returns a `dm_control.rl.control.Environment`.
What physics and task do, they do for any number of UAVs: `fleet.dm_env` builds on it.
"""

from __future__ import annotations

import collections
import importlib
import os
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from dm_control import mujoco
from dm_control.rl import control
from dm_env import specs
from mujoco import mj_step

from mjcollect.envs.course import Course, StartKind, check_start
from mjcollect.envs.episode import Episodes, Rules
from mjcollect.envs.outcome import Outcome
from mjcollect.envs.reward import PRESETS
from mjcollect.geometry.compiled import Array, Bools
from mjcollect.scene.mjcf import build
from mjcollect.scene.order import plan_order
from mjcollect.scene.scene import Scene

DEFAULT_SCENE = "scenario_1"


class Physics(mujoco.Physics):
    """Simulates M UAVs, mostly one, and remembers every physics step of the last slot.

    Attributes:
        path, speeds: (n, 3 M) positions (m) and velocities (m/s) after each physics step.
        touch: (n, M) whether each contact sensor fired in each physics step.
    """

    path: Array
    speeds: Array
    touch: Bools

    def step(self, nstep: int = 1) -> None:
        """Advances by `nstep` steps and keeps each: a contact inside a slot must not be lost."""
        data = self.data.ptr
        q, v, sensors = data.qpos, data.qvel, data.sensordata
        path, speeds = np.empty((nstep, len(q))), np.empty((nstep, len(v)))
        sensed = np.empty((nstep, len(sensors)))
        with self.check_invalid_state():
            for k in range(nstep):
                mj_step(self.model.ptr, data)
                path[k], speeds[k], sensed[k] = q, v, sensors
        self.path, self.speeds, self.touch = path, speeds, sensed > 0

    def flights(self) -> tuple[Array, Array, Bools]:
        """Returns of each UAV what `Episodes.end_slot` takes: path, final velocity, touch."""
        path = self.path.reshape(len(self.path), -1, 3).swapaxes(0, 1)
        return path, self.speeds[-1].reshape(-1, 3), self.touch.T

    def position(self, uav: int = 0) -> Array:
        """Returns the position (3,) of a UAV's centre in m."""
        return np.array(self.data.qpos[3 * uav : 3 * uav + 3])

    def velocity(self, uav: int = 0) -> Array:
        """Returns the velocity (3,) of a UAV in m/s."""
        return np.array(self.data.qvel[3 * uav : 3 * uav + 3])

    def speed(self, uav: int = 0) -> float:
        """Returns the norm of a UAV's velocity in m/s."""
        return float(np.linalg.norm(self.velocity(uav)))


class FlightTask(control.Task):
    """Defines the task of a course: collect each target at rest, in turn, touching nothing."""

    def __init__(
        self,
        course: Course,
        rules: Rules,
        start: StartKind = "point",
        random: int | np.random.RandomState | None = None,
        others: Sequence[Course] = (),
    ) -> None:
        """Sets up the task.

        Args:
            course: nodes to visit.
            rules: observation, reward and shield.
            start: kind of start state, explained at `Course.starts`.
            random: seed or random state of the starts.
            others: courses of the other UAVs of a fleet, for `fleet.dm_env`.

        Raises:
            ValueError: the kind of start is unknown.
        """
        check_start(start)
        self.course, self.start = course, start
        self.courses = (course, *others)
        uavs = len(self.courses)
        self.episodes = Episodes(self.courses, uavs, rules, uavs=uavs)
        self.outcome: Outcome | None = None
        self.acceleration = np.zeros(3 * uavs)
        # DMControlWrapper.set_seed replaces `_random` by a RandomState.
        self._random = (
            random if isinstance(random, np.random.RandomState) else np.random.RandomState(random)
        )

    @property
    def random(self) -> np.random.RandomState:
        """Returns the random state of the starts."""
        return self._random

    @property
    def segment_index(self) -> int:
        """Returns the index of the course's current segment: the number of targets reached."""
        return int(self.episodes.target[0])

    def initialize_episode(self, physics: Physics) -> None:
        """Draws a start state and puts the UAV there."""
        rng = np.random.default_rng(self._random.randint(2**31))
        starts = [course.starts(self.start, 1, rng) for course in self.courses]
        q, v = (np.concatenate(part) for part in zip(*starts, strict=True))
        self.place(physics, q, v)

    def place(self, physics: Physics, q: Array, v: Array) -> None:
        """Begins an episode at a position (3,) in m with a velocity (3,) in m/s, or M (M, 3)."""
        physics.data.qpos[:], physics.data.qvel[:] = q.ravel(), v.ravel()
        self.episodes.reset(np.arange(len(self.courses)), q.reshape(-1, 3), v.reshape(-1, 3))
        self.outcome = None

    def action_spec(self, physics: Physics) -> specs.BoundedArray:
        """Returns the spec of an action (3,): acceleration in units of a_max, each in [-1, 1]."""
        return specs.BoundedArray((3,), np.float64, -1.0, 1.0, name="acceleration")

    def before_step(self, action: Array, physics: Physics) -> None:
        """Turns the raw action into a feasible command for the slot."""
        raw = np.asarray(action, np.float64).reshape(-1, 3)
        self.acceleration = self.episodes.begin_slot(raw).ravel()
        physics.set_control(self.acceleration)

    def after_step(self, physics: Physics) -> None:
        """Judges the slot just flown."""
        self.outcome = self.episodes.end_slot(*physics.flights())

    def get_observation(self, physics: Physics) -> collections.OrderedDict[str, Array]:
        """Returns the observation's named parts, each (d,)."""
        parts = self.episodes.observe()
        return collections.OrderedDict((name, part[0]) for name, part in parts.items())

    def get_reward(self, physics: Physics) -> float:
        """Returns the reward of the last slot."""
        return float(self._last.reward[0])

    def get_termination(self, physics: Physics) -> float | None:
        """Returns the final discount: 0 on arrival or crash, 1 at the step limit, None to go on.

        The step limit is the task's own, because dm-control's would report an arrival or a crash
        in the last slot as a truncation.
        """
        if self._last.terminated[0]:
            return 0.0
        return 1.0 if self._last.truncated[0] else None

    @property
    def _last(self) -> Outcome:
        if self.outcome is None:
            raise RuntimeError("no slot has been flown since the episode began")
        return self.outcome


def make_environment(
    course: Course,
    *,
    observation: str = "guided",
    reward: str = "time",
    start: StartKind = "point",
    random: int | np.random.RandomState | None = None,
    shield: bool = True,
    environment_kwargs: dict[str, Any] | None = None,
) -> control.Environment:
    """Returns the dm-control environment of a course, with further arguments as in `load`."""
    task = FlightTask(course, Rules(observation, reward, shield=shield), start, random)
    return environment_of(task, course.scene, environment_kwargs)


def environment_of(
    task: FlightTask, scene: Scene, environment_kwargs: dict[str, Any] | None = None
) -> control.Environment:
    """Returns the environment of a task in a scene, with a body for each of its courses."""
    solid = PRESETS[task.episodes.rules.reward].crash_ends
    root = build(scene, solid=solid, uavs=len(task.courses))
    physics = Physics.from_xml_string(root.to_xml_string(), root.get_assets())
    return control.Environment(
        physics,
        task,
        n_sub_steps=scene.substeps,
        legacy_step=False,
        **(environment_kwargs or {}),
    )


_TASKS: dict[str, Callable[..., Course]] = {}
# Tasks of several courses. Rooms above this one make their environments, which `load` finds by
# these places when it is asked for them: what they need, this room must not import.
_PLACES = {"fleet": "mjcollect.planners.fleets:fleet_environment"}


def register(name: str) -> Callable[[Callable[..., Course]], Callable[..., Course]]:
    """Returns a decorator that registers a function `(scene, order, **kwargs) -> Course` as a task.

    Raises:
        ValueError: the name is taken.
    """

    def add(maker: Callable[..., Course]) -> Callable[..., Course]:
        if name in (*_TASKS, *_PLACES):
            raise ValueError(f"task: {name!r}: is already registered; choose another name")
        _TASKS[name] = maker
        return maker

    return add


@register("segment")
def _segment(scene: Scene, order: tuple[int, ...], segment: int = 0) -> Course:
    return Course.segment(scene, order, segment)


@register("mission")
def _mission(scene: Scene, order: tuple[int, ...]) -> Course:
    return Course.mission(scene, order)


def task_names() -> tuple[str, ...]:
    """Returns the names of all tasks of one course that `load` knows."""
    return tuple(_TASKS)


def course_of(
    task: str,
    scene: Scene | str | os.PathLike[str] = DEFAULT_SCENE,
    *,
    order: str = "lkh",
    seed: int = 0,
    **task_kwargs: Any,
) -> Course:
    """Returns the course of a task by its name, with arguments as in `load`.

    Raises:
        ValueError: the task is unknown; the message lists those of one course.
        SceneError: the scene is refused.
    """
    if task not in _TASKS:
        raise ValueError(f"task: {task!r}: must be one of {', '.join(_TASKS)}")
    if not isinstance(scene, Scene):
        scene = Scene.find(scene)
    return _TASKS[task](scene, plan_order(scene, order, seed=seed), **task_kwargs)


def load(
    task: str,
    scene: Scene | str | os.PathLike[str] = DEFAULT_SCENE,
    *,
    order: str = "lkh",
    seed: int = 0,
    observation: str = "guided",
    reward: str = "time",
    start: StartKind = "point",
    random: int | np.random.RandomState | None = None,
    shield: bool = True,
    environment_kwargs: dict[str, Any] | None = None,
    **task_kwargs: Any,
) -> control.Environment:
    """Returns a new environment by the name of its task.

    Args:
        task: `segment` (with `segment=I`), `mission`, a name given to `register`, or `fleet`
            (with `uavs=M`), see `planners.fleets.fleet_environment`.
        scene: a `Scene`, a scene file, or the name of a bundled scene.
        order: method of the visiting order, as `plan_order` takes it; `seed` is for `random`.
        observation: name of the observation.
        reward: name of the reward preset.
        start: kind of start states, as `Course.starts` takes it.
        random: seed of the start states.
        shield: whether to bend commands that leave no way to stop without touching anything.
        environment_kwargs: arguments of `control.Environment`.
        task_kwargs: arguments of the task.

    Raises:
        ValueError: a name is unknown; the message lists the valid ones.
        SceneError: the scene is refused.
    """
    if task not in (*_TASKS, *_PLACES):
        raise ValueError(f"task: {task!r}: must be one of {', '.join((*_TASKS, *_PLACES))}")
    options: dict[str, Any] = {
        "observation": observation,
        "reward": reward,
        "start": start,
        "random": random,
        "shield": shield,
        "environment_kwargs": environment_kwargs,
    }
    if task in _PLACES:
        module, name = _PLACES[task].split(":")
        make: Callable[..., control.Environment] = getattr(importlib.import_module(module), name)
        if not isinstance(scene, Scene):
            scene = Scene.find(scene)
        return make(scene, order=order, seed=seed, **task_kwargs, **options)
    course = course_of(task, scene, order=order, seed=seed, **task_kwargs)
    return make_environment(course, **options)
