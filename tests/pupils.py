"""A policy that arrives, made in seconds: it copies the guidance law in the scene it is for."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from tensordict import TensorDict

from mjcollect.envs.batch import Simulations
from mjcollect.envs.course import Course
from mjcollect.envs.episode import Rules
from mjcollect.learning.ddpg import make_actor
from mjcollect.learning.policy import TrainedPolicy


def pupil(courses: Sequence[Course], observation: str, width: int = 64) -> TrainedPolicy:
    """A network of `width` that was shown the law's flights, with noise, on the courses."""
    rng, generator = np.random.default_rng(0), torch.Generator().manual_seed(0)
    seen, done = [], []
    for course in courses:
        sims = Simulations([course], 64, rules=Rules(observation), start="spread", rng=rng)
        noise = np.linspace(0.0, 0.4, 64)[:, None]
        sims.reset()
        for _ in range(120):
            law = sims.law()
            seen.append(sims.observe())
            done.append(law)
            outcome = sims.step(law + noise * rng.normal(size=law.shape))
            sims.reset(np.flatnonzero(outcome.terminated | outcome.truncated))
        sims.close()
    s, a = (torch.from_numpy(np.concatenate(part)).float() for part in (seen, done))
    torch.manual_seed(0)
    actor = make_actor(s.shape[1], width)
    optimizer = torch.optim.Adam(actor.parameters(), lr=3e-3)
    steps = 1_500
    for step in range(steps):
        optimizer.param_groups[0]["lr"] = 3e-3 * (1.0 - step / steps)
        rows = torch.randint(len(s), (256,), generator=generator)
        made = actor(TensorDict({"observation": s[rows]}, 256))["action"]
        loss = (made - a[rows].clamp(-1.0, 1.0)).pow(2).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return TrainedPolicy(actor, observation)
