"""What every environment answers to arguments that it does not have, and to calls out of order."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import ResetNeeded

from parkenv import InputError, lot_v0, make_agent, make_scenario, simulate
from parkenv.envs.local_observation import LocalObservation
from parkenv.envs.sb3 import SearchVecEnv

OPTIONS = {
    "parkenv/Search-v2": {"scenario": "mini"},
    "parkenv/SearchSensors-v2": {"scenario": "mini", "observation": "scan"},
    "parkenv/SearchPerception-v2": {"scenario": "mini"},
    "parkenv/Drive-v1": {"lot": "mini"},
}
MAKERS = (gym.make, lambda name, **options: gym.make_vec(name, 2, **options))
EVERY_ID = pytest.mark.parametrize("name", OPTIONS)
EVERY_LOT = pytest.mark.parametrize("make", [lot_v0.raw_env, lot_v0.parallel_env])


def test_every_registered_id_is_tested():
    assert set(OPTIONS) == {name for name in gym.registry if name.startswith("parkenv/")}


@EVERY_ID
@pytest.mark.parametrize("make", MAKERS)
def test_an_unknown_keyword_is_a_type_error_as_of_any_python_function(make, name):
    """TorchRL's `GymEnv` asks every environment for `frameskip`, and understands nothing else."""
    with pytest.raises(TypeError, match=r"\(\) got an unexpected keyword argument 'frameskip'"):
        make(name, frameskip=4, **OPTIONS[name])


@pytest.mark.parametrize("make", MAKERS)
@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"observaton": "local"}, TypeError, "'observaton'; did you mean 'observation'"),
        ({"k": 3}, InputError, "k is 3"),
        ({"flat": True}, InputError, "flat is True"),
        ({"reward_scale": 0.0}, InputError, r"reward_scale is 0\.0"),
        ({"observation": "hidden"}, InputError, "full, occupancy, local"),
    ],
)
def test_a_wrong_argument_of_a_search_is_named(make, options, error, message):
    with pytest.raises(error, match=message):
        make("parkenv/Search-v2", scenario="mini", **options)


def test_other_makers_say_it_alike_and_name_what_is_near():
    for make in (lot_v0.env, lot_v0.parallel_env, lambda **k: make_scenario("mini", **k)):
        with pytest.raises(TypeError, match=r"'failure_cost'.*'failure_s'"):
            make(failure_cost=3.0)
    with pytest.raises(TypeError, match="frameskip"):
        SearchVecEnv(2, "mini", frameskip=4)


@pytest.mark.parametrize("name", ["parkenv/Search-v2", "parkenv/SearchPerception-v2"])
def test_the_local_observation_by_name_is_that_of_the_wrapper(name):
    options = OPTIONS[name] | ({"weather": "sunny", "picture_width": 160} if "Perception" in name else {})
    named = gym.make(name, observation="local", k=3, **options)
    wrapped = LocalObservation(gym.make(name, **options), k=3)
    rng = np.random.default_rng(0)
    ours, theirs = named.reset(seed=3)[0], wrapped.reset(seed=3)[0]
    for _ in range(8):
        assert named.observation_space.contains(ours)
        for key, value in theirs.items():
            np.testing.assert_array_equal(ours[key], value)
        action = int(rng.choice(np.flatnonzero(ours["action_mask"][:4])))
        (ours, *results), (theirs, *expected) = named.step(action), wrapped.step(action)
        assert results == expected


def test_a_planner_says_what_it_needs_of_a_local_observation():
    env = gym.make("parkenv/Search-v2", scenario="mini", observation="local")
    with pytest.raises(InputError, match="observation holds local, action_mask, want"):
        simulate(env, make_agent("mdp", env.unwrapped.scenario), seed=0)


@EVERY_ID
def test_calls_out_of_order_are_refused(name):
    env = gym.make(name, **OPTIONS[name])
    action = np.zeros(2, np.float32) if "Drive" in name else 3
    with pytest.raises(ResetNeeded):
        env.step(action)
    with pytest.raises(InputError, match="options is 3, want a dictionary or None"):
        env.unwrapped.reset(options=3)
    env.reset(seed=0)
    env.step(action)
    env.close()
    with pytest.raises(ResetNeeded):
        env.step(action)
    env.reset(seed=0)
    env.step(action)


@EVERY_LOT
def test_a_lot_has_no_cars_before_it_begins_and_after_its_end(make):
    env = make(scenario="mini", cars=2)
    act = {"car_0": 3} if make is lot_v0.parallel_env else 3
    for wrong in (act, {}, None):
        with pytest.raises(ResetNeeded):
            env.step(wrong)
    env.reset(seed=0)
    for wrong in (None, 7, "a"):
        with pytest.raises(InputError, match="action"):
            env.step(wrong)
    env.step(act)
    env.close()
    with pytest.raises(ResetNeeded):
        env.step(act)


@pytest.mark.parametrize(
    ("make", "seeds"),
    [
        (lambda: lot_v0.raw_env(scenario="mini", cars=2), (1.5, -1, "1", True)),
        (lambda: lot_v0.parallel_env(scenario="mini", cars=2), (1.5, -1, "1", True)),
        (lambda: gym.make_vec("parkenv/Search-v2", 2, scenario="mini"), (1.5, -1, [1.5, 2], [1, -2])),
    ],
)
def test_seeds_are_whole_numbers(make, seeds):
    env = make()
    for seed in seeds:
        with pytest.raises(InputError, match="seed is"):
            env.reset(seed=seed)


def test_an_empty_name_is_not_the_working_folder(tmp_path, monkeypatch):
    (tmp_path / "one.toml").write_text('lot = "mini"\n')
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="unknown scenario ''"):
        make_scenario("")
