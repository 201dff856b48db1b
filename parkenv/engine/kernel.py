"""The compiled search: the effect of an action on the car, its observations and its belief.

`parkenv/Search-v2` and its batch both run this code, so they agree to the bit.

Functions named `..._at` take an address: that of a record of `Searches`, where they are called from Python.
"""

import math
from typing import Any

import numpy as np
from numba.cpython.unsafe.tuple import tuple_setitem
from numba.np.unsafe.ndarray import to_fixed_tuple

from parkenv.belief.cue_belief import MOST_EVIDENCE, freed
from parkenv.belief.slot_belief import bayes_update, decay_to_prior
from parkenv.compiled.arrays import BoolArray, FloatArray, IntArray
from parkenv.compiled.jit import inlined, kernel
from parkenv.compiled.keyed_random import (
    CUE_STREAM,
    ENTRY_STREAM,
    OBSERVATION_STREAM,
    SCENARIO_STREAM,
    VIEW_STREAM,
    episode_key,
    keyed_exponential,
    keyed_uniform,
)
from parkenv.compiled.memory import float32s, float64s, int32s, int64s
from parkenv.engine.records import (
    BLOCK_BITS,
    BLOCK_SIZE,
    FORECAST,
    N_ACTIONS,
    N_TERMS,
    NO_SLOT,
    OBSERVED_AT,
    SCENARIO,
    SENTINEL,
    UNGUIDED,
    block_at,
    counted_at,
    cue_at,
    edge_at,
    scenario_at,
    search_at,
    shared_world_at,
    slot_at,
)
from parkenv.engine.search_belief import (
    apply_observation,
    belief_now,
    column_of,
    end_of_stay,
    forecast_of,
    init_full_prior,
    is_forbidden,
    is_taken,
    leaving_rate,
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
from parkenv.world.occupancy.kernel import (
    EXTERNAL_KIND,
    LOG_KIND,
    PROCESS_KIND,
    SHARED_KIND,
    hour_of_week,
)
from parkenv.world.week import DAY_S

# Names of the numbers that a step returns; metrics are those of the episode so far.
STEP_RESULT = ("reward", *REWARD_TERMS, *METRICS, "over", "vertex")


def read_step(scenario_index: int, result: tuple[Any, ...]) -> tuple[float, bool, int, dict[str, Any]]:
    """Return reward, over, vertex and `info` of a step, from the index of the scenario and numbers of `STEP_RESULT`.

    Written out: with `dict(zip(...))` a step would take a fifth longer.
    """
    (
        reward, drive, failed, walk, parking, gave_up, drive_s, failed_s, walk_s, parking_cost_s, gave_up_s, total_s,
        driven_m, walked_m, failed_parks, slots_passed, parked, over, vertex,
    ) = result  # fmt: skip
    info = {
        "reward_drive": drive, "reward_failed": failed, "reward_walk": walk, "reward_parking": parking,
        "reward_gave_up": gave_up, "drive_s": drive_s, "failed_s": failed_s, "walk_s": walk_s,
        "parking_cost_s": parking_cost_s, "gave_up_s": gave_up_s, "total_s": total_s, "driven_m": driven_m,
        "walked_m": walked_m, "failed_parks": failed_parks, "slots_passed": slots_passed, "parked": parked,
        "scenario_index": scenario_index,
    }  # fmt: skip
    return reward, over, vertex, info


_LOGISTIC = 1.702  # the logistic law of z times this is closest to the normal one
_LEAST_P = 1e-6
_MOST_TRIES = 10_000
_SURE = 8.0  # standard deviations beyond which a facility is surely full, or not
_ABOVE = 1e-3  # how far above its forecast a facility is at least whose count says that it is full
SCENARIO_BYTES = SCENARIO.itemsize
_DAY_BYTES = worlds.RECORDED_DAY.itemsize

# ---- one search, from Python


@kernel
def begin_search_at(address: int) -> None:
    """Begin the next episode; then call `init_full_prior_at` for an external prior, `observe_live_at` for live counts.

    These are separate functions so that only what is in use is compiled.
    """
    search = search_at(address, 0)
    arrive(search)
    write_clock(search)
    if scenario_at(search.scenario, 0).prior_kind != EXTERNAL_KIND:
        init_full_prior(search)


@kernel
def init_full_prior_at(address: int) -> None:
    """Initialise the belief with the forecast in `Searches.external_forecast`."""
    init_full_prior(search_at(address, 0))


@kernel
def observe_live_at(address: int) -> None:
    """Observe the live counts."""
    search = search_at(address, 0)
    observe_live(search)
    refresh_belief(search)


# One function for each kind of sensor, so that only the kind in use is compiled. Exact is what `observes_exactly` says:
# no errors, no live counts and no cues, so that no car is in the way.


@kernel
def step_exact_at(address: int, action: int) -> tuple[Any, ...]:
    search = search_at(address, 0)
    drive_or_park(search, action)
    if not search.parked:
        observe_exact(search)
    return complete_step(search)  # type: ignore[no-any-return]


@kernel
def step_noisy_at(address: int, action: int) -> tuple[Any, ...]:
    search = search_at(address, 0)
    act(search, action)
    if not search.parked:
        observe_otherwise(search)
    return complete_step(search)  # type: ignore[no-any-return]


# ---- the parts of a step from Python, for environments that drive or observe differently


@kernel
def act_at(address: int, action: int) -> None:
    act(search_at(address, 0), action)


@kernel
def set_step_time_at(address: int, begin: float, drive_s: float, failed_s: float) -> None:
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
def apply_cues_at(address: int, slots: IntArray, hit_rate: FloatArray, false_alarm_rate: FloatArray) -> None:
    """Update the belief in cars about to leave, from what was seen of slots that have just been observed.

    The rates, (k,) contiguous each, are P(what was seen | about to leave) and P(it | not), up to a common factor.
    """
    search = search_at(address, 0)
    for i in range(slots.size):
        apply_cue(search, column_of(search, slots[i]), True, hit_rate[i], false_alarm_rate[i])


@kernel
def set_taken_at(address: int, slot: int) -> None:
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
        write_observed(search, n, float(slot), 1.0, 1.0, 0.0)
        search.n_step_observed = max(search.n_step_observed, n + 1)


@kernel
def finish_step_at(address: int) -> tuple[Any, ...]:
    return complete_step(search_at(address, 0))  # type: ignore[no-any-return]


@kernel
def step_result_at(address: int) -> tuple[Any, ...]:
    return step_result(search_at(address, 0))  # type: ignore[no-any-return]


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
    finish_step(search)
    refresh_belief(search)
    write_clock(search)
    return step_result(search)  # type: ignore[no-any-return]


@inlined
def step_result(search: Any) -> tuple[Any, ...]:
    """Return the numbers named by `STEP_RESULT`.

    Compiled code makes a plain tuple six times as fast as a named one.
    """
    terms = to_fixed_tuple(search.step_costs, N_TERMS)
    for term in range(N_TERMS):
        terms = tuple_setitem(terms, term, -search.step_costs[term])
    return (  # type: ignore[no-any-return]
        (-step_cost_s(search),) + terms + to_fixed_tuple(search.costs, N_TERMS) + (  # noqa: RUF005 - for numba
            sum_of_costs(search), search.driven_m, search.walked_m, search.failed_parks, search.slots_passed,
            search.parked, search.over, search.vertex,
        )
    )  # fmt: skip


@inlined
def step_cost_s(search: Any) -> float:
    seconds = 0.0
    for term in range(N_TERMS):
        seconds += search.step_costs[term]
    return seconds


@kernel
def arrive(search: Any) -> None:
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
    worlds.begin_day(scenario.world_kind, scenario.world, worlds.world_of(search))
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
    """Act, observe and add the costs; unlike `complete_step`, refresh neither the belief nor the clock."""
    act(search, action)
    if not search.parked:
        observe(search)
    finish_step(search)


@inlined
def write_clock(search: Any) -> None:
    search.clock[0], search.clock[1] = search.time, search.time - search.arrival


@inlined
def act(search: Any, action: int) -> None:
    """Drive or park, and wait for a car that moves out of the slot at the new vertex; fleets block lanes instead."""
    vertex, begin = search.vertex, search.time
    drive_or_park(search, action)
    if search.vertex != vertex and scenario_at(search.scenario, 0).moving_s > 0.0:
        search.step_drive_s += in_the_way_s(search)
        search.time = begin + search.step_drive_s


@kernel
def drive_or_park(search: Any, action: int) -> None:
    """Drive along an edge or attempt to park: the costs, time and state of a step, without observing slots in view."""
    scenario, vertex = scenario_at(search.scenario, 0), search.vertex
    edge = edge_at(scenario.edges, vertex * N_ACTIONS + action)
    clear_step(search)
    if search.cues != 0:
        for slot in range(scenario.n_slots):
            float32s(search.cues)[2 * search.width + slot] = 0.0
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
    scenario = scenario_at(search.scenario, 0)
    full = search.n_last_observed_taken == scenario.n_slots and scenario.leave_full_lot
    search.step_gave_up_s = scenario.give_up_s if full else 0.0
    search.over = full or search.parked
    for term in range(N_TERMS):
        search.costs[term] += search.step_costs[term]


@inlined
def give_up(search: Any) -> None:
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
    if scenario_at(search.scenario, 0).no_errors:
        observe_exact(search)
    else:
        observe_noisy(search)
    if scenario_at(search.scenario, 0).n_live > 0:
        observe_live(search)
    if scenario_at(search.scenario, 0).lead_s > 0.0:
        observe_cues(search)


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
    """Observe the slots in view with the scenario's rates: keyed draws of whether each is in sight and looks taken."""
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
def observe_cues(search: Any) -> None:
    """Observe which cars are about to leave, of the slots that have just been observed taken (Bayes' rule)."""
    scenario, time = scenario_at(search.scenario, 0), search.time
    viewed, starts = int64s(scenario.viewed), int64s(scenario.view_starts)
    # Keyed by the millisecond: two observations of a car at the same time have the same error.
    millisecond = int(time * 1000.0)
    for i in range(starts[search.vertex], starts[search.vertex + 1]):
        slot = viewed[i]
        column = np.int64(int32s(search.columns)[slot])
        block = block_at(search.blocks, column >> BLOCK_BITS)
        if column == SENTINEL or block.observed_at[column & (BLOCK_SIZE - 1)] != time:
            continue
        hit, false_alarm, seen = scenario.cue_hit_rate, scenario.cue_false_alarm_rate, False
        if slot_at(search.slots, column).observed_taken:
            rate = hit if is_about_to_leave(search, column, time) else false_alarm
            seen = keyed_uniform(search.key, CUE_STREAM, slot, millisecond) < rate
        apply_cue(search, column, seen, hit, false_alarm)


@kernel
def apply_cue(search: Any, column: int, seen: bool, hit_rate: float, false_alarm_rate: float) -> None:
    """Update the belief that a car is about to leave, whose slot has just been observed, whether a cue was seen."""
    record, k, time = slot_at(search.slots, column), column & (BLOCK_SIZE - 1), search.time
    block = block_at(search.blocks, column >> BLOCK_BITS)
    cue, p, prior, decay_rate = (
        cue_at(search.cue_table, column), block.p_observed[k], block.prior[k], block.decay_rate[k]
    )  # fmt: skip
    rate = leaving_rate(search, prior, decay_rate)
    usual, before, excess, evidence = decay_rate * (1.0 - prior) / rate, 0.0, 0.0, 0.0
    if record.observed_taken:
        if cue.excess != 0.0 and cue.at < time:
            # What the earlier cue has left, of the cars that were still expected to be there
            gap = time - cue.at
            there = decay_to_prior(prior, decay_rate, cue.p, gap) - freed(cue.excess, rate, decay_rate, gap)
            before = cue.excess * math.exp(-rate * gap) * p / max(there, _LEAST_P)
        elif cue.at == time:
            before = cue.excess
        about_to = min(max(usual * p + before, 0.0), p)
        excess = bayes_update(about_to, seen, hit_rate, false_alarm_rate) - usual * p
        if_leaves, if_not = (hit_rate, false_alarm_rate) if seen else (1.0 - hit_rate, 1.0 - false_alarm_rate)
        least = math.exp(-MOST_EVIDENCE)
        evidence = math.log(max(if_leaves, least) / max(if_not, least))
    cue.excess, cue.at, cue.p, cue.evidence = excess, time, p, evidence
    if search.cues != 0:
        float32s(search.cues)[record.slot] = excess
        float32s(search.cues)[2 * search.width + record.slot] = evidence


@inlined
def is_about_to_leave(search: Any, column: int, time: float) -> bool:
    return bool(leaves_in_s(search, column, time) < np.inf)


@kernel
def leaves_in_s(search: Any, column: int, time: float) -> float:
    """Return how soon the car in a slot leaves, s, if it shows that it does; else infinity."""
    scenario, slot = scenario_at(search.scenario, 0), np.int64(slot_at(search.slots, column).slot)
    if (search.n_forbidden > 0 and is_forbidden(search, slot)) or not is_taken(search, column, time):
        return np.inf
    key = search.key
    if scenario.world_kind == SHARED_KIND:
        key = shared_world_at(search.world, 0).key
    end = end_of_stay(search, column, time)
    left = end - time
    return float(left if left <= worlds.shown_s(key, slot, end, scenario.lead_s) else np.inf)


@kernel
def in_the_way_s(search: Any) -> float:
    """Return for how long the car that moves out of the slot at the new vertex is in the way, s."""
    scenario = scenario_at(search.scenario, 0)
    slot = search.vertex
    if slot >= scenario.n_slots:
        return 0.0
    if search.n_forbidden > 0 and is_forbidden(search, slot):
        return 0.0
    column = column_of(search, slot)
    left, record = leaves_in_s(search, column, search.time), slot_at(search.slots, column)
    if not record.observed or record.observed_taken != record.occupied:
        # Its state is still to be observed: `observe_exact` takes a valid one for observed.
        record.valid_until, record.end_known = -np.inf, False
    return float(left if left <= scenario.moving_s else 0.0)


@kernel
def draw_departure(search: Any, column: int, announced: bool) -> None:
    """Draw when the car in a slot leaves, given that it is taken now and whether it shows that it leaves.

    Without any sign it first waits until it shows, at the rate of departures (see `cue_belief`). The time from the
    first sign hangs on the key and the millisecond of the departure: the next one that agrees is taken.
    """
    record, k, time = slot_at(search.slots, column), column & (BLOCK_SIZE - 1), search.time
    block, slot = block_at(search.blocks, column >> BLOCK_BITS), np.int64(record.slot)
    shows = block.decay_rate[k] * (1.0 - block.prior[k])
    leaves = leaving_rate(search, block.prior[k], block.decay_rate[k])
    left = keyed_exponential(search.key, CUE_STREAM, slot, -1) / leaves
    if not announced:
        left += keyed_exponential(search.key, CUE_STREAM, slot, -2) / max(shows, _LEAST_P)
    end, lead_s = time + left, scenario_at(search.scenario, 0).lead_s
    for _ in range(_MOST_TRIES):
        if (end - time <= worlds.shown_s(search.key, slot, end, lead_s)) == announced:
            break
        end += 0.001
    record.occupied, record.since, record.valid_until, record.end_known = True, time, end, True


@kernel
def mark_passed(search: Any) -> None:
    if search.vertex < scenario_at(search.scenario, 0).n_slots:
        record = slot_at(search.slots, column_of(search, search.vertex))
        if not record.passed:
            record.passed = True
            search.slots_passed += 1


# ---- live counts of facilities, as observations of a search


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
    """Return P(a counted facility is full) some time, `age` mean stays, after its count was taken.

    Each car leaves at rate 1 and new ones come as fast as they would fill the facility on average, so the count
    reverts to its mean: it is binomial of what stays, e^-age, plus Poisson of what has come. Its law is taken as
    normal, and the normal one as logistic (error below 0.01); the mean is the one at which a facility is full as often
    as the forecast says. At age 0 the count decides, and in the long run the forecast.
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
def init_prior(search: Any) -> None:
    """Initialise the full belief, if it is kept, with the forecast of every slot; take in live counts."""
    init_full_prior(search)
    if scenario_at(search.scenario, 0).n_live > 0:
        observe_live(search)
        refresh_belief(search)
