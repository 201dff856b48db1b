"""The MDP of the thesis, its solvers, and its tuning by simulation on the forecast alone."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from expected_time import expected_time
from small_lots import small_lot

from parkenv import InputError, OccupancyProcess, Scenario, SensorModel, make_scenario
from parkenv.belief.slot_belief import SlotBelief
from parkenv.lots import grid_lot, packaged_lot
from parkenv.studies.compare.cases import Case, settings_of
from parkenv.studies.episodes import EpisodeRunner
from parkenv.world.lot import PARK
from parkenv.world.occupancy.day_error import DayError
from planners import CirclingWarning, ParkingMDP, label_setting, make_agent, policy_iteration
from planners.thesis.mdp import discount
from planners.thesis.tuning import tune_failure_cost


def line(p_free, walk_s, hop_s=1.0, failure_s=10.0, gamma=0.999):
    """Slots on a line; "right" leads to the next one, "left" back."""
    n = len(p_free)
    neighbors = np.full((n, 4), -1)
    neighbors[:-1, 3] = np.arange(1, n)
    neighbors[1:, 2] = np.arange(n - 1)
    return ParkingMDP(
        neighbors, np.where(neighbors >= 0, hop_s, 0.0), p_free, walk_s, failure_s, wait_s=1.0, gamma=gamma
    )


def retry_value(mdp):
    """Attempting one slot until it is free has a closed-form value: a geometric series."""
    p = mdp.p_free
    return (p * mdp.park_reward - (1 - p) * mdp.failure_s) / (1 - mdp.gamma * (1 - p))


@pytest.mark.parametrize("solve", [policy_iteration, label_setting])
def test_one_slot_is_a_geometric_series(solve):
    mdp = ParkingMDP([[-1] * 4], np.zeros((1, 4)), [0.25], [30.0], failure_s=10.0, wait_s=100.0, gamma=0.99)
    # Three failures on average, each but the first one decision later.
    expected = -(0.75 * 10.0) / (1 - 0.99 * 0.75)
    solution = solve(mdp)
    assert solution.values[0] == pytest.approx(expected, abs=1e-9)
    assert solution.policy[0] == PARK


@pytest.mark.parametrize("solve", [policy_iteration, label_setting])
@pytest.mark.parametrize("gamma", [0.9, 0.99, 0.999])
def test_parking_along_a_line_is_the_best_stop(solve, gamma):
    """The textbook case: the value is the best over all slots of driving there and attempting until it is free."""
    rng = np.random.default_rng(3)
    n = 30
    mdp = line(rng.uniform(0.05, 0.95, n), 40.0 - np.arange(n), gamma=gamma)
    park = retry_value(mdp)
    discount = gamma ** np.arange(n)
    drive = (1 - discount) / (1 - gamma)  # hops of one second, discounted
    hops = np.abs(np.arange(n)[:, None] - np.arange(n))
    expected = (discount[hops] * park - drive[hops]).max(axis=1)
    solution = solve(mdp)
    np.testing.assert_allclose(solution.values, expected, atol=1e-9)
    best = (discount[hops] * park - drive[hops]).argmax(axis=1)
    assert [a == PARK for a in solution.policy] == [best[i] == i for i in range(n)]


@pytest.mark.parametrize("seed", range(20))
def test_no_action_promises_more_than_the_value_of_the_optimum(seed):
    """Bellman's equation on random directed graphs, with dead ends and slots that are certainly free or taken."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 25))
    neighbors = np.where(rng.random((n, 4)) < 0.6, rng.integers(0, n, (n, 4)), -1)
    p_free, move_s = rng.choice([0.0, 1.0, *rng.random(4)], n), rng.uniform(0.5, 20.0, (n, 4))
    mdp = ParkingMDP(neighbors, move_s, p_free, rng.uniform(0, 200, n), 10.0, wait_s=1.0, gamma=0.999)
    solution = policy_iteration(mdp)
    q, tolerance = mdp.action_values(solution.values), 1e-9 * (1.0 + np.abs(solution.values).max())
    np.testing.assert_allclose(q.max(axis=1), solution.values, atol=tolerance, rtol=0)
    np.testing.assert_allclose(q[np.arange(n), solution.policy], solution.values, atol=tolerance, rtol=0)


def test_a_warm_start_ends_at_the_same_optimum_sooner():
    scenario = make_scenario("campus")
    belief = np.random.default_rng(0).uniform(0.5, 0.99, scenario.lot.n_slots)
    first = policy_iteration(ParkingMDP.from_belief(scenario, belief))
    belief[5] = 1.0
    mdp = ParkingMDP.from_belief(scenario, belief)
    cold, warm = policy_iteration(mdp), policy_iteration(mdp, first.policy)
    np.testing.assert_allclose(warm.values, cold.values, atol=1e-7)
    assert warm.iterations < cold.iterations


def test_without_discount_values_are_expected_times():
    mdp = line(np.full(4, 0.5), np.array([40.0, 30.0, 20.0, 10.0]), gamma=1.0, hop_s=2.0)
    values = label_setting(mdp).values
    # Drive three hops, then fail once on average, then walk 10 s.
    assert mdp.expected_time(values)[0] == pytest.approx(3 * 2.0 + 10.0 + 10.0, abs=1e-6)


def test_a_low_discount_is_warned_of():
    lot = grid_lot(2, 40)
    scenario = make_scenario(lot, failure_s=90.0)
    mdp = ParkingMDP.from_belief(scenario, np.full(lot.n_slots, 0.99), gamma=0.99)
    with pytest.warns(CirclingWarning, match="gamma"):
        mdp.check_discount(policy_iteration(mdp).values)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        good = ParkingMDP.from_belief(scenario, np.full(lot.n_slots, 0.5))
        good.check_discount(policy_iteration(good).values)


def test_a_failure_cost_at_which_trying_in_vain_looks_best_is_warned_of():
    scenario = make_scenario("jam", failure_s=0.0)
    mdp = ParkingMDP.from_belief(scenario, np.ones(scenario.lot.n_slots))
    with pytest.warns(CirclingWarning, match="failure_s"):
        mdp.check_discount(policy_iteration(mdp).values)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"p_free": [0.5, 1.5]}, "p_free"),
        ({"p_free": [0.5]}, "shape"),
        ({"gamma": 0.0}, "gamma"),
        ({"failure_s": -1.0}, "failure_s"),
        ({"neighbors": [[-1, -1, -1, 7], [-1] * 4]}, "neighbors"),
        ({"arrival_cost_s": [np.nan, 1.0]}, "arrival_cost_s"),
    ],
)
def test_a_wrong_process_is_refused(changes, message):
    good = {
        "neighbors": [[-1, -1, -1, 1], [-1, -1, 0, -1]], "move_s": np.ones((2, 4)), "p_free": [0.5, 0.5],
        "arrival_cost_s": [1.0, 2.0], "failure_s": 1.0,
    }  # fmt: skip
    with pytest.raises(InputError, match=message):
        ParkingMDP(**(good | changes))


def test_the_shortest_edge_does_not_make_circling_pay():
    """Stops of imported lots may be a millimetre apart; here the car is fast."""
    scenario = make_scenario(grid_lot(2, 12), v_drive=2000.0)
    assert scenario.move_s[scenario.lot.neighbors >= 0].min() < 0.002
    assert discount(make_scenario("campus")) == discount(make_scenario("street")) == 0.9999
    p_occupied = np.full(24, 0.95)
    with pytest.warns(CirclingWarning, match="gamma"):
        make_agent("mdp", scenario, gamma=0.9999).solve(p_occupied)
    plans = [make_agent("mdp", scenario, solver=solver) for solver in ("label_setting", "policy_iteration")]
    assert 0.9999 < plans[0].gamma < 1.0
    costs = [plan.expected_time(p_occupied) for plan in plans]
    np.testing.assert_allclose(costs[0], costs[1], rtol=1e-6)
    exact = make_agent("mdp", scenario, gamma=1.0).expected_time(p_occupied)
    np.testing.assert_allclose(costs[0], exact, rtol=1e-4)


@pytest.mark.parametrize("name", ["campus", "jam"])
def test_who_walks_as_fast_as_they_drive_parks_by_the_entry(name):
    """Fig. 4.11b."""
    fast, slow = (settings_of(make_scenario(name), [10.0], [v], [10.0])[0] for v in (10.0, 4.0))
    planner, nearest, slow_walk = (
        {
            key: np.mean([row[key] for row in Case(scenario, agent).run(range(40))])
            for key in ("driven_m", "walked_m")
        }
        for scenario, agent in ((fast, "mdp"), (fast, "greedy-drive"), (slow, "mdp"))
    )
    assert planner["driven_m"] <= 1.1 * nearest["driven_m"]
    assert planner["walked_m"] > slow_walk["walked_m"] + 10.0


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
