"""Compare closed forms of the literature with what planners and worlds of this package do."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import cached_property, partial
from typing import TYPE_CHECKING, ClassVar, Literal, NamedTuple

from pydantic import Field

from parkenv.errors import InputError, nearest
from parkenv.files.known_names import VERIFY_CASES
from parkenv.files.option import option
from parkenv.files.spec_file import Axis
from parkenv.studies.fields import Seed
from parkenv.studies.results import JsonTable, Results, Row
from parkenv.studies.study import Cell, Study
from parkenv.version import __version__

if TYPE_CHECKING:
    from parkenv.studies.runner import Result
    from parkenv.studies.verify import rows as statements
    from parkenv.studies.workers import Task

PICTURE = "verify.png"


class _Case(NamedTuple):
    """A case, whose items are tasks."""

    name: str

    @property
    def columns(self) -> Row:
        """Columns that identify it."""
        return {"case": self.name}


def _checked(row: Row) -> Row:
    from pydantic import TypeAdapter

    from parkenv.studies.verify.rows import Row as Statement

    found = TypeAdapter(list[Statement]).validate_python(row["rows"])
    return row | {"rows": [dataclasses.asdict(each) for each in found]}


class Verification(Study):
    """Closed forms of the literature against planners and worlds: what is expected, and what is found."""

    table: ClassVar = JsonTable("statements.jsonl", ("case", "task"), _checked, "verified case")
    block: ClassVar = 1
    doing: ClassVar = "Verifying"
    unit: ClassVar = "tasks"
    goes_on: ClassVar = "unfinished"

    kind: Literal["verify"] = "verify"
    cases: Axis[str] = option(
        VERIFY_CASES, f"Some of {', '.join(VERIFY_CASES)}.", takes="NAME[,...]", default="all"
    )
    seed: Seed = Field(0, description="First seed of the simulated cases.")

    @cached_property
    def tasks(self) -> dict[str, list[Task[list[statements.Row]]]]:
        """The tasks of each case.

        Raises:
            InputError: an unknown case; the message names the nearest.
        """
        for case in self.cases:
            if case not in VERIFY_CASES:
                raise InputError(f"cases: there is no case {case!r}; {nearest(case, VERIFY_CASES)}")
        from parkenv.studies.verify import balance, game, line, queues, town

        made = line.CASES | queues.CASES | balance.CASES | game.CASES | town.CASES
        return {case: made[case](self.seed) for case in self.cases}

    def check(self) -> None:
        """See `Study`."""
        assert self.tasks

    def settings(self) -> Row:
        """See `Study`."""
        return {"version": __version__, "seed": self.seed}

    def cells(self) -> list[Cell]:
        """See `Study`."""
        return [Cell(_Case(name), range(len(tasks))) for name, tasks in self.tasks.items()]

    def run(self, work: _Case, items: Sequence[int]) -> list[Row]:
        """See `Study`."""
        tasks = self.tasks[work.name]
        return [
            {"case": work.name, "task": i, "rows": [dataclasses.asdict(row) for row in tasks[i]()]}
            for i in items
        ]

    def statements(self, results: Results) -> list[statements.Row]:
        """Return what is found so far, in the order of the cases."""
        from parkenv.studies.verify.rows import Row as Statement

        finished = [row for cell in self.cells() for row in results.of(self, cell)]
        return [Statement(**each) for row in finished for each in row["rows"]]

    def summarise(self, results: Results) -> Row:
        """See `Study`."""
        from parkenv.studies.verify.rows import CONFIDENCE

        return {"confidence": CONFIDENCE, "rows": [row.columns() for row in self.statements(results)]}

    def outputs(self, result: Result) -> list[Task[object]]:
        """See `Study`: the picture."""
        from parkenv.show.figures.verification import save_verification

        confidence = result.summary["confidence"]
        return [partial(save_verification, result.rows, confidence, result.folder / PICTURE)]
