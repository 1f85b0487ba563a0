"""Compares the learner's speed with Stable-Baselines3's DDPG and hand-written torch loops.

    OMP_NUM_THREADS=1 python -m benchmarks.learner --out docs/results/learner.json

All have the same networks (two hidden layers, LayerNorm in each, as in training), batch and Adam,
update actor, critic and both targets every time, and draw their batches from a full replay buffer
of their own kind; drawing is counted. One thread each, interleaved, medians over the rounds.
Needs `pip install .[bench]`.
"""

from __future__ import annotations

import copy
import statistics
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
import tyro
from stable_baselines3.common.buffers import ReplayBuffer
from tensordict import TensorDict

from benchmarks.common import Output, Row, measure_rates, median_ratio, print_table, save
from benchmarks.sb3 import Spaces, make_sb3, peer_versions
from mjcollect.learning.ddpg import make_actor, make_buffer, make_critic
from mjcollect.learning.fast_ddpg import LEARNERS

GAMMA, TAU, RATE = 0.99, 0.01, 1e-3
OBSERVATION = 52  # An observation has so many numbers.
TRANSITIONS = 20_000  # Each replay buffer holds so many transitions.
ROUND = 8  # updates that ours and SB3's make in one call, as in training
LEAN, SB3 = "ours, lean", "SB3"
PLAIN, TUNED = "hand-written, as CleanRL", "hand-written, tuned"
COLUMNS = (
    ("learner", "{learner}"),
    ("updates/s", "{updates_per_second:.0f}"),
    ("of SB3", "{of SB3:.2f}"),
    ("of hand-written, as CleanRL", "{of hand-written, as CleanRL:.2f}"),
    ("of tuned", "{of hand-written, tuned:.2f}"),
)
TARGETS = {"SB3": 1.3, "hand-written": 0.9}  # least share of a peer's updates per second
PEERS = {"SB3": (SB3, "SB3 as it comes"), "hand-written": (TUNED, "the faster hand-written loop")}
Learn = Callable[[], object]  # makes the updates of one call; the last critic loss


@dataclass(frozen=True)
class Args(Output):
    """Measures updates per second of each learner."""

    sizes: tuple[tuple[int, int], ...] = ((128, 256), (256, 256), (128, 128))
    """Width of the hidden layers and transitions in a batch, for each table."""
    repeats: int = 15
    """Number of rounds, in each of which all learners have a turn."""
    updates: int = 64
    """Updates that each learner makes in a round, a multiple of 8."""


def experience(n: int) -> TensorDict:
    """Returns n random transitions."""
    return TensorDict(
        {
            "observation": torch.randn(n, OBSERVATION),
            "action": torch.rand(n, 3) * 2 - 1,
            "next": {
                "observation": torch.randn(n, OBSERVATION),
                "reward": torch.randn(n, 1),
                "done": torch.rand(n, 1) < 0.02,
                "terminated": torch.rand(n, 1) < 0.01,
            },
        },
        [n],
    )


def ours(kind: str, width: int, batch: int, data: TensorDict) -> Learn:
    """Returns the call of our learner, of either kind."""
    learner = LEARNERS[kind](
        OBSERVATION, width=width, gamma=GAMMA, alpha_actor=RATE, alpha_critic=RATE,
        alpha_target=TAU, final_rate=1.0, total_updates=1,
    )  # fmt: skip
    buffer = make_buffer(len(data), batch, seed=0)
    buffer.extend(data)
    return lambda: learner.learn(buffer, ROUND)[-1]


def fill(buffer: ReplayBuffer, data: TensorDict) -> ReplayBuffer:
    """Puts the transitions into SB3's buffer."""
    after = data["next"]
    buffer.observations[:, 0] = data["observation"].numpy()
    buffer.next_observations[:, 0] = after["observation"].numpy()
    buffer.actions[:, 0] = data["action"].numpy()
    buffer.rewards[:] = after["reward"].numpy()
    buffer.dones[:] = after["terminated"].numpy()
    buffer.pos, buffer.full = 0, True
    return buffer


def sb3(width: int, batch: int, data: TensorDict, *, fused: bool) -> Learn:
    """Returns the call of Stable-Baselines3's DDPG."""
    model = make_sb3(
        Spaces(OBSERVATION), width, fused=fused, buffer_size=len(data), gamma=GAMMA, tau=TAU,
        learning_rate=RATE, seed=0,
    )  # fmt: skip
    fill(model.replay_buffer, data)

    def learn() -> float:
        model.train(gradient_steps=ROUND, batch_size=batch)
        return model.logger.name_to_value["train/critic_loss"]

    return learn


def by_hand(width: int, batch: int, data: TensorDict, *, tuned: bool) -> Learn:
    """Returns the call of a loop in plain torch, as CleanRL's ddpg_continuous_action has it.

    If `tuned`, it has fused Adam, one call for the soft update, and a buffer of torch tensors.
    """
    mlp = make_actor(OBSERVATION, width)[0].module
    nets = torch.nn.Sequential(mlp, torch.nn.Tanh()), make_critic(OBSERVATION, width).module
    actor, critic = nets
    targets = tuple(copy.deepcopy(net).requires_grad_(False) for net in nets)
    actor_optimizer, critic_optimizer = (
        torch.optim.Adam(net.parameters(), lr=RATE, fused=tuned or None) for net in nets
    )
    online, delayed = ([p for net in part for p in net.parameters()] for part in (nets, targets))
    spaces = Spaces(OBSERVATION)
    buffer = fill(
        ReplayBuffer(
            len(data), spaces.observation_space, spaces.action_space, "cpu",
            handle_timeout_termination=False,
        ),
        data,
    )  # fmt: skip
    after = data["next"]
    columns = (
        data["observation"], data["action"], after["observation"],
        after["terminated"].float(), after["reward"],
    )  # fmt: skip

    def draw() -> tuple[torch.Tensor, ...]:
        if tuned:
            index = torch.randint(len(data), (batch,))
            return tuple(column.index_select(0, index) for column in columns)
        return tuple(buffer.sample(batch)[:5])

    def update() -> torch.Tensor:
        s, a, s_next, done, reward = draw()
        with torch.no_grad():
            q_next = targets[1](torch.cat([s_next, targets[0](s_next)], 1)).view(-1)
            u = reward.flatten() + (1 - done.flatten()) * GAMMA * q_next
        critic_loss = F.mse_loss(critic(torch.cat([s, a], 1)).view(-1), u)
        critic_optimizer.zero_grad()
        critic_loss.backward()
        critic_optimizer.step()
        actor_loss = -critic(torch.cat([s, actor(s)], 1)).mean()
        actor_optimizer.zero_grad()
        actor_loss.backward()
        actor_optimizer.step()
        if tuned:
            with torch.no_grad():
                torch._foreach_lerp_(delayed, online, TAU)
        else:
            for p, target in zip(online, delayed, strict=True):
                target.data.copy_(TAU * p.data + (1 - TAU) * target.data)
        return critic_loss

    return lambda: [update() for _ in range(ROUND)][-1]


def lasting(learn: Learn, updates: int) -> Callable[[], int]:
    """Repeats a learner's call for so many updates, and refuses those that have gone wrong."""
    learn()  # what is compiled or loaded at first use
    learn()

    def work() -> int:
        for _ in range(updates // ROUND):
            loss = learn()
        if not np.isfinite(np.asarray(torch.as_tensor(loss).detach())).all():
            raise RuntimeError(f"loss: {loss}: must be finite")
        return updates // ROUND * ROUND

    return work


def measure(width: int, batch: int, args: Args) -> dict[str, Row]:
    """Returns each learner's updates per second and ratios to the others', medians over rounds."""
    torch.manual_seed(0)
    data = experience(TRANSITIONS)
    learners = {
        LEAN: ours("lean", width, batch, data),
        "ours, TorchRL": ours("torchrl", width, batch, data),
        SB3: sb3(width, batch, data, fused=False),
        "SB3, fused Adam": sb3(width, batch, data, fused=True),
        PLAIN: by_hand(width, batch, data, tuned=False),
        TUNED: by_hand(width, batch, data, tuned=True),
    }
    works = {way: lasting(learn, args.updates) for way, learn in learners.items()}
    rates = {way: own.per_second for way, own in measure_rates(works, args.repeats).items()}
    return {
        way: {
            "updates_per_second": statistics.median(own),
            **{f"of {p}": median_ratio(own, rates[p]) for p in rates if p != way},
        }
        for way, own in rates.items()
    }


def main(args: Args) -> None:
    """Measures, prints, saves."""
    torch.set_num_threads(1)
    results = []
    for width, batch in args.sizes:
        table = measure(width, batch, args)
        print(f"\nobservation {OBSERVATION}, {width} x {width}, batch {batch}\n")
        print_table([{"learner": w, f"of {w}": 1.0, **row} for w, row in table.items()], COLUMNS)
        met = {}
        for key, least in TARGETS.items():
            peer, name = PEERS[key]
            reached = table[LEAN][f"of {peer}"]
            met[key] = reached >= least
            verdict = "met" if met[key] else "MISSED"
            print(f"target: {least} of {name}: {reached:.2f}, {verdict}")
        results.append({"width": width, "batch": batch, "table": table, "met": met})
    save(args.out, {"targets": TARGETS, "results": results}, args, peer_versions())


if __name__ == "__main__":
    main(tyro.cli(Args))
