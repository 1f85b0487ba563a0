"""Trained policies: saved to and loaded from policy.pt."""

from __future__ import annotations

import hashlib
import io
import json
import pickle
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import safetensors.torch
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential

from mjcollect import asset_path
from mjcollect.batch import Simulations
from mjcollect.course import Course
from mjcollect.episode import Rules
from mjcollect.observation import OBSERVATIONS
from train.ddpg import make_actor
from train.learn_config import LearnConfig
from train.plain_actor import PlainActor
from train.runs import RunError

SHIPPED = Path("shipped")  # stands for the package's own policy, wherever it is installed
# What reading a file that is no policy ends in.
UNREADABLE = (
    OSError, EOFError, RuntimeError, ValueError, LookupError, AttributeError, TypeError,
    StopIteration, pickle.UnpicklingError, safetensors.SafetensorError,
)  # fmt: skip


@dataclass(frozen=True)
class TrainedPolicy:
    """An actor that acts without noise.

    A single decision is made in plain NumPy, with the weights as they are at the first one: where
    the actor goes on learning, make a new policy.

    Attributes:
        actor: TorchRL module, observation -> action. observation: name of the observation.
    """

    actor: TensorDictSequential
    observation: str

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Actions (N, 3) for observations (N, D) float32."""
        if len(observation) == 1:
            return self.plain(observation[0])[None]
        device = next(self.actor.parameters()).device
        step = TensorDict({"observation": torch.from_numpy(observation)}, len(observation))
        with torch.no_grad():
            return np.asarray(self.actor(step.to(device))["action"].cpu().numpy())

    @cached_property
    def plain(self) -> PlainActor:
        """The actor for single observations."""
        return PlainActor(self.actor)

    @property
    def inputs(self) -> int:
        """Numbers in an observation."""
        return next(self.actor.parameters()).shape[1]

    @property
    def width(self) -> int:
        """Width of the hidden layers."""
        return len(next(self.actor.parameters()))

    def save(self, path: Path) -> None:
        """Write policy.pt, or policy.safetensors: tensors and names, loaded without unpickling."""
        weights = {
            name: value.cpu().contiguous() for name, value in self.actor.state_dict().items()
        }
        if path.suffix == ".safetensors":
            about = json.dumps({"observation": self.observation})
            path.write_bytes(safetensors.torch.save(weights, {"policy": about}))
            return
        # Through memory: on a full disk torch.save itself raises no OSError.
        buffer = io.BytesIO()
        content = {"actor": weights, "observation": self.observation}
        torch.save(content, buffer)
        path.write_bytes(buffer.getvalue())

    @classmethod
    def load(cls, path: Path) -> TrainedPolicy:
        """Read what `save` wrote."""
        if path.suffix == ".safetensors":
            with safetensors.safe_open(path, "pt") as file:
                weights = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
                names = json.loads(file.metadata()["policy"])
        else:
            saved = torch.load(path, weights_only=True, map_location="cpu")
            weights, names = saved["actor"], saved
        first = next(value for name, value in weights.items() if name.endswith("0.weight"))
        if names["observation"] not in OBSERVATIONS:
            raise ValueError(f"observation: {names['observation']}: unknown")
        actor = make_actor(first.shape[1], first.shape[0])
        actor.load_state_dict(weights)
        return cls(actor, names["observation"])


def weights_file(path: Path) -> Path:
    """The file of a policy; of the package's own for `SHIPPED`."""
    return asset_path("policies", "generalist.safetensors") if path == SHIPPED else path


def start_from(
    path: Path, learn: LearnConfig, flag: str = "--weights"
) -> tuple[TrainedPolicy, LearnConfig]:
    """The policy in a file, or `SHIPPED`, and the settings with which learning goes on from it.

    Its observation and width are taken over. Unless `learn` asks for something else than usual, no
    update is made where it is good enough.

    Args:
        flag: that named the file.

    Raises:
        RunError: there is no such policy, or `learn` asks for another observation or width.
    """
    try:
        policy = TrainedPolicy.load(weights_file(path))
    except UNREADABLE as error:
        raise RunError(
            f"{flag}: {path}: holds no policy ({type(error).__name__}); name a "
            "policy.safetensors of train.generalist or a segment's policy.pt"
        ) from None
    usual = LearnConfig()
    for field, value in (("observation", policy.observation), ("width", policy.width)):
        asked = getattr(learn, field)
        if asked not in (value, getattr(usual, field)):
            raise RunError(
                f"--{field}: {asked}: the policy of {flag} {path} has {value}; leave one out"
            )
    least = learn.least_updates
    return policy, replace(
        learn,
        observation=policy.observation,
        width=policy.width,
        least_updates=0 if least == usual.least_updates else least,
    )


def check_size(policy: TrainedPolicy, course: Course, flag: str = "--weights") -> None:
    """Refuse a policy that takes another number of inputs than its observation has here.

    Raises:
        RunError: naming the `flag` that named the policy.
    """
    simulations = Simulations([course], 1, rules=Rules(policy.observation), threads=1)
    size, takes = simulations.observe().shape[1], policy.inputs
    simulations.close()
    if takes != size:
        raise RunError(
            f"{flag}: a policy of {takes} inputs, but the observation {policy.observation} has "
            f"{size} here; name one of this version and for such scenes, or learn from scratch"
        )


def digest(path: Path) -> str:
    """What tells one file of weights, or `SHIPPED`, from another, wherever it lies."""
    return hashlib.sha256(weights_file(path).read_bytes()).hexdigest()[:16]
