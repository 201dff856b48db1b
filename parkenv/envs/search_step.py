"""The compiled search: what one action does to the car, the slots in view, and the belief.

`parkenv/Search-v1` and its batch are this code, so they agree to the bit. Nothing in it costs more in a larger lot:
only slots that were touched in a search, that is looked at or asked for, take any memory that has to be reset.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from parkenv.belief.slot_belief import bayes_update, decay_to_prior
from parkenv.envs.search_tables import (
    ARRIVAL_WEEKDAYS,
    ASKED,
    DAY_HEAD,
    ENTRIES,
    FAILURE_S,
    FALSE_ALARM_RATE,
    GIVE_UP_S,
    HAZARDS,
    HIT_RATE,
    LOG,
    LOG_HEAD,
    METRES,
    N_ACTIONS,
    N_ENTRIES,
    N_SLOTS,
    N_WEEKDAYS,
    NUMBERS,
    PER_LOG_SLOT,
    PERFECT,
    PRIOR_KEPT,
    PRIOR_KIND,
    PRIOR_REALS,
    PROCESS,
    PROFILES,
    SECONDS,
    SEEN_RATE,
    TARGETS,
    VIEWED,
    VIEWS,
    WALK_M,
    WALK_S,
    WINDOW_END,
    WINDOW_START,
    WORLD_INTS,
    WORLD_KEPT,
    WORLD_KIND,
    WORLD_REALS,
    SearchTables,
)
from parkenv.world.keyed_random import (
    ARRIVAL_STREAM,
    ENTRY_STREAM,
    OCCUPANCY_STREAM,
    SIGHTING_STREAM,
    VIEW_STREAM,
    episode_key,
    keyed_uniform,
)
from parkenv.world.lot import PARK
from parkenv.world.occupancy import (
    DAY_S,
    HOUR_S,
    MAX_PROBABILITY,
    MIN_PROBABILITY,
    WEEK_HOURS,
    BoolArray,
    FloatArray,
    IntArray,
    holding_end,
    hour_of_week,
    marginal_from,
    marginal_later,
)
from parkenv.world.recorded_occupancy import recorded_forecast
from sim_sensors.compilation import compiled

# Columns of `Search.numbers`, a row a search: times in s, distances in m.
(
    DRIVE_S, FAILED_S, PARKED_WALK_S, GAVE_UP_S, DRIVEN_M, WALKED_M,
    STEP_DRIVE, STEP_FAILED, STEP_WALK, STEP_GAVE_UP,
    ARRIVAL, SECOND_OF_HOUR, SECOND_OF_DAY, TIME, SEEN_FREE, EXPECTED_FREE, REGION,
) = range(17)  # fmt: skip
N_TERMS = 4
N_REGIONS = 4
N_NUMBERS = REGION + N_REGIONS

# Columns of `Search.counts`; those before EPISODE belong to the search under way.
(
    FAILED_PARKS, N_PASSED, PARKED, OVER, VERTEX, BEFORE, N_TOUCHED, N_SEEN, N_KNOWN_TAKEN, STEPS, HOUR, CHOICE, KEY,
    REMEMBERED, EPISODE, SEED_STATE, SCENARIO,
) = range(17)  # fmt: skip
N_COUNTS = SCENARIO + 1

# Numbers of a touched slot in `Search.memory`: forecast, how fast sightings fade, what the last look left of the
# belief, when that was, until when the slot's true state surely lasts, the belief when it was last reckoned. A slot's
# numbers are those at `spot` of its column and these: slots come in blocks of 8, and a block has 8 of the first
# number, 8 of the second and so on. So the belief in 8 slots at once takes no more than a few vector instructions,
# and what a search touches lies close together.
BLOCK_BITS = 3
BLOCK = 1 << BLOCK_BITS
PRIOR, RATE, SAID, LOOKED, UNTIL, BELIEF = (BLOCK * number for number in range(6))
N_MEMORIES = 6
PER_BLOCK = BLOCK * N_MEMORIES

# Marks of a touched slot in `Search.marks`: which one it is; what is below; number of the stretch of its true state, 0
# while nobody knows it. `Search.place` has the column of each slot, NOBODY's if it was not touched: nothing was ever
# seen there, and nothing of it lasts.
WHO, FLAGS, FLIPS = range(3)
N_MARKS = FLIPS + 1
NOBODY = 0
# In FLAGS: it is taken; UNTIL is exactly when that ends; it was seen; it looked taken; the car stopped there.
TAKEN, EXACT, SEEN, LOOKED_TAKEN, PASSED = 1, 2, 4, 8, 16

FORECAST, DECAY_RATE, P_OBSERVED, OBSERVED_AT = range(4)
"""Rows of `Search.belief`."""
NEVER_OBSERVED = -1.0
"""`observed_at` of a slot that was not observed in this search."""
_SAFE = 1.0 - 1e-6
_MOMENT = 1e-6


# Without numba's reference counting, which would take most of a step's time: no kernel here allocates anything.
kernel = compiled(error_model="numpy", _nrt=False)
inlined = compiled(error_model="numpy", _nrt=False, inline="always")


@inlined
def blocks_of(n_columns: int) -> int:
    """How many blocks hold so many columns."""
    return (n_columns + BLOCK - 1) >> BLOCK_BITS


class Search(NamedTuple):
    """Searches under way, one or many, and the tables that they live on.

    Attributes:
        at, ints, reals, kept: as in `SearchTables`.
        numbers: (n, 21) float64.
        counts: (n, 17) int64.
        memory: (n, 48 per block) float64, blocks of 8 columns; a column a touched slot, and the first is NOBODY's.
        marks: (n, m + 1, 3) int32, a column a touched slot, likewise; m is the slots of the largest lot.
        place: (n, m) int32, a slot's column.
        asked: (n, 2, m) float64, forecast and relaxation rate of priors that are asked in Python; (0, 2, 0) without.
        p_occupied: (n, m) float32, belief in every slot now, if it is kept up; (0, 0) if not.
        belief: (n, 4, m) float32, as observed, likewise: forecast, decay rate, belief after the last observation,
            time of it.
    """

    at: IntArray
    ints: NDArray[np.int32]
    reals: FloatArray
    kept: FloatArray
    numbers: FloatArray
    counts: IntArray
    memory: FloatArray
    marks: NDArray[np.int32]
    place: NDArray[np.int32]
    asked: FloatArray
    p_occupied: NDArray[np.float32]
    belief: NDArray[np.float32]

    @classmethod
    def on(cls, tables: SearchTables, scenario_of: IntArray, full_belief: bool) -> Search:
        """Searches that have not begun.

        Args:
            tables: of the scenarios.
            scenario_of: (n,) which scenario each search is in.
            full_belief: whether to keep up `p_occupied` and `belief`.
        """
        n, m = len(scenario_of), int(tables.at[:, N_SLOTS].max())
        counts = np.zeros((n, N_COUNTS), dtype=np.int64)
        counts[:, SCENARIO] = scenario_of
        asked = bool((tables.at[:, PRIOR_KIND] == ASKED).any())
        shape = (n, m) if full_belief else (0, 0)
        # Past the last slot of a smaller lot: taken, never observed, constant.
        belief = np.zeros((shape[0], 4, shape[1]), dtype=np.float32)
        belief[:, FORECAST] = belief[:, P_OBSERVED] = 1.0
        belief[:, OBSERVED_AT] = NEVER_OBSERVED
        return cls(
            *tables,
            np.zeros((n, N_NUMBERS)),
            counts,
            np.zeros((n, blocks_of(m + 1) * PER_BLOCK)),
            np.zeros((n, m + 1, N_MARKS), dtype=np.int32),
            np.zeros((n, m), dtype=np.int32),
            np.zeros((n, 2, m) if asked else (0, 2, 0)),
            np.ones(shape, dtype=np.float32),
            belief,
        )

    def changing(self) -> tuple[NDArray[Any], ...]:
        """The arrays that a step changes."""
        return self[Search._fields.index("numbers") :]


@kernel
def begin(search: Search, e: int) -> None:
    """`arrive`, and foresee what can be foreseen without Python."""
    arrive(search, e)
    if search.at[search.counts[e, SCENARIO], PRIOR_KIND] != ASKED:
        foresee(search, e)


@kernel
def arrive(search: Search, e: int) -> None:
    """Begin search `e` in the world of its seed and episode; nothing has been seen."""
    at, ints, reals, counts, numbers = search.at, search.ints, search.reals, search.counts, search.numbers
    row = counts[e, SCENARIO]
    key = episode_key(np.uint64(counts[e, SEED_STATE]), counts[e, EPISODE])
    choice = int(keyed_uniform(key, ARRIVAL_STREAM, 0, 0) * at[row, N_WEEKDAYS])
    midnight = ints[at[row, ARRIVAL_WEEKDAYS] + choice] * DAY_S
    start, end = reals[at[row, NUMBERS] + WINDOW_START], reals[at[row, NUMBERS] + WINDOW_END]
    arrival = midnight + (start + keyed_uniform(key, ARRIVAL_STREAM, 0, 1) * (end - start))
    _, hour, second = hour_of_week(arrival)
    entry = int(keyed_uniform(key, ENTRY_STREAM, 0, 0) * at[row, N_ENTRIES])
    forget(search, e)
    for i in range(N_NUMBERS):
        numbers[e, i] = 0.0
    for i in range(EPISODE):
        counts[e, i] = 0
    numbers[e, ARRIVAL] = numbers[e, TIME] = arrival
    numbers[e, SECOND_OF_HOUR] = second
    numbers[e, SECOND_OF_DAY] = arrival - midnight
    counts[e, VERTEX] = counts[e, BEFORE] = ints[at[row, ENTRIES] + entry]
    counts[e, HOUR] = hour
    counts[e, CHOICE] = choice
    counts[e, KEY] = np.int64(key)
    counts[e, REMEMBERED] = -1


@kernel
def forget(search: Search, e: int) -> None:
    """Take the touched slots out of their columns."""
    marks, memory, place = search.marks[e], search.memory[e], search.place[e]
    for column in range(1, search.counts[e, N_TOUCHED] + 1):
        place[marks[column, WHO]] = NOBODY
        # Whole blocks are reckoned; what stands still in an empty column is a number in any case.
        memory[spot(column) + RATE] = 0.0


@inlined
def spot(column: int) -> int:
    """Where in `memory` the numbers of a column are."""
    return (column >> BLOCK_BITS) * PER_BLOCK + (column & (BLOCK - 1))


@inlined
def step_one(search: Search, e: int, action: int) -> None:
    """Everything that an action does in search `e`; what it cost is in the STEP columns."""
    drive_or_park(search, e, action)
    if search.counts[e, PARKED] == 0:
        look(search, e)
    settle(search, e)


@inlined
def tell_time(search: Search, e: int, clock: NDArray[np.float32]) -> None:
    """Write the time, s since Monday 00:00, and since the search began, into a clock, (2,)."""
    now = search.numbers[e, TIME]
    clock[0], clock[1] = now, now - search.numbers[e, ARRIVAL]


@inlined
def drive_or_park(search: Search, e: int, action: int) -> None:
    """Move the car, or try to park it."""
    counts, numbers = search.counts, search.numbers
    at = search.at[counts[e, SCENARIO]]
    vertex = counts[e, VERTEX]
    edge = vertex * N_ACTIONS + action
    drive, failed, walk = search.reals[at[SECONDS] + edge], 0.0, 0.0
    numbers[e, DRIVEN_M] += search.reals[at[METRES] + edge]
    target = search.ints[at[TARGETS] + edge]
    if target != vertex:
        counts[e, BEFORE] = vertex
        counts[e, VERTEX] = target
    elif action == PARK and vertex < at[N_SLOTS]:
        if tried(search, e, vertex):
            failed = search.reals[at[NUMBERS] + FAILURE_S]
        else:
            walk = search.reals[at[WALK_S] + vertex]
            numbers[e, WALKED_M] = search.reals[at[WALK_M] + vertex]
    numbers[e, TIME] += drive + failed
    numbers[e, STEP_DRIVE], numbers[e, STEP_FAILED], numbers[e, STEP_WALK] = drive, failed, walk
    counts[e, STEPS] += 1


@inlined
def tried(search: Search, e: int, slot: int) -> bool:
    """Try to park; whether the slot is taken, which is then certain."""
    column = touched(search, e, slot)
    if is_taken(search, e, column, search.numbers[e, TIME]):
        search.counts[e, FAILED_PARKS] += 1
        learn(search, e, column, True, 1.0)
        return True
    search.counts[e, PARKED] = 1
    return False


@inlined
def look(search: Search, e: int) -> None:
    """See the slots in view of the car, as well as the sighting model lets it."""
    if search.at[search.counts[e, SCENARIO], PERFECT] == 1:
        look_perfectly(search, e)
    else:
        look_badly(search, e)


@inlined
def look_perfectly(search: Search, e: int) -> None:
    """See what is there.

    A slot whose state surely has lasted looks as it did before, and needs no more than a new time of the look.
    """
    ints, memory, place = search.ints, search.memory[e], search.place[e]
    row, vertex, time = search.counts[e, SCENARIO], search.counts[e, VERTEX], search.numbers[e, TIME]
    views, viewed = search.at[row, VIEWS] + vertex, search.at[row, VIEWED]
    for i in range(viewed + ints[views], viewed + ints[views + 1]):
        column = np.int64(place[ints[i]])
        if time >= memory[spot(column) + UNTIL]:
            column = see_anew(search, e, ints[i])
        memory[spot(column) + LOOKED] = time
        if len(search.belief) > 0:
            search.belief[e, OBSERVED_AT, ints[i]] = time - search.numbers[e, ARRIVAL]
    pass_by(search, e)


@inlined
def see_anew(search: Search, e: int, slot: int) -> int:
    """See perfectly what stands in a slot where it may have changed; the slot's column."""
    column: int = touched(search, e, slot)
    taken = is_taken(search, e, column, search.numbers[e, TIME])
    learn(search, e, column, taken, 1.0 if taken else 0.0)
    return column


@kernel
def look_badly(search: Search, e: int) -> None:
    """See some of what is there, and some of it wrongly."""
    at, ints, reals, counts = search.at, search.ints, search.reals, search.counts
    row, vertex, time = counts[e, SCENARIO], counts[e, VERTEX], search.numbers[e, TIME]
    key = np.uint64(counts[e, KEY])
    pass_by(search, e)
    views = at[row, VIEWS] + vertex
    for i in range(ints[views], ints[views + 1]):
        slot = ints[at[row, VIEWED] + i]
        # What hides a slot goes on hiding it: one chance a search, which a nearer look may beat.
        if keyed_uniform(key, VIEW_STREAM, slot, 0) >= reals[at[row, SEEN_RATE] + i]:
            continue
        column = touched(search, e, slot)
        hit, false_alarm = reals[at[row, HIT_RATE] + i], reals[at[row, FALSE_ALARM_RATE] + i]
        rate = hit if is_taken(search, e, column, time) else false_alarm
        # By the millisecond: whoever looks at a slot then makes the same error.
        looks_taken = keyed_uniform(key, SIGHTING_STREAM, slot, int(time * 1000.0)) < rate
        learn(
            search,
            e,
            column,
            looks_taken,
            bayes_update(belief_now(search, e, column), looks_taken, hit, false_alarm),
        )


@kernel
def take_in(
    search: Search, e: int, slots: IntArray, looks_taken: BoolArray, hit: FloatArray, false_alarm: FloatArray
) -> None:
    """In place of `look`: what somebody else made of the slots, each (k,)."""
    pass_by(search, e)
    for i in range(slots.size):
        column = touched(search, e, slots[i])
        said = bayes_update(belief_now(search, e, column), looks_taken[i], hit[i], false_alarm[i])
        learn(search, e, column, looks_taken[i], said)


@inlined
def settle(search: Search, e: int) -> None:
    """Give up a lot that is proven full, and add the step to the episode."""
    counts, numbers = search.counts, search.numbers
    row = counts[e, SCENARIO]
    full = counts[e, N_KNOWN_TAKEN] == search.at[row, N_SLOTS]
    gave_up = search.reals[search.at[row, NUMBERS] + GIVE_UP_S] if full else 0.0
    numbers[e, STEP_GAVE_UP] = gave_up
    counts[e, OVER] = int(full or counts[e, PARKED] == 1)
    for term in range(N_TERMS):
        numbers[e, DRIVE_S + term] += numbers[e, STEP_DRIVE + term]


@inlined
def pass_by(search: Search, e: int) -> None:
    """Count the slot that the car stops at, the first time."""
    vertex = search.counts[e, VERTEX]
    if vertex < search.at[search.counts[e, SCENARIO], N_SLOTS]:
        column = touched(search, e, vertex)
        if search.marks[e, column, FLAGS] & PASSED == 0:
            search.marks[e, column, FLAGS] |= PASSED
            search.counts[e, N_PASSED] += 1


@inlined
def learn(search: Search, e: int, column: int, looks_taken: bool, said: float) -> None:
    """Hold `said` of a slot from now on."""
    counts, flags = search.counts, search.marks[e, column, FLAGS]
    if flags & SEEN == 0:
        counts[e, N_SEEN] += 1
        search.numbers[e, SEEN_FREE] += 0.0 if looks_taken else 1.0
        search.numbers[e, EXPECTED_FREE] += 1.0 - search.memory[e, spot(column) + PRIOR]
    looked_taken = LOOKED_TAKEN if looks_taken else 0
    counts[e, N_KNOWN_TAKEN] += int(looks_taken) - int(flags & LOOKED_TAKEN != 0)
    search.marks[e, column, FLAGS] = (flags & ~LOOKED_TAKEN) | looked_taken | SEEN
    search.memory[e, spot(column) + SAID] = said
    search.memory[e, spot(column) + LOOKED] = search.numbers[e, TIME]
    if len(search.belief) > 0:
        slot = search.marks[e, column, WHO]
        search.belief[e, P_OBSERVED, slot] = said
        search.belief[e, OBSERVED_AT, slot] = search.numbers[e, TIME] - search.numbers[e, ARRIVAL]


@inlined
def belief_now(search: Search, e: int, column: int) -> float:
    """The belief in a touched slot, now."""
    memory, at = search.memory[e], spot(column)
    elapsed = search.numbers[e, TIME] - memory[at + LOOKED]
    return float(decay_to_prior(memory[at + PRIOR], memory[at + RATE], memory[at + SAID], elapsed))


@inlined
def renew(search: Search, e: int) -> None:
    """Bring the full belief up to date; only touched slots can have changed."""
    relax_touched(search, e)
    end = search.counts[e, N_TOUCHED] + 1
    memory, marks, out = search.memory[e], search.marks[e], search.p_occupied[e]
    for first in range(0, end, BLOCK):
        # A loop of fixed length, which is unrolled.
        for column in range(first, first + BLOCK):
            if NOBODY < column < end:
                out[marks[column, WHO]] = memory[spot(column) + BELIEF]


@inlined
def relax_touched(search: Search, e: int) -> None:
    """Reckon the belief in all touched slots, now."""
    for block in range(blocks_of(search.counts[e, N_TOUCHED] + 1)):
        relax_block(search.memory[e], block * PER_BLOCK, search.numbers[e, TIME])


@inlined
def relax_block(memory: FloatArray, at: int, time: float) -> None:
    """`decay_to_prior` for the columns of a block that begins at `at`.

    A loop of its own, and of a length that is known beforehand, so that it becomes vector code.
    """
    for column in range(BLOCK):
        i = at + column
        prior, elapsed = memory[i + PRIOR], time - memory[i + LOOKED]
        memory[i + BELIEF] = decay_to_prior(prior, memory[i + RATE], memory[i + SAID], elapsed)


@inlined
def touched(search: Search, e: int, slot: int) -> int:
    """The column of a slot, begun if there is none."""
    column = int(search.place[e, slot])
    if column == NOBODY:
        column = begin_slot(search, e, slot)
    return column


@inlined
def begin_slot(search: Search, e: int, slot: int) -> int:
    """A column for a slot that has none, and in it what is forecast of the slot."""
    marks, counts, memory = search.marks[e], search.counts, search.memory[e]
    column = counts[e, N_TOUCHED] + 1
    counts[e, N_TOUCHED] = column
    search.place[e, slot] = column
    marks[column, WHO], marks[column, FLAGS], marks[column, FLIPS] = slot, 0, 0
    at = spot(column)
    prior, rate = forecast(search, e, slot)
    memory[at + PRIOR] = memory[at + SAID] = memory[at + BELIEF] = prior
    memory[at + RATE] = rate
    memory[at + LOOKED] = search.numbers[e, ARRIVAL]
    memory[at + UNTIL] = 0.0
    return int(column)


@inlined
def is_taken(search: Search, e: int, column: int, time: float) -> bool:
    """The truth about a touched slot at a time that does not come before that of earlier questions, s."""
    if time >= search.memory[e, spot(column) + UNTIL]:
        _find_out(search, e, column, time)
    return bool(search.marks[e, column, FLAGS] & TAKEN != 0)


@inlined
def _find_out(search: Search, e: int, column: int, time: float) -> None:
    """What stands in a slot at a time for which that is not known yet."""
    if search.at[search.counts[e, SCENARIO], WORLD_KIND] == LOG:
        _replay(search, e, column, time)
        return
    if search.marks[e, column, FLIPS] == 0:
        _draw(search, e, column)
    if time >= search.memory[e, spot(column) + UNTIL]:
        _flip(search, e, column, time)


@inlined
def _draw(search: Search, e: int, column: int) -> None:
    """What stood in a slot at the arrival, and until when at least."""
    counts, marks, at = search.counts, search.marks[e, column], search.at[search.counts[e, SCENARIO]]
    slot, key, hour = np.int64(marks[WHO]), np.uint64(counts[e, KEY]), counts[e, HOUR]
    world, n = at[WORLD_REALS], at[N_SLOTS]
    p = search.memory[e, spot(column) + PRIOR]
    # The forecast of the world itself is its marginal, unless that was too sure to be believed.
    own = at[PRIOR_KIND] == PROCESS and at[PRIOR_REALS] == world
    if not (own and MIN_PROBABILITY < p < MAX_PROBABILITY):
        p, _ = _process_marginal(search, e, slot, world, at[WORLD_KEPT])
    state = 1 if keyed_uniform(key, OCCUPANCY_STREAM, slot, 0) < p else 0
    marks[FLIPS] = 1
    marks[FLAGS] |= TAKEN if state == 1 else 0
    # The stretch ends when its hazard has reached -log(u), which is more than 1 - u; until the hour ends the rate
    # is constant. Mostly that is time enough, and spares us to find out when exactly it ends.
    leaving = (
        search.reals[world + PROFILES + HAZARDS + state * n + slot]
        * search.reals[world + state * WEEK_HOURS + hour]
    )
    lasts = HOUR_S - search.numbers[e, SECOND_OF_HOUR]
    hazard = (1.0 - keyed_uniform(key, OCCUPANCY_STREAM, slot, 1)) * _SAFE
    if hazard < leaving * lasts:
        lasts = hazard / leaving
    search.memory[e, spot(column) + UNTIL] = search.numbers[e, ARRIVAL] + lasts - _MOMENT


@kernel
def _flip(search: Search, e: int, column: int, time: float) -> None:
    """Let cars come and go at a slot until `time`, as `OccupancyProcess` has them."""
    marks, memory, reals = search.marks[e, column], search.memory[e], search.reals
    until = spot(column) + UNTIL
    row, slot, key = search.counts[e, SCENARIO], marks[WHO], np.uint64(search.counts[e, KEY])
    world, n = search.at[row, WORLD_REALS], search.at[row, N_SLOTS]
    since = search.numbers[e, ARRIVAL]
    while time >= memory[until]:
        if marks[FLAGS] & EXACT != 0:
            since = memory[until]
            marks[FLAGS] ^= TAKEN
            marks[FLIPS] += 1
        marks[FLAGS] |= EXACT
        state = 1 if marks[FLAGS] & TAKEN != 0 else 0
        profile, table = world + state * WEEK_HOURS, world + PROFILES + state * (WEEK_HOURS + 1)
        memory[until] = holding_end(
            key,
            slot,
            marks[FLIPS],
            since,
            reals[world + PROFILES + HAZARDS + state * n + slot],
            reals[profile : profile + WEEK_HOURS],
            reals[table : table + WEEK_HOURS + 1],
        )


@kernel
def _replay(search: Search, e: int, column: int, time: float) -> None:
    """Read a slot's state off the log, as `RecordedWorld` does."""
    ints, reals, counts = search.ints, search.reals, search.counts
    row, choice = counts[e, SCENARIO], counts[e, CHOICE]
    n, log = search.at[row, N_SLOTS], search.at[row, WORLD_INTS]
    m, n_days, n_records = ints[log], ints[log + 1], ints[log + 2]
    days = log + LOG_HEAD
    record = ints[days + 2 * n * choice + search.marks[e, column, WHO]]
    first = days + 2 * n * n_days
    begin, end = ints[first + record], ints[first + record + 1]
    looks = first + n_records + 1
    per_day = DAY_HEAD + PER_LOG_SLOT * m
    midnight = reals[search.at[row, WORLD_REALS] + choice * per_day]
    from_s = search.at[row, WORLD_REALS] + n_days * per_day
    second = time - midnight
    i = begin + np.searchsorted(reals[from_s + begin : from_s + end], second, side="right") - 1
    flags = search.marks[e, column, FLAGS] & ~TAKEN
    search.marks[e, column, FLAGS] = flags | (TAKEN if ints[looks + i] != 0 else 0)
    until = reals[from_s + i + 1] + midnight - _MOMENT if i + 1 < end else np.inf
    search.memory[e, spot(column) + UNTIL] = until


@inlined
def forecast(search: Search, e: int, slot: int) -> tuple[float, float]:
    """P(taken) that the car foresees for a slot, and how fast sightings of it fade, 1/s."""
    at = search.at[search.counts[e, SCENARIO]]
    if at[PRIOR_KIND] == ASKED:
        return search.asked[e, 0, slot], search.asked[e, 1, slot]
    if at[PRIOR_KIND] == LOG:
        p, rate = _log_forecast(search, e, slot)
    else:
        p, rate = _process_marginal(search, e, slot, at[PRIOR_REALS], at[PRIOR_KEPT])
    return min(max(p, MIN_PROBABILITY), MAX_PROBABILITY), rate


@inlined
def _process_marginal(search: Search, e: int, slot: int, model: int, kept: int) -> tuple[float, float]:
    reals, hour = search.reals, search.counts[e, HOUR]
    n = search.at[search.counts[e, SCENARIO], N_SLOTS]
    start = search.kept[kept + hour * n + slot]
    if start == 0.0:
        start = _marginal_at_hour(reals, search.kept, model, kept, n, hour, slot)
    factors = model + PROFILES + HAZARDS
    arrival = reals[factors + slot] * reals[model + hour]
    rate = arrival + reals[factors + n + slot] * reals[model + WEEK_HOURS + hour]
    return marginal_later(start, arrival, rate, search.numbers[e, SECOND_OF_HOUR]), rate


@kernel
def _marginal_at_hour(
    reals: FloatArray, kept: FloatArray, model: int, first: int, n: int, hour: int, slot: int
) -> float:
    """The marginal of a slot of a process at a full hour, which is kept from now on."""
    factors = model + PROFILES + HAZARDS
    arrivals, departures = reals[model : model + WEEK_HOURS], reals[model + WEEK_HOURS : model + PROFILES]
    come, go, row = reals[factors + slot], reals[factors + n + slot], first + hour * n + slot
    marginal_from(come, go, arrivals, departures, hour, 0.0, kept, row)
    return float(kept[row])


@kernel
def _log_forecast(search: Search, e: int, slot: int) -> tuple[float, float]:
    ints, reals, counts = search.ints, search.reals, search.counts
    row, choice = counts[e, SCENARIO], counts[e, CHOICE]
    n, log = search.at[row, N_SLOTS], search.at[row, WORLD_INTS]
    m = ints[log]
    log_slot = ints[log + LOG_HEAD + 2 * n * choice + n + slot]
    day = search.at[row, WORLD_REALS] + choice * (DAY_HEAD + PER_LOG_SLOT * m)
    share = day + DAY_HEAD
    p = recorded_forecast(
        log_slot,
        search.numbers[e, SECOND_OF_DAY],
        reals[share : share + 24 * m],
        reals[day + 3 : day + DAY_HEAD],
        reals[share + 24 * m : share + PER_LOG_SLOT * m],
        reals[day + 2],
    )
    return p, reals[day + 1]


@kernel
def foresee(search: Search, e: int) -> None:
    """Write the forecast of every slot into the full belief; none has been observed."""
    at, row = search.at, search.counts[e, SCENARIO]
    n = at[row, N_SLOTS]
    _foresee_each(search, e, row, n)
    belief = search.belief[e]
    for s in range(n):
        search.p_occupied[e, s] = belief[P_OBSERVED, s] = belief[FORECAST, s]
        belief[OBSERVED_AT, s] = NEVER_OBSERVED


@inlined
def _foresee_each(search: Search, e: int, row: int, n: int) -> None:
    at = search.at
    if at[row, PRIOR_KIND] != PROCESS:
        for s in range(n):
            search.belief[e, FORECAST, s], search.belief[e, DECAY_RATE, s] = forecast(search, e, s)
        return
    hour, model = search.counts[e, HOUR], at[row, PRIOR_REALS]
    marginals = at[row, PRIOR_KEPT] + hour * n
    missing = 0
    for s in range(n):
        missing += search.kept[marginals + s] == 0.0
    if missing > 0:
        for s in range(n):
            _marginal_at_hour(search.reals, search.kept, model, at[row, PRIOR_KEPT], n, hour, s)
    factors = model + PROFILES + HAZARDS
    _foresee_all(
        search.reals[factors : factors + n],
        search.reals[factors + n : factors + 2 * n],
        search.reals[model + hour],
        search.reals[model + WEEK_HOURS + hour],
        search.kept[marginals : marginals + n],
        search.numbers[e, SECOND_OF_HOUR],
        search.belief[e, FORECAST],
        search.belief[e, DECAY_RATE],
    )


@kernel
def _foresee_all(
    come: FloatArray,
    go: FloatArray,
    coming: float,
    going: float,
    start: FloatArray,
    second: float,
    out: NDArray[np.float32],
    out_rate: NDArray[np.float32],
) -> None:
    """`forecast` of many slots, whose marginals at the full hour are known, by vector instructions."""
    for s in range(len(start)):
        arrival = come[s] * coming
        rate = arrival + go[s] * going
        p = marginal_later(start[s], arrival, rate, second)
        out[s] = min(max(p, MIN_PROBABILITY), MAX_PROBABILITY)
        out_rate[s] = rate
