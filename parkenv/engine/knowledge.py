"""What cars of a fleet know beyond their own observations: a live map, a guidance system, or everything.

Whatever a car knows is in its belief, so every agent uses it unchanged. Reports from before a car's arrival count as
observations at its arrival, decayed to it; those that have lost half of their value by then are ignored.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from parkenv.belief.slot_belief import decay_to_prior
from parkenv.compiled.memory import float32s, int32s, int64s
from parkenv.engine.kernel import column_of, is_slot_open, set_belief_of
from parkenv.engine.records import (
    BLOCK_BITS,
    BLOCK_SIZE,
    DECAY_RATE,
    FULL_KNOWLEDGE,
    RESERVE_KNOWLEDGE,
    SHARED_KNOWLEDGE,
    block_at,
    car_at,
    live_slot_at,
    report_at,
    scenario_at,
    search_at,
    slot_at,
)
from parkenv.world.occupancy.kernel import inlined, kernel

_HALF_LIFE = 0.6931471805599453


@kernel
def clear_live_map(fleet: Any) -> None:
    """Begin a world: nothing is reported, nothing is reserved."""
    for slot in range(fleet.n_slots):
        live_slot_at(fleet.live_map, slot).time = -np.inf
    fleet.first_report = fleet.n_reports = 0
    fleet.reservations_stale = True


# ---- the live map


@kernel
def report_view(fleet: Any, search: Any) -> None:
    """Report what a car has just observed to the live map."""
    scenario, columns = scenario_at(search.scenario, 0), int32s(search.columns)
    viewed, starts = int64s(scenario.viewed), int64s(scenario.view_starts)
    for i in range(starts[search.vertex], starts[search.vertex + 1]):
        column = np.int64(columns[viewed[i]])
        record = slot_at(search.slots, column)
        block, k = block_at(search.blocks, column >> BLOCK_BITS), column & (BLOCK_SIZE - 1)
        if record.observed and block.observed_at[k] == search.time:
            report_slot(fleet, viewed[i], bool(record.observed_taken), block.p_observed[k])


@kernel
def report_slot(fleet: Any, slot: int, taken: bool, p: float) -> None:
    """Report a slot to the live map; there must be room for the report."""
    if fleet.delay_s == 0.0:
        _put_on_map(fleet, slot, fleet.time, taken, p)
        return
    last = report_at(fleet.reports, (fleet.first_report + fleet.n_reports) % fleet.report_capacity)
    last.time, last.slot, last.taken, last.p = fleet.time, slot, taken, p
    fleet.n_reports += 1


@inlined
def _put_on_map(fleet: Any, slot: int, time: float, taken: bool, p: float) -> None:
    live = live_slot_at(fleet.live_map, slot)
    live.time, live.taken, live.p = time, taken, p


@inlined
def _update_map(fleet: Any) -> None:
    """Put the reports on the map that are old enough."""
    while fleet.n_reports > 0:
        first = report_at(fleet.reports, fleet.first_report)
        if first.time > fleet.time - fleet.delay_s:
            break
        _put_on_map(fleet, first.slot, first.time, first.taken, first.p)
        fleet.first_report = (fleet.first_report + 1) % fleet.report_capacity
        fleet.n_reports -= 1


# ---- what a car takes over


@kernel
def inform(fleet: Any, number: int) -> None:
    """Give a car what it knows beyond its own observations; call after its step, before its belief is refreshed."""
    car = car_at(fleet.cars, number)
    search = search_at(car.search, 0)
    if car.knows == SHARED_KNOWLEDGE:
        _update_map(fleet)
        _inform_by_map(fleet, car, search)
    elif car.knows == FULL_KNOWLEDGE:
        for slot in range(fleet.n_slots):
            taken = not is_slot_open(search.world, slot, number, fleet.time)
            set_belief_of(search, column_of(search, slot), taken, 1.0 if taken else 0.0, search.time)
    elif car.knows == RESERVE_KNOWLEDGE:
        for slot in range(fleet.n_slots):
            column, closed = column_of(search, slot), slot != car.reserved
            set_belief_of(search, column, closed, 1.0 if closed else 0.0, search.time)
            _fix_belief(search, column, slot)


@inlined
def _inform_by_map(fleet: Any, car: Any, search: Any) -> None:
    """Take over newer reports than the car's own observations."""
    since, until = car.informed_until, fleet.time - fleet.delay_s
    for slot in range(fleet.n_slots):
        live = live_slot_at(fleet.live_map, slot)
        if live.time < since or live.time == -np.inf:
            continue
        column = column_of(search, slot)
        block, k = block_at(search.blocks, column >> BLOCK_BITS), column & (BLOCK_SIZE - 1)
        if live.time >= search.arrival:
            if not slot_at(search.slots, column).observed or live.time > block.observed_at[k]:
                set_belief_of(search, column, live.taken, live.p, live.time)
        elif not slot_at(search.slots, column).observed:
            age_s, rate = search.arrival - live.time, block.decay_rate[k]
            if age_s * rate < _HALF_LIFE:
                p = decay_to_prior(block.prior[k], rate, live.p, age_s)
                set_belief_of(search, column, live.taken, p, search.arrival)
    car.informed_until = until


@inlined
def _fix_belief(search: Any, column: int, slot: int) -> None:
    """Let the belief in a slot stay as it is until the guidance system says otherwise."""
    block_at(search.blocks, column >> BLOCK_BITS).decay_rate[column & (BLOCK_SIZE - 1)] = 0.0
    if search.belief != 0:
        float32s(search.belief)[DECAY_RATE * search.width + slot] = 0.0
