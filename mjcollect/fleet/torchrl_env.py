"""Wraps many fleets as one TorchRL environment, by TorchRL's conventions for several agents."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from mjcollect.envs.batch import Simulations
from mjcollect.fleet.episode import at_home, fleet_ends, uav_names
from mjcollect.geometry.compiled import Bools

GROUP = "uavs"  # All UAVs are in one group: nothing but their courses tells them apart.
FLAGS = ("success", "home", "crashed", "shielded")
ENDS = ("done", "terminated", "truncated")


class FleetEnv(EnvBase):
    """Wraps N fleets of M UAVs as a TorchRL environment of batch size N.

    Under the key "uavs" it takes `action` (N, M, 3), float32 in [-1, 1], and returns there
    `observation` (N, M, D) and `reward` (N, M, 1), float32, and the Booleans (N, M, 1) `success`
    (the slot ended with the course finished), `home` (that slot or one before did), `crashed` and
    `shielded` (the shield changed the command). A UAV at home rests and earns 0, whatever its
    action. `done`, `terminated` and `truncated` (N, 1) are the fleet's, see `fleet_ends`.

    Attributes:
        simulations: what is wrapped.
        group_map: the names of the UAVs in the group "uavs".
    """

    def __init__(self, simulations: Simulations, device: str = "cpu") -> None:
        """Wraps `simulations` of N M UAVs, M to a fleet; tensors are returned on `device`."""
        m = simulations.uavs
        n = simulations.count // m
        super().__init__(device=device, batch_size=torch.Size([n]))
        self.simulations = simulations
        self.group_map = {GROUP: uav_names(m)}
        size = simulations.observe(np.arange(1)).shape[1]

        def flag(*shape: int) -> Binary:
            return Binary(n=1, shape=torch.Size([*shape, 1]), dtype=torch.bool, device=device)

        def of_uavs(**specs: Any) -> Composite:
            inner = Composite(**specs, shape=(n, m), device=device)
            return Composite({GROUP: inner}, shape=(n,), device=device)

        self.observation_spec = of_uavs(
            observation=Unbounded((n, m, size), dtype=torch.float32, device=device),
            **{name: flag(n, m) for name in FLAGS},
        )
        self.full_action_spec = of_uavs(
            action=Bounded(-1.0, 1.0, (n, m, 3), dtype=torch.float32, device=device)
        )
        self.full_reward_spec = of_uavs(
            reward=Unbounded((n, m, 1), dtype=torch.float32, device=device)
        )
        ends = {name: flag(n) for name in ENDS}
        self.full_done_spec = Composite(ends, shape=(n,), device=device)

    def _tensor(self, values: np.ndarray, *shape: int) -> torch.Tensor:
        return torch.from_numpy(values.copy()).reshape(*self.batch_size, *shape).to(self.device)

    def _dict(self, terminated: Bools, truncated: Bools, **of_uavs: np.ndarray) -> TensorDict:
        """Returns the ends of fleets (N,), and what is said of their UAVs (N M, ...), observed."""
        m, n = self.simulations.uavs, self.batch_size[0]
        of_uavs["observation"] = self.simulations.observe().astype(np.float32)
        inner = {name: self._tensor(values, m, -1) for name, values in of_uavs.items()}
        ends = zip(ENDS, (terminated | truncated, terminated, truncated), strict=True)
        parts = {name: self._tensor(values, 1) for name, values in ends}
        parts[GROUP] = TensorDict(inner, batch_size=torch.Size([n, m]), device=self.device)
        return TensorDict(parts, batch_size=self.batch_size, device=self.device)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: object) -> TensorDict:
        m, rows = self.simulations.uavs, None
        if tensordict is not None and "_reset" in tensordict:
            chosen = tensordict["_reset"].cpu().numpy().reshape(-1)
            rows = np.flatnonzero(np.repeat(chosen, m))
        self.simulations.reset(rows)
        no = np.zeros(self.simulations.count, dtype=bool)
        return self._dict(no[::m], no[::m], **dict.fromkeys(FLAGS, no))

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        action = tensordict[GROUP, "action"].detach().cpu().numpy().astype(np.float64)
        outcome = self.simulations.step(action.reshape(-1, 3))
        episodes = self.simulations.episodes
        terminated, truncated = fleet_ends(outcome, episodes, self.simulations.uavs)
        return self._dict(
            terminated,
            truncated,
            reward=outcome.reward.astype(np.float32),
            success=outcome.success,
            home=at_home(outcome, episodes),
            crashed=outcome.slot.crashed,
            shielded=outcome.shielded,
        )

    def _set_seed(self, seed: int | None) -> None:
        self.simulations.seed(seed)

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Stops MuJoCo's threads."""
        if not self.is_closed:
            self.simulations.close()
        super().close(raise_if_closed=raise_if_closed)
