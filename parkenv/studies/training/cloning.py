"""Behaviour cloning: collect a planner's demonstrations, and fit a policy to them before reinforcement learning."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from parkenv.engine.local_observation import FollowedSearch
from parkenv.errors import InputError, ensure
from parkenv.scenarios.selection import seeds_by_scenario
from parkenv.studies.simulate import EpisodeResult, Observer, Step, simulate
from parkenv.studies.training.configs import MAX_STEPS, REWARD_SCALE
from parkenv.world.scenario import Scenario
from planners.agent import ClairvoyantAgent, make_agent

UPDATES = 3000  # number of optimizer steps: enough for a policy that seldom deviates from the demonstrations
CLONEABLE = ("ppo", "maskable-ppo")  # algorithms whose policies can be cloned from demonstrations
BATCH = 512
LEARNING_RATE = 1e-3


def require_cloneable(algorithm: str, agent: str, scenario: Scenario) -> None:
    ensure(algorithm in CLONEABLE, f"{algorithm} has no behaviour cloning; take {' or '.join(CLONEABLE)}")
    ensure(
        not isinstance(make_agent(agent, scenario), ClairvoyantAgent),
        f"{agent} cannot be cloned: it decides on the hidden occupancy, which no policy observes",
    )


@dataclass(frozen=True, eq=False)
class Demonstrations:
    """Recorded decisions of an agent, for behaviour cloning.

    Args:
        agent: name of the agent.
        local: (n, 46 + 8k) float32, observations of `LocalObservation`.
        masks: (n, 5) int8, action masks.
        actions: (n,) int64, the agent's actions.
        times: (n,) float64, s from each decision to the end of the search.
    """

    agent: str
    local: NDArray[np.float32]
    masks: NDArray[np.int8]
    actions: NDArray[np.int64]
    times: NDArray[np.float64]

    @classmethod
    def collect(
        cls, agent: str, places: Scenario | Sequence[Scenario], seeds: Sequence[int], k: int = 5
    ) -> Demonstrations:
        """Simulate an agent, one search per seed, in a scenario or in the one of several that the seed draws.

        Truncated searches are left out.
        """
        places = [places] if isinstance(places, Scenario) else places
        finished = []
        for place, its in zip(places, seeds_by_scenario(seeds, len(places)), strict=True):
            planner = make_agent(agent, place)
            env = gym.make("parkenv/Search-v2", scenario=place, max_episode_steps=MAX_STEPS)
            recorder = _DecisionRecorder(FollowedSearch([place], k))
            for seed in its:
                simulate(env, planner, seed, (recorder,))
            finished += recorder.finished
        if not finished:
            names = ", ".join(place.name for place in places)
            raise InputError(f"{agent} finished none of {len(seeds)} searches on {names}: nothing to clone")
        local, masks, actions, rewards = zip(*itertools.chain.from_iterable(finished), strict=True)
        lengths = np.cumsum([len(decisions) for decisions in finished])[:-1]
        times = [-np.cumsum(r[::-1])[::-1] for r in np.split(np.array(rewards), lengths)]
        return cls(agent, np.stack(local), np.stack(masks), np.array(actions), np.concatenate(times))


class _DecisionRecorder(Observer):
    """Record (local observation, action mask, action, reward) of each decision, for searches that are not truncated.

    Args:
        local: computes the local observations.
    """

    def __init__(self, local: FollowedSearch) -> None:
        self._local = local
        self.finished: list[list[tuple[NDArray[np.float32], NDArray[np.int8], int, float]]] = []

    def on_reset(self, env: gym.Env[Any, Any], observation: Any) -> None:
        self._decisions: list[tuple[NDArray[np.float32], NDArray[np.int8], int, float]] = []
        self._now = self._local.observe(observation, begins=0)["local"]

    def on_step(self, step: Step) -> None:
        mask = step.observation["action_mask"]
        self._decisions.append((self._now, mask, int(step.action), step.reward))
        self._now = self._local.observe(step.next_observation)["local"]

    def on_end(self, result: EpisodeResult) -> None:
        if not result.truncated:
            self.finished.append(self._decisions)


def clone(
    model: OnPolicyAlgorithm, demonstrations: Demonstrations, seed: int, updates: int = UPDATES
) -> None:
    """Fit a model's policy to the demonstrations, and its value function to the remaining search time.

    Args:
        model: an untrained ppo or maskable-ppo model.
        demonstrations: decisions to clone.
        seed: seed of the mini-batches.
        updates: number of optimizer steps.
    """
    import torch

    policy, rng = model.policy, np.random.default_rng(seed)
    optimizer = torch.optim.Adam(policy.parameters(), lr=LEARNING_RATE)
    # Copies: a worker process has the arrays in shared memory, which PyTorch must not write.
    returns = torch.tensor(-REWARD_SCALE * demonstrations.times, dtype=torch.float32)
    actions = torch.tensor(demonstrations.actions)
    observed = {
        "local": torch.tensor(demonstrations.local),
        "action_mask": torch.tensor(demonstrations.masks),
    }
    for _ in range(updates):
        batch = torch.as_tensor(rng.integers(len(actions), size=BATCH))
        values, log_prob, _ = policy.evaluate_actions(
            {name: values[batch] for name, values in observed.items()}, actions[batch]
        )
        value_loss = torch.nn.functional.mse_loss(values.flatten(), returns[batch])
        loss = 0.5 * value_loss - log_prob.mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
