"""Train weights for the agent `network`: clone the choices of `belief`, and compare both in held-out worlds.

It takes about a minute, with a line after each round.

`python examples/train_network.py` trains on two packaged lots. The packaged weights learned from 10,000 decisions on
dozens of made lots, in the same two rounds: first the teacher drives, then the network, while the teacher labels what
it meets (DAgger). Two things that they had are left out here: the values of the teacher's other actions as labels, and
a last part in which two actions that score alike are played to the end in the same world.

The weights are read by `network:FILE`, in any command and in `make_agent`.
"""

import gymnasium as gym
import numpy as np
import torch
from torch import nn

import parkenv
from planners.network.agent import NetworkAgent
from planners.network.features import IS_SLOT, LOOKAHEAD, WAITING
from planners.network.policy import NetworkCard, NetworkPolicy

SCENARIOS, FILE = ("mini", "campus"), "network.safetensors"
DECISIONS, EPOCHS, BATCH = 2_000, 8, 256  # decisions of each round
RATES = (2e-3, 1e-3)  # learning rate of each round
LONGEST = 200  # decisions of a search: longer ones drive in circles in a full lot
EXPLORATION = 0.15  # probability of a random move where the teacher drives
SHARPNESS = 20.0  # inverse temperature of the teacher's choice: a twentieth of the time is clearly worse
WORLDS = 40


class Network(nn.Module):
    """The network of `NetworkPolicy`, for gradients; before it learns, it is the look-ahead alone."""

    def __init__(self, card):
        super().__init__()
        self.card, self.layers = card, nn.ParameterDict()
        for name, shape in card.shapes().items():
            weight = torch.zeros(shape)
            if name.endswith("weight") and not name.startswith("score_2"):
                nn.init.kaiming_uniform_(weight.T, a=5**0.5)
            self.layers[name.replace(".", "_")] = nn.Parameter(weight)

    def layer(self, name, x):
        """Apply a linear layer."""
        return x @ self.layers[f"{name}_weight"] + self.layers[f"{name}_bias"]

    def forward(self, actions, tokens, allowed):
        """Score the actions, (n, 6); -1e4 for those that there are not."""
        h = torch.relu(self.layer("token_2", torch.relu(self.layer("token_1", tokens))))
        absent = tokens[..., IS_SLOT, None] == 0.0
        attention = torch.softmax(self.layer("attention", h) - 1e4 * absent, dim=-2)
        x = torch.cat([actions, (attention * h).sum(-2), (h * ~absent).amax(-2)], -1)
        x = torch.relu(self.layer("action_2", torch.relu(self.layer("action_1", x))))
        there = allowed[..., None]
        x = x * there
        mean = x.sum(-2, keepdim=True) / there.sum(-2, keepdim=True).clamp(min=1)
        x = torch.cat([x, mean.expand_as(x), x.amax(-2, keepdim=True).expand_as(x)], -1)
        score = self.layer("score_2", torch.relu(self.layer("score_1", x)))[..., 0] - actions[..., LOOKAHEAD]
        return torch.where(allowed, score, torch.full_like(score, -1e4))

    def policy(self):
        """Return the weights for the agent."""
        names = self.card.shapes()
        weights = {name: self.layers[name.replace(".", "_")].detach().numpy().copy() for name in names}
        return NetworkPolicy(self.card, weights)


def label_searches(policy, first_seed, student_drives):
    """Run searches, and label each decision by the teacher: what the network observes, and the teacher's choice."""
    rng, rows, episode = np.random.default_rng(first_seed), [], 0
    scenarios = [parkenv.make_scenario(name) for name in SCENARIOS]
    places = [
        (gym.make("parkenv/Search-v2", scenario=s), parkenv.make_agent("belief", s), NetworkAgent(s, policy))
        for s in scenarios
    ]
    while len(rows) < DECISIONS:
        env, teacher, student = places[episode % len(places)]
        neighbors = env.unwrapped.scenario.lot.neighbors
        observation, _ = env.reset(seed=first_seed + episode)
        memory = own = None
        for _ in range(LONGEST):
            wanted, memory = teacher.predict(observation, memory)
            chosen, own = student.predict(observation, own)
            features = student.last_features  # None where the agent needs no network
            # A move where the graph has none is the teacher's way to wait.
            waits = wanted < 4 and neighbors[observation["vertex"], wanted] < 0
            label = WAITING if waits else int(wanted)
            if features is not None and features.allowed[label]:
                rows.append((*(array.copy() for array in features[:3]), label))
            action = chosen if student_drives else wanted
            if not student_drives and rng.random() < EXPLORATION:
                action = rng.choice(np.flatnonzero(observation["action_mask"][:4]))
            observation, _, terminated, _, _ = env.step(int(action))
            if terminated:
                break
        episode += 1
    return [torch.from_numpy(np.stack(column)) for column in zip(*rows, strict=True)]


def fit(network, data, rate, seed=0):
    """Fit the network to the teacher's choices."""
    n, rng = len(data[3]), np.random.default_rng(seed)
    optimizer = torch.optim.Adam(network.parameters(), lr=rate)
    steps = max(1, EPOCHS * n // BATCH)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps, 0.05 * rate)
    for _ in range(steps):
        batch = torch.from_numpy(rng.integers(n, size=BATCH))
        actions, tokens, allowed, choice = (part[batch] for part in data)
        loss = nn.functional.cross_entropy(SHARPNESS * network(actions, tokens, allowed), choice)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    return float(loss.detach())


def main():
    """Train, write the file, and compare."""
    torch.set_num_threads(1)  # the network is small: more threads only wait for one another
    torch.manual_seed(0)
    network, data = Network(NetworkCard(seed=0, trained_on=SCENARIOS)), []
    for number, rate in enumerate(RATES):
        some = label_searches(network.policy(), 10_000_000 + 1_000_000 * number, student_drives=number > 0)
        data = [torch.cat(parts) for parts in zip(data, some, strict=True)] if data else some
        print(f"{len(data[3]):,} labelled decisions, loss {fit(network, data, rate):.2f}")
    network.policy().save(FILE)
    agents = ["belief", "network", f"network:{FILE}"]
    for name in SCENARIOS:
        compared = parkenv.compare(scenarios=[name], agents=agents, episodes=WORLDS, seed=3_000_000)
        for row in compared.rows:
            print(f"{name}: {row['agent']:30} {row['total_s']:6.1f} s")


if __name__ == "__main__":
    main()
