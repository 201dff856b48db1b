"""Run the cases of a verification, and write its results."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from importlib import import_module

from parkenv.errors import InputError, nearest
from parkenv.files.known_names import VERIFY_CASES
from parkenv.studies.verify.rows import Row, Task
from parkenv.studies.workers import Workers


def tasks_of(cases: Sequence[str], seed: int) -> dict[str, list[Task]]:
    """Return the tasks of some cases.

    Raises:
        InputError: an unknown case; the message lists the known ones.
    """
    for case in cases:
        if case not in VERIFY_CASES:
            raise InputError(f"--cases: there is no case {case!r}; {nearest(case, VERIFY_CASES)}")
    return {case: import_module(f"parkenv.studies.verify.{case}").tasks(seed) for case in cases}


def verify(
    tasks: dict[str, list[Task]], workers: Workers, on_progress: Callable[[], None] = lambda: None
) -> Iterator[tuple[str, list[Row]]]:
    """Yield the rows of each case, in order, as soon as they are complete.

    Args:
        tasks: from `tasks_of`.
        workers: where they run; the results do not depend on it.
        on_progress: called after each task.
    """
    made = workers.in_order([task for of_case in tasks.values() for task in of_case])
    for case, of_case in tasks.items():
        rows: list[Row] = []
        for _ in of_case:
            rows += next(made)
            on_progress()
        yield case, rows
