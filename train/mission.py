"""Runs Algorithm 2: orders the items, learns every segment, and flies them all, back to the depot.

python -m train.mission --scene FILE --out DIR --workers 2

Learning goes on from the shipped policy, or with --policy none from nothing, as in the paper. With
--uavs 3 three UAVs share the items, and fly what each has learned at the same time.
"""

from __future__ import annotations

import dataclasses
import os
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from mjcollect.envs.course import Course
from mjcollect.envs.recording import fly
from mjcollect.learning.policy import NO_POLICY, OWN, SHIPPED, TrainedPolicy, policy_digest
from mjcollect.scene.order import SHORTEST, order_label, plan_order
from mjcollect.scene.place import check_place
from mjcollect.scene.scene import Scene
from train.fleets.fly import check_fleet, fleet_policies, fly_by_policies, share_scene
from train.fleets.report import Sharing, finish_fleet, write_fleet
from train.jobs.processes import warm_up
from train.jobs.workers import (
    Done,
    Job,
    LocalWorkers,
    RayWorkers,
    attempt_seed,
    connect_ray,
    run_jobs,
    settings_arguments,
)
from train.support.arguments import (
    TrainingArgs,
    check_device,
    check_least,
    check_logger,
    check_still,
)
from train.support.command_line import INTERRUPTED, run_program, say
from train.support.mission_display import MissionDisplay
from train.support.mission_report import finish, mission_result, write_mission
from train.support.presets import with_preset, with_slot
from train.support.run_folder import RunError, RunFolder, default_folder
from train.support.starting_policy import OtherNetwork, check_size, start_from

MOST_SEGMENT_VIDEOS = 10  # With more items than this, only the whole mission is filmed.


class TrainingError(RuntimeError):
    """Says that a segment's training process ended with an error."""


@dataclass(frozen=True)
class Args(TrainingArgs):
    """Orders the items, learns every segment, flies the mission, verifies and films the flight."""

    policy: Path = SHIPPED
    """Goes on learning from a policy: shipped, none (learn from nothing, as the paper does), or a
    .safetensors or .pt file."""
    cost: Literal["distance", "time"] = "distance"
    """Makes the orders lkh, exact and search minimise the straight distance (distance, as in the
    paper) or the least time round the boxes (time)."""
    uavs: int = 1
    """Shares the items among so many UAVs, which fly at the same time."""
    workers: int = 2
    """Sets the number of local processes that train segments side by side."""
    ray: str | None = None
    """Trains on a Ray cluster at this address instead: host:port, auto, or local."""
    retries: int = 2
    """Trains a segment with other seeds, up to this often, until every start arrives."""


def main(argv: list[str] | None = None) -> int:
    """Runs the program and returns its exit code."""
    return run_program("train.mission", Args, train_mission, argv, lambda: with_preset(Args, argv))


def train_mission(args: Args) -> int:
    """Orders the items, learns, flies, verifies and draws; returns the exit code.

    Raises:
        RunError, SceneError, TourError, GuidanceError: the arguments are wrong; nothing is written.
    """
    _check(args)
    scene = with_slot(Scene.find(args.scene), args.slot)
    check_still(scene)
    check_place(scene.origin)
    args, policy = _begin_from(args)
    if args.uavs > 1:
        return _train_fleet(args, scene, policy)
    cost = None
    if args.cost == "time" and args.order in SHORTEST:
        from mjcollect.guidance.travel_times import travel_times

        cost = travel_times(scene)
    order = plan_order(scene, args.order, seed=args.seed, cost=cost)
    method = order_label(args.order) + ("-time" if cost is not None else "")
    config = _config(args, scene, {"order": list(order), "order_method": method})
    folder = _folder(args, scene, args.order)
    folder.check(config, resume=args.resume, overwrite=args.overwrite, inputs=[args.policy])
    if args.resume and folder.read_json("mission.json") is not None:
        return _finish(folder, args, len(order) + 1)
    if args.resume:
        folder.check_scene(scene, args.scene)
    say(f"{scene.name}: order {list(order)} ({method}), {len(order) + 1} segments")
    if args.ray is None:
        warm_up()
    else:
        connect_ray(args.ray)
    say("computing the guidance of every segment")
    guidance = folder.path / "guidance"
    course = Course.mission(scene, order, guidance)
    if policy is not None:
        check_size(policy, course)
    folder.create(config, scene, overwrite=args.overwrite)
    try:
        course.save_guidance(guidance)  # The segments' processes and --resume read it.
        if not _learn(args, folder, scene, order):
            say("stopped, saved; go on with --resume")
            return INTERRUPTED
        segments = [folder.segment(index) for index in range(len(order) + 1)]
        policies = [TrainedPolicy.load(segment.path / "policy.pt") for segment in segments]
        flight = fly(course, policies, args.learn.observation, shield=args.learn.shield)
        training_results = [segment.read_json("segment.json") for segment in segments]
        result = mission_result(course, order, method, flight, training_results, args.seed)
        write_mission(folder, scene, result, flight, plots=args.plots)
        shutil.rmtree(guidance, ignore_errors=True)
    except TrainingError as error:
        say(f"error: {error}; when mended, go on with --resume")
        return 1
    finally:
        folder.unlock()
    return _finish(folder, args, len(order) + 1)


def _config(args: Args, scene: Scene, visited: dict[str, object]) -> dict[str, object]:
    """Returns the document of config.json; `visited` says who visits what."""
    return {
        "program": "train.mission",
        "scene": scene.name,
        **visited,
        "seed": args.seed,
        "device": args.device,
        "preset": args.preset,
        "slot": args.slot,
        "policy": None if args.policy == NO_POLICY else policy_digest(args.policy),
        "retries": args.retries,
        "learn": dataclasses.asdict(args.learn),
    }


def _folder(args: Args, scene: Scene, visited: str) -> RunFolder:
    """Returns the run's folder, by default one named by how it was made."""
    how = [args.preset] if args.preset else ["scratch"] if args.policy == NO_POLICY else []
    names = [scene.slug, visited, *how, f"seed{args.seed}"]
    return RunFolder(args.out or default_folder("mission", *names))


def _train_fleet(args: Args, scene: Scene, policy: TrainedPolicy | None) -> int:
    """Shares the items, learns every UAV's segments, flies all at once; returns the exit code.

    Raises:
        RunError, SceneError, TourError, GuidanceError: the arguments are wrong; nothing is written.
    """
    check_fleet(args.uavs, scene, {}, args.order)
    say(f"sharing {len(scene.items)} items among {args.uavs} UAVs")
    sharing = share_scene(scene, args.uavs, args.seed)
    config = _config(args, scene, {"uavs": args.uavs, "tours": [list(t) for t in sharing.tours]})
    folder = _folder(args, scene, f"{args.uavs}uavs")
    folder.check(config, resume=args.resume, overwrite=args.overwrite, inputs=[args.policy])
    if not (args.resume and folder.read_json("fleet.json") is not None):
        if args.resume:
            folder.check_scene(scene, args.scene)
        if args.ray is None:
            warm_up()
        else:
            connect_ray(args.ray)
        if policy is not None:
            check_size(policy, sharing.courses[0])
        folder.create(config, scene, overwrite=args.overwrite)
        try:
            if not _learn_fleet(args, folder, sharing):
                say("stopped, saved; go on with --resume")
                return INTERRUPTED
            policies = fleet_policies(folder.path, sharing)
            flown, _, _ = fly_by_policies(
                sharing, policies, None, shield=args.learn.shield, explore=True
            )
            trained = [
                [sharing.folder(folder, uav).segment(k).read_json("segment.json") for k in range(n)]
                for uav, n in enumerate(len(course.guidance) for course in sharing.courses)
            ]
            write_fleet(folder, sharing, flown, "policy", args.seed, trained, plots=args.plots)
        except TrainingError as error:
            say(f"error: {error}; when mended, go on with --resume")
            return 1
        finally:
            folder.unlock()
    notes = [
        f"UAV {uav}: {note}"
        for uav, course in enumerate(sharing.courses)
        for note in _notes(sharing.folder(folder, uav), len(course.guidance))
    ]
    return finish_fleet(folder, video=args.video, replay=args.replay, plots=args.plots, notes=notes)


def _learn_fleet(args: Args, folder: RunFolder, sharing: Sharing) -> bool:
    """Trains every segment of every UAV that is not trained yet; False if Ctrl-C stopped it.

    Raises:
        TrainingError: a training ended with an error.
    """
    for uav, course in enumerate(sharing.courses):
        own, order = sharing.folder(folder, uav), tuple(range(len(course.scene.items)))
        own.path.mkdir(parents=True, exist_ok=True)
        own.write("scene.json", course.scene.save)
        course.save_guidance(own.path / "guidance")
        say(f"UAV {uav}: items {list(sharing.tours[uav])}, {len(order) + 1} segments")
        seeded = dataclasses.replace(args, seed=attempt_seed(args.seed, uav, 0), video=False)
        if not _learn(seeded, own, course.scene, order):
            return False
        shutil.rmtree(own.path / "guidance", ignore_errors=True)
    return True


def _check(args: Args) -> None:
    check_least(args, seed=0, uavs=1, workers=1, retries=0, checkpoint_every=1)
    check_device(args.device)
    check_logger(args.logger)
    if args.ray is not None and args.policy not in (NO_POLICY, *OWN):
        raise RunError(
            f"--policy: {args.policy}: the nodes of --ray have the package's own policies only, "
            f"{' and '.join(map(str, OWN))}; leave one of the two out"
        )


def _begin_from(args: Args) -> tuple[Args, TrainedPolicy | None]:
    """Returns the arguments fitted to the policy to start from, and that policy if any."""
    if args.policy != NO_POLICY:
        try:
            policy, learn = start_from(args.policy, args.learn)
            return dataclasses.replace(args, learn=learn), policy
        except OtherNetwork as error:
            if args.policy != SHIPPED:
                raise
            say(f"{error}: that is done")
    return dataclasses.replace(args, policy=NO_POLICY), None


def _learn(args: Args, folder: RunFolder, scene: Scene, order: tuple[int, ...]) -> bool:
    """Trains every segment that is not trained yet; returns False if Ctrl-C stopped it.

    Raises:
        TrainingError: a training ended with an error.
    """

    def job(index: int) -> Job | None:
        """Returns the next training of a segment, or None if it needs no more."""
        segment = folder.segment(index)
        result = segment.read_json("segment.json")
        if result is not None and result["success"] and result["success_rate"] == 1.0:
            return None
        tried = _attempts(folder, index)
        if result is not None or len(tried) > args.retries:
            if len(tried) >= args.retries:
                _keep_best(folder, index)
                return None
            _set_aside(folder, index, len(tried))
        attempt = len(_attempts(folder, index))
        filmed = args.video and len(order) <= MOST_SEGMENT_VIDEOS
        arguments = [
            "--scene", str((folder.path / "scene.json").resolve()), "--segment", str(index),
            "--order", ",".join(map(str, order)),
            "--seed", str(attempt_seed(args.seed, index, attempt)),
            "--device", args.device, "--checkpoint-every", str(args.checkpoint_every), "--resume",
            "--logger", args.logger,
            "--video" if filmed else "--no-video", "--plots" if args.plots else "--no-plots",
            "--replay" if args.replay else "--no-replay",
            *settings_arguments(dataclasses.asdict(args.learn)),
            "--guidance-cache", str((folder.path / "guidance").resolve()),
            *(["--preset", args.preset] if args.preset else []),
            *_from_policy(args.policy, attempt),
        ]  # fmt: skip
        return Job(index, tuple(arguments), segment.path)

    def retry(done: Done) -> Job | None:
        index = done.job.index
        # Python exits with 1 after any error, so only a result file shows that training finished.
        if done.code not in (0, 1) or not (done.job.folder / "segment.json").is_file():
            raise TrainingError(f"segment {index}: exit code {done.code}: {done.message}")
        display.finished(index)
        return job(index)

    display = MissionDisplay(folder, scene, order, args.learn.updates)
    jobs = [found for index in range(len(order) + 1) if (found := job(index))]
    with display.shown():
        return run_jobs(
            LocalWorkers(args.workers) if args.ray is None else RayWorkers(), jobs, retry
        )


def _from_policy(policy: Path, attempt: int) -> list[str]:
    """Returns a training's arguments for the policy to start from; retries start from nothing."""
    if policy == NO_POLICY or attempt > 0:
        return []
    return ["--policy", str(policy if policy in OWN else policy.resolve())]


def _attempts(folder: RunFolder, index: int) -> list[Path]:
    """Returns a segment's trainings that were set aside, in attempts/<segment>-<number>/."""
    return sorted((folder.path / "attempts").glob(f"{index}-*"))


def _set_aside(folder: RunFolder, index: int, number: int) -> None:
    """Moves a training away to repeat it with another seed, atomically by one rename."""
    (folder.path / "attempts").mkdir(exist_ok=True)
    os.rename(folder.segment(index).path, folder.path / "attempts" / f"{index}-{number}")


def _keep_best(folder: RunFolder, index: int) -> None:
    """Puts the best of all trainings of a segment in its place, where none was perfect."""

    def rank(path: Path) -> tuple[bool, float, float]:
        result = RunFolder(path).read_json("segment.json") or {}
        time = result.get("time") or float("inf")
        return (result.get("success", False), result.get("success_rate", 0.0), -time)

    segment = folder.segment(index).path
    tried = _attempts(folder, index)
    # The segment's own comes first and stays unless others are better, so a repetition is harmless.
    best = max([segment, *tried] if segment.exists() else tried, key=rank)
    if best != segment:
        if segment.exists():
            _set_aside(folder, index, len(tried))
        os.rename(best, segment)


def _notes(folder: RunFolder, segments: int) -> list[str]:
    """Returns the report's sentences on segments that were trained more than once."""
    notes = []
    for index in range(segments):
        if tried := _attempts(folder, index):
            result = folder.segment(index).read_json("segment.json") or {}
            notes.append(
                f"Segment {index} was trained {len(tried) + 1} times with different seeds; the "
                f"policy kept arrives from {result.get('success_rate', 0.0):.0%} of the starts."
            )
    return notes


def _finish(folder: RunFolder, args: Args, segments: int) -> int:
    """Renders missing videos, writes the report, prints the result; returns 0 for success."""
    videos = []
    if args.video:
        videos = [folder.path / "mission.mp4"]
        if segments <= MOST_SEGMENT_VIDEOS + 1:  # Some may have been stopped before theirs.
            videos += [folder.segment(k).path / "segment.mp4" for k in range(segments)]
    notes = _notes(folder, segments)
    return finish(folder, videos, args.plots, notes, replay=args.replay)


if __name__ == "__main__":
    sys.exit(main())
