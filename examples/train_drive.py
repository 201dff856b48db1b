"""Learn to drive into a slot: SAC with hindsight experience replay on `parkenv/Drive-v1`, the planner beside it.

`python examples/train_drive.py` trains for some minutes on an easy task, a start up to 4 m outside a slot. A curriculum
goes on from there: larger `DISTANCE`, then `starts="lane"`, then the other kinds of slots. That takes hundreds of
thousands of decisions, and parallel slots stay hard; the planner parks in all of them.
"""

import gymnasium as gym
import numpy as np
import torch
from stable_baselines3 import SAC, HerReplayBuffer

import parkenv  # noqa: F401  registers the environments
from planners.driving.parking import ParkingAgent

DECISIONS, ROUNDS, TASKS = 20_000, 10, 50
TASK = {
    "lot": "campus",
    "kinds": ("perpendicular",),
    "starts": "way-out",
    "distance": (1.0, 4.0),
    "slack": 0.5,
}
HELD = 4  # steps of 0.1 s that a decision holds
SCALE = 0.2 * HELD  # from the reward of a step to one of a decision, near one
CONTACT_COST = (
    7.5  # s; a contact must cost more than to stand still for ever, and not so much that nobody dares
)


class Decisions(gym.Wrapper):
    """Hold each action for `HELD` steps; rewards are near one, and hindsight recomputes them for other goals."""

    def step(self, action):
        """Drive on for one decision."""
        for _ in range(HELD):
            observation, _, terminated, truncated, info = self.env.step(action)
            if terminated or truncated:
                break
        achieved, desired = observation["achieved_goal"], observation["desired_goal"]
        reward = self.compute_reward(achieved, desired, {"contact": info["contact"]})
        return observation, float(reward), terminated, truncated, info

    def compute_reward(self, achieved, desired, info):
        """Return the rewards of a batch of goals: minus the time of a decision, 0 where the car has parked."""
        return np.float32(SCALE) * self.unwrapped.compute_reward(achieved, desired, info)


def success(env, agent):
    """Return the share of held-out tasks in which an agent parks."""
    parked = []
    for seed in range(1_000_000, 1_000_000 + TASKS):
        observation, _ = env.reset(seed=seed)
        memory, over = None, False
        while not over:
            action, memory = agent.predict(observation, memory, deterministic=True)
            observation, _, terminated, truncated, info = env.step(action)
            over = terminated or truncated
        parked.append(info["is_success"])
    return np.mean(parked)


torch.set_num_threads(1)  # the networks are small: more threads only wait for one another
env = Decisions(gym.make("parkenv/Drive-v1", **TASK, contact_cost=CONTACT_COST))
model = SAC(
    "MultiInputPolicy",
    env,
    learning_rate=1e-3,
    buffer_size=DECISIONS,
    learning_starts=1_000,
    gamma=0.98,
    ent_coef="auto_0.02",  # with the default of 1, entropy outweighs the reward of parking for long
    replay_buffer_class=HerReplayBuffer,
    replay_buffer_kwargs={"n_sampled_goal": 4, "copy_info_dict": True},  # rewards need the contacts
    policy_kwargs={"net_arch": [128, 128]},
    seed=0,
    device="cpu",
)
for number in range(ROUNDS):
    model.learn(DECISIONS // ROUNDS, reset_num_timesteps=False)
    print(f"{number + 1} of {ROUNDS} parts learned", flush=True)
model.save("drive.zip")
print(f"{DECISIONS:,} decisions: parks in {success(env, model):.0%} of {TASKS} held-out tasks")
with_map = gym.make("parkenv/Drive-v1", **TASK, obstacle_map=True)
print(f"planner: parks in {success(with_map, ParkingAgent()):.0%}")
