"""`parkenv train`: train agents by reinforcement learning, and evaluate them against planners."""

from __future__ import annotations

import dataclasses
import sys
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from parkenv import __version__
from parkenv.cli import arguments as args
from parkenv.cli.drive_task import DriveTask
from parkenv.cli.report import PAGE
from parkenv.cli.search_task import SearchTask
from parkenv.cli.tables import make_console
from parkenv.cli.training_task import FIGURE, Row, TrainingTask, curves_beside
from parkenv.errors import InputError

if TYPE_CHECKING:
    from parkenv.evaluation.experiments.spec import TrainingSpec
    from parkenv.evaluation.experiments.workers import Workers
    from parkenv.evaluation.training.rl_training import Training

TASKS: Mapping[str, type[TrainingTask]] = {"search": SearchTask, "drive": DriveTask}


def train(
    algorithm: Annotated[
        str | None,
        typer.Argument(
            help="To search: dqn, ppo, maskable-ppo, recurrent-ppo.  [default: maskable-ppo]  "
            "To drive: sac, tqc, ppo.  [default: ppo]"
        ),
    ] = None,
    env: Annotated[
        str,
        typer.Option(
            "--env",
            metavar="search|drive",
            help="What to learn: to search (parkenv/Search-v1), or to drive into slots (parkenv/Drive-v1).",
            rich_help_panel=args.WORLD,
        ),
    ] = "search",
    scenario: args.ScenariosOption = None,
    lot: args.LotOption = None,
    test_on: Annotated[
        str | None,
        typer.Option(
            "--test-on",
            metavar="NAME|FILE[,...]",
            help="Scenarios to test in at the end.  [default: those of the training]",
            rich_help_panel=args.WORLD,
        ),
    ] = None,
    steps: Annotated[
        int | None,
        typer.Option(
            "--steps",
            min=1,
            help="Decisions of a training.  [default: 2000000 to search; to drive, the training config's]",
        ),
    ] = None,
    seeds: Annotated[
        int, typer.Option("--seeds", min=1, help="Trainings, one for each seed from --seed on.")
    ] = 5,
    clone: Annotated[
        str | None,
        typer.Option(
            "--clone",
            metavar="PLANNER",
            help="Start with behaviour cloning of this planner (search; ppo, maskable-ppo).",
        ),
    ] = None,
    demonstrations: Annotated[
        int | None,
        typer.Option("--demonstrations", min=1, help="Searches of the planner to clone.  [default: 2000]"),
    ] = None,
    k: Annotated[
        int | None, typer.Option("--k", min=1, help="Slots in an observation (search).  [default: 5]")
    ] = None,
    evaluate_every: Annotated[
        int | None,
        typer.Option(
            "--evaluate-every",
            min=1,
            help="Decisions between evaluations.  [default: 100000 to search; to drive, a twentieth of --steps]",
        ),
    ] = None,
    evaluation_episodes: Annotated[
        int | None,
        typer.Option(
            "--evaluation-episodes",
            min=2,
            help="Episodes of an evaluation, in held-out worlds; to drive, on each lot for each kind of slot.  "
            "[default: 256; 64]",
        ),
    ] = None,
    planners: Annotated[
        str | None,
        typer.Option(
            "--planners",
            metavar="NAME[,NAME...]|none",
            help="Agents that are drawn for comparison.  [default: belief, mdp-tuned, mdp, first-free, greedy-drive, "
            "greedy-goal; to drive, planner]",
        ),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="First seed of the trainings.")] = 0,
    jobs: args.JobsOption = 0,
    backend: args.BackendOption = "loky",
    address: args.AddressOption = None,
    tensorboard: Annotated[
        bool, typer.Option("--tensorboard", help="Keep logs for TensorBoard in --out.")
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            help="Folder for models, curves and figures.  [default: results/ALGORITHM, results/drive-ALGORITHM]",
        ),
    ] = None,
    beside: Annotated[
        str | None,
        typer.Option(
            "--beside",
            metavar="DIR[,DIR...]",
            help="Folders of other trainings with the same evaluations, to draw in the same figure.",
        ),
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue from the checkpoints in --out.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the training in --out.")] = False,
    report: args.ReportOption = False,
) -> None:
    """Train agents by reinforcement learning with several seeds, and draw their learning curves beside the planners.

    The reward of search agents is minus the time in seconds. They observe the surroundings of the car, so they run on
    any lot. Driving agents park the car in a slot, with hindsight experience replay (sac, tqc) or the dense reward
    (ppo); their curriculum starts just outside the slot. Both are evaluated in held-out worlds; each seed's best model
    is kept, and tested at the end. Hyperparameters are in parkenv/evaluation/training/configs.py.

    Examples:
    * `parkenv train maskable-ppo --scenario campus`

    * `parkenv train maskable-ppo --scenario my_lot.toml --steps 200000 --seeds 1`

    * `parkenv train ppo --clone mdp-tuned --test-on campus,street,jam --out results/cloned`

    * `parkenv train ppo --beside results/maskable-ppo,results/dqn`

    * `parkenv train sac --env drive --scenario campus,street --seeds 3`

    * `parkenv compare --agents mdp,maskable-ppo:results/maskable-ppo/seed_0/model.safetensors`
    """
    from parkenv.evaluation.experiments.agent_spec import split_agents
    from parkenv.evaluation.experiments.spec import TrainingSpec

    given = {
        "scenarios": tuple(args.scenario_specs(scenario, lot=lot)) if scenario or lot else None,
        "test_on": tuple(args.scenario_specs(test_on)) if test_on else None,
        "planners": None if planners is None else [] if planners == "none" else split_agents(planners),
    }
    spec = TrainingSpec().changed(
        env=env, algorithm=algorithm, steps=steps, seeds=seeds, seed=seed, clone=clone, demonstrations=demonstrations,
        k=k, evaluate_every=evaluate_every, evaluation_episodes=evaluation_episodes, tensorboard=tensorboard,
        jobs=jobs, backend=backend, address=address, **given,
    )  # fmt: skip
    others = args.words("--beside", beside) if beside else ()
    run_training(spec, out, resume=resume, overwrite=overwrite, beside=others, report=report)


def run_training(
    spec: TrainingSpec,
    out: Path | None = None,
    *,
    resume: bool = False,
    overwrite: bool = False,
    beside: Sequence[str] = (),
    report: bool = False,
) -> None:
    """Train, test and draw; see `train`.

    Raises:
        InputError: the training is impossible, or the folder cannot be used.
    """
    from parkenv.evaluation.experiments.results import make_folder, write_summary
    from parkenv.evaluation.experiments.spec import SPEC_FILE
    from parkenv.evaluation.training.rl_training import MODEL

    task = TASKS[spec.env](spec)
    task.check()
    settings = {"version": __version__, **task.settings()}
    out = out or Path("results") / task.folder
    others = curves_beside(beside, out, task)
    make_folder(out)
    _require_free(out, settings, resume, overwrite)
    console = make_console()
    with args.workers_of(spec.jobs, spec.backend, spec.address) as workers:
        training = dataclasses.replace(task.training(console), command=("parkenv", *sys.argv[1:]))
        _claim(out, settings, overwrite)
        spec.write(out / SPEC_FILE)
        numbers = range(spec.seed, spec.seed + spec.seeds)
        curves = _train_all(console, task, training, numbers, out, workers, spec.tensorboard)
        models = {n: out / f"seed_{n}" / MODEL for n in numbers}
        outcome = task.report(console, workers, curves, models, out, others)
    command = ["parkenv", *sys.argv[1:]]
    write_summary(
        out, {"command": command, "version": __version__, "seed": spec.seed, "settings": settings, **outcome}
    )
    console.print(f"Models, curves, summary and figure are in {out}")
    if report:
        from parkenv.cli.report import make_report

        make_report(out, jobs=spec.jobs, trust=True)


def _require_free(out: Path, settings: Row, resume: bool, overwrite: bool) -> None:
    """Check that the folder holds no training, or one to resume or replace."""
    from parkenv.evaluation.experiments.results import read_settings, require_same_settings

    if resume and overwrite:
        raise InputError("--resume and --overwrite exclude each other")
    if resume:
        require_same_settings(out, settings, "training")
    elif not overwrite and read_settings(out) is not None:
        raise InputError(
            f"--out {out}: holds a training; add --resume to go on with it, --overwrite to replace it, or name "
            "another folder"
        )


def _claim(out: Path, settings: Row, overwrite: bool) -> None:
    """Write the settings of the new training, and remove the results of the previous one."""
    import shutil

    from parkenv.evaluation.experiments.results import SUMMARY, write_settings

    # Delete the summary: a folder without one holds an unfinished training.
    for outcome in (SUMMARY, PAGE, FIGURE):
        (out / outcome).unlink(missing_ok=True)
    if overwrite:
        for folder in out.glob("seed_*"):
            shutil.rmtree(folder)
    write_settings(out, settings)


def _train_all(
    console: Console,
    task: TrainingTask,
    training: Training,
    seeds: range,
    out: Path,
    workers: Workers,
    tensorboard: bool,
) -> list[list[Row]]:
    """Train all seeds, with one progress bar each, updated from the curves that the trainings write."""
    from functools import partial

    from parkenv.evaluation.training.rl_training import CURVE, read_curve, train_one

    progress = Progress(
        TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[score]}"), TimeElapsedColumn(),
        TimeRemainingColumn(), console=console, disable=not console.is_terminal,
    )  # fmt: skip
    bars = {k: progress.add_task(f"seed {k}", total=training.steps, score="") for k in seeds}
    over = threading.Event()

    def update_bars() -> None:
        while not over.is_set():
            for k, bar in bars.items():
                if curve := read_curve(out / f"seed_{k}" / CURVE):
                    last = curve[-1]
                    progress.update(bar, completed=last["steps"], score=task.score_text(last))
            over.wait(2.0)

    watcher = threading.Thread(target=update_bars, daemon=True)
    with progress:
        watcher.start()
        try:
            tasks = [partial(train_one, training, k, out / f"seed_{k}", tensorboard) for k in seeds]
            curves: dict[int, list[Row]] = {}
            for i, trained in workers.results(tasks):
                trained.save(out / f"seed_{seeds[i]}")
                curves[i] = trained.curve
        except KeyboardInterrupt:
            console.print(f"Interrupted. Checkpoints are in {out}; the same command with --resume goes on.")
            raise typer.Exit(130) from None
        finally:
            over.set()
            watcher.join()
    return [curves[i] for i in range(len(seeds))]
