"""Looks for better settings of the learner, with Optuna: a sweep over settings and seeds.

    python -m examples.sweep --quick
    python -m examples.sweep --out DIR --trials 30 --seeds 2 --jobs 2

Every trial learns the same segment with other settings and with several seeds, side by side in
processes. A trial that is behind the median of the others after an evaluation is pruned. Trial 0
has the learner's own settings. The best of the others is trained again, beside these, with seeds
that the sweep has not used: the best of many trials looks better than it is. The results depend
neither on --jobs nor on stops: Ctrl-C, then --resume, gives the table of one go, its seconds aside.
"""

from __future__ import annotations

import dataclasses
import math
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from examples.sweep.report import Result, write_report
from examples.sweep.training import JUDGED, Crew, Task, hired, score, train
from mjcollect.envs.course import Course
from mjcollect.learning.config import LearnConfig
from mjcollect.learning.evaluation import Evaluator
from mjcollect.scene.order import first_blocked, plan_order
from mjcollect.scene.scene import Scene
from train.support.arguments import check_least, check_still
from train.support.command_line import progress_bar, run_program, say
from train.support.run_folder import RunError, RunFolder

if TYPE_CHECKING:
    import optuna

FILES = ("config.json", "command.txt", "scene.json", "guidance", "study.journal", "sweep.*")
WARM_UP = 2  # No trial is pruned before this evaluation.


@dataclass(frozen=True)
class Args:
    """Looks for better settings of the learner in one segment, and says if it has found any."""

    scene: str = "scenario_1"
    """Names a scene file, or a bundled scene."""
    segment: int | None = None
    """Selects the segment; by default the first blocked one."""
    out: Path = Path("runs/sweep")
    """Writes the sweep to this folder."""
    trials: int = 30
    """Sets the number of settings that are tried; with --resume, of all since the beginning."""
    seeds: int = 2
    """Sets the number of seeds that each of them is trained with."""
    again: int = 4
    """Sets the number of further seeds for the usual settings and the best others."""
    updates: int = 1_500
    """Sets the number of updates of each training; in the first fifth the critic learns alone."""
    evaluations: int = 6
    """Sets how often each is evaluated, and may be pruned."""
    judged: int = 128
    """Sets the number of starts from which the policy of a training is judged in the end."""
    envs: int = 64
    """Sets the number of simulations of each training."""
    demonstrations: int = 10_000
    """Sets the number of the guidance law's transitions with which each training begins."""
    jobs: int = 2
    """Sets the number of processes; each computes with OMP_NUM_THREADS threads, by default 1."""
    seed: int = 0
    """Sets the seed of the sampler, and the first of the trainings."""
    resume: bool = False
    """Goes on with the sweep in the folder."""
    overwrite: bool = False
    """Starts anew in a folder that is not empty."""
    quick: bool = False
    """Makes other defaults: under a minute, to see that all works; it finds nothing."""


QUICK = Args(
    out=Path("runs/sweep-quick"), trials=3, again=1, updates=240, evaluations=3, judged=8, envs=16,
    demonstrations=2_048, quick=True,
)  # fmt: skip


def suggest(trial: optuna.Trial) -> dict[str, Any]:
    """Returns the settings of a trial; this is the space that is searched."""
    return {
        "alpha_actor": trial.suggest_float("alpha_actor", 1e-4, 1e-2, log=True),
        "alpha_critic": trial.suggest_float("alpha_critic", 1e-4, 1e-2, log=True),
        "noise_max": trial.suggest_float("noise_max", 0.1, 0.6),
        "batch": trial.suggest_categorical("batch", [64, 128, 256, 512]),
        "gamma": trial.suggest_float("gamma", 0.9, 0.99),
    }


USUAL = {name: getattr(LearnConfig(), name) for name in
         ("alpha_actor", "alpha_critic", "noise_max", "batch", "gamma")}  # fmt: skip


def try_settings(study: optuna.Study, crew: Crew, task: Task, args: Args) -> None:
    """Tries the next settings, and tells the study."""
    import optuna

    trial, begun = study.ask(), time.monotonic()

    def worse(evaluation: int, mean: float) -> bool:
        trial.report(mean, evaluation)
        return trial.should_prune()

    seeds = range(args.seed, args.seed + args.seeds)
    scores, success = train(crew, task, suggest(trial), seeds, worse)
    for name, value in (
        ("scores", scores), ("success", success), ("seconds", time.monotonic() - begun)
    ):  # fmt: skip
        trial.set_user_attr(name, value)
    if math.isnan(success):
        study.tell(trial, state=optuna.trial.TrialState.PRUNED)
    else:
        study.tell(trial, float(np.mean(scores)))


def open_study(folder: Path) -> optuna.Study:
    """Opens or makes the study in the folder; trials that were interrupted are tried again.

    Raises:
        RunError: the study's file is damaged.
    """
    import optuna

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    path = folder / "study.journal"
    journal = optuna.storages.journal.JournalFileBackend(str(path))
    try:
        study = optuna.create_study(
            storage=optuna.storages.JournalStorage(journal),
            study_name="sweep",
            pruner=optuna.pruners.MedianPruner(n_startup_trials=4, n_warmup_steps=WARM_UP),
            load_if_exists=True,
        )
    except ValueError as error:
        raise RunError(
            f"{path}: is damaged ({error}); remove the line, or start anew with --overwrite"
        ) from None
    state = optuna.trial.TrialState
    for trial in study.get_trials(states=(state.RUNNING, state.WAITING)):
        study.tell(trial.number, state=state.FAIL)
    return study


def finished(study: optuna.Study) -> list[optuna.trial.FrozenTrial]:
    """Returns the trials that came to an end, pruned ones included."""
    from optuna.trial import TrialState

    return study.get_trials(states=(TrialState.COMPLETE, TrialState.PRUNED))


def sweep(study: optuna.Study, task: Task, args: Args) -> None:
    """Tries settings until there are `args.trials`, then trains usual and best others again."""
    import optuna

    with hired(args.jobs) as crew, progress_bar(args.trials, "trial") as bar:
        bar.update(len(finished(study)))
        while (count := len(finished(study))) < args.trials:
            if count == 0:
                study.enqueue_trial(USUAL)
            # A seed for each trial: what is tried does not depend on stops.
            study.sampler = optuna.samplers.TPESampler(
                n_startup_trials=6, seed=args.seed + count, multivariate=True
            )
            try_settings(study, crew, task, args)
            bar.update()
            bar.set_postfix_str(f"best {study.best_value:.4f}")
        again = dict(study.user_attrs.get("again", {}))
        first = args.seed + args.seeds
        trials = finished(study)
        others = [k for k, trial in enumerate(trials) if k > 0 and trial.value is not None]
        if not others or args.again == 0:
            return
        for number in (0, min(others, key=lambda k: trials[k].value)):
            if len(again.get(str(number), ())) != args.again:
                seeds = range(first, first + args.again)
                again[str(number)] = train(crew, task, trials[number].params, seeds)[0]
                study.set_user_attr("again", again)


def main(argv: list[str] | None = None) -> int:
    """Runs the program and returns its exit code."""
    given = sys.argv[1:] if argv is None else argv
    usual = QUICK if "--quick" in given else Args()
    return run_program("examples.sweep", Args, run_sweep, argv, lambda: usual)


def run_sweep(args: Args) -> int:
    """Sweeps, and writes the table; returns 0.

    Raises:
        RunError, SceneError, GuidanceError: the arguments are wrong; nothing is written.
    """
    try:
        import optuna  # noqa: F401
    except ModuleNotFoundError:
        raise RunError("optuna: is not installed; pip install 'mjcollect[sweep]'") from None
    check_least(
        args, trials=1, seeds=2, again=0, updates=1, evaluations=1, judged=2, envs=1, jobs=1,
        seed=0, demonstrations=0,
    )  # fmt: skip
    if args.evaluations > args.updates:
        raise RunError(f"--evaluations: {args.evaluations}: must be at most --updates")
    scene = Scene.find(args.scene)
    check_still(scene)
    order = plan_order(scene, "lkh")
    segment = first_blocked(scene, order) if args.segment is None else args.segment
    if not 0 <= segment <= len(order):
        raise RunError(f"--segment: {segment}: must be 0 to {len(order)}, the tour's last")
    usual = LearnConfig(
        updates=args.updates, least_updates=args.updates, patience=args.updates, extra_updates=0,
        gap=0.0, actor_delay=args.updates // 5, eval_every=args.updates // args.evaluations,
        envs=args.envs, demonstrations=args.demonstrations,
    )  # fmt: skip
    config = {"program": "examples.sweep", **dataclasses.asdict(args)}
    for field in ("out", "trials", "again", "jobs", "resume", "overwrite", "quick"):
        del config[field]  # A sweep may go on with others.
    config |= {"scene": scene.name, "order": list(order), "segment": segment}
    folder = RunFolder(args.out)
    folder.check(config, resume=args.resume, overwrite=args.overwrite)
    if args.resume:
        folder.check_scene(scene, args.scene)
    say(f"{scene.name}: segment {segment} of order {list(order)}")
    course = Course.segment(scene, order, segment)
    folder.create(config, scene, overwrite=args.overwrite, files=FILES)
    try:
        course.save_guidance(folder.path / "guidance")
        task = Task(folder.path.resolve(), order, segment, usual, args.judged)
        study = open_study(folder.path)
        sweep(study, task, args)
        law = Evaluator([course], dataclasses.replace(usual, eval_episodes=args.judged), JUDGED)
        results = [Result.of(k, trial) for k, trial in enumerate(finished(study))]
        again = {int(number): found for number, found in study.user_attrs.get("again", {}).items()}
        text = write_report(folder, results, again, score(task, law.law()))
        law.close()
    finally:
        folder.unlock()
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
