"""Runs the flights of both kinds of environment: starts, slots, observations, infos, pictures."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import fields
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.spaces import Box

from mjcollect.envs.batch import Simulations
from mjcollect.envs.course import Course, StartKind, check_start
from mjcollect.envs.disturbed import course_air
from mjcollect.envs.dm_env import DEFAULT_SCENE, course_of
from mjcollect.envs.episode import GAMMA, Outcome, Rules
from mjcollect.flight.disturbance import Disturbance
from mjcollect.geometry.boxes import point_box_distance
from mjcollect.geometry.compiled import Array, Indices
from mjcollect.scene.scene import Scene

if TYPE_CHECKING:
    from mjcollect.gym.pictures import Pictures
    from mjcollect.render.camera import Picture

RENDER_MODES = ("rgb_array",)
LEAST, MOST = 16, 4096  # Pictures are so many pixels wide and high.
STATE = ("position", "velocity")  # With these options of `reset`, the caller sets the start.
Infos = dict[str, np.ndarray]


class Flights:
    """Holds N flights of one course, with what Gymnasium asks of them, as arrays.

    Attributes:
        course: where they fly. simulations: what flies them.
        observation_space, action_space: of a single flight.
    """

    def __init__(
        self,
        count: int,
        *,
        task: str,
        scene: Scene | str | os.PathLike[str] = DEFAULT_SCENE,
        course: Course | None = None,
        order: str = "lkh",
        order_seed: int = 0,
        observation: str = "guided",
        reward: str = "time",
        gamma: float = GAMMA,
        shield: bool = True,
        start: StartKind = "point",
        disturbance: Disturbance | Mapping[str, Any] | None = None,
        threads: int = 1,
        render_mode: str | None = None,
        size: tuple[int, int] = (640, 360),
        **task_kwargs: Any,
    ) -> None:
        """Builds the course and the simulations; these are the options of the registered ids.

        Args:
            count: N.
            task: `segment`, `mission`, or a name given to `envs.dm_env.register`.
            scene: a `Scene`, a scene file, or the name of a bundled scene.
            course: a course to fly instead, which several environments can share; `task`, `scene`
                and `order` say nothing then.
            order: method of the visiting order, as `plan_order` takes it; `order_seed` is for
                `random`.
            observation, reward, gamma, shield: the rules of an episode, see `envs.episode.Rules`.
            start: kind of start states, as `Course.starts` takes it.
            disturbance: how strong wind, gusts and the like are, as a `Disturbance` or the mapping
                of its fields; each episode draws anew. Moving boxes of the scene always move.
            threads: number of MuJoCo's threads, on which the results do not depend.
            render_mode: None or `rgb_array`. size: width and height of pictures in pixels.
            task_kwargs: arguments of the task, for a segment its number `segment`.

        Raises:
            ValueError: a name is unknown, and the message lists the valid ones; or a disturbance or
                a size is out of range.
            SceneError: the scene is refused.
        """
        if render_mode not in (None, *RENDER_MODES):
            raise ValueError(
                f"render_mode: {render_mode!r}: must be None or one of {', '.join(RENDER_MODES)}"
            )
        if render_mode is not None and not all(LEAST <= side <= MOST for side in size):
            raise ValueError(f"size: {size}: width and height must be {LEAST} to {MOST} pixels")
        check_start(start)
        rules = Rules(observation, reward, gamma, shield)
        if course is None:
            course = course_of(task, scene, order=order, seed=order_seed, **task_kwargs)
        self.course = course
        rng = np.random.default_rng(0)  # `begin` gives another
        self._air = course_air(course, _level(disturbance), count, rng)
        self.simulations = Simulations(
            [course], count, rules=rules, start=start, threads=threads, disturbances=self._air
        )
        self._all = np.arange(count)
        self._pictures = None if render_mode is None else _pictures(course, count, size)
        self._success = np.zeros(count, dtype=bool)
        width = self.observe(self._all[:1]).shape[1]
        self.observation_space = Box(-np.inf, np.inf, (width,), np.float32)
        self.action_space = Box(-1.0, 1.0, (3,), np.float32)
        self.frames_per_second = round(1.0 / course.scene.slot)

    def begin(
        self, rng: np.random.Generator, which: Indices | None = None, state: Any = None
    ) -> None:
        """Begins episodes in the flights `which` (n,), or in all.

        Args:
            rng: draws the starts and, until the next call, the air.
            state: mapping that may set all starts instead: `position` in m and `velocity` in m/s,
                each (3,) or (N, 3); without a velocity they start at rest.

        Raises:
            ValueError: the mapping holds anything else, or an array of another shape; or a start is
                out of bounds, at a box, or too fast.
        """
        which = self._all if which is None else which
        self.simulations.rng = rng
        if self._air is not None:
            self._air.rng = rng
        if state:
            q, v = self._state(state)
            self.simulations.place(which, q[which], v[which])
        else:
            self.simulations.reset(which)
        self._success[which] = False
        if self._pictures is not None:
            episodes = self.simulations.episodes
            self._pictures.begin(which, episodes.truth, episodes.v)

    def _state(self, state: Mapping[str, Any]) -> tuple[Array, Array]:
        """Returns positions and velocities (N, 3) from what a caller set."""
        unknown = set(state) - set(STATE)
        if unknown or "position" not in state:
            raise ValueError(
                f"options: {sorted(state)}: must be position (m), alone or with velocity (m/s)"
            )
        values = []
        for name in STATE:
            given = state.get(name, np.zeros(3))
            try:
                given = np.asarray(given, dtype=np.float64)
                good = given.shape in ((3,), (len(self._all), 3)) and np.isfinite(given).all()
            except (TypeError, ValueError):
                good = False
            if not good:
                raise ValueError(f"{name}: {given}: must be three numbers, or three of each flight")
            values.append(np.broadcast_to(given, (len(self._all), 3)))
        scene, (q, v) = self.course.scene, values
        out = np.any((q < scene.bounds[0]) | (q > scene.bounds[1]), axis=1)
        struck = np.any(point_box_distance(q[:, None], scene.boxes) < scene.reach, axis=1)
        fast = np.linalg.norm(v, axis=1) > scene.v_max * (1 + 1e-6)
        for name, given, wrong, fix in (
            ("position", q, out, "is out of bounds"),
            ("position", q, struck, "is in or too near to a box"),
            ("velocity", v, fast, f"is beyond v_max, {scene.v_max:g} m/s"),
        ):
            if wrong.any():
                raise ValueError(f"{name}: {given[wrong.argmax()].tolist()}: {fix}; choose another")
        return q, v

    def step(self, action: Any) -> Outcome:
        """Flies one slot with actions (N, 3).

        Raises:
            ValueError: the actions have another shape.
        """
        outcome = self.simulations.step(np.asarray(action, np.float64))
        self._success = outcome.success.copy()
        if self._pictures is not None:
            episodes = self.simulations.episodes
            self._pictures.add(episodes.truth, episodes.v)
        return outcome

    def observe(self, which: Indices | None = None) -> np.ndarray:
        """Returns observations (N, D), or only the rows `which` (n,), as float32."""
        return self.simulations.observe(which).astype(np.float32)

    def infos(self, outcome: Outcome | None = None) -> Infos:
        """Returns what is said of a slot, or of starts, in arrays (N,).

        That is `success` (the course is finished), `crashed`, `shielded` (the shield changed the
        command), and `time`, the seconds since the episode began.
        """
        no = np.zeros(len(self._all), dtype=bool)
        time = self.simulations.episodes.steps * self.course.scene.slot
        if outcome is None:
            return {"success": no, "crashed": no.copy(), "shielded": no.copy(), "time": time}
        return {
            "success": outcome.success.copy(),
            "crashed": outcome.slot.crashed.copy(),
            "shielded": outcome.shielded.copy(),
            "time": time,
        }

    def pictures(self) -> list[Picture]:
        """Returns a picture (H, W, 3) uint8 of each flight; there must be a render mode.

        Raises:
            RenderError: there is no GL; the message says how to get it.
        """
        assert self._pictures is not None
        reached: list[int] = (self.simulations.episodes.target + self._success).tolist()
        moving: list[list[Array]] = [[] for _ in reached]
        if self._air is not None:
            movers = self._air.movers
            moving = [list(movers.boxes[k, movers.speed[k] > 0.0]) for k in range(len(reached))]
        return [self._pictures.take(k, count, moving[k]) for k, count in enumerate(reached)]

    def close(self) -> None:
        """Stops MuJoCo's threads and closes the renderer."""
        self.simulations.close()
        if self._pictures is not None:
            self._pictures.close()


def _level(given: Disturbance | Mapping[str, Any] | None) -> Disturbance:
    """Returns a disturbance that may be given by its fields."""
    if not isinstance(given, Mapping):
        return given or Disturbance()
    names = [field.name for field in fields(Disturbance)]
    if unknown := sorted(set(given) - set(names)):
        raise ValueError(
            f"disturbance: {', '.join(unknown)}: unknown; choose from {', '.join(names)}"
        )
    return Disturbance(**given)


def _pictures(course: Course, count: int, size: tuple[int, int]) -> Pictures:
    from mjcollect.gym.pictures import Pictures  # It loads matplotlib.

    return Pictures(course, count, size)
