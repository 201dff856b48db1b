"""Cues of departures: what they say of the future, in what they are observed, and what they are worth."""

import pickle

import gymnasium as gym
import numpy as np
import pytest
from command_line import parkenv as command
from scipy.linalg import expm

import parkenv
from parkenv import InputError, OccupancyProcess, lot_v0
from parkenv.belief.cue_belief import freed
from parkenv.belief.slot_belief import SlotBelief
from parkenv.envs.local_observation import LocalObservation
from parkenv.world.cues import MOVING_S, SENSED, Cues
from parkenv.world.occupancy.log import OccupancyLog
from parkenv.world.occupancy.process import Arrival
from parkenv.world.occupancy.recorded import RecordedOccupancy
from planners import make_agent

N_SEARCHES = 120


def busy(cues=None, p=0.95, stay_s=600.0, name="campus"):
    """A lot with cars that come and go fast."""
    scenario = parkenv.make_scenario(name)
    n, hours = scenario.lot.n_slots, np.ones(168)
    leaving = np.full(n, 1.0 / stay_s)
    world = OccupancyProcess(leaving * p / (1.0 - p), hours, leaving, hours)
    return scenario.replace(occupancy=world, prior=None, cues=cues)


def wandering(scenario, seeds=range(N_SEARCHES), steps=12):
    """Yield observations and states along random drives, after steps that end at a new moment."""
    env, rng = gym.make("parkenv/Search-v2", scenario=scenario), np.random.default_rng(0)
    for seed in seeds:
        observation, _ = env.reset(seed=seed)
        for _ in range(steps):
            moves = np.flatnonzero(observation["action_mask"][:4])
            observation, *_ = env.step(int(rng.choice(moves)))
            yield observation, env.unwrapped.state


@pytest.mark.parametrize("decay_rate", [1 / 40, 1 / 30, 1 / 3])
@pytest.mark.parametrize("p", [0.3, 0.97])
def test_p_free_after_a_cue_is_that_of_the_chain(p, decay_rate):
    """Three states: taken, about to leave, free."""
    arriving, leaving = p * decay_rate, (1.0 - p) * decay_rate
    rate = leaving + 1 / 30
    usual = leaving / rate
    arrives = arriving * np.array([1.0 - usual, usual, -1.0])
    rates = np.array([[-leaving, leaving, 0.0], [0.0, -rate, rate], arrives])
    for about in (0.0, 0.4, 1.0):
        for t in (0.5, 10.0, 60.0, 600.0):
            free = (np.array([1.0 - about, about, 0.0]) @ expm(rates * t))[2]
            without = (1.0 - p) * (1.0 - np.exp(-decay_rate * t))
            assert without + freed(about - usual, rate, decay_rate, t) == pytest.approx(free, abs=1e-6)


def test_drawn_changes_agree_with_all_looks_and_are_not_at_once():
    rng, day = np.random.default_rng(0), "2024-01-01"
    second = np.tile(np.arange(8 * 3600.0, 18 * 3600.0, 1800.0), 50)
    slot = np.repeat(np.arange(50), 20)
    taken = rng.random(slot.size) < 0.7
    looks = (np.tile(slot, 2), np.repeat([0, 1], slot.size), np.tile(second, 2), np.tile(taken, 2))
    log = OccupancyLog(tuple(map(str, range(50))), (day, "2024-01-02"), *looks)
    changes = {}
    for kind in ("midway", "drawn"):
        model = RecordedOccupancy(log, np.arange(50.0), np.arange(50), changes=kind)
        world = model.world(0, Arrival(7.5 * 3600.0, day))
        for time in np.unique(second):
            assert (world.occupied(np.arange(50), time) == taken[second == time]).all()
        states = model.day_states(day)
        within = (states.from_s > 8 * 3600.0) & (states.from_s < 17 * 3600.0)
        changes[kind] = np.unique(states.from_s[within]).size / within.sum()
    assert changes["midway"] < 0.1
    assert changes["drawn"] > 0.9


def test_a_perfect_cue_shows_nearly_all_that_leave_and_nothing_else():
    scenario, to_leave, others = busy(Cues()), [], []
    n = scenario.lot.n_slots
    for observation, state in wandering(scenario):
        slots, taken, *_ = observation["step_observed"].reshape(4, -1)
        seen = slots[(slots >= 0) & (taken == 1)].astype(int)
        left_s = state.world.next_free(seen, state.time) - state.time
        shown = observation["cues"][seen] > 0.5
        to_leave += left_s[shown].tolist()
        others += left_s[~shown].tolist()
        assert (observation["cues"][:n][np.setdiff1d(slots[slots >= 0], seen).astype(int)] == 0.0).all()
    rate = 1 / 31 + 1 / 600
    assert len(to_leave) > 200
    assert np.mean(to_leave) == pytest.approx(1.0 / rate, rel=0.2)
    assert np.mean(np.array(others) < 2.0) < 0.001
    assert len(to_leave) / (len(to_leave) + len(others)) == pytest.approx((1 / 600) / rate, rel=0.3)


@pytest.mark.parametrize("cues", [Cues(), Cues(90.0, 0.5, 0.02)], ids=["perfect", "sensed"])
def test_the_belief_after_cues_is_calibrated(cues):
    """P(free) half a minute after an observation, by how much the cue says, is how often the slot is free then."""
    scenario = busy(cues)
    n, said, true, before = scenario.lot.n_slots, [], [], set()
    for observation, state in wandering(scenario, range(500)):
        slots = np.flatnonzero(observation["cues"][:n] > 0.05)
        # Once a car: what follows is not independent.
        slots = np.array([slot for slot in slots if (state.key, slot) not in before], int)
        before |= {(state.key, slot) for slot in slots}
        later = SlotBelief.of_observation(observation).decay(30.0)
        said += (1.0 - later.p_occupied[slots]).tolist()
        true += (~state.world.occupied(slots, state.time + 30.0)).tolist()
    assert len(said) > 200
    assert np.mean(said) > 0.1
    assert np.mean(said) == pytest.approx(np.mean(true), abs=0.07)


def test_without_cues_all_is_as_before_and_with_them_the_world_is_the_same():
    plain, cued = busy(), busy(Cues(moving_s=0.0))
    assert "cues" not in gym.make("parkenv/Search-v2", scenario=plain).observation_space.spaces
    for seed in range(5):
        totals = []
        for scenario in (plain, cued):
            env, agent = gym.make("parkenv/Search-v2", scenario=scenario), make_agent("first-free", scenario)
            totals.append(parkenv.simulate(env, agent, seed=seed).info["total_s"])
        assert totals[0] == totals[1]


def test_a_car_that_moves_out_is_in_the_way_until_it_is_out():
    scenario = busy(Cues(lead_s=60.0), stay_s=100.0)
    edges, before, waits = scenario.edges, (None, 0, 0.0), 0
    for _, state in wandering(scenario):
        key, vertex, time = before
        before = state.key, state.vertex, state.time
        if key == state.key and vertex != state.vertex:
            drive_s = edges["seconds"][vertex][edges["target"][vertex] == state.vertex].min()
            wait_s = state.time - time - drive_s
            assert -1e-6 < wait_s <= MOVING_S
            if wait_s > 1e-6:
                waits += 1
                assert state.world.occupied([state.vertex], state.time - 0.01)
                assert not state.world.occupied([state.vertex], state.time + 1e-6)
    assert waits > 3


def test_the_bound_is_clairvoyant_and_the_oracle_near_it():
    scenario = busy(Cues(20.0), p=0.98, stay_s=1200.0)
    bound, agent = make_agent("bound", scenario), make_agent("oracle", scenario)
    env, over = gym.make("parkenv/Search-v2", scenario=scenario), []
    for seed in range(10):
        env.reset(seed=seed)
        state = env.unwrapped.state
        least_s = bound.of_world(state.world, state.vertex, state.time)
        over.append(parkenv.simulate(env, agent, seed=seed).info["total_s"] - least_s)
    assert min(over) > -1e-6
    assert np.median(over) < 2.0


def test_single_batched_local_and_copied_searches_observe_the_same():
    scenario = busy(Cues(60.0, 0.8, 0.05))
    env = gym.make("parkenv/Search-v2", scenario=scenario)
    local = gym.make("parkenv/Search-v2", scenario=scenario, observation="local")
    outside = LocalObservation(gym.make("parkenv/Search-v2", scenario=scenario))
    batch = gym.make_vec("parkenv/Search-v2", 1, scenario=scenario)
    assert env.observation_space.contains(env.reset(seed=3)[0])
    local.reset(seed=3), outside.reset(seed=3), batch.reset(seed=3)
    for k in range(40):
        action = k // 5 % 4
        seen, *_ = env.step(action)
        here, there = local.step(action)[0], outside.step(action)[0]
        many, *_ = batch.step(np.array([action]))
        np.testing.assert_array_equal(here["local"], there["local"])
        for name, value in seen.items():
            np.testing.assert_array_equal(value, many[name][0])
        if k == 20:
            env = pickle.loads(pickle.dumps(env))
        later = SlotBelief.of_observation(seen).decay(0.0)
        np.testing.assert_allclose(later.p_occupied, seen["p_occupied"], atol=1e-6)


@pytest.mark.parametrize("background", ["process", "residents"])
def test_cars_of_a_fleet_and_of_its_background_show_that_they_leave(background):
    env = lot_v0.parallel_env(busy(Cues()), cars=4, tick_s=5.0, background=background)
    shown, agents = 0, env.reset(seed=0)[0]
    for _ in range(400):
        if not env.agents:
            break
        actions = {car: int(seen["action_mask"].argmax()) for car, seen in agents.items()}
        agents, *_ = env.step(actions)
        for car, seen in agents.items():
            assert env.observation_space(car).contains(seen)
            shown += int((seen["cues"].reshape(3, -1)[0] > 0.5).sum())
    assert shown > 0


@pytest.mark.slow
def test_belief_gains_from_cues_in_a_nearly_full_lot():
    totals = {}
    for cues in (None, Cues(20.0), Cues(20.0, 0.5, 0.02)):
        scenario = busy(cues, p=0.995, stay_s=1800.0)
        env, agent = gym.make("parkenv/Search-v2", scenario=scenario), make_agent("belief", scenario)
        done = [parkenv.simulate(env, agent, seed=seed) for seed in range(60)]
        totals[cues] = np.array([search.info["total_s"] for search in done])
    none, perfect, sensed = totals.values()
    assert (perfect - none).mean() < -20.0
    assert (sensed - none).mean() < -20.0


@pytest.mark.parametrize("cues", [Cues(20.0), Cues(60.0, 0.6, 0.05)], ids=["perfect", "sensed"])
def test_the_models_belief_is_that_of_the_environment(cues):
    scenario, rng = busy(cues, p=0.9), np.random.default_rng(1)
    env, model = gym.make("parkenv/Search-v2", scenario=scenario), parkenv.model(scenario)
    n, compared = scenario.lot.n_slots, 0
    for seed in range(3):
        observation, _ = env.reset(seed=seed)
        belief = model.initial_belief(observation)
        for _ in range(30):
            action = int(rng.choice(np.flatnonzero(observation["action_mask"][:4])))
            observation, *_ = env.step(action)
            belief = model.update(belief, action, observation)
            np.testing.assert_allclose(belief.slots.p_occupied, observation["p_occupied"], atol=2e-5)
            np.testing.assert_allclose(belief.slots.cues[:n], observation["cues"][:n], atol=2e-5)
            compared += int((observation["cues"][:n] > 0.1).sum())
    assert compared > 5


def test_worlds_of_the_model_leave_as_its_belief_says():
    scenario, rng = busy(Cues(30.0, 0.6, 0.05), p=0.9), np.random.default_rng(1)
    env, model = gym.make("parkenv/Search-v2", scenario=scenario), parkenv.model(scenario)
    shown = []
    for seed in range(8):
        observation, _ = env.reset(seed=seed)
        steps = 0
        while steps < 12 or observation["action_mask"][:4].all():
            observation, *_ = env.step(int(rng.choice(np.flatnonzero(observation["action_mask"][:4]))))
            steps += 1
        belief = model.initial_belief(observation)
        sample = model.sample(belief, rng, 200)
        sample.reseed(rng)
        waiting = int(np.flatnonzero(observation["action_mask"][:4] == 0)[0])
        for _ in range(30):
            sample.step(waiting)
        seen, later = sample.observation(), belief.slots.decay(sample.observation().time - belief.slots.time)
        looks = np.array([sample.observation(i).taken for i in range(len(sample))])
        said, free = 1.0 - later.p_occupied[seen.slots], 1.0 - looks.mean(axis=0)
        shown.append((free.mean(), said.mean(), free[said.argmax()], said.max()))
    free, said, most_free, most_said = np.transpose(shown)
    assert free.mean() == pytest.approx(said.mean(), abs=0.01)
    assert most_free.mean() == pytest.approx(most_said.mean(), abs=0.04)


def test_announced_departures_of_the_model_stay_as_drawn_when_the_car_drives_there():
    scenario, rng = busy(Cues(60.0), p=0.9), np.random.default_rng(0)
    env, model = gym.make("parkenv/Search-v2", scenario=scenario), parkenv.model(scenario)
    shown = []
    for seed in range(40):
        observation, _ = env.reset(seed=seed)
        for _ in range(8):
            observation, *_ = env.step(int(rng.choice(np.flatnonzero(observation["action_mask"][:4]))))
        neighbors = scenario.lot.neighbors[int(observation["vertex"])]
        announced = np.append(observation["cues"].reshape(3, -1)[0] > 0.9, False)
        for action in np.flatnonzero(announced[np.minimum(neighbors, len(announced) - 1)]):
            slot = int(neighbors[action])
            waiting = np.flatnonzero(scenario.lot.neighbors[slot] < 0)[0]
            belief = model.initial_belief(observation)
            sample = model.sample(belief, rng, 100)
            for step in (action, *[waiting] * 20):
                sample.step(np.full(100, step))
            seen = [sample.observation(i) for i in range(100)]
            later = belief.slots.decay(seen[0].time - belief.slots.time)
            free = np.mean([not taken.taken[taken.slots == slot].any() for taken in seen])
            shown.append((free, 1.0 - later.p_occupied[slot]))
    free, said = np.mean(shown, axis=0)
    assert len(shown) >= 3
    assert free == pytest.approx(said, abs=0.05)


def test_what_does_not_know_cues_says_so(tmp_path):
    with pytest.raises(InputError, match=r"hit_rate is 0.1, want at least false_alarm_rate, 0.2"):
        Cues(hit_rate=0.1, false_alarm_rate=0.2)
    for given in ("often", "0.5", "0.5,0.1,31,9"):
        done = command("compare", "--cues", given, "--out", tmp_path / "run")
        assert (done.returncode, done.stderr.count("\n")) == (2, 1)


def test_the_command_line_and_files_have_cues():
    for given in ("perfect", "1,0,31", {"lead_s": 31.0}):
        assert parkenv.make_scenario({"base": "mini", "cues": given}).cues == Cues()
    assert parkenv.make_scenario({"base": "mini", "cues": "0.5,0.01"}).cues == Cues(31.0, 0.5, 0.01)
    assert parkenv.make_scenario({"base": "mini", "cues": "sensed"}).cues == Cues(31.0, *SENSED)
