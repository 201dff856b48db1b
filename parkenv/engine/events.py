"""The compiled engine of a world with many cars: events in continuous time.

A car of the fleet is a search of `parkenv.engine.kernel`, with the same steps and the same belief; only the slots
are shared. At each moment the engine first carries out what is over by then: departures, arrivals, and steps,
after which cars observe. Then the cars that have to decide do so one after another, in the order in which their steps
ended. A decision acts at once: of two cars before the same slot the first gets it, the second has a failed attempt.
The next moment is that of the next event.

A counted facility is one slot: a car that parks there stands in line before its barrier, drives inside, and then its
search ends.

A car that manoeuvres, or stands, blocks the vertex where it is. A car that would reach a blocked vertex waits before
it, and blocks the vertex that it comes from, so queues grow backwards. Cars that leave soon show it by their lights; a
car that stands before such a slot holds it against others, until it drives on.

What a car is told counts as observations of its own, so every agent uses it unchanged. Reports from before a car's
arrival count as observations at its arrival, decayed to it; those that have lost half of their value by then are
ignored. Which slot a guidance system has reserved for it, a car reads from its observation (`parkenv.engine.fleet`).
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from parkenv.belief.slot_belief import decay_to_prior
from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.compiled.heap import pop, push
from parkenv.compiled.jit import inlined, kernel
from parkenv.compiled.keyed_random import car_key
from parkenv.compiled.memory import (
    LINE,
    call_at,
    float64_array,
    float64s,
    int32_array,
    int32s,
    int64_array,
    int64s,
    prefetch,
)
from parkenv.engine.kernel import (
    SCENARIO_BYTES,
    clear_step,
    complete_step,
    drive_or_park,
    enter,
    give_up,
    init_prior,
    is_about_to_leave,
    observe,
    publish_count,
    sum_of_costs,
    write_clock,
)
from parkenv.engine.policy import LEAVE, TAKE_SLOT
from parkenv.engine.records import (
    BALKED,
    BLOCK,
    BLOCK_BITS,
    BLOCK_SIZE,
    CAR,
    FULL_KNOWLEDGE,
    GAVE_UP,
    LEFT,
    N_ACTIONS,
    N_TERMS,
    NO_CAR,
    NO_SLOT,
    PARKED,
    RESERVE_KNOWLEDGE,
    SEARCH,
    SEARCHING,
    SHARED_KNOWLEDGE,
    SHARED_SLOT,
    SLOT,
    TRUNCATED,
    block_at,
    car_at,
    counted_at,
    fleet_at,
    live_slot_at,
    report_at,
    scenario_at,
    search_at,
    shared_slot_at,
    slot_at,
    step_at,
)
from parkenv.engine.search_belief import (
    add_observed,
    column_of,
    empty_shared_slots,
    is_taken,
    refresh_belief,
    set_belief_of,
)
from parkenv.world.lot import PARK
from parkenv.world.occupancy.decay import decay_factor
from parkenv.world.occupancy.kernel import EXTERNAL_KIND
from parkenv.world.scenario import EDGE

# Why `advance_at` returned, if not for a car to decide: all searches are over; the time limit; more SEARCH records
# are needed; Python must compute the forecast of the car `pending`; a compiled policy chose an unknown action; more
# room for reports is needed; Python must reserve slots; more room for the steps that are kept is needed.
(
    FINISHED, PAUSED, NEEDS_SEARCH, NEEDS_FORECAST, WRONG_ACTION, NEEDS_REPORTS, NEEDS_RESERVATIONS, NEEDS_STEPS,
) = range(-1, -9, -1)  # fmt: skip

_MANY_STEPS = 64  # cars on their way, from which on their data does not stay in the cache
_SEARCH_AT = int(CAR.fields["search"][1])  # type: ignore[index]
CAR_BYTES, SEARCH_BYTES, SLOT_BYTES = CAR.itemsize, SEARCH.itemsize, SLOT.itemsize
BLOCK_BYTES, SHARED_BYTES, EDGE_BYTES = BLOCK.itemsize, SHARED_SLOT.itemsize, EDGE.itemsize
_HALF_LIFE = 0.6931471805599453
_ON_TICK = 1e-9  # fraction of a tick


@kernel
def clear_live_map(fleet: Any) -> None:
    for slot in range(fleet.n_slots):
        live_slot_at(fleet.live_map, slot).time = -np.inf
    fleet.first_report = fleet.n_reports = 0
    fleet.reservations_stale = True


# ---- shared information


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


# ---- from Python


@kernel
def begin_world_at(address: int) -> None:
    fleet = fleet_at(address, 0)
    empty_shared_slots(address)
    clear_live_map(fleet)
    clear_lanes(fleet)
    fleet.time = fleet.arrival
    fleet.n_steps_to_end = fleet.n_departures = fleet.event_number = fleet.next_car = 0
    fleet.first_ready = fleet.n_ready = 0
    fleet.pending = NO_CAR
    fleet.n_searching = fleet.n_parked = fleet.n_gone = fleet.n_decisions = 0
    fleet.searching_s = fleet.parked_s = 0.0
    fleet.n_kept_steps = 0
    while fleet.next_car < fleet.n_cars and car_at(fleet.cars, fleet.next_car).parked_at >= 0:
        _stand(fleet, fleet.next_car)
        fleet.next_car += 1


@kernel
def _stand(fleet: Any, number: int) -> None:
    car = car_at(fleet.cars, number)
    car.state, car.slot, car.ended_at = PARKED, car.parked_at, fleet.time
    if car.slot >= fleet.first_counted:
        counted_at(fleet.counted, car.slot - fleet.first_counted).n_cars += 1
    else:
        shared = shared_slot_at(fleet.slots, car.slot)
        shared.car, shared.leaves_at = number, fleet.time + car.stay_s
    fleet.n_parked += 1
    _add_departure(fleet, fleet.time + car.stay_s, number)


@kernel
def advance_at(address: int, until: float) -> int:
    """Carry out events and the decisions of compiled policies of a FLEET record until a time, s since Monday 00:00.

    With an infinite time, until all searches are over. Returns the car whose decision, or the end of whose search,
    Python must handle; or a negative number, see `FINISHED`.
    """
    fleet = fleet_at(address, 0)
    while True:
        if fleet.report_capacity > 0 and fleet.n_reports + fleet.n_slots >= fleet.report_capacity:
            return NEEDS_REPORTS
        if fleet.step_capacity > 0 and fleet.n_kept_steps == fleet.step_capacity:
            return NEEDS_STEPS
        if fleet.next_car == fleet.n_cars and fleet.n_steps_to_end + fleet.n_departures + fleet.n_ready == 0:
            break
        if fleet.n_ready > 0 and not _is_due(fleet, fleet.time):
            number = int64s(fleet.ready)[fleet.first_ready]
            car = car_at(fleet.cars, number)
            if fleet.reservations_stale and car.knows == RESERVE_KNOWLEDGE and car.state == SEARCHING:
                return NEEDS_RESERVATIONS
            if car.policy == 0 or car.state != SEARCHING:
                return int(number)
            if not act(fleet, number, call_at(car.policy, address, number)):
                return WRONG_ACTION
            continue
        if until == np.inf and fleet.n_searching == 0 and fleet.next_car == fleet.n_cars:
            return FINISHED
        if not _is_due(fleet, until):
            break
        status = _next_event(fleet)
        if status < 0:
            return int(status)
    if until < np.inf:
        _pass_time(fleet, max(until, fleet.time))
    return PAUSED if fleet.n_searching > 0 or fleet.next_car < fleet.n_cars else FINISHED


@kernel
def act_at(address: int, action: int) -> None:
    fleet = fleet_at(address, 0)
    act(fleet, int64s(fleet.ready)[fleet.first_ready], action)


@kernel
def release_at(address: int) -> None:
    fleet = fleet_at(address, 0)
    number = _first_ready(fleet)
    _free_search(fleet, car_at(fleet.cars, number))


@kernel
def init_forecast_at(address: int) -> None:
    fleet = fleet_at(address, 0)
    search = search_at(car_at(fleet.cars, fleet.pending).search, 0)
    init_prior(search)
    _inform(fleet, fleet.pending)
    fleet.pending = NO_CAR


# ---- events


@inlined
def _is_due(fleet: Any, time: float) -> bool:
    return bool(min(_next_arrival(fleet), _next_departure(fleet), _next_end(fleet)) <= time)


@inlined
def _next_event(fleet: Any) -> int:
    """Carry out the next event; returns a negative number if Python must help first or after it.

    Of events at the same time, departures come first, then arrivals, and then ends of steps in the order in which they
    were added.
    """
    arrival, departure, end = _next_arrival(fleet), _next_departure(fleet), _next_end(fleet)
    if arrival < departure and arrival <= end:
        if fleet.n_free == 0:
            return NEEDS_SEARCH
        _pass_time(fleet, arrival)
        return int(_arrive(fleet))
    _pass_time(fleet, min(departure, end))
    fleet.reservations_stale = True
    if departure <= end:
        number = np.int64(int32s(fleet.departing_cars)[0])
        times, cars, ranks = _heap(fleet, fleet.departure_times, fleet.departing_cars)
        fleet.n_departures = pop(times, cars, fleet.n_departures, ranks)
        _depart(fleet, number)
    else:
        number = np.int64(int32s(fleet.step_cars)[0])
        times, cars, ranks = _heap(fleet, fleet.step_times, fleet.step_cars)
        fleet.n_steps_to_end = pop(times, cars, fleet.n_steps_to_end, ranks)
        if fleet.n_steps_to_end >= _MANY_STEPS:
            _prefetch_next(fleet)
        _reach(fleet, number)
    return 0


@inlined
def _prefetch_next(fleet: Any) -> None:
    cars = int32s(fleet.step_cars)
    for i in range(3, 7):
        prefetch(fleet.cars + CAR_BYTES * np.int64(cars[i]) + _SEARCH_AT)
    for i in range(1, 3):
        address = car_at(fleet.cars, np.int64(cars[i])).search
        for line in range(0, SEARCH_BYTES, LINE):
            prefetch(address + line)
    search = search_at(car_at(fleet.cars, np.int64(cars[0])).search, 0)
    scenario, vertex, block = scenario_at(search.scenario, 0), search.vertex, search.n_columns >> BLOCK_BITS
    prefetch(scenario.edges + EDGE_BYTES * N_ACTIONS * vertex)
    prefetch(search.slots + SLOT_BYTES * search.n_columns)
    for line in range(0, BLOCK_BYTES, LINE):
        prefetch(search.blocks + BLOCK_BYTES * block + line)
    first = int64s(scenario.view_starts)[vertex]
    if first < int64s(scenario.view_starts)[vertex + 1]:
        slot = int64s(scenario.viewed)[first]
        prefetch(search.columns + 4 * slot)
        prefetch(fleet.slots + SHARED_BYTES * slot)


@inlined
def _next_arrival(fleet: Any) -> float:
    return float(car_at(fleet.cars, fleet.next_car).arrival if fleet.next_car < fleet.n_cars else np.inf)


@inlined
def _next_departure(fleet: Any) -> float:
    return float(float64s(fleet.departure_times)[0] if fleet.n_departures > 0 else np.inf)


@inlined
def _next_end(fleet: Any) -> float:
    return float(float64s(fleet.step_times)[0] if fleet.n_steps_to_end > 0 else np.inf)


@inlined
def _add_departure(fleet: Any, time: float, number: int) -> None:
    times, cars, ranks = _heap(fleet, fleet.departure_times, fleet.departing_cars)
    _rank(fleet, number)
    fleet.n_departures = push(times, cars, fleet.n_departures, time, number, ranks)


@inlined
def _add_end(fleet: Any, time: float, number: int) -> None:
    times, cars, ranks = _heap(fleet, fleet.step_times, fleet.step_cars)
    _rank(fleet, number)
    fleet.n_steps_to_end = push(times, cars, fleet.n_steps_to_end, time, number, ranks)


@inlined
def _rank(fleet: Any, number: int) -> None:
    int64s(fleet.event_ranks)[number] = fleet.event_number
    fleet.event_number += 1


@inlined
def _heap(fleet: Any, times: int, cars: int) -> tuple[FloatArray, NDArray[np.int32], IntArray]:
    n = fleet.n_cars
    return float64_array(times, (n,)), int32_array(cars, (n,)), int64_array(fleet.event_ranks, (n,))


@inlined
def _pass_time(fleet: Any, time: float) -> None:
    elapsed = time - fleet.time
    fleet.searching_s += fleet.n_searching * elapsed
    fleet.parked_s += fleet.n_parked * elapsed
    fleet.time = time


@kernel
def _arrive(fleet: Any) -> int:
    number = fleet.next_car
    fleet.next_car += 1
    car = car_at(fleet.cars, number)
    fleet.n_free -= 1
    car.search = int64s(fleet.free_searches)[fleet.n_free]
    car.target, car.n_moves, car.informed_until = NO_SLOT, 0, -np.inf
    fleet.reservations_stale = True
    search = search_at(car.search, 0)
    search.scenario_index, search.car = car.scenario_index, number
    search.walks, search.n_forbidden = car.walks, car.n_forbidden
    search.zone_cost_s = fleet.zone_cost_s
    if fleet.zone_cost_s != 0:
        search.zone_cost_s += 8 * fleet.n_zones * number
    car.vertex, car.stands, car.holds = car.entry, False, NO_SLOT
    search.scenario = fleet.scenarios + car.scenario_index * SCENARIO_BYTES
    enter(search, car_key(fleet.key, number), fleet.day, car.arrival, fleet.midnight, car.entry)
    if car.knows == RESERVE_KNOWLEDGE:
        search.reserved = NO_SLOT
    car.state = SEARCHING
    fleet.n_searching += 1
    _make_ready(fleet, number)
    write_clock(search)
    if scenario_at(search.scenario, 0).prior_kind == EXTERNAL_KIND:
        fleet.pending = number
        return NEEDS_FORECAST
    init_prior(search)
    _inform(fleet, number)
    return 0


@kernel
def _reach(fleet: Any, number: int) -> None:
    car = car_at(fleet.cars, number)
    search = search_at(car.search, 0)
    if search.parked:
        complete_step(search)
        _end_search(fleet, number, PARKED)
        _add_departure(fleet, fleet.time + car.stay_s, number)
        return
    until = blocked_until(fleet, car, number)
    if until > fleet.time:
        _queue(fleet, car, search, number, until)
        return
    observe(search)
    if car.shares:
        report_view(fleet, search)
    inform(fleet, number)
    complete_step(search)
    leaves = search.reserved == NO_SLOT and scenario_at(search.scenario, 0).leave_full_lot
    if leaves and not search.over:
        give_up(search)
    if search.over:
        _end_search(fleet, number, GAVE_UP)
    elif search.time - search.arrival >= car.patience_s:
        give_up(search)
        _end_search(fleet, number, BALKED)
    elif search.n_steps >= fleet.max_steps:
        _end_search(fleet, number, TRUNCATED)
    else:
        _make_ready(fleet, number)


@inlined
def _queue(fleet: Any, car: Any, search: Any, number: int, until: float) -> None:
    car.queues_since = min(car.queues_since, fleet.time)
    before = search.step_drive_s
    search.step_drive_s += until - fleet.time
    search.time = until
    if fleet.tick_s > 0.0:
        _round_up(fleet, search)
    car.queued_s += search.step_drive_s - before
    block_lane(fleet, search.previous_vertex, search.time, number)
    _add_end(fleet, search.time, number)


@inlined
def _inform(fleet: Any, number: int) -> None:
    inform(fleet, number)
    refresh_belief(search_at(car_at(fleet.cars, number).search, 0))


@inlined
def _depart(fleet: Any, number: int) -> None:
    car = car_at(fleet.cars, number)
    if car.slot >= fleet.first_counted:
        counted = counted_at(fleet.counted, car.slot - fleet.first_counted)
        publish_count(counted, fleet.time)
        counted.n_cars -= 1
    else:
        shared_slot_at(fleet.slots, car.slot).car = NO_CAR
        block_lane(fleet, car.slot, fleet.time + fleet.manoeuvre_s, number)
    if car.shares:
        report_slot(fleet, car.slot, False, 1.0, 0.0, 0.0)
    car.state, car.left_at = LEFT, fleet.time
    fleet.n_parked -= 1
    fleet.n_gone += 1


# ---- decisions


@kernel
def act(fleet: Any, number: int, action: int) -> bool:
    car = car_at(fleet.cars, number)
    search = search_at(car.search, 0)
    if not (LEAVE <= action < N_ACTIONS or TAKE_SLOT <= action < TAKE_SLOT + fleet.n_slots):
        return False
    _first_ready(fleet)
    fleet.n_decisions += 1
    fleet.reservations_stale = True
    if action == LEAVE:
        clear_step(search)
        give_up(search)
        _end_search(fleet, number, BALKED)
        return True
    if action >= TAKE_SLOT:
        search.vertex = action - TAKE_SLOT
        action = PARK
    origin = search.vertex
    car.queues_since = np.inf
    drive_or_park(search, action)
    car.stands, car.vertex = search.vertex == car.vertex, search.vertex
    if search.parked and search.vertex >= fleet.first_counted:
        _enter_facility(fleet, car, search, number)
        return True
    if search.parked:
        complete_step(search)
        shared = shared_slot_at(fleet.slots, search.vertex)
        shared.car, shared.leaves_at = number, fleet.time + car.stay_s
        block_lane(fleet, search.vertex, fleet.time + fleet.manoeuvre_s, number)
        car.slot = search.vertex
        if car.shares:
            report_slot(fleet, car.slot, True, 1.0, 0.0, 1.0)
        _end_search(fleet, number, PARKED)
        _add_departure(fleet, fleet.time + car.stay_s, number)
        return True
    if fleet.tick_s > 0.0:
        _round_up(fleet, search)
    if car.stands:
        hold_slot(fleet, car, number)
        block_lane(fleet, search.vertex, search.time, number)
    else:
        release_slot(fleet, car)
    _add_end(fleet, search.time, number)
    if fleet.step_capacity > 0:
        step = step_at(fleet.steps, fleet.n_kept_steps)
        step.car, step.begin, step.end = number, fleet.time, search.time
        step.origin, step.vertex, step.failed = origin, search.vertex, search.step_failed_s > 0.0
        fleet.n_kept_steps += 1
    return True


@kernel
def _enter_facility(fleet: Any, car: Any, search: Any, number: int) -> None:
    """Let a car into a counted facility with room: it waits before the barrier, and drives to a space inside.

    Its place counts as taken from now on; its stay begins, and its search ends, when it has reached the space.
    """
    counted = counted_at(fleet.counted, search.vertex - fleet.first_counted)
    publish_count(counted, fleet.time)
    empty_s, full_s = counted.inside_s[0], counted.inside_s[1]
    inside_s = empty_s + (full_s - empty_s) * (counted.n_cars / counted.capacity)
    counted.n_cars += 1
    car.slot, search.previous_vertex = search.vertex, search.vertex
    if car.shares:
        is_full = counted.n_cars >= counted.capacity
        report_slot(fleet, car.slot, is_full, 1.0, 0.0, 1.0 if is_full else 0.0)
    opens = max(fleet.time, counted.gate_free_at)
    counted.gate_free_at = opens + counted.gate_s
    car.queued_s += opens - fleet.time
    search.step_drive_s = opens - fleet.time + counted.gate_s + inside_s
    search.time = fleet.time + search.step_drive_s
    if fleet.tick_s > 0.0:
        _round_up(fleet, search)
    _add_end(fleet, search.time, number)


@inlined
def _round_up(fleet: Any, search: Any) -> None:
    begin = fleet.arrival
    ticks = max(
        math.ceil((search.time - begin) / fleet.tick_s - _ON_TICK),
        math.floor((fleet.time - begin) / fleet.tick_s + 0.5) + 1.0,
    )
    later = begin + ticks * fleet.tick_s
    search.step_drive_s += later - search.time
    search.time = later


@kernel
def _end_search(fleet: Any, number: int, state: int) -> None:
    car = car_at(fleet.cars, number)
    search = search_at(car.search, 0)
    car.state, car.ended_at = state, fleet.time
    for term in range(N_TERMS):
        car.costs[term] = search.costs[term]
    car.driven_m, car.walked_m = search.driven_m, search.walked_m
    car.failed_parks, car.slots_passed, car.n_steps = search.failed_parks, search.slots_passed, search.n_steps
    release_slot(fleet, car)
    fleet.n_searching -= 1
    if state == PARKED:
        fleet.n_parked += 1
    else:
        fleet.n_gone += 1
    if state == TRUNCATED:
        car.gave_up_s += scenario_at(search.scenario, 0).give_up_s
    car.total_s = sum_of_costs(car)
    if car.policy == 0:
        _make_ready(fleet, number)
    else:
        _free_search(fleet, car)


@inlined
def _make_ready(fleet: Any, number: int) -> None:
    int64s(fleet.ready)[(fleet.first_ready + fleet.n_ready) % fleet.n_cars] = number
    fleet.n_ready += 1


@inlined
def _first_ready(fleet: Any) -> Any:
    number = int64s(fleet.ready)[fleet.first_ready]
    fleet.first_ready = (fleet.first_ready + 1) % fleet.n_cars
    fleet.n_ready -= 1
    return number


@inlined
def _free_search(fleet: Any, car: Any) -> None:
    int64s(fleet.free_searches)[fleet.n_free] = car.search
    fleet.n_free += 1
    car.search = 0


# ---- how cars get in each other's way


@kernel
def clear_lanes(fleet: Any) -> None:
    until, by = float64s(fleet.blocked_until), int64s(fleet.blocked_by)
    for vertex in range(fleet.n_vertices):
        until[vertex], by[vertex] = -np.inf, NO_CAR


@inlined
def block_lane(fleet: Any, vertex: int, until: float, number: int) -> None:
    if fleet.manoeuvre_s > 0.0:
        at = int64s(fleet.junction_of_vertex)[vertex]
        if until > float64s(fleet.blocked_until)[at]:
            float64s(fleet.blocked_until)[at] = until
            int64s(fleet.blocked_by)[at] = number


@inlined
def blocked_until(fleet: Any, car: Any, number: int) -> float:
    """Return until when another car blocks the vertex that a car has driven to; in the past if none does."""
    if fleet.manoeuvre_s == 0.0 or car.stands:
        return -np.inf
    at = int64s(fleet.junction_of_vertex)[car.vertex]
    return -np.inf if int64s(fleet.blocked_by)[at] == number else float(float64s(fleet.blocked_until)[at])


@inlined
def hold_slot(fleet: Any, car: Any, number: int) -> None:
    """Let a standing car hold the slot before it if the car in it is about to leave, and nobody else holds it."""
    slot, search = car.vertex, search_at(car.search, 0)
    if scenario_at(search.scenario, 0).lead_s > 0.0 and slot < fleet.n_slots:
        shared = shared_slot_at(fleet.slots, slot)
        if shared.held_by == NO_CAR and is_about_to_leave(search, column_of(search, slot), fleet.time):
            shared.held_by, car.holds = number, slot


@inlined
def release_slot(fleet: Any, car: Any) -> None:
    if car.holds != NO_SLOT:
        shared_slot_at(fleet.slots, car.holds).held_by = NO_CAR
        car.holds = NO_SLOT
