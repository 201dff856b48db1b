"""Searches of some agents as a data set for offline reinforcement learning, in Minari's format.

It takes a few seconds.

`python examples/record_minari.py` records a few searches in `minari_data` (`pip install "minari[hdf5]"`). Agents take
turns; at random, some of their actions are replaced by any that is possible. The data set holds what they observed,
did and paid, and with which probability each action was drawn, as off-policy evaluation needs it.

    MINARI_DATASETS_PATH=minari_data python -c "import minari; print(minari.load_dataset('parkenv/campus/mixed-v0'))"
"""

import os
from pathlib import Path

os.environ.setdefault("MINARI_DATASETS_PATH", str(Path("minari_data").absolute()))

import gymnasium as gym
import minari
import numpy as np
from minari.data_collector import EpisodeBuffer

import parkenv

SCENARIO, NAME = "campus", "parkenv/campus/mixed-v0"
AGENTS = ("random", "greedy-total", "mdp", "belief")
EPISODES, EPSILON, SEED = 20, 0.1, 0  # 1,000 searches are some 100,000 steps

env = gym.make("parkenv/Search-v2", scenario=SCENARIO)
agents = [parkenv.make_agent(name, env.unwrapped.scenario) for name in AGENTS]
rng = np.random.default_rng(SEED)


def stacked(parts):
    """Return dictionaries of arrays, one for each step, as one dictionary."""
    return {name: np.stack([part[name] for part in parts]) for name in parts[0]}


def record(agent, number):
    """Let an agent search in the world of a seed, and return what happened."""
    observation, _ = env.reset(seed=SEED + number)
    observations, steps, memory, over = [observation], [], None, False
    while not over:
        planned, memory = agent.predict(observation, memory)
        possible = observation["action_mask"] / observation["action_mask"].sum()
        probabilities = (1.0 - EPSILON) * np.eye(len(possible))[int(planned)] + EPSILON * possible
        action = rng.choice(len(possible), p=probabilities)
        if action != planned:
            memory = None  # the agent plans anew from where it is then
        observation, reward, terminated, truncated, _ = env.step(action)
        over = terminated or truncated
        observations.append(observation)
        steps.append((action, reward, terminated, truncated, probabilities))
    actions, rewards, terminations, truncations, drawn = map(np.array, zip(*steps, strict=True))
    # Row t of the infos belongs to observation t; after the last one nothing is drawn.
    infos = {"action_probabilities": np.vstack([drawn, np.zeros_like(drawn[:1])])}
    outcomes = rewards, terminations, truncations & ~terminations
    return EpisodeBuffer(number, SEED + number, None, stacked(observations), actions, *outcomes, infos)


dataset = minari.create_dataset_from_buffers(
    NAME,
    [record(agents[number % len(agents)], number) for number in range(EPISODES)],
    env,
    algorithm_name=f"{', '.join(AGENTS)}; {EPSILON:.0%} random actions",
    description="Searches for a parking space. The return is minus the total time, s.",
    requirements=[f"parkenv=={parkenv.__version__}"],
)
total_s = [-episode.rewards.sum() for episode in dataset.iterate_episodes()]
print(f"{dataset.total_episodes} searches, {dataset.total_steps} steps, {np.mean(total_s):.1f} s in the mean")

# The data set knows its environment; with the seed and the actions of an episode it repeats the episode.
again, episode = dataset.recover_environment(), next(dataset.iterate_episodes())
again.reset(seed=SEED)
repeated_s = sum(again.step(action)[1] for action in episode.actions)
print(f"the first search again: {-repeated_s:.1f} s, as recorded: {-episode.rewards.sum():.1f} s")
