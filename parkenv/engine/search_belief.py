"""The compiled belief of a search, and the truth that it is about, slot by slot.

The cost of a step does not grow with the lot: only slots that a search has observed or queried get a column in its
tables.
"""

from typing import Any

import numpy as np

from parkenv.belief.cue_belief import freed
from parkenv.belief.slot_belief import bayes_update, decay_to_prior
from parkenv.compiled.arrays import BoolArray
from parkenv.compiled.jit import inlined, kernel
from parkenv.compiled.memory import float32s, float64s, int32s, int64s
from parkenv.engine.records import (
    BLOCK_BITS,
    BLOCK_SIZE,
    DECAY_RATE,
    FORECAST,
    NEVER_OBSERVED,
    NO_CAR,
    OBSERVED_AT,
    P_OBSERVED,
    PROCESS_BACKGROUND,
    RESIDENTS_BACKGROUND,
    SENTINEL,
    block_at,
    counted_at,
    cue_at,
    scenario_at,
    shared_slot_at,
    shared_world_at,
    slot_at,
)
from parkenv.world.occupancy import kernel as worlds
from parkenv.world.occupancy.kernel import EXTERNAL_KIND, LOG_KIND, PROCESS_KIND, SHARED_KIND
from parkenv.world.week import WEEK_HOURS


@inlined
def parking_cost_s(search: Any, slot: int) -> float:
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
    column: int = column_of(search, slot)
    taken = is_taken(search, column, search.time)
    set_belief(search, column, taken, 1.0 if taken else 0.0)
    return column


@inlined
def apply_observation(
    search: Any, column: int, taken: bool, hit_rate: float, false_alarm_rate: float
) -> None:
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
        p_taken = 1.0 if taken else 0.0
        write_observed(search, search.n_step_observed, float(slot), p_taken, hit_rate, false_alarm_rate)
        search.n_step_observed += 1


@inlined
def write_observed(
    search: Any, n: int, slot: float, taken: float, hit_rate: float, false_alarm_rate: float
) -> None:
    rows, most = float32s(search.step_observed), search.most_observed
    rows[n], rows[most + n], rows[2 * most + n], rows[3 * most + n] = slot, taken, hit_rate, false_alarm_rate


@inlined
def set_belief(search: Any, column: int, observed_taken: bool, p: float) -> None:
    set_belief_of(search, column, observed_taken, p, search.time)


@kernel
def set_belief_of(search: Any, column: int, observed_taken: bool, p: float, time: float) -> None:
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
    p = decay_to_prior(block.prior[i], block.decay_rate[i], block.p_observed[i], elapsed)
    return float(p if search.cue_table == 0 else p - freed_now(search, column))


@inlined
def has_cue(search: Any, column: int) -> bool:
    """Return whether a cue belongs to the last observation of a slot: one from before says nothing any more."""
    cue, block = cue_at(search.cue_table, column), block_at(search.blocks, column >> BLOCK_BITS)
    return bool(cue.excess != 0.0 and cue.at == block.observed_at[column & (BLOCK_SIZE - 1)])


@kernel
def freed_now(search: Any, column: int) -> float:
    """Return how much P(free) is above that without cues."""
    if not has_cue(search, column):
        return 0.0
    cue, i = cue_at(search.cue_table, column), column & (BLOCK_SIZE - 1)
    block = block_at(search.blocks, column >> BLOCK_BITS)
    rate = leaving_rate(search, block.prior[i], block.decay_rate[i])
    return float(freed(cue.excess, rate, block.decay_rate[i], search.time - cue.at))


@inlined
def leaving_rate(search: Any, prior: float, decay_rate: float) -> float:
    return float(decay_rate * (1.0 - prior) + 1.0 / scenario_at(search.scenario, 0).lead_s)


@kernel
def refresh_belief(search: Any) -> None:
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


@inlined
def end_observed(search: Any) -> None:
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
    if search.cue_table != 0:
        for column in range(1, search.n_columns + 1):
            if has_cue(search, column):
                block = block_at(search.blocks, column >> BLOCK_BITS)
                i = column & (BLOCK_SIZE - 1)
                block.p_occupied[i] = min(max(block.p_occupied[i] - freed_now(search, column), 0.0), 1.0)


@inlined
def column_of(search: Any, slot: int) -> Any:
    column = np.int64(int32s(search.columns)[slot])
    if column == SENTINEL:
        column = add_column(search, slot)
    return column


@kernel
def add_column(search: Any, slot: int) -> int:
    column = search.n_columns + 1
    search.n_columns = column
    int32s(search.columns)[slot] = column
    record = slot_at(search.slots, column)
    record.slot, record.sojourn, record.valid_until = slot, 0, 0.0
    record.observed = record.observed_taken = record.passed = False
    if search.cue_table != 0:
        cue = cue_at(search.cue_table, column)
        cue.excess, cue.at = 0.0, -np.inf
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
    record = slot_at(search.slots, column)
    if time >= record.valid_until:
        refresh_state(search, record, time)
    return bool(record.occupied)


@kernel
def refresh_state(search: Any, record: Any, time: float) -> None:
    scenario, slot = scenario_at(search.scenario, 0), np.int64(record.slot)
    if scenario.world_kind == SHARED_KIND:
        # Another car may change it at any time, so `valid_until` stays 0.
        record.occupied = not is_slot_open(search.world, slot, search.car, time)
    else:
        world, cursor = worlds.world_of(search), worlds.cursor_of(record)
        worlds.find_state(scenario.world_kind, search.world, world, slot, cursor, time)


@kernel
def end_of_stay(search: Any, column: int, time: float) -> float:
    """Return when the car in a taken slot leaves, s; infinite for what stands for a counted facility."""
    scenario, record = scenario_at(search.scenario, 0), slot_at(search.slots, column)
    slot = np.int64(record.slot)
    if scenario.world_kind != SHARED_KIND:
        own, cursor = worlds.world_of(search), worlds.cursor_of(record)
        return float(worlds.find_end_of_stay(scenario.world_kind, search.world, own, slot, cursor, time))
    world = shared_world_at(search.world, 0)
    if slot >= world.first_counted:
        return np.inf
    shared = shared_slot_at(world.slots, slot)
    if shared.car != NO_CAR or world.background != PROCESS_BACKGROUND:
        return float(shared.leaves_at)
    cursor = worlds.cursor_of(shared)
    day = worlds.world_of(world)
    return float(worlds.find_end_of_stay(world.world_kind, world.world, day, slot, cursor, time))


@kernel
def forecast_of(search: Any, slot: int) -> tuple[float, float]:
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
    """Write the forecast of every slot as the full belief, (4, width), if it is kept: nothing is observed yet."""
    if search.belief == 0:
        return
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
    if search.cues != 0:
        for slot in range(n):
            forecast, decay_rate = belief[FORECAST * width + slot], belief[DECAY_RATE * width + slot]
            float32s(search.cues)[slot] = float32s(search.cues)[2 * width + slot] = 0.0
            lead_s = scenario.lead_s
            rate = leaving_rate(search, forecast, decay_rate) if lead_s > 0.0 else 0.0
            float32s(search.cues)[width + slot] = rate
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


# ---- slots that many cars share: taken by a car of the fleet, or by the background


@kernel
def is_shared_slot_taken(address: int, slot: int, time: float) -> bool:
    """Return whether a slot of a SHARED_WORLD record is taken at a time, s; times must not decrease between calls."""
    world = shared_world_at(address, 0)
    if slot >= world.first_counted:
        counted = counted_at(world.counted, slot - world.first_counted)
        return bool(counted.n_cars >= counted.capacity)
    shared = shared_slot_at(world.slots, slot)
    if shared.car != NO_CAR:
        return True
    if world.background == PROCESS_BACKGROUND:
        return bool(_background_state(world, slot, shared, time))
    return bool(time < shared.leaves_at)


@inlined
def is_slot_open(address: int, slot: int, car: int, time: float) -> bool:
    held_by = shared_slot_at(shared_world_at(address, 0).slots, slot).held_by
    return bool(held_by in (NO_CAR, car) and not is_shared_slot_taken(address, slot, time))


@inlined
def _background_state(world: Any, slot: int, shared: Any, time: float) -> bool:
    if time >= shared.valid_until:
        cursor = worlds.cursor_of(shared)
        worlds.find_state(world.world_kind, world.world, worlds.world_of(world), slot, cursor, time)
    return bool(shared.occupied)


@kernel
def empty_shared_slots(address: int) -> None:
    world = shared_world_at(address, 0)
    worlds.begin_day(world.world_kind, world.world, worlds.world_of(world))
    for slot in range(world.n_slots):
        shared = shared_slot_at(world.slots, slot)
        shared.sojourn, shared.valid_until = 0, -np.inf
        shared.car, shared.held_by, shared.leaves_at = NO_CAR, NO_CAR, -np.inf
        if slot >= world.first_counted:
            counted = counted_at(world.counted, slot - world.first_counted)
            counted.n_cars = counted.published = 0
            counted.gate_free_at = counted.period = -np.inf
        elif world.background == RESIDENTS_BACKGROUND and _background_state(
            world, slot, shared, world.arrival
        ):
            day, cursor = worlds.world_of(world), worlds.cursor_of(shared)
            shared.leaves_at = worlds.find_end_of_stay(
                world.world_kind, world.world, day, slot, cursor, world.arrival
            )


@kernel
def shared_slots_taken_at(address: int, time: float, taken: BoolArray) -> None:
    for slot in range(len(taken)):
        taken[slot] = is_shared_slot_taken(address, slot, time)
