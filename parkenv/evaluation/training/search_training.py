"""Training for `parkenv/Search-v2`: the score is the mean total time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from stable_baselines3.common.vec_env.base_vec_env import VecEnv

from parkenv.envs.search_sb3 import SearchVecEnv
from parkenv.envs.search_vector import ParkSearchVectorEnv
from parkenv.evaluation.experiments.statistics import mean_interval
from parkenv.evaluation.simulate import charge_truncation
from parkenv.evaluation.training.cloning import Demonstrations, clone, require_cloneable
from parkenv.evaluation.training.configs import (
    MAX_STEPS,
    REWARD_SCALE,
    SEARCH_CONFIGS,
    TrainingConfig,
    config_of,
)
from parkenv.evaluation.training.rl_training import Row, Training
from parkenv.world.scenario import Scenario
from planners.learned import LearnedAgent


@dataclass(frozen=True, eq=False)
class SearchTraining(Training):
    """Training of a search agent; its score is the mean total time.

    Args:
        algorithm: one of `SEARCH_CONFIGS`.
        steps: decisions in total.
        evaluate_every: decisions between evaluations.
        scenarios: scenarios to train on, in rotation.
        evaluation_seeds: seeds of the held-out worlds in the first scenario.
        k: number of slots in the observation.
        demonstrations: demonstrations to clone before training; None for no cloning.

    Raises:
        InputError: an unknown algorithm, one that does not support behaviour cloning, or a number out of range.
    """

    scenarios: tuple[Scenario, ...]
    evaluation_seeds: range
    k: int = 5
    demonstrations: Demonstrations | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.demonstrations is not None:
            require_cloneable(self.algorithm, self.demonstrations.agent, self.scenarios[0])

    @property
    def config(self) -> TrainingConfig:
        """Training config of the algorithm."""
        return config_of(self.algorithm, SEARCH_CONFIGS, "search")

    @property
    def metrics(self) -> tuple[str, ...]:
        """Mean total time, s, its 95 % interval, and the fraction of episodes that ended parked."""
        return ("total_s", "low_s", "high_s", "parked_fraction")

    def make_env(self) -> SearchVecEnv:
        """Make a batch of search environments over all scenarios."""
        return SearchVecEnv(
            self.config.n_envs, self.scenarios, REWARD_SCALE, self.k, max_episode_steps=MAX_STEPS
        )

    def evaluate(self, policy: Any, env: VecEnv) -> Row:
        """Run one episode in each held-out world."""
        del env
        times, parked = episode_times(policy, self.scenarios[0], self.evaluation_seeds, self.k)
        return dict(zip(self.metrics, (*mean_interval(times), float(parked.mean())), strict=True))

    def score(self, row: Row) -> tuple[float, ...]:
        """Return minus the mean total time."""
        return (-row["total_s"],)

    def prepare(self, model: Any, seed: int) -> None:
        """Clone the demonstrations, if any."""
        if self.demonstrations is not None:
            clone(model, self.demonstrations, seed)

    def description(self) -> dict[str, Any]:
        """Return scenarios and settings for the model file."""
        config = self.config
        settings = {"n_envs": config.n_envs, "policy": config.policy, **config.settings}
        settings["clone"] = None if self.demonstrations is None else self.demonstrations.agent
        return {"scenarios": [scenario.name for scenario in self.scenarios], "settings": settings}


def search_times(agent: LearnedAgent, scenario: Scenario, seeds: Sequence[int]) -> Row:
    """Run a model, and return its total times as columns of `parkenv compare`."""
    times, parked = episode_times(agent.model, scenario, seeds, agent.local_k)
    mean, low, high = mean_interval(times)
    return {
        "episodes": len(times),
        "parked_fraction": float(parked.mean()),
        "total_s": mean,
        "total_s_ci95": [low, high],
    }


def episode_times(
    model: Any, scenario: Scenario, seeds: Sequence[int], k: int
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Run episodes; return their total times, (n,) s, and whether the car parked, (n,) bool.

    An episode that has not ended after `MAX_STEPS` decisions is charged `give_up_s`, as in `parkenv compare`.

    Args:
        model: a stable-baselines3 or sb3-contrib model of the `local` observation.
        scenario: scenario to search in.
        seeds: one episode each.
        k: number of slots in the observation.
    """
    n = len(seeds)
    batch = ParkSearchVectorEnv(
        n,
        scenario,
        observation="local",
        k=k,
        max_episode_steps=MAX_STEPS,
        autoreset_mode=AutoresetMode.NEXT_STEP,
    )
    observation, _ = batch.reset(seed=list(seeds))
    times, parked = np.full(n, np.nan), np.zeros(n, dtype=np.bool_)
    state, start = None, np.ones(n, dtype=np.bool_)
    masked = "action_masks" in model.predict.__code__.co_varnames
    while np.isnan(times).any():
        masks = {"action_masks": observation["action_mask"]} if masked else {}
        actions, state = model.predict(
            observation, state=state, episode_start=start, deterministic=True, **masks
        )
        observation, _, terminated, truncated, info = batch.step(actions)
        start = terminated | truncated
        first = start & np.isnan(times)
        if first.any():
            charge_truncation(info, scenario, truncated & ~terminated)
            times[first] = info["total_s"][first]
            parked[first] = info["parked"][first]
    return times, parked
