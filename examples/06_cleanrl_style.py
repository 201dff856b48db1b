"""PPO in one file, as CleanRL writes it: clipped ratio, GAE, action masks, on the compiled batch of searches.

It takes about half a minute, with a line after every fourth update.
"""

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from torch import nn
from torch.distributions import Categorical

import parkenv  # noqa: F401 - registers the environments

ENVS, STEPS, UPDATES, EPOCHS, MINIBATCHES = 256, 32, 40, 4, 4
GAMMA, LAMBDA, CLIP, ENTROPY, VALUE, LEARNING_RATE, SCALE = 0.999, 0.95, 0.2, 0.01, 0.5, 1e-3, 0.01

torch.manual_seed(0)
torch.set_num_threads(1)  # the networks are small: more threads only wait for one another
envs = gym.make_vec(
    "parkenv/Search-v2", ENVS, vectorization_mode="vector_entry_point", scenario="mini", observation="local",
    max_episode_steps=500, autoreset_mode=AutoresetMode.SAME_STEP,
)  # fmt: skip
n_inputs, n_actions = envs.single_observation_space["local"].shape[0], envs.single_action_space.n


def network(n_outputs: int, gain: float) -> nn.Sequential:
    """Two hidden layers, orthogonal weights."""
    layers = nn.Linear(n_inputs, 64), nn.Linear(64, 64), nn.Linear(64, n_outputs)
    for layer, scale in zip(layers, (2**0.5, 2**0.5, gain), strict=True):
        nn.init.orthogonal_(layer.weight, scale)
        nn.init.zeros_(layer.bias)
    return nn.Sequential(layers[0], nn.Tanh(), layers[1], nn.Tanh(), layers[2])


actor, critic = network(n_actions, 0.01), network(1, 1.0)
optimizer = torch.optim.Adam([*actor.parameters(), *critic.parameters()], lr=LEARNING_RATE, eps=1e-5)


def policy(local: torch.Tensor, mask: torch.Tensor) -> Categorical:
    """Distribution over the actions that the graph has here."""
    return Categorical(logits=actor(local).masked_fill(mask == 0, -1e9))


def tensors(observation: dict[str, np.ndarray]) -> tuple[torch.Tensor, torch.Tensor]:
    """Observation and action mask as tensors."""
    return torch.tensor(observation["local"]), torch.tensor(observation["action_mask"])


local, mask = tensors(envs.reset(seed=0)[0])
locals_, masks = torch.zeros(STEPS, ENVS, n_inputs), torch.zeros(STEPS, ENVS, n_actions)
actions = torch.zeros(STEPS, ENVS, dtype=torch.int64)
log_probs, rewards, ends, values = (torch.zeros(STEPS, ENVS) for _ in range(4))
times: list[float] = []
for update in range(UPDATES):
    optimizer.param_groups[0]["lr"] = LEARNING_RATE * (1.0 - update / UPDATES)
    for step in range(STEPS):
        with torch.no_grad():
            chosen = policy(local, mask)
            action = chosen.sample()
            values[step] = critic(local).squeeze(-1)
        locals_[step], masks[step], actions[step] = local, mask, action
        log_probs[step] = chosen.log_prob(action)
        observation, reward, terminated, truncated, info = envs.step(action.numpy())
        reward *= SCALE
        cut = truncated & ~terminated
        if cut.any():  # the step limit is no end of the search: add the value of what would follow
            rest = torch.tensor(np.stack([final["local"] for final in info["final_obs"][cut]]))
            with torch.no_grad():
                reward[cut] += GAMMA * critic(rest).squeeze(-1).numpy()
        rewards[step] = torch.tensor(reward)
        ends[step] = torch.tensor(terminated | truncated)
        if "final_info" in info:
            times.extend(info["final_info"]["total_s"][info["_final_info"]])
        local, mask = tensors(observation)

    # Generalised advantage estimation.
    advantages, advantage = torch.zeros(STEPS, ENVS), torch.zeros(ENVS)
    with torch.no_grad():
        following = critic(local).squeeze(-1)
    for step in reversed(range(STEPS)):
        goes_on = 1.0 - ends[step]
        delta = rewards[step] + GAMMA * goes_on * following - values[step]
        advantage = delta + GAMMA * LAMBDA * goes_on * advantage
        advantages[step], following = advantage, values[step]
    returns = (advantages + values).flatten()
    batch = (
        locals_.flatten(0, 1),
        masks.flatten(0, 1),
        actions.flatten(),
        log_probs.flatten(),
        advantages.flatten(),
    )

    for _ in range(EPOCHS):
        for part in torch.randperm(STEPS * ENVS).chunk(MINIBATCHES):
            at, allowed, taken, old, gain = (values_[part] for values_ in batch)
            chosen = policy(at, allowed)
            ratio = (chosen.log_prob(taken) - old).exp()
            gain = (gain - gain.mean()) / (gain.std() + 1e-8)
            clipped = torch.minimum(ratio * gain, ratio.clamp(1.0 - CLIP, 1.0 + CLIP) * gain)
            error = (critic(at).squeeze(-1) - returns[part]).square().mean()
            loss = -clipped.mean() - ENTROPY * chosen.entropy().mean() + 0.5 * VALUE * error
            optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_([*actor.parameters(), *critic.parameters()], 0.5)
            optimizer.step()

    if update % 4 == 3:
        mean = float(np.mean(times))
        print(f"{(update + 1) * STEPS * ENVS:7,} decisions {mean:7.1f} s a search {'#' * round(mean / 10)}")
        times.clear()
