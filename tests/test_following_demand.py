"""Demand with which a lot becomes as full as counted, recorded or expected."""

import numpy as np
import pytest
from car_park_counts import CURVE, write_counts
from command_line import ran, summary_of
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from parkenv import ArrivalWindow, OccupancyLog, RecordedOccupancy, make_scenario
from parkenv.engine.fleet import Fleet
from parkenv.studies.fleet.setting import rate_of
from parkenv.world.demand import ConstantTime, Demand, ExponentialTime, FollowingArrivals
from parkenv.world.occupancy.counted import process_of_curve
from parkenv.world.occupancy.day_error import DayError
from parkenv.world.occupancy.process import Arrival, ArrivalDay, OccupancyModel, OccupancyProcess

TUESDAY = ArrivalDay(1)
MORNING = ArrivalWindow((1,), 7 * 3600.0, 14.5 * 3600.0)
TIMES = 86400.0 + np.arange(7 * 3600.0 + 300.0, 14.5 * 3600.0 + 1.0, 300.0)


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
    process = process.with_day_error(DayError(0.7))
    arrival = Arrival(TIMES[0])
    exact, sampled = (
        kind.course(process, arrival, TIMES[::12]) for kind in (OccupancyProcess, OccupancyModel)
    )
    assert exact.residents[0] == exact.occupied[0]
    np.testing.assert_allclose(sampled, exact, atol=0.05)


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
    scenario = make_scenario("mini")
    times = []
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
