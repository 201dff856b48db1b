"""Trained models as drivers of fleets: their compiled networks choose as the models do."""

import pickle

import numpy as np
import pytest
from sb3_contrib import MaskablePPO
from small_lots import driven
from stable_baselines3 import DQN, PPO

from parkenv import InputError, make_scenario
from parkenv.engine.fleet import DriverKind, Fleet
from parkenv.engine.network import compiled_network
from parkenv.envs.sb3 import SearchVecEnv
from parkenv.studies.fields import AgentSpec
from parkenv.studies.fleet.drivers import network_policy, policy_of
from parkenv.world.demand import ConstantTime, Demand, ExponentialTime, PoissonArrivals
from planners import make_agent
from planners.model_file import save_model

MINI = make_scenario("mini")
DEMAND = Demand(PoissonArrivals(60.0, 8 * 3600, 8.5 * 3600), ExponentialTime(480.0), ConstantTime(300.0))


def small(algorithm):
    policy = {"net_arch": [16, 8]}
    venv = SearchVecEnv(3, "mini")
    return algorithm("MultiInputPolicy", venv, seed=0, device="cpu", policy_kwargs=policy)


@pytest.mark.parametrize("algorithm", [PPO, MaskablePPO, DQN])
def test_a_compiled_network_drives_as_its_model_does(algorithm, tmp_path):
    model = small(algorithm)
    path = tmp_path / "model.safetensors"
    save_model(model, path)
    name = {PPO: "ppo", MaskablePPO: "maskable-ppo", DQN: "dqn"}[algorithm]
    agent = make_agent(f"{name}:{path}", MINI)
    policy, none = policy_of(AgentSpec(name=f"{name}:{path}"), MINI)
    assert none is None
    drawn = policy.data_for([MINI]).record["sampled"]
    assert drawn == (algorithm is not DQN), "policies draw their actions in fleets"
    policy = network_policy(model.policy, 5)
    runs = []
    for kind, agents in ((DriverKind(policy=policy), None), (DriverKind(), [agent])):
        fleet = Fleet(MINI, DEMAND, drivers=[kind], max_steps=60, leave_full_lot=False)
        runs.append(driven(fleet, 3, agents=agents).cars[["total_s", "n_steps", "slot"]].copy())
    np.testing.assert_array_equal(*runs)


def test_drawn_actions_have_the_probabilities_of_the_policy():
    model = small(MaskablePPO)
    policy = pickle.loads(pickle.dumps(network_policy(model.policy, 5, sampled=True)))
    demand = Demand(PoissonArrivals(600.0, 8 * 3600, 9 * 3600))
    fleet = Fleet(MINI, demand, drivers=[DriverKind(policy=policy)], max_steps=1, background="none")
    actual = np.concatenate([driven(fleet, 0, day).cars["vertex"].copy() for day in range(6)])
    twin = Fleet(MINI, demand, drivers=[DriverKind()], max_steps=1, background="none")
    twin.reset(0)
    car = twin.next_decision()
    observation = twin.local_observation(car)
    batched, _ = model.policy.obs_to_tensor(observation)
    wanted = model.policy.get_distribution(batched, action_masks=observation["action_mask"]).distribution
    probabilities = wanted.probs.detach().numpy()[0]
    allowed = np.flatnonzero(observation["action_mask"])
    neighbors = MINI.lot.neighbors[int(twin.cars["entry"][car])]
    for action in allowed[allowed < 4]:
        reached = np.mean(actual == neighbors[action])
        assert reached == pytest.approx(probabilities[action], abs=0.03)


def test_layers_that_do_not_fit_are_named():
    with pytest.raises(InputError, match="want a chain from 91 numbers to 5"):
        compiled_network([(np.zeros((5, 7), np.float32), np.zeros(5, np.float32))])
    with pytest.raises(InputError, match="activation is 'elu'"):
        compiled_network([(np.zeros((5, 91), np.float32), np.zeros(5, np.float32))], activation="elu")
