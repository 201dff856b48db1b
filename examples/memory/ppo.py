"""PPO for networks with a memory, and what their files share: the loop, the evaluation, the command line.

A memory is a `torch.nn.Module` with `size`, the length of its features, and two methods. `begin(n)` returns the state
of n searches that begin, a tensor (n, ...). `forward(inputs, state, begins)` takes inputs (T, n, d), the state before
them and begins (T, n), 1 where a search begins, and returns features (T, n, size) and the state after them. The same
method acts, with T = 1, and learns, with whole rollouts.
"""

import argparse
import csv
import sys
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from torch import nn
from torch.distributions import Categorical

import parkenv
from parkenv.engine.spaces import FlatLayout
from parkenv.world.occupancy.process import ConstantForecast

ENVS, STEPS, EPOCHS, PARTS = 64, 16, 4, 2
GAMMA, LAMBDA, CLIP, ENTROPY, LEARNING_RATE = 0.999, 0.95, 0.2, 0.01, 2e-3
MAX_STEPS = 200
TEST_SEED, TEST_WORLDS = 1_000_000, 256
OBSERVATIONS = ("belief", "no-map", "step")


class Reactive(nn.Module):
    """No memory: the features of the observation alone."""

    def __init__(self, n_inputs, size=64):
        super().__init__()
        self.size = size
        self.layers = nn.Sequential(nn.Linear(n_inputs, size), nn.Tanh())

    def begin(self, n):
        """There is no state."""
        return torch.zeros(n, 0)

    def forward(self, inputs, state, begins):
        """See the module."""
        del begins
        return self.layers(inputs), state


class Policy(nn.Module):
    """A memory, and on its features a layer, the logits of the actions, and the value."""

    def __init__(self, memory):
        super().__init__()
        self.memory = memory
        self.actor = nn.Sequential(nn.Linear(memory.size, 64), nn.Tanh(), nn.Linear(64, 5))
        self.critic = nn.Sequential(nn.Linear(memory.size, 64), nn.Tanh(), nn.Linear(64, 1))
        nn.init.orthogonal_(self.actor[-1].weight, 0.01)

    def forward(self, inputs, state, begins):
        """Return the distribution of the actions that the graph has, values (T, n), and the state."""
        features, state = self.memory(inputs, state, begins)
        logits = self.actor(features).masked_fill(inputs[..., -5:] == 0, -1e9)
        return Categorical(logits=logits, validate_args=False), self.critic(features).squeeze(-1), state


def make_batch(observation, scenario, n):
    """Return n searches in a compiled batch; `no-map` is the belief of a driver whose map says 1/2 for every slot."""
    world = parkenv.make_scenario(scenario)
    if observation == "no-map":
        world = world.replace(prior=ConstantForecast(0.5, world.occupancy))
    return gym.make_vec(
        "parkenv/Search-v2", n, "vector_entry_point", scenario=world, reward_scale=0.01, max_episode_steps=MAX_STEPS,
        autoreset_mode=AutoresetMode.SAME_STEP,
    )  # fmt: skip


class Vectors:
    """Observations of a batch as tensors, (1, n, d), that end with the action mask.

    In those of the last step alone, P(taken) is 1 or 0 for the slots that it observed, and 1/2 for all others.
    """

    def __init__(self, envs, observation):
        self.last_step_alone = observation == "step"
        space = envs.single_observation_space
        kept = [name for name in space if name not in ("belief", "step_observed")]
        self.layout = FlatLayout(gym.spaces.Dict({name: space[name] for name in kept}))

    def __call__(self, observation):
        """Return the tensor of a batch."""
        if self.last_step_alone:
            occupied = np.full_like(observation["p_occupied"], 0.5)
            slots, taken = observation["step_observed"].reshape(len(occupied), 4, -1)[:, :2].swapaxes(0, 1)
            row, at = np.nonzero(slots >= 0)
            occupied[row, slots[row, at].astype(int)] = taken[row, at]
            observation = {**observation, "p_occupied": occupied}
        return torch.as_tensor(self.layout(observation))[None]


def train(make_memory, observation, scenario, decisions, seed, tell):
    """Train a policy; `tell` gets the number of decisions and the total times, s, of the searches that ended."""
    torch.manual_seed(seed)
    envs = make_batch(observation, scenario, ENVS)
    vector = Vectors(envs, observation)
    inputs, begins = vector(envs.reset(seed=seed * 10_000)[0]), torch.ones(1, ENVS)
    policy = Policy(make_memory(inputs.shape[-1]))
    optimizer = torch.optim.Adam(policy.parameters(), LEARNING_RATE, eps=1e-5)
    state, n_updates = policy.memory.begin(ENVS), max(decisions // (ENVS * STEPS), 1)
    for update in range(n_updates):
        optimizer.param_groups[0]["lr"] = LEARNING_RATE * (1.0 - update / n_updates)
        first_state, rows, ended = state, [], []
        for _ in range(STEPS):
            with torch.no_grad():
                chosen, value, state = policy(inputs, state, begins)
                action = chosen.sample()
                following, reward, terminated, truncated, info = envs.step(action[0].numpy())
                for i in np.flatnonzero(
                    truncated & ~terminated
                ):  # the limit is no end: add the value of what follows
                    rest = vector(
                        {name: np.array(value)[None] for name, value in info["final_obs"][i].items()}
                    )
                    reward[i] += GAMMA * policy(rest, state[i : i + 1], torch.zeros(1, 1))[1].item()
            done = terminated | truncated
            if done.any():
                ended.extend(info["final_info"]["total_s"][done])
            over = torch.as_tensor(done, dtype=torch.float32)[None]
            rows.append(
                (inputs, begins, action, chosen.log_prob(action), value, torch.tensor(reward)[None], over)
            )
            inputs, begins = vector(following), over
        with torch.no_grad():
            value = policy(inputs, state, begins)[1][0]
        learn(policy, optimizer, [torch.cat(parts) for parts in zip(*rows, strict=True)], first_state, value)
        tell((update + 1) * ENVS * STEPS, ended)
    return policy


def learn(policy, optimizer, rollout, state, following):
    """Update a policy from a rollout, whose parts are (T, n, ...), with whole searches in each part of the batch."""
    inputs, begins, actions, old, values, rewards, over = rollout
    advantages, advantage = torch.zeros_like(values), torch.zeros(ENVS)
    for step in reversed(range(STEPS)):
        goes_on = 1.0 - over[step]
        delta = rewards[step] + GAMMA * goes_on * following - values[step]
        advantage = delta + GAMMA * LAMBDA * goes_on * advantage
        advantages[step], following = advantage, values[step]
    returns = (advantages + values).float()
    advantages = ((advantages - advantages.mean()) / (advantages.std() + 1e-8)).float()
    for _ in range(EPOCHS):
        for part in torch.randperm(ENVS).chunk(PARTS):
            chosen, value, _ = policy(inputs[:, part], state[part], begins[:, part])
            ratio = (chosen.log_prob(actions[:, part]) - old[:, part]).exp()
            gain = advantages[:, part]
            clipped = torch.minimum(ratio * gain, ratio.clamp(1.0 - CLIP, 1.0 + CLIP) * gain)
            error = (value - returns[:, part]).square().mean()
            loss = -clipped.mean() - ENTROPY * chosen.entropy().mean() + 0.5 * error
            optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(policy.parameters(), 0.5)
            optimizer.step()


@torch.no_grad()
def evaluate(policy, observation, scenario):
    """Return the total times, (TEST_WORLDS,) s, of searches in worlds that had no say, actions drawn as in training."""
    envs = make_batch(observation, scenario, TEST_WORLDS)
    vector = Vectors(envs, observation)
    inputs, begins = vector(envs.reset(seed=TEST_SEED)[0]), torch.ones(1, TEST_WORLDS)
    state, totals = policy.memory.begin(TEST_WORLDS), np.full(TEST_WORLDS, np.nan)
    torch.manual_seed(0)
    while np.isnan(totals).any():
        chosen, _, state = policy(inputs, state, begins)
        following, _, terminated, truncated, info = envs.step(chosen.sample()[0].numpy())
        done = terminated | truncated
        first = done & np.isnan(totals)
        if first.any():
            totals[first] = info["final_info"]["total_s"][first]
        inputs, begins = vector(following), torch.as_tensor(done, dtype=torch.float32)[None]
    return totals


def main(name, make_memory, observation="step"):
    """Train one memory with several seeds; write its curves and its times in the test worlds as CSV."""
    parser = argparse.ArgumentParser(description=f"Train {name} by PPO.")
    parser.add_argument("--observation", choices=OBSERVATIONS, default=observation)
    parser.add_argument("--scenario", default="mini")
    parser.add_argument("--decisions", type=int, default=204_800)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--out", type=Path, default=Path("results/memory"))
    given = parser.parse_args()
    torch.set_num_threads(1)
    given.out.mkdir(parents=True, exist_ok=True)
    stem = given.out / f"{name}-{given.observation}"
    with (
        stem.with_suffix(".curve.csv").open("w", newline="") as curve,
        stem.with_suffix(".test.csv").open("w", newline="") as test,
    ):
        curves, tests = csv.writer(curve), csv.writer(test)
        curves.writerow(["memory", "observation", "seed", "decisions", "searches", "total_s"])
        tests.writerow(["memory", "observation", "seed", "world", "total_s"])
        for seed in range(given.seeds):
            begun = time.process_time()

            def tell(decisions, ended, seed=seed):
                if ended:
                    curves.writerow(
                        [name, given.observation, seed, decisions, len(ended), f"{np.mean(ended):.3f}"]
                    )

            policy = train(make_memory, given.observation, given.scenario, given.decisions, seed, tell)
            totals = evaluate(policy, given.observation, given.scenario)
            tests.writerows(
                [name, given.observation, seed, TEST_SEED + i, f"{total:.3f}"]
                for i, total in enumerate(totals)
            )
            curve.flush()
            test.flush()
            seconds = time.process_time() - begun
            print(
                f"{name} {given.observation} seed {seed}: {totals.mean():6.1f} s, {seconds:.0f} s to train",
                flush=True,
            )


if __name__ == "__main__":
    sys.exit("Run belief.py, frame_stacking.py, gru.py, transformer.py or lru.py; twins.py runs all of them.")
