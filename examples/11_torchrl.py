"""Many cars with TorchRL: PettingZoo's parallel form in TorchRL's wrapper; one network with masked actions drives all.

It takes about a quarter of a minute, with a line after every tenth update.

A car that is under way has no action: the world ignores whatever it is given. TorchRL wants at least one allowed
action, so a small wrapper allows all of them then, and says which cars decide.
Without the packages of the extra `marl`, the example says so.
"""

from importlib.util import find_spec

import numpy as np
from gymnasium import spaces
from pettingzoo.utils import BaseParallelWrapper

from parkenv import lot_v0

CARS, TICKS = 4, 60


class Deciding(BaseParallelWrapper):
    """Observe P(taken) of the slots, where the car is, whether it decides, and the actions that it has."""

    def observation_space(self, agent):
        """Return the space of an agent's observations."""
        space = self.env.observation_space(agent)
        size = space["p_occupied"].shape[0] + space["vertex"].n + 1
        return spaces.Dict(
            {"seen": spaces.Box(0.0, 1.0, (int(size),), np.float32), "action_mask": space["action_mask"]}
        )

    def _observe(self, observations):
        return {agent: self._seen(agent, one) for agent, one in observations.items()}

    def _seen(self, agent, one):
        place = np.zeros(self.env.observation_space(agent)["vertex"].n, np.float32)
        place[one["vertex"]] = 1.0
        decides = one["action_mask"].any()
        seen = np.concatenate([[decides], place, one["p_occupied"]], dtype=np.float32)
        return {"seen": seen, "action_mask": one["action_mask"] if decides else np.ones(5, np.int8)}

    def reset(self, seed=None, options=None):
        """Begin a world."""
        observations, infos = self.env.reset(seed=seed, options=options)
        return self._observe(observations), infos

    def step(self, actions):
        """Go on to the next tick."""
        observations, *results = self.env.step(actions)
        return self._observe(observations), *results


def main():
    """Train one network for all cars by REINFORCE with a baseline for a few seconds."""
    import torch
    from tensordict.nn import TensorDictModule
    from torch import nn
    from torchrl.envs.libs.pettingzoo import PettingZooWrapper
    from torchrl.envs.utils import MarlGroupMapType
    from torchrl.modules import MaskedCategorical

    torch.manual_seed(0)
    torch.set_num_threads(1)
    env = PettingZooWrapper(
        Deciding(
            lot_v0.parallel_env(scenario="mini", cars=CARS, background="none", tick_s=2.0, max_cycles=TICKS)
        ),
        group_map=MarlGroupMapType.ALL_IN_ONE_GROUP,
        use_mask=True,
        done_on_any=False,
        categorical_actions=True,
        seed=0,
    )
    keys = [("agents", "observation", "seen"), ("agents", "action_mask")]
    width = env.observation_spec[keys[0]].shape[-1]
    network = nn.Sequential(nn.Linear(width, 64), nn.Tanh(), nn.Linear(64, 6))  # five logits, and the value

    def policy(seen, mask):
        return MaskedCategorical(logits=network(seen)[..., :5], mask=mask)

    act = TensorDictModule(lambda *one: policy(*one).sample(), in_keys=keys, out_keys=[env.action_key])
    optimizer = torch.optim.Adam(network.parameters(), 1e-2)
    costs = []
    for update in range(1, 31):
        with torch.no_grad():
            ticks = env.rollout(TICKS, act)
        seen, mask = (ticks[key] for key in keys)
        reward = 0.01 * ticks["next", "agents", "reward"].squeeze(-1)
        returns = reward.flip(0).cumsum(0).flip(0)  # (ticks, cars)
        decides = ticks["agents", "mask"] & (seen[..., 0] > 0.0)
        chance = policy(seen, mask).log_prob(ticks[env.action_key])
        error = returns - network(seen)[..., 5]
        loss = (error**2 - chance * error.detach())[decides].mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        costs.append(-100.0 * float(reward.sum()) / CARS)
        if update % 10 == 0:
            print(f"{update} updates: {np.mean(costs[-10:]):.0f} s a car in the last ten worlds")


if find_spec("torchrl") is None:
    print('TorchRL is not installed: pip install "parkenv[marl]"')
else:
    main()
