"""Sensor models: rates by distance and side, files of them, and counts of the perception pipeline's observations."""

import json

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from parkenv import InputError, SensorBand, SensorModel, Traffic, make_scenario
from parkenv.studies.compare.cases import Case
from parkenv.studies.sensing.simulated_sensors import BAND_ENDS, count_observations, fitted_model
from parkenv.world.lot import PARK
from parkenv.world.sensor_model import SENSOR_MODEL_NAMES
from planners import make_agent

BANDS = (SensorBand(3.0, True, 0.9, 0.99, 0.01), SensorBand(9.0, True, 0.5, 0.9, 0.2))


def test_the_nearest_band_that_reaches_holds():
    beside = np.array([1, 1, 1, 1, 1, 0], dtype=bool)
    rates = SensorModel(12.0, 0.8, 0.3, BANDS).rates(np.array([0.0, 3.0, 3.1, 9.0, 9.1, 1.0]), beside)
    assert rates.seen.tolist() == [0.9, 0.9, 0.5, 0.5, 1.0, 1.0]
    assert rates.hit.tolist() == [0.99, 0.99, 0.9, 0.9, 0.8, 0.8]
    assert rates.false_alarm.tolist() == [0.01, 0.01, 0.2, 0.2, 0.3, 0.3]


def test_files_bring_back_what_was_written_and_say_what_they_are(tmp_path):
    model, file = SensorModel(12.0, 0.8, 0.3, BANDS), tmp_path / "sight.json"
    with pytest.raises(InputError, match="want a sensor model"):
        SensorModel.from_file(file)
    model.to_file(file)
    assert SensorModel.from_file(file) == model
    assert json.loads(file.read_text())["format"] == "parkenv-sensor-model"


@pytest.mark.parametrize("name", SENSOR_MODEL_NAMES)
def test_the_stack_is_nearly_always_right_beside_the_car(name):
    rates = SensorModel.named(name).rates(np.array([0.0]), np.array([True]))
    assert rates.hit[0] > 0.95
    assert rates.false_alarm[0] < 0.05


def test_unseen_slots_are_known_once_they_were_tried():
    env = gym.make("parkenv/Search-v2", scenario="mini", sensor_model=SensorModel.blind()).unwrapped
    prior, lot = env.reset(seed=0)[0]["p_occupied"], env.scenario.lot
    while True:
        slot = env.state.vertex
        if slot < lot.n_slots and env.state.world.occupied(np.array([slot]), env.state.time)[0]:
            break
        env.step(int(np.flatnonzero(lot.neighbors[slot] >= 0)[-1]))
    assert not env.state.belief.observed.any()
    observation, *_ = env.step(PARK)
    assert env.state.belief.observed.tolist() == [s == slot for s in range(lot.n_slots)]
    assert observation["p_occupied"][slot] > 0.99  # cars may leave during the attempt
    others = np.arange(lot.n_slots) != slot
    np.testing.assert_array_equal(observation["p_occupied"][others], prior[others])


@given(st.floats(0.7, 1.0), st.floats(0.0, 0.3), st.floats(0.1, 1.0), st.integers(0, 99))
def test_counts_give_the_rates_that_they_were_drawn_from(hit, false_alarm, seen, seed):
    rng = np.random.default_rng(seed)
    n, looks = 4000, np.zeros((len(BAND_ENDS), 2, 2, 3), dtype=np.int64)
    for band in range(len(BAND_ENDS)):
        for side in (0, 1):
            for taken, rate in ((0, false_alarm), (1, hit)):
                told = rng.binomial(n, seen)
                said = rng.binomial(told, rate)
                looks[band, side, taken] = n - told, told - said, said
    rates = fitted_model(looks).rates(np.array(BAND_ENDS), np.ones(len(BAND_ENDS), dtype=bool))
    np.testing.assert_allclose(rates.seen, seen, atol=0.03)
    np.testing.assert_allclose(rates.hit, hit, atol=0.1)
    np.testing.assert_allclose(rates.false_alarm, false_alarm, atol=0.1)


def test_too_few_looks_are_refused():
    with pytest.raises(InputError, match="want at least 20 of each"):
        fitted_model(np.zeros((len(BAND_ENDS), 2, 2, 3), dtype=np.int64))


def test_looks_of_a_real_search_are_counted():
    """Every slot in view after every step is counted once, and most reported states are correct."""
    scenario = make_scenario("mini")
    looks = count_observations(scenario, "laser", "greedy-drive", range(3), "overcast")
    said = looks.sum(axis=(0, 1))
    assert said.sum() >= 10
    right = said[0, 1] + said[1, 2]
    assert right >= 0.9 * said[:, 1:].sum() > 0
    again = count_observations(scenario, "laser", "greedy-drive", range(3), "overcast")
    np.testing.assert_array_equal(looks, again)
    with pytest.raises(InputError, match="rig is 'sonar'"):
        count_observations(scenario, "sonar", "mdp", [0])


@pytest.mark.slow
def test_the_fast_environment_stands_for_the_slow_one():
    """Through the sensors and with the model fitted to them: the same ranking, and means close to each other."""
    searches = (("campus", "first-free"), ("campus", "greedy-drive"), ("mini", "greedy-goal"))
    slow, fast = ([mean_total_s(name, agent, rig) for name, agent in searches] for rig in ("laser", None))
    assert slow[0] < slow[1]
    assert fast[0] < fast[1]
    np.testing.assert_allclose(fast, slow, rtol=0.2)


def mean_total_s(name, agent, rig):
    scenario = make_scenario(name, sensor_model=SensorModel.named("laser"), traffic=Traffic(3, 5))
    rows = Case(scenario, agent, rig=rig).run(range(2_000, 2_004))
    return np.mean([row["total_s"] for row in rows])


@pytest.mark.parametrize("name", ["belief", "mdp-tuned"])
def test_agents_that_plan_on_what_they_see_refuse_to_search_blindly(name):
    with pytest.raises(InputError, match="plans on observations, and this sensor model has none"):
        make_agent(name, make_scenario("mini", sensor_model=SensorModel.blind()))
