"""A learner of your own: the cross-entropy method on the batched environment.

It shares nothing with `mjcollect.learning`. Every simulation is flown by a candidate of its own, a
linear policy; the best tenth of each generation says where the next one is drawn.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import tyro
from tensordict.nn import TensorDictModule

import mjcollect
from mjcollect.envs.episode import Rules


@dataclass
class Args:
    """Learns to fly one segment by the cross-entropy method."""

    scene: str = "scenario_1"
    """Names a scene file or a bundled scene."""
    segment: int = 3
    """Selects the segment of the tour."""
    generations: int = 20
    """Sets the number of generations."""
    candidates: int = 128
    """Sets the number of candidates in a generation, each in a simulation of its own."""
    seed: int = 0
    """Sets the seed."""
    quick: bool = False
    """Learns for a few generations only, to see that it works."""


def main(args: Args) -> list[float]:
    """Learns, prints a line for each generation, and returns the mean return of each elite."""
    if args.quick:
        args.generations, args.candidates = 7, 64
    torch.manual_seed(args.seed)
    scene = mjcollect.Scene.find(args.scene)
    course = mjcollect.Course.segment(scene, mjcollect.plan_order(scene, "lkh"), args.segment)

    # The reward `lost` is minus the time lost in each slot, so a return is minus the time lost in
    # all: the time flown, less what was the least time to go at first, plus what is left to go.
    rules = Rules(observation="path", reward="lost")
    env = mjcollect.BatchedFlightEnv(mjcollect.Simulations([course], args.candidates, rules=rules))
    size = env.observation_spec["observation"].shape[-1]
    slots = min(course.step_limit, 150)

    def act(seen: torch.Tensor) -> torch.Tensor:
        """Returns actions (N, 3), each of its own candidate, from observations (N, D)."""
        return torch.tanh(torch.einsum("nd,ndk->nk", seen, weights[:, :-1]) + weights[:, -1])

    policy = TensorDictModule(act, in_keys=["observation"], out_keys=["action"])

    mean, spread = torch.zeros(size + 1, 3), torch.full((size + 1, 3), 0.5)
    returns = []
    for generation in range(args.generations):
        weights = mean + spread * torch.randn(args.candidates, *mean.shape)
        with torch.no_grad():
            flown = env.rollout(slots, policy, break_when_any_done=False)["next"]
        done = flown["done"].squeeze(-1)
        first = (done.cumsum(1) - done.long()) == 0  # slots of each simulation's first episode
        score = (flown["reward"].squeeze(-1) * first).sum(1)
        arrived = (flown["success"].squeeze(-1) & first).any(1)

        elite = score.topk(max(1, args.candidates // 10)).indices
        mean, spread = weights[elite].mean(0), weights[elite].std(0, correction=0) + 0.02
        returns.append(float(score[elite].mean()))
        best = int(score.argmax())
        time = f"{int(first[best].sum()) * scene.slot:.1f} s" if arrived[best] else "-"
        print(
            f"generation {generation:2}: {int(arrived.sum()):3} of {args.candidates} arrive, "
            f"elite loses {-returns[-1]:6.2f} s, best takes {time}"
        )
    env.close()
    return returns


if __name__ == "__main__":
    main(tyro.cli(Args))
