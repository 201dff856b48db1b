"""The compiled search: the effect of an action on the car, its observations and its belief.

`parkenv/Search-v2` and its batch both run this code, so they agree to the bit.

Functions named `..._at` take an address: that of a record of `Searches`, where they are called from Python.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba.cpython.unsafe.tuple import tuple_setitem
from numba.np.unsafe.ndarray import to_fixed_tuple

from parkenv.compiled.arrays import BoolArray, FloatArray, IntArray
from parkenv.compiled.keyed_random import (
    ENTRY_STREAM,
    OBSERVATION_STREAM,
    SCENARIO_STREAM,
    VIEW_STREAM,
    episode_key,
    keyed_uniform,
)
from parkenv.compiled.memory import float32s, float64s, int32s, int64s
from parkenv.engine.live_counts import observe_live
from parkenv.engine.records import (
    BLOCK_BITS,
    BLOCK_SIZE,
    N_ACTIONS,
    N_TERMS,
    NO_SLOT,
    OBSERVED_AT,
    SCENARIO,
    SENTINEL,
    UNGUIDED,
    block_at,
    edge_at,
    scenario_at,
    search_at,
    slot_at,
)
from parkenv.engine.search_belief import (
    apply_observation,
    belief_now,
    column_of,
    init_full_prior,
    is_forbidden,
    is_taken,
    observe_attempt,
    observe_changed,
    parking_cost_s,
    refresh_belief,
    set_belief,
    write_observed,
)
from parkenv.world.cost_terms import METRICS, REWARD_TERMS
from parkenv.world.lot import PARK
from parkenv.world.occupancy import kernel as worlds
from parkenv.world.occupancy.kernel import EXTERNAL_KIND, LOG_KIND, PROCESS_KIND, inlined, kernel
from parkenv.world.week import DAY_S
from parkenv.world.week_hours import hour_of_week

STEP_RESULT = ("reward", *REWARD_TERMS, *METRICS, "over", "vertex")
"""Names of the numbers that a step returns; metrics are those of the episode so far."""


def read_step(scenario: str, result: tuple[Any, ...]) -> tuple[float, bool, int, dict[str, Any]]:
    """Return reward, over, vertex and `info` of a step, from the name of the scenario and numbers of `STEP_RESULT`.

    Written out: with `dict(zip(...))` a step would take a fifth longer.
    """
    (
        reward, drive, failed, walk, parking, gave_up, drive_s, failed_s, walk_s, parking_cost_s, gave_up_s, total_s,
        driven_m, walked_m, failed_parks, slots_passed, parked, over, vertex,
    ) = result  # fmt: skip
    terms = {"drive": drive, "failed": failed, "walk": walk, "parking": parking, "gave_up": gave_up}
    info = {
        "reward_terms": terms, "drive_s": drive_s, "failed_s": failed_s, "walk_s": walk_s,
        "parking_cost_s": parking_cost_s, "gave_up_s": gave_up_s, "total_s": total_s, "driven_m": driven_m,
        "walked_m": walked_m, "failed_parks": failed_parks, "slots_passed": slots_passed, "parked": parked,
        "scenario": scenario,
    }  # fmt: skip
    return reward, over, vertex, info


SCENARIO_BYTES = SCENARIO.itemsize
_DAY_BYTES = worlds.RECORDED_DAY.itemsize

# ---- one search, from Python


@kernel
def begin_search_at(address: int) -> None:
    """Begin the next episode; an external prior must then be queried and `init_prior` called."""
    search = search_at(address, 0)
    arrive(search)
    write_clock(search)
    if scenario_at(search.scenario, 0).prior_kind != EXTERNAL_KIND:
        init_prior(search)


@kernel
def init_external_forecast_at(address: int) -> None:
    """Initialise the belief with the forecast in `Searches.external_forecast`."""
    init_prior(search_at(address, 0))


# One function for each kind of sensor, so that only the kind in use is compiled.


@kernel
def step_exact_at(address: int, action: int) -> tuple[Any, ...]:
    """Take a valid action with an exact sensor; returns as `step_result`."""
    search = search_at(address, 0)
    drive_or_park(search, action)
    if not search.parked:
        observe_exact(search)
    result: tuple[Any, ...] = complete_step(search)
    return result


@kernel
def step_noisy_at(address: int, action: int) -> tuple[Any, ...]:
    """Take a valid action with a noisy sensor, or live counts; returns as `step_result`."""
    search = search_at(address, 0)
    drive_or_park(search, action)
    if not search.parked:
        observe_otherwise(search)
    result: tuple[Any, ...] = complete_step(search)
    return result


# ---- the parts of a step from Python, for environments that drive or observe differently


@kernel
def act_at(address: int, action: int) -> None:
    drive_or_park(search_at(address, 0), action)


@kernel
def set_step_time_at(address: int, begin: float, drive_s: float, failed_s: float) -> None:
    """Set the times, s, for driving and for failed attempts, of the step that began at `begin`."""
    search = search_at(address, 0)
    search.time = begin + (drive_s + failed_s)
    search.step_drive_s, search.step_failed_s = drive_s, failed_s


@kernel
def fail_attempt_at(address: int) -> None:
    """Count a failed attempt at a free slot; `set_step_time_at` sets its time."""
    search = search_at(address, 0)
    search.failed_parks += 1
    search.n_steps += 1
    clear_step(search)


@kernel
def observe_at(address: int) -> None:
    observe(search_at(address, 0))


@kernel
def apply_observations_at(
    address: int, slots: IntArray, taken: BoolArray, hit_rate: FloatArray, false_alarm_rate: FloatArray
) -> None:
    """Update the belief from observations of some slots, (k,) contiguous each, instead of `observe_at`."""
    search = search_at(address, 0)
    mark_passed(search)
    for i in range(slots.size):
        apply_observation(search, column_of(search, slots[i]), taken[i], hit_rate[i], false_alarm_rate[i])


@kernel
def set_taken_at(address: int, slot: int) -> None:
    """Set P(taken) of a slot to 1, as after a failed attempt, whatever else the step has observed of it."""
    search = search_at(address, 0)
    set_belief(search, column_of(search, slot), True, 1.0)
    if search.step_observed == 0:
        return
    # The last observation of the slot counts.
    n, rows = search.n_step_observed - 1, float32s(search.step_observed)
    while n >= 0 and rows[n] != slot:
        n -= 1
    n = search.n_step_observed if n < 0 else n
    if n < search.most_observed:
        write_observed(search, n, slot, 1.0, 1.0, 0.0)
        search.n_step_observed = max(search.n_step_observed, n + 1)


@kernel
def finish_step_at(address: int) -> tuple[Any, ...]:
    """Add the step to the episode and update the full belief; returns as `step_result`."""
    result: tuple[Any, ...] = complete_step(search_at(address, 0))
    return result


@kernel
def step_result_at(address: int) -> tuple[Any, ...]:
    """Return the numbers named by `STEP_RESULT` of the last step, without changing anything."""
    result: tuple[Any, ...] = step_result(search_at(address, 0))
    return result


@kernel
def read_belief_at(
    address: int, p_occupied: FloatArray, p_observed: FloatArray, observed_at: FloatArray
) -> None:
    """Overwrite arrays that hold the forecast, (n_slots,) each, with the belief in observed slots."""
    search = search_at(address, 0)
    for column in range(1, search.n_columns + 1):
        record, i = slot_at(search.slots, column), column & (BLOCK_SIZE - 1)
        p_occupied[record.slot] = belief_now(search, column)
        if record.observed:
            block = block_at(search.blocks, column >> BLOCK_BITS)
            p_observed[record.slot] = block.p_observed[i]
            observed_at[record.slot] = block.observed_at[i] - search.arrival


# ---- an episode


@inlined
def complete_step(search: Any) -> tuple[Any, ...]:
    """Add the step to the episode, update belief and observed time; returns as `step_result`."""
    finish_step(search)
    refresh_belief(search)
    write_clock(search)
    result: tuple[Any, ...] = step_result(search)
    return result


@inlined
def step_result(search: Any) -> tuple[Any, ...]:
    """Return the numbers named by `STEP_RESULT`.

    Compiled code makes a plain tuple six times as fast as a named one.
    """
    terms = to_fixed_tuple(search.step_costs, N_TERMS)
    for term in range(N_TERMS):
        terms = tuple_setitem(terms, term, -search.step_costs[term])
    result: tuple[Any, ...] = (
        (-step_cost_s(search),) + terms + to_fixed_tuple(search.costs, N_TERMS) + (  # noqa: RUF005 - for numba
            sum_of_costs(search), search.driven_m, search.walked_m, search.failed_parks, search.slots_passed,
            search.parked, search.over, search.vertex,
        )
    )  # fmt: skip
    return result


@inlined
def step_cost_s(search: Any) -> float:
    seconds = 0.0
    for term in range(N_TERMS):
        seconds += search.step_costs[term]
    return seconds


@kernel
def arrive(search: Any) -> None:
    """Begin a search in the scenario and the world of its seed and episode, without observations."""
    key = episode_key(search.seed_state, search.episode)
    search.scenario_index = int(keyed_uniform(key, SCENARIO_STREAM, 0, 0) * search.n_scenarios)
    if search.chosen_scenario > 0:
        search.scenario_index = search.chosen_scenario - 1
    search.scenario = search.scenarios + search.scenario_index * SCENARIO_BYTES
    scenario = scenario_at(search.scenario, 0)
    day, second = worlds.draw_arrival(key, scenario.n_weekdays, scenario.window_start, scenario.window_end)
    if search.chosen_day > 0:
        day, second = search.chosen_day - 1, search.chosen_second
    midnight = int64s(scenario.weekdays)[day] * DAY_S
    arrival = midnight + second
    entry = int(keyed_uniform(key, ENTRY_STREAM, 0, 0) * scenario.n_entries)
    if search.chosen_entry > 0:
        entry = search.chosen_entry - 1
    search.chosen_scenario = search.chosen_entry = search.chosen_day = 0
    search.n_forbidden = scenario.n_forbidden
    enter(search, key, day, arrival, midnight, int64s(scenario.entries)[entry])


@kernel
def enter(search: Any, key: np.uint64, day: int, arrival: float, midnight: float, vertex: int) -> None:
    """Begin a search of the record's scenario at a time and a vertex, without observations.

    The record has `scenario`, `scenario_index` and `n_forbidden`; `day` is the index of the weekday or recorded day
    among the scenario's, `midnight` its beginning.
    """
    scenario = scenario_at(search.scenario, 0)
    clear_slots(search)
    search.world = scenario.world
    if scenario.world_kind == LOG_KIND:
        search.world += day * _DAY_BYTES
    _, hour, second = hour_of_week(arrival)
    search.key, search.day, search.hour, search.second_of_hour = key, day, hour, second
    search.arrival, search.time, search.second_of_day = arrival, arrival, arrival - midnight
    worlds.begin_day(scenario.world_kind, scenario.world, search)
    search.vertex = search.previous_vertex = vertex
    search.parked = search.over = False
    for term in range(N_TERMS):
        search.costs[term] = search.step_costs[term] = 0.0
    search.total_s = search.driven_m = search.walked_m = 0.0
    search.n_observed_free = search.n_expected_free = 0.0
    search.failed_parks = search.slots_passed = search.n_steps = search.n_observed = 0
    search.n_step_observed = 0
    # Slots in which the driver may not park are as good as taken.
    search.n_last_observed_taken = search.n_forbidden
    search.remembered_slot, search.reserved = NO_SLOT, UNGUIDED
    _write_day_error(search)


@inlined
def _write_day_error(search: Any) -> None:
    scenario, day_error = scenario_at(search.scenario, 0), float32s(search.day_error)
    if scenario.prior_kind == LOG_KIND:
        day = worlds.recorded_day_at(scenario.prior, search.day)
        day_error[0], day_error[1] = worlds.recorded_day_level(day, search.second_of_day), 0.0
    elif scenario.prior_kind == PROCESS_KIND:
        for i in range(2):
            day_error[i] = worlds.process_at(scenario.prior, 0).day_error[i]


@kernel
def clear_slots(search: Any) -> None:
    columns = int32s(search.columns)
    for column in range(1, search.n_columns + 1):
        columns[slot_at(search.slots, column).slot] = SENTINEL
        # Whole blocks are computed, so empty columns must hold finite numbers.
        block_at(search.blocks, column >> BLOCK_BITS).decay_rate[column & (BLOCK_SIZE - 1)] = 0.0
    search.n_columns = 0


@inlined
def take_step(search: Any, action: int) -> None:
    """Do everything in a step that does not depend on the sensor; its costs go to the fields `step_*`."""
    drive_or_park(search, action)
    if not search.parked:
        observe(search)
    finish_step(search)


@inlined
def write_clock(search: Any) -> None:
    """Write the observed time: s since Monday 00:00, and since the search began."""
    search.clock[0], search.clock[1] = search.time, search.time - search.arrival


@kernel
def drive_or_park(search: Any, action: int) -> None:
    scenario, vertex = scenario_at(search.scenario, 0), search.vertex
    edge = edge_at(scenario.edges, vertex * N_ACTIONS + action)
    clear_step(search)
    search.step_drive_s = edge.seconds
    search.driven_m += edge.metres
    target = edge.target
    if target != vertex:
        search.previous_vertex, search.vertex = vertex, target
    elif action == PARK and vertex < scenario.n_slots:
        column = column_of(search, vertex)
        taken = is_taken(search, column, search.time)
        if search.n_forbidden > 0 and is_forbidden(search, vertex):
            search.step_drive_s = scenario.wait_s
        else:
            if taken:
                search.failed_parks += 1
                search.step_failed_s = scenario.failure_s
            else:
                search.parked = True
                search.step_walk_s = float64s(scenario.walk_s)[vertex] * search.walks
                search.step_parking_cost_s = parking_cost_s(search, vertex)
                search.walked_m = float64s(scenario.walk_m)[vertex] * search.walks
                if scenario.enter_s != 0:
                    search.step_drive_s += float64s(scenario.enter_s)[vertex]
            observe_attempt(search, column, taken)
    search.time += search.step_drive_s + search.step_failed_s
    search.n_steps += 1


@inlined
def clear_step(search: Any) -> None:
    search.n_step_observed = 0
    for term in range(N_TERMS):
        search.step_costs[term] = 0.0


@inlined
def finish_step(search: Any) -> None:
    """Add the step to the episode; give up if every slot was last observed taken."""
    scenario = scenario_at(search.scenario, 0)
    full = search.n_last_observed_taken == scenario.n_slots and scenario.leave_full_lot
    search.step_gave_up_s = scenario.give_up_s if full else 0.0
    search.over = full or search.parked
    for term in range(N_TERMS):
        search.costs[term] += search.step_costs[term]


@inlined
def give_up(search: Any) -> None:
    """End a search after a step: the car parks elsewhere, at the give-up penalty."""
    penalty = scenario_at(search.scenario, 0).give_up_s
    search.step_gave_up_s += penalty
    search.gave_up_s += penalty
    search.over = True


@inlined
def sum_of_costs(record: Any) -> float:
    seconds = 0.0
    for term in range(N_TERMS):
        seconds += record.costs[term]
    return seconds


# ---- what is observed


@inlined
def observe(search: Any) -> None:
    if scenario_at(search.scenario, 0).exact_sensor:
        observe_exact(search)
    else:
        observe_otherwise(search)


@kernel
def observe_otherwise(search: Any) -> None:
    """Observe the slots in view with a noisy sensor, or with live counts beside."""
    if scenario_at(search.scenario, 0).n_live == 0:
        observe_noisy(search)
        return
    if scenario_at(search.scenario, 0).no_errors:
        observe_exact(search)
    else:
        observe_noisy(search)
    observe_live(search)


@inlined
def observe_exact(search: Any) -> None:
    """Observe the true states of the slots in view.

    If a slot's state cannot have changed, only the time of its observation is updated.
    """
    scenario, time = scenario_at(search.scenario, 0), search.time
    viewed, starts = int64s(scenario.viewed), int64s(scenario.view_starts)
    # Read once: each write below might change the record, for all that the compiler knows.
    slots, blocks, columns = search.slots, search.blocks, int32s(search.columns)
    keeps_belief, keeps_observed = search.belief != 0, search.step_observed != 0
    observed_at, since_arrival = (
        float32s(search.belief + 4 * OBSERVED_AT * search.width),
        time - search.arrival,
    )
    n, most, observed = search.n_step_observed, search.most_observed, float32s(search.step_observed)
    for i in range(starts[search.vertex], starts[search.vertex + 1]):
        slot = viewed[i]
        column = np.int64(columns[slot])
        if time >= slot_at(slots, column).valid_until:
            column = observe_changed(search, slot)
        block_at(blocks, column >> BLOCK_BITS).observed_at[column & (BLOCK_SIZE - 1)] = time
        if keeps_belief:
            observed_at[slot] = since_arrival
        if keeps_observed:
            taken = np.float64(slot_at(slots, column).observed_taken)
            observed[n], observed[most + n] = slot, taken
            observed[2 * most + n], observed[3 * most + n] = 1.0, 0.0
            n += 1
    search.n_step_observed = n
    mark_passed(search)


@kernel
def observe_noisy(search: Any) -> None:
    scenario, key, time = scenario_at(search.scenario, 0), search.key, search.time
    viewed, starts = int64s(scenario.viewed), int64s(scenario.view_starts)
    seen_rate, hit_rate = float64s(scenario.seen_rate), float64s(scenario.hit_rate)
    false_alarm_rate = float64s(scenario.false_alarm_rate)
    mark_passed(search)
    # Keyed by the millisecond: two observations of a slot at the same time have the same error.
    millisecond = int(time * 1000.0)
    for i in range(starts[search.vertex], starts[search.vertex + 1]):
        slot = viewed[i]
        # Occlusions persist: one random number per slot and search; only a higher rate of seeing can overcome it.
        if keyed_uniform(key, VIEW_STREAM, slot, 0) >= seen_rate[i]:
            continue
        column = column_of(search, slot)
        rate = hit_rate[i] if is_taken(search, column, time) else false_alarm_rate[i]
        taken = keyed_uniform(key, OBSERVATION_STREAM, slot, millisecond) < rate
        apply_observation(search, column, taken, hit_rate[i], false_alarm_rate[i])


@kernel
def mark_passed(search: Any) -> None:
    """Count the slot that the car stops at, once per search."""
    if search.vertex < scenario_at(search.scenario, 0).n_slots:
        record = slot_at(search.slots, column_of(search, search.vertex))
        if not record.passed:
            record.passed = True
            search.slots_passed += 1


@inlined
def init_prior(search: Any) -> None:
    """Initialise the full belief, if it is kept, with the forecast of every slot; take in live counts."""
    if search.belief != 0:
        init_full_prior(search)
    if scenario_at(search.scenario, 0).n_live > 0:
        observe_live(search)
        refresh_belief(search)
