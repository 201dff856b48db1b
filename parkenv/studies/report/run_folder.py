"""Read a run folder: summary, figures and episodes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from parkenv import __version__
from parkenv.errors import InputError
from parkenv.files.limited_reading import read_json
from parkenv.files.spec_file import Spec, read_tables
from parkenv.show.report.learning import learning_panels
from parkenv.show.report.page import page_data
from parkenv.studies.fleet.study import FleetStudy
from parkenv.studies.report.summary import SUMMARIES, Summary
from parkenv.studies.results import (
    EPISODES,
    SETTINGS,
    SPEC_FILE,
    SUMMARY,
    SUMMARY_PARTIAL,
    Row,
    without_nan,
)
from parkenv.studies.sensing.sessions import SESSIONS
from parkenv.studies.study import STUDIES, read_study
from parkenv.studies.training.curve_file import CURVE, read_curve


@dataclass(frozen=True)
class RunFolder:
    """A finished run.

    Attributes:
        path: the folder.
        summary: content of `summary.json`.
        figures: the PNG files in the folder, by name.
        kind: compare, survey, demo, train, ...; the command's name if the folder holds no specification.
    """

    path: Path
    summary: Mapping[str, Any]
    figures: tuple[Path, ...]
    kind: str

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read a run folder.

        Raises:
            InputError: there is no folder or no finished run in it, the run is of another version, or the summary is
                damaged.
        """
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
        spec, command = path / SPEC_FILE, summary.get("command")
        kind = read_tables(spec).get("kind") if spec.exists() else None
        kind = str(kind or (command[1] if isinstance(command, list) and len(command) > 1 else ""))
        SUMMARIES.get(kind, Summary).parse(summary, f"{file}: is not as a command wrote it")
        if summary["version"] != __version__:
            raise InputError(
                f"{file}: was written by parkenv {summary['version']}, this is {__version__}, whose searches may "
                "differ; run the command again, or report it with that version"
            )
        return cls(path, summary, tuple(sorted(path.glob("*.png"))), kind)

    def spec(self) -> Spec | None:
        """Read the specification that the run kept; None for a command that keeps none.

        Raises:
            InputError: the file is missing or damaged.
        """
        return read_study(self.path / SPEC_FILE) if self.kind in STUDIES else None

    @property
    def arguments(self) -> list[str]:
        """Arguments of the command."""
        return [str(word) for word in self.summary["command"][2:]]

    def totals(self) -> dict[tuple[Any, ...], float]:
        """Read the total time, s, of every search in `episodes.csv`, by `Case.key`; empty without the file.

        Raises:
            InputError: the file is damaged, or not of this version.
        """
        return {EPISODES.key(row): row["total_s"] for row in EPISODES.read(self.path)}

    def day_totals(self) -> dict[tuple[Any, ...], float]:
        """Read the mean total time, s, of every day in `days.csv`, by `FleetStudy.keys`; empty without the file.

        Raises:
            InputError: the file is damaged, or not of this version.
        """
        table = FleetStudy.table
        return {table.key(row): row["total_s"] for row in table.read(self.path)}

    def sessions(self) -> list[Row]:
        """Read the drives of a survey from `sessions.csv`, NaN as None; none without the file.

        Raises:
            InputError: the file is damaged, or not of this version.
        """
        rows: list[Row] = without_nan(SESSIONS.read(self.path))
        return rows

    def curve(self, seed: int) -> list[Row]:
        """Read the evaluations of a training, NaN as None; none without their file.

        Raises:
            InputError: the file is damaged.
        """
        rows: list[Row] = without_nan(read_curve(self.path / f"seed_{seed}" / CURVE))
        return rows

    def learning(self) -> list[dict[str, Any]]:
        """Return the panels of a training's learning curves; none for runs of other kinds.

        Raises:
            InputError: a file of evaluations is damaged.
        """
        if self.kind != "train" or not self.summary.get("curve"):
            return []
        return learning_panels(self.summary, [self.curve(row["seed"]) for row in self.summary["rows"]])

    def page_data(
        self,
        encounters: Sequence[Mapping[str, Any]] = (),
        drives: Sequence[Mapping[str, Any]] = (),
        fleets: Sequence[Mapping[str, Any]] = (),
        notes: Sequence[str] = (),
    ) -> dict[str, Any]:
        """Return the data of the run's page; see `parkenv.show.report.page.page_data`."""
        return page_data(
            self.kind, self.summary, sessions=self.sessions(), learning=self.learning(), encounters=encounters,
            drives=drives, fleets=fleets, notes=notes,
        )  # fmt: skip
