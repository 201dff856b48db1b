"""The tasks of `parkenv train`: defaults, checks, settings and reports."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from parkenv.cli.tables import make_table
from parkenv.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console

    from parkenv.evaluation.experiments.spec import TrainingSpec
    from parkenv.evaluation.experiments.workers import Workers
    from parkenv.evaluation.training.rl_training import Training
    from parkenv.scenarios.spec import ScenarioSpec

EVALUATION_SEED, TEST_SEED = 2_000_000, 3_000_000
"""First world seeds of the evaluations during training, and of the final test."""

FIGURE = "learning_curve.png"

Row = dict[str, Any]


@dataclass(eq=False)
class TrainingTask(ABC):
    """A kind of training: its defaults, checks and report.

    Args:
        spec: specification of the training; the task supplies missing values.
    """

    spec: TrainingSpec

    @property
    @abstractmethod
    def algorithm(self) -> str:
        """Name of the algorithm."""

    @property
    @abstractmethod
    def folder(self) -> str:
        """Default name of the output folder."""

    @abstractmethod
    def config(self) -> Any:
        """Training config of the algorithm.

        Raises:
            InputError: the algorithm has none for this task.
        """

    def check(self) -> None:
        """Check, before training, that everything can be trained, tested and drawn.

        Raises:
            InputError: an invalid option, or a missing package.
        """
        from planners.model_file import algorithm_class

        self.config()
        algorithm_class(self.algorithm)

    @abstractmethod
    def settings(self) -> Row:
        """Return the settings that a resumed training must share with this one."""

    @abstractmethod
    def evaluation_settings(self, settings: Row) -> Row:
        """Return the settings that evaluations depend on: curves are comparable if these are equal."""

    @property
    @abstractmethod
    def measures(self) -> tuple[str, ...]:
        """Columns of `curve.csv` to draw."""

    @abstractmethod
    def training(self, console: Console) -> Training:
        """Make the training, with demonstrations if needed."""

    @abstractmethod
    def score_text(self, row: Row) -> str:
        """Return the score of an evaluation as text for the progress bar."""

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
        """Test the models, draw the figure and print the table; return the entries of the summary."""


def scenario_settings(scenarios: Sequence[ScenarioSpec]) -> Row:
    """Return the settings that training depends on: scenarios and fingerprints of their files."""
    from parkenv.evaluation.experiments.experiment import fingerprints, flat_tables

    return {
        "scenarios": {s.title: flat_tables(s.model_dump(mode="json")) for s in scenarios},
        "files": fingerprints([file for s in scenarios for file in s.files()]),
    }


def name_of(settings: Row) -> str:
    """Return the name of a training in a figure with others."""
    name, cloned, scenarios = (
        str(settings["algorithm"]),
        settings.get("clone"),
        settings.get("scenario", ()),
    )
    if len(scenarios) > 1:
        name += f" on {', '.join(scenarios)}"
    return f"{name} after cloning {cloned}" if cloned else name


def curves_beside(folders: Sequence[str], out: Path, task: TrainingTask) -> dict[str, list[list[Row]]]:
    """Read the curves of other trainings: the rows of `curve.csv` of each seed, by name.

    Args:
        folders: output folders of `parkenv train` (`--beside`).
        out: folder of the training to draw them with.
        task: task of that training.

    Raises:
        InputError: a folder has no training, or one with other evaluations; a folder is given twice; or there are too
            many to tell apart.
    """
    from parkenv.evaluation.experiments.results import read_settings
    from parkenv.evaluation.figures.learning_curves import COLORS
    from parkenv.evaluation.training.rl_training import CURVE, read_curve

    if len(folders) >= len(COLORS):
        raise InputError(f"--beside names {len(folders)} folders, want at most {len(COLORS) - 1}")
    own, known = task.settings(), {out.resolve()}
    beside: dict[str, list[list[Row]]] = {}
    for folder in map(Path, folders):
        if folder.resolve() in known:
            raise InputError(f"--beside: {folder} is already drawn")
        known.add(folder.resolve())
        settings = read_settings(folder)
        curves = [read_curve(its) for its in sorted(folder.glob(f"seed_*/{CURVE}"))]
        curves = [curve for curve in curves if curve]
        if settings is None or not curves:
            raise InputError(f"--beside: {folder} holds no training")
        theirs = task.evaluation_settings(settings)
        for name, value in task.evaluation_settings(own).items():
            if theirs[name] != value:
                raise InputError(
                    f"--beside: {name} is {theirs[name]!r} in {folder} and {value!r} here; their evaluations cannot "
                    "be compared"
                )
        if not {"steps", *task.measures} <= {*curves[0][0]} or "algorithm" not in settings:
            raise InputError(f"--beside: {folder} was not written by this version of parkenv")
        name = name_of(settings)
        if name == name_of(own) or name in beside:
            name = f"{name} ({folder})"
        beside[name] = curves
    return beside


def row_of(agent: str, scenario: str, number: int, curve: list[Row], own: Row, model: Path) -> Row:
    """Return the summary row of one seed."""
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
    text_of: Callable[[Row], str],
    *further: str,
) -> None:
    """Print a table with a column per scenario and further key, and a row per model and planner."""
    columns = list(
        dict.fromkeys((row["test_scenario"], *(row[name] for name in further)) for row in transfer)
    )
    table = make_table(title, ["", *(" ".join(column) for column in columns)])
    agents = {f"{algorithm}, seed {n}": n for n in dict.fromkeys(row["seed"] for row in transfer)}
    for agent, number in agents.items():
        its = {(r["test_scenario"], *(r[f] for f in further)): r for r in transfer if r["seed"] == number}
        table.add_row(agent, *(text_of(its[column]) for column in columns))
    for agent in dict.fromkeys(row["agent"] for row in planners):
        its = {(r["scenario"], *(r[f] for f in further)): r for r in planners if r["agent"] == agent}
        table.add_row(agent, *(text_of(its[column]) for column in columns))
    console.print(table)
