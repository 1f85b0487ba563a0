"""Lets a policy try something else where it gets no nearer: noise on its actions, as in training.

A policy without memory can go to and fro before a narrow place for ever. Which actions it takes
then is left to chance for a while; the shield bends them as it bends any others.
"""

from __future__ import annotations

import numpy as np

from mjcollect.envs.episode import Episodes
from mjcollect.geometry.compiled import Array

PATIENCE = 2.0  # A flight that has got no nearer for this long (s) explores,
BURST = 4.0  # for so long (s),
NOISE = 1.0  # with Gaussian noise of this standard deviation over a_max on every action.
NEARER = 0.2  # Nearer means that the time to go has fallen by this much (s).


class Exploration:
    """Adds noise to the actions of those of N episodes that get no nearer to their target.

    Attributes:
        slots: (N,) number of slots explored since each episode began.
    """

    def __init__(self, count: int, seed: int = 0) -> None:
        """Prepares for `count` episodes; `seed` gives the noise."""
        self._rng = np.random.default_rng(seed)
        self._best, self._target = np.full(count, np.inf), np.full(count, -1)
        self._idle, self._left, self.slots = (np.zeros(count, dtype=np.intp) for _ in range(3))

    def __call__(self, episodes: Episodes, action: Array) -> Array:
        """Returns the actions (N, 3), with noise where it explores; call it once in every slot."""
        slot = float(episodes.world.slot)
        to_go = episodes.approach.time_to_go(episodes.seen_world)
        new = (episodes.steps == 0) | (episodes.target != self._target)
        self.slots[episodes.steps == 0] = 0
        self._target = episodes.target.copy()
        self._left[new] = 0
        nearer = new | (to_go < self._best - NEARER)
        self._best = np.where(nearer, to_go, self._best)
        self._idle = np.where(nearer, 0, self._idle + 1)
        begins = self._idle * slot >= PATIENCE - 1e-9
        self._left = np.where(begins, round(BURST / slot), np.maximum(self._left - 1, 0))
        explores = self._left > 0
        self._best[explores], self._idle[explores] = to_go[explores], 0  # Then it begins anew.
        self.slots += explores
        noise = NOISE * self._rng.standard_normal(action.shape)
        return np.asarray(np.where(explores[:, None], np.clip(action + noise, -1.0, 1.0), action))
