"""Presets: named sets of settings that replace defaults; a flag given beside one wins over it."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

from mjcollect.learning.config import LearnConfig
from mjcollect.scene.file_format import SceneError
from mjcollect.scene.scene import Scene
from train.support.run_folder import RunError

T = TypeVar("T")
PresetName = Literal["paper"]
NEVER = 1_000_000_000  # updates; more than any budget


@dataclass(frozen=True)
class Choice:
    """A setting's value under a preset, and where that value comes from."""

    value: bool | float | int | str
    source: str


PAPER: Mapping[str, Choice] = {
    "reward": Choice("paper", "section V-A: r1 to r6"),
    "observation": Choice("paper", "section IV-B: S = {q, v, l, m, p}"),
    "demonstrations": Choice(0, "Algorithm 1, initialisation: D is empty"),
    "guided_share": Choice(0.0, "Algorithm 1: every action is pi(S; theta), perturbed"),
    "shield": Choice(False, "section V-A: contact and bounds are penalties, r5 and r6"),
    "envs": Choice(1, "Algorithm 1: one episode after another"),
    "u1": Choice(64, "U_1 is open: as many operations a round as the 64 simulations make else"),
    "noise_min": Choice(0.3, "Algorithm 1: one Gaussian perturbation; its size is open"),
    "optimizer": Choice("sgd", "Algorithm 1: plain gradient steps for w and theta"),
    "alpha_critic": Choice(1e-6, "open; plain steps on r1, hundreds a slot, end in NaN at 1e-4"),
    "alpha_actor": Choice(1e-6, "open; as alpha_critic"),
    "final_rate": Choice(1.0, "Algorithm 1: alpha^(w) and alpha^(theta) are constants"),
    "actor_delay": Choice(0, "Algorithm 1: w and theta are updated together from the start"),
    "average_rate": Choice(0.0, "Algorithm 1 has no average of actors beside theta_target"),
    "flown": Choice("last", "Algorithm 1, output: pi(theta) after the last update"),
    "extra_updates": Choice(0, "Algorithm 1: a fixed number of episodes M"),
    "least_updates": Choice(NEVER, "Algorithm 1: a fixed number of episodes M"),
    "patience": Choice(NEVER, "Algorithm 1: a fixed number of episodes M"),
    "retries": Choice(0, "Algorithm 2, step 3: Algorithm 1 is run once for each leg"),
}
"""What the paper says of settings that a flag sets, and what could not stay as it is with that."""


OPEN = (
    "updates", "u2", "batch", "buffer", "width", "gamma", "alpha_target", "noise_max",
)  # fmt: skip
"""Settings of Algorithm 1 whose values the paper does not give: under the preset, our defaults."""


PRESETS: dict[PresetName, Mapping[str, Choice]] = {"paper": PAPER}


def with_preset(args_class: Callable[..., T], argv: Sequence[str] | None) -> T:
    """The program's defaults under the `--preset` in its command line, for the flags to override.

    Args:
        args_class: settings of a program, with a `preset` and a `learn`. argv: None is sys.argv.
    """
    finder = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    finder.add_argument("--preset")
    name = None
    with contextlib.suppress(argparse.ArgumentError):  # tyro says what is wrong
        name = finder.parse_known_args(sys.argv[1:] if argv is None else list(argv))[0].preset
    if name not in PRESETS:
        return args_class()
    values = {field: choice.value for field, choice in PRESETS[name].items()}
    known = {field.name for field in dataclasses.fields(LearnConfig)}
    learn = LearnConfig(**{field: values.pop(field) for field in known & values.keys()})  # type: ignore[arg-type]
    own = {field.name for field in dataclasses.fields(args_class)}  # type: ignore[arg-type]
    rest: dict[str, Any] = {field: values[field] for field in own & values.keys()}
    return args_class(preset=name, learn=learn, **rest)


def with_slot(scene: Scene, slot: float | None) -> Scene:
    """The scene with another slot, in s; None leaves it.

    Raises:
        RunError: `slot` is not a multiple of the scene's physics step, or not a length of time.
    """
    if slot is None:
        return scene
    try:
        return dataclasses.replace(scene, slot=slot)
    except SceneError as error:
        raise RunError(
            f"--slot: {slot}: must be a multiple of the scene's physics_step = "
            f"{scene.physics_step} s, from one to 1000 of them"
        ) from error
