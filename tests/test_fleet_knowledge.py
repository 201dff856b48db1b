"""What cars of a fleet know: the live map, reservations, everything; and mixed fleets."""

import math
from itertools import permutations

import numpy as np
import pytest
from small_lots import driven

import parkenv
from parkenv import SensorModel, make_scenario
from parkenv.belief.slot_belief import SlotBelief
from parkenv.engine.fleet import DriverKind, Fleet
from parkenv.world.demand import (
    ConstantTime,
    Demand,
    ExponentialTime,
    Headways,
    ListedArrivals,
    PoissonArrivals,
)
from parkenv.world.scenario import drive_times
from planners import make_agent
from planners.heuristics import POLICIES

TWO = Demand(ListedArrivals((36000.0, 36060.0)))


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
    kinds = [DriverKind(policy=POLICIES["greedy-drive"], knows=knows)]
    searched = {}
    for leave in (True, False):
        fleet = driven(Fleet("mini", demand, background="none", drivers=kinds, leave_full_lot=leave), 0)
        names, n = np.array(fleet.state_names()), fleet.scenario.lot.n_slots
        without = names == ("gave_up" if leave else "balked")
        assert ((names == "parked").sum(), without.sum()) == (n, 25 - n)
        searched[leave] = (fleet.cars["ended_at"] - fleet.cars["arrival"])[without].mean()
    assert searched[True] < 300.0 <= searched[False]


def test_drive_times_are_those_of_the_routes_of_agents():
    from planners.routes import DriveRoutes

    scenario = parkenv.make_scenario("campus")
    expected = DriveRoutes(scenario).seconds_from(100)[: scenario.lot.n_slots]
    np.testing.assert_allclose(drive_times(scenario, 100), expected)
