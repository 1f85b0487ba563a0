"""Learns to fly one segment of a tour, flies it, verifies the flight, and draws it.

python -m train.segment --scene FILE --segment I --out DIR
"""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from mjcollect.envs.course import Course
from mjcollect.envs.recording import fly
from mjcollect.learning.policy import NO_POLICY, TrainedPolicy, policy_digest
from mjcollect.learning.trainer import Trainer, segment_trainer
from mjcollect.planners.mpc import Mpc
from mjcollect.planners.plan import fly_planner
from mjcollect.render.arrivals import progress
from mjcollect.render.path_figures import plot_path_3d, plot_path_top
from mjcollect.render.time_figures import plot_learning
from mjcollect.scene.bounds import detour_bound, segment_bound
from mjcollect.scene.order import first_blocked, node_name, plan_order, tour_segments
from mjcollect.scene.scene import Scene
from mjcollect.verify import verify
from train.support.arguments import (
    TrainingArgs,
    check_device,
    check_least,
    check_logger,
    check_still,
)
from train.support.command_line import INTERRUPTED, run_program, say
from train.support.mission_report import film, write_record, write_replay
from train.support.presets import with_preset, with_slot
from train.support.run_folder import RunError, RunFolder, default_folder, finite, versions
from train.support.starting_policy import check_size, start_from
from train.support.training_loop import learn_to_the_end


@dataclass(frozen=True)
class Args(TrainingArgs):
    """Learns to fly one segment of a tour with DDPG, flies it, verifies the flight and films it."""

    segment: int | None = None
    """Selects the segment, 0 (leaves the depot) to K (returns); by default the first
    blocked one, or 0 if none is."""
    guidance_cache: Path | None = None
    """Names the folder in which a mission saved its guidance, which else takes seconds to build."""


def main(argv: list[str] | None = None) -> int:
    """Runs the program and returns its exit code."""
    return run_program("train.segment", Args, train_segment, argv, lambda: with_preset(Args, argv))


def train_segment(args: Args) -> int:
    """Learns, flies, verifies and draws a segment; returns the exit code.

    Raises:
        RunError, SceneError, TourError, GuidanceError: the arguments are wrong; nothing is written.
    """
    check_device(args.device)
    check_least(args, seed=0, checkpoint_every=1)
    check_logger(args.logger)
    policy = None
    if args.policy != NO_POLICY:
        policy, learn = start_from(args.policy, args.learn)
        args = dataclasses.replace(args, learn=learn)
    scene = with_slot(Scene.find(args.scene), args.slot)
    check_still(scene)
    order = plan_order(scene, args.order, seed=args.seed)
    index = first_blocked(scene, order) if args.segment is None else args.segment
    if not 0 <= index <= len(order):
        raise RunError(f"--segment: {index}: must be 0 to {len(order)}, the tour's last")
    config = {
        "program": "train.segment",
        "scene": scene.name,
        "order": list(order),
        "order_method": args.order,
        "segment": index,
        "seed": args.seed,
        "device": args.device,
        "preset": args.preset,
        "slot": args.slot,
        "policy": None if policy is None else policy_digest(args.policy),
        "learn": dataclasses.asdict(args.learn),
    }
    name = [f"segment{index}", *([args.preset] if args.preset else []), f"seed{args.seed}"]
    folder = RunFolder(args.out or default_folder("segment", scene.slug, *name))
    folder.check(config, resume=args.resume, overwrite=args.overwrite, inputs=[args.policy])
    if args.resume and folder.read_json("segment.json") is not None:
        return _report(folder, args)
    if args.resume:
        folder.check_scene(scene, args.scene)
    say(f"{scene.name}: order {list(order)}, segment {index}: {_legend(order, index)}")
    course = Course.segment(scene, order, index, args.guidance_cache)
    if policy is not None:
        check_size(policy, course)
    folder.create(config, scene, overwrite=args.overwrite)
    try:
        return _run(course, order, index, folder, args, policy)
    finally:
        folder.unlock()


def _run(
    course: Course, order: tuple[int, ...], index: int, folder: RunFolder, args: Args,
    policy: TrainedPolicy | None,
) -> int:  # fmt: skip
    trainer = segment_trainer(course, args.learn, args.seed, args.device, policy)
    goal = segment_bound(course.scene, *course.nodes)
    try:
        if not learn_to_the_end(
            trainer,
            folder,
            {"trainer": trainer, "buffer": trainer.buffer},
            lambda row: _progress(row, goal),
            resume=args.resume,
            checkpoint_every=args.checkpoint_every,
            logger=args.logger,
        ):
            return INTERRUPTED
        _finish(trainer, course, folder, order, index, args.plots)
    finally:
        trainer.close()
    return _report(folder, args)


def _progress(row: dict[str, float], bound: float) -> str:
    time_ = f"{row['eval_time']:.1f}s" if math.isfinite(row["eval_time"]) else "-"
    return (
        f"return {row['episode_return']:.2f}, success {row['eval_success_rate']:.0%}, "
        f"time {time_} (bound {bound:.1f}s)"
    )


def _finish(
    trainer: Trainer, course: Course, folder: RunFolder, order: tuple[int, ...], index: int,
    plots: bool,
) -> None:  # fmt: skip
    """Flies and judges the best policy; writes every file but the video, segment.json last."""
    scene, (start_node, end_node) = course.scene, tour_segments(order)[index]
    if trainer.best_policy is not None:
        trainer.learner.actor.load_state_dict(trainer.best_policy)
    policy = trainer.policy
    flight = fly(course, [policy], policy.observation, shield=trainer.config.shield)
    violations = verify(scene, flight.trajectory, order, segment=index)
    success = flight.success and not violations
    seconds = flight.trajectory.duration if success else None
    bound = segment_bound(scene, start_node, end_node)
    detour = detour_bound(scene, start_node, end_node, course.guidance[0].length)
    law = trainer.evaluator.law()
    rivals = {
        "law_time": finite(law.point_time),
        "mpc_time": _mpc_time(course, order, index) if plots else None,
    }
    folder.write_metrics(trainer.rows)
    folder.write("policy.pt", policy.save)
    write_record(folder, flight)
    if plots:
        flown, way = progress(scene, flight.trajectory, order, index), course.guidance[0].path
        folder.write("path_3d.png", lambda part: plot_path_3d(part, flown, way))
        folder.write("path_top.png", lambda part: plot_path_top(part, flown, way))
        folder.write(
            "learning.png",
            lambda part: plot_learning(part, trainer.rows, bound=bound, detour=detour, **rivals),
        )
    folder.write_json(
        "segment.json",
        {
            "scene": scene.name,
            "segment": index,
            "order": list(order),
            "from": start_node,
            "to": end_node,
            "time": seconds,
            "lower_bound": bound,
            "ratio": seconds / bound if seconds is not None and bound > 0 else None,
            "detour_time": detour,
            "success": success,
            "success_rate": trainer.best.success_rate if trainer.best else 0.0,
            "best_mean_time": finite(trainer.best.mean_time) if trainer.best else None,
            "last_mean_time": finite(trainer.last.mean_time) if trainer.last else None,
            "last_success_rate": trainer.last.success_rate if trainer.last else 0.0,
            "shield_share": flight.shield_share,
            **rivals,
            "contacts": flight.contacts,
            "violations": [violation.to_dict() for violation in violations],
            "train_seconds": trainer.seconds,
            "env_steps": trainer.env_steps,
            "updates": trainer.learner.updates,
            "seed": trainer.seed,
            "versions": versions(),
        },
    )
    # A finished run needs no replay buffer, which is by far the largest part of a checkpoint.
    folder.save_checkpoint(trainer=trainer)


def _mpc_time(course: Course, order: tuple[int, ...], index: int) -> float | None:
    """Returns the MPC's time (s) from the segment's own start point, or None if it fails."""
    flight = fly_planner(course, Mpc(course))
    fails = not flight.success or verify(course.scene, flight.trajectory, order, segment=index)
    return None if fails else flight.trajectory.duration


def _report(folder: RunFolder, args: Args) -> int:
    """Makes a missing replay and video, prints the result; returns 0 for success, else 1."""
    result = folder.read_json("segment.json")
    assert result is not None
    if args.replay:
        write_replay(folder)
    if args.video:
        film(folder.path / "segment.mp4")
    where = f"{_legend(result['order'], result['segment'])}, {folder.path}"
    if result["success"]:
        ratio = "" if result["ratio"] is None else f" ({result['ratio']:.3f} of the lower bound)"
        print(
            f"success: {result['time']:.1f} s{ratio}, detour estimate "
            f"{result['detour_time']:.1f} s, success rate {result['success_rate']:.0%}: {where}"
        )
        return 0
    reasons = ", ".join(sorted({violation["kind"] for violation in result["violations"]}))
    print(f"no success ({reasons or 'not finished'}): {where}")
    return 1


def _legend(order: Sequence[int], index: int) -> str:
    return " -> ".join(node_name(node) for node in tour_segments(order)[index])


if __name__ == "__main__":
    sys.exit(main())
