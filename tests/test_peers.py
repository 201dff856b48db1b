"""The planners of pomdp-py as agents of ours, and comparisons of planners at several times for a decision."""

import gymnasium as gym
import numpy as np
import pytest
from command_line import parkenv as command
from test_model import numbers_in

import parkenv
from parkenv import InputError
from planners import make_agent

PEERS = ("examples.peers.pomdp_py_agents:POUCT", "examples.peers.pomdp_py_agents:POMCP")


@pytest.fixture
def peers(monkeypatch, request):
    pytest.importorskip("pomdp_py", reason="needs the extra pomdp: pomdp-py")
    monkeypatch.chdir(request.config.rootpath)
    return PEERS


def totals(env, agent, n=8):
    return np.mean([parkenv.simulate(env, agent, seed=seed).info["total_s"] for seed in range(n)])


def test_planners_of_pomdp_py_gain_on_the_heuristic_of_their_rollouts(peers):
    scenario = parkenv.make_scenario("mini", day_error=0.8)
    env = gym.make("parkenv/Search-v2", scenario=scenario)
    least = totals(env, make_agent("greedy-total", scenario))
    for name in peers:
        found = [totals(env, make_agent(name, scenario, simulations=60)) for _ in range(2)]
        assert found[0] < least + 0.5
        if name == PEERS[0]:  # POMCP draws with Python's own generator
            assert found[0] == found[1]


def test_no_key_of_the_world_can_be_reached_from_their_memory(peers):
    env = gym.make("parkenv/Search-v2", scenario=parkenv.make_scenario("mini"))
    for name in peers:
        agent, memory = make_agent(name, env.unwrapped.scenario, simulations=20), None
        observation, _ = env.reset(seed=3)
        for _ in range(2):
            action, memory = agent.predict(observation, memory)
            observation, *_ = env.step(action)
        record = env.unwrapped.searches.records[0]
        hidden = [record[key].tobytes() for key in ("key", "seed_state")]
        roots = (agent, memory, memory.agent.belief, memory.planner)
        assert not any(key in found for found in numbers_in(*roots) for key in hidden)


def test_a_budget_that_no_agent_takes_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"budget_ms is 10, and no agent takes it: mdp"):
        parkenv.compare(
            scenarios=["mini"], agents=["mdp"], grid={"budget_ms": [10.0]}, episodes=1, jobs=1,
            folder=tmp_path / "run",
        )  # fmt: skip
    done = command("compare", "--agents", "rollout", "--budget-ms", "0,x", "--out", tmp_path / "run")
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "run").exists()
