"""Reads the policy that learning goes on from, or that flies, as the flag --policy names it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from mjcollect.envs.batch import Simulations
from mjcollect.envs.course import Course
from mjcollect.envs.episode import Rules
from mjcollect.learning.config import LearnConfig
from mjcollect.learning.policy import PolicyError, TrainedPolicy, weights_file
from train.support.run_folder import RunError


class OtherNetwork(RunError):
    """Says that settings ask for another observation or width than the policy has."""


def start_from(path: Path, learn: LearnConfig) -> tuple[TrainedPolicy, LearnConfig]:
    """Returns the policy in a file, or `SHIPPED`, and settings with which to learn on from it.

    Its observation and width are taken over. Unless `learn` asks for something else than usual, no
    update is made where it is good enough.

    Raises:
        RunError: There is no such policy.
        OtherNetwork: `learn` asks for another observation or width.
    """
    try:
        policy = TrainedPolicy.load(weights_file(path))
    except PolicyError as error:
        raise RunError(
            f"--policy: {error}; name a policy.safetensors of train.generalist or a segment's "
            "policy.pt"
        ) from None
    usual = LearnConfig()
    for field, value in (("observation", policy.observation), ("width", policy.width)):
        asked = getattr(learn, field)
        if asked not in (value, getattr(usual, field)):
            raise OtherNetwork(
                f"--{field}: {asked}: the policy of --policy {path} has {value}; leave one out, "
                "or learn from scratch"
            )
    least = learn.least_updates
    return policy, replace(
        learn,
        observation=policy.observation,
        width=policy.width,
        least_updates=0 if least == usual.least_updates else least,
    )


def check_size(policy: TrainedPolicy, course: Course) -> None:
    """Refuses a policy that takes another number of inputs than its observation has here.

    Raises:
        RunError: It does.
    """
    simulations = Simulations([course], 1, rules=Rules(policy.observation), threads=1)
    size, takes = simulations.observe().shape[1], policy.inputs
    simulations.close()
    if takes != size:
        raise RunError(
            f"--policy: a policy of {takes} inputs, but the observation {policy.observation} has "
            f"{size} here; name one of this version and for such scenes, or learn from scratch"
        )
