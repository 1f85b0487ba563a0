"""Declares the flags that several programs share, and refuses wrong values before any work."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import torch
import tyro

from mjcollect.learning import logs
from mjcollect.learning.config import LearnConfig
from mjcollect.learning.policy import NO_POLICY
from mjcollect.scene.scene import Scene
from train.support.presets import PresetName
from train.support.run_folder import RunError

Device = Literal["cpu", "cuda"]


@dataclass(frozen=True)
class TrainingArgs:
    """Holds the flags that `train.segment` and `train.mission` share."""

    scene: str = "scenario_1"
    """Scene file, or the name of a bundled scene."""
    order: str = "lkh"
    """Visiting order: lkh, exact, search, random, given (file order), or a list such as 2,0,1."""
    out: Path | None = None
    """Run folder; default: one below runs/ that is named after scene, program and seed."""
    seed: int = 0
    """Seed of every random stream; each segment of a mission gets one of its own from it."""
    device: Device = "cpu"
    """Where the networks live; simulation stays on the CPU."""
    resume: bool = False
    """Go on with the run in the folder."""
    overwrite: bool = False
    """Start anew in a folder that is not empty."""
    video: bool = True
    """Render segment.mp4 and mission.mp4; the segments' own only up to 10 items."""
    replay: bool = True
    """Write replay.html, which shows the flight in a browser."""
    plots: bool = True
    """Draw the plots, and fly the MPC in each segment to show what there is to beat."""
    checkpoint_every: int = 1000
    """Updates between checkpoints."""
    logger: logs.LoggerName = "none"
    """Log for other tools too, in logs/ of the run folder; wandb offline."""
    policy: Path = NO_POLICY
    """Policy to go on from: shipped, none (learn from nothing, as the paper does), or a file:
    policy.safetensors or policy.pt."""
    preset: PresetName | None = None
    """Settings by name; flags given beside it win. paper: Algorithm 1 as the paper states it."""
    slot: float | None = None
    """Seconds of a slot (the paper's delta) in place of the scene file's, such as 0.2 or 1.0."""
    learn: Annotated[LearnConfig, tyro.conf.arg(name="")] = dataclasses.field(
        default_factory=LearnConfig
    )
    """Settings of the learner."""


def check_least(args: object, **least: int) -> None:
    """Refuses numbers that are too small.

    Args:
        least: the least value of each field of `args`.

    Raises:
        RunError: A number is too small; the message names flag, value and bound.
    """
    for field, bound in least.items():
        value = getattr(args, field)
        if value < bound:
            too_small = "must not be negative" if bound == 0 else f"must be at least {bound}"
            raise RunError(f"--{field.replace('_', '-')}: {value}: {too_small}")


def check_still(scene: Scene) -> None:
    """Refuses a scene whose boxes move, which learning does not know of.

    Raises:
        RunError: some do.
    """
    if scene.moving:
        raise RunError(
            f"--scene: {scene.name}: moving: {len(scene.moving)} boxes: only train.fly flies among "
            "moving boxes; leave the key out to learn"
        )


def check_device(device: Device) -> None:
    """Refuses a device that is not there.

    Raises:
        RunError: torch sees no CUDA device.
    """
    if device == "cuda" and not torch.cuda.is_available():
        raise RunError("--device: cuda: torch sees no CUDA device here; use --device cpu")


def check_logger(logger: logs.LoggerName) -> None:
    """Refuses a logger whose package is not installed.

    Raises:
        RunError: it is not; the message says how to get it.
    """
    try:
        logs.check_logger(logger)
    except ModuleNotFoundError as error:
        raise RunError(f"--logger: {error}") from None
