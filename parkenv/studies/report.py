"""The page on a finished run: what its study says about it, its figures, and what it replays, run again."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from pydantic import Field

from parkenv.errors import InputError
from parkenv.files.atomic_write import make_folder
from parkenv.files.limited_reading import read_json
from parkenv.files.spec_file import Several, Spec, read_tables
from parkenv.show.report.page import Page, page_data, write_page
from parkenv.show.report.tables import tables_of
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
    """Content of `summary.json`, of any kind of run."""

    command: Several[str] = Field(min_length=2)
    version: str
    seed: int | None = Field(None, ge=0, le=10**15)
    rows: Several[dict[str, Any]]


@dataclass(frozen=True)
class RunFolder:
    """A finished run.

    Attributes:
        path: the folder.
        summary: content of `summary.json`.
        kind: compare, survey, demo, train, ...; the command's name if the folder holds no specification.
        page: what its study says about it.
    """

    path: Path
    summary: Mapping[str, Any]
    kind: str
    page: Page

    @classmethod
    def read(cls, path: Path) -> Self:
        if not path.is_dir():
            raise InputError(f"{path}: no such folder; want one that a command with --out wrote")
        file = path / SUMMARY
        if not file.exists():
            if (path / SUMMARY_PARTIAL).exists() or (path / SETTINGS).exists():
                raise InputError(
                    f"{path}: holds a run that was interrupted; finish it (--resume), then report it"
                )
            raise InputError(f"{path}: holds no {SUMMARY}; want a folder that a command with --out wrote")
        summary = read_json(file, finite=True)
        if not isinstance(summary, dict):
            raise InputError(f"{file}: want the summary of a command")
        damaged = f"{file}: is not as a command wrote it"
        Summary.parse(summary, damaged)
        if summary["version"] != __version__:
            raise InputError(
                f"{file}: was written by parkenv {summary['version']}, this is {__version__}, whose searches may "
                "differ; run the command again, or report it with that version"
            )
        spec = path / SPEC_FILE
        kind = str((spec.exists() and read_tables(spec).get("kind")) or summary["command"][1])
        try:
            if kind in STUDIES:
                page = study_class(kind).page(summary, path)
            else:
                page = Page(f"parkenv {kind}", tables=tables_of(summary, {"rows": "Results"}))
            return cls(path, summary, kind, page)
        except InputError:
            raise
        except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
            raise InputError(f"{damaged}: {error!r}") from error

    def spec(self) -> Study | None:
        return read_study(self.path / SPEC_FILE) if self.kind in STUDIES else None

    @property
    def command(self) -> list[str]:
        """The words of a command that repeats the run in a folder beside it."""
        words = [
            str(self.path / SPEC_FILE) if word == SPEC_FILE else str(word) for word in self.summary["command"]
        ]
        if self.kind not in STUDIES:
            return words
        if {"--resume", "--overwrite"} & set(words):
            words = ["parkenv", "run", str(self.path / SPEC_FILE)]
        out, path = ("--out", "-o"), self.path if self.path.name else self.path.resolve()
        pairs = zip(words, ["", *words], strict=False)
        others = [w for w, before in pairs if not {w, before} & {*out} and not w.startswith("--out=")]
        return [*others, "--out", f"{path}-again"]

    @property
    def figures(self) -> list[Path]:
        return sorted(self.path.glob("*.png"))

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
    """Write the page on a run.

    Args:
        run: the run.
        study: its study; None to replay nothing.
        options: what to replay.
        out: the page; None for `report.html` in the folder of the run.
        notes: notes for the reader.
        workers: where searches, drives and days run again.
        progress: called as they finish.
        doing: what `progress` is called with.

    Returns:
        The page, and all notes on it.
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
    write_page(run.data(recordings, notes), path, run.figures)
    return path, notes
