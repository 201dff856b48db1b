"""Cars of a fleet: how they get in each other's way, and what they know: live map, reservations, everything."""

import math
from itertools import permutations

import numpy as np
import pytest
from small_lots import driven

from parkenv import OccupancyProcess, Scenario, SensorModel, make_scenario
from parkenv.belief.slot_belief import SlotBelief
from parkenv.engine.fleet import DriverKind, Fleet
from parkenv.engine.records import SEARCHING
from parkenv.lots import grid_lot
from parkenv.world.cues import Cues
from parkenv.world.demand import (
    ConstantTime,
    Demand,
    ExponentialTime,
    Headways,
    ListedArrivals,
    PoissonArrivals,
)
from parkenv.world.lot import PARK
from planners import make_agent
from planners.heuristics import POLICIES
from planners.routes import DriveRoutes

LOT = grid_lot(1, 8)
STEADY = OccupancyProcess.from_demand(np.zeros(8), np.zeros(168))
SCENARIO = Scenario(
    lot=LOT,
    name="row",
    occupancy=STEADY,
    v_drive=2.5,
    failure_s=10.0,
    sensor_model=SensorModel(view_range=6.0),
)
ROUTES = DriveRoutes(SCENARIO)
TWO = Demand(ListedArrivals((36000.0, 36060.0)))


def toward(slot, vertex):
    return PARK if vertex == slot else ROUTES.move_toward(vertex, int(slot))


def drive(fleet, slots):
    seen = {}
    fleet.reset(0)
    while (car := fleet.next_decision()) is not None:
        observation = fleet.observation(car)
        seen.setdefault(car, []).append(observation)
        fleet.act(toward(slots[car], int(observation["vertex"])))
    return seen


def by_distance():
    return np.argsort(ROUTES.seconds_from(int(LOT.entry_vertices[0]))[:8])


def arriving(*times, stay_s=1e5):
    return Demand(ListedArrivals(tuple(36000.0 + t for t in times)), ConstantTime(stay_s))


def test_cars_that_park_or_leave_block_those_behind_them_and_queues_dissolve():
    near, far = by_distance()[[0, -1]]
    ends = {}
    for manoeuvre_s in (0.0, 30.0):
        fleet = Fleet(SCENARIO, arriving(0.0, 0.5), background="none", manoeuvre_s=manoeuvre_s)
        drive(fleet, [near, far])
        ends[manoeuvre_s] = fleet.cars["ended_at"] - fleet.cars["arrival"]
        assert fleet.cars["queued_s"][0] == 0.0
        waited = fleet.cars["queued_s"][1]
    assert ends[0.0][0] == ends[30.0][0]
    assert ends[30.0][1] - ends[0.0][1] == pytest.approx(waited)
    # It reaches the blocked vertex half a second after the manoeuvre has begun.
    assert waited == pytest.approx(29.5)
    fleet = Fleet(SCENARIO, arriving(0.0, 1.5, 3.0, 4.5), background="none", manoeuvre_s=60.0)
    drive(fleet, by_distance()[[3, -1, -2, -3]])
    queued = fleet.cars["queued_s"]
    assert queued[0] == 0.0
    assert (np.diff(queued[1:]) < 0).all()
    assert queued[3] > 45.0
    assert fleet.state_names() == ["parked"] * 4
    # A car that leaves blocks the lane, too.
    fleet = Fleet(SCENARIO, arriving(0.0, 60.0, stay_s=58.0), background="none", manoeuvre_s=20.0)
    drive(fleet, by_distance()[[0, -1]])
    assert fleet.cars["left_at"][0] < fleet.cars["ended_at"][1]
    assert fleet.cars["queued_s"][1] > 0.0


def test_the_car_that_waits_for_one_that_leaves_has_the_slot():
    slot, states = int(by_distance()[2]), {}
    for cues in (None, Cues(lead_s=1e6, moving_s=0.0)):
        # The first leaves while the second stands in a failed attempt; the third comes by in between.
        demand = Demand(ListedArrivals((36000.0, 36040.0, 36049.0)), ConstantTime(46.0))
        fleet = Fleet(SCENARIO.replace(cues=cues), demand, background="none")
        drive(fleet, [slot] * 3)
        states[cues is None] = np.argsort(fleet.cars["ended_at"]).tolist()
        assert (fleet.slots["held_by"] == -1).all()
    assert (states[True], states[False]) == ([0, 2, 1], [0, 1, 2])


def test_cars_see_others_in_view_and_where_one_stands():
    slot = int(by_distance()[4])
    fleet = Fleet(SCENARIO, arriving(0.0, 2.0, 4.0), background="none", sees_cars=True)
    seen = drive(fleet, [slot] * 3)
    counts = np.array([observation["cars"].sum(axis=1) for observation in seen[2]])
    assert counts.max() <= 2
    assert (counts[:, 0] > 0).any()
    assert (counts[:, 1] <= counts[:, 0]).all()
    # The second fails at the slot, and stands there.
    assert any(observation["cars"][1, slot] == 1 for observation in seen[2])


@pytest.mark.parametrize("tick_s", [1.0, 0.3])
def test_queues_keep_to_ticks(tick_s):
    demand = Demand(Headways(30, 3.0))
    kinds = [DriverKind(policy=POLICIES["greedy-drive"])]
    fleet = driven(Fleet("mini", demand, drivers=kinds, tick_s=tick_s, manoeuvre_s=7.7, background="none"), 0)
    ticks = (fleet.cars["ended_at"] - fleet.begin) / tick_s
    np.testing.assert_allclose(ticks, np.round(ticks), atol=1e-6)
    assert (fleet.cars["queued_s"] > 0).any()


def test_a_car_in_a_queue_stands_still_in_pictures():
    near, far = by_distance()[[0, -1]]
    fleet = Fleet(SCENARIO, arriving(0.0, 0.5), background="none", manoeuvre_s=30.0)
    fleet.reset(0)
    at = {}
    for second in np.arange(0.0, 40.0, 0.5):
        while (car := fleet.next_decision(fleet.begin + second)) is not None:
            fleet.act(toward((near, far)[car], int(fleet.observation(car)["vertex"])))
        if 1 in (searching := np.flatnonzero(fleet.cars["state"] == SEARCHING)):
            at[second] = fleet.poses()[0][list(searching).index(1)]
    hops = np.hypot(*np.diff(np.array(list(at.values())), axis=0).T)
    assert hops.max() <= 0.55 * SCENARIO.v_drive, "it does not jump back"
    assert (hops == 0.0).sum() >= 55, "it waits for half a minute"


def second_arrives(fleet, seed=0):
    fleet.reset(seed)
    viewed = set()
    while (car := fleet.next_decision()) != 1:
        observation = fleet.observation(car)
        vertex = int(observation["vertex"])
        if observation["time"][1] > 0:
            viewed |= set(fleet.scenario.in_view(vertex))
        moves = np.flatnonzero(observation["action_mask"][:4])
        fleet.act(moves[0] if len(viewed) % 2 else moves[-1])
    return viewed, fleet.observation(1)["belief"].reshape(4, -1)


@pytest.mark.parametrize(
    ("knows", "shares", "delay_s"),
    [("shared", True, 0.0), ("own", True, 0.0), ("shared", False, 0.0), ("shared", True, 1e5)],
)
def test_the_live_map_holds_what_sharing_cars_have_observed(knows, shares, delay_s):
    fleet = Fleet("campus", TWO, drivers=[DriverKind(knows=knows, shares=shares)], delay_s=delay_s)
    viewed, (forecast, _, p_observed, observed_at) = second_arrives(fleet)
    known = set(np.flatnonzero(observed_at >= 0.0))
    assert viewed
    assert known == (viewed if knows == "shared" and shares and delay_s == 0.0 else set())
    taken = fleet.taken()
    for slot in known:
        # A minute old at most: nearly certain.
        assert abs(p_observed[slot] - taken[slot]) < 0.1 or forecast[slot] == p_observed[slot]


def test_reports_arrive_after_their_delay():
    known = {}
    for delay_s in (0.0, 30.0, 45.0, 60.0):
        fleet = Fleet("campus", TWO, drivers=[DriverKind(knows="shared", shares=True)], delay_s=delay_s)
        _, parts = second_arrives(fleet)
        known[delay_s] = set(np.flatnonzero(parts[3] >= 0.0))
    assert known[0.0] > known[30.0] > known[45.0] >= known[60.0]


def test_what_a_car_is_told_at_its_arrival_counts_as_an_observation_then():
    """Bayes' rule with the error rates of the old reports gives the belief that the car begins with."""
    sensor = SensorModel(hit_rate=0.9, false_alarm_rate=0.2)
    for scenario in (make_scenario("campus"), make_scenario("campus", sensor_model=sensor)):
        fleet = Fleet(scenario, TWO, drivers=[DriverKind(knows="shared", shares=True)])
        viewed, _ = second_arrives(fleet)
        belief = SlotBelief.of_observation(fleet.observation(1))
        told = belief.observations
        assert 0 < len(told.slots) <= len(viewed)
        assert (told.time == 0.0).all()
        again = SlotBelief.of_forecast(belief.forecast, belief.decay_rate).update(told.slots, *told[2:])
        if scenario.sensor_model.perfect:
            np.testing.assert_allclose(again.p_occupied, belief.p_occupied, atol=1e-5)
        else:
            same = (again.p_occupied > belief.forecast) == (belief.p_occupied > belief.forecast)
            assert same[told.slots].mean() > 0.9


def test_full_knowledge_is_the_truth_at_every_decision():
    fleet = Fleet("campus", Demand(Headways(8, 5.0), ConstantTime(60.0)), drivers=[DriverKind(knows="full")])
    fleet.reset(1)
    rng = np.random.default_rng(0)
    while (car := fleet.next_decision()) is not None:
        observation = fleet.observation(car)
        np.testing.assert_array_equal(observation["p_occupied"] == 1.0, fleet.taken())
        fleet.act(rng.choice(np.flatnonzero(observation["action_mask"])))


def test_reservations_are_exclusive_and_cost_the_least_in_total():
    fleet = Fleet("mini", Demand(Headways(3, 1.0)), background="none", drivers=[DriverKind(knows="reserve")])
    agent, memory, together = make_agent("greedy-drive", fleet.scenario), {}, 0
    fleet.reset(0)
    while (car := fleet.next_decision()) is not None:
        cars = np.flatnonzero(fleet.cars["state"] == 1)
        each = np.array([fleet.observation(int(one))["reserved"] for one in cars])
        assert (each.sum(axis=1) == 1).all()
        assert each.sum(axis=0).max() == 1
        reserved, observation = each.argmax(axis=1), fleet.observation(car)
        assert fleet.observation_space.contains(observation)
        assert (observation["belief"].reshape(4, -1)[1] > 0.0).all(), "the belief is the car's own"
        if len(cars) > 1:
            together += 1
            cost = np.array([fleet.time_to_slots(int(one)) for one in cars])
            cost[:, fleet.taken()] = np.inf
            least = min(
                sum(cost[i, slot] for i, slot in enumerate(slots))
                for slots in permutations(range(fleet.scenario.lot.n_slots), len(cars))
            )
            assert cost[np.arange(len(cars)), reserved].sum() == pytest.approx(least)
        action, memory[car] = agent.predict(observation, memory.get(car))
        fleet.act(action)
    assert together > 3
    assert (fleet.cars["failed_parks"] == 0).all()


@pytest.mark.parametrize("name", ["belief", "mdp", "first-free"])
def test_every_agent_drives_to_its_reserved_slot(name):
    fleet = Fleet("campus", Demand(Headways(6, 20.0)), drivers=[DriverKind(knows="reserve")])
    driven(fleet, 3, agents=[make_agent(name, fleet.scenario)])
    assert set(fleet.state_names()) <= {"parked", "left"}
    assert (fleet.cars["failed_parks"] == 0).all()


def means(knows, demand, **options):
    kinds = [DriverKind(policy=POLICIES["first-free"], knows=knows, shares=True)]
    fleet = Fleet("campus", demand, drivers=kinds, leave_full_lot=False, **options)
    return np.mean([driven(fleet, seed).cars["total_s"].mean() for seed in range(10)])


@pytest.mark.slow
def test_knowing_more_helps_and_guidance_helps_most():
    demand = Demand(PoissonArrivals(120.0, 32400.0, 36000.0), ExponentialTime(3600.0), ConstantTime(900.0))
    shared, full, reserve = (means(knows, demand) for knows in ("shared", "full", "reserve"))
    assert means("own", demand) > means("shared", demand, delay_s=120.0) > shared > full > reserve


@pytest.mark.parametrize("knows", ["own", "full", "reserve"])
def test_a_full_lot_is_left_at_once_or_searched_until_patience_ends(knows):
    demand = Demand(Headways(25, 1.0), ConstantTime(math.inf), ConstantTime(300.0))
    kinds, searched = [DriverKind(policy=POLICIES["greedy-drive"], knows=knows)], {}
    for leave in (True, False):
        fleet = driven(Fleet("mini", demand, background="none", drivers=kinds, leave_full_lot=leave), 0)
        names, n = np.array(fleet.state_names()), fleet.scenario.lot.n_slots
        without = names == ("gave_up" if leave else "balked")
        assert ((names == "parked").sum(), without.sum()) == (n, 25 - n)
        searched[leave] = (fleet.cars["ended_at"] - fleet.cars["arrival"])[without].mean()
    assert searched[True] < 300.0 <= searched[False]
