"""Learning by imitation: a planner's decisions, and a policy that is fitted to them before it learns on its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from parkenv.envs.local_observation import LocalObservation
from parkenv.errors import InputError
from parkenv.evaluation.training.configs import MAX_STEPS, REWARD_SCALE
from parkenv.world.scenario import Scenario
from planners.agent import make_agent
from planners.bounds.oracle import OracleAgent

UPDATES = 3000
"""Steps of the optimizer, enough for a policy that seldom strays from what it was shown."""
IMITATORS = ("ppo", "maskable-ppo")
"""Algorithms whose policies can be fitted to what was shown."""
BATCH = 512
LEARNING_RATE = 1e-3


def require_imitable(algorithm: str, agent: str, scenario: Scenario) -> None:
    """Refuse what cannot be imitated, before it is watched.

    Raises:
        InputError: an algorithm that does not imitate, no such agent, or the oracle.
    """
    if algorithm not in IMITATORS:
        raise InputError(f"{algorithm} cannot begin by imitation; take {' or '.join(IMITATORS)}")
    if isinstance(make_agent(agent, scenario), OracleAgent):
        raise InputError(f"{agent} cannot be imitated: it goes by what nobody can observe")


@dataclass(frozen=True, eq=False)
class Demonstrations:
    """Decisions of a planner.

    Args:
        agent: its name.
        local: (n, 46 + 8k) float32, what `LocalObservation` showed.
        masks: (n, 5) int8, which actions the graph had.
        actions: (n,) int64, what it did.
        times: (n,) float64, s from each decision to the search's end.
    """

    agent: str
    local: NDArray[np.float32]
    masks: NDArray[np.int8]
    actions: NDArray[np.int64]
    times: NDArray[np.float64]

    @classmethod
    def collect(cls, agent: str, scenario: Scenario, seeds: Sequence[int], k: int = 5) -> Demonstrations:
        """Watch an agent search, once for each seed; searches that it cannot finish are left out.

        Raises:
            InputError: it finished none.
        """
        planner = make_agent(agent, scenario)
        env = gym.make("parkenv/Search-v1", scenario=scenario, max_episode_steps=MAX_STEPS)
        around = LocalObservation(env, k)
        local: list[NDArray[np.float32]] = []
        masks: list[NDArray[np.int8]] = []
        actions: list[int] = []
        times: list[NDArray[np.float64]] = []
        for seed in seeds:
            observation, _ = env.reset(seed=seed)
            memory, over, truncated = None, False, False
            rewards: list[float] = []
            first = len(actions)
            while not (over or truncated):
                local.append(around.observation(observation)["local"])
                masks.append(observation["action_mask"])
                action, memory = planner.predict(observation, memory)
                actions.append(int(action))
                observation, reward, over, truncated, _ = env.step(action)
                rewards.append(float(reward))
            if truncated and not over:
                del local[first:], masks[first:], actions[first:]
                continue
            times.append(-np.cumsum(rewards[::-1])[::-1])
        if not times:
            raise InputError(
                f"{agent} finished none of {len(seeds)} searches on {scenario.name}: nothing to imitate"
            )
        return cls(agent, np.stack(local), np.stack(masks), np.array(actions), np.concatenate(times))


def clone(model: OnPolicyAlgorithm, shown: Demonstrations, seed: int, updates: int = UPDATES) -> None:
    """Fit a model's policy to what was shown, and its values to how long the searches took from there.

    Args:
        model: fresh, of ppo or maskable-ppo.
        shown: what to imitate.
        seed: of the order in which it is looked at.
        updates: steps of the optimizer.
    """
    import torch

    policy, rng = model.policy, np.random.default_rng(seed)
    optimizer = torch.optim.Adam(policy.parameters(), lr=LEARNING_RATE)
    returns = torch.as_tensor(-REWARD_SCALE * shown.times, dtype=torch.float32)
    actions = torch.as_tensor(shown.actions)
    observed = {"local": torch.as_tensor(shown.local), "action_mask": torch.as_tensor(shown.masks)}
    for _ in range(updates):
        chosen = torch.as_tensor(rng.integers(len(actions), size=BATCH))
        values, log_prob, _ = policy.evaluate_actions(
            {name: values[chosen] for name, values in observed.items()}, actions[chosen]
        )
        misjudged = torch.nn.functional.mse_loss(values.flatten(), returns[chosen])
        loss = 0.5 * misjudged - log_prob.mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
