"""Training in a fleet: one network for all cars; the score is the mean total time of those that it drives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env.base_vec_env import VecEnv

from parkenv.engine.fleet import DriverKind
from parkenv.envs.sb3 import FleetVecEnv, network_rule
from parkenv.studies.fleet.drivers import MixedFleet, driver_of
from parkenv.studies.training.configs import (
    FLEET_CONFIGS,
    REWARD_SCALE,
    TrainingConfig,
    config_of,
)
from parkenv.studies.training.curve_file import Row
from parkenv.studies.training.rl_training import Training


@dataclass(frozen=True, eq=False)
class FleetTraining(Training):
    """Training of one network that drives all cars of a fleet, or a share of them.

    Args:
        algorithm: one of `FLEET_CONFIGS`.
        steps: decisions of the cars that are learned from, in total.
        evaluate_every: decisions between evaluations.
        fleet: lot, demand, and who else drives.
        evaluation_seed: seed of the held-out days.
        days: number of these.
        k: number of slots in the observation.

    Raises:
        InputError: an unknown algorithm, or a number out of range.
    """

    fleet: MixedFleet
    evaluation_seed: int
    days: int
    k: int = 5

    @property
    def config(self) -> TrainingConfig:
        """Training config of the algorithm."""
        return config_of(self.algorithm, FLEET_CONFIGS, "fleet")

    @property
    def metrics(self) -> tuple[str, ...]:
        """Mean total time, s, its 95 % interval over days, fraction of cars that parked, search time, s."""
        return ("total_s", "low_s", "high_s", "parked_fraction", "search_s")

    def make_env(self) -> FleetVecEnv:
        """Make the worlds."""
        fleet = self.fleet
        kinds = [DriverKind(fleet.share, None, fleet.knows, shares=fleet.knows == "shared")]
        if fleet.among is not None:
            kinds.append(DriverKind(1.0 - fleet.share, driver_of(fleet.among, fleet.scenario)[0]))
        return FleetVecEnv(
            self.config.n_envs, fleet.scenario, fleet.demand, kinds, REWARD_SCALE, self.k, fleet.max_steps,
            leave_full_lot=False,
        )  # fmt: skip

    def connect(self, model: Any) -> None:
        """Let the other cars of the worlds follow the model's policy."""
        model.env.follow(model.policy)

    def before_rollout(self, model: Any) -> None:
        """Hand the current weights to the other cars."""
        model.env.follow(model.policy)

    def before_checkpoint(self, model: Any) -> None:
        """Begin all worlds anew: a checkpoint then needs no more than the numbers of their days."""
        model._last_obs = model.env.reset()
        model._last_episode_starts = np.ones(model.n_envs, dtype=np.bool_)

    def evaluate(self, policy: Any, env: VecEnv) -> Row:
        """Run the held-out days."""
        del env
        row = self.fleet.row(network_rule(policy, self.k, sampled=True), self.evaluation_seed, self.days)
        low, high = row["total_s_ci95"]
        found = (row["total_s"], low, high, row["parked_fraction"], row["search_s"])
        return dict(zip(self.metrics, found, strict=True))

    def score(self, row: Row) -> tuple[float, ...]:
        """Return minus the mean total time."""
        return (-row["total_s"],)

    def description(self) -> dict[str, Any]:
        """Return scenario and settings for the model file."""
        config, fleet = self.config, self.fleet
        settings = {"n_envs": config.n_envs, "policy": config.policy, **config.settings}
        settings |= {"fleet": fleet.name, "knows": fleet.knows, "demand": str(fleet.demand)}
        return {"scenarios": [fleet.scenario.name], "settings": settings}
