"""A world that is a Python class runs wherever the compiled ones do."""

import copy
import pickle

import gymnasium as gym
import numba
import numpy as np
import pytest
from timetable_world import Timetable

import parkenv
from parkenv.compiled.memory import address_of
from parkenv.engine.fleet import DriverKind, Fleet
from parkenv.envs.search_vector import ParkSearchVectorEnv
from parkenv.studies.compare.cases import Case
from parkenv.world.demand import Demand, Headways
from parkenv.world.occupancy.kernel import FUNCTIONS
from planners.agent import make_agent
from planners.heuristics import POLICIES


def scenario(kind=Timetable, **changes):
    mini = parkenv.make_scenario("mini", **changes)
    return mini.replace(occupancy=kind(mini.lot), prior=None)


def test_every_observation_and_attempt_is_true():
    env = gym.make("parkenv/Search-v2", scenario=scenario())
    world, slots, failed = env.unwrapped.scenario.occupancy, np.arange(10), 0
    n_fresh = 0
    for seed in range(5):
        observation, _ = env.reset(seed=seed)
        rng = np.random.default_rng(seed)
        for _ in range(60):
            before, here = observation["time"], int(observation["vertex"])
            action = rng.choice(np.flatnonzero(observation["action_mask"]))
            taken = bool(here < 10 and world.occupied([here], env.unwrapped.state.time)[0])
            observation, _, over, _, info = env.step(action)
            failed += bool(action == 4 and taken)
            assert not (action == 4 and here < 10) or info["parked"] != taken
            if over:
                break
            _, _, p_observed, observed_at = observation["belief"].reshape(4, -1)
            fresh = (observed_at == observation["time"][1]) & (observation["time"][1] > before[1])
            n_fresh += fresh.sum()
            now = world.occupied(slots, env.unwrapped.state.time)
            np.testing.assert_array_equal(p_observed[fresh] > 0.5, now[fresh])
    assert failed
    assert n_fresh > 100


def test_a_batch_a_saved_state_and_a_pickle_go_on_as_the_single_search_does():
    its = scenario()
    batch, env = ParkSearchVectorEnv(3, its), gym.make("parkenv/Search-v2", scenario=its)
    observations, _ = batch.reset(seed=7)
    observation, _ = env.reset(seed=8)
    rng = np.random.default_rng(0)
    for step in range(40):
        np.testing.assert_array_equal(observations["belief"][1], observation["belief"])
        actions = [int(rng.choice(np.flatnonzero(mask[:4]))) for mask in observations["action_mask"]]
        observations, rewards, *_ = batch.step(np.array(actions))
        observation, reward, *_ = env.step(actions[1])
        assert rewards[1] == reward
        if step == 20:
            batch.set_state(batch.get_state())
            env = pickle.loads(pickle.dumps(env))


@pytest.mark.parametrize("background", ["process", "residents"])
def test_a_fleet_shares_it(background):
    kinds = [DriverKind(policy=POLICIES["first-free"]), DriverKind(knows="full")]
    fleet = Fleet(scenario(), Demand(Headways(8, 20.0)), drivers=kinds, background=background)
    fleet.reset(0)
    world = fleet.scenario.occupancy
    np.testing.assert_array_equal(fleet.taken(), world.occupied(np.arange(10), fleet.begin))
    fleet.run([None, make_agent("greedy-drive", fleet.scenario)])
    assert (fleet.cars["slot"] >= 0).any()


@numba.cfunc("float64(int64, int64, float64)")
def _state(period_s, slot, time):
    return 1.0 if (time - 97.0 * slot) % period_s < 900.0 else 0.0


@numba.cfunc("float64(int64, int64, float64)")
def _next_free(period_s, slot, time):
    return time + max(900.0 - (time - 97.0 * slot) % period_s, 0.0)


class CompiledTimetable(Timetable):
    """The same timetable with compiled functions: compiled code never calls Python for a slot."""

    def occupied(self, slots, time):
        assert len(slots) > 1, "asked in Python for a single slot"
        return super().occupied(slots, time)

    @property
    def address(self):
        self._record = np.array([(1200, _state.address, _next_free.address)], FUNCTIONS)
        return address_of(self._record, FUNCTIONS)


def test_a_world_may_bring_compiled_functions():
    totals = [
        [row["total_s"] for row in Case(scenario(kind), name).run(range(10))]
        for kind, name in (
            (Timetable, "greedy-drive"),
            (CompiledTimetable, "greedy-drive"),
            (Timetable, "oracle"),
        )
    ]
    assert totals[0] == totals[1]
    assert sum(totals[2]) < sum(totals[0])


class Broken(Timetable):
    def occupied(self, slots, time):
        raise ZeroDivisionError("no timetable today")


def drive(env, action):
    env.reset(seed=0)
    for _ in range(10):
        env.step(action)


def test_its_errors_reach_the_caller():
    env = gym.make("parkenv/Search-v2", scenario=scenario(Broken))
    with pytest.raises(ZeroDivisionError, match="no timetable today"):
        drive(env, 3)
    with pytest.raises(ZeroDivisionError):
        drive(ParkSearchVectorEnv(2, scenario(Broken)), np.array([0, 3]))
    with pytest.raises(ZeroDivisionError):
        Fleet(scenario(Broken), background="residents").reset(0)


def test_it_cannot_be_made_fuller_and_copies_work():
    its = scenario()
    assert not its.occupancy.adjustable
    with pytest.raises(parkenv.errors.InputError, match="Timetable"):
        parkenv.make_scenario(its, day_error=0.5)
    other = copy.deepcopy(its)
    env = gym.make("parkenv/Search-v2", scenario=other)
    first, _ = env.reset(seed=3)
    again, _ = gym.make("parkenv/Search-v2", scenario=its).reset(seed=3)
    np.testing.assert_array_equal(first["belief"], again["belief"])
