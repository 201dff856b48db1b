"""Tuning the thesis's planner by simulation on the forecast alone."""

import gymnasium as gym
import numpy as np
import pytest
from expected_time import expected_time
from small_lots import small_lot

from parkenv import InputError, OccupancyProcess, Scenario, SensorModel, make_scenario
from parkenv.belief.slot_belief import SlotBelief
from parkenv.lots import packaged_lot
from parkenv.studies.episodes import EpisodeRunner
from parkenv.world.occupancy.day_error import DayError
from planners import make_agent
from planners.thesis.tuning import tune_failure_cost

COSTS = (1.0, 4.0, 16.0, 64.0)


@pytest.mark.parametrize("seed", [3, 5, 21, 39, 59, 75])
def test_the_simulation_agrees_with_the_planner_itself(seed):
    """Its mean over worlds is the planner's exact expectation, up to sampling error."""
    problem, p, entry = small_lot(seed)
    tuning = tune_failure_cost(problem, p, entry, costs=COSTS, worlds=4000, seed=1)
    exact = [expected_time(make_agent("mdp", problem, failure_s=c), problem, p, entry) for c in COSTS]
    np.testing.assert_allclose(tuning.mean_s, exact, rtol=0.05)
    assert exact[COSTS.index(tuning.best)] <= min(exact) * 1.03


@pytest.mark.parametrize(
    ("level", "sensor"), [(1.5, SensorModel()), (0.0, SensorModel(hit_rate=0.8, false_alarm_rate=0.1))]
)
def test_the_simulation_has_days_and_errors_of_the_sensor_as_the_environment_has(level, sensor):
    lot, p = packaged_lot("mini"), 0.6
    lasting = OccupancyProcess.from_demand(
        np.full(lot.n_slots, np.log(p / (1.0 - p))), np.zeros(168), 1e9
    ).with_day_error(DayError(level))
    scenario = Scenario(name="lasting", lot=lot, occupancy=lasting, give_up_s=300.0, sensor_model=sensor)
    forecast, entry = np.full(lot.n_slots, p), int(lot.entry_vertices[0])
    found = tune_failure_cost(
        scenario.public(), forecast, entry, costs=[4.0], worlds=4000, day_error=DayError(level)
    ).mean_s[0]
    runner = EpisodeRunner(scenario, "mdp", make_agent("mdp", scenario, failure_s=4.0, gamma=1.0))
    times = np.array([runner.run(seed).row["total_s"] for seed in range(800)])
    assert abs(times.mean() - found) < 2.5 * times.std() / np.sqrt(len(times))
    plain = tune_failure_cost(
        scenario.replace(sensor_model=SensorModel()).public(), forecast, entry, costs=[4.0], worlds=4000
    )
    assert abs(times.mean() - plain.mean_s[0]) > 3.0 * times.std() / np.sqrt(len(times)), "it matters here"


def test_the_same_seed_gives_the_same_choice_and_another_one_other_worlds():
    problem, p, entry = small_lot(2)
    one, two, other = (tune_failure_cost(problem, p, entry, seed=s) for s in (0, 0, 1))
    np.testing.assert_array_equal(one.mean_s, two.mean_s)
    assert (one.mean_s != other.mean_s).any()


def test_it_sees_the_forecast_and_not_the_world():
    """Two opposite worlds with the same map: the choice is the same."""
    scenario = make_scenario("jam")
    full = OccupancyProcess.from_demand(np.full(scenario.lot.n_slots, 9.0), np.zeros(168))
    chosen = []
    for s in (scenario, scenario.replace(occupancy=full, prior=scenario.prior)):
        observation, _ = gym.make("parkenv/Search-v2", scenario=s).reset(seed=4)
        agent = make_agent("mdp-tuned", s)
        chosen.append(agent.begin(observation, SlotBelief.of_observation(observation)).failure_s)
    assert chosen[0] == chosen[1]


def test_it_is_the_planner_of_the_thesis_at_the_chosen_cost():
    scenario = make_scenario("campus")
    tuned = EpisodeRunner(scenario, "mdp-tuned", make_agent("mdp-tuned", scenario))
    for seed in range(3):
        row = tuned.run(seed).row
        observation, _ = tuned.env.reset(seed=seed)
        cost = tuned.agent.begin(observation, SlotBelief.of_observation(observation)).failure_s
        plain = EpisodeRunner(scenario, "mdp", make_agent("mdp", scenario, failure_s=cost)).run(seed).row
        assert row == plain


@pytest.mark.parametrize(
    ("n", "options", "message"),
    [
        (12, {"worlds": 0}, "worlds is 0"),
        (12, {"costs": (0.0, 1.0)}, "costs"),
        (4, {}, "p_occupied has shape"),
    ],
)
def test_what_cannot_be_simulated_is_refused(n, options, message):
    problem, p, entry = small_lot(0)
    with pytest.raises(InputError, match=message):
        tune_failure_cost(problem, p[:n], entry, **options)
    if "worlds" in options:
        with pytest.raises(InputError, match=message):
            make_agent("mdp-tuned", problem, **options)
