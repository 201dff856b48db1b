"""Methods of others as agents of ours, and comparisons of planners at several times for a decision."""

import gc
import random
import sys
from importlib import import_module
from itertools import permutations

import gymnasium as gym
import numpy as np
import pytest
from command_line import parkenv as command
from test_model import numbers_in

import parkenv
from parkenv import InputError
from planners import make_agent

PEERS = ("examples.peers.pomdp_py_agents:POUCT", "examples.peers.pomdp_py_agents:POMCP")
OF_PAPERS = tuple(
    f"examples.peers.{name}"
    for name in ("lmu:ReplannedMDP", "mit:StopsAhead", "mit:Impatient", "mit:Patient")
)


@pytest.fixture
def in_root(monkeypatch, request):
    monkeypatch.chdir(request.config.rootpath)
    monkeypatch.syspath_prepend(request.config.rootpath)


@pytest.fixture
def peers(in_root):
    pytest.importorskip("pomdp_py", reason="needs the extra pomdp: pomdp-py")
    return PEERS


def totals(env, agent, n=8):
    return np.mean([parkenv.simulate(env, agent, seed=seed).info["total_s"] for seed in range(n)])


def test_planners_of_pomdp_py_gain_on_the_heuristic_of_their_rollouts(peers):
    scenario = parkenv.make_scenario("mini", day_error=0.8)
    env = gym.make("parkenv/Search-v2", scenario=scenario)
    at_random = totals(env, make_agent("random", scenario))
    for name in peers:
        assert totals(env, make_agent(name, scenario, simulations=30, base="random")) < 0.6 * at_random


def test_planners_of_pomdp_py_are_seeded_and_leave_the_generator_of_python_alone(peers):
    scenario = parkenv.make_scenario("mini", day_error=0.8)
    env = gym.make("parkenv/Search-v2", scenario=scenario)
    for name in peers:
        found = []
        for seed in (1, 2):
            random.seed(seed)
            state = random.getstate()
            found.append(totals(env, make_agent(name, scenario, simulations=30), n=4))
            assert random.getstate() == state
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


def test_methods_of_papers_search_and_are_seeded(in_root):
    scenario = parkenv.make_scenario("mini", day_error=0.8)
    env = gym.make("parkenv/Search-v2", scenario=scenario)
    least = {name: totals(env, make_agent(name, scenario), 4) for name in ("belief", "random")}
    for name in OF_PAPERS:
        found = [totals(env, make_agent(name, scenario), 4) for _ in range(2)]
        assert found[0] == found[1]
        assert found[0] < least["random"] or name.endswith("Patient")
        if name.endswith(("StopsAhead", "ReplannedMDP")):
            assert found[0] < least["belief"] + 3.0


def test_an_agent_of_a_paper_reaches_no_hidden_state(in_root):
    env = gym.make("parkenv/Search-v2", scenario=parkenv.make_scenario("mini"))
    for name in OF_PAPERS:
        agent = make_agent(name, env.unwrapped.scenario)
        assert type(agent.problem) is parkenv.world.scenario.SearchProblem
        observation, _ = env.reset(seed=3)
        _, memory = agent.predict(observation, None)
        record = env.unwrapped.searches.records[0]
        hidden = [record[key].tobytes() for key in ("key", "seed_state")]
        assert not any(key in found for found in numbers_in(agent, memory) for key in hidden)


def test_stops_ahead_are_the_formulas_of_the_paper(in_root):
    scenario, to_lot_s = parkenv.make_scenario("mini"), np.array([20.0, 10.0])
    p, walk_s, drive_s = (
        np.array([0.8, 0.5]),
        np.array([30.0, 60.0]),
        np.array([[300.0, 15.0], [12.0, 300.0]]),
    )
    expected = {}
    for stops in (1, 2, 3):
        agent = make_agent("examples.peers.mit:StopsAhead", scenario, stops=stops)
        agent.cost_s, agent.between_s = walk_s, drive_s
        expected[stops] = agent.expected_s(to_lot_s, p)
    assert expected[1] == pytest.approx([20 / 0.8 + 30, 10 / 0.5 + 60])
    second = [min(300 / 0.8 + 30, 15 / 0.5 + 60), min(12 / 0.8 + 30, 300 / 0.5 + 60)]
    assert expected[2] == pytest.approx([20 + 0.8 * 30 + 0.2 * second[0], 10 + 0.5 * 60 + 0.5 * second[1]])
    third = [
        min(drive_s[i, j] + p[j] * walk_s[j] + (1 - p[j]) * second[j] for j in range(2)) for i in range(2)
    ]
    assert expected[3] == pytest.approx([20 + 0.8 * 30 + 0.2 * third[0], 10 + 0.5 * 60 + 0.5 * third[1]])
    with pytest.raises(InputError, match="stops is 4"):
        make_agent("examples.peers.mit:StopsAhead", scenario, stops=4)


def time_in_order(bays, between_s, p, cost_s, wait_s):
    """Return the expected time from the first bay, which is taken, on to the others, and of a wait at the last."""
    here, *then = bays
    if not then:
        return wait_s[here]
    after_s = time_in_order(then, between_s, p, cost_s, wait_s)
    return between_s[here, then[0]] + p[then[0]] * cost_s[then[0]] + (1 - p[then[0]]) * after_s


def test_the_mdp_of_bays_is_the_best_order_of_them(in_root):
    lmu, rng, n = import_module("examples.peers.lmu"), np.random.default_rng(0), 4
    for _ in range(20):
        between_s, p = rng.uniform(1, 50, (n, n)), rng.random(n)
        cost_s, wait_s = rng.uniform(5, 60, n), rng.uniform(100, 200, n)
        found = lmu.best_times(list(lmu.sets_of(n)), between_s, p, cost_s, wait_s)
        orders = [(0, *rest[:k]) for rest in permutations(range(1, n)) for k in range(n)]
        assert found[0b0001, 0] == pytest.approx(
            min(time_in_order(bays, between_s, p, cost_s, wait_s) for bays in orders)
        )


def test_bays_are_markov_chains_to_the_moment_of_arrival(in_root):
    scenario = parkenv.make_scenario("mini")
    agent = make_agent("examples.peers.lmu:ReplannedMDP", scenario)
    belief = parkenv.belief.slot_belief.SlotBelief.of_forecast(np.full(10, 0.8), np.full(10, 1e-2))
    belief = belief.update([4], [False])
    assert agent.p_free(belief, np.full(10, 100.0)) == pytest.approx(1.0 - belief.decay(100.0).p_occupied)


def test_cars_of_a_fleet_that_share_reserve_and_adapt(in_root):
    pytest.importorskip("pettingzoo", reason="needs the extra multi: pettingzoo")
    fleet = import_module("examples.peers.lmu_fleet")
    for kind in fleet.FLEETS:
        times_s = fleet.total_times(kind, "mini", 3, seed=1)
        assert times_s == fleet.total_times(kind, "mini", 3, seed=1)
        assert len(times_s) == 3
        assert min(times_s) > 0.0


PIPED = "examples.peers.in_another_environment:Piped"
SERVER = """
import json, sys, time
print('hello', file=sys.stderr)
for line in sys.stdin:
    message = json.loads(line)
    if 'problem' in message:
        print(json.dumps({'ready': True}), flush=True)
        continue
    mask = message['observation']['action_mask']
    print(ANSWER, flush=True)
"""


class FirstMove:
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return int(observation["action_mask"].argmax()), state


def test_an_agent_in_a_process_of_its_own(in_root, tmp_path):
    scenario, file = parkenv.make_scenario("mini"), tmp_path / "server.py"
    env = gym.make("parkenv/Search-v2", scenario=scenario, max_episode_steps=20)
    file.write_text(SERVER.replace("ANSWER", "json.dumps({'action': mask.index(1)})"))
    agent = make_agent(PIPED, scenario, command=f"'{sys.executable} {file}'")
    found, wanted = (parkenv.simulate(env, driver, seed=1).info["total_s"] for driver in (agent, FirstMove()))
    assert found == wanted
    process = agent.process.process
    del agent
    gc.collect()
    assert process.poll() is not None


@pytest.mark.slow  # waits in vain for 5 s
def test_what_goes_wrong_in_a_process_of_its_own_is_told(in_root, tmp_path):
    scenario, file = parkenv.make_scenario("mini"), tmp_path / "server.py"
    env = gym.make("parkenv/Search-v2", scenario=scenario, max_episode_steps=20)
    for answer, message in (
        ("1 / 0", r"ended with exit code 1; its last line: ZeroDivisionError"),
        ("time.sleep(60)", r"no answer within 5 s; its last line: hello"),
        ("'parked'", r"answered 'parked\\n', want a line with a JSON object"),
        ("json.dumps({'action': 7})", r"action is 7, want 0 to 4"),
    ):
        file.write_text(SERVER.replace("ANSWER", answer))
        limit_s = 5.0 if "sleep" in answer else 60.0
        agent = make_agent(PIPED, scenario, command=f"{sys.executable} {file}", start_s=limit_s)
        with pytest.raises(InputError, match=message):
            parkenv.simulate(env, agent, seed=1)
    with pytest.raises(InputError, match="cannot be run: No such file"):
        parkenv.simulate(env, make_agent(PIPED, scenario, command="no-such-command"), seed=1)
