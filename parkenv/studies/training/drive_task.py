"""Training of parking agents by `parkenv train --env drive`."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

from parkenv.scenarios.build import build
from parkenv.show.figures.learning_curves import save_success_curves
from parkenv.studies.training.configs import DRIVE_CONFIGS, config_of
from parkenv.studies.training.curve_file import across_seeds
from parkenv.studies.training.drive_training import DriveTraining, parked_on
from parkenv.studies.training.drive_training_env import slot_groups
from parkenv.studies.training.spec import DriveTrainingSpec
from parkenv.studies.training.training_task import (
    Row,
    Status,
    Table,
    Trained,
    TrainingTask,
    row_of,
    table_of_tests,
)
from parkenv.studies.trips.parking_runs import parking_table
from parkenv.studies.workers import Workers
from parkenv.world.lot import ParkingLot
from planners.names import PARKING_PLANNER


class DriveTask(TrainingTask):
    """Training of parking agents on the lots of some scenarios."""

    prefix = "drive-"
    spec: DriveTrainingSpec

    def __init__(self, spec: DriveTrainingSpec) -> None:
        super().__init__(spec)
        self.steps = spec.steps or int(config_of(self.algorithm, DRIVE_CONFIGS, "drive").steps)
        self.evaluate_every = spec.evaluate_every or max(1, self.steps // 20)

    @cached_property
    def lots(self) -> list[ParkingLot]:
        """Lots to train on."""
        return [build(scenario).lot for scenario in self.scenarios]

    @cached_property
    def tested(self) -> list[ParkingLot]:
        """Lots to test on."""
        return [build(scenario).lot for scenario in self.spec.test_on or self.scenarios]

    def check(self) -> None:
        """See `TrainingTask`."""
        config_of(self.algorithm, DRIVE_CONFIGS, "drive")
        super().check()
        for lots in (self.lots, self.tested):
            slot_groups(lots)

    def settings(self) -> Row:
        """See `TrainingTask`."""
        return {
            **super().settings(), "env": "drive", "lot": [lot.name for lot in self.lots], "steps": self.steps,
            "evaluate_every": self.evaluate_every,
        }  # fmt: skip

    def evaluation_settings(self, settings: Row) -> Row:
        """See `TrainingTask`."""
        return {name: settings.get(name) for name in ("env", "lot", "evaluation_episodes")}

    @property
    def measures(self) -> tuple[str, ...]:
        """See `TrainingTask`."""
        return tuple(f"{group.kind}_success" for group in slot_groups(self.lots))

    def training(self, status: Status) -> DriveTraining:
        """See `TrainingTask`."""
        del status
        return DriveTraining(
            self.algorithm, self.steps, self.evaluate_every, tuple(self.lots), self.evaluation_seeds
        )

    def score_text(self, row: Row) -> str:
        """See `TrainingTask`."""
        return f"{row['success']:.0%} parked"

    def report(self, status: Status, workers: Workers, trained: Trained, figure: Path) -> tuple[Row, Table]:
        """See `TrainingTask`."""
        lines: dict[str, float] = {}
        planners: list[Row] = []
        if self.spec.agents:
            with status("The planner parks in the same tasks"):
                parkings = parked_on(self.lots, self.evaluation_seeds, workers, PARKING_PLANNER)
                lines = {row["kind"]: row["success"] for row in parking_table(parkings)}
                for lot in self.tested:
                    table = parking_table(parked_on([lot], self.test_seeds, workers, PARKING_PLANNER))
                    planners += [{"agent": PARKING_PLANNER, "scenario": lot.name, **row} for row in table]
        rows, transfer = [], []
        names = ",".join(lot.name for lot in self.tested)
        with status("Testing"):
            for (number, model), curve in zip(trained.models.items(), trained.curves, strict=True):
                parkings = []
                for lot in self.tested:
                    some = parked_on([lot], self.test_seeds, workers, f"{self.algorithm}:{model}")
                    parkings += some
                    its = {"agent": self.algorithm, "seed": number, "test_scenario": lot.name}
                    transfer += [its | row for row in parking_table(some)]
                total = parking_table(parkings)[-1]
                own = {c: total[c] for c in ("success", "success_ci95", "contacts", "time_s")}
                rows.append(row_of(self.algorithm, names, number, curve, own, model))
        kinds = [n.removesuffix("_success") for n in trained.curves[0][0] if n.endswith("_success")]
        lots = " and ".join(lot.name for lot in self.lots)
        title = f"{lots}: {self.evaluation_episodes} parkings of each kind in held-out tasks"
        curves = {self.algorithm: trained.curves, **trained.beside}
        means = {
            name: {kind: across_seeds(its, f"{kind}_success") for kind in kinds}
            for name, its in curves.items()
        }
        save_success_curves(curves, means, lines, title, figure)

        heading = "Parkings that succeed, contacts, median s of those, in held-out tasks"
        return {
            "rows": rows, "transfer": transfer, "planners": planners, "evaluated": lines,
            "curve": means[self.algorithm],
            "beside": {name: means[name] for name in trained.beside},
        }, table_of_tests(heading, self.algorithm, transfer, planners, _parkings, "kind")  # fmt: skip


def _parkings(row: Row) -> str:
    low, high = row["success_ci95"]
    return f"{row['success']:.1%} [{low:.1%}, {high:.1%}], {row['contacts']}, {row['time_s']:.1f}"
