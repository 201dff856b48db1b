"""`parkenv/Search-v2`: contract, determinism, rewards, ends, observations."""

import hashlib
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from hypothesis import given
from hypothesis import strategies as st

from parkenv import InputError, OccupancyProcess, Scenario, SensorBand, SensorModel, make_scenario
from parkenv.belief.slot_belief import SlotBelief
from parkenv.lots import grid_lot
from parkenv.world.lot import PARK
from parkenv.world.occupancy.decay import decay_factor

ENV_IDS = [name for name in gym.registry if name.startswith("parkenv/Search")]


def always(lot, occupied):
    """A world in which slot s is always taken if `occupied[s]`, else always free."""
    return OccupancyProcess.from_demand(np.where(occupied, 25.0, -25.0), np.zeros(168), 1e9)


def random_episode(env, seed, steps=300):
    """Act at random, and return all observations."""
    rng = np.random.default_rng(seed)
    observation, _ = env.reset(seed=seed)
    seen = [observation]
    for _ in range(steps):
        action = rng.choice(np.flatnonzero(observation["action_mask"]))
        observation, reward, terminated, truncated, info = env.step(action)
        seen.append((observation, reward, terminated, truncated, info))
        if terminated or truncated:
            break
    return seen


def digest(env, seed):
    return hashlib.sha256(repr(random_episode(env, seed)).encode()).hexdigest()


# Gymnasium's checker takes many steps, and sensors are slow.
@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("scenario", "env_id"), [("street", ENV_IDS[0]), *(("mini", it) for it in ENV_IDS)])
def test_every_id_passes_the_checker_without_a_warning(env_id, scenario):
    env = gym.make(env_id, scenario=scenario, render_mode="rgb_array")
    check_env(env.unwrapped)
    env.close()


@pytest.mark.filterwarnings("ignore:Your observation (image|scan|pose).* has an unconventional shape")
@pytest.mark.parametrize("env_id", [*ENV_IDS, "parkenv/Drive-v1"])
def test_stable_baselines_accepts_it(env_id):
    from stable_baselines3.common.env_checker import check_env as check_sb3  # not in the other process below

    check_sb3(gym.make(env_id, **{"lot" if "Drive" in env_id else "scenario": "mini"}).unwrapped)


def test_equal_seeds_give_equal_episodes_here_and_in_another_process():
    program = (
        "import sys; sys.path.insert(0, 'tests'); import gymnasium as gym, parkenv;"
        "from test_search_env import digest; print(digest(gym.make('parkenv/Search-v2', scenario='street'), 5))"
    )
    theirs = subprocess.check_output([sys.executable, "-c", program], text=True)
    env = gym.make("parkenv/Search-v2", scenario="street")
    assert theirs.strip() == digest(env, 5) == digest(env, 5) != digest(env, 2**40)


def two_slots(taken):
    lot = grid_lot(1, 2, aisle=6.0)
    return Scenario(name="two", lot=lot, occupancy=always(lot, np.array(taken)), failure_s=7.0, wait_s=2.0)


def test_a_lot_proven_full_ends_the_search_with_the_cost_of_going_elsewhere():
    scenario = two_slots([True, True]).replace(give_up_s=300.0, sensor_model=SensorModel(view_range=0.0))
    env = gym.make("parkenv/Search-v2", scenario=scenario)
    observation, _ = env.reset(seed=0)
    seen_before_the_end, terminated = set(), False
    while not terminated:
        seen_before_the_end.add(int(observation["vertex"]))
        column = int(np.flatnonzero(scenario.lot.neighbors[observation["vertex"]] >= 0)[-1])
        observation, _, terminated, truncated, info = env.step(column)
    assert not truncated
    assert info["reward_gave_up"] == -300.0
    assert not info["parked"]
    assert len(seen_before_the_end & {0, 1}) == 1, "it ends as soon as the second of two slots is seen taken"
    with pytest.raises(gym.error.ResetNeeded):
        env.step(0)


@pytest.mark.parametrize("noisy", [False, True])
def test_the_belief_read_from_an_observation_is_that_of_the_environment(noisy):
    model = SensorModel(8.0, hit_rate=0.9, false_alarm_rate=0.2) if noisy else SensorModel()
    env = gym.make("parkenv/Search-v2", scenario="campus", sensor_model=model).unwrapped
    observation, _ = env.reset(seed=4)
    rng = np.random.default_rng(1)
    for _ in range(60):
        observation, *_ = env.step(rng.choice(np.flatnonzero(observation["action_mask"][:PARK])))
    now, exact = SlotBelief.of_observation(observation), env.state.belief
    assert exact.observed.sum() > 10
    for name in "forecast p_occupied p_observed observed_at age observed_free observed_taken".split():
        np.testing.assert_allclose(getattr(now, name), getattr(exact, name), rtol=1e-6, atol=1e-4)


def test_old_ids_are_not_registered():
    for name, version in {"Search": 2, "SearchSensors": 2, "SearchPerception": 2, "Drive": 1}.items():
        with (
            pytest.warns(DeprecationWarning, match="out of date"),
            pytest.raises(gym.error.DeprecatedEnv, match=f"parkenv/{name}-v{version}"),
        ):
            gym.make(f"parkenv/{name}-v{version - 1}")


@given(x=st.floats(0.0, 600.0))
def test_decay_is_the_exponential(x):
    assert decay_factor(x) == pytest.approx(np.exp(-x), rel=1e-14)


def test_sight_differs_by_distance_and_side():
    lot = make_scenario("mini").lot
    bands = (
        SensorBand(up_to=1.0, beside=True, seen_rate=1.0, hit_rate=1.0, false_alarm_rate=0.0),
        SensorBand(up_to=6.0, beside=True, seen_rate=0.5, hit_rate=0.9, false_alarm_rate=0.1),
        SensorBand(up_to=6.0, beside=False, seen_rate=0.25, hit_rate=0.8, false_alarm_rate=0.2),
    )
    taken = np.arange(lot.n_slots) % 2 == 0
    sensor = SensorModel(6.0, bands=bands)
    scenario = Scenario(name="bands", lot=lot, occupancy=always(lot, taken), sensor_model=sensor)
    starts, slots = scenario.slots_in_view
    rows = slice(starts[0], starts[1])
    own = slots[rows] == 0
    rates = scenario.sensor_rates.of(rows)
    np.testing.assert_array_equal(rates.hit[own], 1.0)
    across = lot.slot_yaw[slots[rows]] != lot.slot_yaw[0]
    assert across.any()
    np.testing.assert_array_equal(rates.seen[across], 0.25)


def test_wrong_use_is_refused():
    env = gym.make("parkenv/Search-v2", scenario="mini").unwrapped
    env.reset(seed=0)
    for wrong in (7, -1, 3.0, None, [1, 2]):
        with pytest.raises(InputError, match="action is"):
            env.step(wrong)
    with pytest.raises(InputError, match="slots"):
        Scenario(name="x", lot=grid_lot(1, 3), occupancy=always(None, np.array([True])))
    with pytest.raises(InputError, match="slots"):
        gym.make("parkenv/Search-v2", scenario="campus").unwrapped.set_state(env.get_state())
