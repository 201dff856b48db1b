"""Learn from recorded searches, and estimate what policies cost without letting them search; then let them search.

    parkenv dataset campus --policy mdp --epsilon 0.2 --steps 40000 --out data
    python offline_learning.py data/parkenv/campus/mdp-v0 --updates 3000 --searches 1000

needs `pip install "parkenv[rl,offline]"`, and d3rlpy (`pip install --no-deps d3rlpy gym structlog dataclasses-json
marshmallow typing-inspect mypy-extensions gym-notices`: it asks for an old Gymnasium). Behaviour cloning and CQL are
d3rlpy's; its IQL is for continuous actions, so IQL for five actions stands here. The models are agents:

    parkenv compare --scenario campus --agents "mdp,offline_learning:Learned(file=learned/iql.npz)"
"""

import argparse
import csv
from pathlib import Path

import numpy as np

SCALE, GAMMA = 0.01, 1.0  # rewards near one; searches end
N_ACTIONS = 5


class Learned:
    """An agent that takes the best of the possible actions by the scores of a network.

    Args:
        problem: the problem; not used.
        file: the layers, `.npz`.
    """

    local_k = 5  # it observes what is near the car

    def __init__(self, problem, file="learned/bc.npz"):
        del problem
        self.name = Path(file).stem
        with np.load(file, allow_pickle=False) as layers:
            self.layers = [layers[name] for name in sorted(layers.files)]

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        """Return the actions for one observation of `LocalObservation`, or for a batch."""
        del episode_start, deterministic
        mask = observation["action_mask"]
        scores = forward(self.layers, np.concatenate([observation["local"], mask], axis=-1))
        return np.where(mask == 1, scores, -np.inf).argmax(axis=-1), state


def forward(layers, x):
    """Return the scores of a network: layers with rectifiers in between; weights and biases alternate."""
    for i in range(0, len(layers), 2):
        x = (np.maximum(x, 0.0) if i else x) @ layers[i].T + layers[i + 1]
    return x


# ---- the data


class Data:
    """A data set as arrays of all its episodes, one after the other.

    Attributes:
        x: (N + E, 91) float32, observation and mask; each of the E episodes has a row more than steps.
        behaviour: (N + E, 5), with which probability each action was drawn.
        at, after: (N,) rows of the observation before and after each step.
        actions, rewards, ended: (N,) of each step; rewards in units of 100 s.
        first: (E,) step that begins each episode.
    """

    def __init__(self, folder):
        from minari import MinariDataset

        self.dataset = MinariDataset(Path(folder) / "data")
        episodes = list(self.dataset.iterate_episodes())
        seen = [e.observations for e in episodes]
        self.x = np.concatenate([np.hstack([s["local"], s["action_mask"]]) for s in seen]).astype(np.float32)
        self.behaviour = np.concatenate([e.infos["action_probabilities"] for e in episodes])
        self.actions = np.concatenate([e.actions for e in episodes])
        self.rewards = np.concatenate([e.rewards for e in episodes]) * SCALE
        self.ended = np.concatenate([e.terminations for e in episodes])
        self.lengths = np.array([len(e) for e in episodes])
        self.first = np.cumsum(self.lengths) - self.lengths
        self.at = np.arange(len(self.actions)) + np.repeat(np.arange(len(episodes)), self.lengths)
        self.after = self.at + 1

    @property
    def mask(self):
        """(N + E, 5) float32, the possible actions."""
        return self.x[:, -N_ACTIONS:]

    def softened(self, epsilon):
        """Return the probabilities of the recorded agent's actions if it took random ones less or more often."""
        planned = np.eye(N_ACTIONS)[self.behaviour.argmax(axis=1)]
        return (1.0 - epsilon) * planned + epsilon * self.mask / self.mask.sum(axis=1, keepdims=True)

    def greedy(self, layers):
        """Return the probabilities of a network's actions: one is certain."""
        return np.eye(N_ACTIONS)[np.where(self.mask == 1, forward(layers, self.x), -np.inf).argmax(axis=1)]

    def by_episode(self, values, past=0.0):
        """Return values of steps as (E, longest), `past` past the end of an episode."""
        table = np.full((len(self.lengths), self.lengths.max()), past)
        table[np.arange(table.shape[1]) < self.lengths[:, None]] = values
        return table


# ---- estimators of the mean return, from (E, T) tables


def per_decision(rewards, ratios):
    """Importance sampling: each reward counts by how much more probable the actions up to it are."""
    return (np.cumprod(ratios, axis=1) * rewards).sum(axis=1).mean()


def weighted(rewards, ratios):
    """The same with weights that add up to one in every step; an episode that is over keeps its last one."""
    return (_weights(ratios) * rewards).sum()


def doubly_robust(rewards, ratios, q, v):
    """The direct method, corrected by the weighted errors of its values in every step (WDR)."""
    weights = _weights(ratios)
    before = np.hstack([np.full((len(weights), 1), 1.0 / len(weights)), weights[:, :-1]])
    return (weights * (rewards - q) + before * v).sum()


def _weights(ratios):
    weights = np.cumprod(ratios, axis=1)
    return weights / np.maximum(weights.sum(axis=0), 1e-300)


# ---- networks


def network(seed, outputs=N_ACTIONS):
    """Return an untrained network."""
    import torch

    torch.manual_seed(seed)
    layers = [torch.nn.Linear(91, 128), torch.nn.ReLU(), torch.nn.Linear(128, 128), torch.nn.ReLU()]
    return torch.nn.Sequential(*layers, torch.nn.Linear(128, outputs))


def layers_of(module):
    """Return weights and biases of the linear layers of a module, in their order."""
    import torch

    linear = [m for m in module.modules() if isinstance(m, torch.nn.Linear)]
    return [each.detach().numpy().astype(np.float64) for m in linear for each in (m.weight, m.bias)]


def fitted_q(data, target, updates, seed=0):
    """Fitted Q evaluation (Le et al., 2019): the values of a policy, from its probabilities at every observation."""
    import torch

    model, old, rng = network(seed), network(seed), np.random.default_rng(seed)
    optimizer = torch.optim.Adam(model.parameters(), 1e-3)
    x, pi = torch.tensor(data.x), torch.tensor(target, dtype=torch.float32)
    rewards, over = torch.tensor(data.rewards, dtype=torch.float32), torch.tensor(data.ended)
    for update in range(updates):
        if update % 50 == 0:
            old.load_state_dict(model.state_dict())
        if update == updates * 2 // 3:
            optimizer.param_groups[0]["lr"] = 1e-4
        i = rng.integers(len(data.actions), size=512)
        at, after = data.at[i], data.after[i]
        with torch.no_grad():
            ahead = (pi[after] * old(x[after])).sum(1).masked_fill(over[i], 0.0)
        found = model(x[at]).gather(1, torch.tensor(data.actions[i])[:, None])[:, 0]
        loss = torch.nn.functional.mse_loss(found, rewards[i] + GAMMA * ahead)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return forward(layers_of(model), data.x)


def train_d3rlpy(data, name, updates, seed=0):
    """Behaviour cloning or conservative Q-learning (CQL) of d3rlpy."""
    import d3rlpy
    import structlog

    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(30))  # warnings
    d3rlpy.seed(seed)
    ends = np.zeros(len(data.actions))
    ends[data.first + data.lengths - 1] = 1.0
    steps = d3rlpy.dataset.MDPDataset(
        data.x[data.at], data.actions[:, None], data.rewards[:, None].astype(np.float32),
        ends * data.ended, ends * ~data.ended, action_size=N_ACTIONS,
    )  # fmt: skip
    encoder = d3rlpy.models.VectorEncoderFactory(hidden_units=[128, 128])
    if name == "bc":
        config = d3rlpy.algos.DiscreteBCConfig(batch_size=512, encoder_factory=encoder, beta=0.0)
    else:
        config = d3rlpy.algos.DiscreteCQLConfig(
            batch_size=512, learning_rate=1e-3, gamma=0.999, alpha=0.5, target_update_interval=500,
            encoder_factory=encoder,
        )  # fmt: skip
    algorithm = config.create()
    quiet = d3rlpy.logging.NoopAdapterFactory()
    algorithm.fit(steps, updates, updates, logger_adapter=quiet, show_progress=False, save_interval=10**9)
    modules = algorithm.impl.modules
    return layers_of(modules.imitator if name == "bc" else modules.q_funcs[0])


def train_iql(data, updates, seed=0, expectile=0.7, temperature=2.5):
    """Implicit Q-learning (Kostrikov et al., 2021) for five actions: values of good recorded actions, then cloning."""
    import torch

    q, old, v, policy = network(seed), network(seed), network(seed + 1, 1), network(seed + 2)
    parameters = [*q.parameters(), *v.parameters(), *policy.parameters()]
    optimizer, rng = torch.optim.Adam(parameters, 1e-3), np.random.default_rng(seed)
    x, over = torch.tensor(data.x), torch.tensor(data.ended)
    rewards = torch.tensor(data.rewards, dtype=torch.float32)
    for update in range(updates):
        if update % 200 == 0:
            old.load_state_dict(q.state_dict())
        i = rng.integers(len(data.actions), size=512)
        at, after, actions = x[data.at[i]], x[data.after[i]], torch.tensor(data.actions[i])[:, None]
        with torch.no_grad():
            ahead = v(after)[:, 0].masked_fill(over[i], 0.0)
            taken = old(at).gather(1, actions)[:, 0]
        ahead_of = taken - v(at)[:, 0]
        v_loss = (torch.where(ahead_of > 0, expectile, 1.0 - expectile) * ahead_of**2).mean()
        q_loss = torch.nn.functional.mse_loss(q(at).gather(1, actions)[:, 0], rewards[i] + 0.999 * ahead)
        scores = policy(at).masked_fill(at[:, -N_ACTIONS:] == 0, -1e9)
        log_p = torch.log_softmax(scores, 1).gather(1, actions)[:, 0]
        advantage = torch.exp(temperature * ahead_of.detach()).clamp(max=50.0)
        loss = v_loss + q_loss - (advantage * log_p).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return layers_of(policy)


# ---- the table


def searched(scenario, agent, epsilon, n):
    """Return mean total time and half its 95 % interval, s, of searches in worlds that are not in the data."""
    from parkenv.studies.agent_spec import AgentSpec
    from parkenv.studies.dataset.recording import SearchRecorder

    recorder = SearchRecorder(scenario, AgentSpec.parse(agent, "agent"), "local", epsilon)
    total_s = np.array([-each.arrays["rewards"].sum() for each in recorder.searches(range(10**6, 10**6 + n))])
    return total_s.mean(), 1.96 * total_s.std() / np.sqrt(n)


def estimates(data, target, updates):
    """Return the mean total time of a policy and half the 95 % interval, s, by each estimator; effective episodes."""
    taken = data.at, data.actions
    ratios = data.by_episode(target[taken] / data.behaviour[taken], past=1.0)
    rewards = data.by_episode(data.rewards)
    values = fitted_q(data, target, updates)
    q = data.by_episode(values[taken])
    v = data.by_episode((target * values).sum(axis=1)[data.at])

    def of(i):
        return {
            "fitted Q": v[i, 0].mean(),
            "per decision": per_decision(rewards[i], ratios[i]),
            "weighted": weighted(rewards[i], ratios[i]),
            "doubly robust": doubly_robust(rewards[i], ratios[i], q[i], v[i]),
        }

    found, rng, n = of(slice(None)), np.random.default_rng(0), len(rewards)
    again = [of(rng.integers(n, size=n)) for _ in range(100)]  # episodes drawn anew (bootstrap)
    whole = np.prod(ratios, axis=1)
    halves = {name: 1.96 * np.std([each[name] for each in again]) / SCALE for name in found}
    size = whole.sum() ** 2 / max((whole**2).sum(), 1e-300)
    return {name: (-value / SCALE, halves[name]) for name, value in found.items()}, size


def main():
    """Train, evaluate, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "folder", help="a data set of `parkenv dataset --epsilon`, the folder with `data` in it"
    )
    parser.add_argument("--out", default="learned", type=Path)
    parser.add_argument("--updates", default=6_000, type=int)
    parser.add_argument("--searches", default=4_000, type=int, help="for the true values")
    given = parser.parse_args()
    data, out = Data(given.folder), given.out
    out.mkdir(exist_ok=True)
    about = data.dataset.storage.metadata["parkenv"]
    scenario = data.dataset.recover_environment().unwrapped.scenario
    policy, shares = about["policy"], (about["epsilon"], about["epsilon"] / 2, 0.0)
    targets = [(f"{policy}, {e:.0%} random", {"name": policy}, e, data.softened(e)) for e in shares]
    for name in ("bc", "cql", "iql"):
        layers = train_iql(data, given.updates) if name == "iql" else train_d3rlpy(data, name, given.updates)
        file = out / f"{name}.npz"
        np.savez(file, **{f"{i:02}": layer for i, layer in enumerate(layers)})
        agent = {"name": "offline_learning:Learned", "file": str(file)}
        targets.append((name, agent, 0.0, data.greedy(layers)))
    rows = []
    for label, agent, epsilon, target in targets:
        truth, half = searched(scenario, agent, epsilon, given.searches)
        found, size = estimates(data, target, given.updates)
        errors = {
            f"{name} - true": f"{mean - truth:+.1f} ± {more:.1f}" for name, (mean, more) in found.items()
        }
        rows.append(
            {"policy": label, "true s": f"{truth:.1f} ± {half:.1f}", **errors, "episodes": f"{size:.0f}"}
        )
    with (out / "estimates.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    for cells in (rows[0].keys(), ["---"] * len(rows[0]), *(row.values() for row in rows)):
        print(f"| {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
