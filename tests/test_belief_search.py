"""The belief planner and the one that expects rivals: against optima and equilibria, and in adverse cases."""

import itertools
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from expected_time import expected_time, optimum_s
from small_lots import cut_in_two, features, full_lot, lasting, small_lot

from parkenv import OccupancyProcess, ParkingLot, Scenario, SensorBand, SensorModel, make_scenario
from parkenv.belief.day_belief import DayBelief
from parkenv.belief.slot_belief import SlotBelief
from parkenv.engine.fleet import DriverKind, Fleet
from parkenv.lots import grid_lot
from parkenv.scenarios.spec import scenario_specs
from parkenv.studies.compare.cases import Case, at_occupancy
from parkenv.studies.episodes import EpisodeRunner
from parkenv.studies.fields import AgentSpec
from parkenv.studies.fleet.setting import Setting
from parkenv.studies.fleet.study import FleetStudy
from parkenv.studies.statistics import mean_interval
from parkenv.world.demand import ConstantTime, Demand, ListedArrivals
from parkenv.world.lot import PARK
from planners import make_agent
from planners.belief.agent import WORK_PER_MS
from planners.belief.best_path import best_path
from planners.belief.planning_graph import MOST_STOPS

LOTS = range(0, 324, 13)
"""Thirteen divides none of the rounds of slot chances, pitch, view and shape: they are mixed as in all 324."""
LOT = grid_lot(1, 3, pitch=12.0)


def gap(seed, **options):
    """How much longer than the optimum it takes on a random small lot whose map is right, %."""
    problem, p, entry = small_lot(seed)
    best = optimum_s(problem, p.astype(np.float32), entry)
    agent = make_agent("belief", problem, **options)
    return 100.0 * (expected_time(agent, problem, p, entry) / best - 1.0)


def has_large_trees(seed):
    """Two aisles, where each slot is observed only from its own vertex."""
    return seed % 6 not in (3, 5) and seed // 18 % 2 == 0


@pytest.mark.slow
@pytest.mark.parametrize(("large", "least", "mean", "most"), [(False, 12, 0.02, 0.1), (True, 5, 0.5, 2.0)])
def test_it_stays_near_the_optimum_on_small_lots(large, least, mean, most):
    gaps = np.array([gap(seed, day=False) for seed in LOTS if has_large_trees(seed) == large])
    assert len(gaps) > least
    assert gaps.min() > -1e-3
    assert gaps.mean() < mean
    assert np.quantile(gaps, 0.95) < most


@pytest.mark.slow
def test_doubting_a_right_map_costs_little():
    assert np.mean([gap(seed) for seed in LOTS]) < 2.0


def search(scenario, seed=0, **options):
    return EpisodeRunner(scenario, "belief", make_agent("belief", scenario, **options)).run(seed).row


def totals_s(scenario, agent, n, options=None):
    return np.array([row["total_s"] for row in Case(scenario, agent, options=options or {}).run(range(n))])


def choices(scenario, monkeypatch, seed=1, **options):
    """What each search for a path was promised and came to, in one search for a slot."""
    made = []

    def noted(*arguments):
        choice = best_path(*arguments)
        made.append((arguments[2], choice))
        return choice

    monkeypatch.setattr("planners.belief.agent.best_path", noted)
    search(scenario, seed, **options)
    return made


def test_decisions_keep_to_their_budget(monkeypatch):
    scenario = at_occupancy(make_scenario("campus"), 0.95)
    n = scenario.lot.n_slots
    one_candidate = 30 * (MOST_STOPS + n + MOST_STOPS) + n
    quick, usual, slow = (
        np.array([choice.work for _, choice in choices(scenario, monkeypatch, budget_ms=ms)])
        for ms in (0.2, 5.0, 50.0)
    )
    for work, ms in (quick, 0.2), (usual, 5.0), (slow, 50.0):
        assert work.max() <= ms * WORK_PER_MS + one_candidate
    assert quick.max() < usual.max() < slow.max()


def test_it_parks_at_once_in_an_empty_lot_that_is_known_to_be():
    lot = grid_lot(2, 20)
    row = search(lasting(lot, np.zeros(lot.n_slots, dtype=bool), said=-5.0))
    assert row["total_s"] == pytest.approx(row["bound_s"], abs=1.0)


@pytest.mark.parametrize(("day_error", "ahead_s", "mean_s"), [(0.0, 50.0, 92.0), (0.8, 40.0, 105.0)])
def test_it_beats_the_planner_of_the_thesis_where_its_map_is_wrong(day_error, ahead_s, mean_s):
    """On jam the tuned planner trusts its map into every aisle; what the first slots show is enough to doubt it."""
    scenario = make_scenario("jam", day_error=day_error)
    belief, tuned = totals_s(scenario, "belief", 10), totals_s(scenario, "mdp-tuned", 10)
    assert mean_interval(belief - tuned)[2] < -ahead_s
    assert belief.mean() < mean_s


def test_it_looks_at_all_of_a_full_lot_again_and_again():
    """Among slots that differ a little it must not drive to and fro between the likeliest ones."""
    scenario = full_lot(grid_lot(4, 30))
    env = gym.make("parkenv/Search-v2", scenario=scenario)
    agent, memory = make_agent("belief", scenario), None
    observation, _ = env.reset(seed=0)
    path = []
    for _ in range(600):
        action, memory = agent.predict(observation, memory)
        observation, *_ = env.step(action)
        path.append(int(observation["vertex"]))
    assert min(len(set(path[i : i + 150])) for i in (150, 300, 450)) > 80


@pytest.mark.parametrize(("rows", "columns"), [(2, 8), (1, 1)])
def test_nothing_free_anywhere_ends_in_proof(rows, columns):
    lot = grid_lot(rows, columns)
    row = search(lasting(lot, np.ones(lot.n_slots, dtype=bool), give_up_s=400.0))
    assert (row["gave_up_s"], row["truncated"], row["failed_parks"]) == (400.0, False, 0)
    assert row["drive_s"] < 120.0


@pytest.mark.parametrize("lot", [grid_lot(1, 1), grid_lot(2, 10)])
def test_the_goal_may_be_the_entry(lot):
    here = ParkingLot(**{**features(lot), "goals": lot.entries})
    row = search(lasting(here, np.arange(lot.n_slots) % 3 != 0))
    assert row["parked"]
    assert row["total_s"] <= 2.0 * row["bound_s"] + 20.0


def test_a_lot_cut_in_two_is_searched_where_a_way_leads():
    lot = cut_in_two()
    half = lot.n_slots // 2
    taken = np.arange(lot.n_slots) < half
    taken[2] = False
    row = search(lasting(lot, taken))
    assert row["slot"] == "2"
    # Nothing within reach is free, and the other half cannot be proven full: the step limit ends it.
    taken[2] = True
    row = search(lasting(lot, taken))
    assert row["truncated"]
    assert row["failed_parks"] == 0


@pytest.mark.parametrize("said", [-8.0, 8.0])
@pytest.mark.parametrize("name", ["campus", "jam"])
def test_what_a_worthless_map_costs(name, said):
    """The map has all slots free, or all taken. With all free, the thesis's planner is 90 s above the bound on jam."""
    scenario = make_scenario(name)
    prior = OccupancyProcess.from_demand(np.full(scenario.lot.n_slots, said), np.zeros(168))
    rows = Case(scenario.replace(prior=prior), "belief").run(range(8))
    assert all(row["parked"] for row in rows)
    lost_s = sorted(row["total_s"] - row["bound_s"] for row in rows)
    # On the fullest day of jam there is no free slot for minutes.
    assert np.mean(lost_s[:-1]) < 30.0


def test_it_expects_slots_that_it_saw_taken_to_come_free():
    """Half of the lot cannot be reached, so it is never proven full; the rest changes within minutes."""
    lot = cut_in_two()
    occupancy = OccupancyProcess.from_demand(np.full(lot.n_slots, 2.5), np.zeros(168), 300.0)
    sighting = SensorModel(view_range=0.0)
    scenario = Scenario(name="busy", lot=lot, occupancy=occupancy, give_up_s=1e4, sensor_model=sighting)
    agent, env = make_agent("belief", scenario), gym.make("parkenv/Search-v2", scenario=scenario)
    expected = []
    for seed in range(10):
        observation, _ = env.reset(seed=seed)
        memory, over = None, False
        while not over:
            action, memory = agent.predict(observation, memory)
            if not (memory.state[: lot.n_slots // 2] == 0).any():
                expected.append(memory.expected_s)
            observation, _, terminated, truncated, info = env.step(action)
            over = terminated or truncated
        assert info["parked"]
    assert len(expected) > 20
    # With a single observation per slot, only giving up would remain once all slots have been observed.
    assert np.median(expected) < 600.0


@pytest.mark.parametrize("seed", [2000035, 2000684])
def test_it_does_not_circle_among_taken_slots(seed):
    """In lots 98 and 99 % full against the forecast: another look at them is no news that begins a plan anew."""
    assert search(make_scenario("jam"), seed)["total_s"] < 400.0


def hidden_lots(name, seen_rate, occupancy=None):
    """Observations are the same from every view: a slot that is missed once is always missed."""
    bands = tuple(SensorBand(6.0, beside, seen_rate, 1.0, 0.0) for beside in (False, True))
    scenario = make_scenario(name).replace(sensor_model=SensorModel(bands=bands))
    return scenario if occupancy is None else at_occupancy(scenario, occupancy)


@pytest.mark.parametrize("seen_rate", [0.3, 0.5])
def test_hidden_slots_are_tried_where_nothing_better_is_left(seen_rate):
    """On a small lot, all slots are soon hidden or taken; the reference planner attempts them one by one."""
    scenario = hidden_lots("mini", seen_rate, 0.8)
    ours, theirs = (Case(scenario, agent).run(range(40)) for agent in ("belief", "mdp"))
    assert not any(row["truncated"] for row in ours)
    means = [np.mean([row["total_s"] for row in rows]) for rows in (ours, theirs)]
    assert means[0] < 1.1 * means[1]
    assert max(row["failed_parks"] for row in ours) >= 2, "they are tried"


def test_a_path_is_kept_to_until_something_is_seen_unless_another_is_better_than_it_was(monkeypatch):
    """Paths are valued by estimates, which differ by where the car is: it could turn round between two for ever."""
    scenario, kept = at_occupancy(make_scenario("campus"), 0.95), []
    for seed in (5, 11, 17, 23, 29):
        made = choices(scenario, monkeypatch, seed=seed, budget_ms=10.0)
        kept += [(left_s, choice.value.expected_s) for left_s, choice in made if left_s < np.inf]
        last = [choice.value.remaining_s for _, choice in made]
        assert all(left_s in (last_s, np.inf) for (left_s, _), last_s in zip(made[1:], last, strict=False))
    assert len(kept) > 10
    assert all(expected_s <= remaining_s for remaining_s, expected_s in kept)


def actions(agent, scenario, seed):
    env = gym.make("parkenv/Search-v2", scenario=scenario)
    observation, _ = env.reset(seed=seed)
    chosen, memory, over = [], None, False
    while not over:
        action, memory = agent.predict(observation, memory)
        chosen.append(int(action))
        observation, _, terminated, truncated, _ = env.step(action)
        over = terminated or truncated
    return chosen


def test_without_rivals_it_is_belief_and_equal_seeds_give_equal_actions_in_batches_too():
    scenario = make_scenario("mini")
    belief = make_agent("belief", scenario)
    nobody = make_agent("belief-rivals", scenario, arrivals_per_hour=0)
    for seed in range(3):
        assert actions(belief, scenario, seed) == actions(nobody, scenario, seed)
    agent = make_agent("belief-rivals", scenario)
    assert actions(agent, scenario, 3) == actions(make_agent("belief-rivals", scenario), scenario, 3)
    observations = [gym.make("parkenv/Search-v2", scenario=scenario).reset(seed=seed)[0] for seed in range(4)]
    batch = {name: np.stack([one[name] for one in observations]) for name in observations[0]}
    together, _ = agent.predict(batch)
    assert together.tolist() == [int(agent.predict(one)[0]) for one in observations]


def in_view_of_a_free_slot(scenario):
    """A car beside a free slot; nearer to the goal, another one was seen free."""
    walk_s, lot = scenario.walk_s, scenario.lot
    drive = scenario.move_s
    for vertex in np.argsort(-walk_s):
        for move in range(4):
            ahead = lot.neighbors[vertex, move]
            if 0 <= ahead < lot.n_slots and walk_s[ahead] + drive[vertex, move] < walk_s[vertex] - 1.2:
                return int(vertex), int(ahead)
    raise AssertionError("no such pair")


def test_where_slots_vanish_it_prefers_the_free_slot_at_hand_to_a_better_one_further_on():
    scenario = make_scenario("campus")
    here, better = in_view_of_a_free_slot(scenario)
    n = scenario.lot.n_slots
    belief = SlotBelief.of_forecast(np.full(n, 0.7), np.full(n, 1e-3))
    belief = belief.update([here, better], [False, False])
    observation = {
        "vertex": np.int64(here), "time": np.array([8 * 3600.0, 0.0]), "action_mask": np.ones(5, np.int8),
        **belief.to_observation(),
    }  # fmt: skip
    calm, _ = make_agent("belief", scenario).predict(observation)
    crowded, _ = make_agent("belief-rivals", scenario, arrivals_per_hour=20_000).predict(observation)
    assert calm != PARK
    assert crowded == PARK
    cars = np.zeros((2, scenario.lot.n_vertices), np.int8)
    for in_view in (0, 100):
        cars[0, here] = in_view
        learned, _ = make_agent("belief-rivals", scenario).predict({**observation, "cars": cars})
        assert (learned == PARK) == (in_view > 0), "whoever meets many cars reckons with many"


def test_rivals_take_the_best_slots_whatever_is_observed_of_one():
    n = 40
    belief = SlotBelief.of_forecast(np.full(n, 0.6), np.full(n, 1e-3))
    near, rates = np.linspace(1.0, -1.0, n), np.zeros(n)
    rates[:10] = 0.05
    calm = DayBelief(belief, near)
    crowd = DayBelief(belief, near, rival_rates=rates)
    for seen_taken in (False, True):
        belief = belief.update([0], [seen_taken])
        for day in (calm, crowd):
            day.update(belief.observations)
        belief = belief.decay(2.0)
    p = crowd.p_occupied(belief.time)
    assert p[5] > calm.p_occupied(belief.time)[5] + 0.05
    assert p[5] > p[20], "the best slots are the rivals'"


def test_drivers_who_know_the_same_make_tours_of_their_own():
    scenario = make_scenario("campus")
    observation, _ = gym.make("parkenv/Search-v2", scenario=scenario).reset(seed=1)
    tours = {}
    for name in ("belief", "belief-rivals"):
        agent, tours[name] = make_agent(name, scenario), set()
        for later_s in range(8):
            driver = {**observation, "time": observation["time"] + np.array([later_s, 0.0], np.float32)}
            action, memory = agent.predict(driver)
            tours[name].add(agent.plan_preview(driver, int(action), memory))
    assert len(tours["belief"]) == 1
    assert len(tours["belief-rivals"]) >= 4


def test_an_experiment_tells_it_the_demand():
    (scenario,) = scenario_specs("mini")
    study = FleetStudy().changed(scenario=scenario)
    for name, rate in (("belief-rivals", 120.0), ("belief-rivals(arrivals_per_hour=30)", 30.0)):
        _, (agent, _) = study.fleet(Setting("mini", AgentSpec.of(name), "own", 0.0, 120.0))
        assert agent.arrivals_per_hour == rate
    sighted = study.changed(sees_cars=True)
    _, (agent, _) = sighted.fleet(Setting("mini", AgentSpec.of("belief-rivals"), "own", 0.0, 120.0))
    assert agent.arrivals_per_hour is None, "it counts the cars that it meets"


class FromSlot:
    def __init__(self, first, world):
        del world
        self.first = first

    def predict(self, observation, state=None):
        last = -1 if state is None else state
        vertex = int(observation["vertex"])
        known = SlotBelief.of_observation(observation)
        if vertex < 3 and known.observed_free[vertex] and (vertex >= self.first or last == 3):
            return PARK, last
        (ahead,) = np.flatnonzero(LOT.neighbors[vertex] >= 0)[:1]
        return int(ahead), 3 if vertex == 2 else last


def scenario(p_taken, taken, v_walk):
    occupancy = OccupancyProcess.from_demand(np.where(taken, 25.0, -25.0), np.zeros(168), 1e9)
    logit = np.log(p_taken / (1.0 - p_taken))
    prior = OccupancyProcess.from_demand(np.full(3, logit), np.zeros(168), 600.0)
    blind = SensorModel(view_range=0.0)
    return make_scenario(
        LOT, occupancy=occupancy, prior=prior, sensor_model=blind, v_walk=v_walk, give_up_s=120.0
    )


def costs(p_taken, v_walk, drivers):
    total_s = np.zeros((len(drivers), len(drivers), 2))
    arrivals = ListedArrivals((8 * 3600.0, 8 * 3600.0 + 2.0))
    demand = Demand(arrivals, ConstantTime(3600.0), ConstantTime(120.0))
    for taken in itertools.product((False, True), repeat=3):
        world = scenario(p_taken, np.array(taken), v_walk)
        p = np.where(taken, p_taken, 1.0 - p_taken).prod()
        kinds = [DriverKind(), DriverKind()]
        for i, first in enumerate(drivers):
            for j, second in enumerate(drivers):
                fleet = Fleet(world, demand, drivers=kinds, background="process", leave_full_lot=False)
                fleet.reset(0)
                agents, memory = [make(world) for make in (first, second)], [None, None]
                while (car := fleet.next_decision()) is not None:
                    action, memory[car] = agents[car].predict(fleet.observation(car), memory[car])
                    fleet.act(action)
                total_s[i, j] += p * fleet.cars["total_s"]
    return total_s


def equilibria(total_s):
    first, second = total_s[..., 0], total_s[..., 1]
    least = (first <= first.min(axis=0) + 1e-9) & (second <= second.min(axis=1, keepdims=True) + 1e-9)
    return [tuple(pair) for pair in np.argwhere(least)]


def ours(world):
    return make_agent("belief-rivals", world, arrivals_per_hour=20)


@pytest.mark.parametrize(("p_taken", "v_walk"), [(0.5, 1.1), (0.3, 0.3), (0.1, 0.3)])
def test_two_of_it_need_no_longer_than_in_equilibrium_and_the_second_cannot_gain(p_taken, v_walk):
    total_s = costs(p_taken, v_walk, [*(partial(FromSlot, k) for k in range(3)), ours])
    exact = equilibria(total_s[:3, :3])
    assert exact
    assert total_s[3, 3].mean() < 1.01 * min(total_s[pair].mean() for pair in exact)
    first, second = total_s[3, 3]
    assert second < total_s[3, :3, 1].min() + 1.0
    # It reckons with more rivals than the one behind it, so in front it may stop too early.
    assert first < total_s[:3, 3, 0].min() + 25.0
