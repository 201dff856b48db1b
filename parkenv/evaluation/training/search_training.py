"""Training for `parkenv/Search-v1`: total time counts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from stable_baselines3.common.vec_env.base_vec_env import VecEnv

from parkenv import __version__
from parkenv.envs.search_sb3 import SearchVecEnv
from parkenv.envs.search_vector import ParkSearchVectorEnv
from parkenv.evaluation.experiments.statistics import mean_interval
from parkenv.evaluation.simulate import charge_truncation
from parkenv.evaluation.training.cloning import Demonstrations, clone, require_imitable
from parkenv.evaluation.training.configs import MAX_STEPS, RECIPES, REWARD_SCALE, Recipe, recipe_of
from parkenv.evaluation.training.rl_training import Row, Training
from parkenv.world.scenario import Scenario
from planners.learned import OBSERVATION, LearnedAgent, ModelCard


@dataclass(frozen=True, eq=False)
class SearchTraining(Training):
    """Learning to search.

    Args:
        algorithm: one of `RECIPES`.
        steps: decisions to make.
        examine_every: decisions between examinations.
        scenarios: worlds to learn in, in turns.
        examined_on: seeds of the worlds of the examinations, of the first scenario.
        k: slots that the observation tells of.
        demonstrations: to imitate first; None to begin from nothing.

    Raises:
        InputError: an unknown algorithm, one that cannot imitate, or a number out of its range.
    """

    scenarios: tuple[Scenario, ...]
    examined_on: range
    k: int = 5
    demonstrations: Demonstrations | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.demonstrations is not None:
            require_imitable(self.algorithm, self.demonstrations.agent, self.scenarios[0])

    @property
    def recipe(self) -> Recipe:
        """Settings of the algorithm."""
        return recipe_of(self.algorithm, RECIPES, "search")

    @property
    def scores(self) -> tuple[str, ...]:
        """Mean total time, s, its 95 % interval, and the share of the searches that ended in a slot."""
        return ("total_s", "low_s", "high_s", "parked_fraction")

    def practice(self, seed: int, curve: Sequence[Row]) -> VecEnv:
        """Searches in all scenarios."""
        del curve
        env = SearchVecEnv(
            self.recipe.n_envs, self.scenarios, REWARD_SCALE, self.k, max_episode_steps=MAX_STEPS
        )
        env.seed(seed)
        return env

    def examine(self, model: Any, practice: VecEnv) -> Row:
        """Search in the examination's worlds."""
        del practice
        times, parked = examined(model, self.scenarios[0], self.examined_on, self.k)
        return dict(zip(self.scores, (*mean_interval(times), float(parked.mean())), strict=True))

    def merit(self, row: Row) -> tuple[float, ...]:
        """The less time, the better."""
        return (-row["total_s"],)

    def prepare(self, model: Any, seed: int) -> None:
        """Imitate, if there is something to imitate."""
        if self.demonstrations is not None:
            clone(model, self.demonstrations, seed)

    def card(self, seed: int, steps: int) -> ModelCard:
        """What the model file is to say."""
        recipe = self.recipe
        settings = {"n_envs": recipe.n_envs, "policy": recipe.policy, **recipe.settings}
        settings["imitated"] = None if self.demonstrations is None else self.demonstrations.agent
        names = tuple(s.name for s in self.scenarios)
        return ModelCard(self.algorithm, names, self.k, OBSERVATION, seed, steps, settings, __version__)


def search_times(agent: LearnedAgent, scenario: Scenario, seeds: Sequence[int]) -> Row:
    """How long the searches of a model take, in the words of `parkenv compare`."""
    times, parked = examined(agent.model, scenario, seeds, agent.local_k)
    mean, low, high = mean_interval(times)
    return {
        "episodes": len(times),
        "parked_fraction": float(parked.mean()),
        "total_s": mean,
        "total_s_ci95": [low, high],
    }


def examined(
    model: Any, scenario: Scenario, seeds: Sequence[int], k: int
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Total times of a model's searches, (n,) s, and whether it parked, (n,) bool.

    A search that is not over after `MAX_STEPS` decisions is charged `give_up_s`, as in `parkenv compare`.

    Args:
        model: of stable-baselines3 or sb3-contrib, over the `local` observation.
        scenario: the world.
        seeds: a search for each.
        k: slots that the observation tells of.
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
