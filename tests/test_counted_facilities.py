"""Counted facilities in the engine: barrier, time inside, full signs and live counts; drivers who may not park."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from scipy.stats import binom, poisson
from small_lots import driven
from test_supply import GARAGE, town

from parkenv import make_scenario, simulate
from parkenv.engine.fleet import DriverKind, Fleet
from parkenv.engine.kernel import p_full
from parkenv.engine.records import PARKED, SEARCHING
from parkenv.lots import grid_lot
from parkenv.studies.fields import AgentSpec
from parkenv.studies.fleet.drivers import policy_of
from parkenv.world.demand import ConstantTime, Demand, ExponentialTime, ListedArrivals, PoissonArrivals
from parkenv.world.lot import PARK, ParkingLot
from parkenv.world.occupancy.process import Arrival
from parkenv.world.occupancy.typical_week import typical_occupancy
from parkenv.world.tariff import Price, Zone
from planners import make_agent
from planners.heuristics.policies import POLICIES

GREEDY = DriverKind(policy=POLICIES["greedy-drive"])


def garage_alone(**facility):
    grid = grid_lot(1, 1)
    fields = {"zone": "", "capacity": 5, "gate_s": 0.0, "inside_s": (0.0, 0.0), "xy": (1.0, 5.0)}
    garage = replace(GARAGE, **fields | facility)
    empty = np.zeros(0)
    lot = ParkingLot(
        "garage", (), empty, empty, empty, empty, empty, grid.lanes, grid.entries, grid.goals, facilities=(garage,)
    )  # fmt: skip
    return make_scenario(lot)


def run(scenario, demand, kind=GREEDY, **options):
    return driven(Fleet(scenario, demand, background="none", drivers=[kind], **options), 3)


def parked_in(fleet, slot):
    cars = fleet.cars
    return np.count_nonzero((cars["slot"] == slot) & np.isin(cars["state"], (PARKED, SEARCHING)))


def test_cars_stand_in_line_before_the_barrier():
    scenario = garage_alone(gate_s=20.0, inside_s=(30.0, 80.0))
    fleet = run(scenario, Demand(ListedArrivals((0.0, 1.0, 2.0, 3.0)), ConstantTime(7200.0)))
    cars = fleet.cars
    inside_s = 30.0 + 50.0 * np.arange(4) / 5
    # Each passes 20 s after the one before it, and drives on inside as far as that is full.
    np.testing.assert_allclose(np.diff(cars["ended_at"] - inside_s), 20.0)
    np.testing.assert_allclose(cars["queued_s"], 19.0 * np.arange(4))
    np.testing.assert_allclose(cars["drive_s"], cars["ended_at"] - cars["arrival"])
    np.testing.assert_allclose(cars["total_s"], cars["drive_s"] + cars["walk_s"])
    assert cars["ended_at"][0] - cars["arrival"][0] == pytest.approx(50.0, abs=15.0)
    assert scenario.enter_s.tolist() == [20.0 + 55.0]
    fleet.run(until=cars["ended_at"][0] + 7200.0)
    assert fleet.counts().tolist() == [3]


@pytest.mark.parametrize("gate_s", [0.0, 15.0])
def test_every_car_is_somewhere(gate_s):
    """Counts of facilities are those of the cars in them, and never above capacity; cars are conserved."""
    garage = replace(GARAGE, capacity=6, gate_s=gate_s, zone="")
    other = replace(GARAGE, name="P2", capacity=2, xy=(5.0, 9.0), zone="", known="nothing")
    lot = town(facilities=(garage, other), slot_facility=(), zone_rules={})
    demand = Demand(PoissonArrivals(60.0, 0.0, 6 * 3600.0), ExponentialTime(900.0), ConstantTime(240.0))
    fleet = Fleet(make_scenario(lot), demand, background="none", drivers=[GREEDY], leave_full_lot=False)
    fleet.reset(seed=2)
    full = 0
    for minute in range(4, 480, 4):
        fleet.run(until=fleet.begin + 60.0 * minute)
        totals, counts = fleet.totals, fleet.counts()
        assert sum(totals[name] for name in ("due", "searching", "parked", "gone")) == len(fleet.cars)
        assert [parked_in(fleet, slot) for slot in range(lot.n_slots)] == counts.tolist()
        assert (counts <= lot.capacity).all()
        assert (fleet.taken() == (counts == lot.capacity)).all()
        full += counts[-2] == 6
    assert 0 < full < 119
    assert fleet.cars["failed_parks"].sum() > 0
    assert (np.sort(fleet.cars["state"]) > SEARCHING).all()


def test_cars_may_stand_there_when_the_world_begins():
    scenario = make_scenario(town(zone_rules={}))
    fleet = run(scenario, Demand(ListedArrivals((60.0,)), ConstantTime(600.0), parked=30))
    cars = fleet.cars
    assert np.count_nonzero(cars["parked_at"] >= 0) == 30
    np.testing.assert_array_equal(cars["slot"][:30], cars["parked_at"][:30])
    assert (cars["total_s"][:30] == 0.0).all()
    counts = fleet.counts()
    assert counts[10] > 0
    assert counts.sum() == fleet.totals["parked"]
    fleet.run(until=fleet.begin + 601.0)
    np.testing.assert_allclose(cars["left_at"][:30], fleet.begin + cars["stay_s"][:30])
    assert fleet.counts().sum() == 1


FORBIDDEN = {"inner": Zone("inner", Price(1.0)), "permit": Zone("permit", users=("permit-a",))}


@pytest.mark.parametrize(
    "agent", ["first-free", "greedy-drive", "greedy-total", "greedy-goal", "mdp", "belief"]
)
def test_nobody_parks_where_the_driver_may_not(agent):
    """In fleets with compiled policies and agents in Python, and in single searches."""
    scenario = make_scenario(town(zone_rules=FORBIDDEN))
    demand = Demand(
        PoissonArrivals(60.0, 8 * 3600.0, 10 * 3600.0), ExponentialTime(900.0), ConstantTime(600.0)
    )
    policy, own = policy_of(AgentSpec(name=agent), scenario)
    fleet = Fleet(scenario, demand, background="none", drivers=[DriverKind(policy=policy)])
    driven(fleet, 1, agents=[own])
    zones = np.array(scenario.lot.zones)[scenario.lot.zone_of_slot[fleet.cars["slot"]]]
    parked = fleet.cars["slot"] >= 0
    assert parked.sum() > 20
    assert "permit" not in zones[parked]
    assert np.isfinite(fleet.cars["total_s"]).all()
    env = gym.make("parkenv/Search-v2", scenario=scenario)
    driver = make_agent(agent, scenario)
    for seed in range(5):
        result = simulate(env, driver, seed)
        assert not result.info["parked"] or scenario.lot.slot_zone[env.unwrapped.state.vertex] != "permit"


def parks_at(env, slot):
    while (vertex := env.unwrapped.state.vertex) != slot:
        env.step(way_to(env.unwrapped.scenario.lot, vertex, slot))
    return env.step(PARK)


def test_forbidden_slots_are_as_good_as_taken():
    scenario = make_scenario(town(zone_rules=FORBIDDEN))
    env = gym.make("parkenv/Search-v2", scenario=scenario)
    observation, _ = env.reset(seed=0)
    forbidden = scenario.lot.slot_zone == "permit"
    assert (observation["p_occupied"][forbidden] == 1.0).all()
    assert (observation["p_occupied"][~forbidden] < 1.0).all()
    assert scenario.action_masks[:10, PARK].tolist() == (~forbidden[:10]).tolist()
    assert np.isinf(scenario.arrival_cost_s[forbidden]).all()
    # An attempt there is no attempt: the car waits.
    _, reward, terminated, _, info = parks_at(env, 0)
    assert (terminated, reward, info["failed_parks"]) == (False, -scenario.wait_s, 0)
    allowed = gym.make("parkenv/Search-v2", scenario=scenario.replace(classes=("permit-a",)))
    assert (allowed.reset(seed=0)[0]["p_occupied"] < 1.0).all()


def test_a_single_search_takes_as_long_inside_as_agents_expect():
    scenario = garage_alone(gate_s=20.0, inside_s=(30.0, 80.0))
    # A week in which nobody else comes.
    scenario = scenario.replace(walk_back=True, occupancy=typical_occupancy(scenario.lot, demand=-40.0))
    env = gym.make("parkenv/Search-v2", scenario=scenario)
    env.reset(seed=1)
    _, reward, terminated, _, info = parks_at(env, 0)
    assert terminated
    assert info["parked"]
    assert -reward == pytest.approx(scenario.arrival_cost_s[0])
    assert info["reward_drive"] == -75.0


def test_a_typical_week_fills_a_facility_as_often_as_all_of_its_spaces():
    """In the fullest hour, and with the rates of the first car that leaves."""
    lot = town(zone_rules={})
    week, spaces = make_scenario(lot).occupancy, typical_occupancy(lot)
    hour = Arrival((24.0 + 11.5) * 3600.0)
    p, each = week.forecast(hour), spaces.forecast(hour)
    np.testing.assert_array_equal(p.p_occupied[:10], each.p_occupied[:10])
    assert p.p_occupied[10] == pytest.approx(each.p_occupied[10] ** 40, rel=0.25)
    assert week.departure_factor[10] == 40.0 * spaces.departure_factor[10]


def test_the_walk_back_counts_for_those_who_mind_it():
    scenario = make_scenario(town(zone_rules={}))
    fleets = [
        run(scenario, Demand(ListedArrivals((0.0, 60.0)), ConstantTime(600.0), walks_back=back))
        for back in (False, True)
    ]
    there, back = (fleet.cars for fleet in fleets)
    assert there["slot"].tolist() == back["slot"].tolist()
    np.testing.assert_allclose(back["walk_s"], 2.0 * there["walk_s"])
    np.testing.assert_allclose(back["walked_m"], 2.0 * there["walked_m"])


@pytest.mark.parametrize("capacity", [20, 300])
@pytest.mark.parametrize("age", [0.01, 0.1, 1.0])
def test_a_count_tells_how_full_it_will_be(capacity, age):
    """Against the exact law of M/M/∞: those that stay are binomial, those that come Poisson."""
    for load in (0.9, 1.0):
        mean, stay = load * capacity, np.exp(-age)
        long_run = float(poisson.sf(capacity - 1, mean))
        for count in (capacity // 2, capacity - 2, capacity):
            left = binom.pmf(np.arange(count + 1), count, stay)
            exact = left @ poisson.sf(capacity - 1 - np.arange(count + 1), mean * (1.0 - stay))
            assert p_full(long_run, count, capacity, age) == pytest.approx(exact, abs=0.06)
        assert p_full(long_run, capacity - 1, capacity, 0.0) == 0.0
        assert p_full(long_run, capacity, capacity, 0.0) == 1.0
        assert p_full(long_run, 0, capacity, 50.0) == pytest.approx(long_run, abs=1e-6)


def test_a_batch_knows_what_a_single_search_knows():
    garage = replace(GARAGE, known="live", capacity=3)
    scenario = make_scenario(town(facilities=(garage, town().facilities[1]), zone_rules=FORBIDDEN))
    env = gym.make("parkenv/Search-v2", scenario=scenario)
    batch = gym.make_vec("parkenv/Search-v2", num_envs=2, scenario=scenario)
    one, _ = env.reset(seed=3)
    seen, _ = batch.reset(seed=[3, 4])
    for action in np.random.default_rng(0).integers(0, 4, 8):
        for name, value in one.items():
            np.testing.assert_array_equal(np.ravel(seen[name][0]), np.ravel(value), err_msg=name)
        one, *_ = env.step(action)
        seen, *_ = batch.step(np.full(2, action))


def first_belief(known, count, delay_s=0.0):
    garage = replace(GARAGE, zone="", capacity=5, known=known, delay_s=delay_s, gate_s=0.0)
    scenario = make_scenario(town(facilities=(garage,), slot_facility=(), zone_rules={}))
    times = (*(1e-3 * i for i in range(count)), 100.0)
    fleet = Fleet(scenario, Demand(ListedArrivals(times), ConstantTime(36000.0)), background="none")
    fleet.reset()
    while (car := fleet.next_decision()) != count:
        slot = scenario.lot.n_slots - 1
        vertex = int(fleet.observation(car)["vertex"])
        fleet.act(PARK if vertex == slot else way_to(scenario.lot, vertex, slot))
    observation = fleet.observation(car)
    return float(observation["p_occupied"][-1]), float(observation["belief"].reshape(4, -1)[0, -1])


def way_to(lot, vertex, target):
    from scipy.sparse.csgraph import dijkstra

    metres = dijkstra(lot.drive_matrix().T.tocsr(), indices=target)
    moves = [a for a in range(4) if lot.neighbors[vertex, a] >= 0]
    return min(moves, key=lambda a: lot.edge_length[vertex, a] + metres[lot.neighbors[vertex, a]])


def test_a_live_count_is_known_everywhere():
    for known in ("nothing", "sign"):
        p, forecast = first_belief(known, 5)
        assert p == forecast
    nearly, forecast = first_belief("live", 3)
    full, _ = first_belief("live", 5)
    assert nearly < forecast < full
    assert full < 1.0
    # It is published every hour: what has happened since is not known.
    assert first_belief("live", 5, delay_s=3600.0)[0] < 0.1
