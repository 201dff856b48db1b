"""What the kinds of training differ in: defaults, checks, settings and reports."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

from parkenv.errors import InputError
from parkenv.files.spec_file import Several, Spec
from parkenv.scenarios.spec import ScenarioSpec
from parkenv.show.figures.learning_curves import COLORS
from parkenv.studies.fingerprints import fingerprints, flat_tables
from parkenv.studies.results import SETTINGS, read_settings
from parkenv.studies.training.curve_file import CURVE, read_curve
from parkenv.studies.training.rl_training import AnyTraining
from parkenv.studies.training.spec import TrainingSpec
from parkenv.studies.workers import Workers

EVALUATION_SEED, TEST_SEED = 2_000_000, 3_000_000
"""First world seeds of the evaluations during training, and of the final test."""

FIGURE = "learning_curve.png"

Row = dict[str, Any]
Status = Callable[[str], AbstractContextManager[Any]]
"""Shows what is going on during a block."""
Table = tuple[str, list[str], list[list[str]]]
"""Title, headings and rows."""


class Trained(NamedTuple):
    """Trainings that have ended.

    Attributes:
        curves: rows of `curve.csv`, by training.
        models: model files by seed.
        beside: curves of other trainings, by name.
    """

    curves: list[list[Row]]
    models: dict[int, Path]
    beside: dict[str, list[list[Row]]]


class TrainingTask(ABC):
    """A kind of training: its defaults, checks and report.

    Args:
        spec: specification of the training.
    """

    prefix: ClassVar[str] = ""
    """Of the default name of the output folder."""

    def __init__(self, spec: TrainingSpec) -> None:
        self.spec = spec
        self.algorithm = spec.algorithm
        self.scenarios = spec.scenarios or ()
        self.evaluation_episodes = spec.evaluation_episodes
        self.evaluation_seeds = range(EVALUATION_SEED, EVALUATION_SEED + self.evaluation_episodes)
        self.test_seeds = range(TEST_SEED, TEST_SEED + 2 * self.evaluation_episodes)

    @property
    def folder(self) -> str:
        """Default name of the output folder."""
        return self.prefix + self.algorithm

    @property
    def given_scenarios(self) -> tuple[ScenarioSpec, ...]:
        """All scenarios that are trained or evaluated on."""
        return self.scenarios

    @property
    @abstractmethod
    def measures(self) -> tuple[str, ...]:
        """Columns of `curve.csv` to draw."""

    @property
    def announcement(self) -> str | None:
        """What is said before the training begins."""
        return None

    @abstractmethod
    def check(self) -> None:
        """Check, before training, that everything can be trained, tested and drawn.

        Raises:
            InputError: an invalid option, or a missing package.
        """
        from planners.model_file import algorithm_class

        algorithm_class(self.algorithm)

    @abstractmethod
    def settings(self) -> Row:
        """Return the settings that a resumed training must share with this one."""
        given = self.given_scenarios
        return {
            "algorithm": self.algorithm,
            "evaluation_episodes": self.evaluation_episodes,
            "scenarios": {s.title: flat_tables(s.model_dump(mode="json")) for s in given},
            "files": fingerprints([file for s in given for file in s.files()]),
        }

    @abstractmethod
    def evaluation_settings(self, settings: Row) -> Row:
        """Return the settings that evaluations depend on: curves are comparable if these are equal."""

    @abstractmethod
    def training(self, status: Status) -> AnyTraining:
        """Make the training, with demonstrations if needed."""

    @abstractmethod
    def score_text(self, row: Row) -> str:
        """Return the score of an evaluation as text for the progress bar."""

    @abstractmethod
    def report(self, status: Status, workers: Workers, trained: Trained, figure: Path) -> tuple[Row, Table]:
        """Test the models and draw the figure; return the entries of the summary, and a table to print."""


class _Naming(Spec, extra="ignore"):
    """The settings that a training is named after."""

    algorithm: str
    scenario: Several[str] | None = None
    clone: str | None = None
    observation: str = "local"


def name_of(settings: Row, source: str = "settings") -> str:
    """Return the name of a training in a figure with others.

    Raises:
        InputError: a setting is of another kind; the message starts with `source`.
    """
    its = _Naming.parse(settings, source)
    scenarios = its.scenario or ()
    name = f"{its.algorithm}{' on scans' if its.observation == 'scan' else ''}"
    name += f" on {', '.join(scenarios)}" if len(scenarios) > 1 else ""
    return f"{name} after cloning {its.clone}" if its.clone else name


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
    if len(folders) >= len(COLORS):
        raise InputError(f"--beside names {len(folders)} folders, want at most {len(COLORS) - 1}")
    own, known = task.settings(), {os.path.realpath(out)}
    beside: dict[str, list[list[Row]]] = {}
    for folder in map(Path, folders):
        if os.path.realpath(folder) in known:
            raise InputError(f"--beside: {folder} is already drawn")
        known.add(os.path.realpath(folder))
        settings = read_settings(folder)
        columns = ("steps", *task.measures)
        curves = [read_curve(its, columns) for its in sorted(folder.glob(f"seed_*/{CURVE}"))]
        curves = [curve for curve in curves if curve]
        if settings is None or not curves or "algorithm" not in settings:
            raise InputError(f"--beside: {folder} holds no training")
        label = name_of(settings, str(folder / SETTINGS))
        theirs = task.evaluation_settings(settings)
        for name, value in task.evaluation_settings(own).items():
            if theirs[name] != value:
                raise InputError(
                    f"--beside: {name} is {theirs[name]!r} in {folder} and {value!r} here; their evaluations cannot "
                    "be compared"
                )
        if label == name_of(own) or label in beside:
            label = f"{label} ({folder})"
        beside[label] = curves
    return beside


def row_of(agent: str, scenario: str, number: int, curve: list[Row], own: Row, model: Path) -> Row:
    """Return the summary row of one seed."""
    last = curve[-1]
    return {
        "agent": agent, "scenario": scenario, "seed": number, "steps": last["steps"], **own,
        "steps_per_s": last["steps"] / max(last["wall_s"], 1e-9), "model": str(model),
    }  # fmt: skip


def table_of_tests(
    title: str,
    algorithm: str,
    transfer: list[Row],
    planners: list[Row],
    text_of: Callable[[Row], str],
    *further: str,
) -> Table:
    """Return a table with a column per scenario and further key, and a row per model and planner."""
    columns = list(
        dict.fromkeys((row["test_scenario"], *(row[name] for name in further)) for row in transfer)
    )
    found: dict[str, dict[tuple[Any, ...], Row]] = {}
    for row in transfer:
        key = (row["test_scenario"], *(row[name] for name in further))
        found.setdefault(f"{algorithm}, seed {row['seed']}", {})[key] = row
    for row in planners:
        found.setdefault(row["agent"], {})[(row["scenario"], *(row[name] for name in further))] = row
    rows = [[agent, *(text_of(its[column]) for column in columns)] for agent, its in found.items()]
    return title, ["", *(" ".join(column) for column in columns)], rows
