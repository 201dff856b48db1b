"""Label setting against closed forms, other solvers and its own repair; and the agents that plan with it."""

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse.csgraph import dijkstra
from small_lots import CAR_PARKS

from parkenv import InputError, make_scenario
from parkenv.belief.slot_belief import SlotBelief
from parkenv.lots import city_lot, grid_lot
from parkenv.world.lot import PARK
from planners import ParkingMDP, label_setting, make_agent, policy_iteration
from planners.thesis.label_setting import TIE_S, StoppingGraph, best_moves, repair, set_labels

seeds = st.integers(0, 2**32 - 1)


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
    as_good = ParkingMDP(
        [[-1, -1, -1, 1], [-1] * 4], np.full((2, 4), 2.0), [1.0, 1.0], [2.0, 0.0], 0.0, gamma=1.0
    )
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
    expected = (drive + stop).min(axis=1)
    ours = label_setting(mdp).values
    np.testing.assert_array_equal(np.isinf(ours), np.isinf(expected))
    expect_same_values(-ours, np.where(np.isinf(expected), np.inf, expected))


@given(seed=seeds, gamma=st.sampled_from([0.99, 0.9999, 1.0]), shortest=st.sampled_from([0.0, 1e-9, 1e-4]))
@settings(max_examples=60)
def test_edges_of_no_length_or_hardly_any_are_no_obstacle(seed, gamma, shortest):
    mdp = random_process(seed, gamma, 5.0)
    rng = np.random.default_rng(seed)
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
    rng = np.random.default_rng(seed)
    mdp = random_process(seed, gamma, failure)
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


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"solver": "lp"}, "solver is 'lp'"),
        ({"gamma": 1.0, "solver": "policy_iteration"}, "gamma is 1.0"),
        ({"gamma": 0.0}, "gamma is 0.0"),
    ],
)
def test_bad_options_are_refused(options, message):
    with pytest.raises(InputError, match=message):
        make_agent("mdp", make_scenario("mini"), **options)


def test_a_hopeless_slot_found_taken_is_news_and_a_drift_is_not():
    scenario = make_scenario("mini")
    agent = make_agent("mdp", scenario)
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
