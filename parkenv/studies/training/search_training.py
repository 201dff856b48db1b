"""Training for `parkenv/Search-v2`: the score is the mean total time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from stable_baselines3.common.vec_env.base_vec_env import VecEnv

from parkenv.envs.sb3 import SearchVecEnv, search_batch
from parkenv.scenarios.places import by_size, open_places
from parkenv.studies.simulate import charge_truncation
from parkenv.studies.statistics import mean_interval
from parkenv.studies.training.cloning import Demonstrations, clone, require_cloneable
from parkenv.studies.training.configs import (
    MAX_STEPS,
    REWARD_SCALE,
    SCAN_CONFIGS,
    SEARCH_CONFIGS,
    TrainingConfig,
    config_of,
)
from parkenv.studies.training.curve_file import Row
from parkenv.studies.training.rl_training import Training
from parkenv.world.scenario import Scenario
from planners.learned import LearnedAgent
from planners.model_file import SEARCH_OBSERVATIONS, observation_of

METRICS = ("total_s", "low_s", "high_s", "parked_fraction")
HELD_OUT = ("held_out_s", "held_out_low_s", "held_out_high_s", "held_out_parked_fraction")


@dataclass(frozen=True, eq=False)
class SearchTraining(Training):
    """Training of a search agent; its score is the mean total time.

    Args:
        algorithm: one of `SEARCH_CONFIGS`.
        steps: decisions in total.
        evaluate_every: decisions between evaluations.
        scenarios: scenarios to train on; each search is in one of them, drawn from its seed.
        evaluation_seeds: seeds of the held-out worlds; each draws one of the scenarios.
        k: number of slots in the observation, or of scans; None for the default.
        demonstrations: demonstrations to clone before training; None for no cloning.
        held_out: further places to evaluate in. They do not decide which model is kept.
        curriculum: `size`: begin in the smallest lots; see `parkenv.scenarios.places.open_places`.
        observation: `local` or, in one scenario, `scan`.

    Raises:
        InputError: an unknown algorithm, one that does not support behaviour cloning, or a number out of range.
    """

    scenarios: tuple[Scenario, ...]
    evaluation_seeds: range
    k: int | None = None
    demonstrations: Demonstrations | None = None
    held_out: tuple[Scenario, ...] = ()
    curriculum: str | None = None
    observation: str = "local"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.demonstrations is not None:
            require_cloneable(self.algorithm, self.demonstrations.agent, self.scenarios[0])

    @property
    def config(self) -> TrainingConfig:
        """Training config of the algorithm."""
        return search_config(self.algorithm, self.observation)

    @property
    def metrics(self) -> tuple[str, ...]:
        """Mean total time, s, its 95 % interval, and the fraction of episodes that ended parked; also held out."""
        return METRICS + (HELD_OUT if self.held_out else ())

    def make_env(self) -> SearchVecEnv:
        """Make a batch of search environments over all scenarios."""
        places = self.scenarios if self.curriculum is None else by_size(self.scenarios)
        env = SearchVecEnv(self.config.n_envs, places, REWARD_SCALE, self.k, self.observation, MAX_STEPS)
        self._open_places(env, 0.0)
        return env

    def before_rollout(self, model: Any) -> None:
        """Add the places that the curriculum has come to."""
        self._open_places(model.env, model.num_timesteps / self.steps)

    def _open_places(self, env: SearchVecEnv, progress: float) -> None:
        if self.curriculum is not None:
            env.batch.n_places = open_places(len(self.scenarios), progress)

    def evaluate(self, policy: Any, env: VecEnv) -> Row:
        """Run one episode in each held-out world, in the places trained on and in those held out."""
        del env
        found: list[float] = []
        for places in (self.scenarios, self.held_out) if self.held_out else (self.scenarios,):
            times, parked = episode_times(policy, places, self.evaluation_seeds)
            found += [*mean_interval(times), float(parked.mean())]
        return dict(zip(self.metrics, found, strict=True))

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
        settings["curriculum"] = self.curriculum
        names = [scenario.name for scenario in self.scenarios]
        return {"scenarios": names, "held_out": [one.name for one in self.held_out], "settings": settings}


def search_config(algorithm: str, observation: str) -> TrainingConfig:
    """Return the training config of an algorithm for searches with an observation.

    Raises:
        InputError: there is none.
    """
    if observation == "scan":
        return config_of(algorithm, SCAN_CONFIGS, "searches on scans")
    return config_of(algorithm, SEARCH_CONFIGS, "search")


def search_times(agent: LearnedAgent, places: Scenario | Sequence[Scenario], seeds: Sequence[int]) -> Row:
    """Run a model, and return its total times as columns of `parkenv compare`."""
    return times_row(*episode_times(agent.model, places, seeds))


def times_row(times: NDArray[np.float64], parked: NDArray[np.bool_]) -> Row:
    """Return the total times of episodes as columns of `parkenv compare`."""
    mean, low, high = mean_interval(times)
    return {
        "episodes": len(times),
        "parked_fraction": float(parked.mean()),
        "total_s": mean,
        "total_s_ci95": [low, high],
    }


def episode_times(
    model: Any, places: Scenario | Sequence[Scenario], seeds: Sequence[int]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Run episodes; return their total times, (n,) s, and whether the car parked, (n,) bool.

    An episode that has not ended after `MAX_STEPS` decisions is charged `give_up_s`, as in `parkenv compare`.

    Args:
        model: a stable-baselines3 or sb3-contrib model of the `local` or the `scan` observation.
        places: scenario to search in; or several, of which each seed draws one.
        seeds: one episode each.
    """
    n = len(seeds)
    _, version, k = observation_of(model.observation_space)
    observation = SEARCH_OBSERVATIONS[version][0]
    batch = search_batch(n, places, observation, k, MAX_STEPS, AutoresetMode.NEXT_STEP)
    seen, _ = batch.reset(seed=list(seeds))
    give_up_s = np.array([scenario.give_up_s for scenario in batch.scenarios])[batch.place_of]
    times, parked = np.full(n, np.nan), np.zeros(n, dtype=np.bool_)
    state, start = None, np.ones(n, dtype=np.bool_)
    masked = "action_masks" in model.predict.__code__.co_varnames
    while np.isnan(times).any():
        masks = {"action_masks": seen["action_mask"]} if masked else {}
        actions, state = model.predict(seen, state=state, episode_start=start, deterministic=True, **masks)
        seen, _, terminated, truncated, info = batch.step(actions)
        start = terminated | truncated
        first = start & np.isnan(times)
        if first.any():
            charge_truncation(info, give_up_s, truncated & ~terminated)
            times[first] = info["total_s"][first]
            parked[first] = info["parked"][first]
    return times, parked
