"""The generative model: its beliefs are those of the environment, its worlds are so in distribution."""

import gc
import runpy
import types
from collections import defaultdict
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from expected_time import optimum_s
from hypothesis import given, settings
from hypothesis import strategies as st
from small_lots import small_lot

import parkenv
from parkenv import InputError, SensorBand, SensorModel
from parkenv.belief.slot_belief import SlotBelief
from parkenv.world.lot import PARK
from planners import make_agent
from planners.heuristics.policies import POLICIES

NOISY = SensorModel(9.0, bands=(SensorBand(4.0, True, 0.9, 0.9, 0.1), SensorBand(9.0, False, 0.6, 0.8, 0.3)))
SENSORS = {"exact": SensorModel(view_range=6.0), "noisy": NOISY}
START = {"entry": 0, "arrival": "Tue 09:10"}


def searching(sensor="exact", name="mini", **changes):
    scenario = parkenv.make_scenario(name, sensor_model=SENSORS[sensor], **changes)
    return gym.make("parkenv/Search-v2", scenario=scenario), parkenv.model(scenario)


def random_action(observation, rng, n_actions=PARK + 1):
    return int(rng.choice(np.flatnonzero(observation["action_mask"][:n_actions])))


@pytest.mark.parametrize("sensor", SENSORS)
@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32))
def test_its_beliefs_are_those_of_the_environment(sensor, seed):
    env, model = searching(sensor, day_error=0.8)
    observation, _ = env.reset(seed=seed)
    belief, rng = model.initial_belief(observation), np.random.default_rng(seed)
    for _ in range(25):
        action = random_action(observation, rng)
        observation, _, over, _, _ = env.step(action)
        belief = model.update(belief, action, observation)
        assert belief.vertex == observation["vertex"]
        np.testing.assert_allclose(belief.slots.p_occupied, observation["p_occupied"], atol=1e-6)
        np.testing.assert_allclose(belief.slots.parts, observation["belief"], atol=1e-5)
        seen, theirs = belief.slots.observations, SlotBelief.of_observation(observation).observations
        np.testing.assert_array_equal(seen.slots, theirs.slots)
        np.testing.assert_array_equal(seen.taken, theirs.taken)
        if over:
            return


@pytest.mark.parametrize("sensor", SENSORS)
def test_worlds_of_the_updated_belief_are_those_weighted_by_the_observations(sensor):
    """Bayes' rule: a particle filter by `observation_probability` expects what `sample` of the updated belief does."""
    env, model = searching(sensor, day_error=0.8)
    rng, n = np.random.default_rng(5), 20_000
    observation, _ = env.reset(seed=2)
    belief = model.initial_belief(observation)
    particles, weight = model.sample(belief, rng, n), np.ones(n)
    for _ in range(5):
        action = random_action(observation, rng, PARK)
        observation, *_ = env.step(action)
        p = model.observation_probability(observation, particles, action)
        by_particles = weight @ p / weight.sum()
        by_belief = model.observation_probability(observation, model.sample(belief, rng, n), action)
        n_effective = weight.sum() ** 2 / (weight**2).sum()
        error = by_belief.std() * np.sqrt(1.0 / n_effective + 1.0 / n)
        assert n_effective > 20.0
        assert abs(by_particles - by_belief.mean()) < 4 * error + 1e-9
        weight *= p
        particles.step(np.full(n, action))
        belief = model.update(belief, action, observation)


@pytest.mark.slow
@pytest.mark.parametrize("sensor", SENSORS)
def test_a_heuristic_takes_as_long_as_in_the_environment(sensor):
    env, model = searching(sensor, "campus")
    agent, total_s = make_agent("first-free", env.unwrapped.scenario), []
    for seed in range(1500):
        observation, _ = env.reset(seed=seed, options=START)
        memory, over, late = None, False, False
        while not (over or late):
            action, memory = agent.predict(observation, memory)
            observation, _, over, late, info = env.step(action)
        total_s.append(info["total_s"])
    observation, _ = env.reset(seed=0, options=START)
    belief = model.initial_belief(observation)
    cost_s = model.sample(belief, np.random.default_rng(0), 20_000).run(POLICIES["first-free"])
    error = np.hypot(np.std(total_s) / len(total_s) ** 0.5, cost_s.std() / len(cost_s) ** 0.5)
    assert abs(np.mean(total_s) - cost_s.mean()) < 3.5 * error


def numbers_in(*roots):
    """Yield the bytes of all arrays and whole numbers that the objects lead to, not by way of code."""
    seen, waiting = set(), list(roots)
    while waiting:
        one = waiting.pop()
        code = type(one).__module__.startswith(("numba", "llvmlite", "ctypes"))
        if code or id(one) in seen or isinstance(one, (type, types.ModuleType, types.FunctionType)):
            continue
        seen.add(id(one))
        if isinstance(one, (np.ndarray, np.generic)):
            yield np.asarray(one).tobytes()
            waiting.append(one.base)
        elif isinstance(one, int) and abs(one) < 2**64:
            yield one.to_bytes(9, "little", signed=True)
        waiting += gc.get_referents(one)


def test_no_key_of_the_world_can_be_reached():
    env, model = searching("noisy")
    observation, _ = env.reset(seed=3)
    rng, belief = np.random.default_rng(0), model.initial_belief(observation)
    for _ in range(5):
        action = random_action(observation, rng, PARK)
        observation, *_ = env.step(action)
        belief = model.update(belief, action, observation)
    state, record = model.sample(belief, rng), env.unwrapped.searches.records[0]
    hidden = [record[name].tobytes() for name in ("key", "seed_state")]
    assert any(hidden[0] in found for found in numbers_in(env.unwrapped.searches)), "the walk finds it there"
    for found in numbers_in(model, belief, state):
        assert not any(key in found for key in hidden)


def test_a_step_leaves_its_state_and_only_new_random_numbers_change_what_comes():
    env, model = searching("noisy", "campus")
    belief, rng = model.initial_belief(env.reset(seed=0)[0]), np.random.default_rng(0)
    state = model.sample(belief, rng)
    many = model.sample(belief, np.random.default_rng(0), 1, copies=3)
    before, futures = state.searches.records.tobytes(), []
    for reseeded in (False, False, True):
        now, told = state, []
        for action in (3, 3, 3, 0, 3, 3):
            now, observation, cost_s, over = model.step(now, action, rng if reseeded else None)
            told.append((observation.slots.tolist(), observation.taken.tolist(), cost_s, over))
        futures.append(told)
    assert state.searches.records.tobytes() == before
    assert futures[0] == futures[1] != futures[2]
    for action, told in zip((3, 3, 3, 0, 3, 3), futures[0], strict=True):
        cost_s, over = many.step(np.full(3, action))
        assert (many.observation(2).slots.tolist(), many.observation(1).taken.tolist()) == told[:2]
        assert cost_s.tolist() == [told[2]] * 3
        assert over.tolist() == [told[3]] * 3


def test_bad_input_is_answered_in_one_line():
    env, model = searching()
    observation, _ = env.reset(seed=0)
    belief, rng = model.initial_belief(observation), np.random.default_rng(0)
    elsewhere, other = searching(name="campus")
    there = other.initial_belief(elsewhere.reset(seed=0)[0])
    state = model.sample(belief, rng)
    calls = {
        "lot 'mini'": lambda: other.sample(belief, rng),
        "slots, want": lambda: other.initial_belief(observation),
        "action is 7": lambda: model.step(state, 7),
        "lot 'campus'": lambda: model.step(other.sample(there, rng), 0),
        "holds 2": lambda: model.step(model.sample(belief, rng, 2), 0),
        "policy is 'first-free'": lambda: state.run("first-free"),
        "i is 1": lambda: state.one(1),
        "n is 2.5": lambda: model.sample(belief, rng, 2.5),
        "of vertex": lambda: model.update(belief, 3, {**observation, "vertex": 10_000}),
    }
    for message, call in calls.items():
        with pytest.raises(InputError, match=message) as caught:
            call()
        assert "\n" not in str(caught.value)


def test_worlds_have_their_slots_from_the_belief_about_the_day():
    env, model = searching(day_error=0.8)
    observation, _ = env.reset(seed=1, options=START)
    here, n = int(observation["vertex"]), 20_000
    action = int(np.flatnonzero(observation["action_mask"][:PARK])[0])
    belief = model.initial_belief(observation)
    worlds = model.sample(belief, np.random.default_rng(0), n)
    worlds.step(np.full(n, action))
    seen = [worlds.observation(i) for i in range(n)]
    taken = np.array([one.taken for one in seen])
    expected = belief.day.p_occupied(0.0)[seen[0].slots]
    error = np.sqrt(expected * (1.0 - expected) / n)
    assert seen[0].vertex != here
    assert (np.abs(taken.mean(axis=0) - expected) < 4 * error + 0.003).all(), "they may change on the way"


def test_a_copy_of_a_search_moves_on_without_it():
    env, _ = searching(name="mini", day_error=0.8)
    agent = make_agent("belief", env.unwrapped.scenario)
    observation, _ = env.reset(seed=3)
    action, memory = agent.predict(observation)
    kept = memory.copy()
    expected_s, state = memory.expected_s, memory.state.copy()
    weights = memory.day.mixture()[0]
    for _ in range(6):
        observation, _, over, _, _ = env.step(int(action))
        if over:
            break
        action, memory = agent.predict(observation, memory)
    assert (memory.state != state).any()
    assert kept.expected_s == expected_s
    np.testing.assert_array_equal(kept.state, state)
    np.testing.assert_array_equal(kept.day.mixture()[0], weights)


EXAMPLE = runpy.run_path(str(Path(__file__).parents[1] / "examples" / "write_pomdp.py"))


class Read:
    """A `.pomdp` file with sure transitions and observations, as ours are."""

    def __init__(self, lines):
        after, reward, seen = {}, {}, {}
        for line in lines:
            key, *rest = [part.strip() for part in line.split("#")[0].split(":")]
            words = [part.split() for part in rest]
            if key == "T":
                (action,), (state,), (target, p) = words
                assert float(p) == 1.0
                after[action, state] = target
            elif key == "R":
                (action,), (state,), _, (_, r) = words
                reward[action, state] = float(r)
            elif key == "O":
                (action,), (state,), (observation, p) = words
                assert (action, float(p)) == ("*", 1.0)
                seen[state] = observation
            elif key:
                setattr(self, key, words[0])
        self.chances = dict(zip(self.states, map(float, self.start), strict=True))
        self.after = {(a, s): after.get((a, s)) or after["*", s] for a in self.actions for s in self.states}
        self.reward = {key: reward.get(key, 0.0) for key in self.after}
        self.seen = seen
        assert sum(self.chances.values()) == pytest.approx(1.0)
        assert {*self.after.values(), *self.seen} <= {*self.states}
        assert {*self.seen.values()} <= {*self.observations}

    def value(self):
        """Value iteration over the beliefs that can follow from the start."""
        first = frozenset((s, p) for s, p in self.chances.items() if p)
        steps, waiting = {}, [first]
        while waiting:
            belief = waiting.pop()
            if belief in steps:
                continue
            steps[belief] = []
            for action in self.actions:
                by_seen, reward = defaultdict(list), 0.0
                for state, p in belief:
                    reward += p * self.reward[action, state]
                    after = self.after[action, state]
                    if after != "done":
                        by_seen[self.seen[after]].append((after, p))
                branches = []
                for found in by_seen.values():
                    total = sum(p for _, p in found)
                    branches.append((total, frozenset((s, round(p / total, 12)) for s, p in found)))
                steps[belief].append((reward, branches))
                waiting += [after for _, after in branches]
        values = dict.fromkeys(steps, 0.0)
        while True:
            worst = 0.0
            for belief, actions in steps.items():
                best = max(r + sum(p * values[b] for p, b in branches) for r, branches in actions)
                worst, values[belief] = max(worst, abs(best - values[belief])), best
            if worst < 1e-10:
                return values[first]


def few_slots(seed):
    """Three or four slots along one or two aisles."""
    problem, p_occupied, vertex = small_lot(seed, ((1, 3), (2, 2), (1, 4)))
    return problem, p_occupied, vertex if seed % 2 else np.random.default_rng(seed).integers(len(p_occupied))


@pytest.mark.parametrize("seed", range(6))
def test_value_iteration_on_the_file_finds_the_optimum(seed):
    problem, p_occupied, vertex = few_slots(seed)
    read = Read(EXAMPLE["pomdp_lines"](problem, p_occupied, vertex))
    assert -read.value() == pytest.approx(optimum_s(problem, p_occupied, vertex), abs=1e-6)
