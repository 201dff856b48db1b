"""What planners and worlds do is what theory says; and the closed forms themselves, against plain computations."""

import math
from functools import cache

import balance
import line
import numpy as np
import pytest
import queues
from closed_forms import Statement, all_forms, sections
from line import CHANCES, EQUAL_COSTS, THESIS_SPEEDS, Line
from queues import MEEK, Queue, Run, erlang_b, lane
from scipy import stats

from planners.agent import make_agent


@cache
def statements():
    return [
        pytest.param(each, id=f"{form.title}: {each.case}", marks=[pytest.mark.slow] if each.slow else [])
        for form in all_forms()
        for each in form.statements()
    ]


@pytest.mark.parametrize("statement", statements())
def test_what_is_found_agrees_with_theory(statement):
    low, high = statement.interval()
    assert low <= statement.expected <= high


def test_the_page_has_every_form_and_its_numbers():
    text = sections()
    for form in all_forms():
        assert f"## {form.title}\n\n*{form.source}.*" in text
    assert "| A = 5: mean index of a car's slot | 4.1739 |" in text


def test_a_statement_agrees_where_theory_is_in_its_interval():
    assert Statement("", 3.0, lambda: 3.0).agrees()
    assert not Statement("", 3.0, lambda: 3.001).agrees()
    assert Statement("", 3.0, lambda: 3.001, tolerance=0.002).agrees()
    drawn = np.random.default_rng(0).normal(5.0, 2.0, 400)
    low, high = Statement("", 5.0, lambda: drawn).interval()
    assert low < 5.0 < high < 6.0
    assert high - low == pytest.approx(2 * 3.93 * drawn.std(ddof=1) / 20.0, rel=0.01), "Student's t, 399"
    rng = np.random.default_rng(1)
    missed = sum(not Statement("", 0.0, lambda: rng.normal(size=30)).agrees() for _ in range(4000))
    assert missed <= 3, "0.4 are expected"


def best_threshold_and_cost(on):
    onward, takes = 0.0, []
    for r in range(-on.beyond, on.before + 1):
        cost = r * on.before_s if r >= 0 else -r * on.beyond_s
        takes.append(cost <= onward or r == -on.beyond)
        taken = onward if r > -on.beyond else cost
        onward = (1.0 - on.q) * (cost if takes[-1] else onward) + on.q * taken
    return line.threshold_of(np.array(takes[::-1]), on.before), onward


@pytest.mark.parametrize("ratio", [EQUAL_COSTS, THESIS_SPEEDS, 0.8])
@pytest.mark.parametrize("q", CHANCES)
def test_the_closed_form_of_the_line_is_that_of_its_dynamic_program(q, ratio):
    on = Line.long(q, ratio)
    threshold, cost_s = best_threshold_and_cost(on)
    assert on.threshold == threshold
    drive_s = (on.before + 1) * line.PITCH / line.V_WALK * ratio
    assert on.mean_s - drive_s == pytest.approx(cost_s, rel=1e-4)
    assert on.mean_cost(np.arange(on.n_slots) >= on.before - on.threshold) == pytest.approx(cost_s, rel=1e-4)


def test_the_thresholds_are_those_of_the_literature():
    assert [Line.long(q, EQUAL_COSTS).threshold for q in CHANCES] == [1, 2, 3, 4, 6, 13, 68]
    assert line.threshold_of(np.array([False, True, True, True]), 2) == 1.0
    assert math.isnan(line.threshold_of(np.array([True, False, True, True]), 2)), "no threshold"


def test_an_agent_that_takes_the_first_free_slot_is_found_out():
    on = line.SHORT
    total_s = line.total_times("greedy-drive", on, range(300))
    assert not Statement("", on.mean_s, lambda: total_s).agrees()
    problem = on.problem()
    agent, p = make_agent("greedy-drive", problem), np.full(on.n_slots, 0.5)
    assert line.free_slots_taken(agent, problem, p, on.n_slots).all()


def test_inspections_are_without_replacement():
    for free in (2, 3):
        assert not Statement("", line.SLOTS / free, lambda free=free: line.passed(free)).agrees()


@pytest.mark.parametrize(("slots", "load"), [(1, 0.3), (5, 5.0), (10, 8.0), (100, 200.0)])
def test_erlang_b_is_the_truncated_poisson_law(slots, load):
    law = stats.poisson(load)
    assert erlang_b(slots, load) == pytest.approx(law.pmf(slots) / law.cdf(slots))


def test_the_half_rule_is_the_best_threshold_and_has_its_limit():
    taus = (0.25, 0.4, 0.45, 0.5, 0.55, 0.6, 0.75)
    chance = {tau: tau * erlang_b(round(tau * 4000), 4000.0) for tau in taus}
    assert max(chance, key=chance.get) == 0.5
    for tau, p in chance.items():
        assert p == pytest.approx(tau * (1.0 - tau), rel=0.01)


def test_mean_parked_counts_the_time_in_a_window():
    cars = np.zeros(4, [("slot", int), ("ended_at", float), ("left_at", float)])
    cars["slot"] = 0, 2, 2, -1
    cars["ended_at"] = 0.0, 5.0, 30.0, 1.0
    cars["left_at"] = 15.0, 20.0, np.inf, np.inf
    assert Run(cars, 10.0, 50.0).mean_parked(3) == pytest.approx([5 / 40, 0.0, 30 / 40])


def test_other_drivers_do_not_take_slots_as_erlang_says():
    assert sum(not each.agrees() for each in queues.ordered_entry(MEEK)) in range(4, 7)


def cars_of(n_slots, policy, load, hours):
    (cars,) = Queue(lane(n_slots), policy, load, 1, 0.0, hours).samples(lambda run: run.cars.copy())
    return cars


def test_a_driver_at_the_threshold_takes_the_first_free_slot_of_its_zone():
    cars = cars_of(queues.ZONE_SLOTS, queues.THRESHOLDS[0.5], 20.0, 2.0)
    # An empty zone of 100 slots: the first car stops at its far end, the others behind it, towards the goal.
    first = queues.ZONE_SLOTS - queues.ZONE_LOAD // 2
    assert cars["slot"][0] == first
    assert (cars["slot"] >= first).all()
    assert (cars["n_moves"] == 0).all(), "never a single free slot"


def test_a_lost_car_is_found():
    cars, _, _ = balance.day("mini")
    cars = cars.copy()
    cars["ended_at"][3] += 300.0
    assert balance.unbalanced_events(balance.made_fleet("mini"), cars) > 0
