"""Copies, pickles, saved states and changed results of all kinds of environments, batches and simulated searches."""

import copy
import os
import pickle
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from test_search_reference import recorded_scenario
from test_sensors_env import SMALL_RIG

import parkenv
from parkenv import Traffic
from parkenv.envs.local_observation import LocalObservation
from parkenv.envs.search_vector import ParkSearchVectorEnv
from parkenv.lots.generators import grid_lot

DRIVEN = (3, 3, 1, 3, 0, 2)
INNER = {"states", "envs", "one_by_one", "at_once", "fleet"}


def parts(result):
    """Return all numbers and texts of a result, in order."""
    if isinstance(result, dict):
        return [part for name in sorted(result) for part in parts(result[name])]
    if isinstance(result, (tuple, list)) or (isinstance(result, np.ndarray) and result.dtype == object):
        return [part for item in result for part in parts(item)]
    return [result.tobytes() if isinstance(result, np.ndarray) else result]


def spoil(result):
    """Write to all arrays of a result."""
    for item in result.values() if isinstance(result, dict) else result:
        if isinstance(item, np.ndarray) and item.dtype != object:
            item[...] = 1 if item.dtype.kind in "bU" else 77
        elif isinstance(item, (dict, tuple, list, np.ndarray)):
            spoil(item)


class ModelState:
    """A simulated search with the interface of an environment; several kinds of objects hang on it."""

    def __init__(self):
        env = gym.make("parkenv/Search-v2", scenario="mini")
        self.model = parkenv.model(env.unwrapped.scenario)
        self.belief = self.model.initial_belief(env.reset(seed=0)[0])

    def reset(self, seed):
        self.states = self.model.sample(self.belief, np.random.default_rng(seed), 3)
        return tuple(self.states.observation(2))

    def step(self, action):
        costs, over = self.states.step(np.full(3, action))
        _, seen, *rest = self.model.step(self.model.sample(self.belief, np.random.default_rng(1)), action)
        return costs, over, tuple(self.states.observation(2)), tuple(seen), rest


class Batch:
    """Gives every search of a batch the same action."""

    def __init__(self, **options):
        options = {"num_envs": 3, "scenario": "mini", "max_episode_steps": 4} | options
        self.envs = ParkSearchVectorEnv(**options)

    def reset(self, seed):
        return self.envs.reset(seed=seed)

    def step(self, action):
        return self.envs.step(np.full(3, action))


class Learner(Batch):
    """As stable-baselines3 has it."""

    def __init__(self):
        from parkenv.envs.sb3 import SearchVecEnv

        self.envs = SearchVecEnv(3, "mini", observation="full", max_episode_steps=4)

    def reset(self, seed):
        self.envs.seed(seed)
        return self.envs.reset(), self.envs.action_masks()

    def step(self, action):
        return *super().step(action), self.envs.action_masks()


class Cars:
    """Many cars, decided for from outside, in both forms of PettingZoo's interface."""

    def __init__(self):
        from parkenv import lot_v0

        options = {"scenario": "mini", "cars": 3, "knows": "reserve"}
        self.one_by_one, self.at_once = lot_v0.raw_env(**options), lot_v0.parallel_env(**options)

    def reset(self, seed):
        self.one_by_one.reset(seed=seed)
        return self.at_once.reset(seed=seed)

    def step(self, action):
        last = self.one_by_one.last()
        self.one_by_one.step(None if last[2] or last[3] else action)
        return last, self.at_once.step(dict.fromkeys(self.at_once.agents, action))


class Drive:
    """A car that is driven among others, by pedal and wheel."""

    def __init__(self):
        crowd = Traffic(cars=6, pedestrians=8)
        options = {"lot": "campus", "traffic": crowd, "laser": True, "obstacle_map": True}
        self.env = gym.make("parkenv/Drive-v1", **options).unwrapped

    def reset(self, seed):
        return self.env.reset(seed=seed)

    def step(self, action):
        return self.env.step([0.2 * action, -0.7])


class FleetOfAgents:
    """A fleet under way, half of it driven by compiled policies."""

    def __init__(self):
        from parkenv.engine.fleet import DriverKind, Fleet
        from parkenv.world.demand import Demand, Headways
        from planners.heuristics.policies import POLICIES

        drivers = DriverKind(policy=POLICIES["greedy-drive"]), DriverKind()
        self.fleet = Fleet("mini", Demand(Headways(6)), drivers=drivers)

    def reset(self, seed):
        self.fleet.reset(seed)
        return {}

    def step(self, action):
        car = self.fleet.next_decision()
        seen = None if car is None else self.fleet.observation(car)
        if car is not None:
            self.fleet.act(action)
        return seen or {}, self.fleet.time, self.fleet.state_names()


def single(name="Search-v2", **options):
    return gym.make(f"parkenv/{name}", **{"scenario": "mini"} | options).unwrapped


KINDS = {
    "full": single,
    "local": lambda: single(observation="local"),
    "occupancy": lambda: single(observation="occupancy", flat=True),
    "pictures": lambda: single("SearchSensors-v2", rig=SMALL_RIG),
    "recorded": lambda: single("SearchSensors-v2", scenario=recorded_scenario(), observation="scan"),
    "places": lambda: single(scenario=["mini", grid_lot(3, 8)]),
    "wrapped": lambda: LocalObservation(gym.make("parkenv/Search-v2", scenario="mini")),
    "model": ModelState,
    "batch": Batch,
    "batch of two lots": lambda: Batch(scenario=["mini", grid_lot(3, 8)]),
    "batch of occupancies": lambda: Batch(observation="occupancy", autoreset_mode=AutoresetMode.SAME_STEP),
    "local batch": lambda: Batch(observation="local"),
    "learner": Learner,
    "cars": Cars,
    "fleet": FleetOfAgents,
}


@pytest.fixture(params=KINDS)
def kind(request):
    return KINDS[request.param]


def run(world, actions):
    return [parts(world.step(action)) for action in actions]


@pytest.mark.parametrize("twin_of", [copy.copy, copy.deepcopy, lambda it: pickle.loads(pickle.dumps(it))])
def test_a_copy_goes_on_alone_as_the_original_would(kind, twin_of):
    plain, world = kind(), kind()
    for each in (plain, world):
        each.reset(seed=3)
        each.step(3)
    wanted = run(plain, DRIVEN[1:3])
    if twin_of is copy.copy and isinstance(world, (Batch, ModelState, Cars, FleetOfAgents)):
        twin = copy.copy(world)
        for name in INNER.intersection(vars(world)):
            setattr(twin, name, copy.copy(getattr(world, name)))
    else:
        twin = twin_of(world)
    run(twin, (1, 1))
    again = twin_of(world) if twin_of is not copy.copy else None
    assert run(world, DRIVEN[1:3]) == wanted
    if again is not None:
        del world
        assert run(again, DRIVEN[1:3]) == wanted


def test_pickles_go_on_in_another_process():
    worlds = [make() for make in KINDS.values()]
    for world in worlds:
        world.reset(seed=3)
        world.step(3)
    sent = pickle.dumps(worlds)
    wanted = [run(world, DRIVEN[1:3]) for world in worlds]
    code = "import pickle, sys; from test_copies import *; " + (
        "sys.stdout.buffer.write(pickle.dumps([run(w, DRIVEN[1:3]) for w in pickle.load(sys.stdin.buffer)]))"
    )
    env = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run([sys.executable, "-c", code], input=sent, stdout=-1, check=True, env=env)
    assert pickle.loads(done.stdout) == wanted


def test_what_a_caller_does_to_results_changes_nothing_later(kind):
    plain, world = kind(), kind()
    plain.reset(seed=3)
    spoil(world.reset(seed=3))
    for action in DRIVEN[:4]:
        result, wanted = world.step(action), plain.step(action)
        assert parts(result) == parts(wanted)
        spoil(result)


@pytest.mark.parametrize("name", ["full", "local", "pictures", "recorded", "places"])
def test_a_saved_state_is_gone_on_from_in_any_environment_of_its_kind(name):
    """In the middle of another search, and later in its own; the seed of the episodes to come is in it."""
    world, other = KINDS[name](), KINDS[name]()
    env, another = (getattr(each, "env", each) for each in (world, other))
    world.reset(seed=3)
    world.step(3)
    saved = pickle.loads(pickle.dumps(env.get_state()))
    wanted = run(world, DRIVEN[1:3]), parts(env.reset())
    other.reset(seed=9)
    for each, its in ((other, another), (world, env)):
        its.set_state(saved)
        assert (run(each, DRIVEN[1:3]), parts(its.reset())) == wanted


@pytest.mark.parametrize(("seed", "parked"), [(0, True), (11, False)])
def test_the_belief_of_a_search_that_is_over_samples_no_search_that_goes_on(seed, parked):
    env, over, memory = single(), False, None
    model, agent = parkenv.model(env.scenario), parkenv.make_agent("first-free", env.scenario)
    observation, _ = env.reset(seed=seed)
    belief = model.initial_belief(observation)
    while not over:
        action, memory = agent.predict(observation, memory)
        observation, _, over, _, info = env.step(action)
        belief = model.update(belief, int(action), observation)
        states = model.sample(belief, np.random.default_rng(0), 5)
        assert states.over.tolist() == [over] * 5
    assert info["parked"] == parked
    assert states.step(np.full(5, 3))[0].tolist() == [0.0] * 5


def test_what_holds_addresses_alone_says_that_it_cannot_be_copied():
    from planners.heuristics.policies import POLICIES

    data = POLICIES["greedy-drive"].data_for([single().scenario])
    for copied in (copy.copy, copy.deepcopy, pickle.dumps):
        with pytest.raises(TypeError, match="holds addresses of this process"):
            copied(data)
