"""Studies: specifications that say what to run, and what to make of the rows; `parkenv.studies.runner` runs them.

A study has *cells*, such as an agent in a setting, and a cell has *items*, such as seeds or days. A new kind of study
is a subclass with fields and a few methods, and a line in `STUDIES`. Its module is imported to parse a file or an
option, so methods import what they run.
"""

from __future__ import annotations

import itertools
from abc import abstractmethod
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Self

from pydantic import Field

from parkenv.errors import InputError, nearest
from parkenv.files.known_names import BackendName
from parkenv.files.option import option
from parkenv.files.spec_file import Several, Spec, read_tables
from parkenv.scenarios.spec import ScenarioSpec
from parkenv.show.tables import part_of, tables_of
from parkenv.studies.fields import split_agents
from parkenv.studies.results import EPISODES, Key, Results, Row, Table
from parkenv.studies.workers import Task, Workers

if TYPE_CHECKING:
    from parkenv.show.report.page import Page
    from parkenv.show.tables import Column

STUDIES: Mapping[str, str] = {
    "compare": "parkenv.studies.compare.comparison:Comparison",
    "commute": "parkenv.studies.commute.study:Commute",
    "fleet": "parkenv.studies.fleet.study:FleetStudy",
    "curve": "parkenv.studies.curve.study:CurveStudy",
    "demand": "parkenv.studies.fleet.demand_study:DemandStudy",
    "benchmark": "parkenv.studies.benchmark.study:Benchmark",
    "survey": "parkenv.studies.sensing.survey_study:SurveyStudy",
    "demo": "parkenv.studies.demo.study:Demo",
    "calibrate": "parkenv.studies.trips.calibration_study:CalibrationStudy",
    "train": "parkenv.studies.training.study:TrainingStudy",
    "park": "parkenv.studies.trips.manoeuvre_study:ManoeuvreStudy",
}


# Called with what is going on, how much of it is finished, and of how much; 0 where that is not known yet.
Progress = Callable[[str, int, int], None]


def run_tasks(doing: str, tasks: Sequence[Task[object]], workers: Workers, progress: Progress) -> None:
    if tasks:
        progress(doing, 0, len(tasks))
    for number, _ in enumerate(workers.results(tasks), start=1):
        progress(doing, number, len(tasks))


def counted(progress: Progress, doing: str, total: int = 0) -> Callable[[], None]:
    """Return a function to call each time that a part of `total` is finished."""
    done = itertools.count(1)
    progress(doing, 0, total)
    return lambda: progress(doing, next(done), total)


class ExecutionSpec(Spec):
    """Where tasks run; the results do not depend on it."""

    jobs: int = option(
        0,
        "Worker processes, at most one per core and per task.",
        short="-j",
        panel="Machines",
        default="0, all cores",
        ge=0,
        le=10_000,
    )
    backend: BackendName = option(
        "loky",
        "Run workers on this machine (loky), or on a Ray or Dask cluster (extras ray, dask).",
        panel="Machines",
    )
    address: str | None = option(
        None,
        "Address of the cluster: Ray's head, HOST:6379 or ray://HOST:10001; Dask's scheduler, tcp://HOST:8786.",
        takes="HOST:PORT",
        panel="Machines",
        default="a cluster on this machine",
    )

    def workers(self) -> Workers:
        return Workers(self.jobs or None, self.backend, self.address)


class Cell(NamedTuple):
    """A part of a study whose items differ in a number only.

    Attributes:
        work: what `Study.run` needs besides the study, such as an agent in a scenario; has the `columns` that identify
            its rows.
        items: seeds, days or numbers of sessions.
    """

    work: Any
    items: Sequence[Any]


MOST_SLOTS = 20_000  # lots with more slots are not replayed: the page would not load
AGREES_S = 1e-6  # total times of a search or a day that differ by less agree, s
# Searches in a world, a drive or a day in the data of a page; its `differences` from the run are notes.
Recording = dict[str, Any]


class ReplayJob(NamedTuple):
    """Searches, drives or days to run again for a page."""

    tasks: Sequence[Task[Recording]] = ()
    notes: Sequence[str] = ()  # what is left out, and why


class NotInRunError(InputError):
    """A search, a day or an agent was chosen that the run does not have."""


class ReportOptions(Spec):
    episodes: int | None = option(
        None,
        "About how many episodes to replay, all agents together.",
        short="-n",
        default="20; through simulated sensors 4; 8 days of a fleet",
        ge=0,
    )
    numbers: Several[float] | None = option(
        None,
        "Replay the episodes with these seeds, or these days of a fleet.",
        name="--replay",
        takes="SEED[,...]",
        min_length=1,
    )
    agents: Several[str] | None = option(
        None, "Replay only these agents.", takes="NAME[,...]", parse=split_agents
    )
    sessions: int = option(1, "Survey drives to replay.", ge=0)
    frames: int = option(120, "Captures of them to keep, all drives together.", ge=2, le=250)
    drives: Sequence[dict[str, Any]] | None = Field(
        None, description="Recorded drives to use instead of driving again."
    )

    def chosen_agents(self, known: Sequence[str]) -> Sequence[str]:
        for name in self.agents or ():
            if name not in known:
                raise NotInRunError(f"--agents has {name!r}; {nearest(name, list(dict.fromkeys(known)))}")
        return known if self.agents is None else self.agents

    def chosen_numbers(self, known: Sequence[int]) -> list[int] | None:
        for number in self.numbers or ():
            if number not in known:
                span = f"{known[0]} to {known[-1]}" if known else "none"
                raise NotInRunError(f"--replay has {number:g}; this run's are {span}")
        return None if self.numbers is None else [int(number) for number in self.numbers]


class Labelled(NamedTuple):
    """Work of which only the columns that identify its rows are known."""

    columns: Row


class Study(ExecutionSpec):
    """A specification that can be run: subclasses define the work and how its rows are summarised.

    Attributes:
        kind: name of the kind of study in files.
        table: where finished rows go.
        further_tables: where what rows hold under the names of these goes.
        block: items in a task: an interruption loses few of them, and starting a task costs little.
        doing, unit: what the progress bar says and counts.
        heading: heading of the report, before the scenarios; the kind if empty.
        table_titles: titles of the tables of the report, by their entries in the summary.
        columns: columns of the tables, besides those that all searches have.
        shown: tables that the terminal shows, by name, and their columns; all if empty.
        examples: command lines for the help page.
        writes: what the folder holds, for the help page.
    """

    kind: str
    table: ClassVar[Table] = EPISODES
    further_tables: ClassVar[tuple[Table, ...]] = ()
    block: ClassVar[int] = 10
    doing: ClassVar[str] = "Searching"
    unit: ClassVar[str] = "episodes"
    heading: ClassVar[str] = ""
    table_titles: ClassVar[Mapping[str, str]] = {"rows": "Results"}
    columns: ClassVar[Sequence[Column]] = ()
    shown: ClassVar[Mapping[str, Collection[str]]] = {"rows": ()}
    examples: ClassVar[str] = ""
    writes: ClassVar[str] = "the results"

    def __getstate__(self) -> dict[Any, Any]:
        """Workers make scenarios themselves, once each."""
        state = super().__getstate__()
        fields = type(self).model_fields
        return state | {"__dict__": {name: v for name, v in state["__dict__"].items() if name in fields}}

    def check(self) -> None:
        """Check, before anything is written, that all cells can be run.

        Raises:
            InputError: a scenario or an agent cannot be made, or parts of the specification do not fit together.
        """

    @abstractmethod
    def settings(self) -> Row:
        """Return everything that affects a row; a resumed run must have the same settings."""

    def cells(self) -> list[Cell]:
        """Return all cells, in the order of the results; unless `stages` does."""
        return []

    @abstractmethod
    def run(self, work: Any, items: Sequence[Any]) -> list[Row]:
        """Run a block of items of a cell, in a worker process; return their rows."""

    @abstractmethod
    def summarise(self, results: Results) -> Row:
        """Return what `summary.json` holds besides command, version and seed; `rows` is its table."""

    def rows_of(self, cell: Cell, results: Results) -> list[Row]:
        """Return the finished rows of a cell, in the order of its items."""
        rows = results.rows(self.table)
        return [rows[key] for item in cell.items for key in self.keys(cell.work, item) if key in rows]

    def all_rows(self, results: Results) -> list[Row]:
        """Return the finished rows of all cells, in their order."""
        return [row for cell in self.cells() for row in self.rows_of(cell, results)]

    def outputs(self, results: Results, summary: Row) -> list[Task[object]]:
        """Return tasks that write what follows from results and their summary into the folder, such as figures."""
        return []

    @classmethod
    def findings(cls, summary: Row) -> list[str]:
        """Return the results of a finished run in sentences, for its report; none by default."""
        return []

    @classmethod
    def page(cls, summary: Row, folder: Path) -> Page:
        """Return what a report says about a finished run.

        Args:
            summary: content of `summary.json`.
            folder: folder of the run.

        Raises:
            InputError: a file in the folder is damaged.
        """
        from parkenv.show.report.page import Page, on_scenarios

        title = f"{cls.heading}{on_scenarios(summary['rows'])}"
        if not cls.heading:
            title = f"parkenv {cls.model_fields['kind'].default}"
        return Page(title, cls.findings(summary), cls.page_tables(summary, folder))

    @classmethod
    def page_tables(cls, summary: Row, folder: Path) -> list[Row]:
        """Return the tables of a report; see `page`."""
        return tables_of(summary, cls.table_titles, cls.columns)

    @classmethod
    def printed(cls, summary: Row, folder: Path) -> list[Row]:
        """Return the tables that a terminal shows; see `page`."""
        tables = {table["name"]: table for table in cls.page_tables(summary, folder)}
        return [
            part_of(tables[name], keys) if keys else tables[name]
            for name, keys in cls.shown.items()
            if name in tables
        ]

    @classmethod
    def folder(cls, given: Mapping[str, Any]) -> Path:
        """Return where a command with these options, `--episodes` or `SUITE`, puts the results."""
        return Path("results") / str(cls.model_fields["kind"].default)

    def with_options(self, given: Mapping[str, Any], *, resumed: bool) -> Self:
        """Return the study with what several options of a command mean together.

        Args:
            given: the options, such as `--episodes`, and their texts.
            resumed: whether the study is that of a run to continue.
        """
        return self

    def replays(self, folder: Path, options: ReportOptions) -> Sequence[ReplayJob]:
        """Return what of the run in a folder a report shows again; nothing by default.

        Raises:
            InputError, OSError: the run cannot be repeated.
        """
        return ()

    def keys(self, work: Any, item: Any) -> list[Key]:
        """Return the keys of the rows of an item."""
        return [self.table.key({**work.columns, self.table.keys[-1]: item})]

    def label(self, work: Any) -> str:
        """Return the name of a cell in warnings, each of which is shown once for it."""
        return str(work)

    def prepare(self, results: Results, *, continues: bool) -> None:
        """Make a folder ready for this run, or for going on with an earlier one: remove what is not in its tables."""

    def stages(self, results: Results) -> Iterator[Stage]:
        """Yield the stages of the run; each may depend on the results of those before."""
        yield Stage(self.doing, self, self.cells())

    def save_artifacts(self, work: Any, rows: Sequence[Row], results: Results) -> None:
        """Take out of finished rows what is not in tables, and write it, before they are stored."""


class Stage(NamedTuple):
    doing: str  # what the progress bar says
    study: Study
    cells: Sequence[Cell]


def study_class(kind: object, source: str = "") -> type[Any]:
    if not isinstance(kind, str) or kind not in STUDIES:
        raise InputError(f"{source}: kind is {kind!r}; {nearest(str(kind), STUDIES)}")
    module, _, name = STUDIES[kind].partition(":")
    study: type[Any] = getattr(import_module(module), name)
    return study


def schemas() -> dict[str, dict[str, Any]]:
    models: dict[str, Any] = {"scenario": ScenarioSpec} | {kind: study_class(kind) for kind in STUDIES}
    draft = {"$schema": "https://json-schema.org/draft/2020-12/schema"}
    return {kind: draft | model.model_json_schema() for kind, model in models.items()}


def read_study(file: Path) -> Any:
    tables = read_tables(file)
    study = study_class(tables.get("kind", "compare"), str(file))
    return study.parse(tables, str(file), file.parent).of_file(file)
