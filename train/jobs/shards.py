"""Spreads simulations over processes of their own, here or on the nodes of a Ray cluster.

They go in lock-step: all fly a slot, then the learner goes on. So a run depends on its seed and on
the number of its shards, not on where they are or how fast.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from mjcollect.envs.batch import Simulations
from mjcollect.envs.outcome import Outcome
from mjcollect.flight.contact import Slot
from mjcollect.geometry.compiled import Array, Indices
from train.jobs.processes import importing_pool

Make = Callable[[], Simulations]


class Server:
    """Holds one shard's simulations in its process."""

    def __init__(self) -> None:
        """Begins with no simulations."""
        self._simulations: Simulations | None = None

    def make(self, make: Make) -> None:
        """Holds the simulations that `make` returns, in place of those before."""
        if self._simulations is not None:
            self._simulations.close()
        self._simulations = make()

    def call(self, name: str, *arguments: Any) -> Any:
        """Calls a method of the simulations."""
        return getattr(self._simulations, name)(*arguments)

    def step(self, action: Array) -> tuple[Outcome, Array]:
        """Returns a slot's outcome and the observation after it: one journey instead of two."""
        assert self._simulations is not None
        return self._simulations.step(action), self._simulations.observe()


_SERVER = Server()  # of this process, if it is a local shard


def _ask(name: str, arguments: tuple[Any, ...]) -> Any:
    import torch

    torch.set_num_threads(1)
    return getattr(_SERVER, name)(*arguments)


class LocalCrew:
    """Holds servers in processes of this machine."""

    def __init__(self, count: int) -> None:
        """Starts `count` servers, which end with this process."""
        self._pools = [importing_pool(1) for _ in range(count)]

    def ask(self, name: str, arguments: Sequence[tuple[Any, ...]]) -> list[Any]:
        """Calls a method of every server, each with arguments of its own; returns the answers."""
        asked = [
            pool.submit(_ask, name, own) for pool, own in zip(self._pools, arguments, strict=True)
        ]
        return [answer.result() for answer in asked]

    def close(self) -> None:
        """Ends the processes."""
        for pool in self._pools:
            pool.shutdown(cancel_futures=True)


class RayCrew:
    """Holds servers as actors of the cluster that `workers.connect_ray` has connected to."""

    def __init__(self, count: int) -> None:
        """Starts `count` actors, each on a core of its own."""
        import ray

        self._ray = ray
        actor = ray.remote(num_cpus=1)(Server)
        self._actors = [actor.remote() for _ in range(count)]

    def ask(self, name: str, arguments: Sequence[tuple[Any, ...]]) -> list[Any]:
        """Calls a method of every server, as `LocalCrew.ask` does."""
        pairs = zip(self._actors, arguments, strict=True)
        answers: list[Any] = self._ray.get(
            [getattr(actor, name).remote(*own) for actor, own in pairs]
        )
        return answers

    def close(self) -> None:
        """Leaves the cluster."""
        self._ray.shutdown()


Crew = LocalCrew | RayCrew


class ShardedSimulations:
    """Makes one `batch.Batch` of the simulations of a crew, in the order of its shards."""

    def __init__(self, crew: Crew, makes: Sequence[Make], counts: Sequence[int]) -> None:
        """Has every server make its simulations.

        Args:
            makes: what each server calls. counts: how many simulations each then holds.
        """
        self._crew, self.count = crew, sum(counts)
        self._ends = np.cumsum(counts)
        crew.ask("make", [(make,) for make in makes])
        self._seen = self._all("observe")

    def _all(self, name: str) -> Array:
        return np.concatenate(self._crew.ask("call", [(name,)] * len(self._ends)))

    def reset(self, chosen: Indices | None = None) -> None:
        """Draws new starts, as `Simulations.reset` does."""
        which = np.arange(self.count) if chosen is None else chosen
        parts = [
            which[(which >= begin) & (which < end)] - begin
            for begin, end in zip([0, *self._ends[:-1]], self._ends, strict=True)
        ]
        self._crew.ask("call", [("reset", part) for part in parts])
        rows = self._crew.ask("call", [("observe", part) for part in parts])
        self._seen[np.sort(which)] = np.concatenate(rows)

    def step(self, action: Array) -> Outcome:
        """Flies one slot with raw actions (N, 3), as `Simulations.step` does."""
        parts = np.split(action, self._ends[:-1])
        outcomes, seen = zip(*self._crew.ask("step", [(part,) for part in parts]), strict=True)
        self._seen = np.concatenate(seen)
        slot = _joined(Slot, [outcome.slot for outcome in outcomes])
        return _joined(Outcome, outcomes, slot=slot)

    def observe(self, chosen: Indices | None = None) -> Array:
        """Returns observations (N, D), as `Simulations.observe` does."""
        return self._seen.copy() if chosen is None else self._seen[chosen]

    def law(self) -> Array:
        """Returns actions (N, 3) of the guidance law, as `Simulations.law` does."""
        return self._all("law")

    def seed(self, seed: int | None) -> None:
        """Draws the next starts from streams of this seed."""
        seeds = np.random.SeedSequence(seed).generate_state(len(self._ends))
        self._crew.ask("call", [("seed", int(own)) for own in seeds])

    def state_dict(self) -> dict[str, Any]:
        """Returns the states of all shards."""
        return {"shards": self._crew.ask("call", [("state_dict",)] * len(self._ends))}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes back to states of `state_dict`."""
        self._crew.ask("call", [("load_state_dict", own) for own in state["shards"]])
        self._seen = self._all("observe")

    def close(self) -> None:
        """Does nothing, since the crew goes on to other simulations."""


def _joined(kind: type[Any], parts: Sequence[Any], **given: Any) -> Any:
    """Returns dataclasses of arrays (n, ...) put one after another."""
    names = [field.name for field in dataclasses.fields(kind) if field.name not in given]
    arrays = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    return kind(**arrays, **given)
