"""What `parkenv train` trains: a course, and what the command tells of it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from parkenv.cli.tables import make_table
from parkenv.errors import InputError

if TYPE_CHECKING:
    from parkenv.evaluation.experiments.spec import TrainingSpec
    from parkenv.evaluation.experiments.workers import Workers
    from parkenv.evaluation.training.rl_training import Training
    from parkenv.scenarios.spec import ScenarioSpec

EXAMINED_FROM, TESTED_FROM = 2_000_000, 3_000_000
"""First seeds of the worlds of evaluations, and of the test at the end."""

FIGURE = "learning_curve.png"

Row = dict[str, Any]


@dataclass(eq=False)
class Course(ABC):
    """What is trained, and what the command prints and draws.

    Args:
        spec: what was asked for; what it leaves open is decided here.
    """

    spec: TrainingSpec

    @property
    @abstractmethod
    def algorithm(self) -> str:
        """By name."""

    @property
    @abstractmethod
    def folder(self) -> str:
        """Where results go by default."""

    @abstractmethod
    def config(self) -> Any:
        """The algorithm's, or an `InputError`."""

    def check(self) -> None:
        """Refuse now what could not be trained, tested or drawn later.

        Raises:
            InputError: an option that cannot be used, or a package that is not there.
        """
        from planners.learned import algorithm_class

        self.config()
        algorithm_class(self.algorithm)

    @abstractmethod
    def settings(self) -> Row:
        """What a training that is gone on with must have in common with this one."""

    @abstractmethod
    def evaluation_settings(self, settings: Row) -> Row:
        """What the evaluations of a training depend on: curves can be compared where it is equal."""

    @property
    @abstractmethod
    def measures(self) -> tuple[str, ...]:
        """Columns of `curve.csv` that are drawn."""

    @abstractmethod
    def training(self, console: Console) -> Training:
        """Made when it is sure that there will be one."""

    @abstractmethod
    def score_text(self, row: Row) -> str:
        """An evaluation in a few words."""

    @abstractmethod
    def report(
        self,
        console: Console,
        workers: Workers,
        curves: list[list[Row]],
        models: dict[int, Path],
        out: Path,
        beside: dict[str, list[list[Row]]],
    ) -> Row:
        """Test the models, draw the figure, print the table; what goes into the summary."""


def scenario_settings(scenarios: Sequence[ScenarioSpec]) -> Row:
    """What training depends on of its scenarios, as settings hold it."""
    from parkenv.evaluation.experiments.experiment import fingerprints, flat_tables

    return {
        "scenarios": {s.title: flat_tables(s.model_dump(mode="json")) for s in scenarios},
        "files": fingerprints([file for s in scenarios for file in s.files()]),
    }


def name_of(settings: Row) -> str:
    """What a training is called beside others."""
    name, imitated, scenarios = (
        str(settings["algorithm"]),
        settings.get("clone"),
        settings.get("scenario", ()),
    )
    if len(scenarios) > 1:
        name += f" on {', '.join(scenarios)}"
    return f"{name} after cloning {imitated}" if imitated else name


def curves_beside(folders: Sequence[str], out: Path, course: Course) -> dict[str, list[list[Row]]]:
    """Curves of other trainings, by name, of each seed the rows of its `curve.csv`.

    Args:
        folders: that `parkenv train` wrote to; `--beside`.
        out: the folder of the training that they are to be drawn beside.
        course: of that training.

    Raises:
        InputError: a folder without a training, or one with other evaluations; the same one twice; or too
            many to tell apart.
    """
    from parkenv.evaluation.experiments.results import read_settings
    from parkenv.evaluation.figures.learning_curves import COLORS
    from parkenv.evaluation.training.rl_training import CURVE, read_curve

    if len(folders) >= len(COLORS):
        raise InputError(f"--beside names {len(folders)} folders, want at most {len(COLORS) - 1}")
    own, known = course.settings(), {out.resolve()}
    beside: dict[str, list[list[Row]]] = {}
    for folder in map(Path, folders):
        if folder.resolve() in known:
            raise InputError(f"--beside: {folder} is drawn already")
        known.add(folder.resolve())
        settings = read_settings(folder)
        curves = [read_curve(its) for its in sorted(folder.glob(f"seed_*/{CURVE}"))]
        curves = [curve for curve in curves if curve]
        if settings is None or not curves:
            raise InputError(f"--beside: {folder} holds no training")
        theirs = course.evaluation_settings(settings)
        for name, value in course.evaluation_settings(own).items():
            if theirs[name] != value:
                raise InputError(
                    f"--beside: {name} is {theirs[name]!r} in {folder} and {value!r} here; their evaluations cannot "
                    "be compared"
                )
        if not {"steps", *course.measures} <= {*curves[0][0]} or "algorithm" not in settings:
            raise InputError(f"--beside: {folder} was not written by this version of parkenv")
        name = name_of(settings)
        if name == name_of(own) or name in beside:
            name = f"{name} ({folder})"
        beside[name] = curves
    return beside


def row_of(agent: str, scenario: str, number: int, curve: list[Row], own: Row, model: Path) -> Row:
    """A row of the summary for one training."""
    last = curve[-1]
    return {
        "agent": agent, "scenario": scenario, "seed": number, "steps": last["steps"], **own,
        "steps_per_s": last["steps"] / max(last["wall_s"], 1e-9), "model": str(model),
    }  # fmt: skip


def print_tests(
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
