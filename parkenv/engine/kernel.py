"""The compiled search: the effect of an action on the car, its observations and its belief.

`parkenv/Search-v2` and its batch both run this code, so they agree to the bit. The cost of a step does not grow with
the lot: only slots that a search has observed or queried get a column in its tables.

Functions named `..._at` take an address: that of a record of `Searches`, where they are called from Python.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numba.cpython.unsafe.tuple import tuple_setitem
from numba.np.unsafe.ndarray import to_fixed_tuple
from numpy.typing import NDArray

from parkenv.belief.slot_belief import bayes_update, decay_to_prior
from parkenv.compiled.arrays import BoolArray, FloatArray, IntArray
from parkenv.compiled.keyed_random import (
    ENTRY_STREAM,
    OBSERVATION_STREAM,
    PLACE_STREAM,
    VIEW_STREAM,
    episode_key,
    keyed_uniform,
)
from parkenv.compiled.memory import float32s, float64s, int32s, int64s
from parkenv.engine.records import (
    BLOCK_BITS,
    BLOCK_SIZE,
    DECAY_RATE,
    FORECAST,
    N_ACTIONS,
    N_TERMS,
    NEVER_OBSERVED,
    NO_CAR,
    NO_SLOT,
    OBSERVED_AT,
    P_OBSERVED,
    PROCESS_BACKGROUND,
    RESIDENTS_BACKGROUND,
    SCENARIO,
    SENTINEL,
    UNGUIDED,
    block_at,
    counted_at,
    edge_at,
    scenario_at,
    search_at,
    shared_slot_at,
    shared_world_at,
    slot_at,
)
from parkenv.world.cost_terms import METRICS, REWARD_TERMS
from parkenv.world.lot import PARK
from parkenv.world.occupancy import kernel as worlds
from parkenv.world.occupancy.kernel import EXTERNAL_KIND, LOG_KIND, PROCESS_KIND, SHARED_KIND, inlined, kernel
from parkenv.world.week import DAY_S, WEEK_HOURS
from parkenv.world.week_hours import hour_of_week

_LOGISTIC = 1.702  # the logistic law of z times this is closest to the normal one
_SURE = 8.0  # standard deviations beyond which a facility is surely full, or not
_ABOVE = 1e-3  # how far above its forecast a facility is at least whose count says that it is full
STEP_RESULT = ("reward", *REWARD_TERMS, *METRICS, "over", "vertex")
"""Names of the numbers that a step returns; metrics are those of the episode so far."""


def _make_step_reader() -> Callable[[str, tuple[Any, ...]], tuple[float, bool, int, dict[str, Any]]]:
    """Return the function that `read_step` is.

    Its source is written from the table of terms: with `dict(zip(...))` a step would take a fifth longer, and with one
    argument for each number 3 % longer.
    """
    terms = ", ".join(f"{name!r}: {name}" for name in REWARD_TERMS)
    metrics = ", ".join(f"{name!r}: {name}" for name in METRICS)
    source = f"""
def read_step(place, result):
    {", ".join(STEP_RESULT)} = result
    return reward, over, vertex, {{"reward_terms": {{{terms}}}, {metrics}, "place": place}}
"""
    made: dict[str, Any] = {}
    exec(source, made)
    reader: Callable[[str, tuple[Any, ...]], tuple[float, bool, int, dict[str, Any]]] = made["read_step"]
    return reader


read_step = _make_step_reader()
"""Function (name of the scenario, numbers of `STEP_RESULT`) -> reward, over, vertex and `info` of the step."""
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
    """Move along the graph or attempt to park, without observing yet."""
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
    """Observe the slots in view with the scenario's sensor model."""
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
    """Return what the last step cost, s."""
    seconds = 0.0
    for term in range(N_TERMS):
        seconds += search.step_costs[term]
    return seconds


@kernel
def arrive(search: Any) -> None:
    """Begin a search in the place and the world of its seed and episode, without observations."""
    key = episode_key(search.seed_state, search.episode)
    search.place = int(keyed_uniform(key, PLACE_STREAM, 0, 0) * search.n_places)
    if search.chosen_place > 0:
        search.place = search.chosen_place - 1
    search.scenario = search.scenarios + search.place * SCENARIO_BYTES
    scenario = scenario_at(search.scenario, 0)
    day, second = worlds.draw_arrival(key, scenario.n_weekdays, scenario.window_start, scenario.window_end)
    if search.chosen_day > 0:
        day, second = search.chosen_day - 1, search.chosen_second
    midnight = int64s(scenario.weekdays)[day] * DAY_S
    arrival = midnight + second
    entry = int(keyed_uniform(key, ENTRY_STREAM, 0, 0) * scenario.n_entries)
    if search.chosen_entry > 0:
        entry = search.chosen_entry - 1
    search.chosen_place = search.chosen_entry = search.chosen_day = 0
    search.n_forbidden = scenario.n_forbidden
    enter(search, key, day, arrival, midnight, int64s(scenario.entries)[entry])


@kernel
def enter(search: Any, key: np.uint64, day: int, arrival: float, midnight: float, vertex: int) -> None:
    """Begin a search of the record's scenario at a time and a vertex, without observations.

    Args:
        search: a SEARCH record with `scenario`, `place` and `n_forbidden`.
        key: key of the world.
        day: index of the weekday or recorded day among the scenario's.
        arrival: s since Monday 00:00.
        midnight: beginning of that day, s since Monday 00:00.
        vertex: vertex of the entry.
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
    """Write the day error of the forecast, unless the prior is external."""
    scenario, day_error = scenario_at(search.scenario, 0), float32s(search.day_error)
    if scenario.prior_kind == LOG_KIND:
        day = worlds.recorded_day_at(scenario.prior, search.day)
        day_error[0], day_error[1] = worlds.recorded_day_level(day, search.second_of_day), 0.0
    elif scenario.prior_kind == PROCESS_KIND:
        for i in range(2):
            day_error[i] = worlds.process_at(scenario.prior, 0).day_error[i]


@kernel
def clear_slots(search: Any) -> None:
    """Remove all slots from their columns."""
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
    """Move the car, or attempt to park."""
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
def parking_cost_s(search: Any, slot: int) -> float:
    """Return what parking in a slot costs the driver, s: what the lot says, and the price of the stay."""
    scenario = scenario_at(search.scenario, 0)
    if search.zone_cost_s == 0:
        return float(float64s(scenario.parking_cost_s)[slot])
    zone = int64s(scenario.zone_of_slot)[slot]
    return float(float64s(scenario.lot_cost_s)[slot] + float64s(search.zone_cost_s)[zone])


@inlined
def is_forbidden(search: Any, slot: int) -> bool:
    """Return whether the driver may not park in a slot."""
    return bool(parking_cost_s(search, slot) == np.inf)


@inlined
def clear_step(search: Any) -> None:
    """Begin a step: it costs nothing yet, and nothing is observed."""
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
    """Return the sum of `costs` of a SEARCH or CAR record, s."""
    seconds = 0.0
    for term in range(N_TERMS):
        seconds += record.costs[term]
    return seconds


# ---- what is observed


@inlined
def observe(search: Any) -> None:
    """Observe the slots in view with the scenario's sensor model."""
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


@kernel
def observe_live(search: Any) -> None:
    """Take in the live counts of facilities; those in view are known exactly.

    A full facility is an observation of a taken slot, another one of a free slot, with P(full) on arrival there. Where
    that is above the forecast although there is room, the forecast rises to it.
    """
    scenario, live = scenario_at(search.scenario, 0), int64s(scenario_at(search.scenario, 0).live)
    for i in range(scenario.n_live):
        slot = live[i]
        column = column_of(search, slot)
        record, k = slot_at(search.slots, column), column & (BLOCK_SIZE - 1)
        block = block_at(search.blocks, column >> BLOCK_BITS)
        in_view = record.observed and block.observed_at[k] == search.time
        if in_view or (search.n_forbidden > 0 and is_forbidden(search, slot)):
            continue
        if scenario.world_kind != SHARED_KIND:
            taken = is_taken(search, column, search.time)
            set_belief(search, column, taken, 1.0 if taken else 0.0)
            continue
        world = shared_world_at(search.world, 0)
        counted = counted_at(world.counted, slot - world.first_counted)
        publish_count(counted, search.time)
        age_s = search.time - counted.period * counted.delay_s if counted.delay_s > 0.0 else 0.0
        n_vertices = scenario.n_vertices
        ahead_s = age_s + float64s(scenario.live_drive_s)[n_vertices * i + search.vertex]
        forecast, _ = forecast_of(search, slot)
        p = p_full(forecast, counted.published, counted.capacity, scenario.turnover * ahead_s)
        taken = counted.published >= counted.capacity
        block.prior[k] = forecast if taken else max(forecast, p)
        if search.belief != 0:
            float32s(search.belief)[FORECAST * search.width + slot] = block.prior[k]
        set_belief(search, column, taken, max(p, forecast + _ABOVE * (1.0 - forecast)) if taken else p)


@kernel
def p_full(forecast: float, count: float, capacity: float, age: float) -> float:
    """Return P(a counted facility is full) some time after its count was taken.

    Each car leaves at rate 1 and new ones come as fast as they would fill the facility on average, so the count
    reverts to its mean: it is binomial of what stays, e^-age, plus Poisson of what has come. Its law is taken as
    normal, and the normal one as logistic (error below 0.01); the mean is the one at which a facility is full as often
    as the forecast says. At age 0 the count decides, and in the long run the forecast.

    Args:
        forecast: P(full) without a count, in (0, 1).
        count: number of cars.
        capacity: number of cars that fit.
        age: time since then, in mean stays.
    """
    forecast = min(max(forecast, worlds.MIN_PROBABILITY), worlds.MAX_PROBABILITY)
    z = math.log(forecast / (1.0 - forecast)) / _LOGISTIC
    root = 0.5 * (z + math.sqrt(z * z + 4.0 * (capacity - 0.5)))
    stay = math.exp(-age)
    mean = count * stay + root * root * (1.0 - stay)
    variance = (1.0 - stay) * (count * stay + root * root)
    above = mean - capacity + 0.5
    if variance <= 0.0 or abs(above) > _SURE * math.sqrt(variance):
        return 1.0 if above > 0.0 else 0.0
    return 1.0 / (1.0 + math.exp(-_LOGISTIC * above / math.sqrt(variance)))


@inlined
def publish_count(counted: Any, time: float) -> None:
    """Publish the count of a facility as of the last time when that was due; call before it changes."""
    if counted.delay_s == 0.0:
        counted.published = counted.n_cars
    elif math.floor(time / counted.delay_s) > counted.period:
        counted.published, counted.period = counted.n_cars, math.floor(time / counted.delay_s)


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
def observe_changed(search: Any, slot: int) -> int:
    """Observe the true state of a slot that may have changed; returns its column."""
    column: int = column_of(search, slot)
    taken = is_taken(search, column, search.time)
    set_belief(search, column, taken, 1.0 if taken else 0.0)
    return column


@kernel
def observe_noisy(search: Any) -> None:
    """Observe the slots in view with misses and errors."""
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
    """Observe without error whether a slot is taken, by an attempt to park in it."""
    set_belief(search, column, taken, 1.0 if taken else 0.0)
    add_observed(search, slot_at(search.slots, column).slot, taken, 1.0, 0.0)


@inlined
def add_observed(search: Any, slot: int, taken: bool, hit_rate: float, false_alarm_rate: float) -> None:
    """Add a slot to what the step observed, if that is kept."""
    if search.step_observed != 0:
        write_observed(search, search.n_step_observed, slot, taken, hit_rate, false_alarm_rate)
        search.n_step_observed += 1


@inlined
def write_observed(
    search: Any, n: int, slot: float, taken: float, hit_rate: float, false_alarm_rate: float
) -> None:
    """Write an entry of `step_observed`."""
    rows, most = float32s(search.step_observed), search.most_observed
    rows[n], rows[most + n], rows[2 * most + n], rows[3 * most + n] = slot, taken, hit_rate, false_alarm_rate


@kernel
def mark_passed(search: Any) -> None:
    """Count the slot that the car stops at, once per search."""
    if search.vertex < scenario_at(search.scenario, 0).n_slots:
        record = slot_at(search.slots, column_of(search, search.vertex))
        if not record.passed:
            record.passed = True
            search.slots_passed += 1


# ---- the belief


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
    """Return the current belief in the slot of a column."""
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
    """Compute the current belief in all slots with a column."""
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


# ---- the truth and the forecast


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


@inlined
def init_prior(search: Any) -> None:
    """Initialise the full belief, if it is kept, with the forecast of every slot; take in live counts."""
    if search.belief != 0:
        _init_full_prior(search)
    if scenario_at(search.scenario, 0).n_live > 0:
        observe_live(search)
        refresh_belief(search)


@kernel
def _init_full_prior(search: Any) -> None:
    """Initialise the full belief with the forecast of every slot."""
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


# ---- slots that many cars share


@kernel
def is_shared_slot_taken(address: int, slot: int, time: float) -> bool:
    """Return whether a slot is taken at a time, s; times must not decrease between calls.

    Args:
        address: address of the SHARED_WORLD record.
        slot: index of the slot.
        time: s since Monday 00:00.
    """
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
    """Return whether a car may park in a slot at a time, s: it is free, and no other car waits for it."""
    held_by = shared_slot_at(shared_world_at(address, 0).slots, slot).held_by
    return bool(held_by in (NO_CAR, car) and not is_shared_slot_taken(address, slot, time))


@inlined
def leaves_soon(world: Any, slot: int, time: float, soon_s: float) -> bool:
    """Return whether the car in a slot, of the fleet or a resident, leaves within `soon_s` s after a time, s."""
    leaves_at = shared_slot_at(world.slots, slot).leaves_at
    return bool(time < leaves_at <= time + soon_s)


@inlined
def _background_state(world: Any, slot: int, shared: Any, time: float) -> bool:
    """Return whether the scenario's own world takes a slot at a time."""
    if time >= shared.valid_until:
        worlds.find_state(world.world_kind, world.world, world, slot, shared, time)
    return bool(shared.occupied)


@kernel
def empty_shared_slots(address: int) -> None:
    """Begin a world: no car of the fleet is parked, and residents are where the background has cars at the arrival.

    Args:
        address: address of the SHARED_WORLD record.
    """
    world = shared_world_at(address, 0)
    worlds.begin_day(world.world_kind, world.world, world)
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
            shared.leaves_at = worlds.find_end_of_stay(
                world.world_kind, world.world, world, slot, shared, world.arrival
            )


@kernel
def shared_slots_taken_at(address: int, time: float, taken: NDArray[np.bool_]) -> None:
    """Write whether each slot, (n_slots,), is taken at a time, s; times must not decrease between calls."""
    for slot in range(len(taken)):
        taken[slot] = is_shared_slot_taken(address, slot, time)
