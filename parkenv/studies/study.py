"""Studies: a specification that says what to run, and the one runner of all kinds of studies.

A study has *cells*, such as an agent in a setting, and a cell has *items*, such as seeds or days. `run` gives blocks of
items to worker processes and appends the rows that come back to the tables in the folder, so that an interrupted run
loses nothing that is finished and a resumed one equals an unbroken one.

A new kind of study is a subclass with fields and a few methods, and a line in `STUDIES`. Its module is imported to
parse a file or an option, so methods import what they run.
"""

from __future__ import annotations

import math
import re
import shutil
import time
import warnings
import weakref
from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from tempfile import mkdtemp
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, NamedTuple
from uuid import uuid4

from pydantic import Field

from parkenv import __version__
from parkenv.errors import InputError, nearest
from parkenv.files.folder_lock import only_writer
from parkenv.files.known_names import BackendName
from parkenv.files.limited_reading import read_json
from parkenv.files.option import Option
from parkenv.files.spec_file import Spec, read_tables
from parkenv.studies.results import (
    EPISODES,
    SETTINGS,
    SPEC_FILE,
    SUMMARY,
    GoesOn,
    Key,
    ResultFolder,
    Row,
    Table,
)
from parkenv.studies.workers import Task, Workers

if TYPE_CHECKING:
    from parkenv.studies.replays import Replays

STUDIES: Mapping[str, str] = {
    "compare": "parkenv.studies.compare.comparison:Comparison",
    "commute": "parkenv.studies.commute.study:Commute",
    "fleet": "parkenv.studies.fleet.study:FleetStudy",
    "benchmark": "parkenv.studies.benchmark.study:Benchmark",
    "survey": "parkenv.studies.sensing.survey_study:SurveyStudy",
    "detectors": "parkenv.studies.sensing.detector_study:DetectorStudy",
    "demo": "parkenv.studies.demo.study:Demo",
    "calibrate": "parkenv.studies.trips.calibration_study:CalibrationStudy",
    "verify": "parkenv.studies.verify.study:Verification",
    "train": "parkenv.studies.training.spec:TrainingSpec",
}
"""`MODULE:CLASS` of each kind of study, by the key `kind` of its files."""
SYNC_S = 1.0
"""Least time between two flushes of finished rows to disk if they come faster, s."""

Progress = Callable[[str, int, int], None]
"""Called with what is going on, how much of it is finished, and of how much."""


class ExecutionSpec(Spec):
    """Where tasks run; the results do not depend on it."""

    jobs: Annotated[int, Option(short="-j", takes="N >= 0", panel="Machines", default="0, all cores")] = (
        Field(0, ge=0, le=10_000, description="Worker processes, at most one per core and per task.")
    )
    backend: Annotated[BackendName, Option(panel="Machines")] = Field(
        "loky",
        description="Run workers on this machine (loky), or on a Ray or Dask cluster (extras ray, dask).",
    )
    address: Annotated[
        str | None, Option(takes="HOST:PORT", panel="Machines", default="a cluster on this machine")
    ] = Field(
        None,
        description="Of the cluster: Ray's head, HOST:6379 or ray://HOST:10001; Dask's scheduler, tcp://HOST:8786.",
    )

    def workers(self) -> Workers:
        """Return the workers, a context manager that connects to clusters.

        Raises:
            InputError: the fields are incompatible.
        """
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


class Study(ExecutionSpec):
    """A specification that can be run: subclasses say what is run and what is made of the rows.

    Attributes:
        kind: name of the kind of study in files.
        table: where finished rows go.
        all_tables: all tables of the folder, the most important first, if there are several.
        block: items in a task: an interruption loses few of them, and starting a task costs little.
        doing, unit: what the progress bar says and counts.
        goes_on: when a run continues the one in its folder: if `asked` to resume; also if that is `unfinished`,
            otherwise it replaces it; or `always`, whatever the settings, which the keys of rows hold.
        keeps_order: whether rows are stored in the order of the items, instead of as they finish.
    """

    kind: str
    table: ClassVar[Table] = EPISODES
    all_tables: ClassVar[tuple[Table, ...]] = ()
    block: ClassVar[int] = 10
    doing: ClassVar[str] = "Searching"
    unit: ClassVar[str] = "episodes"
    goes_on: ClassVar[GoesOn] = "asked"
    keeps_order: ClassVar[bool] = False

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

    def outputs(self, result: Result) -> list[Task[object]]:
        """Return tasks that write what follows from a result into its folder, such as figures."""
        del result
        return []

    def replays(self, folder: Path) -> Replays:
        """Return what a report may run again; nothing by default.

        Raises:
            InputError, OSError: the run in the folder cannot be repeated.
        """
        from parkenv.studies.replays import Replays

        del folder
        return Replays()

    def keys(self, work: Any, item: Any) -> list[Key]:
        """Return the keys of the rows of an item."""
        return [self.table.key({**work.columns, self.table.keys[-1]: item})]

    def label(self, work: Any) -> str:
        """Return the name of a cell in warnings, each of which is shown once for it."""
        return str(work)

    def prepare(self, results: Results, *, continues: bool) -> None:
        """Make a folder ready for this run, or for going on with an earlier one: remove what is not in its tables."""

    def warm_up(self) -> list[Task[object]]:
        """Return tasks to run first, such as to compile what many processes would compile at the same time."""
        return []

    def stages(self, results: Results) -> Iterator[Stage]:
        """Yield the stages of the run; each may depend on the results of those before."""
        del results
        yield Stage(self.doing, self, self.cells())

    def enough(self, work: Any, items: Sequence[Any], results: Results) -> Any:
        """Return the work of a task, with what it needs from the tasks before."""
        del items, results
        return work

    def keep(self, work: Any, rows: Sequence[Row], results: Results) -> None:
        """Keep what of finished rows is not in the table, in the process of the run; called before they are stored."""


class Stage(NamedTuple):
    """Cells that may run at the same time.

    Attributes:
        doing: what the progress bar says.
        study: the study whose cells they are.
        cells: the cells.
    """

    doing: str
    study: Study
    cells: Sequence[Cell]


class Results(ResultFolder):
    """Finished rows of a study, in memory and in its folder.

    Attributes:
        kept: what this run has found besides, for figures.
    """

    def __init__(self, path: Path, tables: Sequence[Table]) -> None:
        super().__init__(path, tables)
        self.kept: dict[str, Any] = {}

    def of(self, study: Study, cell: Cell) -> list[Row]:
        """Return the finished rows of a cell, in the order of its items."""
        rows = self.rows(study.table)
        return [rows[key] for item in cell.items for key in study.keys(cell.work, item) if key in rows]


@dataclass(frozen=True, eq=False)
class Result:
    """What a study has found.

    Attributes:
        study: the study.
        results: its finished rows, and their folder.
        summary: content of `summary.json`; NaN where that has null.
    """

    study: Study
    results: Results
    summary: Row

    @property
    def folder(self) -> Path:
        """The folder with the tables; removed with this result if none was given."""
        return self.results.path

    @property
    def rows(self) -> list[Row]:
        """Rows of the summary, such as one for each agent in each setting."""
        rows: list[Row] = self.summary["rows"]
        return rows

    @property
    def complete(self) -> bool:
        """Whether everything is finished."""
        return bool(self.summary["complete"])

    def frame(self) -> Any:
        """Return `rows` as a pandas `DataFrame`.

        Raises:
            InputError: pandas is not installed.
        """
        try:
            pandas = import_module("pandas")
        except ImportError as error:
            raise InputError("frame() needs pandas: pip install pandas") from error
        return pandas.DataFrame(self.rows)

    def figures(self) -> list[Path]:
        """Draw all figures into the folder; return the PNG files there."""
        _draw(self, lambda *_: None)
        return sorted(self.folder.glob("*.png"))


class Interrupted(KeyboardInterrupt):
    """A run was interrupted (Ctrl-C); finished rows are in its folder.

    Attributes:
        result: what is finished.
    """

    def __init__(self, result: Result) -> None:
        super().__init__()
        self.result = result


def study_class(kind: object, source: str = "") -> type[Any]:
    """Return the class of a kind of study.

    Raises:
        InputError: an unknown kind; the message starts with the source and names the nearest.
    """
    if not isinstance(kind, str) or kind not in STUDIES:
        raise InputError(f"{source}: kind is {kind!r}; {nearest(str(kind), STUDIES)}")
    module, _, name = STUDIES[kind].partition(":")
    found: type[Any] = getattr(import_module(module), name)
    return found


def read_study(file: Path) -> Any:
    """Read the specification of a study; its key `kind` says which, `compare` if absent.

    Raises:
        InputError: see `Spec.read`.
    """
    tables = read_tables(file)
    study = study_class(tables.get("kind", "compare"), str(file))
    return study.parse(tables, str(file), file.parent).of_file(file)


def run(
    study: Study,
    folder: Path | str | None = None,
    *,
    resume: bool = False,
    overwrite: bool = False,
    progress: Progress = lambda *_: None,
    workers: Workers | None = None,
    command: Sequence[str] | None = None,
) -> Result:
    """Run a study; skip what its folder already holds.

    The folder gets the specification (`experiment.json`), the settings (`settings.json`), the tables, the figures and
    the summary (`summary.json`).

    Args:
        study: the study.
        folder: where the results go; None for a temporary folder that lasts as long as the result.
        resume: continue an earlier run.
        overwrite: replace the results of another run.
        progress: called as rows finish; see `Progress`.
        workers: where tasks run, if not as the study says; results do not depend on it.
        command: command line to record in the summary.

    Raises:
        InputError: the study cannot be run, or the folder cannot be used.
        Interrupted: Ctrl-C; the exception holds the result so far.
    """
    study.check()
    if folder is None:
        path = Path(mkdtemp(prefix="parkenv-"))
        try:
            result = run(study, path, progress=progress, workers=workers, command=command)
        except Interrupted as stopped:
            weakref.finalize(stopped.result, shutil.rmtree, path)
            raise
        except BaseException:
            shutil.rmtree(path)
            raise
        weakref.finalize(result, shutil.rmtree, path)
        return result
    path = Path(folder)
    with only_writer(path), study.workers() if workers is None else nullcontext(workers) as used:
        results = Results(path, study.all_tables or (study.table,))
        settings, continues = results.claim(
            study.settings(), study.kind, resume=resume, overwrite=overwrite, goes_on=study.goes_on
        )
        study.prepare(results, continues=continues)
        results.begin(settings)
        study.write(path / SPEC_FILE)
        done: list[Stage] = []
        try:
            _run_all("Compiling, once per installation", study.warm_up(), used, progress)
            for stage in study.stages(results):
                done.append(stage)
                _run_stage(stage, results, used, progress)
            interrupted = False
        except KeyboardInterrupt:
            interrupted = True
        _put_in_order(done, results)
        head = {
            "command": list(command or ("parkenv", study.kind)),
            "version": __version__,
            "seed": getattr(study, "seed", None),
        }
        summary = head | {"complete": not interrupted} | study.summarise(results)
        result = Result(study, results, summary)
        if interrupted:
            results.finish(summary, complete=False)
            raise Interrupted(result)
        if getattr(study, "figures", True):
            _draw(result, progress)
        results.finish(summary)
    return result


def open_run(folder: Path | str) -> Result:
    """Read the finished run in a folder.

    Raises:
        InputError: there is none, or a file is damaged.
    """
    path = Path(folder)
    for name in (SPEC_FILE, SETTINGS, SUMMARY):
        if not (path / name).exists():
            raise InputError(f"{path}: holds no finished run: no {name}")
    study = read_study(path / SPEC_FILE)
    results = Results(path, study.all_tables or (study.table,))
    results.read()
    return Result(study, results, read_json(path / SUMMARY))


def _put_in_order(stages: Sequence[Stage], results: Results) -> None:
    """Put the rows of all stages in the order of their cells; a cell may be in several stages."""
    order: dict[Table, dict[int, list[Key]]] = {}
    for _, study, cells in stages:
        of_table = order.setdefault(study.table, {})
        for work, items in cells:
            of_table.setdefault(id(work), []).extend(key for item in items for key in study.keys(work, item))
    for table, of_cells in order.items():
        results.put_in_order([key for keys in of_cells.values() for key in keys], table)


def _draw(result: Result, progress: Progress) -> None:
    """Write the outputs, in processes of this machine: only they can write the folder."""
    with Workers(result.study.jobs or None) as workers:
        _run_all("Drawing figures", result.study.outputs(result), workers, progress)


def _run_all(doing: str, tasks: Sequence[Task[object]], workers: Workers, progress: Progress) -> None:
    if tasks:
        progress(doing, 0, len(tasks))
    for number, _ in enumerate(workers.results(tasks), start=1):
        progress(doing, number, len(tasks))


def _run_stage(stage: Stage, results: Results, workers: Workers, progress: Progress) -> None:
    """Run what the results do not hold yet, and add it.

    Raises:
        KeyboardInterrupt: passed on; finished rows are in the folder.
    """
    doing, study, cells = stage
    finished = results.rows(study.table)
    blocks: list[tuple[Any, Sequence[Any]]] = []
    total = missing = 0
    for work, items in cells:
        left = []
        for item in items:
            keys = study.keys(work, item)
            total += len(keys)
            if any(key not in finished for key in keys):
                missing += len(keys)
                left.append(item)
        blocks += [(work, left[i : i + study.block]) for i in range(0, len(left), study.block)]
    done = total - missing
    progress(doing, done, total)
    token = "" if workers.in_process else uuid4().hex
    tasks = [
        partial(_run_block, token, study, study.enough(work, block, results), block) for work, block in blocks
    ]
    shown: set[tuple[str, str]] = set()
    synced = -math.inf
    numbered = enumerate(workers.in_order(tasks)) if study.keeps_order else workers.results(tasks)
    for number, (rows, messages) in numbered:
        work = blocks[number][0]
        study.keep(work, rows, results)
        # A row may take a millisecond, and a flush to disk a second.
        sync = time.monotonic() >= synced + SYNC_S
        results.add(rows, study.table, sync=sync)
        synced = time.monotonic() if sync else synced
        done += len(rows)
        progress(doing, done, total)
        for message in messages:
            # Numbers in the text differ between items.
            topic = study.label(work), re.sub(r"\d+", "", message)
            if topic not in shown:
                shown.add(topic)
                warnings.warn(f"{topic[0]}: {message}", stacklevel=2)


_KEPT: dict[str, Study] = {}
"""The study of a worker process, by its token: it keeps its scenarios for the next block."""


def _run_block(token: str, study: Study, work: Any, items: Sequence[Any]) -> tuple[list[Row], list[str]]:
    """Run a block; return its rows and its warnings, which would not reach the user in order from a worker process."""
    if token:
        if token not in _KEPT:
            _KEPT.clear()
            _KEPT[token] = study
        study = _KEPT[token]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default")
        rows = study.run(work, items)
    return rows, [str(w.message) for w in caught]
