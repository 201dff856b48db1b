"""The page on a finished run: what its study says about it, its figures, and what it replays, run again."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from pydantic import Field

from parkenv.errors import InputError, require
from parkenv.files.atomic_write import make_folder
from parkenv.files.limited_reading import read_json
from parkenv.files.spec_file import Several, Spec, read_tables
from parkenv.show.report.page import Page, page_data, write_page
from parkenv.show.tables import tables_of
from parkenv.studies.results import PAGE, SETTINGS, SPEC_FILE, SUMMARY, SUMMARY_PARTIAL, require_unchanged
from parkenv.studies.study import (
    STUDIES,
    NotInRunError,
    Progress,
    Recording,
    ReplayJob,
    ReportOptions,
    Study,
    read_study,
    study_class,
)
from parkenv.studies.workers import SERIAL, Workers
from parkenv.version import __version__


class Summary(Spec, extra="allow"):
    command: Several[str] = Field(min_length=2)
    version: str
    seed: int | None = Field(None, ge=0, le=10**15)
    rows: Several[dict[str, Any]]


@dataclass(frozen=True)
class RunFolder:
    path: Path
    summary: Mapping[str, Any]  # content of `summary.json`
    kind: str  # compare, survey, ...; the command's name if the folder holds no specification
    page: Page  # what its study says about it

    @classmethod
    def read(cls, path: Path) -> Self:
        file, wanted = path / SUMMARY, "want a folder that a command with --out wrote"
        require(path.is_dir(), f"{path}: no such folder; {wanted}")
        if not file.exists():
            is_begun = (path / SUMMARY_PARTIAL).exists() or (path / SETTINGS).exists()
            require(
                not is_begun,
                f"{path}: holds a run that was interrupted; finish it (--resume), then report it",
            )
            raise InputError(f"{path}: holds no {SUMMARY}; {wanted}")
        summary = read_json(file, finite=True)
        require(isinstance(summary, dict), f"{file}: want the summary of a command")
        damaged = f"{file}: is not as a command wrote it"
        Summary.parse(summary, damaged)
        require(
            summary["version"] == __version__,
            f"{file}: was written by parkenv {summary['version']}, this is {__version__}, whose searches may differ; "
            "run the command again, or report it with that version",
        )
        spec = path / SPEC_FILE
        kind = str((spec.exists() and read_tables(spec).get("kind")) or summary["command"][1])
        try:
            if kind in STUDIES:
                page = study_class(kind).page(summary, path)
            else:
                page = Page(f"parkenv {kind}", tables=tables_of(summary, {"rows": "Results"}))
        except InputError:
            raise
        except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
            raise InputError(f"{damaged}: {error!r}") from error
        return cls(path, summary, kind, page)

    def spec(self) -> Study | None:
        return read_study(self.path / SPEC_FILE) if self.kind in STUDIES else None

    @property
    def command(self) -> list[str]:
        """The words of a command that repeats the run, in a folder beside it."""
        if self.kind not in STUDIES:
            return list(map(str, self.summary["command"]))
        path = self.path if self.path.name else self.path.resolve()
        return ["parkenv", "run", str(self.path / SPEC_FILE), "--out", f"{path}-again"]

    def data(self, recordings: Sequence[Recording] = (), notes: Sequence[str] = ()) -> dict[str, Any]:
        return page_data(self.kind, self.page, {**self.summary, "command": self.command}, recordings, notes)


def write_report(
    run: RunFolder,
    study: Study | None,
    options: ReportOptions | None = None,
    *,
    out: Path | None = None,
    notes: Sequence[str] = (),
    workers: Workers = SERIAL,
    progress: Progress = lambda *_: None,
    doing: str = "Running again",
) -> tuple[Path, list[str]]:
    """Write the page on a run, for `report.html` in its folder unless `out` is given; return it, and all notes on it.

    Searches, drives and days that `options` choose run again; nothing does without the run's study.
    """
    options = options or ReportOptions()
    path = out or run.path / PAGE
    make_folder(path.parent)
    notes, jobs = [*notes], list[ReplayJob]()
    try:
        if study is not None:
            require_unchanged(study, run.path)
            jobs += study.replays(run.path, options)
    except NotInRunError:
        raise
    except (InputError, OSError) as error:
        # The page still has tables and figures.
        notes.append(f"There is no replay: {error}")
    notes += [note for job in jobs for note in job.notes]
    tasks = [task for job in jobs for task in job.tasks]
    recordings = [*(options.drives or ())]
    progress(doing, 0, len(tasks))
    for number, recording in enumerate(workers.in_order(tasks), start=1):
        recordings.append(recording)
        progress(doing, number, len(tasks))
    notes += [note for recording in recordings for note in recording.get("differences", ())]
    write_page(run.data(recordings, notes), path, sorted(run.path.glob("*.png")))
    return path, notes
