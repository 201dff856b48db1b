"""What all kinds of training have: seeds of evaluations, checks, settings, and the report of the models."""

from __future__ import annotations

import os
import threading
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

from parkenv.errors import InputError
from parkenv.files.spec_file import Several, Spec
from parkenv.scenarios.spec import ScenarioSpec
from parkenv.show.figures.learning_curves import COLORS, save_learning_curves
from parkenv.studies.fingerprints import fingerprints, flat_tables
from parkenv.studies.report import Replay
from parkenv.studies.results import SETTINGS, read_settings
from parkenv.studies.study import Progress
from parkenv.studies.training.curve_file import CURVE, Row, across_seeds, read_curve
from parkenv.studies.workers import Workers

if TYPE_CHECKING:
    from parkenv.studies.agent_spec import AgentSpec
    from parkenv.studies.training.spec import TrainingSpec

EVALUATION_SEED, TEST_SEED = 2_000_000, 3_000_000
"""First world seeds of the evaluations during training, and of the final test."""
TRAINING_SEEDS = 10_000_000
"""World seeds of training seed s start at (s + 1) times this, far from those of evaluations and benchmark suites."""
MODEL, FIGURE = "model.safetensors", "learning_curve.png"
_OUTSIDE = {
    "kind", "jobs", "backend", "address", "trainings", "seed", "agents", "tensorboard", "scenarios", "held_out",
    "evaluate_on", "test_on", "test_among", "beside",
}  # fmt: skip
"""Fields of a specification that do not change its trainings, or that `settings` gives in other words."""


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


class Tested(NamedTuple):
    """The test of one model.

    Attributes:
        scenario: what it was tested in, for its row of the summary.
        own: columns of this row.
        transfer: a row for each test.
        places: a row for each place of tests that are in many.
    """

    scenario: str
    own: Row
    transfer: list[Row]
    places: Sequence[Row] = ()


class Training(ABC):
    """A kind of training: what is trained, how it is evaluated, and the report of its models.

    Args:
        spec: specification of the training.
    """

    evaluated_by: ClassVar[tuple[str, ...]]
    """Settings that evaluations depend on: curves are comparable if these are equal."""
    command: tuple[str, ...] = ()
    """Command line, for the model's card."""
    shared: Any = None
    """What the trainings with all seeds share; made by `begin`."""

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
        return self.algorithm if self.spec.env == "search" else f"{self.spec.env}-{self.algorithm}"

    @property
    @abstractmethod
    def steps(self) -> int:
        """Decisions of a training."""

    @property
    def given_scenarios(self) -> tuple[ScenarioSpec, ...]:
        """All scenarios that are trained or evaluated on."""
        return self.scenarios

    @property
    @abstractmethod
    def metrics(self) -> tuple[str, ...]:
        """Names of the results of an evaluation; columns of `curve.csv`."""

    @property
    def columns(self) -> tuple[str, ...]:
        """All columns of `curve.csv`."""
        return ("steps", *self.metrics, "wall_s")

    @property
    @abstractmethod
    def measures(self) -> tuple[str, ...]:
        """Columns of `curve.csv` to draw."""

    @property
    def announcement(self) -> str | None:
        """What is said before the training begins."""
        return None

    def check(self) -> None:
        """Check, before training, that everything can be trained, tested and drawn.

        Raises:
            InputError: an invalid option, or a missing package.
        """
        from planners.model_file import algorithm_class

        algorithm_class(self.algorithm)

    def settings(self) -> Row:
        """Return the settings that a resumed training must share with this one."""
        given = self.given_scenarios
        return {
            **self.spec.model_dump(mode="json", exclude=_OUTSIDE),
            "scenarios": {s.title: flat_tables(s.model_dump(mode="json")) for s in given},
            "files": fingerprints([file for s in given for file in s.files()]),
        }

    def begin(self, progress: Progress) -> None:
        """Make what the trainings with all seeds share."""
        del progress

    @contextmanager
    def watched(self, out: Path, seeds: Sequence[int], progress: Progress) -> Iterator[None]:
        """Follow the curves that trainings write into a folder, with a bar for each, during a block."""
        over = threading.Event()

        def follow() -> None:
            while not over.wait(2.0):
                for seed in seeds:
                    # The training itself reports a damaged curve.
                    with suppress(InputError):
                        if curve := read_curve(out / f"seed_{seed}" / CURVE, self.columns):
                            last = curve[-1]
                            progress(f"seed {seed}", last["steps"], self.steps)

        watcher = threading.Thread(target=follow, daemon=True)
        watcher.start()
        try:
            yield
        finally:
            over.set()
            watcher.join()

    def replays(self, summary: Row, folder: Path) -> Sequence[Replay]:
        """Return what a report may show again; nothing by default."""
        del summary, folder
        return ()

    @abstractmethod
    def train(self, seed: int, folder: Path) -> list[Row]:
        """Train with one seed; write the model and `curve.csv` to a folder.

        Args:
            seed: seed of the network and of the worlds.
            folder: output folder, created if missing.

        Returns:
            The rows of `curve.csv`.
        """

    def report(self, progress: Progress, workers: Workers, trained: Trained, figure: Path) -> Row:
        """Test the models and draw the figure; return the entries of the summary."""
        lines, planners = self.planners(progress, workers)
        rows, transfer, places = list[Row](), list[Row](), list[Row]()
        for number, (seed, model) in enumerate(trained.models.items()):
            progress("Testing", number, len(trained.models))
            of_model, last = {"agent": self.algorithm, "seed": seed}, trained.curves[number][-1]
            tested = self.test(model, workers)
            transfer += [of_model | row for row in tested.transfer]
            places += [of_model | row for row in tested.places]
            rows.append({
                "agent": self.algorithm, "scenario": tested.scenario, "seed": seed, "steps": last["steps"],
                **tested.own, "steps_per_s": last["steps"] / max(last["wall_s"], 1e-9), "model": str(model),
            })  # fmt: skip
        self.draw(trained, lines, figure)
        progress("Testing", len(rows), len(rows))
        return {
            "rows": rows, "transfer": transfer, "planners": planners, "evaluated": lines,
            **({"places": places} if places else {}),
            "curve": self.across_seeds(trained.curves),
            "beside": {name: self.across_seeds(its) for name, its in trained.beside.items()},
        }  # fmt: skip

    @property
    @abstractmethod
    def compared(self) -> tuple[AgentSpec, ...]:
        """Agents to compare with."""

    @property
    @abstractmethod
    def tests(self) -> Mapping[str, Any]:
        """The tests in the end, by name: what is run in each."""

    def planners(self, progress: Progress, workers: Workers) -> tuple[dict[str, float], list[Row]]:
        """Run the agents to compare with; return their scores in the evaluations by name, and their rows of tests."""
        lines, rows = dict[str, float](), list[Row]()
        if self.compared:
            doing, count = "Planners in the same worlds", 1 + len(self.tests)
            progress(doing, 0, count)
            lines = self.evaluate_planners(workers)
            for number, name in enumerate(self.tests, start=1):
                progress(doing, number, count)
                rows += self.test_planners(name, workers)
            progress(doing, count, count)
        return lines, rows

    @abstractmethod
    def evaluate_planners(self, workers: Workers) -> dict[str, float]:
        """Return the scores of the agents to compare with in the worlds of the evaluations, by name."""

    @abstractmethod
    def test_planners(self, name: str, workers: Workers) -> list[Row]:
        """Return the rows of a test of the agents to compare with: agent, scenario (the test's name) and results."""

    @abstractmethod
    def test(self, model: Path, workers: Workers) -> Tested:
        """Test a model."""

    @property
    @abstractmethod
    def title(self) -> str:
        """Title of the figure of learning curves."""

    def drawn(self, curves: list[list[Row]]) -> dict[str, list[list[Row]]]:
        """Return the curves to draw, by name."""
        return {self.algorithm: curves}

    def draw(self, trained: Trained, lines: Mapping[str, float], figure: Path) -> None:
        """Draw the learning curves, and scores of planners as lines."""
        curves = self.drawn(trained.curves) | trained.beside
        means = {label: self.across_seeds(its) for label, its in curves.items()}
        self.save_curves(curves, means, lines, self.title, figure)

    def save_curves(self, *drawn: Any) -> None:
        """Draw curves, their means and lines, with a title, into a file."""
        save_learning_curves(*drawn)

    def across_seeds(self, curves: list[list[Row]]) -> Any:
        """Return the mean of the curves, for the summary."""
        return across_seeds(curves)


def use_one_thread() -> None:
    """Let this process train on a single thread, so that one training per core can run in parallel."""
    import torch
    from numba import get_num_threads

    # Starting numba's threads sets the number of OpenMP's, which PyTorch has, too.
    get_num_threads()
    torch.set_num_threads(1)


def training_of(spec: TrainingSpec) -> Training:
    """Return the training of a specification."""
    module, _, name = spec.trained_by.partition(":")
    made: Training = getattr(import_module(f"parkenv.studies.training.{module}"), name)(spec)
    return made


class _Naming(Spec, extra="ignore"):
    """The settings that a training is named after."""

    algorithm: str
    scenario: Several[str] | None = None
    clone: str | None = None


def name_of(settings: Row, source: str = "settings") -> str:
    """Return the name of a training in a figure with others.

    Raises:
        InputError: a setting is of another kind; the message starts with `source`.
    """
    its = _Naming.parse(settings, source)
    scenarios = its.scenario or ()
    name = its.algorithm + (f" on {', '.join(scenarios)}" if len(scenarios) > 1 else "")
    return f"{name} after cloning {its.clone}" if its.clone else name


def curves_beside(folders: Sequence[str], out: Path, training: Training) -> dict[str, list[list[Row]]]:
    """Read the curves of other trainings: the rows of `curve.csv` of each seed, by name.

    Args:
        folders: output folders of `parkenv train` (`--beside`).
        out: folder of the training to draw them with.
        training: that training.

    Raises:
        InputError: a folder has no training, or one with other evaluations; a folder is given twice; or there are too
            many to tell apart.
    """
    if len(folders) >= len(COLORS):
        raise InputError(f"--beside names {len(folders)} folders, want at most {len(COLORS) - 1}")
    own, known = training.settings(), {os.path.realpath(out)}
    beside: dict[str, list[list[Row]]] = {}
    for folder in map(Path, folders):
        if os.path.realpath(folder) in known:
            raise InputError(f"--beside: {folder} is already drawn")
        known.add(os.path.realpath(folder))
        settings = read_settings(folder)
        columns = ("steps", *training.measures)
        curves = [read_curve(its, columns) for its in sorted(folder.glob(f"seed_*/{CURVE}"))]
        curves = [curve for curve in curves if curve]
        if settings is None or not curves or "algorithm" not in settings:
            raise InputError(f"--beside: {folder} holds no training")
        label = name_of(settings, str(folder / SETTINGS))
        for name in training.evaluated_by:
            theirs, ours = settings.get(name), own.get(name)
            if theirs != ours:
                raise InputError(
                    f"--beside: {name} is {theirs!r} in {folder} and {ours!r} here; their evaluations cannot be "
                    "compared"
                )
        if label == name_of(own) or label in beside:
            label = f"{label} ({folder})"
        beside[label] = curves
    return beside
