"""The compiled hidden occupancy: whether a slot is taken at a time.

In a process, every slot is a two-state Markov chain whose random numbers are a pure function of (key, slot, sojourn):
a state can be computed for any slot at any time in any order. A recorded day is read from a log; a world of the user's
own is asked by the addresses of its functions. The worlds of `parkenv.world`, the search environment and its batch all
call these functions; only slots that a fleet shares are looked up before (`engine.search_belief`).

A *sojourn* is a period in which the state of a slot does not change.
"""

import math
from typing import Any

import numpy as np

from parkenv.compiled.jit import compiled, inlined, kernel
from parkenv.compiled.keyed_random import (
    ARRIVAL_STREAM,
    DAY_STREAM,
    LEAD_STREAM,
    OCCUPANCY_STREAM,
    keyed_exponential,
    keyed_uniform,
)
from parkenv.compiled.memory import (
    ADDRESS,
    call_world_at,
    float64s,
    int64s,
    part_of,
    prefetch,
    record_at,
    uint8s,
)
from parkenv.world.occupancy.centred_logits import TABLE_ROWS, TABLE_STEPS
from parkenv.world.occupancy.decay import decay_factor
from parkenv.world.week import DAY_HOURS, DAY_PERIODS, HOUR_S, PERIOD_S, WEEK_HOURS, WEEK_S

# Forecasts are never certain, so that a planner can recover from a wrong one.
MIN_PROBABILITY = 0.001
MAX_PROBABILITY = 0.999

_NEVER_WEEKS = 1e9
_FORGOTTEN = 1e-17
# Safety factor against rounding for the lower bound of a sojourn's end.
_SAFE = 1.0 - 1e-6
_MOMENT_S = 1e-6

# Kinds of worlds: a generating process; a replayed log; functions at addresses, such as those of a Python class;
# slots that a fleet of cars shares. Kinds of forecasts: the first two, and EXTERNAL_KIND, computed in Python at every
# arrival.
PROCESS_KIND, LOG_KIND, EXTERNAL_KIND, SHARED_KIND = range(4)

# An `OccupancyProcess`.
PROCESS = np.dtype(
    [
        # float64 arrays; a row of the first three is the state before the change.
        ("n_slots", np.int64),
        ("factors", ADDRESS),  # (2, n_slots)
        ("profiles", ADDRESS),  # (2, 168) 1/s
        ("hazards", ADDRESS),  # (2, 169) integrals of the profiles from Monday 00:00 to full hours
        ("hourly_marginals", ADDRESS),  # (168, n_slots) P(taken) at full hours; 0 before it is first needed
        ("centring", ADDRESS),  # see `centring_table`
        ("nearness", ADDRESS),  # (n_slots,), or no address without one
        ("day_error", np.float64, (2,)),  # standard deviations over days of level and slope, logits
        ("flat", np.float64),  # P(taken) of every slot in a `ConstantForecast`; NaN: as the process says
    ],
    align=True,
)

WORLD_FIELDS = [
    ("key", np.uint64),
    ("arrival", np.float64),  # s since Monday 00:00
    ("hour", np.int64),  # of the week, at the arrival
    ("second_of_hour", np.float64),
    ("day_odds", np.float64),  # the day's level, as a factor of the odds
    ("day_slope", np.float64),  # logits
]
WORLD = np.dtype(WORLD_FIELDS, align=True)  # the world of an episode in a process

# A log day replayed on a lot.
RECORDED_DAY = np.dtype(
    [
        ("midnight", np.float64),  # s since Monday 00:00
        # Arrays of `ReplayForecast` and `DayStates`.
        *((name, ADDRESS) for name in ("log_odds", "day_level", "decay_rate", "first", "from_s", "occupied")),
    ],
    align=True,
)

# A world by the addresses of two functions of (int64 data, int64 slot, float64 time, s): whether the slot is taken, 1
# or 0; the earliest time from then on at which it is free, s, infinite if never. They return float64.
FUNCTIONS = np.dtype([("data", np.int64), ("state", ADDRESS), ("next_free", ADDRESS)], align=True)

CURSOR_FIELDS = [
    ("since", np.float64),  # begin of the sojourn, s
    ("valid_until", np.float64),  # s, the state lasts at least until then
    ("sojourn", np.int32),  # its number, from 1; 0 before the first query
    ("occupied", np.bool_),
    ("end_known", np.bool_),  # whether it ends exactly then
]
CURSOR = np.dtype(CURSOR_FIELDS, align=True)  # the computed part of one slot's true state

process_at, world_at = record_at(PROCESS), record_at(WORLD)
recorded_day_at, cursor_at = record_at(RECORDED_DAY), record_at(CURSOR)
functions_at = record_at(FUNCTIONS)
world_of, cursor_of = part_of(WORLD), part_of(CURSOR)  # of records with their fields


@compiled(error_model="numpy")
def hour_of_week(time: float) -> tuple[float, int, float]:
    """Return week, hour of the week and second of the hour of a time, s since Monday 00:00."""
    week = np.floor(time / WEEK_S)
    second = time - week * WEEK_S
    hour = min(int(second // HOUR_S), WEEK_HOURS - 1)
    return week, hour, second - hour * HOUR_S


@kernel
def draw_arrival(key: np.uint64, n_days: int, start_s: float, end_s: float) -> tuple[int, float]:
    """Draw when the search with a key begins, uniform: the index of the day, and the second of the day in a window."""
    day = int(keyed_uniform(key, ARRIVAL_STREAM, 0, 0) * n_days)
    return day, start_s + keyed_uniform(key, ARRIVAL_STREAM, 0, 1) * (end_s - start_s)


@inlined
def begin_day(kind: int, model: int, world: Any) -> None:
    world.day_odds, world.day_slope = 1.0, 0.0
    if kind == PROCESS_KIND and model != 0:
        draw_day(process_at(model, 0), world)


@inlined
def find_state(kind: int, model: int, world: Any, slot: int, cursor: Any, time: float) -> bool:
    """Return whether a slot is taken at a time, s, not before its cursor's sojourn began, and move the cursor.

    `model` is the address of the PROCESS, RECORDED_DAY or FUNCTIONS record of the kind, `world` a WORLD record.
    """
    if kind == LOG_KIND:
        return bool(recorded_state(recorded_day_at(model, 0), slot, cursor, time))
    if kind == EXTERNAL_KIND:
        functions = functions_at(model, 0)
        # `valid_until` stays in the past: the function is asked every time.
        cursor.occupied = call_world_at(functions.state, functions.data, slot, time) != 0.0
        return bool(cursor.occupied)
    return bool(process_state(process_at(model, 0), world, slot, cursor, time))


@inlined
def find_end_of_stay(kind: int, model: int, world: Any, slot: int, cursor: Any, time: float) -> float:
    if kind == EXTERNAL_KIND:
        functions = functions_at(model, 0)
        return float(call_world_at(functions.next_free, functions.data, slot, time))
    if kind == PROCESS_KIND:
        find_sojourn_end(process_at(model, 0), world, slot, cursor)
        return float(cursor.valid_until)
    day = recorded_day_at(model, 0)
    return float(recorded_next_free(day, slot, time - day.midnight) + day.midnight)


@inlined
def shown_s(key: np.uint64, slot: int, end: float, lead_s: float) -> float:
    """Return for how long before the end of its stay a car shows that it leaves, s (see `parkenv.world.cues`)."""
    return float(lead_s * keyed_exponential(key, LEAD_STREAM, slot, np.int64(end * 1000.0)))


@inlined
def draw_day(process: Any, world: Any) -> None:
    world.day_odds, world.day_slope = 1.0, 0.0
    if has_days(process):
        # Box and Muller: two independent normal numbers from two uniform ones.
        radius = math.sqrt(-2.0 * math.log(keyed_uniform(world.key, DAY_STREAM, 0, 0)))
        angle = 2.0 * math.pi * keyed_uniform(world.key, DAY_STREAM, 0, 1)
        world.day_odds = math.exp(process.day_error[0] * radius * math.cos(angle))
        if process.day_error[1] > 0.0:
            world.day_slope = process.day_error[1] * radius * math.sin(angle)


@inlined
def has_days(process: Any) -> bool:
    return bool(process.day_error[0] > 0.0 or process.day_error[1] > 0.0)


@inlined
def _odds_of_day(process: Any, world: Any, slot: int) -> float:
    if process.day_error[1] > 0.0:
        return float(world.day_odds * math.exp(world.day_slope * float64s(process.nearness)[slot]))
    return float(world.day_odds)


@inlined
def _centring_odds(process: Any, slot: int, p: float) -> float:
    """Return the factor of a slot's odds that makes `p` the mean over days, from the table."""
    if process.day_error[1] > 0.0:
        return float(_centring_with_slope(process, slot, p))
    return float(_between(process.centring, p * TABLE_STEPS))


@kernel
def _centring_with_slope(process: Any, slot: int, p: float) -> float:
    near = float64s(process.nearness)[slot]
    row = near * near * TABLE_ROWS
    j = min(int(row), TABLE_ROWS - 1)
    below = process.centring + 8 * j * (TABLE_STEPS + 1)
    low = _between(below, p * TABLE_STEPS)
    high = _between(below + 8 * (TABLE_STEPS + 1), p * TABLE_STEPS)
    return float(low + (row - j) * (high - low))


@inlined
def _between(table: int, place: float) -> float:
    k = min(int(place), TABLE_STEPS - 1)
    low = float64s(table)[k]
    return float(low + (place - k) * (float64s(table)[k + 1] - low))


@kernel
def process_state(process: Any, world: Any, slot: int, cursor: Any, time: float) -> bool:
    if cursor.sojourn == 0:
        _enter_first_sojourn(process, world, slot, cursor)
    while time >= cursor.valid_until:
        if cursor.end_known:
            cursor.since = cursor.valid_until
            cursor.occupied = not cursor.occupied
            cursor.sojourn += 1
            cursor.end_known = False
        find_sojourn_end(process, world, slot, cursor)
    return bool(cursor.occupied)


@kernel
def _enter_first_sojourn(process: Any, world: Any, slot: int, cursor: Any) -> None:
    key, arrival, hour, second = world.key, world.arrival, world.hour, world.second_of_hour
    p, _ = process_forecast(process, hour, second, slot)
    odds = 1.0
    if has_days(process):
        odds = _centring_odds(process, slot, p) * _odds_of_day(process, world, slot)
        occupied = keyed_uniform(key, OCCUPANCY_STREAM, slot, 0) * (p * odds + (1.0 - p)) < p * odds
    else:
        occupied = keyed_uniform(key, OCCUPANCY_STREAM, slot, 0) < p
    cursor.sojourn, cursor.since, cursor.occupied, cursor.end_known = 1, arrival, occupied, False
    # The sojourn ends when its hazard reaches -log(u), which is more than 1 - u; until the hour ends the rate is
    # constant. This bound is usually late enough, so the exact end need not be computed.
    state = 1 if occupied else 0
    factor = float64s(process.factors)[state * process.n_slots + slot]
    rate = factor * float64s(process.profiles)[state * WEEK_HOURS + hour] * (1.0 if occupied else odds)
    lasts = HOUR_S - second
    hazard = (1.0 - keyed_uniform(key, OCCUPANCY_STREAM, slot, 1)) * _SAFE
    if hazard < rate * lasts:
        lasts = hazard / rate
    cursor.valid_until = arrival + lasts - _MOMENT_S


@kernel
def find_sojourn_end(process: Any, world: Any, slot: int, cursor: Any) -> None:
    if cursor.end_known:
        return
    state = 1 if cursor.occupied else 0
    factor = float64s(process.factors)[state * process.n_slots + slot]
    profile = process.profiles + state * WEEK_HOURS * 8
    hazards = process.hazards + state * (WEEK_HOURS + 1) * 8
    end = np.inf
    if factor * float64s(hazards)[WEEK_HOURS] > 0.0:
        hazard = keyed_exponential(world.key, OCCUPANCY_STREAM, slot, np.int64(cursor.sojourn)) / factor
        if has_days(process) and not cursor.occupied:
            end = _taken_on_day(process, world, slot, cursor.since, hazard)
        else:
            end = _time_after(profile, hazards, cursor.since, hazard)
    cursor.valid_until, cursor.end_known = end, True


@kernel
def _time_after(profile: int, hazards: int, since: float, hazard: float) -> float:
    """Return when the hazard of a slot with factor 1, integrated from `since` on, reaches `hazard`.

    `profile` is the address of (168,) rates, 1/s, `hazards` that of their (169,) sums, of which the last is above 0.
    """
    rates, sums = float64s(profile), float64s(hazards)
    week, hour, second = hour_of_week(since)
    target = sums[hour] + rates[hour] * second + hazard
    more_weeks = np.floor(target / sums[WEEK_HOURS])
    if not more_weeks < _NEVER_WEEKS:
        return np.inf
    rest = target - more_weeks * sums[WEEK_HOURS]
    # sums[hour] < rest <= sums[hour + 1], hence a positive rate, except for rounding at the ends.
    hour = min(max(_count_below(hazards, 0, WEEK_HOURS + 1, rest, False) - 1, 0), WEEK_HOURS - 1)
    second = min((rest - sums[hour]) / rates[hour], HOUR_S) if rates[hour] > 0.0 else 0.0
    return max((week + more_weeks) * WEEK_S + hour * HOUR_S + second, since)  # type: ignore[no-any-return]


@kernel
def _taken_on_day(process: Any, world: Any, slot: int, since: float, hazard: float) -> float:
    """As `_time_after`, for arrivals in the world of a day, hour by hour.

    The rate of an hour is centred for the forecast when the hour begins, or at the arrival if that is later.
    """
    _, hour, second = hour_of_week(since)
    hazard /= _odds_of_day(process, world, slot)
    in_first_hour = since < world.arrival - world.second_of_hour + HOUR_S
    time, end, weekly = since, since + (HOUR_S - second), 0.0
    for passed in range(3 * WEEK_HOURS):
        if passed == 0 and in_first_hour:
            p, _ = process_forecast(process, world.hour, world.second_of_hour, slot)
        else:
            p = _marginal_at_full_hour(process, hour, slot)
        rate = float64s(process.profiles)[hour] * _centring_odds(process, slot, p)
        gathered = rate * (end - time)
        if rate > 0.0 and gathered >= hazard:
            return float(min(time + max(hazard, 0.0) / rate, end))
        hazard -= gathered
        # The first hour is not a whole one; the 168 after it are a week.
        weekly += gathered if passed > 0 else 0.0
        if passed == WEEK_HOURS:
            more_weeks = np.floor(hazard / weekly)
            if not more_weeks < _NEVER_WEEKS:
                return np.inf
            hazard -= more_weeks * weekly
            end += more_weeks * WEEK_S
        time, end, hour = end, end + HOUR_S, (hour + 1) % WEEK_HOURS
    return time


@kernel
def _count_below(address: int, begin: int, end: int, value: float, equal_too: bool) -> int:
    """Count the ascending float64 from `begin` to `end` below `value`; equal ones count with `equal_too`."""
    # Own bisection: numpy's takes half a second to compile.
    values, low, high = float64s(address), begin, end
    while low < high:
        middle = (low + high) >> 1
        if values[middle] < value or (equal_too and values[middle] == value):
            low = middle + 1
        else:
            high = middle
    return low - begin


@kernel
def process_law(process: Any, world: Any, slot: int) -> tuple[float, float, float, float, float]:
    """Return P(taken) of a slot at the arrival, given the day, and the rates of its law, 1/s.

    These are of arrival in that hour and in the next, and of departure in both.
    """
    n, hour = process.n_slots, world.hour
    factors, profiles = float64s(process.factors), float64s(process.profiles)
    following = (hour + 1) % WEEK_HOURS
    p, _ = process_forecast(process, hour, world.second_of_hour, slot)
    odds, later_odds = 1.0, 1.0
    if has_days(process):
        of_day = _odds_of_day(process, world, slot)
        odds = _centring_odds(process, slot, p) * of_day
        later_odds = _centring_odds(process, slot, _marginal_at_full_hour(process, following, slot)) * of_day
    arriving = factors[slot] * profiles[hour] * odds
    arriving_later = factors[slot] * profiles[following] * later_odds
    leaving, leaving_later = profiles[WEEK_HOURS + hour], profiles[WEEK_HOURS + following]
    departure = factors[n + slot]
    return (
        p * odds / (p * odds + 1.0 - p),
        arriving,
        arriving_later,
        departure * leaving,
        departure * leaving_later,
    )


@inlined
def prefetch_forecast(address: int, hour: int, slot: int) -> None:
    process = process_at(address, 0)
    prefetch(process.factors + 8 * slot)
    prefetch(process.factors + 8 * (process.n_slots + slot))
    prefetch(process.hourly_marginals + 8 * (hour * process.n_slots + slot))


@inlined
def process_forecast(process: Any, hour: int, second: float, slot: int) -> tuple[float, float]:
    """Return P(taken) of a slot at a second of an hour of the week, and its decay rate there, 1/s."""
    n = process.n_slots
    factors, profiles = float64s(process.factors), float64s(process.profiles)
    arrival = factors[slot] * profiles[hour]
    rate = arrival + factors[n + slot] * profiles[WEEK_HOURS + hour]
    if process.flat >= 0.0:
        return process.flat, rate
    start = _marginal_at_full_hour(process, hour, slot)
    return marginal_later(start, arrival, rate, second), rate


@inlined
def _marginal_at_full_hour(process: Any, hour: int, slot: int) -> float:
    start = float64s(process.hourly_marginals)[hour * process.n_slots + slot]
    if start == 0.0:
        start = _marginal_at_hour(process, hour, slot)
    return float(start)


@inlined
def marginal_later(start: float, arrival: float, rate: float, second: float) -> float:
    """Return P(taken) `second` s after it was `start`, with constant rates of arrival and arrival plus departure."""
    equilibrium = arrival / rate if rate > 0.0 else 0.0
    return float(equilibrium + (start - equilibrium) * decay_factor(rate * second))


@kernel
def _marginal_at_hour(process: Any, now: int, slot: int) -> float:
    """Compute and store P(taken) at the beginning of hour `now` of the week.

    It is the periodic solution of p' = λ(t)(1-p) - μ(t)p. The affine map over the week that ends at `now` is
    accumulated backwards, latest hour first, until earlier hours have no more influence. A slot that never changes has
    no unique solution; it gets 0.5.
    """
    n = process.n_slots
    factors, profiles = float64s(process.factors), float64s(process.profiles)
    p, gain, gathered, forgotten = 0.0, 1.0, 0.0, False
    for back in range(1, WEEK_HOURS + 1):
        hour = (now - back) % WEEK_HOURS
        arrival = factors[slot] * profiles[hour]
        rate = arrival + factors[n + slot] * profiles[WEEK_HOURS + hour]
        if rate > 0.0:
            moved = -math.expm1(-rate * HOUR_S)
            p += gain * (arrival / rate) * moved
            gain *= 1.0 - moved
            gathered += rate * HOUR_S
            if gain < _FORGOTTEN:
                forgotten = True
                break
    if not forgotten:
        p = p / -math.expm1(-gathered) if gathered > 0.0 else 0.5
    float64s(process.hourly_marginals)[now * n + slot] = p
    return p


@kernel
def keep_hourly_marginals(process: Any, hour: int) -> None:
    n = process.n_slots
    start = float64s(process.hourly_marginals)
    missing = 0
    for slot in range(n):
        missing += start[hour * n + slot] == 0.0
    if missing > 0:
        for slot in range(n):
            if start[hour * n + slot] == 0.0:
                _marginal_at_hour(process, hour, slot)


@inlined
def recorded_index(day: Any, slot: int, second: float) -> int:
    begin, end = int64s(day.first)[slot], int64s(day.first)[slot + 1]
    return int(begin + _count_below(day.from_s, begin, end, second, True) - 1)


@kernel
def recorded_state(day: Any, slot: int, cursor: Any, time: float) -> bool:
    k = recorded_index(day, slot, time - day.midnight)
    last = k + 1 >= int64s(day.first)[slot + 1]
    cursor.occupied = uint8s(day.occupied)[k] != 0
    cursor.valid_until = np.inf if last else float64s(day.from_s)[k + 1] + day.midnight - _MOMENT_S
    return bool(cursor.occupied)


@kernel
def recorded_next_free(day: Any, slot: int, second: float) -> float:
    """Return the first second from then on at which a slot is free, infinite if never."""
    k, end, free_from = recorded_index(day, slot, second), int64s(day.first)[slot + 1], second
    while k < end and uint8s(day.occupied)[k] != 0:
        k += 1
        free_from = float64s(day.from_s)[k] if k < end else np.inf
    return float(free_from)


@kernel
def recorded_changes(day: Any, slot: int, second: float) -> int:
    taken, changes = uint8s(day.occupied), 0
    for k in range(int64s(day.first)[slot] + 1, recorded_index(day, slot, second) + 1):
        changes += taken[k] != taken[k - 1]
    return changes


@inlined
def _between_periods(values: int, second: float) -> float:
    """Interpolate linearly between the middles of a day's half-hours; the first and the last value hold to midnight."""
    at = min(max(second / PERIOD_S - 0.5, 0.0), DAY_PERIODS - 1.0)
    low = min(int(at), DAY_PERIODS - 2)
    of = float64s(values)
    return float(of[low] + (at - low) * (of[low + 1] - of[low]))


@kernel
def recorded_forecast(day: Any, slot: int, second: float) -> tuple[float, float]:
    logit = _between_periods(day.log_odds + slot * DAY_PERIODS * 8, second)
    p = 1.0 / (1.0 + math.exp(-logit))
    rate = float64s(day.decay_rate)[min(int(second // HOUR_S), DAY_HOURS - 1)]
    return min(max(p, MIN_PROBABILITY), MAX_PROBABILITY), float(rate)


@kernel
def recorded_day_level(day: Any, second: float) -> float:
    return float(_between_periods(day.day_level, second))
