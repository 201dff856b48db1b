"""`parkenv train`: agents that learn, examined beside the planners."""

from __future__ import annotations

import json
import sys
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
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
    from parkenv.evaluation.drive_training import DriveTraining
    from parkenv.evaluation.rl_training import Training
    from parkenv.evaluation.search_training import SearchTraining
    from parkenv.evaluation.workers import Workers
    from parkenv.lot import ParkingLot
    from parkenv.scenario import Scenario

PLANNERS = "belief,mdp-tuned,mdp,first-free,greedy-drive,greedy-goal"
EXAMINED_FROM, TESTED_FROM, SHOWN_FROM = 2_000_000, 3_000_000, 5_000_000
"""First seeds of the worlds in which models are examined, tested at the end, and shown what to imitate."""
ENVS = ("search", "drive")

Row = dict[str, Any]


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
            help="What to learn: to search (parkenv/Search-v0), or to drive into slots (parkenv/Drive-v0).",
            rich_help_panel=args.WORLD,
        ),
    ] = "search",
    scenario: Annotated[
        str | None,
        typer.Option(
            "--scenario",
            metavar="NAME[,NAME...]",
            help="Where to learn to search; several take turns.  [default: campus]",
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
    shown: Annotated[int, typer.Option("--shown", min=1, help="Searches of the planner to imitate.")] = 2000,
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
    kept, and tested in the end in worlds of no examination. Settings are in parkenv/evaluation/recipes.py.

    Examples:
    * `parkenv train maskable-ppo --scenario campus`

    * `parkenv train ppo --imitate mdp-tuned --test-on campus,street,jam --out results/cloned`

    * `parkenv train sac --env drive --lot campus,street --seeds 3`

    * `parkenv compare --agents mdp,maskable-ppo:results/maskable-ppo/seed_0/model.zip`
    """  # fmt: skip
    from parkenv.evaluation.results import make_folder, write_summary
    from planners.learned import algorithm_class

    if env not in ENVS:
        raise InputError(f"--env is {env!r}, want one of {', '.join(ENVS)}")
    course: _Course
    if env == "search":
        _refuse("drive", {"--lot": lot})
        course = _SearchCourse(
            algorithm or "maskable-ppo", scenario or "campus", test_on, steps or 2_000_000, imitate, shown, k or 5,
            examine_every or 100_000, examined_on or 256, planners or PLANNERS,
        )  # fmt: skip
    else:
        _refuse("search", {"--scenario": scenario, "--imitate": imitate, "--k": k})
        course = _DriveCourse(
            algorithm or "ppo", lot or "campus,street", test_on, steps, examine_every, examined_on or 64,
            planners or "planner",
        )  # fmt: skip
    course.recipe()
    algorithm_class(course.algorithm)
    settings = {"version": __version__, **course.settings()}
    out = out or Path("results") / course.folder
    make_folder(out)
    _claim(out, settings, resume, overwrite)
    console = make_console()
    with args.workers_of(jobs, backend, address) as workers:
        training = course.training(console)
        numbers = range(seed, seed + seeds)
        curves = _train_all(console, course, training, numbers, out, workers, tensorboard)
        outcome = course.report(
            console, workers, curves, {n: out / f"seed_{n}" / "model.zip" for n in numbers}, out
        )
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


class _Course(ABC):
    """What is trained, and what the command tells of it."""

    algorithm: str

    @property
    @abstractmethod
    def folder(self) -> str:
        """Where results go by default."""

    @abstractmethod
    def recipe(self) -> Any:
        """The algorithm's, or an `InputError`."""

    @abstractmethod
    def settings(self) -> Row:
        """What a training that is gone on with must have in common with this one."""

    @abstractmethod
    def training(self, console: Console) -> Training:
        """Made when it is sure that there will be one."""

    @abstractmethod
    def told(self, row: Row) -> str:
        """An examination in a word."""

    @abstractmethod
    def report(
        self, console: Console, workers: Workers, curves: list[list[Row]], models: dict[int, Path], out: Path
    ) -> Row:
        """Test the models, draw the figure, print the table; what goes into the summary."""


@dataclass(eq=False)
class _SearchCourse(_Course):
    algorithm: str
    scenario: str
    test_on: str | None
    steps: int
    imitate: str | None
    shown: int
    k: int
    examine_every: int
    examined_on: int
    planners: str

    @property
    def folder(self) -> str:
        return self.algorithm

    def recipe(self) -> Any:
        from parkenv.evaluation.recipes import RECIPES, recipe_of

        return recipe_of(self.algorithm, RECIPES, "search")

    @cached_property
    def worlds(self) -> list[Scenario]:
        from parkenv.scenario import Scenario

        return [Scenario.named(name) for name in args.words("--scenario", self.scenario)]

    @cached_property
    def tested(self) -> list[Scenario]:
        from parkenv.scenario import Scenario

        return [Scenario.named(name) for name in args.words("--test-on", self.test_on or self.scenario)]

    @property
    def examined(self) -> range:
        return range(EXAMINED_FROM, EXAMINED_FROM + self.examined_on)

    def settings(self) -> Row:
        _ = self.tested
        return {
            "algorithm": self.algorithm, "scenario": [w.name for w in self.worlds], "steps": self.steps,
            "imitate": self.imitate, "shown": self.shown if self.imitate else None, "k": self.k,
            "examine_every": self.examine_every, "examined_on": self.examined_on,
        }  # fmt: skip

    def training(self, console: Console) -> SearchTraining:
        from parkenv.evaluation.search_training import SearchTraining

        demonstrations = None
        if self.imitate is not None:
            from parkenv.evaluation.cloning import Demonstrations

            with console.status(f"Watching {self.imitate} search {self.shown} times"):
                demonstrations = Demonstrations.collect(
                    self.imitate, self.worlds[0], range(SHOWN_FROM, SHOWN_FROM + self.shown), self.k
                )
        return SearchTraining(
            self.algorithm, self.steps, self.examine_every, tuple(self.worlds), self.examined, self.k, demonstrations
        )  # fmt: skip

    def told(self, row: Row) -> str:
        return f"{row['total_s']:.1f} s"

    def report(
        self, console: Console, workers: Workers, curves: list[list[Row]], models: dict[int, Path], out: Path
    ) -> Row:
        from parkenv.evaluation.learning_curves import across_seeds, save_learning_curves
        from parkenv.evaluation.search_training import search_times
        from planners.learned import LearnedAgent

        names = [] if self.planners == "none" else args.words("--planners", self.planners)
        at_test = range(TESTED_FROM, TESTED_FROM + 2 * self.examined_on)
        lines, tables = _planner_times(
            console, workers, names, self.worlds[0], self.tested, self.examined, at_test
        )
        rows, transfer = [], []
        with console.status("Testing"):
            for (number, model), curve in zip(models.items(), curves, strict=True):
                for world in self.tested:
                    row = search_times(LearnedAgent(world, self.algorithm, model), world, at_test)
                    transfer.append(
                        {"agent": self.algorithm, "seed": number, "test_scenario": world.name, **row}
                    )
                tested = transfer[-len(self.tested)]
                own = {c: tested[c] for c in ("total_s", "total_s_ci95")}
                rows.append(_row_of(self.algorithm, self.worlds[0].name, number, curve, own, model))
        title = f"{self.worlds[0].name}: {self.examined_on} searches in worlds that were not trained on"
        save_learning_curves({self.algorithm: curves}, lines, title, out / "learning_curve.png")
        _print(
            console,
            "Mean total time, s, in worlds of no examination",
            self.algorithm,
            transfer,
            tables,
            _interval,
        )
        return {
            "rows": rows, "transfer": transfer, "planners": tables, "examined": lines, "curve": across_seeds(curves),
        }  # fmt: skip


@dataclass(eq=False)
class _DriveCourse(_Course):
    algorithm: str
    lot: str
    test_on: str | None
    asked_steps: int | None
    asked_every: int | None
    examined_on: int
    planners: str

    @property
    def folder(self) -> str:
        return f"drive-{self.algorithm}"

    def recipe(self) -> Any:
        from parkenv.evaluation.recipes import DRIVE_RECIPES, recipe_of

        return recipe_of(self.algorithm, DRIVE_RECIPES, "drive")

    @property
    def steps(self) -> int:
        return self.asked_steps or int(self.recipe().steps)

    @property
    def examine_every(self) -> int:
        return self.asked_every or max(1, self.steps // 20)

    @cached_property
    def lots(self) -> list[ParkingLot]:
        from parkenv.envs.drive import lot_named

        return [lot_named(name) for name in args.words("--lot", self.lot)]

    @cached_property
    def tested(self) -> list[ParkingLot]:
        from parkenv.envs.drive import lot_named

        return [lot_named(name) for name in args.words("--test-on", self.test_on or self.lot)]

    def settings(self) -> Row:
        from parkenv.evaluation.drive_practice import places_of
        from planners.drivers import PLANNER

        places_of(self.tested)  # complains before anything is trained
        if self.planners not in (PLANNER, "none"):
            raise InputError(f"--planners is {self.planners!r}, want {PLANNER} or none with --env drive")
        return {
            "algorithm": self.algorithm, "env": "drive", "lot": [lot.name for lot in self.lots], "steps": self.steps,
            "examine_every": self.examine_every, "examined_on": self.examined_on,
        }  # fmt: skip

    def training(self, console: Console) -> DriveTraining:
        del console
        from parkenv.evaluation.drive_training import DriveTraining

        examined = range(EXAMINED_FROM, EXAMINED_FROM + self.examined_on)
        return DriveTraining(self.algorithm, self.steps, self.examine_every, tuple(self.lots), examined)

    def told(self, row: Row) -> str:
        return f"{row['success']:.0%} parked"

    def report(
        self, console: Console, workers: Workers, curves: list[list[Row]], models: dict[int, Path], out: Path
    ) -> Row:
        from parkenv.evaluation.drive_training import parked_on
        from parkenv.evaluation.learning_curves import across_seeds, save_success_curves
        from parkenv.evaluation.parking_runs import parking_table
        from planners.drivers import PLANNER

        examined = range(EXAMINED_FROM, EXAMINED_FROM + self.examined_on)
        at_test = range(TESTED_FROM, TESTED_FROM + 2 * self.examined_on)
        names = " and ".join(lot.name for lot in self.lots)
        lines: dict[str, float] = {}
        tables: list[Row] = []
        if self.planners != "none":
            with console.status("The planner parks in the same tasks"):
                parkings = parked_on(self.lots, examined, workers, PLANNER)
                lines = {row["kind"]: row["success"] for row in parking_table(parkings)}
                for lot in self.tested:
                    table = parking_table(parked_on([lot], at_test, workers, PLANNER))
                    tables += [{"agent": PLANNER, "scenario": lot.name, **row} for row in table]
        rows, transfer = [], []
        with console.status("Testing"):
            for (number, model), curve in zip(models.items(), curves, strict=True):
                parkings = []
                for lot in self.tested:
                    some = parked_on([lot], at_test, workers, f"{self.algorithm}:{model}")
                    parkings += some
                    transfer += [
                        {"agent": self.algorithm, "seed": number, "test_scenario": lot.name, **row}
                        for row in parking_table(some)
                    ]
                tested = parking_table(parkings)[-1]
                own = {c: tested[c] for c in ("success", "success_ci95", "contacts", "time_s")}
                rows.append(
                    _row_of(
                        self.algorithm, ",".join(lot.name for lot in self.tested), number, curve, own, model
                    )
                )
        kinds = [name.removesuffix("_success") for name in curves[0][0] if name.endswith("_success")]
        title = f"{names}: {self.examined_on} parkings of each kind that were not trained on"
        save_success_curves({self.algorithm: curves}, kinds, lines, title, out / "learning_curve.png")
        heading = "Parkings that succeed, contacts, median s of those, in tasks of no examination"
        _print(console, heading, self.algorithm, transfer, tables, _parkings, "kind")
        return {
            "rows": rows, "transfer": transfer, "planners": tables, "examined": lines,
            "curve": {kind: across_seeds(curves, f"{kind}_success") for kind in kinds},
        }  # fmt: skip


def _row_of(agent: str, scenario: str, number: int, curve: list[Row], own: Row, model: Path) -> Row:
    """A row of the summary for one training."""
    last = curve[-1]
    return {
        "agent": agent, "scenario": scenario, "seed": number, "steps": last["steps"], **own,
        "steps_per_s": last["steps"] / max(last["wall_s"], 1e-9), "model": str(model),
    }  # fmt: skip


def _claim(out: Path, settings: Row, resume: bool, overwrite: bool) -> None:
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
) -> tuple[dict[str, float], list[Row]]:
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
    console: Console,
    course: _Course,
    training: Training,
    seeds: range,
    out: Path,
    workers: Workers,
    tensorboard: bool,
) -> list[list[Row]]:
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
                    progress.update(bar, completed=last["steps"], told=course.told(last))
            over.wait(2.0)

    watcher = threading.Thread(target=look, daemon=True)
    with progress:
        watcher.start()
        try:
            tasks = [partial(train_one, training, k, out / f"seed_{k}", tensorboard) for k in seeds]
            curves: dict[int, list[Row]] = {}
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
    console: Console,
    title: str,
    algorithm: str,
    transfer: list[Row],
    planners: list[Row],
    told: Callable[[Row], str],
    *further: str,
) -> None:
    """A column for each world, and for what else tells rows apart; a line for each model and planner."""
    columns = list(
        dict.fromkeys((row["test_scenario"], *(row[name] for name in further)) for row in transfer)
    )
    table = make_table(title, ["", *(" ".join(column) for column in columns)])
    agents = {f"{algorithm}, seed {n}": n for n in dict.fromkeys(row["seed"] for row in transfer)}
    for agent, number in agents.items():
        its = {(r["test_scenario"], *(r[f] for f in further)): r for r in transfer if r["seed"] == number}
        table.add_row(agent, *(told(its[column]) for column in columns))
    for agent in dict.fromkeys(row["agent"] for row in planners):
        its = {(r["scenario"], *(r[f] for f in further)): r for r in planners if r["agent"] == agent}
        table.add_row(agent, *(told(its[column]) for column in columns))
    console.print(table)


def _interval(row: Row) -> str:
    low, high = row["total_s_ci95"]
    return f"{row['total_s']:.1f} [{low:.1f}, {high:.1f}]"


def _parkings(row: Row) -> str:
    low, high = row["success_ci95"]
    return f"{row['success']:.1%} [{low:.1%}, {high:.1%}], {row['contacts']}, {row['time_s']:.1f}"
