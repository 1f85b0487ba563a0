"""Replaces defaults by a preset, a named set of settings; a flag given beside it wins over it."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, TypeVar

from mjcollect.scene.file_format import SceneError
from mjcollect.scene.scene import Scene
from train.support.run_folder import RunError

T = TypeVar("T")
PresetName = Literal["paper"]
NEVER = 1_000_000_000  # No budget has as many updates.

# What the paper says of settings that a flag sets, with its source, and what could not stay as it
# is with that. The values of updates, u2, batch, buffer, width, gamma, alpha_target and noise_max
# are open in the paper: they stay our defaults.
PAPER: Mapping[str, bool | float | int | str] = {
    "reward": "paper",  # section V-A: r1 to r6
    "observation": "paper",  # section IV-B: S = {q, v, l, m, p}
    "demonstrations": 0,  # Algorithm 1, initialisation: D is empty
    "guided_share": 0.0,  # Algorithm 1: every action is pi(S; theta), perturbed
    "shield": False,  # section V-A: contact and bounds are penalties, r5 and r6
    "envs": 1,  # Algorithm 1: one episode after another
    "u1": 64,  # U_1 is open: as many operations a round as the 64 simulations make else
    "noise_min": 0.3,  # Algorithm 1: one Gaussian perturbation; its size is open
    "optimizer": "sgd",  # Algorithm 1: plain gradient steps for w and theta
    "alpha_critic": 1e-6,  # open; plain steps on r1, hundreds a slot, end in NaN at 1e-4
    "alpha_actor": 1e-6,  # open; as alpha_critic
    "final_rate": 1.0,  # Algorithm 1: alpha^(w) and alpha^(theta) are constants
    "actor_delay": 0,  # Algorithm 1: w and theta are updated together from the start
    "average_rate": 0.0,  # Algorithm 1 has no average of actors beside theta_target
    "flown": "last",  # Algorithm 1, output: pi(theta) after the last update
    "extra_updates": 0,  # Algorithm 1: a fixed number of episodes M
    "least_updates": NEVER,  # Algorithm 1: a fixed number of episodes M
    "patience": NEVER,  # Algorithm 1: a fixed number of episodes M
    "retries": 0,  # Algorithm 2, step 3: Algorithm 1 is run once for each segment
}
PRESETS: Mapping[PresetName, Mapping[str, bool | float | int | str]] = {"paper": PAPER}


def with_preset(args_class: Callable[..., T], argv: Sequence[str] | None) -> T:
    """Returns a program's defaults under the `--preset` in its command line, for flags to override.

    The program's settings have a `preset` and a `learn`; if `argv` is None, sys.argv is read.
    """
    finder = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    finder.add_argument("--preset")
    name: Any = None
    with contextlib.suppress(argparse.ArgumentError):  # tyro says what is wrong
        name = finder.parse_known_args(sys.argv[1:] if argv is None else list(argv))[0].preset
    choices = PRESETS.get(name)
    if choices is None:
        return args_class()
    usual: Any = args_class(preset=name)
    learn = {field: v for field, v in choices.items() if hasattr(usual.learn, field)}
    own = {field: v for field, v in choices.items() if hasattr(usual, field)}
    changed: T = dataclasses.replace(usual, learn=dataclasses.replace(usual.learn, **learn), **own)
    return changed


def with_slot(scene: Scene, slot: float | None) -> Scene:
    """Returns the scene with another slot, in s; None leaves it.

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
