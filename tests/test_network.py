"""The agent `network`: symmetry, one size for all lots, masks, parity with PyTorch, files, training."""

import itertools
import json
from functools import partial
from importlib import import_module

import gymnasium as gym
import numpy as np
import pytest
from small_lots import full_lot

import parkenv
from parkenv.belief.slot_belief import SlotBelief
from parkenv.errors import InputError
from parkenv.lots import grid_lot
from parkenv.scenarios.build import make_scenario
from parkenv.studies.simulate import simulate
from planners.agent import agent_file, make_agent
from planners.network.agent import NetworkAgent
from planners.network.features import ACTION_FEATURES, CANDIDATES, PARKING, TOKEN_FEATURES, WAITING, Features
from planners.network.policy import SHIPPED, NetworkCard, NetworkPolicy


def random_policy(seed=0, **card):
    """A network with random weights."""
    rng, card = np.random.default_rng(seed), NetworkCard(**card)
    weights = {name: rng.normal(0.0, 0.2, shape).astype(np.float32) for name, shape in card.shapes().items()}
    return NetworkPolicy(card, weights)


def decisions(agent, scenario, seed, most=60):
    """The actions of one search, with observations, features and scores."""
    env = gym.make("parkenv/Search-v2", scenario=scenario)
    observation, _ = env.reset(seed=seed)
    memory, found = None, []
    for _ in range(most):
        action, memory = agent.predict(observation, memory)
        features = None if agent.last_features is None else [a.copy() for a in agent.last_features]
        found.append((observation, int(action), features, agent.last_scores))
        observation, _, terminated, _, _ = env.step(action)
        if terminated:
            break
    return found


@pytest.mark.parametrize("name", ["campus", "street"])
def test_turning_the_map_changes_nothing(name):
    """A quarter turn permutes the columns of the moves, and nothing else that the agent knows."""
    scenario = make_scenario(name)
    agent, turned = (NetworkAgent(scenario, random_policy()) for _ in range(2))
    order = [2, 3, 1, 0]  # up becomes left, and so on
    turned._neighbors = turned._neighbors[:, order].copy()
    turned._move_s = turned._move_s[:, order].copy()
    found, memory = decisions(agent, scenario, seed=3), None
    rows = [*order, PARKING, WAITING]
    for observation, _, features, scores in found:
        _, memory = turned.predict(observation, memory)
        if features is None:
            continue
        for one, other in zip(features, turned.last_features, strict=True):
            np.testing.assert_array_equal(one[rows], other)
        np.testing.assert_allclose(scores[rows], turned.last_scores, atol=1e-5)
    assert len(found) > 3


def test_the_same_weights_serve_small_and_large_lots():
    policy = random_policy()
    for lot in (grid_lot(2, 5), grid_lot(20, 50)):
        scenario = make_scenario(lot, day_error=0.8)
        agent = NetworkAgent(scenario, policy)
        (_, _, features, scores), *_ = decisions(agent, scenario, seed=0, most=1)
        assert features[0].shape == (6, ACTION_FEATURES)
        assert features[1].shape == (6, CANDIDATES, TOKEN_FEATURES)
        assert np.isfinite(scores[features[2]]).all()
        assert all(np.isfinite(a[features[2]]).all() for a in features[:2])


def test_times_are_relative():
    """If everything takes twice the time, the network observes the same."""
    scenario = make_scenario("campus", day_error=0.0)
    slow = scenario.replace(
        v_drive=scenario.v_drive / 2.0, v_walk=scenario.v_walk / 2.0, failure_s=2.0 * scenario.failure_s,
        wait_s=2.0 * scenario.wait_s, give_up_s=2.0 * scenario.give_up_s,
    )  # fmt: skip
    observation, _ = gym.make("parkenv/Search-v2", scenario=scenario).reset(seed=0)
    SlotBelief.of_observation(observation).decay_rate[:] = 0.0  # cars are as quick as before
    agents = [NetworkAgent(one, random_policy()) for one in (scenario, slow)]
    for agent, factor in zip(agents, (1.0, 2.0), strict=True):
        # The costs of the look-ahead are in seconds, so they are scaled as well.
        agent._failure_costs = agent._failure_costs * factor
        agent.predict(observation)
    for one, other in zip(agents[0].last_features[:2], agents[1].last_features[:2], strict=True):
        np.testing.assert_allclose(one, other, atol=1e-3)


@pytest.mark.parametrize("seed", range(3))
def test_only_actions_that_there_are_are_taken(seed):
    scenario = make_scenario("mini")
    agent = NetworkAgent(scenario, random_policy(seed))
    for observation, action, features, scores in decisions(agent, scenario, seed):
        allowed = features[2]
        np.testing.assert_array_equal(np.isfinite(scores), allowed)
        np.testing.assert_array_equal(allowed[:PARKING], observation["action_mask"][:PARKING].astype(bool))
        if observation["action_mask"][action] == 0:  # waiting
            assert scores.argmax() == WAITING
        if action == PARKING:
            assert not SlotBelief.of_observation(observation).observed_taken[observation["vertex"]]


def test_the_look_ahead_knows_the_shortest_drive_and_walk_where_all_slots_are_free():
    problem = make_scenario(grid_lot(4, 12), day_error=0.0).public()
    agent = NetworkAgent(problem, random_policy())
    belief = SlotBelief.of_forecast(np.full(problem.lot.n_slots, 1e-9), np.zeros(problem.lot.n_slots))
    vertex = int(problem.lot.entry_vertices[0])
    observation = {
        "vertex": vertex, "time": np.zeros(2, np.float32), "action_mask": problem.action_masks[vertex],
        **belief.to_observation(),
    }  # fmt: skip
    _, memory = agent.predict(observation)
    near = memory.near
    best = (near.table.seconds[near.index(vertex)][: near.n_slots] + near.cost_s).min()
    assert agent.last_features.lookahead_s.min() == pytest.approx(best, rel=0.02)


@pytest.fixture(scope="module")
def example():
    """The example that trains the network."""
    pytest.importorskip("torch")
    return import_module("examples.train_network")


def test_numpy_and_torch_agree(example):
    import torch

    rng, n = np.random.default_rng(0), 32
    tokens = rng.uniform(-1.0, 1.0, (n, 6, CANDIDATES, TOKEN_FEATURES)).astype(np.float32)
    tokens[..., 0] = rng.random((n, 6, CANDIDATES)) < 0.7
    actions = rng.uniform(0.0, 1.0, (n, 6, ACTION_FEATURES)).astype(np.float32)
    allowed = rng.random((n, 6)) < 0.6
    allowed[:, 0] = True
    policy = random_policy()
    network = example.Network(policy.card)
    with torch.no_grad():
        for name, values in policy.weights.items():
            network.layers[name.replace(".", "_")].copy_(torch.from_numpy(values))
        found = network(*map(torch.from_numpy, (actions, tokens, allowed))).numpy()
    batch = policy.scores(Features(actions, tokens, allowed, np.zeros((n, 6))))
    np.testing.assert_allclose(batch[allowed], found[allowed], atol=2e-5)
    for i in range(3):
        single = policy.scores(Features(actions[i], tokens[i], allowed[i], np.zeros(6)))
        np.testing.assert_allclose(single, batch[i], atol=2e-5)
    for name, values in network.policy().weights.items():
        np.testing.assert_array_equal(values, policy.weights[name])


def test_trained_weights_are_repeatable_and_drive(example, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    few_of = {"SCENARIOS": ("mini",), "DECISIONS": 20, "EPOCHS": 20, "BATCH": 16, "WORLDS": 2}
    for name, few in few_of.items():
        monkeypatch.setattr(example, name, few)
    monkeypatch.setattr(parkenv, "compare", partial(parkenv.compare, jobs=1))
    files = []
    for _ in range(2):
        example.main()
        files.append((tmp_path / example.FILE).read_bytes())
    assert files[0] == files[1]
    agent = make_agent(f"network:{example.FILE}", make_scenario("mini"))
    assert agent.policy.card.trained_on == ("mini",)


def test_files_keep_weights_and_card_and_other_libraries_read_them(tmp_path):
    safetensors = pytest.importorskip("safetensors.numpy")
    policy = random_policy(seed=3, trained_on=("a", "b"), command=("parkenv", "train"))
    policy.save(tmp_path / "it.safetensors")
    read = NetworkPolicy.load(tmp_path / "it.safetensors")
    assert read.card == policy.card
    for weights in (read.weights, safetensors.load_file(tmp_path / "it.safetensors")):
        for name, values in policy.weights.items():
            np.testing.assert_array_equal(values, weights[name])


def spoilt():
    """Bytes of files that are no network, and what is said of them."""
    data = SHIPPED.read_bytes()
    size = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + size])

    def with_header(**changes):
        text = json.dumps({**header, **changes}).encode()
        return len(text).to_bytes(8, "little") + text + data[8 + size :]

    def with_card(**card):
        return with_header(__metadata__={"parkenv": json.dumps(card)})

    nan = np.full((len(data) - 8 - size) // 4, np.nan, "<f4").tobytes()
    name = "token_1.weight"
    return [
        (None, "bad.safetensors"),
        (b"", "no model file"),
        (b"PK\x03\x04" + bytes(50), "no model file"),
        (data[: len(data) // 2], "weights"),
        (with_header(__metadata__={}), "no card"),
        (with_card(format="parkenv-model-2"), "no card"),
        (with_card(**json.loads(header["__metadata__"]["parkenv"]) | {"width": 10**9}), "width"),
        (with_header(**{name: {**header[name], "shape": [1, 1]}}), "weights"),
        (with_header(**{name: {**header[name], "data_offsets": [-4, 4]}}), "weights"),
        (data[: 8 + size] + nan, "no numbers"),
    ]


@pytest.mark.parametrize(("content", "wanted"), spoilt(), ids=range(10))
def test_bad_files_are_one_clear_line(tmp_path, content, wanted):
    path = tmp_path / "bad.safetensors"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=wanted) as caught:
        make_agent(f"network:{path}", make_scenario("mini"))
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


def test_the_shipped_network_is_small_and_own_weights_are_named_after_a_colon(tmp_path):
    policy = NetworkPolicy.load()
    assert sum(w.size for w in policy.weights.values()) < 300_000
    assert policy.card.trained_on
    assert policy.card.command[:3] == ("parkenv", "train", "network")
    path = tmp_path / "own.safetensors"
    path.write_bytes(SHIPPED.read_bytes())
    scenario = make_scenario("mini")
    own, shipped = make_agent(f"network:{path}", scenario), make_agent("network", scenario)
    assert [d[1] for d in decisions(own, scenario, 1)] == [d[1] for d in decisions(shipped, scenario, 1)]
    assert agent_file(f"network:{path}") == path


@pytest.mark.parametrize("name", ["campus", "street", "jam", "mini"])
def test_it_parks_and_repeats_itself(name):
    scenario = make_scenario(name)
    env = gym.make("parkenv/Search-v2", scenario=scenario)
    agents = make_agent("network", scenario), make_agent("network", scenario)
    for seed in range(2):
        first, second = (simulate(env, agent, seed) for agent in agents)
        assert not first.truncated
        assert first.info["total_s"] == second.info["total_s"]
        assert first.steps == second.steps


def test_without_news_it_does_not_circle_forever():
    """A network that always wants to turn back is made to drive on."""
    scenario, policy = make_scenario("campus"), random_policy()
    for weights in policy.weights.values():
        weights[...] = 0.0
    agent = NetworkAgent(scenario, policy)
    visited = [int(observation["vertex"]) for observation, *_ in decisions(agent, scenario, 0, most=200)]
    pairs = list(itertools.pairwise(visited))
    assert max(pairs.count(pair) for pair in set(pairs)) < 20


def test_it_does_not_prove_a_full_lot_full():
    """To see the last slot taken ends a search with the penalty; until then a car may leave."""
    scenario = make_scenario(full_lot(grid_lot(2, 20)), day_error=0.8)
    env = gym.make("parkenv/Search-v2", scenario=scenario, max_episode_steps=200)
    assert simulate(env, make_agent("network", scenario), 0).truncated
