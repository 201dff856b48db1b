"""`parkenv.lot_v0`: PettingZoo's own tests, and its two forms beside each other."""

import importlib
import sys

import numpy as np
import pytest
from gymnasium.error import DependencyNotInstalled
from pettingzoo import test

from parkenv import InputError, OccupancyProcess, Scenario, lot_v0
from parkenv.lots import grid_lot
from parkenv.world.cost_terms import REWARD_TERMS
from parkenv.world.cues import Cues
from parkenv.world.demand import ConstantTime, Demand, ListedArrivals
from planners.agent import make_agent

# PettingZoo knows by name which environments may have dictionaries as observations.
pytestmark = [
    pytest.mark.filterwarnings("ignore:Observation is not a NumPy array"),
    pytest.mark.filterwarnings("ignore:Observation space for each agent probably should be"),
]


ALL = {"knows": "full", "sees_cars": True, "cues": Cues(), "manoeuvre_s": 5.0}


@pytest.mark.parametrize("options", [{}, ALL])
def test_pettingzoo_s_tests_of_interface_and_seeds(options):
    test.api_test(lot_v0.env(cars=3, **options), num_cycles=40)
    test.parallel_api_test(lot_v0.parallel_env(cars=3, tick_s=5.0, **options), num_cycles=100)
    test.seed_test(lambda: lot_v0.env(cars=3, **options), num_cycles=20)
    test.parallel_seed_test(lambda: lot_v0.parallel_env(cars=3, **options), num_cycles=20)


def test_pettingzoo_s_tests_of_pictures_and_max_cycles(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    test.render_test(lot_v0.env)
    environment = lot_v0.parallel_env(render_mode="rgb_array")
    environment.reset(seed=0)
    assert environment.render().shape == (480, 640, 3)
    test.max_cycles_test(lot_v0)


def aec_run(environment, seed, policy):
    """Observations, rewards and ends of every car, in order."""
    environment.reset(seed=seed)
    seen = {agent: [] for agent in environment.agents}
    for agent in environment.agent_iter():
        observation, reward, terminated, truncated, _ = environment.last()
        seen[agent].append((observation, reward, terminated, truncated))
        environment.step(None if terminated or truncated else policy(agent, observation))
    return seen


def parallel_run(environment, seed, policy):
    """As `aec_run`, of the ticks at which something happened to a car."""
    observations, _ = environment.reset(seed=seed)
    seen = {agent: [] for agent in environment.agents}
    rewards = dict.fromkeys(environment.agents, 0.0)
    ended = dict.fromkeys(environment.agents, (False, False))
    while True:
        for agent, observation in observations.items():
            if observation["action_mask"].any() or any(ended[agent]):
                seen[agent].append((observation, rewards[agent], *ended[agent]))
        if not environment.agents:
            return seen
        actions = {
            agent: policy(agent, observations[agent]) if observations[agent]["action_mask"].any() else 0
            for agent in environment.agents
        }
        observations, rewards, terminated, truncated, _ = environment.step(actions)
        ended = {agent: (terminated[agent], truncated[agent]) for agent in observations}


def assert_alike(one, other):
    assert one.keys() == other.keys()
    for agent in one:
        assert len(one[agent]) == len(other[agent])
        for (observed, *rest), (also_observed, *also_rest) in zip(one[agent], other[agent], strict=True):
            assert rest == also_rest
            for key in observed:
                np.testing.assert_array_equal(observed[key], also_observed[key], strict=True)


def test_both_forms_are_alike_where_ticks_divide_all_times():
    """Every drive, failed attempt and arrival takes a multiple of an eighth of a second."""
    process = OccupancyProcess.from_demand(np.full(12, 1.0), np.zeros(168), 60.0)
    times = {"v_drive": 2.0, "failure_s": 3.0, "wait_s": 1.0}
    scenario = Scenario(lot=grid_lot(2, 6), name="grid", occupancy=process, **times)
    arrivals = ListedArrivals((36000.0, 36000.0, 36003.0, 36005.5, 36030.0))
    demand = Demand(arrivals, stay=ConstantTime(20.0))
    options = {"scenario": scenario, "demand": demand, "max_cycles": 100_000}

    def policy():
        rng = np.random.default_rng(3)
        draws = {f"car_{i}": rng.random(5000) for i in range(5)}
        counts = dict.fromkeys(draws, 0)

        def choose(agent, observation):
            actions = np.flatnonzero(observation["action_mask"])
            counts[agent] += 1
            return int(actions[int(draws[agent][counts[agent]] * len(actions))])

        return choose

    for seed in range(2):
        aec = aec_run(lot_v0.raw_env(**options), seed, policy())
        parallel = parallel_run(lot_v0.parallel_env(**options, tick_s=0.125 / (seed + 1)), seed, policy())
        assert_alike(aec, parallel)


def test_every_agent_drives_a_car_whose_rewards_are_sums_of_terms_and_whose_return_is_its_total_time():
    names = ["mdp", "greedy-goal", "greedy-drive", "first-free", "random", "belief", "network"]
    environment = lot_v0.raw_env(scenario="mini", cars=len(names))
    drivers = {f"car_{i}": make_agent(name, environment.scenario) for i, name in enumerate(names)}
    memory, totals, returns = {}, {}, dict.fromkeys(drivers, 0.0)
    environment.reset(seed=1)
    for agent in environment.agent_iter():
        observation, reward, terminated, truncated, info = environment.last()
        returns[agent] += reward
        if info:
            assert reward == pytest.approx(sum(info[name] for name in REWARD_TERMS))
            totals[agent] = info["total_s"]
        action = None
        if not (terminated or truncated):
            action, memory[agent] = drivers[agent].predict(observation, memory.get(agent))
        environment.step(action)
    assert returns == pytest.approx({agent: -total for agent, total in totals.items()})


def test_a_bad_tick_and_missing_actions_are_refused():
    with pytest.raises(InputError, match="tick_s is 0"):
        lot_v0.parallel_env(tick_s=0)
    environment = lot_v0.parallel_env()
    environment.reset(seed=0)
    with pytest.raises(InputError, match="actions lack car_0"):
        environment.step({})


def test_without_pettingzoo_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "pettingzoo", None)
    monkeypatch.delitem(sys.modules, "parkenv.lot_v0")
    with pytest.raises(DependencyNotInstalled, match=r"parkenv\[multi\]"):
        importlib.import_module("parkenv.lot_v0")
