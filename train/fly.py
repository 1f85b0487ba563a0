"""Flies a scene at once with the shipped policy or a planner, or a finished mission again.

python -m train.fly --scene FILE
python -m train.fly --scene FILE --planner mpc
python -m train.fly --scene FILE --wind 5 --gusts 2.5 --mover 10 --flights 100
python -m train.fly --scene FILE --uavs 3
python -m train.fly --run DIR
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from mjcollect.envs.course import Course
from mjcollect.envs.disturbed import is_disturbed
from mjcollect.envs.episode import Rules
from mjcollect.envs.recording import fly, fly_law
from mjcollect.fleet.flight import fly_fleet
from mjcollect.flight.disturbance import Disturbance
from mjcollect.learning.config import LearnConfig
from mjcollect.learning.policy import DISTURBED, SHIPPED, TrainedPolicy, policy_digest
from mjcollect.planners.mpc import Mpc
from mjcollect.planners.plan import Planner, fly_planner
from mjcollect.planners.reference.reference import NoFlight, Reference
from mjcollect.scene.order import order_label, plan_order
from mjcollect.scene.place import check_place
from mjcollect.scene.scene import Scene
from train import segment
from train.fleets.fly import (
    Trained,
    check_fleet,
    finished_fleet,
    fleet_policies,
    fly_by_policies,
    pilot_of,
    share_scene,
)
from train.fleets.report import Sharing, finish_fleet, write_fleet
from train.support.arguments import check_least
from train.support.command_line import INTERRUPTED, run_program, say
from train.support.disturbed_mission import (
    CALM,
    Weather,
    flights_result,
    fly_all,
    judged,
    write_air,
)
from train.support.finished_run import finished_run
from train.support.mission_report import finish, mission_result, write_mission
from train.support.repair import fly_and_repair
from train.support.run_folder import RunError, RunFolder, check_writable, default_folder
from train.support.starting_policy import check_size, start_from


@dataclass(frozen=True)
class Args:
    """Flies a mission without training it first: a scene at once, or a finished run again.

    It is flown many times where the air is disturbed; the first flight that comes home is shown in
    full, and the exit code is 0 if there is one. Nothing is trained then.
    """

    run: Path | None = None
    """Flies the policies of the finished train.mission run in this folder."""
    scene: str | None = None
    """Names a scene file or a bundled scene; with --run it must be the run's own scene."""
    planner: Literal["policy", "mpc", "reference", "guidance"] = "policy"
    """Selects what flies: policy (the run's trained policies, or --policy), mpc (model predictive
    control), reference (the whole mission planned ahead in the fewest slots), or guidance (the
    guidance law, which learns nothing)."""
    policy: Path | None = None
    """Names the policy that flies --scene: shipped (the default in calm air), disturbed (that in
    disturbed air), or a .safetensors or .pt file."""
    finetune: int = 2_000
    """Trains that policy for this many updates in each segment where it fails; 0 for none."""
    uavs: int = 1
    """Shares the items of --scene among so many UAVs, which fly at the same time."""
    order: str | None = None
    """Orders the items of --scene: lkh (default), exact, search, random, given, or a list such as
    2,0,1."""
    out: Path | None = None
    """Writes the results to this folder; by default runs/fly/<scene or run>-<planner>-seed<N>, with
    the disturbances before the seed."""
    guidance_cache: Path | None = None
    """Loads guidance from this folder where it fits, and adds what had to be built."""
    seed: int | None = None
    """Sets the seed of the random order for --scene, of --finetune and of disturbances; 0 by
    default."""
    shield: bool = True
    """Bends commands of policy and guidance that leave no way to stop without touching anything.
    Runs learned without the shield, and in calm air mpc and reference, always fly without it."""
    explore: bool = True
    """Lets a policy try something else where it gets no nearer: noise on its actions, for a while;
    in disturbed air, or with --flights."""
    flights: int | None = None
    """Flies the mission so often, each time in air of its own; by default 100 times in disturbed
    air, else once."""
    disturbance: Annotated[Disturbance, tyro.conf.arg(name="")] = CALM
    """Disturbs the flights."""
    overwrite: bool = False
    """Starts anew in a folder that is not empty."""
    video: bool = True
    """Renders mission.mp4."""
    replay: bool = True
    """Writes replay.html, which shows the flight in a browser."""
    plots: bool = True
    """Draws the plots."""


def main(argv: list[str] | None = None) -> int:
    """Runs the program and returns its exit code."""
    return run_program("train.fly", Args, fly_mission, argv)


def fly_mission(args: Args) -> int:
    """Flies, verifies and draws a mission; returns the exit code.

    Raises:
        RunError, SceneError, TourError, GuidanceError: the arguments are wrong; nothing is written.
    """
    if args.run is None and args.scene is None:
        raise RunError("give --scene FILE to fly it at once, or --run DIR of a finished mission")
    if args.uavs != 1 or (args.run is not None and (args.run / "fleet.json").is_file()):
        return fly_fleet_mission(args)
    given = {"seed": args.seed, "flights": args.flights}
    least = {"seed": 0, "flights": 1}
    check_least(args, finetune=0, **{k: least[k] for k, v in given.items() if v is not None})
    if args.policy is not None and (args.run is not None or args.planner != "policy"):
        raise RunError(f"--policy: {args.policy}: flies a --scene; leave --run and --planner out")
    if args.run is None and args.planner == "policy" and args.policy is None:
        disturbed = is_disturbed(args.disturbance) or Scene.find(args.scene or "").moving
        args = replace(args, policy=DISTURBED if disturbed else SHIPPED)
    policy = None if args.policy is None else start_from(args.policy, LearnConfig())[0]
    training_results: Sequence[dict[str, Any] | None]
    if args.run is not None:
        scene, order, method, seed = finished_run(args.run, args.scene, args.seed, args.order)
        segments = [RunFolder(args.run).segment(k) for k in range(len(order) + 1)]
        by_policy = args.planner == "policy"  # Other pilots do not depend on the training.
        training_results = [
            own.read_json("segment.json") if by_policy else None for own in segments
        ]
        learn = (RunFolder(args.run).read_json("config.json") or {}).get("learn", {})
        shield = args.shield and (not by_policy or learn.get("shield", False))
    else:
        scene, seed = Scene.find(args.scene or ""), args.seed or 0
        order = plan_order(scene, args.order or "lkh", seed=seed)
        method = order_label(args.order or "lkh")
        training_results = [None] * (len(order) + 1)
        shield = args.shield
    check_place(scene.origin)
    weather = Weather.of(args.disturbance, args.flights)
    many = weather.flights > 1 or weather.disturbed or bool(scene.moving)
    if many and args.planner == "reference":
        raise RunError(
            "--planner: reference: its plan is flown blindly, and made for a single calm flight; "
            "take policy, guidance or mpc, or leave disturbances and --flights out"
        )
    # In calm air the plans of MPC and reference planner are free of contact as they are.
    shield = shield and (many or args.planner in ("policy", "guidance"))
    name = scene.slug if args.run is None else args.run.resolve().name
    names = [name, args.planner, *(weather.name() if many else []), f"seed{seed}"]
    folder = RunFolder(args.out or default_folder("fly", *names))
    config = {
        "program": "train.fly",
        "scene": scene.name,
        "order": list(order),
        "planner": args.planner,
        "run": None if args.run is None else str(args.run),
        "policy": None if args.policy is None else policy_digest(args.policy),
        "seed": seed,
        "shield": shield,
        **(weather.config() | {"explore": args.explore} if many else {}),
    }
    folder.check(config, overwrite=args.overwrite, inputs=[args.run, args.policy])
    if args.guidance_cache is not None:
        check_writable(args.guidance_cache, "--guidance-cache")
    course = Course.mission(scene, order, args.guidance_cache)
    if args.guidance_cache is not None:
        course.save_guidance(args.guidance_cache)
    planner: Planner | None = None
    notes: list[str] = []
    if many:
        weather.check(course)
    if policy is not None:
        check_size(policy, course)
    elif args.planner == "policy":
        policies = [_load(own.path / "policy.pt") for own in segments]
    elif args.planner == "mpc":
        planner = Mpc(course)
    elif args.planner == "reference":
        planner, seconds = _planned(course)
        notes.append(f"Planned in {seconds:.1f} s.")
    folder.create(config, scene, overwrite=args.overwrite)
    flown = None
    if many:
        pilots = [] if args.planner != "policy" else policies if policy is None else [policy]
        every = fly_all(course, weather, args.planner, pilots, seed, shield, args.explore)
        flown = judged(course, order, every)
        flight = flown.flights[flown.shown].flight
    elif policy is not None:
        train = partial(_train, args, course, order, folder, seed, shield)
        repaired = fly_and_repair(course, order, policy, train if args.finetune else None, shield)
        flight, training_results, notes = repaired.flight, repaired.trained, repaired.notes
        args = replace(args, planner=repaired.planner)
    elif planner is not None:
        flight = fly_planner(course, planner)
        notes.append(planner.summary())
    elif args.planner == "policy":
        flight = fly(course, policies, policies[0].observation, shield=shield)
    else:
        flight = fly_law(course, shield=shield)
    for note in notes:
        say(note)
    air = None if flown is None else flown.flights[flown.shown].air
    result = mission_result(course, order, method, flight, training_results, seed, air)
    result["planner"] = args.planner
    if flown is not None:
        result |= flights_result(weather, flown)
        write_air(folder, course, order, flown, args.plots)
    write_mission(folder, scene, result, flight, plots=args.plots, air=air)
    folder.unlock()
    videos = [folder.path / "mission.mp4"] if args.video else []
    return finish(folder, videos, args.plots, notes, replay=args.replay)


def fly_fleet_mission(args: Args) -> int:
    """Flies, verifies and draws a mission of several UAVs, or one of a run again.

    Raises:
        RunError, SceneError, TourError, GuidanceError: the arguments are wrong; nothing is written.
    """
    check_least(args, uavs=1, finetune=0, **({} if args.seed is None else {"seed": 0}))
    if args.policy is not None and (args.run is not None or args.planner != "policy"):
        raise RunError(f"--policy: {args.policy}: flies a --scene; leave --run and --planner out")
    if args.planner == "reference":
        raise RunError(
            "--planner: reference: its plan is made for one UAV; take policy, guidance or mpc"
        )
    seed = args.seed or 0
    scene = Scene.load(args.run / "scene.json") if args.run else Scene.find(args.scene or "")
    check_place(scene.origin)
    others = {"--flights": args.flights, "--guidance-cache": args.guidance_cache}
    disturbed = {f"--{k}": v for k, v in asdict(args.disturbance).items() if v != getattr(CALM, k)}
    check_fleet(args.uavs, scene, {**others, **disturbed}, args.order)
    policies: list[TrainedPolicy] = []
    if args.run is not None:
        sharing, seed = finished_fleet(args.run, scene)
        check_same_fleet(args, sharing, seed)
        names = [args.run.resolve().name]
        if args.planner == "policy":
            policies = fleet_policies(args.run, sharing)
    else:
        sharing = share_scene(scene, args.uavs, seed)
        names = [scene.slug, f"{args.uavs}uavs"]
        if args.planner == "policy":
            args = replace(args, policy=args.policy or SHIPPED)
            one = start_from(args.policy or SHIPPED, LearnConfig())[0]
            check_size(one, sharing.courses[0])
            policies = [one] * sum(len(course.guidance) for course in sharing.courses)
    folder = RunFolder(args.out or default_folder("fly", *names, args.planner, f"seed{seed}"))
    config = {
        "program": "train.fly",
        "scene": scene.name,
        "uavs": sharing.uavs,
        "tours": [list(tour) for tour in sharing.tours],
        "planner": args.planner,
        "run": None if args.run is None else str(args.run),
        "policy": None if args.policy is None else policy_digest(args.policy),
        "seed": seed,
        "shield": args.shield,
    }
    folder.check(config, overwrite=args.overwrite, inputs=[args.run, args.policy])
    folder.create(config, scene, overwrite=args.overwrite)
    trained: Trained = [[None] * len(course.guidance) for course in sharing.courses]
    notes: list[str] = []
    if args.planner == "policy":

        def train(uav: int, index: int) -> tuple[TrainedPolicy, dict[str, Any]]:
            course, own = sharing.courses[uav], sharing.folder(folder, uav)
            own.path.mkdir(parents=True, exist_ok=True)
            own.write("scene.json", course.scene.save)
            order = tuple(range(len(course.scene.items)))
            return _train(args, course, order, own, seed, args.shield, index)

        repairs = train if args.finetune and args.policy is not None else None
        flown, trained, notes = fly_by_policies(
            sharing, policies, repairs, shield=args.shield, explore=args.explore
        )
    else:
        pilot, observation = pilot_of(args.planner, sharing, [], args.explore)
        flown = fly_fleet(sharing.courses, pilot, Rules(observation, shield=args.shield))
    for note in notes:
        say(note)
    write_fleet(folder, sharing, flown, args.planner, seed, trained, plots=args.plots)
    folder.unlock()
    return finish_fleet(folder, video=args.video, replay=args.replay, plots=args.plots, notes=notes)


def check_same_fleet(args: Args, sharing: Sharing, seed: int) -> None:
    """Refuses flags that contradict the run that is flown again.

    Raises:
        RunError: --uavs, --scene or --seed differs from the run's.
    """
    if args.uavs not in (1, sharing.uavs):
        raise RunError(f"--uavs: {args.uavs}: the run's is {sharing.uavs}; leave it out with --run")
    if args.seed not in (None, seed):
        raise RunError(f"--seed: {args.seed}: the run's is {seed}; leave it out with --run")
    other = None if args.scene is None else Scene.find(args.scene)
    if other is not None and (difference := sharing.scene.difference(other)):
        raise RunError(f"--scene: {args.scene}: is not the run's: {difference}; leave it out")


def _train(
    args: Args, course: Course, order: tuple[int, ...], folder: RunFolder, seed: int, shield: bool,
    index: int,
) -> tuple[TrainedPolicy, dict[str, Any]]:  # fmt: skip
    """Goes on learning from `--policy` in one segment; returns the policy and segment.json.

    Raises:
        KeyboardInterrupt: Ctrl-C ended the training.
    """
    assert args.policy is not None
    own = folder.segment(index)
    learn = LearnConfig(
        updates=args.finetune,
        extra_updates=0,
        eval_every=max(args.finetune // 10, 1),
        shield=shield,
    )
    with tempfile.TemporaryDirectory(prefix=".part-", dir=folder.path) as guidance:
        course.save_guidance(Path(guidance))
        training = segment.Args(
            scene=str(folder.path / "scene.json"), order=",".join(map(str, order)), segment=index,
            out=own.path, seed=seed, policy=args.policy, guidance_cache=Path(guidance),
            video=False, replay=False, overwrite=True, learn=learn,
        )  # fmt: skip
        if segment.train_segment(training) == INTERRUPTED:
            raise KeyboardInterrupt
    result = own.read_json("segment.json")
    assert result is not None
    return TrainedPolicy.load(own.path / "policy.pt"), result


def _planned(course: Course) -> tuple[Reference, float]:
    """Returns the reference planner with its plan made, and the time it took (s).

    Raises:
        RunError: it finds no flight.
    """
    reference, begun = Reference(course, tell=say), time.perf_counter()
    try:
        reference.plan()
    except NoFlight as error:
        raise RunError(str(error)) from None
    return reference, time.perf_counter() - begun


def _load(path: Path) -> TrainedPolicy:
    if not path.is_file():
        raise RunError(f"--run: {path}: is missing; the run is not finished")
    return TrainedPolicy.load(path)


if __name__ == "__main__":
    sys.exit(main())
