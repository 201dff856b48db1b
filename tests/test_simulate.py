"""`simulate`: the one episode loop, its observers, its accounting of truncation and its decision times."""

import copy
import itertools
import pickle

import gymnasium as gym
import numba
import numpy as np
import pytest
from gymnasium.wrappers import TimeLimit
from timetable_world import Timetable

import parkenv
from parkenv import make_scenario
from parkenv.compiled.clock import seconds_spent
from parkenv.compiled.memory import address_of
from parkenv.engine.fleet import DriverKind, Fleet
from parkenv.envs.search_vector import ParkSearchVectorEnv
from parkenv.studies.compare.cases import Case
from parkenv.studies.simulate import Observer, simulate
from parkenv.world.demand import Demand, Headways
from parkenv.world.occupancy.kernel import FUNCTIONS
from planners import make_agent
from planners.heuristics import POLICIES

MINI = make_scenario("mini")


class Counter(Observer):
    """Records every call."""

    def __init__(self):
        self.calls = []
        self.on_reset = lambda _, observation: self.calls.append(("reset", observation))
        self.on_step = lambda step: self.calls.append(("step", step))


class Waiting:
    """Never drives and never parks."""

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return int(np.flatnonzero(observation["action_mask"][:4] == 0)[0]), state


@pytest.mark.parametrize("name", ["mdp", "first-free", "oracle"])
def test_observers_see_the_whole_episode_in_order(name):
    env, one, two = gym.make("parkenv/Search-v2", scenario=MINI), Counter(), Counter()
    result = simulate(env, make_agent(name, MINI), 5, (one, two))
    assert [call for call, _ in one.calls] == ["reset", *["step"] * result.steps]
    assert [call for call, _ in two.calls] == ["reset", *["step"] * result.steps]
    (_, first), *steps = one.calls
    steps = [step for _, step in steps]
    assert (result.seed, result.truncated) == (5, False)
    assert steps[0].observation is first
    for before, after in itertools.pairwise(steps):
        assert before.next_observation is after.observation
        assert not before.terminated
    last = steps[-1]
    assert last.terminated
    assert last.info == result.info
    assert last.memory is result.memory
    assert -sum(step.reward for step in steps) == pytest.approx(result.info["total_s"])


def test_a_search_is_truncated_and_charged_once_unless_it_parks_at_the_step_limit():
    env = TimeLimit(gym.make("parkenv/Search-v2", scenario=MINI), 7)
    counter = Counter()
    result = simulate(env, Waiting(), 0, (counter,))
    assert result.truncated
    assert result.steps == 7
    assert result.info["gave_up_s"] == MINI.give_up_s
    assert result.info["total_s"] == pytest.approx(7 * MINI.wait_s + MINI.give_up_s)
    assert counter.calls[-1][1].info["gave_up_s"] == 0.0, "the environment's own info stays as it is"
    env = gym.make("parkenv/Search-v2", scenario=MINI)
    agent = make_agent("first-free", MINI)
    free = simulate(env, agent, 3)
    limited = simulate(TimeLimit(env, free.steps), agent, 3)
    assert limited.info == free.info
    assert not limited.truncated


def test_decision_times_leave_out_compilation():
    @numba.njit
    def norm(x):
        return np.sqrt((x * x).sum())

    class Compiling(Waiting):
        def predict(self, observation, state=None, episode_start=None, deterministic=True):
            norm(observation["p_occupied"])
            return super().predict(observation, state, episode_start, deterministic)

    before = seconds_spent()
    result = simulate(TimeLimit(gym.make("parkenv/Search-v2", scenario=MINI), 3), Compiling(), 0)
    compiling_s = seconds_spent() - before
    assert compiling_s > 0.02
    assert min(result.decision_s) > 0.0
    assert sum(result.decision_s) < 0.5 * compiling_s


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


def test_a_batch_and_pickles_go_on_as_the_single_search_does():
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
            batch, env = pickle.loads(pickle.dumps((batch, env)))


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
    worlds = ((Timetable, "greedy-drive"), (CompiledTimetable, "greedy-drive"), (Timetable, "oracle"))
    totals = [[row["total_s"] for row in Case(scenario(kind), name).run(range(10))] for kind, name in worlds]
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
