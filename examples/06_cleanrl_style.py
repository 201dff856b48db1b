"""A policy gradient in one file, as CleanRL writes them: the compiled batch, PyTorch, and nothing between."""

import gymnasium as gym
import torch
from gymnasium.vector import AutoresetMode
from torch import nn

import parkenv  # noqa: F401 - registers the environments

N, ROLLOUT, UPDATES = 256, 32, 40
envs = gym.make_vec(
    "parkenv/Search-v1", N, vectorization_mode="vector_entry_point", scenario="mini", observation="local",
    autoreset_mode=AutoresetMode.SAME_STEP,
)  # fmt: skip
torch.manual_seed(0)
size = envs.single_observation_space["local"].shape[0]
actor = nn.Sequential(nn.Linear(size, 64), nn.Tanh(), nn.Linear(64, 5))
critic = nn.Sequential(nn.Linear(size, 64), nn.Tanh(), nn.Linear(64, 1))
optimizer = torch.optim.Adam([*actor.parameters(), *critic.parameters()], lr=3e-3)


def distribution(observation: dict[str, torch.Tensor]) -> torch.distributions.Categorical:
    """Over the actions that the graph has."""
    logits = actor(observation["local"])
    return torch.distributions.Categorical(logits=logits.masked_fill(observation["action_mask"] == 0, -1e9))


seen, _ = envs.reset(seed=0)
times: list[float] = []
for update in range(UPDATES):
    observations, actions, rewards, ends = [], [], [], []
    for _ in range(ROLLOUT):
        tensors = {name: torch.from_numpy(values) for name, values in seen.items()}
        action = distribution(tensors).sample()
        seen, reward, terminated, truncated, info = envs.step(action.numpy())
        observations.append(tensors)
        actions.append(action)
        rewards.append(torch.from_numpy(reward).float() / 100.0)
        ends.append(torch.from_numpy(terminated | truncated).float())
        if "final_info" in info:
            times.extend(info["final_info"]["total_s"][info["_final_info"]])
    value = critic(torch.from_numpy(seen["local"])).squeeze(-1).detach()
    returns = []
    for reward, end in zip(reversed(rewards), reversed(ends), strict=True):
        value = reward + (1.0 - end) * value
        returns.append(value)
    wanted = torch.stack(returns[::-1]).flatten()
    batch = {name: torch.cat([o[name] for o in observations]) for name in seen}
    values = critic(batch["local"]).squeeze(-1)
    chosen, advantage = distribution(batch), (wanted - values).detach()
    advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
    gain = (chosen.log_prob(torch.cat(actions)) * advantage).mean() + 0.01 * chosen.entropy().mean()
    loss = 0.5 * (wanted - values).square().mean() - gain
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
    if update % 10 == 9 and times:
        print(f"after {(update + 1) * ROLLOUT * N:7,} decisions: {sum(times) / len(times):6.1f} s a search")
        times.clear()
