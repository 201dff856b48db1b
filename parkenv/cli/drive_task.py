"""Training of parking agents by `parkenv train --env drive`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from parkenv.cli.training_task import (
    EVALUATION_SEED,
    FIGURE,
    TEST_SEED,
    Row,
    TrainingTask,
    print_tests,
    row_of,
    scenario_settings,
)
from parkenv.errors import InputError
from parkenv.scenarios.build import build
from parkenv.scenarios.spec import ScenarioSpec, scenario_spec

if TYPE_CHECKING:
    from rich.console import Console

    from parkenv.evaluation.experiments.workers import Workers
    from parkenv.evaluation.training.drive_training import DriveTraining
    from parkenv.world.lot import ParkingLot


@dataclass(eq=False)
class DriveTask(TrainingTask):
    """Training of parking agents on the lots of some scenarios."""

    @property
    def algorithm(self) -> str:
        """See `TrainingTask`."""
        return self.spec.algorithm or "ppo"

    @property
    def _scenarios(self) -> Sequence[ScenarioSpec]:
        return self.spec.scenarios or (scenario_spec("campus"), scenario_spec("street"))

    @property
    def evaluation_episodes(self) -> int:
        """Episodes per evaluation, lot and kind of slot."""
        return self.spec.evaluation_episodes or 64

    @property
    def folder(self) -> str:
        """See `TrainingTask`."""
        return f"drive-{self.algorithm}"

    def config(self) -> Any:
        """See `TrainingTask`."""
        from parkenv.evaluation.training.configs import DRIVE_CONFIGS, config_of

        return config_of(self.algorithm, DRIVE_CONFIGS, "drive")

    @property
    def steps(self) -> int:
        """Decisions of a training."""
        return self.spec.steps or int(self.config().steps)

    @property
    def evaluate_every(self) -> int:
        """Decisions between evaluations."""
        return self.spec.evaluate_every or max(1, self.steps // 20)

    @cached_property
    def lots(self) -> list[ParkingLot]:
        """Lots to train on."""
        return [build(scenario).lot for scenario in self._scenarios]

    @cached_property
    def tested(self) -> list[ParkingLot]:
        """Lots to test on."""
        return [build(scenario).lot for scenario in self.spec.test_on or self._scenarios]

    def check(self) -> None:
        """See `TrainingTask`."""
        from parkenv.evaluation.training.drive_training_env import slot_groups
        from planners.driving.parking_agents import PLANNER

        super().check()
        for lots in (self.lots, self.tested):
            slot_groups(lots)
        if any(agent.label != PLANNER for agent in self.spec.agents or ()):
            raise InputError(
                f"--agents names other agents than {PLANNER}; with --env drive want {PLANNER} or none"
            )

    def settings(self) -> Row:
        """See `TrainingTask`."""
        return {
            "algorithm": self.algorithm, "env": "drive", "lot": [lot.name for lot in self.lots], "steps": self.steps,
            "evaluate_every": self.evaluate_every, "evaluation_episodes": self.evaluation_episodes,
            **scenario_settings(self._scenarios),
        }  # fmt: skip

    def evaluation_settings(self, settings: Row) -> Row:
        """See `TrainingTask`."""
        return {name: settings.get(name) for name in ("env", "lot", "evaluation_episodes")}

    @property
    def measures(self) -> tuple[str, ...]:
        """See `TrainingTask`."""
        from parkenv.evaluation.training.drive_training_env import slot_groups

        return tuple(f"{group.kind}_success" for group in slot_groups(self.lots))

    def training(self, console: Console) -> DriveTraining:
        """See `TrainingTask`."""
        del console
        from parkenv.evaluation.training.drive_training import DriveTraining

        evaluation_seeds = range(EVALUATION_SEED, EVALUATION_SEED + self.evaluation_episodes)
        return DriveTraining(
            self.algorithm, self.steps, self.evaluate_every, tuple(self.lots), evaluation_seeds
        )

    def score_text(self, row: Row) -> str:
        """See `TrainingTask`."""
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
        """See `TrainingTask`."""
        from parkenv.evaluation.figures.learning_curves import across_seeds, save_success_curves
        from parkenv.evaluation.training.drive_training import parked_on
        from parkenv.evaluation.trips.parking_runs import parking_table
        from planners.driving.parking_agents import PLANNER

        evaluation_seeds = range(EVALUATION_SEED, EVALUATION_SEED + self.evaluation_episodes)
        at_test = range(TEST_SEED, TEST_SEED + 2 * self.evaluation_episodes)
        names = " and ".join(lot.name for lot in self.lots)
        lines: dict[str, float] = {}
        tables: list[Row] = []
        if self.spec.agents is None or self.spec.agents:
            with console.status("The planner parks in the same tasks"):
                parkings = parked_on(self.lots, evaluation_seeds, workers, PLANNER)
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
        title = f"{names}: {self.evaluation_episodes} parkings of each kind in held-out tasks"
        save_success_curves({self.algorithm: curves, **beside}, kinds, lines, title, out / FIGURE)
        heading = "Parkings that succeed, contacts, median s of those, in held-out tasks"
        print_tests(console, heading, self.algorithm, transfer, tables, _parkings, "kind")
        return {
            "rows": rows, "transfer": transfer, "planners": tables, "evaluated": lines,
            "curve": {kind: across_seeds(curves, f"{kind}_success") for kind in kinds},
            "beside": {
                name: {kind: across_seeds(its, f"{kind}_success") for kind in kinds} for name, its in beside.items()
            },
        }  # fmt: skip


def _parkings(row: Row) -> str:
    low, high = row["success_ci95"]
    return f"{row['success']:.1%} [{low:.1%}, {high:.1%}], {row['contacts']}, {row['time_s']:.1f}"
