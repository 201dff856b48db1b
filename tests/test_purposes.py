"""Drivers with several purposes: their cars, their tables in scenario files, and demand that follows counts."""

import dataclasses
import math

import numpy as np
import pytest
from car_park_counts import CURVE, write_counts
from command_line import ran, summary_of
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.testing import assert_allclose, assert_array_equal
from small_lots import driven

from parkenv import ArrivalWindow, OccupancyLog, RecordedOccupancy, make_scenario
from parkenv.compiled.keyed_random import world_key
from parkenv.engine.fleet import DriverKind, Fleet
from parkenv.errors import InputError
from parkenv.lots import write_lot
from parkenv.scenarios.spec import ScenarioSpec
from parkenv.studies.fields import AgentSpec
from parkenv.studies.fleet.drivers import demand_in, record_days
from parkenv.studies.fleet.setting import rate_of
from parkenv.world.arrivals import Headways, NoArrivals, PoissonArrivals, follow_counts
from parkenv.world.demand import (
    ConstantTime,
    Demand,
    ExponentialTime,
    FollowingArrivals,
    LogNormalTime,
    TownDemand,
)
from parkenv.world.durations import rest_of_stay
from parkenv.world.facility import Facility
from parkenv.world.occupancy.counted import process_of_curve
from parkenv.world.occupancy.day_error import DayError
from parkenv.world.occupancy.process import Arrival, ArrivalDay, OccupancyModel, OccupancyProcess
from parkenv.world.scenario import drive_times
from parkenv.world.tariff import Price, Zone
from planners.heuristics.policies import POLICIES

DAY = ArrivalDay(0)
WINDOW = 7 * 3600.0, 20 * 3600.0
COMMUTERS = Demand(
    PoissonArrivals(60.0, *WINDOW), LogNormalTime(8 * 3600.0, 0.3), name="commuters", value_of_time=18.0,
    classes={"permit-a": 0.25, "charging": 0.5}, kwh=20.0,
)  # fmt: skip
RESIDENTS = Demand(
    NoArrivals(WINDOW[0]), ExponentialTime(7200.0), name="residents", classes={"permit-a": 1.0},
    walks_back=True, parked=400,
)  # fmt: skip
TUESDAY = ArrivalDay(1)
MORNING = ArrivalWindow((1,), 7 * 3600.0, 14.5 * 3600.0)
TIMES = 86400.0 + np.arange(7 * 3600.0 + 300.0, 14.5 * 3600.0 + 1.0, 300.0)


def drawn(demand, episode=0):
    return demand.draw(world_key(1, episode), WINDOW[0], 2, DAY)


def test_purposes_keep_their_cars_whoever_else_comes():
    alone = Demand(Headways(30), ExponentialTime(900.0), goal_weights=(1.0, 3.0))
    for ours, its in zip(drawn(TownDemand((alone,))), drawn(alone), strict=True):
        assert_array_equal(ours, its)
    town, alone = drawn(TownDemand((RESIDENTS, COMMUTERS))), drawn(COMMUTERS)
    its = town.purpose == 1
    assert_array_equal(town.arrival_s[its], alone.arrival_s)
    assert_array_equal(town.stay_s[its], alone.stay_s)
    assert np.all(np.diff(town.arrival_s) >= 0.0)
    # Bits are those of the town's classes: permit-a of both purposes, charging of one.
    assert set(town.classes[~its]) == {1}
    assert np.mean(town.classes[its] & 1 > 0) == pytest.approx(0.25, abs=0.05)
    charges = town.classes & 2 > 0
    assert_array_equal(town.kwh, np.where(charges, 20.0, 0.0))
    assert np.isnan(town.value_of_time[~its]).all()
    assert (town.value_of_time[its] == 18.0).all()
    assert_array_equal(town.walks_back, ~its)
    with_parked = drawn(Demand(COMMUTERS.arrivals, COMMUTERS.stay, name="commuters", parked=7))
    assert with_parked.parked.tolist() == [True] * 7 + [False] * (len(with_parked.parked) - 7)
    assert (with_parked.arrival_s[:7] == WINDOW[0]).all()
    assert_array_equal(with_parked.stay_s[7:], drawn(COMMUTERS).stay_s)


@pytest.mark.parametrize("law", [ExponentialTime(3600.0), LogNormalTime(3600.0, 0.5), ConstantTime(3600.0)])
def test_the_rest_of_a_stay_has_the_mean_of_renewal_theory(law):
    """E(S²) / 2 E(S); of stays that stand for their law, which cut the tail off."""
    stays = law.quantile((np.arange(400) + 0.5) / 400)
    rest = rest_of_stay(law, (np.arange(100_000) + 0.5) / 100_000)
    assert rest.mean() == pytest.approx((stays**2).mean() / stays.mean() / 2.0, rel=1e-3)
    assert rest.min() >= 0.0
    assert rest.max() <= stays.max()
    assert np.isinf(rest_of_stay(ConstantTime(math.inf), np.array([0.5]))).all()


@settings(max_examples=15)
@given(st.lists(st.floats(0.1, 300.0), min_size=13, max_size=13), st.sampled_from([1.0, 3.0]))
def test_counts_that_a_demand_made_are_followed(rates, hours):
    cars = expected((*[0.0] * 7, *rates, *[0.0] * 4), LogNormalTime(hours * 3600.0, 1.0))
    found = follow_counts(0.0, cars, *WINDOW, (hours,))
    assert_allclose(found.expected, cars, atol=1e-6 * (1.0 + cars.max()))
    assert (found.per_hour >= 0.0).all()


def expected(per_hour, stay):
    """Cars at full hours from 8:00, if they stay by that law; by summing over minutes."""
    stays = stay.quantile((np.arange(400) + 0.5) / 400)
    minutes = np.arange(WINDOW[0], WINDOW[1], 60.0) + 30.0
    rate = np.array(per_hour)[(minutes // 3600.0).astype(int)] / 60.0
    ends = WINDOW[0] + 3600.0 * np.arange(1, 14)
    there = (stays > (ends[:, None] - minutes)[..., None]).mean(axis=2) * (minutes < ends[:, None])
    return (there * rate).sum(axis=1)


def test_the_longest_stay_that_follows_is_taken():
    falls = np.array([100.0] * 6 + [100.0 * 0.5**k for k in range(7)])  # halves in an hour
    steady = np.full(13, 100.0)
    short_s, long_s = (follow_counts(100.0, cars, *WINDOW).stay.mean_s for cars in (falls, steady))
    assert short_s < long_s == 24 * 3600.0
    with_gap = np.where(np.arange(13) == 4, np.nan, steady)
    assert_allclose(follow_counts(100.0, with_gap, *WINDOW).expected, 100.0, rtol=0.05)


TABLES = {
    "lot": "mini",
    "arrivals": {"hours": "08:00-10:00"},
    "demand": {
        "shoppers": {"arrivals_per_hour": 30, "stay_s": 1800, "value_of_time": 8, "walks_back": True},
        "staff": {
            "arrivals_per_hour": [0] * 8 + [6] + [0] * 15, "stay_s": 28800, "stay_law": "log-normal",
            "stay_cv": 0.2, "parked": 2, "goals": [1.0],
        },
    },
}  # fmt: skip


def test_a_scenario_file_has_purposes():
    demand = make_scenario(ScenarioSpec.parse(TABLES, "town.toml")).demand
    assert [one.name for one in demand.purposes] == ["shoppers", "staff"]
    assert (demand.expected, demand.scaled(2.0).expected) == (66.0, 132.0)
    shoppers, staff = demand.purposes
    assert staff.stay == LogNormalTime(28800.0, 0.2)
    assert staff.parked == 2
    assert shoppers.walks_back
    assert shoppers.goal_weights == staff.goal_weights == (1.0,)  # without weights to all goals alike
    assert shoppers.entry_weights == ()
    assert make_scenario("mini").demand is None


def test_drivers_pay_by_their_own_time_and_park_by_their_classes():
    lot = make_scenario("mini").lot
    zones = np.where(np.arange(10) < 5, "kerb", "residents")
    rules = {"kerb": Zone("kerb", Price(3.0)), "residents": Zone("residents", users=("permit-a",))}
    its = make_scenario(dataclasses.replace(lot, slot_zone=zones, zone_rules=rules))
    of = [
        Demand(Headways(5), ConstantTime(3600.0), name="rich", value_of_time=36.0),
        Demand(Headways(5), ConstantTime(3600.0), name="residents", classes={"permit-a": 1.0}),
    ]
    fleet = Fleet(its, TownDemand(of))
    fleet.reset(3)
    costs = fleet.drawn.zone_costs()  # of kerb and residents
    rich = np.isinf(costs[:, 1])
    assert rich.sum() == 5
    assert_array_equal(costs[rich, 0], 300.0)
    assert_array_equal(costs[~rich], [[900.0, 0.0]] * 5)
    for car in range(10):
        alone = its.walk_s + its.parking_cost_of(fleet.drawn.drivers_of(car)) + its.enter_s
        assert_array_equal(fleet.drawn.arrival_cost_s(car), alone)
    with pytest.raises(InputError, match="permit-b"):
        Fleet(its, Demand(Headways(2), classes={"permit-b": 1.0})).reset()


@pytest.mark.slow
def test_cars_of_the_town_stand_where_they_may_when_its_day_begins():
    town = make_scenario("town")
    fleet = Fleet(town, town.demand, drivers=[DriverKind(policy=POLICIES["usual"])])
    fleet.reset(1)
    cars = fleet.cars[fleet.cars["parked_at"] >= 0]
    assert len(cars) == sum(one.parked for one in town.demand.purposes)
    assert_array_equal(np.bincount(cars["parked_at"], minlength=town.lot.n_slots), fleet.counts())
    assert (fleet.counts() <= town.lot.capacity).all()
    of_car = fleet.drawn.zone_costs()[fleet.cars["parked_at"] >= 0, town.lot.zone_of_slot[cars["parked_at"]]]
    assert np.isfinite(of_car).all()


@pytest.mark.slow
def test_in_a_town_the_way_to_the_goal_takes_no_patience():
    town = make_scenario("town")
    goals = tuple(np.ones(len(town.lot.goals)))
    demand = Demand(Headways(60, 20.0), patience=ConstantTime(1.0), goal_weights=goals)
    fleet = Fleet(town, demand, background="none", drivers=[DriverKind(policy=POLICIES["greedy-goal"])])
    driven(fleet, 1)
    for car in fleet.cars:
        problem = fleet.scenarios[car["scenario_index"]]
        way_s = drive_times(problem, int(car["entry"]))[problem.walk_s.argmin()]
        assert car["patience_s"] == pytest.approx(1.0 + way_s)
        assert car["slot"] >= 0 or car["ended_at"] - car["arrival"] >= car["patience_s"]
    assert np.mean(fleet.cars["slot"] >= 0) > 0.2  # those whose goal has a free space beside it


def test_recorded_days_are_the_world_of_single_searches(tmp_path):
    mini = make_scenario("mini").lot
    lot = dataclasses.replace(mini, slot_ids=tuple(f"{name}, left" for name in mini.slot_ids))
    write_lot(lot, tmp_path / "mini.geojson")
    spec = ScenarioSpec.parse(TABLES | {"lot": str(tmp_path / "mini.geojson")}, "town.toml")
    log = tmp_path / "days.csv.gz"
    how = {"agent": AgentSpec(name="usual"), "days": 2, "rounds": 1, "seed": 0}
    record_days(spec, log, **how | {"rounds": 2})
    searched = make_scenario(spec.changed(occupancy={"log": str(log), "mapping": "same"}))
    earlier = make_scenario(spec.changed(occupancy="typical"))
    assert searched.occupancy.recorded
    usual = DriverKind(policy=POLICIES["usual"])
    fleet = Fleet(earlier, earlier.demand, drivers=[usual], leave_full_lot=False)
    record_days(spec, log, **how)
    searched = make_scenario(spec.changed(occupancy={"log": str(log), "mapping": "same"}))
    fleet.reset(0, 0)
    day = searched.occupancy.arrival_days(searched.arrival)[0]
    for time in (1800.0, 5400.0):
        fleet.run(until=fleet.begin + time)
        arrival = Arrival(day.weekday * 86400.0 + 8 * 3600.0 + time, day.date)
        taken = searched.occupancy.world(world_key(0, 0), arrival).occupied(np.arange(10), arrival.time)
        assert np.count_nonzero(taken != fleet.taken()) <= 1  # times are whole seconds
    with pytest.raises(InputError, match="has no demand"):
        record_days(ScenarioSpec.parse({"lot": "mini"}, "x"), log, **how)


def test_cars_of_a_town_choose_entries_and_goals_by_its_weights():
    scenario = make_scenario("town")
    demand = demand_in(scenario.replace(demand=None), 100.0, 3600.0, 600.0)
    for name in ("goal_weights", "entry_weights"):
        assert np.allclose(getattr(demand, name), sum(getattr(scenario.lot, name).values()))


def test_a_parked_car_passes_no_garage_that_has_room():
    """Each drawn slot was taken with a chance of 0.8 when a car came, a garage only when it was full."""
    mini = make_scenario("mini")
    at = mini.lot.goals[0]
    lot = dataclasses.replace(mini.lot, facilities=(Facility("P", "garage", capacity=40, xy=tuple(at)),))
    its, goals = make_scenario(lot), (1.0,) * len(lot.goals)
    fleet = Fleet(its, Demand(Headways(1), ConstantTime(3600.0), parked=30, goal_weights=goals))
    fleet.reset(0)
    garage, walk_s = int(np.flatnonzero(lot.is_counted)[0]), its.at_goal(0).walk_s
    parked_at = fleet.cars["parked_at"][fleet.cars["parked_at"] >= 0]
    assert (walk_s[parked_at] <= walk_s[garage]).all()
    assert np.count_nonzero(parked_at == garage) >= 20


def steady(occupied, stay_s, n=50):
    odds = occupied / (1.0 - occupied)
    return OccupancyProcess(np.ones(n), np.full(168, odds / stay_s), np.ones(n), np.full(168, 1.0 / stay_s))


def expected_cars(rates, survives):
    arrival = np.arange(MORNING.start_s, MORNING.end_s, 60.0) + 30.0
    elapsed = (TIMES - 86400.0)[:, None] - arrival
    came = rates[(arrival // 3600).astype(int)] * 60.0 / 3600.0
    return np.where(elapsed > 0.0, survives(np.maximum(elapsed, 0.0)), 0.0) @ came


def test_a_lot_that_stays_as_full_needs_the_cars_that_leave():
    process = steady(0.6, 5400.0)
    rates = FollowingArrivals(process, MORNING, ExponentialTime(5400.0)).rates_of(TUESDAY).per_hour
    assert rates[7:15] == pytest.approx([50 * 0.6 * 3600.0 / 5400.0] * 8, rel=0.01)
    assert max(rates[:7] + rates[15:]) < 1e-6
    twice = FollowingArrivals(process, MORNING, ExponentialTime(5400.0), scale=2.0).rates_of(TUESDAY).per_hour
    assert twice == pytest.approx([2.0 * rate for rate in rates], abs=1e-6)


def test_the_course_of_a_process_is_the_mean_of_its_worlds():
    process = process_of_curve(np.linspace(-1.0, 1.0, 40), 0.5 + 0.3 * np.sin(np.arange(24.0)), 5400.0)
    process, arrival = process.with_day_error(DayError(0.7)), Arrival(TIMES[0])
    exact, mean = (kind.course(process, arrival, TIMES[::12]) for kind in (OccupancyProcess, OccupancyModel))
    assert exact.residents[0] == exact.occupied[0]
    np.testing.assert_allclose(mean, exact, atol=0.05)


@settings(max_examples=12)
@example(curve=CURVE, minutes=20.0, hour=9, change=0.0)
@example(curve=CURVE, minutes=60.0, hour=9, change=0.0)
@given(
    curve=arrays(float, 24, elements=st.floats(0.02, 0.95)),
    minutes=st.floats(10.0, 300.0),
    hour=st.integers(7, 14),
    change=st.floats(-20.0, 20.0),
)
def test_no_other_arrivals_come_closer_to_the_counts(curve, minutes, hour, change):
    process, stay_s = process_of_curve(np.zeros(80), curve, 7200.0), 60.0 * minutes
    rates = np.array(FollowingArrivals(process, MORNING, ExponentialTime(stay_s)).rates_of(TUESDAY).per_hour)
    course = process.course(Arrival(86400.0 + MORNING.start_s), TIMES)

    def apart(rates):
        cars = expected_cars(rates, lambda seconds: np.exp(-seconds / stay_s))
        return np.square(course.residents + cars / 80 - course.occupied)

    other = rates.copy()
    other[hour] = max(0.0, other[hour] + change)
    assert apart(other).sum() > apart(rates).sum() - 1e-3
    assert (rates > 0.0).all()
    # A day as of a real car park can be followed; a lot that empties at once cannot.
    if curve is CURVE:
        assert np.sqrt(apart(rates).mean()) < 0.02


def test_each_recorded_day_is_followed_for_itself():
    rng = np.random.default_rng(1)
    slot, day, step = (a.ravel() for a in np.meshgrid(range(12), range(3), range(24), indexing="ij"))
    taken = rng.random(slot.size) < 0.2 + 0.2 * day
    days = ("2024-01-01", "2024-01-08", "2024-01-15")
    log = OccupancyLog(tuple(map(str, range(12))), days, slot, day, 7 * 3600.0 + 1800.0 * step, taken)
    occupancy, window = RecordedOccupancy(log, np.arange(12.0)), ArrivalWindow((0,), 8 * 3600.0, 12 * 3600.0)
    follows = FollowingArrivals(occupancy, window, ConstantTime(1800.0))
    rates = [sum(follows.rates_of(day).per_hour) for day in occupancy.arrival_days(window)]
    assert rates == sorted(rates)
    assert rates[2] > 1.5 * rates[0]
    hours = 3600.0 * np.arange(8.0, 13.0)
    course = occupancy.course(Arrival(hours[0], days[1]), hours)
    recorded = [taken[(day == 1) & (step == 2 * hour)].mean() for hour in range(1, 6)]
    np.testing.assert_allclose(course.occupied, recorded)
    assert course.residents[0] == course.occupied[0]
    assert (np.diff(course.residents) <= 0.0).all()


def test_worlds_of_a_key_have_the_same_cars_and_more_come_if_more_are_wanted():
    scenario, times = make_scenario("mini"), []
    for times_counted in (1.0, 1.0, 3.0):
        stay = ExponentialTime(1200.0)
        arrivals = FollowingArrivals(scenario.occupancy, scenario.arrival, stay, times_counted)
        fleet = Fleet(scenario, Demand(arrivals, stay))
        fleet.reset(7, 3)
        times.append(fleet.cars["arrival"].copy())
    assert np.array_equal(times[0], times[1])
    assert len(times[2]) > 2 * len(times[0])


@pytest.mark.parametrize(
    ("given", "rate"),
    [(60, 60.0), ("60", 60.0), ("counted", "counted"), ("given", "given"), ("1x", "1x"), (" 1.20x", "1.2x")],
)
def test_a_demand_is_a_number_or_a_multiple_of_the_given_or_counted_one(given, rate):
    assert rate_of(given) == rate
    assert rate_of(str(rate)) == rate, "as read from a table"


@pytest.mark.slow
def test_the_fleet_follows_the_counts_of_a_car_park(tmp_path):
    write_counts(tmp_path / "counts.csv", change=lambda park, day, taken: 0.85 * taken)
    words = ("--scenario", "campus", "--occupancy", tmp_path / "counts.csv", "--car-park", "P0")
    words += ("--replay-from", "2024-01-20", "--hours", "07:00-12:30", "-n", 6, "--knows", "own", "--jobs", 1)
    ran("fleet", *words, "--out", tmp_path / "out")
    summary = summary_of(tmp_path / "out")
    (row,) = summary["rows"]
    assert row["arrivals_per_hour"] == "counted"
    assert row["occupancy"] == pytest.approx(row["counted_occupancy"], abs=0.03)
    hours = summary["hours"]
    assert [row["hour"] for row in hours] == [7, 8, 9, 10, 11, 12]
    assert hours[0]["counted_occupancy"] < 0.3 < 0.7 < hours[4]["counted_occupancy"]
    assert max(abs(hour["occupancy"] - hour["counted_occupancy"]) for hour in hours) < 0.05
