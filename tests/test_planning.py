"""The MDP of the thesis and its solvers against closed forms and each other; repair; tuning on the forecast alone."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from expected_time import expected_time
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse.csgraph import dijkstra
from small_lots import CAR_PARKS, small_lot

from parkenv import OccupancyProcess, Scenario, SensorModel, make_scenario
from parkenv.belief.slot_belief import SlotBelief
from parkenv.lots import city_lot, grid_lot, packaged_lot
from parkenv.studies.compare.cases import Case, settings_of
from parkenv.studies.episodes import EpisodeRunner
from parkenv.world.lot import PARK
from parkenv.world.occupancy.day_error import DayError
from planners import CirclingWarning, ParkingMDP, label_setting, make_agent, policy_iteration
from planners.thesis.label_setting import TIE_S, StoppingGraph, best_moves, repair, set_labels
from planners.thesis.mdp import discount
from planners.thesis.tuning import tune_failure_cost

COSTS = (1.0, 4.0, 16.0, 64.0)
seeds = st.integers(0, 2**32 - 1)


def line(p_free, walk_s, hop_s=1.0, failure_s=10.0, gamma=0.999):
    """Slots on a line; "right" leads to the next one, "left" back."""
    n = len(p_free)
    neighbors = np.full((n, 4), -1)
    neighbors[:-1, 3] = np.arange(1, n)
    neighbors[1:, 2] = np.arange(n - 1)
    move_s = np.where(neighbors >= 0, hop_s, 0.0)
    return ParkingMDP(neighbors, move_s, p_free, walk_s, failure_s, wait_s=1.0, gamma=gamma)


def retry_value(mdp):
    """Attempting one slot until it is free has a closed-form value: a geometric series."""
    p = mdp.p_free
    return (p * mdp.park_reward - (1 - p) * mdp.failure_s) / (1 - mdp.gamma * (1 - p))


@pytest.mark.parametrize("solve", [policy_iteration, label_setting])
def test_one_slot_is_a_geometric_series(solve):
    mdp = ParkingMDP([[-1] * 4], np.zeros((1, 4)), [0.25], [30.0], failure_s=10.0, wait_s=100.0, gamma=0.99)
    # Three failures on average, each but the first one decision later.
    expected, solution = -(0.75 * 10.0) / (1 - 0.99 * 0.75), solve(mdp)
    assert solution.values[0] == pytest.approx(expected, abs=1e-9)
    assert solution.policy[0] == PARK


@pytest.mark.parametrize("solve", [policy_iteration, label_setting])
@pytest.mark.parametrize("gamma", [0.9, 0.99, 0.999])
def test_parking_along_a_line_is_the_best_stop(solve, gamma):
    """The textbook case: the value is the best over all slots of driving there and attempting until it is free."""
    rng, n = np.random.default_rng(3), 30
    mdp = line(rng.uniform(0.05, 0.95, n), 40.0 - np.arange(n), gamma=gamma)
    park, discount = retry_value(mdp), gamma ** np.arange(n)
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
    means = []
    for scenario, agent in ((fast, "mdp"), (fast, "greedy-drive"), (slow, "mdp")):
        rows = Case(scenario, agent).run(range(40))
        means.append([np.mean([row[key] for row in rows]) for key in ("driven_m", "walked_m")])
    (driven, walked), (nearest, _), (_, walked_slowly) = means
    assert driven <= 1.1 * nearest
    assert walked > walked_slowly + 10.0


@pytest.mark.parametrize("seed", [3, 5, 21, 39, 59, 75])
def test_the_simulation_agrees_with_the_planner_itself(seed):
    """Its mean over worlds is the planner's exact expectation, up to sampling error."""
    problem, p, entry = small_lot(seed)
    tuning = tune_failure_cost(problem, p, entry, costs=COSTS, worlds=4000, seed=1)
    exact = [expected_time(make_agent("mdp", problem, failure_s=c), problem, p, entry) for c in COSTS]
    np.testing.assert_allclose(tuning.mean_s, exact, rtol=0.05)
    assert exact[COSTS.index(tuning.best)] <= min(exact) * 1.03


@pytest.mark.parametrize(("level", "errors"), [(1.5, {}), (0.0, {"hit_rate": 0.8, "false_alarm_rate": 0.1})])
def test_the_simulation_has_days_and_errors_of_the_sensor_as_the_environment_has(level, errors):
    lot, p, sensor = packaged_lot("mini"), 0.6, SensorModel(**errors)
    lasting = OccupancyProcess.from_demand(np.full(lot.n_slots, np.log(p / (1.0 - p))), np.zeros(168), 1e9)
    lasting = lasting.with_day_error(DayError(level))
    scenario = Scenario(name="lasting", lot=lot, occupancy=lasting, give_up_s=300.0, sensor_model=sensor)
    forecast, entry = np.full(lot.n_slots, p), int(lot.entry_vertices[0])
    simulated = {"p_occupied": forecast, "vertex": entry, "costs": [4.0], "worlds": 4000}
    found = tune_failure_cost(scenario.public(), **simulated, day_error=DayError(level)).mean_s[0]
    runner = EpisodeRunner(scenario, "mdp", make_agent("mdp", scenario, failure_s=4.0, gamma=1.0))
    times = np.array([runner.run(seed).row["total_s"] for seed in range(800)])
    assert abs(times.mean() - found) < 2.5 * times.std() / np.sqrt(len(times))
    plain = tune_failure_cost(scenario.replace(sensor_model=SensorModel()).public(), **simulated).mean_s[0]
    assert abs(times.mean() - plain) > 3.0 * times.std() / np.sqrt(len(times)), "it matters here"


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


def random_process(seed, gamma, failure, *, shortest=0.5, wait_s=1.0, two_way=False):
    """A random graph with dead ends, unreachable parts, and slots that are certainly free or taken."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 30))
    neighbors = np.where(rng.random((n, 4)) < 0.5, rng.integers(0, n, (n, 4)), -1)
    move_s = np.round(rng.uniform(shortest, 20.0, (n, 4)), int(rng.integers(0, 3)))
    if two_way:
        ring = np.arange(n)
        neighbors = np.stack([(ring + 1) % n, (ring - 1) % n, np.full(n, -1), np.full(n, -1)], axis=1)
        move_s[:, 1] = np.roll(move_s[:, 0], 1)
    kind, some = rng.integers(0, 4), rng.choice([0.0, 1.0, *rng.random(4)], n)
    p_free = [some, np.zeros(n), np.ones(n), np.where(rng.random(n) < 0.1, 0.7, 0.0)][kind]
    return ParkingMDP(neighbors, move_s, p_free, rng.uniform(0, 200, n), failure, wait_s, gamma)


def expect_same_values(ours, theirs):
    scale = 1.0 + np.abs(theirs[np.isfinite(theirs)]).max(initial=0.0)
    np.testing.assert_allclose(ours, theirs, atol=1e-9 * scale, rtol=0)


def test_unreachable_ties_and_circles_have_their_closed_forms():
    """On a ring of four either way round is as long; on one that is cheap to go round, circling beats every stop."""
    neighbors = [[-1, 1, -1, -1], [-1] * 4, [0, -1, -1, -1]]
    mdp = ParkingMDP(neighbors, np.ones((3, 4)), [0.5, 0.0, 0.0], [5.0] * 3, failure_s=10.0, gamma=1.0)
    solution = label_setting(mdp)
    np.testing.assert_allclose(solution.values, [-10.0, -np.inf, -11.0])
    assert list(solution.policy) == [PARK, 0, 0]
    ring = np.arange(4)
    neighbors = np.stack([np.full(4, -1), (ring - 1) % 4, np.full(4, -1), (ring + 1) % 4], axis=1)
    mdp = ParkingMDP(neighbors, np.full((4, 4), 3.0), [1.0, 0, 0, 0], np.zeros(4), failure_s=50.0)
    assert list(label_setting(mdp).policy) == [PARK, 1, 1, 3]
    both = np.full((2, 4), 2.0), [1.0, 1.0], [2.0, 0.0], 0.0
    as_good = ParkingMDP([[-1, -1, -1, 1], [-1] * 4], *both, gamma=1.0)
    assert list(label_setting(as_good).policy) == [PARK, PARK]
    n = 5
    neighbors = np.full((n, 4), -1)
    neighbors[:, 0] = (np.arange(n) + 1) % n
    mdp = ParkingMDP(neighbors, np.ones((n, 4)), np.zeros(n), np.zeros(n), 90.0, wait_s=50.0, gamma=0.99)
    assert not set_labels(StoppingGraph.of(mdp), mdp.p_free).settled
    solution = label_setting(mdp)
    np.testing.assert_allclose(solution.values, -100.0)
    assert (solution.policy == 0).all()


@given(
    seed=seeds,
    gamma=st.sampled_from([0.9, 0.99, 0.999, 0.9999]),
    failure=st.sampled_from([0.0, 5.0, 90.0]),
    wait_s=st.sampled_from([0.0, 1.0, 50.0]),
    two_way=st.booleans(),
)
@settings(max_examples=200)
def test_it_agrees_with_policy_iteration_on_any_graph(seed, gamma, failure, wait_s, two_way):
    mdp = random_process(seed, gamma, failure, wait_s=wait_s, two_way=two_way)
    ours, theirs = label_setting(mdp), policy_iteration(mdp)
    expect_same_values(ours.values, theirs.values)
    q = mdp.action_values(ours.values)
    expect_same_values(q.max(axis=1), theirs.values)
    assert (q[np.arange(mdp.n_states), ours.policy] >= q.max(axis=1) - 1.01 * TIE_S).all()
    if two_way:
        assert ours.iterations == 1, "two-way edges need no other solver"


@given(seed=seeds, failure=st.sampled_from([0.0, 5.0, 90.0]))
@settings(max_examples=60)
def test_without_discount_it_is_the_shortest_way_on_any_graph(seed, failure):
    mdp = random_process(seed, 1.0, failure)
    n = mdp.n_states
    edge = np.full((n, n), np.inf)
    source, move = np.nonzero(mdp.neighbors >= 0)
    np.minimum.at(edge, (source, mdp.neighbors[source, move]), mdp.move_s[source, move])
    drive = dijkstra(np.where(np.isinf(edge), 0.0, edge))
    with np.errstate(divide="ignore", invalid="ignore"):
        stop = np.where(mdp.p_free > 0, (1 - mdp.p_free) / mdp.p_free * failure - mdp.park_reward, np.inf)
    expected, ours = (drive + stop).min(axis=1), label_setting(mdp).values
    np.testing.assert_array_equal(np.isinf(ours), np.isinf(expected))
    expect_same_values(-ours, np.where(np.isinf(expected), np.inf, expected))


@given(seed=seeds, gamma=st.sampled_from([0.99, 0.9999, 1.0]), shortest=st.sampled_from([0.0, 1e-9, 1e-4]))
@settings(max_examples=60)
def test_edges_of_no_length_or_hardly_any_are_no_obstacle(seed, gamma, shortest):
    mdp, rng = random_process(seed, gamma, 5.0), np.random.default_rng(seed)
    move_s = np.where(rng.random(mdp.move_s.shape) < 0.2, shortest, mdp.move_s)
    mdp = ParkingMDP(mdp.neighbors, move_s, mdp.p_free, mdp.arrival_cost_s, 5.0, 1.0, gamma)
    ours = label_setting(mdp)
    if gamma < 1.0:
        expect_same_values(ours.values, policy_iteration(mdp).values)
    else:
        finite = np.isfinite(ours.values)
        best = mdp.action_values(np.where(finite, ours.values, -1e12)).max(axis=1)
        expect_same_values(ours.values[finite], best[finite])


def test_directed_lots_with_little_free_are_settled_in_one_pass():
    """The real thing: lots with one-way lanes need no other solver, as long as something may be free."""
    rng = np.random.default_rng(1)
    for lot in [city_lot(600), *(make_scenario(name).lot for name in CAR_PARKS)]:
        scenario = make_scenario(lot)
        for chance in (0.0, 0.02, 0.3):
            p_free = np.where(rng.random(lot.n_slots) < chance, rng.random(lot.n_slots), 0.0)
            p_free[-1] = 0.2 if chance else 0.0
            mdp = ParkingMDP.from_belief(scenario, 1.0 - p_free)
            solution = label_setting(mdp)
            np.testing.assert_allclose(solution.values, policy_iteration(mdp).values, atol=1e-7)
            assert solution.iterations == 1 or not p_free.any(), (lot.name, chance)


@given(
    seed=seeds,
    gamma=st.sampled_from([0.9, 0.99, 0.9999, 1.0]),
    failure=st.sampled_from([0.0, 5.0, 90.0]),
    of_a_lot=st.booleans(),
)
@settings(max_examples=100)
def test_a_mended_plan_equals_a_fresh_one(seed, gamma, failure, of_a_lot):
    rng, mdp = np.random.default_rng(seed), random_process(seed, gamma, failure)
    n_slots = mdp.n_states
    if of_a_lot:
        lot = grid_lot(int(rng.integers(1, 5)), int(rng.integers(2, 9)))
        p = rng.choice([0.0, 1.0, *rng.random(3)], lot.n_slots)
        mdp = ParkingMDP.from_belief(make_scenario(lot), p, failure_s=failure, gamma=gamma)
        n_slots = lot.n_slots
    graph = StoppingGraph.of(mdp)
    labels = set_labels(graph, mdp.p_free.copy())
    for _ in range(12):
        changed = rng.choice(n_slots, int(rng.integers(0, min(n_slots, 6) + 1)), replace=False)
        repair(graph, labels, changed, rng.choice([0.0, 1.0, *rng.random(3)], len(changed)))
        fresh = set_labels(graph, labels.p_free.copy())
        assert labels.settled == fresh.settled
        if fresh.settled:
            expect_same_values(labels.cost, fresh.cost)
            moves, again = (best_moves(graph, x.p_free, x.cost) for x in (labels, fresh))
            np.testing.assert_array_equal(moves, again)


@pytest.fixture(scope="module")
def city():
    scenario = make_scenario(city_lot(3000))
    mdp = ParkingMDP.from_belief(scenario, np.random.default_rng(0).uniform(0.3, 1.0, 3000))
    return StoppingGraph.of(mdp), mdp.p_free


def test_mending_touches_what_the_change_reaches_and_plans_large_changes_afresh(city):
    graph, p_free = city
    labels = set_labels(graph, p_free.copy())
    passed = np.flatnonzero(labels.move[:3000] != PARK)[:200]
    touched = [repair(graph, labels, passed[i : i + 1], np.zeros(1)) for i in range(200)]
    assert touched == [0] * 200, "a slot that nobody was to park in, found taken, changes no plan"
    touched = []
    for slot in np.random.default_rng(2).permutation(3000)[:60]:
        before, was = labels.cost.copy(), labels.p_free[slot]
        touched.append(repair(graph, labels, np.array([slot]), np.ones(1)))
        assert (labels.cost != before).sum() <= touched[-1] or touched[-1] == -1
        repair(graph, labels, np.array([slot]), np.array([was]))
        np.testing.assert_array_equal(labels.cost, before)
    assert 0 < max(touched) < 300, touched
    labels = set_labels(graph, p_free.copy())
    changed = np.random.default_rng(1).permutation(3000)[:1500]
    assert repair(graph, labels, changed, np.full(1500, 0.5)) == -1
    np.testing.assert_array_equal(labels.cost, set_labels(graph, labels.p_free).cost)
    # So is the loss of the one slot that all the lot was heading for.
    only = np.zeros(len(p_free))
    only[1234] = 1.0
    labels = set_labels(graph, only)
    assert repair(graph, labels, np.array([1234]), np.zeros(1)) == -1
    np.testing.assert_array_equal(labels.cost, set_labels(graph, labels.p_free).cost)


# On a full day of mini, failing for ever costs nothing.
@pytest.mark.filterwarnings("ignore:a failed attempt costs nothing:planners.CirclingWarning")
@pytest.mark.parametrize("failure_s", [0.0, 10.0, 90.0])
@pytest.mark.parametrize("name", CAR_PARKS)
def test_both_solvers_lead_to_the_same_actions(name, failure_s):
    scenario = make_scenario(name, failure_s=failure_s)
    env = gym.make("parkenv/Search-v2", scenario=scenario)
    agents = [make_agent("mdp", scenario, solver=s) for s in ("label_setting", "policy_iteration")]
    replans = 0
    for seed in range(3):
        observation, _ = env.reset(seed=seed)
        memories, over, steps = [None, None], False, 0
        while not over and steps < 60:
            actions = []
            for i, agent in enumerate(agents):
                action, memories[i] = agent.predict(observation, memories[i])
                actions.append(int(action))
            assert actions[0] == actions[1], (seed, steps)
            observation, _, terminated, truncated, _ = env.step(actions[0])
            over, steps = terminated or truncated, steps + 1
        assert memories[0].replans == memories[1].replans
        replans += memories[0].replans
        np.testing.assert_array_equal(memories[0].policy, memories[1].policy)
    assert replans > 0, "on an empty day a search ends without any"


def test_a_hopeless_slot_found_taken_is_news_and_a_drift_is_not():
    agent = make_agent("mdp", make_scenario("mini"))
    belief = np.full(10, 0.995, dtype=np.float32)
    stated = SlotBelief.of_forecast(belief, np.full(10, 1e-4)).to_observation()
    observation = {"vertex": 3, "time": np.zeros(2, dtype=np.float32), **stated}
    _, memory = agent.predict(observation)
    drifted = belief.copy()
    drifted[[1, 2]] += 0.002
    agent.predict({**observation, "p_occupied": drifted}, memory)
    assert memory.replans == 0
    drifted[3] = 1.0
    agent.predict({**observation, "p_occupied": drifted}, memory)
    assert memory.replans == 1
    np.testing.assert_array_equal(memory.labels.p_free[:10], 1.0 - drifted.astype(np.float64))
