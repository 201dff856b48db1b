"""Theory of many cars in one lot against the engine: the closed forms themselves, and small runs of each case."""

import math

import numpy as np
import pytest
from scipy import stats

from parkenv.studies.verify import balance, game, queues, town
from parkenv.studies.verify.queues import MEEK, ORDERED_ENTRY, Queue, Run, erlang_b, lane
from parkenv.studies.verify.rows import disagreeing
from planners.heuristics import POLICIES


@pytest.mark.parametrize(("slots", "load"), [(1, 0.3), (5, 5.0), (10, 8.0), (100, 200.0)])
def test_erlang_b_is_the_truncated_poisson_law(slots, load):
    law = stats.poisson(load)
    assert erlang_b(slots, load) == pytest.approx(law.pmf(slots) / law.cdf(slots))


def test_the_mean_index_of_ordered_entry_is_that_of_the_literature():
    assert sum(erlang_b(k, 5.0) for k in range(60)) == pytest.approx(4.174, abs=5e-4)


def test_the_half_rule_is_the_best_threshold_and_has_its_limit():
    chance = {
        tau: tau * erlang_b(round(tau * 4000), 4000.0) for tau in (0.25, 0.4, 0.45, 0.5, 0.55, 0.6, 0.75)
    }
    assert max(chance, key=chance.get) == 0.5
    for tau, p in chance.items():
        assert p == pytest.approx(tau * (1.0 - tau), rel=0.01)


def test_mean_parked_counts_the_time_in_a_window():
    cars = np.zeros(4, [("slot", int), ("ended_at", float), ("left_at", float)])
    cars["slot"] = 0, 2, 2, -1
    cars["ended_at"] = 0.0, 5.0, 30.0, 1.0
    cars["left_at"] = 15.0, 20.0, np.inf, np.inf
    assert Run(cars, 10.0, 50.0).mean_parked(3) == pytest.approx([5 / 40, 0.0, 30 / 40])


@pytest.mark.parametrize(("policy", "wrong"), [(ORDERED_ENTRY, range(1)), (MEEK, range(4, 7))])
def test_slots_are_taken_as_often_as_erlang_says_and_by_other_drivers_not(policy, wrong):
    made = queues.entry_rows(1, policy, 30, 200.0)
    assert len(disagreeing(made)) in wrong
    assert len(made) == len(queues.SHOWN) + 1


@pytest.mark.parametrize("law", queues.LAWS)
def test_the_law_of_the_stay_does_not_matter(law):
    made = [*queues.loss_row(law, 2, 40, 150.0), *queues.drivers_row(law, 2, 10, 100.0)]
    assert not disagreeing(made), made


@pytest.mark.parametrize("policy", [ORDERED_ENTRY, POLICIES["greedy-drive"]], ids=lambda p: p.name)
def test_the_lot_turns_away_as_many_as_erlang_says(policy):
    assert not disagreeing(queues.blocking_row(policy, 3, queues.EXPONENTIAL, "", 40, 150.0))


def test_no_car_is_lost_at_any_event():
    made = balance.rows("mini", 4)
    assert not disagreeing(made), made
    assert all(row.exact for row in made)


def test_a_lost_car_is_found():
    fleet = balance.made_fleet("mini")
    fleet.reset(5, 0)
    fleet.run()
    cars = fleet.cars.copy()
    times = np.sort(cars["arrival"])
    assert all(balance.checked_events(fleet, 5, 0, times, cars))
    cars["ended_at"][3] += 300.0
    assert not all(balance.checked_events(fleet, 5, 0, times, cars))


def test_strategies_on_the_half_line():
    made = [*queues.meek_row(1.0, 6, 40, 300.0), *queues.threshold_row(0.5, 6, 8, 60.0)]
    assert not disagreeing(made), made


def cars_of(n_slots, policy, load, hours):
    (cars,) = Queue(lane(n_slots), policy, load, 1, 0.0, hours).samples(0, lambda run: run.cars.copy())
    return cars


def test_a_driver_at_the_threshold_takes_the_first_free_slot_of_its_zone():
    cars = cars_of(queues.ZONE_SLOTS, queues.CompiledPolicy("half", queues.decide_half), 20.0, 2.0)
    # An empty zone of 100 slots: the first car stops at its far end, the others behind it, towards the goal.
    first = queues.ZONE_SLOTS - queues.ZONE_LOAD // 2
    assert cars["slot"][0] == first
    assert (cars["slot"] >= first).all()
    assert (cars["n_moves"] == 0).all(), "never a single free slot"


def test_the_price_of_anarchy_of_the_parking_game():
    expected = [game.expected_price(n) for n in game.DRIVERS]
    assert expected == pytest.approx([1.2, 1.2857, 1.35, 1.3636, 1.25], abs=1e-4)
    made = game.rows(7)
    assert not disagreeing(made), made
    assert all(row.exact for row in made)


def test_drivers_who_compete_pay_for_places_and_failed_searches():
    played = game.Game(0)
    assert played.competing_cost(0) == 0.0
    assert played.competing_cost(game.PLACES) == game.PLACES * game.STREET
    assert played.competing_cost(game.PLACES + 1) == game.PLACES * game.STREET + game.FAILED
    assert played.equilibrium(70) == 70
    assert math.isclose(played.social_cost(50, 60), 100.0)


def test_a_full_lot_is_left_by_ordered_entry():
    cars = cars_of(1, ORDERED_ENTRY, 50.0, 3.0)
    parked = cars["slot"] >= 0
    assert 0 < parked.sum() < len(cars)
    assert (cars["gave_up_s"][~parked] > 0.0).all()


def test_a_garage_refuses_as_erlang_says_and_its_barrier_is_a_queue():
    made = town.garage_rows(3, capacity=10, load=8.0, runs=30, hours=100.0)
    assert all(row.agrees for row in made)
    low, high = made[0].interval
    assert not low <= queues.erlang_b(9, 8.0) <= high


def test_a_walk_on_streets_takes_as_long_as_the_formula_says():
    rows = town.network_rows(5, cars=800)
    assert all(row.agrees for row in rows)
    assert [row.expected for row in rows] == sorted(row.expected for row in rows)
