"""`parkenv train`: agents that learn, examined beside the planners."""

from __future__ import annotations

import sys
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from parkenv import __version__
from parkenv.cli import arguments as args
from parkenv.cli.drive_course import DriveCourse
from parkenv.cli.report import PAGE
from parkenv.cli.search_course import SearchCourse
from parkenv.cli.tables import make_console
from parkenv.cli.training_course import FIGURE, Course, Row, curves_beside
from parkenv.errors import InputError

if TYPE_CHECKING:
    from parkenv.evaluation.experiments.workers import Workers
    from parkenv.evaluation.training.rl_training import Training

PLANNERS = "belief,mdp-tuned,mdp,first-free,greedy-drive,greedy-goal"
ENVS = ("search", "drive")


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
    scenario: Annotated[
        str | None,
        typer.Option(
            "--scenario",
            metavar="NAME[,NAME...]",
            help="Where to learn to search; several take turns, and examinations are on the first.  [default: campus]",
            rich_help_panel=args.WORLD,
        ),
    ] = None,
    lot: Annotated[
        str | None,
        typer.Option(
            "--lot",
            metavar="NAME|FILE[,...]",
            help="Where to learn to drive into slots.  [default: campus,street, which have all kinds of slots]",
            rich_help_panel=args.WORLD,
        ),
    ] = None,
    test_on: Annotated[
        str | None,
        typer.Option(
            "--test-on",
            metavar="NAME[,NAME...]",
            help="Where to test in the end.  [default: where they learn]",
            rich_help_panel=args.WORLD,
        ),
    ] = None,
    steps: Annotated[
        int | None,
        typer.Option(
            "--steps",
            min=1,
            help="Decisions to make in training.  [default: 2000000 to search; to drive, what the recipe says]",
        ),
    ] = None,
    seeds: Annotated[
        int, typer.Option("--seeds", min=1, help="Trainings, one for each seed from --seed on.")
    ] = 5,
    imitate: Annotated[
        str | None,
        typer.Option(
            "--imitate",
            metavar="PLANNER",
            help="Begin by imitating this planner (search; ppo, maskable-ppo).",
        ),
    ] = None,
    shown: Annotated[
        int | None,
        typer.Option("--shown", min=1, help="Searches of the planner to imitate.  [default: 2000]"),
    ] = None,
    k: Annotated[
        int | None,
        typer.Option("--k", min=1, help="Slots that an observation tells of (search).  [default: 5]"),
    ] = None,
    examine_every: Annotated[
        int | None,
        typer.Option(
            "--examine-every",
            min=1,
            help="Decisions between examinations.  [default: 100000 to search; to drive, a twentieth of --steps]",
        ),
    ] = None,
    examined_on: Annotated[
        int | None,
        typer.Option(
            "--examined-on",
            min=2,
            help="Searches an examination, or drives into each lot's slots of each kind, none of them trained on.  "
            "[default: 256; 64]",
        ),
    ] = None,
    planners: Annotated[
        str | None,
        typer.Option(
            "--planners",
            metavar="NAME[,NAME...]|none",
            help=f"Who is drawn for comparison.  [default: {PLANNERS}; planner]",
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
            help="Folders of other trainings with the same examinations, to draw in the same figure.",
        ),
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the checkpoints in --out.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the training in --out.")] = False,
    report: Annotated[
        bool, typer.Option("--report", help="Also write report.html, as `parkenv report` does.")
    ] = False,
) -> None:
    """Train agents by reinforcement learning, several seeds, and draw their learning curves beside the planners.

    They learn to search, with minus the seconds as rewards, and observe what is near the car, so that they run on any
    lot. Or they learn to drive into slots, from goals of hindsight (sac, tqc) or the dense reward (ppo), beginning a
    step before the slot. They are examined as they learn, in worlds that are not trained on; each seed's best model is
    kept, and tested in the end in worlds of no examination. Settings are in parkenv/evaluation/training/configs.py.

    Examples:
    * `parkenv train maskable-ppo --scenario campus`

    * `parkenv train ppo --imitate mdp-tuned --test-on campus,street,jam --out results/cloned`

    * `parkenv train ppo --beside results/maskable-ppo,results/dqn`

    * `parkenv train sac --env drive --lot campus,street --seeds 3`

    * `parkenv compare --agents mdp,maskable-ppo:results/maskable-ppo/seed_0/model.zip`
    """  # fmt: skip
    from parkenv.evaluation.experiments.results import make_folder, write_summary

    if env not in ENVS:
        raise InputError(f"--env is {env!r}, want one of {', '.join(ENVS)}")
    course: Course
    if env == "search":
        _refuse("drive", {"--lot": lot})
        if shown is not None and imitate is None:
            raise InputError("--shown goes with --imitate")
        course = SearchCourse(
            algorithm or "maskable-ppo", scenario or "campus", test_on, steps or 2_000_000, imitate, shown or 2000,
            k or 5, examine_every or 100_000, examined_on or 256, planners or PLANNERS,
        )  # fmt: skip
    else:
        _refuse("search", {"--scenario": scenario, "--imitate": imitate, "--shown": shown, "--k": k})
        course = DriveCourse(
            algorithm or "ppo", lot or "campus,street", test_on, steps, examine_every, examined_on or 64,
            planners or "planner",
        )  # fmt: skip
    course.check()
    from parkenv.evaluation.training.rl_training import MODEL

    settings = {"version": __version__, **course.settings()}
    out = out or Path("results") / course.folder
    others = curves_beside(args.words("--beside", beside) if beside else (), out, course)
    make_folder(out)
    _require_free(out, settings, resume, overwrite)
    console = make_console()
    with args.workers_of(jobs, backend, address) as workers:
        training = course.training(console)
        _claim(out, settings, overwrite)
        numbers = range(seed, seed + seeds)
        curves = _train_all(console, course, training, numbers, out, workers, tensorboard)
        models = {n: out / f"seed_{n}" / MODEL for n in numbers}
        outcome = course.report(console, workers, curves, models, out, others)
    command = ["parkenv", *sys.argv[1:]]
    write_summary(
        out, {"command": command, "version": __version__, "seed": seed, "settings": settings, **outcome}
    )
    console.print(f"Models, curves, summary and figure are in {out}")
    if report:
        from parkenv.cli.report import make_report

        make_report(out, jobs=jobs)


def _refuse(env: str, options: Row) -> None:
    for name, value in options.items():
        if value is not None:
            raise InputError(f"{name} goes with --env {env}")


def _require_free(out: Path, settings: Row, resume: bool, overwrite: bool) -> None:
    """Make sure that what is in the folder may be used, or replaced."""
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
    """Write down what is trained in the folder from now on, in place of what was."""
    import shutil

    from parkenv.evaluation.experiments.results import SUMMARY, write_settings

    # Whoever finds no summary knows that the training is not finished.
    for outcome in (SUMMARY, PAGE, FIGURE):
        (out / outcome).unlink(missing_ok=True)
    if overwrite:
        for folder in out.glob("seed_*"):
            shutil.rmtree(folder)
    write_settings(out, settings)


def _train_all(
    console: Console,
    course: Course,
    training: Training,
    seeds: range,
    out: Path,
    workers: Workers,
    tensorboard: bool,
) -> list[list[Row]]:
    """Train all seeds; a bar each, fed by the curves that the trainings write."""
    from functools import partial

    from parkenv.evaluation.training.rl_training import CURVE, read_curve, train_one

    progress = Progress(
        TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[told]}"), TimeElapsedColumn(),
        TimeRemainingColumn(), console=console, disable=not console.is_terminal,
    )  # fmt: skip
    bars = {k: progress.add_task(f"seed {k}", total=training.steps, told="") for k in seeds}
    over = threading.Event()

    def look() -> None:
        while not over.is_set():
            for k, bar in bars.items():
                if curve := read_curve(out / f"seed_{k}" / CURVE):
                    last = curve[-1]
                    progress.update(bar, completed=last["steps"], told=course.told(last))
            over.wait(2.0)

    watcher = threading.Thread(target=look, daemon=True)
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
