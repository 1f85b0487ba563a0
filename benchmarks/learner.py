"""Updates per second of the learner against Stable-Baselines3's DDPG and hand-written torch loops.

    OMP_NUM_THREADS=1 python -m benchmarks.learner --out docs/results/learner.json

All have the same networks (two hidden layers, LayerNorm in each, as in training), batch and Adam,
update actor, critic and both targets every time, and draw their batches from a full replay buffer
of their own kind; drawing is counted. One thread each, interleaved, medians over the rounds.
Needs `pip install .[bench]`.
"""

from __future__ import annotations

import copy
import dataclasses
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
import tyro
from stable_baselines3.common.buffers import ReplayBuffer
from tensordict import TensorDict

from benchmarks.results import save
from benchmarks.sb3 import Spaces, make_sb3, peer_versions
from mjcollect.learning.fast_ddpg import LEARNERS
from mjcollect.learning.networks import make_actor, make_critic
from mjcollect.learning.replay import make_buffer

GAMMA, TAU, RATE = 0.99, 0.01, 1e-3
TARGETS = {"SB3": 1.3, "hand-written": 0.9}
LABELS = {"SB3": "SB3 as it comes", "hand-written": "the faster hand-written loop"}


@dataclass(frozen=True)
class Args:
    """Measure updates per second of each learner."""

    sizes: tuple[tuple[int, int], ...] = ((128, 256), (256, 256), (128, 128))
    """Width of the hidden layers and transitions in a batch, per table."""
    observation: int = 52
    """Length of the observation."""
    repeats: int = 15
    """Interleaved rounds."""
    updates: int = 64
    """Updates of each learner in a round."""
    u2: int = 8
    """Updates that ours and SB3's make in one call, as in training."""
    transitions: int = 20_000
    """Transitions in each replay buffer."""
    out: Path | None = None
    """JSON file for the results."""


def experience(args: Args) -> TensorDict:
    """Random transitions."""
    n, d = args.transitions, args.observation
    return TensorDict(
        {
            "observation": torch.randn(n, d),
            "action": torch.rand(n, 3) * 2 - 1,
            "next": {
                "observation": torch.randn(n, d),
                "reward": torch.randn(n, 1),
                "done": torch.rand(n, 1) < 0.02,
                "terminated": torch.rand(n, 1) < 0.01,
            },
        },
        [n],
    )


def ours(kind: str, width: int, batch: int, data: TensorDict, args: Args) -> Callable[[int], None]:
    """Our learner, of either kind."""
    learner = LEARNERS[kind](
        args.observation, width=width, gamma=GAMMA, alpha_actor=RATE, alpha_critic=RATE,
        alpha_target=TAU, final_rate=1.0, total_updates=1,
    )  # fmt: skip
    buffer = make_buffer(len(data), batch, seed=0)
    buffer.extend(data)

    def learn(updates: int) -> None:
        for _ in range(updates // args.u2):
            losses = learner.learn(buffer, args.u2)
        check(losses[-1])

    return learn


def fill(buffer: ReplayBuffer, data: TensorDict) -> ReplayBuffer:
    """Put the transitions into SB3's buffer."""
    after = data["next"]
    buffer.observations[:, 0] = data["observation"].numpy()
    buffer.next_observations[:, 0] = after["observation"].numpy()
    buffer.actions[:, 0] = data["action"].numpy()
    buffer.rewards[:] = after["reward"].numpy()
    buffer.dones[:] = after["terminated"].numpy()
    buffer.pos, buffer.full = 0, True
    return buffer


def sb3(
    width: int, batch: int, data: TensorDict, args: Args, *, fused: bool
) -> Callable[[int], None]:
    """Stable-Baselines3's DDPG."""
    model = make_sb3(
        Spaces(args.observation), width, fused=fused, buffer_size=len(data), gamma=GAMMA, tau=TAU,
        learning_rate=RATE, seed=0,
    )  # fmt: skip
    fill(model.replay_buffer, data)

    def learn(updates: int) -> None:
        for _ in range(updates // args.u2):
            model.train(gradient_steps=args.u2, batch_size=batch)
        check(model.logger.name_to_value["train/critic_loss"])

    return learn


def by_hand(
    width: int, batch: int, data: TensorDict, args: Args, *, tuned: bool
) -> Callable[[int], None]:
    """A loop in plain torch, as CleanRL's ddpg_continuous_action has it.

    `tuned`: with fused Adam, one call for the soft update, and a buffer of torch tensors.
    """
    mlp = make_actor(args.observation, width)[0].module
    actor, critic = torch.nn.Sequential(mlp, torch.nn.Tanh()), make_critic(args.observation, width)
    critic = critic.module
    nets = (actor, critic)
    targets = tuple(copy.deepcopy(net).requires_grad_(False) for net in nets)
    actor_optimizer, critic_optimizer = (
        torch.optim.Adam(net.parameters(), lr=RATE, fused=tuned or None) for net in nets
    )
    pairs = [list(net.parameters()) for net in nets], [list(net.parameters()) for net in targets]
    online, delayed = (first + second for first, second in pairs)
    spaces = Spaces(args.observation)
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

    def learn(updates: int) -> None:
        for _ in range(updates):
            loss = update()
        check(loss)

    return learn


def check(loss: object) -> None:
    """Refuse to time updates that have gone wrong."""
    if not np.isfinite(np.asarray(torch.as_tensor(loss).detach())).all():
        raise RuntimeError(f"loss: {loss}: must be finite")


def measure(width: int, batch: int, args: Args) -> dict[str, dict[str, float]]:
    """Updates per second of each learner and its ratio to SB3's, medians over the rounds."""
    torch.manual_seed(0)
    data = experience(args)
    ways = {
        "ours, lean": ours("lean", width, batch, data, args),
        "ours, TorchRL": ours("torchrl", width, batch, data, args),
        "SB3": sb3(width, batch, data, args, fused=False),
        "SB3, fused Adam": sb3(width, batch, data, args, fused=True),
        "hand-written, as CleanRL": by_hand(width, batch, data, args, tuned=False),
        "hand-written, tuned": by_hand(width, batch, data, args, tuned=True),
    }
    for learn in ways.values():
        learn(args.u2 * 2)
    rates: dict[str, list[float]] = {way: [] for way in ways}
    for _ in range(args.repeats):
        for way, learn in ways.items():
            start = time.perf_counter()
            learn(args.updates)
            rates[way].append(args.updates / (time.perf_counter() - start))
    return {
        way: {
            "updates_per_second": statistics.median(rates[way]),
            **{f"of {peer}": ratio(rates[way], rates[peer]) for peer in ways if peer != way},
        }
        for way in ways
    }


def ratio(one: list[float], other: list[float]) -> float:
    """Median over the rounds, which both ran side by side."""
    return statistics.median(a / b for a, b in zip(one, other, strict=True))


def main(args: Args) -> None:
    """Measure, print, save."""
    torch.set_num_threads(1)
    results = []
    for width, batch in args.sizes:
        table = measure(width, batch, args)
        print(f"\nobservation {args.observation}, {width} x {width}, batch {batch}\n")
        print("| learner | updates/s | of SB3 | of hand-written, as CleanRL | of tuned |")
        print("|---|---|---|---|---|")
        for way, row in table.items():
            peers = ("SB3", "hand-written, as CleanRL", "hand-written, tuned")
            shares = " | ".join(f"{row.get(f'of {peer}', 1.0):.2f}" for peer in peers)
            print(f"| {way} | {row['updates_per_second']:.0f} | {shares} |")
        lean = table["ours, lean"]
        reached = {"SB3": lean["of SB3"], "hand-written": lean["of hand-written, tuned"]}
        met = {peer: reached[peer] >= least for peer, least in TARGETS.items()}
        for peer, least in TARGETS.items():
            verdict = "met" if met[peer] else "MISSED"
            print(f"target: {least} of {LABELS[peer]}: {reached[peer]:.2f}, {verdict}")
        results.append({"width": width, "batch": batch, "table": table, "met": met})
    content = {"targets": TARGETS, "results": results}
    save(args.out, content, arguments=dataclasses.asdict(args), versions=peer_versions())


if __name__ == "__main__":
    main(tyro.cli(Args))
