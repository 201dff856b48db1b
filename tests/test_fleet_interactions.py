"""How cars of a fleet get in each other's way: queues, lights of cars that leave, held slots, what cars see."""

import numpy as np
import pytest
from small_lots import driven

from parkenv import OccupancyProcess, Scenario, SensorModel
from parkenv.engine.fleet import DriverKind, Fleet
from parkenv.engine.records import SEARCHING
from parkenv.lots import grid_lot
from parkenv.world.cues import Cues
from parkenv.world.demand import ConstantTime, Demand, Headways, ListedArrivals
from parkenv.world.lot import PARK
from planners.heuristics import POLICIES
from planners.routes import DriveRoutes

LOT = grid_lot(1, 8)
SCENARIO = Scenario(
    lot=LOT,
    name="row",
    occupancy=OccupancyProcess.from_demand(np.zeros(8), np.zeros(168)),
    v_drive=2.5,
    failure_s=10.0,
    sensor_model=SensorModel(view_range=6.0),
)
ROUTES = DriveRoutes(SCENARIO)


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


def test_a_car_that_parks_blocks_those_behind_it():
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


def test_queues_grow_backwards_and_dissolve():
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
    slot = int(by_distance()[2])
    states = {}
    for cues in (None, Cues(lead_s=1e6, moving_s=0.0)):
        # The first leaves while the second stands in a failed attempt; the third comes by in between.
        demand = Demand(ListedArrivals((36000.0, 36040.0, 36049.0)), ConstantTime(46.0))
        fleet = Fleet(SCENARIO.replace(cues=cues), demand, background="none")
        drive(fleet, [slot] * 3)
        states[cues is None] = np.argsort(fleet.cars["ended_at"]).tolist()
        assert (fleet.slots["held_by"] == -1).all()
    assert states[True] == [0, 2, 1]
    assert states[False] == [0, 1, 2]


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
