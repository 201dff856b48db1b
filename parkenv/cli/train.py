"""`parkenv train`: agents that learn, examined beside the planners."""

from __future__ import annotations

import json
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from parkenv import __version__
from parkenv.cli import arguments as args
from parkenv.cli.tables import make_console, make_table
from parkenv.errors import InputError

if TYPE_CHECKING:
    from parkenv.evaluation.rl_training import Training
    from parkenv.evaluation.workers import Workers

PLANNERS = "belief,mdp-tuned,mdp,first-free,greedy-drive,greedy-goal"
EXAMINED_FROM, TESTED_FROM, SHOWN_FROM = 2_000_000, 3_000_000, 5_000_000
"""First seeds of the worlds in which models are examined, tested at the end, and shown what to imitate."""


def train(
    algorithm: Annotated[str, typer.Argument(help="dqn, ppo, maskable-ppo, recurrent-ppo.")] = "maskable-ppo",
    scenario: Annotated[
        str,
        typer.Option(
            "--scenario",
            metavar="NAME[,NAME...]",
            help="Where to learn; several take turns.",
            rich_help_panel=args.WORLD,
        ),
    ] = "campus",
    test_on: Annotated[
        str | None,
        typer.Option(
            "--test-on",
            metavar="NAME[,NAME...]",
            help="Where to test in the end.  [default: --scenario]",
            rich_help_panel=args.WORLD,
        ),
    ] = None,
    steps: Annotated[int, typer.Option("--steps", min=1, help="Decisions to make in training.")] = 2_000_000,
    seeds: Annotated[
        int, typer.Option("--seeds", min=1, help="Trainings, one for each seed from --seed on.")
    ] = 5,
    imitate: Annotated[
        str | None,
        typer.Option(
            "--imitate", metavar="PLANNER", help="Begin by imitating this planner (ppo, maskable-ppo)."
        ),
    ] = None,
    shown: Annotated[int, typer.Option("--shown", min=1, help="Searches of the planner to imitate.")] = 2000,
    k: Annotated[int, typer.Option("--k", min=1, help="Slots that an observation tells of.")] = 5,
    examine_every: Annotated[
        int, typer.Option("--examine-every", min=1, help="Decisions between examinations.")
    ] = 100_000,
    examined_on: Annotated[
        int,
        typer.Option(
            "--examined-on", min=2, help="Searches an examination, in worlds that are not trained on."
        ),
    ] = 256,
    planners: Annotated[
        str, typer.Option("--planners", metavar="NAME[,NAME...]|none", help="Who is drawn for comparison.")
    ] = PLANNERS,
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
            "--out", "-o", help="Folder for models, curves and figures.  [default: results/ALGORITHM]"
        ),
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the checkpoints in --out.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the training in --out.")] = False,
) -> None:
    """Train agents by reinforcement learning, several seeds, and draw their learning curves beside the planners.

    Models observe what is near the car, so they run on any lot. They are examined as they learn, in worlds that are
    not trained on; each seed's best model is kept, and tested in the end in worlds of no examination. Rewards are
    minus seconds. Hyper-parameters are in parkenv/evaluation/recipes.py.

    Examples:
    * `parkenv train maskable-ppo --scenario campus`

    * `parkenv train ppo --imitate mdp-tuned --test-on campus,street,jam --out results/cloned`

    * `parkenv compare --agents mdp,maskable-ppo:results/maskable-ppo/seed_0/model.zip`
    """  # fmt: skip
    from parkenv.evaluation.recipes import RECIPES
    from parkenv.evaluation.results import make_folder, write_summary
    from parkenv.scenario import Scenario
    from planners.learned import algorithm_class

    if algorithm not in RECIPES:
        raise InputError(f"ALGORITHM is {algorithm!r}, want one of {', '.join(RECIPES)}")
    algorithm_class(algorithm)
    from parkenv.evaluation.learning_curves import across_seeds, save_learning_curves
    from parkenv.evaluation.rl_training import Training, search_times

    worlds = [Scenario.named(name) for name in args.words("--scenario", scenario)]
    tested = [Scenario.named(name) for name in args.words("--test-on", test_on or scenario)]
    compared = [] if planners == "none" else args.words("--planners", planners)
    out = out or Path("results") / algorithm
    settings = {
        "version": __version__, "algorithm": algorithm, "scenario": [w.name for w in worlds], "steps": steps,
        "imitate": imitate, "shown": shown if imitate else None, "k": k, "examine_every": examine_every,
        "examined_on": examined_on,
    }  # fmt: skip
    make_folder(out)
    _claim(out, settings, resume, overwrite)
    console = make_console()
    examined = range(EXAMINED_FROM, EXAMINED_FROM + examined_on)
    at_test = range(TESTED_FROM, TESTED_FROM + 2 * examined_on)
    with args.workers_of(jobs, backend, address) as workers:
        demonstrations = None
        if imitate is not None:
            from parkenv.evaluation.cloning import Demonstrations

            with console.status(f"Watching {imitate} search {shown} times"):
                demonstrations = Demonstrations.collect(
                    imitate, worlds[0], range(SHOWN_FROM, SHOWN_FROM + shown), k
                )
        training = Training(
            algorithm, tuple(worlds), examined, steps, examine_every, k, demonstrations, tensorboard
        )
        numbers = range(seed, seed + seeds)
        curves = _train_all(console, training, numbers, out, workers)
        lines, tables = _planner_times(console, workers, compared, worlds[0], tested, examined, at_test)
    rows, transfer = [], []
    with console.status("Testing"):
        for number, curve in zip(numbers, curves, strict=True):
            model = out / f"seed_{number}" / "model.zip"
            for world in tested:
                row = search_times(algorithm, model, world, at_test)
                transfer.append({"agent": algorithm, "seed": number, "test_scenario": world.name, **row})
            rows.append(
                {
                    "agent": algorithm, "scenario": worlds[0].name, "seed": number, "steps": curve[-1]["steps"],
                    **{c: transfer[-len(tested)][c] for c in ("total_s", "total_s_ci95")},
                    "steps_per_s": curve[-1]["steps"] / max(curve[-1]["wall_s"], 1e-9), "model": str(model),
                }
            )  # fmt: skip
    write_summary(
        out,
        {
            "command": ["parkenv", *sys.argv[1:]], "version": __version__, "seed": seed, "settings": settings,
            "rows": rows, "transfer": transfer, "planners": tables, "examined": lines,
            "curve": across_seeds(curves),
        },
    )  # fmt: skip
    title = f"{worlds[0].name}: {len(examined)} searches in worlds that were not trained on"
    save_learning_curves({algorithm: curves}, lines, title, out / "learning_curve.png")
    _print(console, algorithm, transfer, tables)
    console.print(f"Models, curves, summary and figure are in {out}")


def _claim(out: Path, settings: dict[str, Any], resume: bool, overwrite: bool) -> None:
    """Make sure that what is in the folder may be used, or replaced."""
    import shutil

    from parkenv.whole_files import written_whole

    file = out / "settings.json"
    if file.exists() and not overwrite:
        if not resume:
            raise InputError(
                f"--out {out}: holds a training; add --resume to go on with it, --overwrite to replace it, or name "
                "another folder"
            )
        before = json.loads(file.read_text(encoding="utf-8"))
        for name, value in settings.items():
            if before.get(name) != value:
                raise InputError(
                    f"--resume: {name} was {before.get(name)!r} in {out}, now it is {value!r}; use the same settings, "
                    "or another folder"
                )
    elif resume:
        raise InputError(f"--resume: {out} holds no training to go on with")
    if overwrite:
        for folder in out.glob("seed_*"):
            shutil.rmtree(folder)
    with written_whole(file) as beside:
        beside.write_text(json.dumps(settings, indent=2) + "\n", encoding="utf-8")


def _planner_times(
    console: Console,
    workers: Workers,
    names: Sequence[str],
    first: Any,
    tested: Sequence[Any],
    examined: range,
    at_test: range,
) -> tuple[dict[str, float], list[dict[str, Any]]]:
    """Mean times of planners in the worlds of the examinations, and rows of those of the test."""
    from parkenv.evaluation.compare import rows_of

    if not names:
        return {}, []
    with console.status("Planners search in the same worlds"):
        rows = rows_of(names, first, examined, workers)
        tables = [row for world in tested for row in rows_of(names, world, at_test, workers)]
    lines = {row["agent"]: row["total_s"] for row in rows}
    return {**lines, "clairvoyant bound": rows[0]["bound_s"]}, tables


def _train_all(
    console: Console, training: Training, seeds: range, out: Path, workers: Workers
) -> list[list[dict[str, Any]]]:
    """Train all seeds; a bar each, fed by the curves that the trainings write."""
    from functools import partial

    from parkenv.evaluation.rl_training import CURVE, read_curve, train_one

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
                    progress.update(bar, completed=last["steps"], told=f"{last['total_s']:.1f} s")
            over.wait(2.0)

    watcher = threading.Thread(target=look, daemon=True)
    with progress:
        watcher.start()
        try:
            tasks = [partial(train_one, training, k, out / f"seed_{k}") for k in seeds]
            curves: dict[int, list[dict[str, Any]]] = {}
            for i, trained in workers.results(tasks):
                trained.keep_in(out / f"seed_{seeds[i]}")
                curves[i] = trained.curve
        except KeyboardInterrupt:
            console.print(f"Interrupted. Checkpoints are in {out}; the same command with --resume goes on.")
            raise typer.Exit(130) from None
        finally:
            over.set()
            watcher.join()
    return [curves[i] for i in range(len(seeds))]


def _print(
    console: Console, algorithm: str, transfer: list[dict[str, Any]], planners: list[dict[str, Any]]
) -> None:
    tested = list(dict.fromkeys(row["test_scenario"] for row in transfer))
    table = make_table("Mean total time, s, in worlds of no examination", ["", *tested])
    for number in dict.fromkeys(row["seed"] for row in transfer):
        its = {row["test_scenario"]: row for row in transfer if row["seed"] == number}
        table.add_row(f"{algorithm}, seed {number}", *(_interval(its[name]) for name in tested))
    for agent in dict.fromkeys(row["agent"] for row in planners):
        its = {row["scenario"]: row for row in planners if row["agent"] == agent}
        table.add_row(agent, *(_interval(its[name]) for name in tested))
    console.print(table)


def _interval(row: dict[str, Any]) -> str:
    low, high = row["total_s_ci95"]
    return f"{row['total_s']:.1f} [{low:.1f}, {high:.1f}]"
