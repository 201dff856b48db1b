"""The compiled belief of a search, and the truth that it is about, slot by slot.

The cost of a step does not grow with the lot: only slots that a search has observed or queried get a column in its
tables.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from parkenv.belief.slot_belief import bayes_update, decay_to_prior
from parkenv.compiled.memory import float32s, float64s, int32s, int64s
from parkenv.engine.records import (
    BLOCK_BITS,
    BLOCK_SIZE,
    DECAY_RATE,
    FORECAST,
    NEVER_OBSERVED,
    OBSERVED_AT,
    P_OBSERVED,
    SENTINEL,
    block_at,
    scenario_at,
    slot_at,
)
from parkenv.engine.shared_slots import is_slot_open
from parkenv.world.occupancy import kernel as worlds
from parkenv.world.occupancy.kernel import EXTERNAL_KIND, LOG_KIND, PROCESS_KIND, SHARED_KIND, inlined, kernel
from parkenv.world.week import WEEK_HOURS


@inlined
def parking_cost_s(search: Any, slot: int) -> float:
    """Return what parking in a slot costs the driver, s: what the lot says, and the price of the stay."""
    scenario = scenario_at(search.scenario, 0)
    if search.zone_cost_s == 0:
        return float(float64s(scenario.parking_cost_s)[slot])
    zone = int64s(scenario.zone_of_slot)[slot]
    return float(float64s(scenario.lot_cost_s)[slot] + float64s(search.zone_cost_s)[zone])


@inlined
def is_forbidden(search: Any, slot: int) -> bool:
    return bool(parking_cost_s(search, slot) == np.inf)


@kernel
def observe_changed(search: Any, slot: int) -> int:
    """Observe the true state of a slot that may have changed; returns its column."""
    column: int = column_of(search, slot)
    taken = is_taken(search, column, search.time)
    set_belief(search, column, taken, 1.0 if taken else 0.0)
    return column


@inlined
def apply_observation(
    search: Any, column: int, taken: bool, hit_rate: float, false_alarm_rate: float
) -> None:
    """Update the belief in a slot from one observation (Bayes' rule)."""
    p = bayes_update(belief_now(search, column), taken, hit_rate, false_alarm_rate)
    set_belief(search, column, taken, p)
    add_observed(search, slot_at(search.slots, column).slot, taken, hit_rate, false_alarm_rate)


@inlined
def observe_attempt(search: Any, column: int, taken: bool) -> None:
    set_belief(search, column, taken, 1.0 if taken else 0.0)
    add_observed(search, slot_at(search.slots, column).slot, taken, 1.0, 0.0)


@inlined
def add_observed(search: Any, slot: int, taken: bool, hit_rate: float, false_alarm_rate: float) -> None:
    if search.step_observed != 0:
        write_observed(search, search.n_step_observed, slot, taken, hit_rate, false_alarm_rate)
        search.n_step_observed += 1


@inlined
def write_observed(
    search: Any, n: int, slot: float, taken: float, hit_rate: float, false_alarm_rate: float
) -> None:
    rows, most = float32s(search.step_observed), search.most_observed
    rows[n], rows[most + n], rows[2 * most + n], rows[3 * most + n] = slot, taken, hit_rate, false_alarm_rate


@inlined
def set_belief(search: Any, column: int, observed_taken: bool, p: float) -> None:
    """Set P(taken) of a slot to `p` after an observation at the current time."""
    set_belief_of(search, column, observed_taken, p, search.time)


@kernel
def set_belief_of(search: Any, column: int, observed_taken: bool, p: float, time: float) -> None:
    """Set P(taken) of a slot to `p` after an observation at a time, s, not before the arrival."""
    record, i = slot_at(search.slots, column), column & (BLOCK_SIZE - 1)
    block = block_at(search.blocks, column >> BLOCK_BITS)
    if not record.observed:
        record.observed = True
        search.n_observed += 1
        search.n_observed_free += 0.0 if observed_taken else 1.0
        # Rounded as in the observation.
        search.n_expected_free += 1.0 - np.float32(block.prior[i])
    search.n_last_observed_taken += int(observed_taken) - int(record.observed_taken)
    record.observed_taken = observed_taken
    block.p_observed[i], block.observed_at[i] = p, time
    if search.belief != 0:
        belief, width = float32s(search.belief), search.width
        belief[P_OBSERVED * width + record.slot] = p
        belief[OBSERVED_AT * width + record.slot] = time - search.arrival


@inlined
def belief_now(search: Any, column: int) -> float:
    block, i = block_at(search.blocks, column >> BLOCK_BITS), column & (BLOCK_SIZE - 1)
    elapsed = search.time - block.observed_at[i]
    return float(decay_to_prior(block.prior[i], block.decay_rate[i], block.p_observed[i], elapsed))


@kernel
def refresh_belief(search: Any) -> None:
    """Write the current belief into `p_occupied`, if it is kept; only slots with a column can have changed."""
    if search.belief == 0:
        return
    decay_belief(search)
    end_observed(search)
    p_occupied, end = float32s(search.p_occupied), search.n_columns + 1
    for first in range(0, end, BLOCK_SIZE):
        block = block_at(search.blocks, first >> BLOCK_BITS)
        # Fixed length, so that the loop is unrolled.
        for i in range(BLOCK_SIZE):
            if SENTINEL < first + i < end:
                p_occupied[slot_at(search.slots, first + i).slot] = block.p_occupied[i]


@kernel
def write_belief(search: Any) -> None:
    """Write the belief in all slots with a column, as of the last step, to memory that may hold an older one."""
    width, slots, blocks, arrival = search.width, search.slots, search.blocks, search.arrival
    p_occupied, belief = float32s(search.p_occupied), float32s(search.belief)
    for column in range(1, search.n_columns + 1):
        slot, i = slot_at(slots, column).slot, column & (BLOCK_SIZE - 1)
        block = block_at(blocks, column >> BLOCK_BITS)
        p_occupied[slot] = block.p_occupied[i]
        belief[FORECAST * width + slot], belief[P_OBSERVED * width + slot] = (
            block.prior[i],
            block.p_observed[i],
        )
        belief[OBSERVED_AT * width + slot] = block.observed_at[i] - arrival


@inlined
def end_observed(search: Any) -> None:
    """Mark the rest of `step_observed` as unused."""
    if search.step_observed != 0:
        for n in range(search.n_step_observed, search.n_step_used):
            write_observed(search, n, -1.0, 0.0, 0.0, 0.0)
        search.n_step_used = search.n_step_observed


@kernel
def decay_belief(search: Any) -> None:
    time = search.time
    for number in range((search.n_columns + BLOCK_SIZE) >> BLOCK_BITS):
        block = block_at(search.blocks, number)
        # Fixed length, so that the loop is vectorised.
        for i in range(BLOCK_SIZE):
            block.p_occupied[i] = decay_to_prior(
                block.prior[i], block.decay_rate[i], block.p_observed[i], time - block.observed_at[i]
            )


@inlined
def column_of(search: Any, slot: int) -> Any:
    """Return the column of a slot, a new one if it has none."""
    column = np.int64(int32s(search.columns)[slot])
    if column == SENTINEL:
        column = add_column(search, slot)
    return column


@kernel
def add_column(search: Any, slot: int) -> int:
    """Give a slot a column, and write its forecast there."""
    column = search.n_columns + 1
    search.n_columns = column
    int32s(search.columns)[slot] = column
    record = slot_at(search.slots, column)
    record.slot, record.sojourn, record.valid_until = slot, 0, 0.0
    record.observed = record.observed_taken = record.passed = False
    block, i = block_at(search.blocks, column >> BLOCK_BITS), column & (BLOCK_SIZE - 1)
    prior, rate = forecast_of(search, slot)
    if search.n_forbidden > 0 and is_forbidden(search, slot):
        record.occupied = record.observed_taken = True
        record.valid_until = np.inf
        prior, rate = 1.0, 0.0
    block.prior[i] = block.p_observed[i] = block.p_occupied[i] = prior
    block.decay_rate[i], block.observed_at[i] = rate, search.arrival + NEVER_OBSERVED
    return int(column)


@inlined
def is_taken(search: Any, column: int, time: float) -> bool:
    """Return whether the slot of a column is taken at a time, s; times must not decrease between calls."""
    record = slot_at(search.slots, column)
    if time >= record.valid_until:
        find_state(search, record, time)
    return bool(record.occupied)


@kernel
def find_state(search: Any, record: Any, time: float) -> None:
    """Compute whether a slot is taken at a time beyond the known part of its sojourn."""
    scenario, slot = scenario_at(search.scenario, 0), np.int64(record.slot)
    if scenario.world_kind == SHARED_KIND:
        # Another car may change it at any time, so `valid_until` stays 0.
        record.occupied = not is_slot_open(search.world, slot, search.car, time)
    else:
        worlds.find_state(scenario.world_kind, search.world, search, slot, record, time)


@kernel
def forecast_of(search: Any, slot: int) -> tuple[float, float]:
    """Return the forecast P(taken) of a slot, and its decay rate, 1/s."""
    scenario = scenario_at(search.scenario, 0)
    if scenario.prior_kind == EXTERNAL_KIND:
        external = float64s(search.external_forecast)
        return external[slot], external[search.width + slot]
    if scenario.prior_kind == LOG_KIND:
        day = worlds.recorded_day_at(scenario.prior, search.day)
        p, rate = worlds.recorded_forecast(day, slot, search.second_of_day)
    else:
        p, rate = worlds.process_forecast(
            worlds.process_at(scenario.prior, 0), search.hour, search.second_of_hour, slot
        )
    return min(max(p, worlds.MIN_PROBABILITY), worlds.MAX_PROBABILITY), rate


@kernel
def init_full_prior(search: Any) -> None:
    scenario, width = scenario_at(search.scenario, 0), search.width
    belief, p_occupied, n = float32s(search.belief), float32s(search.p_occupied), scenario.n_slots
    if scenario.prior_kind == PROCESS_KIND:
        _init_process_prior(search)
    else:
        for slot in range(n):
            belief[FORECAST * width + slot], belief[DECAY_RATE * width + slot] = forecast_of(search, slot)
    if search.n_forbidden > 0:
        for slot in range(n):
            if is_forbidden(search, slot):
                belief[FORECAST * width + slot], belief[DECAY_RATE * width + slot] = 1.0, 0.0
    for slot in range(n):
        p_occupied[slot] = belief[P_OBSERVED * width + slot] = belief[FORECAST * width + slot]
        belief[OBSERVED_AT * width + slot] = NEVER_OBSERVED
    # Padding past the last slot; the previous place may have been larger.
    for slot in range(n, width):
        p_occupied[slot] = belief[FORECAST * width + slot] = belief[P_OBSERVED * width + slot] = 1.0
        belief[DECAY_RATE * width + slot] = 0.0
        belief[OBSERVED_AT * width + slot] = NEVER_OBSERVED
    end_observed(search)


@kernel
def _init_process_prior(search: Any) -> None:
    """Write the forecast of all slots, vectorised, from marginals precomputed at the full hour."""
    scenario, width, hour, second = (
        scenario_at(search.scenario, 0), search.width, search.hour, search.second_of_hour,
    )  # fmt: skip
    process, n = worlds.process_at(scenario.prior, 0), scenario.n_slots
    worlds.keep_hourly_marginals(process, hour)
    factors, profiles = float64s(process.factors), float64s(process.profiles)
    start, belief = float64s(process.hourly_marginals), float32s(search.belief)
    arriving, leaving = profiles[hour], profiles[WEEK_HOURS + hour]
    for slot in range(n):
        arrival = factors[slot] * arriving
        rate = arrival + factors[n + slot] * leaving
        p = process.flat
        if not p >= 0.0:
            p = worlds.marginal_later(start[hour * n + slot], arrival, rate, second)
        belief[FORECAST * width + slot] = min(max(p, worlds.MIN_PROBABILITY), worlds.MAX_PROBABILITY)
        belief[DECAY_RATE * width + slot] = rate
