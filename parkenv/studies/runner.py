"""The one runner of all kinds of studies: workers, lock, progress, interruption, resume, tables and summary.

`run` gives blocks of items to worker processes and stores the rows that come back in the folder, so that an interrupted
run keeps all finished rows, and a resumed run equals an uninterrupted one.
"""

import re
import shutil
import warnings
import weakref
from collections.abc import Collection, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from tempfile import mkdtemp
from typing import Any
from uuid import uuid4

from parkenv.errors import InputError, require
from parkenv.files.folder_lock import only_writer
from parkenv.files.limited_reading import read_json
from parkenv.files.user_class import failure_of
from parkenv.studies.fields import classes_in
from parkenv.studies.results import SETTINGS, SPEC_FILE, SUMMARY, Key, Results, Row
from parkenv.studies.study import Progress, Stage, Study, read_study, run_tasks
from parkenv.studies.workers import Workers
from parkenv.version import __version__


@dataclass(frozen=True, eq=False)
class Result:
    """The result of a study.

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
        """Return `rows` as a pandas `DataFrame`, which is not installed with parkenv."""
        return import_module("pandas").DataFrame(self.rows)

    def figures(self) -> list[Path]:
        """Draw all figures into the folder; return the PNG files there."""
        _draw(self, lambda *_: None)
        return sorted(self.folder.glob("*.png"))

    def report(self, out: Path | None = None) -> Path:
        """Write an HTML page with tables, figures, and replays of searches, drives or days; return the file.

        Args:
            out: the page; None for `report.html` in the folder.

        Raises:
            InputError: the run is not finished, or the page cannot be written.
        """
        from parkenv.studies.report import RunFolder, write_report

        with self.study.workers() as workers:
            return write_report(RunFolder.read(self.folder), self.study, out=out, workers=workers)[0]


class Interrupted(KeyboardInterrupt):
    """A run was interrupted (Ctrl-C); finished rows are in its folder.

    Attributes:
        result: what is finished.
    """

    def __init__(self, result: Result) -> None:
        super().__init__()
        self.result = result


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
        command: command line to record in the summary; by default the one that runs the specification in the folder.

    Raises:
        InputError: the study cannot be run, or the folder cannot be used.
        Interrupted: Ctrl-C; the exception holds the result so far.
    """
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
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default")
        study.check()
    for warning in caught:
        warnings.warn(warning.message, stacklevel=2)
    told = {str(warning.message) for warning in caught}
    path = Path(folder)
    with (
        only_writer(path),
        study.workers() if workers is None else nullcontext(workers) as used,
        Results(path, (study.table, *study.further_tables)) as results,
    ):
        results.workers, results.progress = used, progress
        results.command = tuple(command or ("parkenv", "run", SPEC_FILE))
        settings = results.claim(study.settings(), study.kind, resume=resume, overwrite=overwrite)
        study.prepare(results, continues=resume)
        results.begin(settings, continues=resume)
        study.write(path / SPEC_FILE)
        done: list[Stage] = []
        try:
            for stage in study.stages(results):
                done.append(stage)
                _run_stage(stage, results, used, progress, told)
            interrupted = False
        except KeyboardInterrupt:
            interrupted = True
        _put_in_order(done, results)
        head = {
            "command": list(results.command),
            "version": __version__,
            "seed": getattr(study, "seed", None),
        }
        summary = head | {"complete": not interrupted} | study.summarise(results)
        results.export()
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
        require((path / name).exists(), f"{path}: holds no finished run: no {name}")
    study = read_study(path / SPEC_FILE)
    results = Results(path, (study.table, *study.further_tables))
    results.read()
    return Result(study, results, read_json(path / SUMMARY))


def _put_in_order(stages: Sequence[Stage], results: Results) -> None:
    cells = [(study, study.cells()) for study in {id(stage.study): stage.study for stage in stages}.values()]
    order: dict[tuple[str, ...], list[Key]] = {}
    for study, of_study in [*cells, *((stage.study, stage.cells) for stage in stages)]:
        order.setdefault(tuple(study.table.keys), []).extend(
            key for work, items in of_study for item in items for key in study.keys(work, item)
        )
    results.put_in_order(order)


def _draw(result: Result, progress: Progress) -> None:
    """Write the outputs, in processes of this machine: only they can write the folder."""
    with Workers(result.study.jobs or None) as workers:
        run_tasks("Drawing figures", result.study.outputs(result.results, result.summary), workers, progress)


def _run_stage(
    stage: Stage, results: Results, workers: Workers, progress: Progress, told: Collection[str] = ()
) -> None:
    """Run what the results do not hold yet, and add it; warnings that the user has been told are not repeated."""
    doing, study, cells = stage
    finished = results.rows(study.table)
    # The number of a block within its cell, the cell's work and the items.
    numbered: list[tuple[int, Any, Sequence[Any]]] = []
    total = done = 0
    for work, items in cells:
        left = []
        for item in items:
            keys = study.keys(work, item)
            total += len(keys)
            if all(key in finished for key in keys):
                done += len(keys)
            else:
                left.append(item)
        starts = range(0, len(left), study.block)
        numbered += [(n, work, left[i : i + study.block]) for n, i in enumerate(starts)]
    if not workers.in_process:
        # One block of each cell first: workers then compile the functions of different agents at the same time.
        numbered.sort(key=lambda block: block[0] > 0)
    blocks = [(work, items) for _, work, items in numbered]
    progress(doing, done, total)
    token = "" if workers.in_process else uuid4().hex
    tasks = [partial(_run_block, token, study, work, block) for work, block in blocks]
    shown: set[tuple[str, str]] = set()
    for number, (rows, messages) in workers.results(tasks):
        work = blocks[number][0]
        study.save_artifacts(work, rows, results)
        results.add(rows, study.table)
        done += len(rows)
        progress(doing, done, total)
        for message in messages:
            # Numbers in the text differ between items.
            topic = study.label(work), re.sub(r"\d+", "", message)
            if topic not in shown and message not in told:
                shown.add(topic)
                warnings.warn(f"{topic[0]}: {message}", stacklevel=2)


# The study of a worker process, by its token: it keeps its scenarios for the next block.
_KEPT: dict[str, Study] = {}


def _run_block(token: str, study: Study, work: Any, items: Sequence[Any]) -> tuple[list[Row], list[str]]:
    """Run a block; return its rows and its warnings, which would not reach the user in order from a worker process."""
    if token:
        if token not in _KEPT:
            _KEPT.clear()
            _KEPT[token] = study
        study = _KEPT[token]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default")
        try:
            rows = study.run(work, items)
        except InputError:
            raise
        except Exception as error:
            if failure := failure_of(error, classes_in(study)):
                raise failure from error
            raise
    return rows, [str(w.message) for w in caught]
