"""Runs N MuJoCo simulations at once, also as one TorchRL environment.

`mujoco.rollout` steps them on its own threads, each in a scene of its own if wanted, and returns
every physics step, so that a contact inside a slot is not lost. `episode.Episodes` gives the rules,
the same as in the single dm-control environment.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, Protocol

import mujoco
import numpy as np
import torch
from mujoco import rollout
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from mjcollect.envs.course import Course, StartKind
from mjcollect.envs.episode import FLEET_SAVED, SAVED, Episodes, Rules
from mjcollect.envs.outcome import Outcome
from mjcollect.envs.reward import PRESETS
from mjcollect.flight.contact import may_touch_rows
from mjcollect.flight.disturbance import Disturbances
from mjcollect.flight.separation import clashes
from mjcollect.geometry.compiled import Array, Bools, Indices, plain
from mjcollect.scene.mjcf import build, compile_model, let_boxes_sleep
from mjcollect.scene.scene import Scene

STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS
REDRAWS = 20  # Starts too near to other UAVs are drawn anew so often at most.
FLAGS = ("done", "terminated", "truncated", "success", "crashed", "shielded")


class Batch(Protocol):
    """Lists what N simulations can do, in this process or in others; `Simulations` explains it."""

    count: int

    def reset(self, chosen: Indices | None = None) -> None: ...  # noqa: D102
    def step(self, action: Array) -> Outcome: ...  # noqa: D102
    def observe(self, chosen: Indices | None = None) -> Array: ...  # noqa: D102
    def law(self) -> Array: ...  # noqa: D102
    def seed(self, seed: int | None) -> None: ...  # noqa: D102
    def state_dict(self) -> dict[str, Any]: ...  # noqa: D102
    def load_state_dict(self, state: dict[str, Any]) -> None: ...  # noqa: D102
    def close(self) -> None: ...  # noqa: D102


class Simulations:
    """Runs N flights in this process, on NumPy arrays: reset, step, observe.

    MuJoCo looks for contacts only in slots in which a body may come near a box, since looking
    costs the more the more boxes there are. No state changes by a bit for that.
    """

    def __init__(
        self,
        courses: Sequence[Course],
        count: int,
        *,
        rules: Rules | None = None,
        start: StartKind = "point",
        rng: np.random.Generator | None = None,
        threads: int = 2,
        disturbances: Disturbances | None = None,
        uavs: int = 1,
    ) -> None:
        """Compiles one model per distinct scene and prepares the threads.

        Args:
            courses: one course for all simulations, or one each.
            count: N.
            uavs: M, the number of UAVs in each MuJoCo simulation, whose flights follow each other
                among the N; there are N / M simulations then.
            rules: observation, reward and shield.
            start: kind of start states; rng: draws them.
            threads: number of MuJoCo's threads.
            disturbances: those of these simulations, if any.
        """
        rules = rules or Rules()
        if count % uavs:
            raise ValueError(f"count: {count}: must be a multiple of uavs: {uavs}")
        self.count, self.start, self.uavs = count, start, uavs
        self.rng = rng or np.random.default_rng(0)
        self.episodes = Episodes(courses, count, rules, disturbances, uavs)
        solid = PRESETS[rules.reward].crash_ends
        worlds = range(0, count, uavs)  # the first flight of each simulation
        firsts = [self.episodes.course(i).scene for i in worlds]
        scenes = {id(scene): scene for scene in firsts}
        alone = len(scenes) == 1  # Then its boxes may sleep: each thread's data is its own.
        models = {key: _compiled(scene, solid, alone, uavs) for key, scene in scenes.items()}
        self._models = [models[id(scene)] for scene in firsts]
        self._near = np.empty(count, dtype=bool)
        first = self._models[0][0]
        largest = first if len(models) == 1 else _largest(list(scenes.values()), uavs)
        self._data = [mujoco.MjData(largest) for _ in range(threads)]
        # MuJoCo's nthread=0 steps in the calling thread.
        self._rollout = rollout.Rollout(nthread=threads if threads > 1 else 0)
        self._n = self.episodes.world.substeps
        self.state = np.zeros((len(firsts), mujoco.mj_stateSize(first, STATE)))
        self._states = np.empty((len(firsts), self._n, self.state.shape[1]))
        self._sensors = np.empty((len(firsts), self._n, first.nsensordata))

    def close(self) -> None:
        """Stops the threads."""
        self._rollout.close()

    def reset(self, chosen: Indices | None = None) -> None:
        """Draws new starts for the simulations with indices `chosen` (n,), or for all."""
        which = np.arange(self.count) if chosen is None else chosen
        if len(which) == 0:
            return
        q, v = self._starts(which)
        for _ in range(REDRAWS if self.uavs > 1 else 0):  # UAVs of a fleet do not start in a crash.
            whole_q, whole_v = self.episodes.truth.copy(), self.episodes.v.copy()
            whole_q[which], whole_v[which] = q, v
            clash = clashes(self.episodes.world, self.uavs, whole_q, whole_v)[which]
            if not clash.any():
                break
            q[clash], v[clash] = self._starts(which[clash])
        self.place(which, q, v)

    def _starts(self, which: Indices) -> tuple[Array, Array]:
        """Draws positions (m) and velocities (m/s), each (n, 3), at which flights `which` start."""
        courses = self.episodes.targets.courses
        if len(courses) == 1:
            return courses[0].starts(self.start, len(which), self.rng)
        drawn = [self.episodes.course(i).starts(self.start, 1, self.rng) for i in which]
        return np.concatenate([pair[0] for pair in drawn]), np.concatenate(
            [pair[1] for pair in drawn]
        )

    def place(self, which: Indices, q: Array, v: Array) -> None:
        """Begins episodes at q, v (n, 3) in m and m/s in the simulations `which` (n,)."""
        world, first = which // self.uavs, 1 + 3 * (which % self.uavs)
        self.state[world, 0] = 0.0  # the time
        for k in range(3):
            self.state[world, first + k] = q[:, k]
            self.state[world, first + k + 3 * self.uavs] = v[:, k]
        self.episodes.reset(which, q, v)

    def step(self, action: Array) -> Outcome:
        """Flies one slot with raw actions (N, 3) in units of a_max, and returns its outcome.

        Raises:
            ValueError: the actions have another shape.
        """
        if np.shape(action) != (self.count, 3):
            raise ValueError(f"action: shape {np.shape(action)}: must be ({self.count}, 3)")
        self.acceleration = self.episodes.begin_slot(action)
        disturbances, flown = self.episodes.disturbances, self.acceleration
        if disturbances is not None:
            flown = disturbances.controls(self.episodes.world, self.acceleration)
        self.roll(flown)
        return self.episodes.end_slot(self.path, self._flights(self.state, 1), self._sensed())

    def law(self) -> Array:
        """Returns the actions (N, 3) of the guidance law in units of a_max."""
        return self.episodes.guidance_action()

    def seed(self, seed: int | None) -> None:
        """Draws all later starts from this seed."""
        self.rng = np.random.default_rng(seed)

    def state_dict(self) -> dict[str, Any]:
        """Returns the whole state, without courses and settings."""
        episodes = self.episodes
        disturbances = episodes.disturbances
        saved = SAVED + (FLEET_SAVED if self.uavs > 1 else ())
        return {
            "rng": self.rng.bit_generator.state,
            "simulations": torch.from_numpy(self.state.copy()),
            "episodes": {name: torch.from_numpy(getattr(episodes, name).copy()) for name in saved},
            "disturbances": None if disturbances is None else disturbances.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes back to a state that `state_dict` returned."""
        self.rng.bit_generator.state = state["rng"]
        self.state = state["simulations"].numpy().copy()
        if self.episodes.disturbances is not None:
            self.episodes.disturbances.load_state_dict(state["disturbances"])
        self.episodes.load({name: v.numpy().copy() for name, v in state["episodes"].items()})

    def roll(self, acceleration: Array) -> None:
        """Lets MuJoCo fly one slot, without the rules of flight.

        Args:
            acceleration: (N, 3) in m/s^2, held for the slot, or (N, n, 3), one per physics step.
        """
        each = acceleration if acceleration.ndim == 3 else acceleration[:, None]
        control = plain(np.broadcast_to(each, (self.count, self._n, 3)))
        q, v = plain(self._flights(self.state, 0)), plain(self._flights(self.state, 1))
        may_touch_rows(self.episodes.world, self.uavs, q, v, control, self._near)
        near: list[bool] = self._near.reshape(-1, self.uavs).max(axis=1).tolist()
        if self.uavs > 1:
            whole = control.reshape(-1, self.uavs, self._n, 3).swapaxes(1, 2)
            control = plain(whole).reshape(-1, self._n, 3 * self.uavs)
        self._rollout.rollout(
            [pair[not looks] for pair, looks in zip(self._models, near, strict=True)],
            self._data,
            self.state,
            control,
            skip_checks=True,
            nstep=self._n,
            state=self._states,
            sensordata=self._sensors,
        )
        self.state = self._states[:, -1].copy()

    @property
    def path(self) -> Array:
        """Returns the positions (N, n, 3) in m after the last slot's physics steps."""
        return self._flights(self._states, 0)

    @property
    def speeds(self) -> Array:
        """Returns the velocities (N, n, 3) in m/s after the last slot's physics steps."""
        return self._flights(self._states, 1)

    def _flights(self, states: Array, part: int) -> Array:
        """Returns the rows (N, ..., 3) of the flights in MuJoCo's states (N / M, ..., S).

        Part 0 is their positions, part 1 their velocities.
        """
        width = 3 * self.uavs
        found = states[..., 1 + part * width : 1 + (part + 1) * width]
        if self.uavs == 1:
            return found
        found = np.moveaxis(found.reshape(*found.shape[:-1], self.uavs, 3), -2, 1)
        return found.reshape(self.count, *found.shape[2:])

    def _sensed(self) -> Bools:
        """Returns whether each contact sensor (N, n) fired in each physics step."""
        fired = self._sensors > 0  # (N / M, n, M), one sensor each
        return np.asarray(fired.swapaxes(1, 2).reshape(self.count, self._n))

    def observe(self, chosen: Indices | None = None) -> Array:
        """Returns the flat observation (N, D): the parts of `Episodes.observe` in their order.

        If `chosen` (n,) is given, only the rows of these simulations are computed, (n, D).
        """
        return np.concatenate(list(self.episodes.observe(chosen).values()), axis=-1)


@lru_cache(maxsize=4)
def _compiled(
    scene: Scene, solid: bool, alone: bool, uavs: int
) -> tuple[mujoco.MjModel, mujoco.MjModel]:
    """Returns the scene's model, and the same without contacts.

    Training and evaluation share them: do not change them.
    """
    model = compile_model(scene, solid=solid, uavs=uavs)
    if alone:
        let_boxes_sleep(model)
    other = copy.copy(model)
    other.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    return model, other


def _largest(scenes: Sequence[Scene], uavs: int) -> mujoco.MjModel:
    """Returns a model whose MjData can hold any scene's: `Rollout` writes past a smaller one."""
    root = build(max(scenes, key=lambda scene: len(scene.obstacles)), uavs=uavs)
    for index in range(max(len(scene.items) for scene in scenes)):
        root.worldbody.add("site", name=f"room_{index}")
    return mujoco.MjModel.from_xml_string(root.to_xml_string(), root.get_assets())


class BatchedFlightEnv(EnvBase):
    """Wraps N simulations as a TorchRL environment of batch size N.

    The observation is float32 (N, D), the action float32 (N, 3) in [-1, 1]. Each step also returns
    `success`, `crashed` and `shielded` (the shield changed the command), Boolean (N, 1).
    """

    def __init__(self, simulations: Batch, device: str = "cpu") -> None:
        """Wraps `simulations`; tensors are returned on `device`."""
        n = simulations.count
        super().__init__(device=device, batch_size=torch.Size([n]))
        self.simulations = simulations
        size = simulations.observe().shape[1]
        flag = Binary(n=1, shape=(n, 1), dtype=torch.bool, device=device)
        self.observation_spec = Composite(
            observation=Unbounded((n, size), dtype=torch.float32, device=device),
            success=flag.clone(),
            crashed=flag.clone(),
            shielded=flag.clone(),
            shape=(n,),
            device=device,
        )
        self.action_spec = Bounded(-1.0, 1.0, (n, 3), dtype=torch.float32, device=device)
        self.reward_spec = Unbounded((n, 1), dtype=torch.float32, device=device)
        self.full_done_spec = Composite(
            done=flag.clone(),
            terminated=flag.clone(),
            truncated=flag.clone(),
            shape=(n,),
            device=device,
        )

    def _flag(self, values: Bools) -> torch.Tensor:
        return torch.from_numpy(values[:, None].copy()).to(self.device)

    def _observe(self, chosen: Indices | None = None) -> torch.Tensor:
        observed = self.simulations.observe(chosen).astype(np.float32)
        return torch.from_numpy(observed).to(self.device)

    def _dict(self, **more: torch.Tensor) -> TensorDict:
        parts = {"observation": self._observe(), **more}
        return TensorDict(parts, batch_size=self.batch_size, device=self.device)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: object) -> TensorDict:
        which = None
        if tensordict is not None and "_reset" in tensordict:
            which = np.flatnonzero(tensordict["_reset"].cpu().numpy().reshape(-1))
        self.simulations.reset(which)
        no = np.zeros(self.simulations.count, dtype=bool)
        return self._dict(**{flag: self._flag(no) for flag in FLAGS})

    def maybe_reset(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Begins anew where an episode has ended.

        It does what `EnvBase` does through `_reset`, without computing rows that are then dropped.
        """
        chosen = np.flatnonzero(tensordict["done"].cpu().numpy())
        if len(chosen):
            self.simulations.reset(chosen)
            rows = torch.from_numpy(chosen).to(self.device)
            for name, values in list(tensordict.items()):
                tensordict[name] = values.index_fill(0, rows, 0)
            tensordict["observation"].index_copy_(0, rows, self._observe(chosen))
        return tensordict

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        action = tensordict["action"].detach().cpu().numpy().astype(np.float64)
        outcome = self.simulations.step(action)
        reward = torch.from_numpy(outcome.reward.astype(np.float32)[:, None]).to(self.device)
        return self._dict(
            reward=reward,
            done=self._flag(outcome.terminated | outcome.truncated),
            terminated=self._flag(outcome.terminated),
            truncated=self._flag(outcome.truncated),
            success=self._flag(outcome.success),
            crashed=self._flag(outcome.slot.crashed),
            shielded=self._flag(outcome.shielded),
        )

    def _set_seed(self, seed: int | None) -> None:
        self.simulations.seed(seed)

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Stops MuJoCo's threads."""
        if not self.is_closed:
            self.simulations.close()
        super().close(raise_if_closed=raise_if_closed)
