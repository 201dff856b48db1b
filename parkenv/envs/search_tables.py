"""Scenarios as plain arrays, for the compiled search."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from parkenv.errors import InputError
from parkenv.world.lot import MOVES, PARK
from parkenv.world.occupancy import DAY_S, WEEK_HOURS, OccupancyProcess
from parkenv.world.occupancy_log import weekday_of
from parkenv.world.recorded_occupancy import RecordedOccupancy
from parkenv.world.scenario import Scenario

# Columns of `SearchTables.at`, a row a scenario: counts, kinds, and where in the pools its arrays begin.
(
    N_SLOTS, PERFECT, ARRIVAL_WEEKDAYS, N_WEEKDAYS, ENTRIES, N_ENTRIES, TARGETS, VIEWS, VIEWED, MASKS,
    NUMBERS, SECONDS, METRES, WALK_S, WALK_M, SEEN_RATE, HIT_RATE, FALSE_ALARM_RATE,
    WORLD_KIND, WORLD_REALS, WORLD_INTS, WORLD_KEPT, PRIOR_KIND, PRIOR_REALS, PRIOR_KEPT,
) = range(25)  # fmt: skip
_N_COLUMNS = 25

# At NUMBERS in the reals.
FAILURE_S, GIVE_UP_S, WINDOW_START, WINDOW_END = range(4)

PROCESS, LOG, ASKED = range(3)
"""Kinds of world and prior: a generating process; a replayed log; asked in Python at every arrival."""

N_ACTIONS = PARK + 1
# A process in the reals: two factors a slot, two profiles, two tables of hazard; row 0 is left by arrivals.
PROFILES = 2 * WEEK_HOURS
HAZARDS = 2 * (WEEK_HOURS + 1)


class SearchTables(NamedTuple):
    """What does not change while cars search, of one scenario or several.

    Attributes:
        at: (n_scenarios, 25) int64, see the names of its columns.
        ints: int32 pool: graph, views, weekdays, entries, records of logs.
        reals: float64 pool: times, distances, rates, costs, occupancy models.
        kept: float64 pool, marginals at full hours, worked out when they are first wanted; 0 before.
    """

    at: NDArray[np.int64]
    ints: NDArray[np.int32]
    reals: NDArray[np.float64]
    kept: NDArray[np.float64]

    @classmethod
    def of(cls, scenarios: Sequence[Scenario]) -> SearchTables:
        """Lay scenarios out.

        Raises:
            InputError: an occupancy that is neither a process nor a log.
        """
        ints, reals, kept = _Pool(np.int32), _Pool(np.float64), _Marginals()
        at = np.zeros((len(scenarios), _N_COLUMNS), dtype=np.int64)
        for row, scenario in zip(at, scenarios, strict=True):
            _lay_out_search(row, scenario, ints, reals)
            _lay_out_occupancy(row, scenario, ints, reals, kept)
        return cls(at, ints.joined(), reals.joined(), kept.joined())


class _Pool:
    """Arrays one after another, and where each begins."""

    def __init__(self, dtype: type) -> None:
        self._dtype = dtype
        self._parts: list[NDArray[Any]] = []
        self._size = 0

    def add(self, values: ArrayLike) -> int:
        part: NDArray[Any] = np.asarray(values, dtype=self._dtype).ravel()
        start = self._size
        self._parts.append(part)
        self._size += part.size
        return start

    def joined(self) -> NDArray[Any]:
        return np.concatenate([*self._parts, np.zeros(1, self._dtype)])


class _Marginals:
    """Room for the marginals of each process; one alone shares what it has worked out."""

    def __init__(self) -> None:
        self._start: dict[int, int] = {}
        self._of: list[OccupancyProcess] = []
        self._size = 0

    def add(self, process: OccupancyProcess) -> int:
        if id(process) not in self._start:
            self._start[id(process)] = self._size
            self._of.append(process)
            self._size += process.kept.size
        return self._start[id(process)]

    def joined(self) -> NDArray[np.float64]:
        return self._of[0].kept if len(self._of) == 1 else np.zeros(max(self._size, 1))


def _lay_out_search(row: NDArray[np.int64], scenario: Scenario, ints: _Pool, reals: _Pool) -> None:
    lot, masks = scenario.lot, scenario.action_masks
    # Every action leads somewhere: what the graph does not have, and parking, to where the car is.
    targets = np.repeat(np.arange(lot.n_vertices)[:, None], N_ACTIONS, axis=1)
    seconds = np.full(targets.shape, scenario.wait_s)
    metres = np.zeros(targets.shape)
    moves = masks[:, : len(MOVES)] == 1
    targets[:, :PARK][moves] = lot.neighbors[moves]
    seconds[:, :PARK][moves] = scenario.move_s[moves]
    metres[:, :PARK][moves] = lot.edge_length[moves]
    seconds[: lot.n_slots, PARK] = 0.0
    entries = lot.entry_vertices if scenario.entry is None else lot.entry_vertices[[scenario.entry]]
    views, viewed = scenario.slots_in_view
    rates = scenario.sensor_rates
    row[N_SLOTS], row[PERFECT] = lot.n_slots, scenario.sensor_model.perfect
    row[ENTRIES], row[N_ENTRIES] = ints.add(entries), len(entries)
    row[TARGETS], row[VIEWS], row[VIEWED] = ints.add(targets), ints.add(views), ints.add(viewed)
    row[MASKS] = ints.add(masks @ (1 << np.arange(N_ACTIONS)))
    window = scenario.arrival
    row[NUMBERS] = reals.add([scenario.failure_s, scenario.give_up_s, window.start_s, window.end_s])
    row[SECONDS], row[METRES] = reals.add(seconds), reals.add(metres)
    row[WALK_S], row[WALK_M] = reals.add(scenario.walk_s), reals.add(lot.walk_m(scenario.goal))
    row[SEEN_RATE], row[HIT_RATE], row[FALSE_ALARM_RATE] = map(reals.add, rates)


def _lay_out_occupancy(
    row: NDArray[np.int64], scenario: Scenario, ints: _Pool, reals: _Pool, kept: _Marginals
) -> None:
    occupancy, prior = scenario.occupancy, scenario.prior
    if isinstance(occupancy, OccupancyProcess):
        row[WORLD_KIND] = PROCESS
        row[WORLD_REALS], row[WORLD_KEPT] = _add_process(occupancy, reals), kept.add(occupancy)
        weekdays = list(scenario.arrival.weekdays)
    elif isinstance(occupancy, RecordedOccupancy):
        row[WORLD_KIND] = LOG
        days = occupancy.days_in(scenario.arrival)
        weekdays = [weekday_of(day) for day in days]
        row[WORLD_REALS], row[WORLD_INTS] = _add_log(occupancy, days, ints, reals)
    else:
        raise InputError(
            f"occupancy is a {type(occupancy).__name__}, want an OccupancyProcess or a RecordedOccupancy"
        )
    row[ARRIVAL_WEEKDAYS], row[N_WEEKDAYS] = ints.add(weekdays), len(weekdays)
    if prior is None or prior is occupancy:
        row[PRIOR_KIND], row[PRIOR_REALS], row[PRIOR_KEPT] = row[[WORLD_KIND, WORLD_REALS, WORLD_KEPT]]
    elif isinstance(prior, OccupancyProcess):
        row[PRIOR_KIND] = PROCESS
        row[PRIOR_REALS], row[PRIOR_KEPT] = _add_process(prior, reals), kept.add(prior)
    else:
        row[PRIOR_KIND] = ASKED


def _add_process(process: OccupancyProcess, reals: _Pool) -> int:
    start = reals.add(process.profiles)
    reals.add(process.tables)
    reals.add(process.factors)
    return start


# A log in the ints: how many slots, days and records it has; for each day to be replayed n records and n log slots;
# where each record begins; the looks. In the reals: for each of those days its midnight, the relaxation rate, how many
# records are left to forecast from, 24 sums, and shares and numbers of days of each log slot; then when looks begin.
LOG_HEAD = 3
DAY_HEAD = 3 + 24
PER_LOG_SLOT = 24 + 1


def _add_log(occupancy: RecordedOccupancy, days: list[str], ints: _Pool, reals: _Pool) -> tuple[int, int]:
    log = occupancy.log
    start = ints.add([len(log.slot_ids), len(days), len(log.first) - 1])
    layouts = [occupancy.layout(day) for day in days]
    for layout in layouts:
        ints.add(layout.record)
        ints.add(layout.log_slot)
    ints.add(log.first)
    ints.add(log.occupied)
    first = reals.add([])
    for day, layout in zip(days, layouts, strict=True):
        reals.add([weekday_of(day) * DAY_S, layout.decay_rate, layout.n_records])
        reals.add(layout.lot_share)
        reals.add(layout.share)
        reals.add(layout.n_days)
    reals.add(log.from_s)
    return first, start
