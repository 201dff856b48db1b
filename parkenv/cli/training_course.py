"""What `parkenv train` trains: a course, and what the command tells of it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from parkenv.cli.tables import make_table

if TYPE_CHECKING:
    from parkenv.evaluation.rl_training import Training
    from parkenv.evaluation.workers import Workers

EXAMINED_FROM, TESTED_FROM = 2_000_000, 3_000_000
"""First seeds of the worlds in which models are examined, and tested at the end."""

Row = dict[str, Any]


class Course(ABC):
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
