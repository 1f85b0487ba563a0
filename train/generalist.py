"""Learns one policy for scenes it has never seen, in many segments at once.

python -m train.generalist --out DIR

It uses the same DDPG as `train.segment`. The segments lie in generated scenes; every `--rotate`
updates other segments of the pool are flown, and policies are evaluated on segments that are never
trained on. With more cores, `--shards` processes simulate side by side, here or with `--ray` on a
cluster; with a GPU, `--device cuda` learns there.
"""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro

from mjcollect.envs.batch import Batch, Simulations
from mjcollect.envs.course import Course
from mjcollect.envs.observation import SHOW_DISTURBANCES
from mjcollect.flight.disturbance import Disturbance, Disturbances
from mjcollect.learning.config import LearnConfig
from mjcollect.learning.evaluation import Evaluator
from mjcollect.learning.lessons import Lessons
from mjcollect.learning.logs import LoggerName
from mjcollect.learning.policy import NO_POLICY, TrainedPolicy, policy_digest, weights_file
from mjcollect.learning.random_streams import stream, torch_seed
from mjcollect.learning.trainer import Trainer, make_simulations
from train.jobs.lessons import School, give_lessons, load_lessons
from train.jobs.segment_pool import build_all, draw_segment
from train.jobs.shards import Crew, LocalCrew, RayCrew, ShardedSimulations
from train.jobs.workers import connect_ray
from train.support.arguments import check_device, check_least, check_logger
from train.support.command_line import INTERRUPTED, progress_bar, run_program, say, stop_on_ctrl_c
from train.support.generalist_report import finish, report
from train.support.run_folder import RunError, RunFolder, default_folder
from train.support.training_loop import learn_to_the_end

HELD_OUT = 1_000_000  # Segments are never trained on from this number on.
# A start without arrival counts as this time (s): 1% more arrivals are worth 0.3 s of mean time.
FAILURE_SECONDS = 30.0
LEARN = LearnConfig(
    updates=120_000, least_updates=120_000, patience=120_000, extra_updates=0, envs=128, width=192,
    buffer=1_000_000, actor_delay=2_000, noise_min=0.02, noise_max=0.3, demonstrations=50_000,
    guided_until=0.0, eval_every=5_000, eval_episodes=4,
)  # fmt: skip
DISTURBANCE = Disturbance(
    wind=5.0, gusts=2.5, gain=0.25, delay=0.1, noise=0.5, mover=20.0, boxes=2, turned=45.0
)
POOL, LESSONS = "pool", "lessons"  # folders in the run's
HARDER = 4.0  # A segment that always fails is drawn this many times more often than one that never.
FADED = 0.5  # What was seen of a segment weighs this share when it has been flown again.


@dataclass(frozen=True)
class Args:
    """Learns one policy for scenes it has never seen."""

    out: Path | None = None
    """Writes the run to this folder; by default runs/generalist/seed<N>."""
    seed: int = 0
    """Sets the seed of every random stream, the scenes included."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Puts the networks on this device; simulation stays on the CPU."""
    workers: int = 2
    """Sets the number of processes that build the segments' guidance."""
    segments: int = 240
    """Sets the number of segments trained on, each in a generated scene of its own."""
    held_out: int = 60
    """Sets the number of segments, in further scenes, on which policies are compared."""
    shards: int = 0
    """Sets the number of processes that simulate, in step with the learner; 0 for the learner's."""
    ray: str | None = None
    """Runs the shards on a Ray cluster at this address instead: host:port, auto, or local."""
    policy: Path = NO_POLICY
    """Starts from this policy: shipped, none, or a file. Its observation is that of --observation,
    or the first part of it, path of robust."""
    courses: int = 64
    """Sets the number of segments flown side by side, each in several simulations."""
    rotate: int = 2_000
    """Changes the segments that are flown every this many updates."""
    lessons: int = 0
    """First has the MPC say in this many slots what it would do, in flights of its own and of
    --policy; the actor learns from that beside its critic."""
    imitation: float = 1.0
    """Weights the mean square distance to the MPC's actions against the critic's value."""
    disturbed: float = 0.0
    """Disturbs this share of the simulations, and the evaluation if it is above 0; that needs the
    observation robust."""
    disturbance: Annotated[Disturbance, tyro.conf.arg(name="")] = DISTURBANCE
    """Sets the greatest disturbances."""
    resume: bool = False
    """Goes on with the run in the folder."""
    overwrite: bool = False
    """Starts anew in a folder that is not empty."""
    checkpoint_every: int = 10_000
    """Writes a checkpoint every this many updates."""
    logger: LoggerName = "none"
    """Logs for other tools too, in logs/ of the run folder; wandb offline."""
    learn: Annotated[LearnConfig, tyro.conf.arg(name="")] = LEARN
    """Sets the learner."""


class Generalist:
    """Holds a trainer whose simulations change their segments; `state_dict()` is its state."""

    def __init__(self, args: Args, numbers: tuple[list[int], list[int]], folder: Path) -> None:
        """Starts the shards, the simulations and the trainer.

        Args:
            numbers: numbers of the pool's segments to train on, and of those held out.
            folder: absolute, with the pool's guidance and with lessons if they are asked for.

        Raises:
            RunError: the policy to start from takes more numbers than there are.
        """
        self.args, self._pool = args, folder / POOL
        self._numbers, held_out = numbers
        self._crew: Crew | None = None
        if args.shards > 0:
            self._crew = LocalCrew(args.shards) if args.ray is None else RayCrew(args.shards)
        config, seed = args.learn, args.seed
        courses = [Course.segment(*draw_segment(seed, number), self._pool) for number in held_out]
        disturbances = None
        if args.disturbed > 0.0:  # Starts are calm at the point itself, disturbed in its ball.
            calm = np.tile(np.arange(config.eval_episodes) == 0, len(courses))
            rng = np.random.default_rng(stream(seed, "evaluate disturbances"))
            disturbances = Disturbances(args.disturbance, len(calm), rng, vary=True, calm=calm)
        evaluator = Evaluator(courses, config, seed, disturbances, FAILURE_SECONDS)
        self.rotation, self.failed = 0, np.zeros(len(self._numbers))
        simulations, weights = self._simulations(), None
        if args.policy != NO_POLICY:
            policy = TrainedPolicy.load(weights_file(args.policy))
            try:
                weights = policy.widened(simulations.observe().shape[1])
            except ValueError as error:
                raise RunError(f"--{error}") from None
        lessons = None
        if args.lessons > 0:
            columns = load_lessons(folder / LESSONS, args.lessons)
            seen, actions = (column.to(args.device) for column in columns)
            lessons = Lessons(
                seen, actions, weight=args.imitation, batch=config.batch,
                seed=torch_seed(seed, "lessons"),
            )  # fmt: skip
        self.trainer = Trainer(simulations, evaluator, config, seed, args.device, weights, lessons)

    def _simulations(self) -> Batch:
        """Returns simulations on this rotation's segments, more of those that fail."""
        chance = 1.0 + (HARDER - 1.0) * self.failed
        parts = range(max(self.args.shards, 1))
        self._drawn = [
            drawn(self.args, self._numbers, chance / chance.sum(), self.rotation, part)
            for part in parts
        ]
        if self._crew is None:
            return simulations(self.args, self._drawn[0], self._pool, self.rotation)
        makes = [
            partial(simulations, self.args, self._drawn[part], self._pool, self.rotation, part)
            for part in parts
        ]
        return ShardedSimulations(self._crew, makes, [_envs(self.args, part) for part in parts])

    def rotate(self) -> None:
        """Changes the segments if `--rotate` updates have passed."""
        rotation = self.trainer.learner.updates // self.args.rotate
        if rotation != self.rotation:
            self._learn_what_fails()
            self.rotation = rotation
            self.trainer.move(self._simulations())

    def _learn_what_fails(self) -> None:
        """Updates the share of failures of every segment flown in this rotation."""
        numbers = np.concatenate(
            [np.resize(own, _envs(self.args, part)) for part, own in enumerate(self._drawn)]
        )
        for index, number in enumerate(self._numbers):
            mine = numbers == number
            endings = int(self.trainer.endings[mine].sum())
            if endings > 0:
                share = float(self.trainer.failures[mine].sum()) / endings
                self.failed[index] = FADED * self.failed[index] + (1.0 - FADED) * share

    def state_dict(self) -> dict[str, Any]:
        """Returns the whole state, without the buffer's content and the settings."""
        own = {"rotation": self.rotation, "failed": self.failed.tolist()}
        return {**own, "trainer": self.trainer.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Goes back to a state that `state_dict` returned."""
        self.rotation, self.failed = state["rotation"], np.array(state["failed"])
        self.trainer.move(self._simulations())
        self.trainer.load_state_dict(state["trainer"])

    def close(self) -> None:
        """Stops all processes and threads."""
        self.trainer.close()
        if self._crew is not None:
            self._crew.close()


def _envs(args: Args, part: int) -> int:
    """Returns the number of simulations in a shard."""
    return len(range(part, args.learn.envs, max(args.shards, 1)))


def drawn(
    args: Args, numbers: Sequence[int], chance: np.ndarray, rotation: int, part: int
) -> np.ndarray:
    """Returns the numbers of the segments that are flown in a rotation, or in one shard of it.

    Args:
        numbers: numbers of the pool's segments. chance: of each to be drawn before the others.
        rotation: number of the rotation. part: number of the shard.
    """
    rng = np.random.default_rng(stream(args.seed, f"draw {rotation} shard {part}"))
    count = min(-(-args.courses // max(args.shards, 1)), len(numbers))
    return rng.choice(numbers, count, replace=False, p=chance)


def simulations(
    args: Args, numbers: np.ndarray, pool: Path, rotation: int, part: int = 0
) -> Simulations:
    """Returns the simulations of a rotation, or of one shard.

    Args:
        numbers: numbers of the pool's segments to fly. pool: folder of their guidance; what is
            missing is built. rotation: number of the rotation. part: number of the shard.
    """
    envs = _envs(args, part)
    name = f"rotation {rotation}" + (f" shard {part}" if args.shards else "")
    rng = np.random.default_rng(stream(args.seed, name))
    segments = [Course.segment(*draw_segment(args.seed, int(n)), pool) for n in numbers]
    disturbances = None
    if args.disturbed > 0.0:
        calm = rng.permutation(envs) >= round(args.disturbed * envs)
        disturbances = Disturbances(args.disturbance, envs, rng, vary=True, calm=calm)
    courses = [segments[i % len(segments)] for i in range(envs)]
    learn = dataclasses.replace(args.learn, envs=envs)
    return make_simulations(courses, learn, int(rng.integers(2**62)), disturbances)


def main(argv: list[str] | None = None) -> int:
    """Runs the program and returns its exit code."""
    return run_program("train.generalist", Args, train_generalist, argv)


def train_generalist(args: Args) -> int:
    """Builds the pool, learns and saves the policy; returns the exit code.

    Raises:
        RunError: the arguments cannot be run.
    """
    _check(args)
    config = {"program": "train.generalist", **dataclasses.asdict(args)}
    for field in ("out", "resume", "overwrite", "workers", "ray", "checkpoint_every", "logger"):
        del config[field]
    config["policy"] = None if args.policy == NO_POLICY else policy_digest(args.policy)
    folder = RunFolder(args.out or default_folder("generalist", f"seed{args.seed}"))
    folder.check(config, resume=args.resume, overwrite=args.overwrite, inputs=[args.policy])
    if args.resume and folder.read_json("generalist.json") is not None:
        return report(folder)
    if args.ray is not None:
        connect_ray(args.ray, cpus=args.shards)
    folder.create(config, None, overwrite=args.overwrite)
    try:
        numbers = _build(folder, args)
        if numbers is None or not _give_lessons(folder, args, numbers[0]):
            say("stopped; go on with --resume")
            return INTERRUPTED
        generalist = Generalist(args, numbers, folder.path.resolve())
        try:
            if not _learn(generalist, folder, args):
                return INTERRUPTED
            finish(generalist.trainer, folder, numbers)
        finally:
            generalist.close()
    finally:
        folder.unlock()
    return report(folder)


def _check(args: Args) -> None:
    """Refuses what would fail late.

    Raises:
        RunError: a setting is out of range; the message names field, value and fix.
    """
    check_device(args.device)
    check_logger(args.logger)
    check_least(
        args, seed=0, workers=1, segments=1, held_out=1, courses=1, rotate=1, checkpoint_every=1,
        lessons=0,
    )  # fmt: skip
    if not 0.0 <= args.imitation < math.inf:
        raise RunError(f"--imitation: {args.imitation}: must be a number from 0 on")
    if not 0.0 <= args.disturbed <= 1.0:
        raise RunError(f"--disturbed: {args.disturbed}: must lie between 0 and 1")
    if not 0 <= args.shards <= args.learn.envs:
        raise RunError(f"--shards: {args.shards}: must lie between 0 and --envs {args.learn.envs}")
    if args.ray is not None and args.shards < 1:
        raise RunError("--ray: needs --shards N, the number of actors that simulate")
    if args.learn.observation == "paper":
        raise RunError(
            "--observation: paper: has as many numbers as a scene has boxes and items, and these "
            "scenes differ; use path, guided or robust"
        )
    if args.disturbed > 0.0 and args.learn.observation not in SHOW_DISTURBANCES:
        raise RunError(
            f"--observation: {args.learn.observation}: does not show disturbances; use "
            f"{' or '.join(SHOW_DISTURBANCES)}, or --disturbed 0"
        )


def _build(folder: RunFolder, args: Args) -> tuple[list[int], list[int]] | None:
    """Builds the pool; returns the numbers to train on and held out, or None after Ctrl-C."""
    built: dict[str, bool] = folder.read_json("pool.json") or {}
    wanted = [*range(args.segments), *range(HELD_OUT, HELD_OUT + args.held_out)]
    missing = [number for number in wanted if str(number) not in built]
    for draft in (folder.path / POOL).glob("*.tmp"):  # by a process that was killed
        draft.unlink()
    with stop_on_ctrl_c() as stopped, progress_bar(len(wanted), "segment") as bar:
        bar.update(len(wanted) - len(missing))
        for number, ok in build_all(args.seed, missing, folder.path / POOL, args.workers):
            built[str(number)] = ok
            bar.update()
            if stopped():
                break
    folder.write_json("pool.json", built)
    if any(str(number) not in built for number in wanted):
        return None
    found = [number for number in wanted if built[str(number)]]
    train, held_out = ([n for n in found if (n >= HELD_OUT) == out] for out in (False, True))
    for field, left in (("segments", train), ("held-out", held_out)):
        if not left:
            raise RunError(f"--{field}: the guidance finds no way in any of them; ask for more")
    return train, held_out


def _give_lessons(folder: RunFolder, args: Args, numbers: Sequence[int]) -> bool:
    """Has the MPC give the lessons that are asked for; returns False if Ctrl-C stopped it."""
    if args.lessons == 0:
        return True
    school = School(
        args.seed, tuple(numbers), (folder.path / POOL).resolve(), args.learn.rules,
        args.disturbed, args.disturbance,
        None if args.policy == NO_POLICY else weights_file(args.policy).resolve(),
    )  # fmt: skip
    given, where = 0, folder.path / LESSONS
    with stop_on_ctrl_c() as stopped, progress_bar(args.lessons, "lesson") as bar:
        for size in give_lessons(school, where, args.lessons, args.workers):
            bar.update(min(size, args.lessons - given))
            given = min(given + size, args.lessons)
            if stopped():
                break
    return given >= args.lessons


def _learn(generalist: Generalist, folder: RunFolder, args: Args) -> bool:
    """Trains to the end; returns False if Ctrl-C stopped it, after a checkpoint."""
    return learn_to_the_end(
        generalist.trainer,
        folder,
        {"generalist": generalist, "buffer": generalist.trainer.buffer},
        lambda row: (
            f"held out: success {row['eval_success_rate']:.1%}, calm {row['eval_time']:.2f} s, "
            f"all {row['eval_mean_time']:.2f} s"
        ),
        resume=args.resume,
        checkpoint_every=args.checkpoint_every,
        logger=args.logger,
        after_round=generalist.rotate,
    )


if __name__ == "__main__":
    sys.exit(main())
