"""PPO of TorchRL's own parts on its `GymEnv`: `python with_torchrl.py SCENARIO DECISIONS`."""

import sys

import torch
from held_out import OPTIONS, tell
from tensordict.nn import TensorDictModule
from torch import nn
from torch.distributions import Categorical
from torchrl.collectors import Collector
from torchrl.envs import GymEnv, RewardSum, TransformedEnv
from torchrl.modules import ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

SCENARIO, DECISIONS = sys.argv[1], int(sys.argv[2])
BATCH, EPOCHS, MINIBATCH = 2048, 4, 512

torch.manual_seed(0)
torch.set_num_threads(1)
env = TransformedEnv(
    GymEnv("parkenv/Search-v2", scenario=SCENARIO, categorical_action_encoding=True, **OPTIONS), RewardSum()
)
env.set_seed(0)
size = env.observation_spec["observation"].shape[-1]


def network(outputs):
    """Two hidden layers."""
    return nn.Sequential(nn.Linear(size, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, outputs))


logits = network(5)
actor = ProbabilisticActor(
    TensorDictModule(logits, ["observation"], ["logits"]),
    in_keys=["logits"],
    spec=env.action_spec,
    distribution_class=Categorical,
    return_log_prob=True,
)
critic = ValueOperator(network(1), ["observation"])
advantage = GAE(gamma=0.999, lmbda=0.95, value_network=critic)
loss = ClipPPOLoss(actor, critic, clip_epsilon=0.2)
optimizer = torch.optim.Adam(loss.parameters(), 1e-3)
batches = Collector(env, actor, frames_per_batch=BATCH, total_frames=DECISIONS)
for number, batch in enumerate(batches, 1):
    for _ in range(EPOCHS):
        with torch.no_grad():
            advantage(batch)
        for part in torch.randperm(BATCH).split(MINIBATCH):
            losses = loss(batch.reshape(-1)[part])
            optimizer.zero_grad()
            sum(value for name, value in losses.items() if name.startswith("loss_")).backward()
            nn.utils.clip_grad_norm_(loss.parameters(), 0.5)
            optimizer.step()
    ends = batch["next", "done"].squeeze(-1)
    returns = batch["next", "episode_reward"].squeeze(-1)[ends]
    print(f"{number * BATCH:9,} decisions {-100.0 * returns.mean().item():7.1f} s", flush=True)
batches.shutdown()

tell(
    "torchrl",
    DECISIONS,
    lambda observation: int(Categorical(logits=logits(torch.as_tensor(observation))).sample()),
    SCENARIO,
)
