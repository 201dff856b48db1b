"""The course in which `parkenv train` teaches to drive into slots."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from parkenv.cli import arguments as args
from parkenv.cli.training_course import EXAMINED_FROM, FIGURE, TESTED_FROM, Course, Row, print_tests, row_of
from parkenv.errors import InputError

if TYPE_CHECKING:
    from parkenv.evaluation.experiments.workers import Workers
    from parkenv.evaluation.training.drive_training import DriveTraining
    from parkenv.world.lot import ParkingLot


@dataclass(eq=False)
class DriveCourse(Course):
    """Drives into the slots of some lots.

    Args:
        algorithm: by name.
        lot, test_on: names or files of lots, divided by commas, to train and to test on; None to test on the same.
        asked_steps, asked_every: decisions of a training, and between examinations; None for what the recipe says.
        examined_on: drives into each lot's slots of each kind an examination; the test has twice as many.
        planners: planner or none.
    """

    algorithm: str
    lot: str
    test_on: str | None
    asked_steps: int | None
    asked_every: int | None
    examined_on: int
    planners: str

    @property
    def folder(self) -> str:
        """See `Course`."""
        return f"drive-{self.algorithm}"

    def recipe(self) -> Any:
        """See `Course`."""
        from parkenv.evaluation.training.configs import DRIVE_CONFIGS, config_of

        return config_of(self.algorithm, DRIVE_CONFIGS, "drive")

    @property
    def steps(self) -> int:
        """Decisions of a training."""
        return self.asked_steps or int(self.recipe().steps)

    @property
    def examine_every(self) -> int:
        """Decisions between examinations."""
        return self.asked_every or max(1, self.steps // 20)

    @cached_property
    def lots(self) -> list[ParkingLot]:
        """Where it is trained."""
        from parkenv.lots import load_lot

        return [load_lot(name) for name in args.words("--lot", self.lot)]

    @cached_property
    def tested(self) -> list[ParkingLot]:
        """Where it is tested."""
        from parkenv.lots import load_lot

        return [load_lot(name) for name in args.words("--test-on", self.test_on or self.lot)]

    def check(self) -> None:
        """See `Course`."""
        from parkenv.evaluation.training.drive_training_env import slot_groups
        from planners.driving.parking_agents import PLANNER

        super().check()
        for lots in (self.lots, self.tested):
            slot_groups(lots)
        if self.planners not in (PLANNER, "none"):
            raise InputError(f"--planners is {self.planners!r}, want {PLANNER} or none with --env drive")

    def settings(self) -> Row:
        """See `Course`."""
        return {
            "algorithm": self.algorithm, "env": "drive", "lot": [lot.name for lot in self.lots], "steps": self.steps,
            "examine_every": self.examine_every, "examined_on": self.examined_on,
        }  # fmt: skip

    def examination(self, settings: Row) -> Row:
        """See `Course`."""
        return {name: settings.get(name) for name in ("env", "lot", "examined_on")}

    @property
    def measures(self) -> tuple[str, ...]:
        """See `Course`."""
        from parkenv.evaluation.training.drive_training_env import slot_groups

        return tuple(f"{group.kind}_success" for group in slot_groups(self.lots))

    def training(self, console: Console) -> DriveTraining:
        """See `Course`."""
        del console
        from parkenv.evaluation.training.drive_training import DriveTraining

        examined = range(EXAMINED_FROM, EXAMINED_FROM + self.examined_on)
        return DriveTraining(self.algorithm, self.steps, self.examine_every, tuple(self.lots), examined)

    def told(self, row: Row) -> str:
        """See `Course`."""
        return f"{row['success']:.0%} parked"

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
        from parkenv.evaluation.figures.learning_curves import across_seeds, save_success_curves
        from parkenv.evaluation.training.drive_training import parked_on
        from parkenv.evaluation.trips.parking_runs import parking_table
        from planners.driving.parking_agents import PLANNER

        examined = range(EXAMINED_FROM, EXAMINED_FROM + self.examined_on)
        at_test = range(TESTED_FROM, TESTED_FROM + 2 * self.examined_on)
        names = " and ".join(lot.name for lot in self.lots)
        lines: dict[str, float] = {}
        tables: list[Row] = []
        if self.planners != "none":
            with console.status("The planner parks in the same tasks"):
                parkings = parked_on(self.lots, examined, workers, PLANNER)
                lines = {row["kind"]: row["success"] for row in parking_table(parkings)}
                for lot in self.tested:
                    table = parking_table(parked_on([lot], at_test, workers, PLANNER))
                    tables += [{"agent": PLANNER, "scenario": lot.name, **row} for row in table]
        rows, transfer = [], []
        with console.status("Testing"):
            for (number, model), curve in zip(models.items(), curves, strict=True):
                parkings = []
                for lot in self.tested:
                    some = parked_on([lot], at_test, workers, f"{self.algorithm}:{model}")
                    parkings += some
                    transfer += [
                        {"agent": self.algorithm, "seed": number, "test_scenario": lot.name, **row}
                        for row in parking_table(some)
                    ]
                tested = parking_table(parkings)[-1]
                own = {c: tested[c] for c in ("success", "success_ci95", "contacts", "time_s")}
                rows.append(
                    row_of(
                        self.algorithm, ",".join(lot.name for lot in self.tested), number, curve, own, model
                    )
                )
        kinds = [name.removesuffix("_success") for name in curves[0][0] if name.endswith("_success")]
        title = f"{names}: {self.examined_on} parkings of each kind that were not trained on"
        save_success_curves({self.algorithm: curves, **beside}, kinds, lines, title, out / FIGURE)
        heading = "Parkings that succeed, contacts, median s of those, in tasks of no examination"
        print_tests(console, heading, self.algorithm, transfer, tables, _parkings, "kind")
        return {
            "rows": rows, "transfer": transfer, "planners": tables, "examined": lines,
            "curve": {kind: across_seeds(curves, f"{kind}_success") for kind in kinds},
            "beside": {
                name: {kind: across_seeds(its, f"{kind}_success") for kind in kinds} for name, its in beside.items()
            },
        }  # fmt: skip


def _parkings(row: Row) -> str:
    low, high = row["success_ci95"]
    return f"{row['success']:.1%} [{low:.1%}, {high:.1%}], {row['contacts']}, {row['time_s']:.1f}"
