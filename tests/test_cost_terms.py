"""The costs of a step add up to its reward, and those of an episode to its total time, in every adapter."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from small_lots import features

from parkenv import ParkingLot, lot_v0, make_scenario
from parkenv.engine.records import CAR, N_TERMS, SEARCH
from parkenv.envs.sb3 import SearchVecEnv
from parkenv.envs.search_vector import ParkSearchVectorEnv
from parkenv.studies.trips.driven_search import DrivenSearch
from parkenv.world.cost_terms import COST_FIELDS, COST_TERMS, METRICS, REWARD_TERMS
from parkenv.world.tariff import Tariff

SLOT_S, ZONE_S = 15.0, 30.0  # of parking: of the slot itself, and of an hour in its zone
PRICE_S = SLOT_S + ZONE_S  # of a search, which is for the expected stay of an hour
LIMIT = 60


@pytest.fixture(scope="module")
def scenario():
    """A lot where every slot has a cost, its zone a price, and where a failed attempt is likely."""
    plain = make_scenario("mini")
    lot = ParkingLot(**features(plain.lot) | {"slot_parking_cost_s": np.full(plain.lot.n_slots, SLOT_S)})
    tariff = Tariff({"other": 12.0 * ZONE_S / 3600.0})
    return replace(plain, lot=lot, failure_s=7.0, tariff=tariff, value_of_time=12.0)


def check_sums(info, parked=True, of_many=False):
    """The terms of an episode, as `info` names them, are its total; of many cars each pays for its own stay."""
    assert set(METRICS) <= set(info)
    assert sum(info[name] for name in COST_FIELDS) == pytest.approx(info["total_s"])
    if parked:
        assert info["parked"]
        paid_s = info["parking_cost_s"]
        assert paid_s > SLOT_S if of_many else paid_s == pytest.approx(PRICE_S)


def check_step(reward, info):
    """The terms of a step are its reward."""
    assert sum(info[name] for name in REWARD_TERMS) == pytest.approx(reward)


def tries(mask, rng):
    """A random action that the graph has, mostly parking where there is a slot."""
    return 4 if mask[4] and rng.random() < 0.7 else int(rng.choice(np.nonzero(mask)[0]))


@pytest.mark.parametrize(
    ("name", "options", "searches"),
    [
        ("Search-v2", {}, 3),
        ("SearchSensors-v2", {"observation": "scan"}, 3),
        pytest.param("SearchPerception-v2", {"captures": 1, "picture_width": 160}, 1, marks=pytest.mark.slow),
    ],
)
def test_single_searches(scenario, name, options, searches):
    env = gym.make(f"parkenv/{name}", scenario=scenario, **options)
    rng, seen = np.random.default_rng(0), set()
    for seed in range(searches):
        observation, _ = env.reset(seed=seed)
        returned, over, sums = 0.0, False, dict.fromkeys(REWARD_TERMS, 0.0)
        while not over:
            observation, reward, terminated, truncated, info = env.step(
                tries(observation["action_mask"], rng)
            )
            check_step(reward, info)
            check_sums(info, parked=bool(terminated and info["parked"]))
            returned, over = returned + reward, terminated or truncated
            sums = {term: sums[term] - info[term] for term in REWARD_TERMS}
        assert info["total_s"] == pytest.approx(-returned)
        for term in COST_TERMS:
            assert info[term.field] == pytest.approx(sums[f"reward_{term.name}"])
        seen |= {term.name for term in COST_TERMS if info[term.field]}
    assert {"drive", "walk", "parking"} <= seen


def test_the_batch(scenario):
    envs = ParkSearchVectorEnv(8, scenario, max_episode_steps=LIMIT, autoreset_mode=AutoresetMode.SAME_STEP)
    observations, _ = envs.reset(seed=0)
    rng, returns, ended = np.random.default_rng(0), np.zeros(8), 0
    for _ in range(200):
        actions = np.array([tries(mask, rng) for mask in observations["action_mask"]])
        observations, rewards, terminated, truncated, infos = envs.step(actions)
        returns += rewards
        done = terminated | truncated
        for i in np.flatnonzero(done):
            final = {name: infos["final_info"][name][i] for name in METRICS}
            check_sums(final, parked=bool(final["parked"]))
            terms = infos["final_info"]
            assert sum(terms[name][i] for name in REWARD_TERMS) == pytest.approx(rewards[i])
            assert final["total_s"] == pytest.approx(-returns[i])
            ended += int(final["parked"])
        returns[done] = 0.0
    assert ended > 10


def test_stable_baselines3(scenario):
    venv = SearchVecEnv(4, scenario, max_episode_steps=LIMIT)
    venv.seed(0)
    venv.reset()
    rng, ended = np.random.default_rng(0), 0
    for _ in range(200):
        actions = np.array([tries(mask, rng) for mask in venv.action_masks()])
        _, _, done, infos = venv.step(actions)
        for i in np.flatnonzero(done):
            check_sums(infos[i], parked=infos[i]["parked"])
            assert infos[i]["episode"]["r"] == pytest.approx(-infos[i]["total_s"])
            ended += int(infos[i]["parked"])
    assert ended > 10


@pytest.mark.filterwarnings("ignore")
def test_many_cars_as_agents(scenario):
    env = lot_v0.env(scenario=scenario, cars=6)
    env.reset(seed=0)
    rng, returns, parked = np.random.default_rng(0), {}, 0
    for car in env.agent_iter():
        observation, _, terminated, truncated, info = env.last()
        if info:
            returns[car] = returns.get(car, 0.0) + sum(info[name] for name in REWARD_TERMS)
            check_sums(info, parked=info["parked"], of_many=True)
        if terminated or truncated:
            assert info["total_s"] == pytest.approx(-returns[car])
            parked += int(info["parked"])
            env.step(None)
        else:
            env.step(tries(observation["action_mask"], rng))
    assert parked > 0


def test_driven_trips(scenario):
    trip = DrivenSearch(scenario).run(seed=1)
    assert trip.parked
    assert trip.costs["parking_cost_s"] == pytest.approx(PRICE_S)
    assert set(trip.costs) == set(COST_FIELDS) - {"drive_s"}
    assert trip.total_s == pytest.approx(trip.lanes_s + trip.manoeuvre_s + sum(trip.costs.values()))


@pytest.mark.parametrize("record", [SEARCH, CAR])
def test_records_hold_every_term_in_order(record):
    one = np.zeros(1, record)
    one["costs"] = np.arange(N_TERMS) + 1.0
    assert [one[name][0] for name in COST_FIELDS] == [i + 1.0 for i in range(N_TERMS)]
