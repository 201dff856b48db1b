"""Shared information in a fleet: reports on the live map, and the state of every slot.

What a car is told counts as observations of its own, so every agent uses it unchanged. Reports from before a car's
arrival count as observations at its arrival, decayed to it; those that have lost half of their value by then are
ignored. Which slot a guidance system has reserved for it, a car reads from its observation (`parkenv.engine.fleet`).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from parkenv.belief.slot_belief import decay_to_prior
from parkenv.compiled.memory import float64s, int32s, int64s
from parkenv.engine.records import (
    BLOCK_BITS,
    BLOCK_SIZE,
    FULL_KNOWLEDGE,
    SHARED_KNOWLEDGE,
    block_at,
    car_at,
    live_slot_at,
    report_at,
    scenario_at,
    search_at,
    slot_at,
)
from parkenv.engine.search_belief import add_observed, column_of, is_taken, set_belief_of
from parkenv.world.occupancy.decay import decay_factor
from parkenv.world.occupancy.kernel import inlined, kernel

_HALF_LIFE = 0.6931471805599453


@kernel
def clear_live_map(fleet: Any) -> None:
    for slot in range(fleet.n_slots):
        live_slot_at(fleet.live_map, slot).time = -np.inf
    fleet.first_report = fleet.n_reports = 0
    fleet.reservations_stale = True


# ---- the live map


@kernel
def report_view(fleet: Any, search: Any) -> None:
    scenario, columns = scenario_at(search.scenario, 0), int32s(search.columns)
    viewed, starts = int64s(scenario.viewed), int64s(scenario.view_starts)
    hit_rate, false_alarm_rate = float64s(scenario.hit_rate), float64s(scenario.false_alarm_rate)
    for i in range(starts[search.vertex], starts[search.vertex + 1]):
        column = np.int64(columns[viewed[i]])
        record = slot_at(search.slots, column)
        block, k = block_at(search.blocks, column >> BLOCK_BITS), column & (BLOCK_SIZE - 1)
        # What the driver may not use counts as taken for it, but not for others.
        if record.observed and block.observed_at[k] == search.time and record.valid_until < np.inf:
            taken, p = bool(record.observed_taken), block.p_observed[k]
            report_slot(fleet, viewed[i], taken, hit_rate[i], false_alarm_rate[i], p)


@kernel
def report_slot(
    fleet: Any, slot: int, taken: bool, hit_rate: float, false_alarm_rate: float, p: float
) -> None:
    """Report an observation of a slot, and P(taken) after it, to the live map; there must be room for the report."""
    if fleet.delay_s == 0.0:
        _write(live_slot_at(fleet.live_map, slot), fleet.time, taken, hit_rate, false_alarm_rate, p)
        return
    last = report_at(fleet.reports, (fleet.first_report + fleet.n_reports) % fleet.report_capacity)
    last.slot = slot
    _write(last, fleet.time, taken, hit_rate, false_alarm_rate, p)
    fleet.n_reports += 1


@inlined
def _write(report: Any, time: float, taken: bool, hit_rate: float, false_alarm_rate: float, p: float) -> None:
    report.time, report.taken, report.p = time, taken, p
    report.hit_rate, report.false_alarm_rate = hit_rate, false_alarm_rate


@inlined
def _update_map(fleet: Any) -> None:
    while fleet.n_reports > 0:
        first = report_at(fleet.reports, fleet.first_report)
        if first.time > fleet.time - fleet.delay_s:
            break
        live = live_slot_at(fleet.live_map, first.slot)
        _write(live, first.time, first.taken, first.hit_rate, first.false_alarm_rate, first.p)
        fleet.first_report = (fleet.first_report + 1) % fleet.report_capacity
        fleet.n_reports -= 1


# ---- what a car takes over


@kernel
def inform(fleet: Any, number: int) -> None:
    """Tell a car what it knows beyond its own observations; call after its step, before its belief is refreshed."""
    car = car_at(fleet.cars, number)
    search = search_at(car.search, 0)
    if car.knows == SHARED_KNOWLEDGE:
        _update_map(fleet)
        _inform_by_map(fleet, car, search)
    elif car.knows == FULL_KNOWLEDGE:
        search.n_step_observed = 0
        for slot in range(fleet.n_slots):
            column = column_of(search, slot)
            taken = is_taken(search, column, fleet.time)
            set_belief_of(search, column, taken, 1.0 if taken else 0.0, search.time)
            add_observed(search, slot, taken, 1.0, 0.0)


@inlined
def _inform_by_map(fleet: Any, car: Any, search: Any) -> None:
    since, until = car.informed_until, fleet.time - fleet.delay_s
    for slot in range(fleet.n_slots):
        live = live_slot_at(fleet.live_map, slot)
        if live.time < since or live.time == -np.inf:
            continue
        column = column_of(search, slot)
        if slot_at(search.slots, column).valid_until == np.inf:
            continue  # The driver may not park there, whatever others say.
        block, k = block_at(search.blocks, column >> BLOCK_BITS), column & (BLOCK_SIZE - 1)
        hit_rate, false_alarm_rate = live.hit_rate, live.false_alarm_rate
        if live.time >= search.arrival:
            if slot_at(search.slots, column).observed and live.time <= block.observed_at[k]:
                continue
            set_belief_of(search, column, live.taken, live.p, live.time)
        else:
            age_s, prior, rate = search.arrival - live.time, block.prior[k], block.decay_rate[k]
            if slot_at(search.slots, column).observed or age_s * rate >= _HALF_LIFE:
                continue
            set_belief_of(
                search, column, live.taken, decay_to_prior(prior, rate, live.p, age_s), search.arrival
            )
            # What the report says about a slot that may have changed since.
            kept, mean = decay_factor(rate * age_s), prior * hit_rate + (1.0 - prior) * false_alarm_rate
            contrast = (hit_rate - false_alarm_rate) * kept
            hit_rate, false_alarm_rate = mean + contrast * (1.0 - prior), mean - contrast * prior
        add_observed(search, slot, live.taken, hit_rate, false_alarm_rate)
    car.informed_until = until
