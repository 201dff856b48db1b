"""The lower bound that knows all arrivals: below the best schedule on tiny days, below every driver on large ones."""

import itertools
import math

import numpy as np
import pytest

from parkenv.scenarios.spec import scenario_specs
from parkenv.studies.fleet.clairvoyant_bound import ParkingDay, clairvoyant_bound_s
from parkenv.studies.fleet.day import Roads
from parkenv.studies.fleet.study import FleetStudy


def best_schedule_s(day):
    n_cars, slots = len(day.arrival), range(len(day.cost_s))

    def total_s(places):
        groups = [[car for car in range(n_cars) if places[car] == slot] for slot in slots]
        orders = (
            (in_order_s(day, slot, order) for order in itertools.permutations(groups[slot])) for slot in slots
        )
        return day.give_up_s * places.count(-1) + sum(map(min, orders))

    return min(map(total_s, itertools.product((-1, *slots), repeat=n_cars)))


def in_order_s(day, slot, cars):
    free_from, total = day.free_from[slot], 0.0
    for car in cars:
        parks_at = max(free_from, day.arrival[car] + day.drive_s[day.entry[car], slot])
        if parks_at > day.arrival[car] + day.patience_s[car]:
            return math.inf
        price_s = day.zone_cost_s[car, day.zone[slot]]
        total += parks_at - day.arrival[car] + day.cost_s[slot] + price_s
        free_from = parks_at + day.stay_s[car]
    return total


def random_day(rng):
    n_cars, n_slots, n_entries = rng.integers(1, 5), rng.integers(1, 4), rng.integers(1, 3)
    free_from = rng.uniform(0.0, 900.0, n_slots)
    free_from[rng.random(n_slots) < 0.5] = -math.inf
    free_from[rng.random(n_slots) < 0.1] = math.inf
    drive_s = rng.uniform(5.0, 60.0, (n_entries, n_slots))
    drive_s[rng.random(drive_s.shape) < 0.1] = math.inf
    return ParkingDay(
        arrival=np.sort(rng.uniform(0.0, 900.0, n_cars)) + rng.choice([0.0, 1e6]),
        stay_s=rng.exponential(rng.choice([200.0, 2000.0]), n_cars),
        patience_s=np.full(n_cars, rng.choice([50.0, 400.0, math.inf])),
        entry=rng.integers(0, n_entries, n_cars),
        drive_s=drive_s,
        cost_s=rng.uniform(5.0, 120.0, n_slots),
        free_from=free_from,
        zone=rng.integers(0, 2, n_slots),
        zone_cost_s=rng.uniform(0.0, 200.0, (n_cars, 2)) * rng.choice([0.0, 1.0]),
        give_up_s=float(rng.choice([200.0, 1800.0])),
    )


@pytest.mark.slow
def test_it_is_never_above_the_best_schedule_of_a_tiny_day():
    rng = np.random.default_rng(1)
    days = [random_day(rng) for _ in range(45)]
    ratios = np.array([clairvoyant_bound_s(day) / best_schedule_s(day) for day in days])
    assert (ratios <= 1.0).all()
    assert np.median(ratios) > 0.95


def test_without_competition_it_is_the_time_of_each_car_alone():
    day = ParkingDay(
        arrival=np.array([0.0, 10_000.0]), stay_s=np.full(2, 600.0), patience_s=np.full(2, math.inf),
        entry=np.array([0, 1]), drive_s=np.array([[10.0, 20.0], [20.0, 10.0]]), cost_s=np.array([30.0, 30.0]),
        free_from=np.full(2, -math.inf), zone=np.zeros(2, np.int64), zone_cost_s=np.zeros((2, 1)),
        give_up_s=900.0,
    )  # fmt: skip
    assert clairvoyant_bound_s(day) == pytest.approx(80.0)
    later = day._replace(arrival=day.arrival + 5e5, free_from=day.free_from + 5e5)
    assert clairvoyant_bound_s(later) == pytest.approx(80.0)
    assert clairvoyant_bound_s(day._replace(free_from=np.full(2, math.inf))) == pytest.approx(1800.0)


@pytest.mark.parametrize(
    ("stay_s", "give_up_s", "least_s", "best_s"),
    [(math.inf, 900.0, 60.0, 930.0), (600.0, 100.0, 100.0, 130.0)],
)
def test_a_stay_may_end_after_the_day(stay_s, give_up_s, least_s, best_s):
    day = ParkingDay(
        arrival=np.array([0.0, 5.0]), stay_s=np.full(2, stay_s), patience_s=np.full(2, 600.0),
        entry=np.zeros(2, np.int64), drive_s=np.array([[10.0]]), cost_s=np.array([20.0]),
        free_from=np.array([-math.inf]), zone=np.zeros(1, np.int64), zone_cost_s=np.zeros((2, 1)), give_up_s=give_up_s,
    )  # fmt: skip
    assert least_s < clairvoyant_bound_s(day) <= best_schedule_s(day) == best_s


@pytest.mark.parametrize("knows", ["own", "reserve", "full"])
def test_no_fleet_is_below_it(knows):
    (scenario,) = scenario_specs("mini")
    scenario = scenario.changed(arrivals={"hours": "08:00-09:00", "days": "weekdays"})
    scenario = scenario.changed(costs={"prices": {} if knows == "own" else {"other": 1.0}})
    study = FleetStudy().changed(scenario=scenario, knows=(knows,), arrivals_per_hour=(8.0, 40.0))
    roads = Roads(study.built["mini"])
    for setting in study.fleet_settings:
        for day in range(2):
            fleet, agents = study.fleet(setting)
            fleet.reset(2, day)
            bound_s = clairvoyant_bound_s(roads.parking_day(fleet))
            fleet.run(agents)
            assert roads.alone_s(fleet).sum() - 1e-4 <= bound_s <= fleet.cars["total_s"].sum()
