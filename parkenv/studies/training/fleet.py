"""Training in a fleet: one network for all cars; the score is the mean total time of those that it drives."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env.base_vec_env import VecEnv

from parkenv.engine.fleet import DriverKind
from parkenv.envs.fleet_vector import FleetVectorEnv, network_policy
from parkenv.envs.sb3 import BatchVecEnv
from parkenv.errors import InputError
from parkenv.scenarios.build import build
from parkenv.show.plurals import plural
from parkenv.studies.agent_spec import AgentSpec
from parkenv.studies.fleet.drivers import MixedFleet, demand_in, policy_of
from parkenv.studies.training.configs import FLEET_CONFIGS, REWARD_SCALE
from parkenv.studies.training.curve_file import Row
from parkenv.studies.training.learning import RLTraining
from parkenv.studies.training.spec import FleetTrainingSpec
from parkenv.studies.training.training import EVALUATION_SEED, TEST_SEED, Tested
from parkenv.studies.workers import Workers
from parkenv.world.scenario import Scenario

FEW = 0.1
"""Share of the cars that a model drives in tests among other agents."""


class FleetTraining(RLTraining):
    """Training of one network that drives all cars of a fleet, or a share of them."""

    spec: FleetTrainingSpec
    evaluated_by = ("env", "scenario", "fleet", "demand", "evaluation_episodes")
    configs = FLEET_CONFIGS

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
    def tests(self) -> dict[str, MixedFleet]:
        """See `Training`: the fleet of the training, every car, and few among others."""
        whole = replace(self.fleet, share=1.0, among=None)
        few = [replace(self.fleet, share=FEW, among=agent) for agent in self.spec.test_among]
        return {fleet.name: fleet for fleet in (self.fleet, whole, *few)}

    @property
    def compared(self) -> tuple[AgentSpec, ...]:
        """See `Training`."""
        return self.spec.agents

    @property
    def measures(self) -> tuple[str, ...]:
        """See `Training`."""
        return ("total_s",)

    def check(self) -> None:
        """See `Training`."""
        super().check()
        among = self.spec.among
        if among is not None and policy_of(among, self.scenario)[0] is None:
            raise InputError(f"--among is {among.label!r}, want a compiled policy: X, or a model")
        for agent in (*self.spec.agents, *self.spec.test_among):
            policy_of(agent, self.scenario)
        _ = self.fleet

    def settings(self) -> Row:
        """See `Training`."""
        return super().settings() | {
            "scenario": [self.scenario.name], "fleet": self.fleet.name, "demand": str(self.fleet.demand),
        }  # fmt: skip

    @property
    def metrics(self) -> tuple[str, ...]:
        """Mean total time, s, its 95 % interval over days, fraction of cars that parked, search time, s."""
        return ("total_s", "low_s", "high_s", "parked_fraction", "search_s")

    def make_env(self) -> BatchVecEnv:
        """Make the worlds."""
        fleet = self.fleet
        kinds = [DriverKind(fleet.share, None, fleet.knows, shares=fleet.knows == "shared")]
        if fleet.among is not None:
            kinds.append(DriverKind(1.0 - fleet.share, policy_of(fleet.among, fleet.scenario)[0]))
        worlds = FleetVectorEnv(
            self.config.n_envs, fleet.scenario, fleet.demand, kinds, self.spec.k, fleet.max_steps, leave_full_lot=False
        )  # fmt: skip
        return BatchVecEnv(worlds, REWARD_SCALE)

    def connect(self, model: Any) -> None:
        """Let the other cars of the worlds follow the model's policy."""
        model.env.batch.follow(model.policy)

    def before_rollout(self, model: Any) -> None:
        """Hand the current weights to the other cars."""
        model.env.batch.follow(model.policy)

    def before_checkpoint(self, model: Any) -> None:
        """Begin all worlds anew: a checkpoint then needs no more than the numbers of their days."""
        model._last_obs = model.env.reset()
        model._last_episode_starts = np.ones(model.n_envs, dtype=np.bool_)

    def evaluate(self, policy: Any, env: VecEnv) -> Row:
        """Run the held-out days."""
        del env
        row = self.fleet.row(
            network_policy(policy, self.spec.k, sampled=True), EVALUATION_SEED, self.evaluation_episodes
        )
        low, high = row["total_s_ci95"]
        found = (row["total_s"], low, high, row["parked_fraction"], row["search_s"])
        return dict(zip(self.metrics, found, strict=True))

    def description(self) -> dict[str, Any]:
        """Return scenario and settings for the model file."""
        fleet = self.fleet
        settings = self.settings_of_model(fleet=fleet.name, knows=fleet.knows, demand=str(fleet.demand))
        return {"scenarios": [fleet.scenario.name], "settings": settings}

    def evaluate_planners(self, workers: Workers) -> dict[str, float]:
        """See `Training`."""
        days = self.evaluation_episodes
        return {
            agent.label: self.fleet.row(agent, EVALUATION_SEED, days, workers)["total_s"]
            for agent in self.compared
        }

    def test_planners(self, name: str, workers: Workers) -> list[Row]:
        """See `Training`."""
        test, days = self.tests[name], len(self.test_seeds)
        return [
            {"agent": agent.label, "scenario": name, **test.row(agent, TEST_SEED, days, workers)}
            for agent in self.compared
        ]

    def test(self, model: Path, workers: Workers) -> Tested:
        """See `Training`."""
        member, days = AgentSpec(name=f"{self.algorithm}:{model}"), len(self.test_seeds)
        transfer = [
            {"test_scenario": name, **test.row(member, TEST_SEED, days, workers)}
            for name, test in self.tests.items()
        ]
        own = {c: transfer[0][c] for c in ("total_s", "total_s_ci95", "search_s")}
        return Tested(self.scenario.name, own, transfer)

    @property
    def title(self) -> str:
        """See `Training`."""
        rate, days = self.spec.arrivals_per_hour, plural(self.evaluation_episodes, "held-out day")
        return f"{self.scenario.name}, {rate:g} cars an hour, {self.fleet.name}: {days}"
