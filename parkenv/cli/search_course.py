"""The course in which `parkenv train` teaches to search."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from parkenv.cli import arguments as args
from parkenv.cli.training_course import (
    EXAMINED_FROM,
    FIGURE,
    TESTED_FROM,
    Course,
    Row,
    name_of,
    print_tests,
    row_of,
)
from parkenv.scenarios.build import make_scenario

if TYPE_CHECKING:
    from parkenv.evaluation.experiments.workers import Workers
    from parkenv.evaluation.training.search_training import SearchTraining
    from parkenv.world.scenario import Scenario

SHOWN_FROM = 5_000_000
"""First seed of the worlds in which a planner shows what to imitate."""


@dataclass(eq=False)
class SearchCourse(Course):
    """Searches in some scenarios.

    Args:
        algorithm: by name.
        scenario, test_on: names of scenarios, divided by commas, to train and to test in; None to test in the same.
        steps: decisions of a training.
        imitate: name of a planner to begin by imitating, or None.
        shown: searches of it.
        k: slots that an observation tells of.
        examine_every: decisions between examinations.
        examined_on: searches an examination; the test has twice as many.
        planners: names, divided by commas, or none.
    """

    algorithm: str
    scenario: str
    test_on: str | None
    steps: int
    imitate: str | None
    shown: int
    k: int
    examine_every: int
    examined_on: int
    planners: str

    @property
    def folder(self) -> str:
        """See `Course`."""
        return self.algorithm

    def recipe(self) -> Any:
        """See `Course`."""
        from parkenv.evaluation.training.configs import SEARCH_CONFIGS, config_of

        return config_of(self.algorithm, SEARCH_CONFIGS, "search")

    @cached_property
    def worlds(self) -> list[Scenario]:
        """Where it is trained."""
        return [make_scenario(name) for name in args.words("--scenario", self.scenario)]

    @cached_property
    def tested(self) -> list[Scenario]:
        """Where it is tested."""
        return [make_scenario(name) for name in args.words("--test-on", self.test_on or self.scenario)]

    @property
    def examined(self) -> range:
        """Seeds of the worlds of the examinations."""
        return range(EXAMINED_FROM, EXAMINED_FROM + self.examined_on)

    @property
    def compared(self) -> list[str]:
        """Planners that are drawn for comparison."""
        return [] if self.planners == "none" else args.words("--planners", self.planners)

    def check(self) -> None:
        """See `Course`."""
        from parkenv.evaluation.training.cloning import require_imitable
        from planners.agent import make_agent

        super().check()
        if self.imitate is not None:
            require_imitable(self.algorithm, self.imitate, self.worlds[0])
        for world in (self.worlds[0], *self.tested):
            for name in self.compared:
                make_agent(name, world)

    def settings(self) -> Row:
        """See `Course`."""
        return {
            "algorithm": self.algorithm, "scenario": [w.name for w in self.worlds], "steps": self.steps,
            "imitate": self.imitate, "shown": self.shown if self.imitate else None, "k": self.k,
            "examine_every": self.examine_every, "examined_on": self.examined_on,
        }  # fmt: skip

    def examination(self, settings: Row) -> Row:
        """See `Course`."""
        first, *_ = settings.get("scenario") or [None]
        return {"scenario": first, "examined_on": settings.get("examined_on")}

    @property
    def measures(self) -> tuple[str, ...]:
        """See `Course`."""
        return ("total_s",)

    def training(self, console: Console) -> SearchTraining:
        """See `Course`."""
        from parkenv.evaluation.training.search_training import SearchTraining

        demonstrations = None
        if self.imitate is not None:
            from parkenv.evaluation.training.cloning import Demonstrations

            with console.status(f"Watching {self.imitate} search {self.shown} times"):
                demonstrations = Demonstrations.collect(
                    self.imitate, self.worlds[0], range(SHOWN_FROM, SHOWN_FROM + self.shown), self.k
                )
        return SearchTraining(
            self.algorithm, self.steps, self.examine_every, tuple(self.worlds), self.examined, self.k, demonstrations
        )  # fmt: skip

    def told(self, row: Row) -> str:
        """See `Course`."""
        return f"{row['total_s']:.1f} s"

    def report(
        self,
        console: Console,
        workers: Workers,
        curves: list[list[Row]],
        models: dict[int, Path],
        out: Path,
        beside: dict[str, list[list[Row]]],
    ) -> Row:
        """See `Course`."""
        from parkenv.evaluation.figures.learning_curves import across_seeds, save_learning_curves
        from parkenv.evaluation.training.search_training import search_times
        from planners.learned import LearnedAgent

        at_test = range(TESTED_FROM, TESTED_FROM + 2 * self.examined_on)
        lines, tables = _planner_times(
            console, workers, self.compared, self.worlds[0], self.tested, self.examined, at_test
        )
        rows, transfer = [], []
        with console.status("Testing"):
            for (number, model), curve in zip(models.items(), curves, strict=True):
                for world in self.tested:
                    row = search_times(LearnedAgent(world, self.algorithm, model), world, at_test)
                    transfer.append(
                        {"agent": self.algorithm, "seed": number, "test_scenario": world.name, **row}
                    )
                tested = transfer[-len(self.tested)]
                own = {c: tested[c] for c in ("total_s", "total_s_ci95")}
                rows.append(row_of(self.algorithm, tested["test_scenario"], number, curve, own, model))
        title = f"{self.worlds[0].name}: {self.examined_on} searches in worlds that were not trained on"
        save_learning_curves({name_of(self.settings()): curves, **beside}, lines, title, out / FIGURE)
        print_tests(
            console,
            "Mean total time, s, in worlds of no examination",
            self.algorithm,
            transfer,
            tables,
            _interval,
        )
        return {
            "rows": rows, "transfer": transfer, "planners": tables, "examined": lines, "curve": across_seeds(curves),
            "beside": {name: across_seeds(its) for name, its in beside.items()},
        }  # fmt: skip


def _planner_times(
    console: Console,
    workers: Workers,
    names: Sequence[str],
    first: Any,
    tested: Sequence[Any],
    examined: range,
    at_test: range,
) -> tuple[dict[str, float], list[Row]]:
    """Mean times of planners in the worlds of the examinations, and rows of those of the test."""
    from parkenv.evaluation.experiments.compare import rows_of

    if not names:
        return {}, []
    with console.status("Planners search in the same worlds"):
        rows = rows_of(names, first, examined, workers)
        tables = [row for world in tested for row in rows_of(names, world, at_test, workers)]
    lines = {row["agent"]: row["total_s"] for row in rows}
    return {**lines, "clairvoyant bound": rows[0]["bound_s"]}, tables


def _interval(row: Row) -> str:
    low, high = row["total_s_ci95"]
    return f"{row['total_s']:.1f} [{low:.1f}, {high:.1f}]"
