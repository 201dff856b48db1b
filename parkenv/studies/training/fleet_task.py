"""Training of one network for all cars of a fleet by `parkenv train --env fleet`."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from pathlib import Path

from parkenv.engine.fleet_rules import RULES
from parkenv.errors import InputError
from parkenv.scenarios.build import build
from parkenv.show.figures.learning_curves import save_learning_curves
from parkenv.show.plurals import plural
from parkenv.studies.agent_spec import AgentSpec
from parkenv.studies.fleet.drivers import MixedFleet, demand_in, driver_of
from parkenv.studies.training.configs import FLEET_CONFIGS, config_of
from parkenv.studies.training.curve_file import across_seeds
from parkenv.studies.training.fleet_training import FleetTraining
from parkenv.studies.training.spec import FleetTrainingSpec
from parkenv.studies.training.training_task import (
    EVALUATION_SEED,
    TEST_SEED,
    Row,
    Status,
    Table,
    Trained,
    TrainingTask,
    row_of,
    table_of_tests,
)
from parkenv.studies.workers import Workers
from parkenv.world.scenario import Scenario

FEW = 0.1
"""Share of the cars that a model drives in tests among other agents."""


class FleetTask(TrainingTask):
    """Training in one fleet."""

    prefix = "fleet-"
    spec: FleetTrainingSpec

    def __init__(self, spec: FleetTrainingSpec) -> None:
        super().__init__(spec)
        self.steps, self.k, self.compared, self.test_among = spec.steps, spec.k, spec.agents, spec.test_among
        self.evaluate_every = spec.evaluate_every or max(1, self.steps // 10)

    @cached_property
    def scenario(self) -> Scenario:
        """The scenario to train in."""
        if len(self.scenarios) != 1:
            raise InputError(f"--scenario names {len(self.scenarios)} scenarios, want one with --env fleet")
        return build(self.scenarios[0])

    @cached_property
    def fleet(self) -> MixedFleet:
        """The fleet to train in."""
        spec = self.spec
        demand = demand_in(self.scenario, spec.arrivals_per_hour, spec.stay_s, spec.patience_s)
        share = 1.0 if spec.among is None else spec.learners or FEW
        return MixedFleet(self.scenario, demand, spec.knows, share, spec.among)

    @cached_property
    def tests(self) -> list[MixedFleet]:
        """The fleets of the tests in the end: that of the training, every car, and few among others."""
        whole = replace(self.fleet, share=1.0, among=None)
        few = [replace(self.fleet, share=FEW, among=agent) for agent in self.test_among]
        return list(dict.fromkeys([self.fleet, whole, *few]))

    @property
    def measures(self) -> tuple[str, ...]:
        """See `TrainingTask`."""
        return ("total_s",)

    def check(self) -> None:
        """See `TrainingTask`."""
        config_of(self.algorithm, FLEET_CONFIGS, "fleet")
        super().check()
        if self.spec.among is not None and driver_of(self.spec.among, self.scenario)[0] is None:
            raise InputError(
                f"--among is {self.spec.among.label!r}, want a compiled driver: {', '.join(RULES)}, or a model"
            )
        for agent in (*self.compared, *self.test_among):
            driver_of(agent, self.scenario)
        _ = self.fleet

    def settings(self) -> Row:
        """See `TrainingTask`."""
        return {
            **super().settings(), "env": "fleet", "scenario": [self.scenario.name], "steps": self.steps,
            "evaluate_every": self.evaluate_every, "k": self.k, "fleet": self.fleet.name,
            "knows": self.fleet.knows, "demand": str(self.fleet.demand),
        }  # fmt: skip

    def evaluation_settings(self, settings: Row) -> Row:
        """See `TrainingTask`."""
        names = ("env", "scenario", "fleet", "demand", "evaluation_episodes")
        return {name: settings.get(name) for name in names}

    def training(self, status: Status) -> FleetTraining:
        """See `TrainingTask`."""
        del status
        return FleetTraining(
            self.algorithm, self.steps, self.evaluate_every, self.fleet, EVALUATION_SEED,
            self.evaluation_episodes, self.k,
        )  # fmt: skip

    def score_text(self, row: Row) -> str:
        """See `TrainingTask`."""
        return f"{row['total_s']:.1f} s"

    def report(self, status: Status, workers: Workers, trained: Trained, figure: Path) -> tuple[Row, Table]:
        """See `TrainingTask`."""
        days = self.evaluation_episodes
        lines: dict[str, float] = {}
        planners: list[Row] = []
        for agent in self.compared:
            with status(f"{agent.label} drives on the same days"):
                lines[agent.label] = self.fleet.row(agent, EVALUATION_SEED, days, workers)["total_s"]
                for fleet in self.tests:
                    row = fleet.row(agent, TEST_SEED, 2 * days, workers)
                    planners.append({"agent": agent.label, "scenario": fleet.name, **row})
        rows, transfer = [], []
        with status("Testing"):
            for (number, model), curve in zip(trained.models.items(), trained.curves, strict=True):
                member = AgentSpec(name=f"{self.algorithm}:{model}")
                for fleet in self.tests:
                    row = fleet.row(member, TEST_SEED, 2 * days, workers)
                    test = {"agent": self.algorithm, "seed": number, "test_scenario": fleet.name}
                    transfer.append(test | row)
                main = transfer[-len(self.tests)]
                own = {c: main[c] for c in ("total_s", "total_s_ci95", "search_s")}
                rows.append(row_of(self.algorithm, self.scenario.name, number, curve, own, model))
        rate = self.spec.arrivals_per_hour
        title = (
            f"{self.scenario.name}, {rate:g} cars an hour, {self.fleet.name}: {plural(days, 'held-out day')}"
        )
        curves = {self.algorithm: trained.curves} | trained.beside
        means = {name: across_seeds(its) for name, its in curves.items()}
        save_learning_curves(curves, means, lines, title, figure)
        heading = (
            f"Mean total time, s, of a driver's cars and [of the others], {plural(2 * days, 'held-out day')}"
        )
        return {
            "rows": rows, "transfer": transfer, "planners": planners, "evaluated": lines,
            "curve": means[self.algorithm],
            "beside": {name: means[name] for name in trained.beside},
        }, table_of_tests(heading, self.algorithm, transfer, planners, _times)  # fmt: skip


def _times(row: Row) -> str:
    low, high = row["total_s_ci95"]
    others = "" if row["others_s"] != row["others_s"] else f"; others {row['others_s']:.1f}"
    return f"{row['total_s']:.1f} [{low:.1f}, {high:.1f}]{others}"
