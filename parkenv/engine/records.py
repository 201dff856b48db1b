"""Scenarios, searches, and worlds of many cars as records with named fields, for the compiled engine."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import copy
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse.csgraph import dijkstra

from parkenv.compiled.arrays import IntArray
from parkenv.compiled.memory import (
    ADDRESS,
    LINE,
    address_of,
    in_one_block,
    record_at,
    sparse_zeros,
    zeros_on_lines,
)
from parkenv.errors import InputError
from parkenv.files.known_names import KNOWLEDGE
from parkenv.world.cost_terms import COST_FIELDS, COST_TERMS
from parkenv.world.lot import PARK
from parkenv.world.occupancy.kernel import (
    CURSOR_FIELDS,
    EXTERNAL_KIND,
    LOG_KIND,
    PROCESS_KIND,
    RECORDED_DAY,
    WORLD_FIELDS,
)
from parkenv.world.occupancy.process import Arrival, CompiledModel, PriorModel, World
from parkenv.world.scenario import EDGE, Scenario, SearchProblem

N_ACTIONS = PARK + 1

SCENARIO = np.dtype(
    [
        ("n_slots", np.int64),
        ("n_vertices", np.int64),
        # Whether slots in view are observed without error, and whether that is all that is observed.
        ("no_errors", np.bool_),
        ("exact_sensor", np.bool_),
        ("failure_s", np.float64),
        ("give_up_s", np.float64),
        # Whether a search ends once every slot was last observed taken.
        ("leave_full_lot", np.bool_),
        # Cost of a move that the graph does not have, s; number of slots in which the scenario's driver may not park.
        ("wait_s", np.float64),
        ("n_forbidden", np.int64),
        # Arrival window and entries: seconds of the day; (n_weekdays,) int64; (n_entries,) int64 vertices.
        ("window_start", np.float64),
        ("window_end", np.float64),
        ("n_weekdays", np.int64),
        ("weekdays", ADDRESS),
        ("n_entries", np.int64),
        ("entries", ADDRESS),
        # (n_vertices, 5) EDGE records.
        ("edges", ADDRESS),
        # (n_vertices, 5) uint8, mask of the actions that the graph has.
        ("action_masks", ADDRESS),
        # (n_slots,) float64: walk to the goal, s and m; parking cost for the expected stay, s, and without prices.
        ("walk_s", ADDRESS),
        ("walk_m", ADDRESS),
        ("parking_cost_s", ADDRESS),
        ("lot_cost_s", ADDRESS),
        # (n_slots,) int64 tariff zone of each slot.
        ("zone_of_slot", ADDRESS),
        # (n_slots,) float64 expected time from the entry of a counted facility to a space, s, or 0 without any.
        ("enter_s", ADDRESS),
        # Facilities with a live count: how many; (n_live,) int64 slots; (n_live, n_vertices) float64 drive from each
        # vertex, s; expected departures of a car, 1/s.
        ("n_live", np.int64),
        ("live", ADDRESS),
        ("live_drive_s", ADDRESS),
        ("turnover", np.float64),
        # Slots in view of vertex v are viewed[view_starts[v]] to viewed[view_starts[v + 1]], excluded; int64 both.
        ("view_starts", ADDRESS),
        ("viewed", ADDRESS),
        # For each of `viewed`, float64: P(in sight), P(observed taken | taken), P(observed taken | free).
        ("seen_rate", ADDRESS),
        ("hit_rate", ADDRESS),
        ("false_alarm_rate", ADDRESS),
        # For PROCESS_KIND, a PROCESS record; for LOG_KIND, RECORDED_DAY records, one for each of `weekdays`; for
        # SHARED_KIND, the SHARED_WORLD record; 0 if Python makes the world of every search.
        ("world_kind", np.int64),
        ("world", ADDRESS),
        ("prior_kind", np.int64),
        ("prior", ADDRESS),
    ],
    align=True,
)
"""The constant part of the searches in a scenario; the comments describe the arrays at the addresses."""

_TABLES = tuple(
    name
    for name in SCENARIO.names or ()
    if SCENARIO[name] == ADDRESS
    and name
    not in (
        "n_slots",
        "n_vertices",
        "n_weekdays",
        "n_entries",
        "world_kind",
        "prior_kind",
        "n_forbidden",
        "n_live",
    )
)
N_REGIONS = 4

N_TERMS = len(COST_TERMS)
_SUMS = [
    # Costs over the episode, s; their sum; m.
    *((name, np.float64) for name in COST_FIELDS),
    ("total_s", np.float64),
    ("driven_m", np.float64),
    ("walked_m", np.float64),
    ("failed_parks", np.int64),
    ("slots_passed", np.int64),
    ("n_steps", np.int64),
]
STEP_FIELDS = tuple(f"step_{name}" for name in COST_FIELDS)
"""Fields of the costs of the last step."""
_PROGRESS = [
    *_SUMS,
    # Costs of the last step, s.
    *((name, np.float64) for name in STEP_FIELDS),
    # Current status; times in s since Monday 00:00.
    ("vertex", np.int64),
    ("previous_vertex", np.int64),
    ("time", np.float64),
    ("parked", np.bool_),
    ("over", np.bool_),
    # The world; index of the weekday or recorded day among the scenario's; second of that day at the arrival.
    *WORLD_FIELDS,
    ("day", np.int64),
    ("second_of_day", np.float64),
    # Counts: slots with a column in the tables; slots observed; of those, free when first observed, expected to be
    # free, and taken when last observed.
    ("n_columns", np.int64),
    ("n_observed", np.int64),
    ("n_observed_free", np.float64),
    ("n_expected_free", np.float64),
    ("n_last_observed_taken", np.int64),
    # Number of observations of the last step in `step_observed`, and of its entries that may be in use.
    ("n_step_observed", np.int64),
    ("n_step_used", np.int64),
    # For the local observation: forecast fraction of free slots in each quarter of the lot; the best slot observed
    # free, or -1.
    ("free_by_region", np.float64, (N_REGIONS,)),
    ("remembered_slot", np.int64),
    # Index of the search's scenario; number of slots in which the driver may not park.
    ("place", np.int64),
    ("n_forbidden", np.int64),
]
_EPISODES = [("episode", np.int64), ("seed_state", np.uint64), ("clock", np.float32, (2,))]

PROGRESS_FIELDS = tuple(str(entry[0]) for entry in _PROGRESS + _EPISODES)
"""Fields of a SEARCH record that a search changes."""


def _with_costs(fields: Sequence[Any], **arrays: str) -> np.dtype[Any]:
    """Return the record type of some fields, in which arrays of `N_TERMS` costs overlie the fields that begin there.

    A record is a whole number of cache lines.
    """
    plain = np.dtype(list(fields), align=True)
    assert plain.names is not None
    assert plain.fields is not None
    members = {name: plain.fields[name][:2] for name in plain.names}
    for name, first in arrays.items():
        members[name] = np.dtype((np.float64, (N_TERMS,))), plain.fields[first][1]
    formats, offsets = zip(*members.values(), strict=True)
    size = -(-plain.itemsize // LINE) * LINE
    layout = {"names": list(members), "formats": formats, "offsets": offsets, "itemsize": size}
    return np.dtype(layout, align=True)  # type: ignore[call-overload, no-any-return]


SEARCH = _with_costs(
    [
        *_PROGRESS,
        # Number of the episode, and the mixed seed: together they give `key`.
        *_EPISODES[:2],
        # Time since Monday 00:00, and since the search began, as observed.
        _EPISODES[2],
        # The SCENARIO records, and from how many of them, the first ones, the place of an episode is drawn.
        ("scenarios", ADDRESS),
        ("n_places", np.int64),
        # Place, entry and day of the next episode, counted from 1, or 0 to draw them; second of that day.
        ("chosen_place", np.int64),
        ("chosen_entry", np.int64),
        ("chosen_day", np.int64),
        ("chosen_second", np.float64),
        # Number of the car in its fleet, where slots are shared; (2 n_vertices,) uint8 moves to the target of its
        # compiled policy, the last one first; the slot that a guidance system has reserved for it, `NO_SLOT`, or
        # `UNGUIDED`.
        ("car", np.int64),
        ("moves", ADDRESS),
        ("reserved", np.int64),
        # (n_zones,) float64, s, what the car's own stay costs in each zone, infinite where the driver may not park; 0:
        # that of the scenario's driver. Factor of the walk: 2 where the way back counts.
        ("zone_cost_s", ADDRESS),
        ("walks", np.float64),
        # Data of the search: its SCENARIO record; BLOCK records; SLOT records; (n_slots,) int32 columns; (2, width)
        # float64 forecast and decay rate of an external prior, or 0; (2,) float32 day error of the forecast; the
        # record of the world: PROCESS, RECORDED_DAY, FUNCTIONS or SHARED_WORLD.
        ("scenario", ADDRESS),
        ("blocks", ADDRESS),
        ("slots", ADDRESS),
        ("columns", ADDRESS),
        ("external_forecast", ADDRESS),
        ("day_error", ADDRESS),
        ("world", ADDRESS),
        # Number of slots of the largest lot; (width,) float32 current belief, (4, width) float32 `belief` and
        # (4, most_observed) float32 `step_observed` of the observation, or 0 if these are not kept.
        ("width", np.int64),
        ("p_occupied", ADDRESS),
        ("belief", ADDRESS),
        ("most_observed", np.int64),
        ("step_observed", ADDRESS),
    ],
    costs=COST_FIELDS[0],
    step_costs=STEP_FIELDS[0],
)
"""A running search; `costs` and `step_costs` are its costs by term, (N_TERMS,)."""

NO_SLOT, UNGUIDED = -1, -2
"""`reserved` of a search for which a guidance system has no slot, and of one without a guidance system."""
SENTINEL = 0  # column shared by all slots without their own: they were not observed

SLOT = np.dtype(
    [
        ("slot", np.int32),
        *CURSOR_FIELDS,
        ("observed", np.bool_),
        ("observed_taken", np.bool_),
        ("passed", np.bool_),
    ],
    align=True,
)
"""A slot with a column: true state as in CURSOR; whether it was observed, was last observed taken, was passed."""

SPARSE_SLOTS = 4096
"""Slots from which the tables of a fleet's searches take memory only where they are written."""
DENSE_SLOTS = 2**24
"""Slots of all searches up to which their tables, a gigabyte then, are in large pages."""
BLOCK_BITS = 3
BLOCK_SIZE = 1 << BLOCK_BITS
BLOCK = np.dtype(
    [
        (name, np.float64, (BLOCK_SIZE,))
        for name in ("prior", "decay_rate", "p_observed", "observed_at", "p_occupied")
    ],
    align=True,
)
"""The belief in 8 slots: forecast; decay rate, 1/s; P(taken) after the last observation; its time, s; current P(taken).

A few vector instructions update a block, and the data of a search stay close together in memory.
"""

FORECAST, DECAY_RATE, P_OBSERVED, OBSERVED_AT = range(4)  # the parts of the observation's `belief`
NEVER_OBSERVED = -1.0  # `observed_at` of a slot not observed in this search

scenario_at, search_at, edge_at = record_at(SCENARIO), record_at(SEARCH), record_at(EDGE)
slot_at, block_at = record_at(SLOT), record_at(BLOCK)

# ---- slots that many cars share

BACKGROUNDS = ("process", "residents", "none")
PROCESS_BACKGROUND, RESIDENTS_BACKGROUND, NO_BACKGROUND = range(3)
NO_CAR = -1

# Records do not begin with another's fields: numba would take them for that type, with a warning.
SHARED_WORLD_FIELDS = [
    # (n_slots,) SHARED_SLOT records.
    ("n_slots", np.int64),
    ("slots", ADDRESS),
    # Index of the first slot that stands for a counted facility, and COUNTED records of these.
    ("first_counted", np.int64),
    ("counted", ADDRESS),
    *WORLD_FIELDS,
    ("background", np.int64),
    # The scenario's own world: its kind; the PROCESS or FUNCTIONS record, or the RECORDED_DAY of the day.
    ("world_kind", np.int64),
    ("world", ADDRESS),
]
SHARED_WORLD = np.dtype(SHARED_WORLD_FIELDS, align=True)
"""The hidden occupancy of a world that many cars share. A longer record that begins with these fields also serves, by
its address.

A slot is taken if a car of the fleet stands in it, or else by the *background*: nobody; residents, who were parked when
the world began, leave once and are followed by cars of the fleet only; or the scenario's own world, in which
other cars come and go all day. The slot of a counted facility is taken if as many cars of the fleet as fit are inside,
or before its barrier; it has no background.
"""

SHARED_SLOT = np.dtype(
    [
        ("car", np.int64),
        ("leaves_at", np.float64),
        ("held_by", np.int64),
        *CURSOR_FIELDS,
    ],
    align=True,
)
"""A shared slot: the car of the fleet in it or `NO_CAR`; when that car, or else the resident, leaves or has left, s;
the car that waits for it, or `NO_CAR`; cursor of the background."""

COUNTED = np.dtype(
    [
        ("capacity", np.int64),
        ("n_cars", np.int64),
        ("gate_s", np.float64),
        ("inside_s", np.float64, (2,)),
        ("gate_free_at", np.float64),
        ("delay_s", np.float64),
        ("published", np.int64),
        ("period", np.float64),
    ],
    align=True,
)
"""A counted facility: how many cars fit, and are inside or before its barrier; seconds at the barrier, and from there
to a space when empty and when full; when the barrier is free, s; how often its live count is published, s, 0: at once;
the count published last, and in which period since the beginning of the week."""

shared_world_at, shared_slot_at = record_at(SHARED_WORLD), record_at(SHARED_SLOT)
counted_at = record_at(COUNTED)

# ---- cars, and their world

STATES = ("due", "searching", "parked", "left", "gave_up", "balked", "truncated")
DUE, SEARCHING, PARKED, LEFT, GAVE_UP, BALKED, TRUNCATED = range(7)
"""States of a car: not yet arrived; searching; parked; has left its slot; went elsewhere because the lot was proven
full; went elsewhere because its patience was at an end; ended by the limit of steps."""

OWN_KNOWLEDGE, SHARED_KNOWLEDGE, RESERVE_KNOWLEDGE, FULL_KNOWLEDGE = (
    KNOWLEDGE.index(name) for name in ("own", "shared", "reserve", "full")
)
"""What a car knows of the slots: its own observations; also those on the live map; the slot that the guidance system
has reserved for it; the true state of every slot."""

CAR = _with_costs(
    [
        # The demand: index of the scenario (goal) and of the kind of driver; vertex of the entry; arrival, s since
        # Monday 00:00; s.
        ("place", np.int64),
        ("kind", np.int64),
        ("entry", np.int64),
        ("arrival", np.float64),
        ("stay_s", np.float64),
        ("patience_s", np.float64),
        # Its purpose; factor of the walk; slot in which it stands when the world begins, or -1; number of slots in
        # which it may not park.
        ("purpose", np.int64),
        ("walks", np.float64),
        ("parked_at", np.int64),
        ("n_forbidden", np.int64),
        # The driver: address of the compiled policy, or 0 if Python decides; what it knows.
        ("policy", ADDRESS),
        ("knows", np.int64),
        # Whether it reports to the live map; until when it knows that map, s.
        ("shares", np.bool_),
        ("informed_until", np.float64),
        # One of the states above; the slot, or -1; when the search ended and when the car left its slot, s since Monday
        # 00:00, infinite before.
        ("state", np.int64),
        ("slot", np.int64),
        ("ended_at", np.float64),
        ("left_at", np.float64),
        # Where it is, or is driving to, while it searches; whether it stands there, in a failed attempt or a wait; time
        # spent in queues, s, part of `drive_s`; the slot that it holds, or -1.
        ("vertex", np.int64),
        ("stands", np.bool_),
        ("queued_s", np.float64),
        ("queues_since", np.float64),
        ("holds", np.int64),
        # Sums of the search, complete when it has ended.
        *_SUMS,
        # Its SEARCH record, 0 unless searching. For compiled policies: the target slot, or -1; how many of the moves to
        # it are left; until when the search is expected to last, walk and price included, s since its beginning;
        # whether the target, not observed yet, was the best at the last decision.
        ("search", ADDRESS),
        ("target", np.int64),
        ("n_moves", np.int64),
        ("expected_s", np.float64),
        ("settled", np.bool_),
    ],
    costs=COST_FIELDS[0],
)
"""A car of the fleet; `costs` are its costs by term, (N_TERMS,)."""

_REPORTED = [
    ("time", np.float64),
    ("taken", np.bool_),
    ("hit_rate", np.float64),
    ("false_alarm_rate", np.float64),
    ("p", np.float64),
]
LIVE_SLOT = np.dtype(_REPORTED, align=True)
"""A slot on the live map: time of the last report, s, before all others without one; the observation, and its error
rates; P(taken) then."""

REPORT = np.dtype([("slot", np.int64), *_REPORTED], align=True)
"""A report for the live map."""

STEP = np.dtype(
    [
        ("car", np.int64),
        ("begin", np.float64),
        ("end", np.float64),
        ("origin", np.int64),
        ("vertex", np.int64),
        ("failed", np.bool_),
    ],
    align=True,
)
"""A step of a car, but for the last one, which parks it: index of the car; s since Monday 00:00; the vertices that it
drives from and to; whether it is a failed attempt. A car that does not act at the end of its step waits in a queue."""

FLEET = np.dtype(
    [
        *SHARED_WORLD_FIELDS,
        # The events to come, at most one of each car: its step is over, or it leaves its slot. For both a heap of
        # (n_cars,) float64 times, s, and int32 cars, and how many there are. By car, (n_cars,) int64, the order of
        # events at the same time; number of the next event.
        ("step_times", ADDRESS),
        ("step_cars", ADDRESS),
        ("n_steps_to_end", np.int64),
        ("departure_times", ADDRESS),
        ("departing_cars", ADDRESS),
        ("n_departures", np.int64),
        ("event_ranks", ADDRESS),
        ("event_number", np.int64),
        # Beginning of the day, s since Monday 00:00; index of the day among the scenario's; the time now.
        ("midnight", np.float64),
        ("day", np.int64),
        ("time", np.float64),
        # SCENARIO records by place; (n_cars,) CAR records in order of arrival; index of the next car to arrive.
        ("scenarios", ADDRESS),
        ("n_cars", np.int64),
        ("cars", ADDRESS),
        ("next_car", np.int64),
        # (n_cars, n_zones) float64, s, what each car's stay costs in each zone; 0 without rules of zones.
        ("zone_cost_s", ADDRESS),
        ("n_zones", np.int64),
        # Cars to decide, in order: a ring of n_cars int64.
        ("ready", ADDRESS),
        ("first_ready", np.int64),
        ("n_ready", np.int64),
        # (capacity,) int64 addresses of unused SEARCH records.
        ("free_searches", ADDRESS),
        ("n_free", np.int64),
        # The car whose forecast Python must compute before the next event.
        ("pending", np.int64),
        # Durations are rounded up to multiples of this, s; 0: continuous time. Limit of a car's decisions.
        ("tick_s", np.float64),
        ("max_steps", np.int64),
        # Cars now; number of decisions; integrals over time since the beginning, s: cars searching and parked.
        ("n_searching", np.int64),
        ("n_parked", np.int64),
        ("n_gone", np.int64),
        ("n_decisions", np.int64),
        ("searching_s", np.float64),
        ("parked_s", np.float64),
        # Blocked lanes: length of a manoeuvre, s, 0 without blocking; by vertex, (n_vertices,): until when, s, float64,
        # and by which car, int64. For how long before they leave cars show it, s.
        ("manoeuvre_s", np.float64),
        ("n_vertices", np.int64),
        ("blocked_until", ADDRESS),
        ("blocked_by", ADDRESS),
        ("leaving_soon_s", np.float64),
        # The live map: (n_slots,) LIVE_SLOT; its delay, s; a ring of REPORT records that are not on it yet: its size,
        # the first, and how many there are.
        ("live_map", ADDRESS),
        ("delay_s", np.float64),
        ("reports", ADDRESS),
        ("report_capacity", np.int64),
        ("first_report", np.int64),
        ("n_reports", np.int64),
        # Whether something has happened since slots were last reserved.
        ("reservations_stale", np.bool_),
        # (step_capacity,) STEP records of all steps so far, if they are kept, and how many there are.
        ("steps", ADDRESS),
        ("step_capacity", np.int64),
        ("n_kept_steps", np.int64),
        # By place: (n_slots,) int64 slots by cost of arrival. By kind of driver: int64 address of the data of its
        # compiled policy, or 0.
        ("by_cost", ADDRESS),
        ("policy_data", ADDRESS),
        # (n_vertices,) int64, the vertex by which a blocked lane is known: one for each junction.
        ("junction_of_vertex", ADDRESS),
    ],
    align=True,
)
"""A world with many cars; `arrival` is when it begins, s since Monday 00:00."""

car_at, fleet_at = record_at(CAR), record_at(FLEET)
live_slot_at, report_at, step_at = record_at(LIVE_SLOT), record_at(REPORT), record_at(STEP)


class ScenarioRecords:
    """Scenarios as records, and the arrays that the records point to: one set of tables for any number of searches.

    Args:
        scenarios: the scenarios; or problems without a world, whose searches can only be followed from outside.

    Attributes:
        records: (n,) of the dtype SCENARIO.
        scenarios: the scenarios.
        n_bytes: memory of records and arrays, bytes.

    """

    def __init__(self, scenarios: Sequence[Scenario] | Sequence[SearchProblem]) -> None:
        self._kept: list[Any] = []
        self._kept_at: dict[
            tuple[int, str], tuple[Any, int]
        ] = {}  # arrays that scenarios share, and copies of them
        self._models: list[CompiledModel] = []
        self._model_at: dict[tuple[int, int], tuple[PriorModel, int]] = {}
        self._drives: dict[tuple[int, float], int] = {}
        self.scenarios: tuple[Any, ...] = tuple(scenarios)
        self.records = np.zeros(len(scenarios), SCENARIO)
        for record, scenario in zip(self.records, scenarios, strict=True):
            self._write_problem(record, scenario)
            record["world_kind"] = record["prior_kind"] = EXTERNAL_KIND
            if isinstance(scenario, Scenario):
                self._write_world(record, scenario)
        if len(scenarios) > 1:
            self._join()
        arrays = {id(array): array for array in _arrays_in(self._kept)}
        for model in self._models:
            of_model = _arrays_in([model.record, *model.tables.values(), *model.kept])
            arrays |= {id(array): array for array in of_model}
        self.n_bytes = self.records.nbytes + sum(array.nbytes for array in arrays.values())

    def _join(self) -> None:
        """Move the tables of all scenarios into one block of memory."""
        of_models = [array for model in self._models for array in model.tables.values()]
        tables = [*self._kept, *of_models]
        copies = in_one_block(tables)
        moved = {
            address_of(old, old.dtype): address_of(new, new.dtype)
            for old, new in zip(tables, copies, strict=True)
        }
        models = []
        for model in self._models:
            record = model.record.copy()
            for name in model.tables:
                record[name] = moved[int(record[name][0])]
            moved[address_of(model.record, record.dtype)] = address_of(record, record.dtype)
            models.append(model._replace(record=record, tables={}))
        for name in _TABLES:
            self.records[name] = [moved.get(int(address), int(address)) for address in self.records[name]]
        self._kept, self._models = copies, models

    def _keep(self, values: ArrayLike, dtype: Any = np.float64) -> int:
        """Keep an array, once if several scenarios share it, and return its address."""
        key = id(values), str(np.dtype(dtype))
        if key not in self._kept_at:
            array = np.ascontiguousarray(values, dtype)
            array.flags.writeable = False
            self._kept.append(array)
            self._kept_at[key] = values, address_of(array, dtype)
        return self._kept_at[key][1]

    def _write_problem(self, record: np.void, scenario: SearchProblem) -> None:
        lot, masks = scenario.lot, scenario.action_masks
        starts, viewed = scenario.slots_in_view
        rates = scenario.sensor_rates
        live = scenario.live_slots
        numbers = {
            "n_slots": lot.n_slots,
            "n_vertices": lot.n_vertices,
            "no_errors": scenario.sensor_model.perfect,
            "exact_sensor": scenario.observes_exactly,
            "failure_s": scenario.failure_s,
            "give_up_s": scenario.give_up_s,
            "leave_full_lot": True,
            "wait_s": scenario.wait_s,
            "n_forbidden": int(np.isinf(scenario.parking_cost_s).sum()),
            "n_live": len(live),
            "turnover": 1.0 / max(scenario.stay_s, 1.0),
            "edges": self._keep(scenario.edges, EDGE),
            "action_masks": self._keep(masks, np.uint8),
            "walk_s": self._keep(scenario.walk_s),
            "walk_m": self._keep(lot.walk_m(scenario.goal)),
            "parking_cost_s": self._keep(scenario.parking_cost_s),
            "lot_cost_s": self._keep(lot.slot_parking_cost_s),
            "zone_of_slot": self._keep(lot.zone_of_slot, np.int64),
            "view_starts": self._keep(starts, np.int64),
            "viewed": self._keep(viewed, np.int64),
            "seen_rate": self._keep(rates.seen),
            "hit_rate": self._keep(rates.hit),
            "false_alarm_rate": self._keep(rates.false_alarm),
        }
        if lot.is_counted.any():
            numbers["enter_s"] = self._keep(scenario.enter_s)
        if len(live):
            numbers |= {
                "live": self._keep(live, np.int64),
                "live_drive_s": self._live_drive_s(scenario, live),
            }
        for name, value in numbers.items():
            record[name] = value

    def _live_drive_s(self, scenario: SearchProblem, live: IntArray) -> int:
        """Keep how long cars drive from each vertex to facilities with a live count; once for all goals of a lot."""
        key = id(scenario.lot), scenario.v_drive
        if key not in self._drives:
            metres = dijkstra(scenario.lot.drive_matrix(timed=True).T.tocsr(), indices=live)
            self._drives[key] = self._keep(metres / scenario.v_drive)
        return self._drives[key]

    def _write_world(self, record: np.void, scenario: Scenario) -> None:
        entries = scenario.lot.entry_vertices
        entries = entries if scenario.entry is None else entries[[scenario.entry]]
        record["entries"], record["n_entries"] = self._keep(entries, np.int64), len(entries)
        record["window_start"], record["window_end"] = scenario.arrival.start_s, scenario.arrival.end_s
        occupancy, prior = scenario.occupancy, scenario.prior or scenario.occupancy
        weekdays = [day.weekday for day in occupancy.arrival_days(scenario.arrival)]
        record["weekdays"], record["n_weekdays"] = self._keep(weekdays, np.int64), len(weekdays)
        record["world_kind"], record["world"] = occupancy.kind, self._address_of(occupancy, scenario)
        if prior is occupancy and record["world"]:
            record["prior_kind"], record["prior"] = record["world_kind"], record["world"]
        elif prior.kind == PROCESS_KIND and (address := self._address_of(prior, scenario)):
            record["prior_kind"], record["prior"] = PROCESS_KIND, address

    def _address_of(self, model: PriorModel, scenario: Scenario) -> int:
        """Keep the records of a model, once if scenarios share it, and return their address; 0 without records."""
        key = id(model), id(scenario.arrival)
        if key not in self._model_at:
            compiled = model.compiled(scenario.arrival)
            if compiled is not None:
                self._models.append(compiled)
            address = 0 if compiled is None else address_of(compiled.record, compiled.record.dtype)
            self._model_at[key] = model, address
        return self._model_at[key][1]


def _arrays_in(kept: Sequence[Any]) -> Iterator[NDArray[Any]]:
    """Yield the arrays among what is kept, and those of its occupancy models."""
    for one in kept:
        if isinstance(one, np.ndarray):
            yield one
        else:
            yield from (value for value in vars(one).values() if isinstance(value, np.ndarray))


_ARRAYS = {
    "slots": "slots",
    "blocks": "_blocks",
    "columns": "_columns",
    "external_forecast": "external_forecast",
    "day_error": "day_error",
    "p_occupied": "p_occupied",
    "belief": "belief",
    "step_observed": "step_observed",
}
"""Attributes of `Searches` with a row for each search, by the SEARCH field that holds the row's address."""


class Searches:
    """One or more running searches as records, and the arrays that the records point to.

    Args:
        scenarios: scenarios of the searches; if there are several, one is drawn for each episode.
        n: number of searches.
        full_belief: whether to keep `p_occupied` and `belief` up to date.
        most_observed: maximum number of slots that a step observes; None: those in view, and one more, or 0 without
            the full belief; with 0, `step_observed` is not kept.
        sparse: whether tables take memory only where they are written, by small pages, which are slower; None: if the
            searches have more than `DENSE_SLOTS` in all.

    Attributes:
        records: (n,) of the dtype SEARCH.
        slots: (n, m + 1) of the dtype SLOT, a column for each slot that a search has observed or queried, in order of
            first use; the first column is the sentinel. m is the number of slots of the largest lot.
        external_forecast: (n, 2, m) float64, forecast and decay rate of priors that only Python can compute; else
            (0, 2, 0).
        needs_python: whether an arrival is complete only after `complete_arrival`.
        day_error: (n, 2) float32, logits, day error of each search's forecast: level and slope.
        p_occupied: (n, m) float32, current belief in every slot; (0, 0) if not kept.
        belief: (n, 4, m) float32: forecast, decay rate, belief after the last observation, and its time; (0, 4, 0) if
            not kept.
        step_observed: (n, 4, most_observed) float32, what the last step observed: slot, whether it was observed taken,
            hit rate, false-alarm rate; slot -1 past the last; (0, 4, 0) if not kept.
    """

    def __init__(
        self,
        scenarios: ScenarioRecords,
        n: int,
        full_belief: bool,
        most_observed: int | None = None,
        sparse: bool | None = None,
    ) -> None:
        m = int(scenarios.records["n_slots"].max())
        external = bool((scenarios.records["prior_kind"] == EXTERNAL_KIND).any())
        self.needs_python = external or bool((scenarios.records["world"] == 0).any())
        self._worlds: dict[int, World] = {}  # made in Python, by search
        self.scenarios = scenarios
        self.records = zeros_on_lines((n,), SEARCH)
        if sparse is None:
            sparse = n * m > DENSE_SLOTS
        # Zeros stand for the sentinel. A search observes a small part of a large lot.
        zeros = sparse_zeros if sparse else zeros_on_lines
        self.slots = zeros((n, m + 1), SLOT)
        self._blocks = zeros((n, (m + BLOCK_SIZE) >> BLOCK_BITS), BLOCK)
        self._columns = zeros((n, m), np.int32)
        self.external_forecast = np.zeros((n, 2, m) if external else (0, 2, 0))
        self.day_error = np.zeros((n, 2), np.float32)
        # Padding past the last slot of a smaller lot: taken, constant, never observed.
        self.p_occupied = np.ones((n, m) if full_belief else (0, 0), np.float32)
        self.belief = np.zeros((n, 4, m) if full_belief else (0, 4, 0), np.float32)
        self.belief[:, [FORECAST, P_OBSERVED]] = 1.0
        self.belief[:, OBSERVED_AT] = NEVER_OBSERVED
        if most_observed is None:
            most_observed = most_observed_in(scenarios.scenarios) if full_belief else 0
        k = most_observed
        self.step_observed = np.zeros((n, 4, k) if k > 0 else (0, 4, 0), np.float32)
        self.records["width"], self.records["most_observed"], self.records["n_step_used"] = m, k, k
        self.records["walks"], self.records["reserved"] = 1.0, UNGUIDED
        self.records["scenarios"] = address_of(scenarios.records, SCENARIO)
        self.records["n_places"] = len(scenarios.records)
        self._find_scenarios()
        for name, array in self._arrays().items():
            self._write_addresses(name, array)

    def _write_addresses(self, name: str, array: NDArray[Any]) -> None:
        first = address_of(array, array.dtype)
        self.records[name] = first + np.arange(len(self.records)) * array.strides[0] if len(array) else 0

    def hold(self, p_occupied: NDArray[np.float32], belief: NDArray[np.float32]) -> None:
        """Use these arrays from now on, with the values that they have; of the shapes and types of the class."""
        self.p_occupied, self.belief = p_occupied, belief
        self._write_addresses("p_occupied", p_occupied)
        self._write_addresses("belief", belief)

    def copiers(self, search: int) -> tuple[Callable[[], NDArray[Any]], ...]:
        """Return what copies a search's `clock`, `p_occupied`, `belief`, `step_observed` and `day_error`; flat arrays.

        Bound methods: looking them up would take a tenth of a step.
        """
        parts = (self.p_occupied, self.belief, self.step_observed, self.day_error)
        return (self.records["clock"][search].copy, *(part[search].reshape(-1).copy for part in parts))

    def complete_arrival(self, search: int) -> None:
        """Add what only Python can make for a search that has just begun: its world, its forecast."""
        scenario, record = self.scenario_of(search), self.records[search]
        self._make_world(search)
        if self.scenarios.records["prior_kind"][record["place"]] != EXTERNAL_KIND:
            return
        arrival = arrival_of(scenario, record)
        forecast = scenario.forecast(arrival)
        n = len(forecast.p_occupied)
        self.external_forecast[search, :, :n] = forecast.p_occupied, forecast.decay_rate
        self.day_error[search] = forecast.day_error.level, forecast.day_error.slope

    def begin_outside(self, place: int, observation: Mapping[str, Any]) -> None:
        """Let the only search be one that runs elsewhere: its place among the scenarios, and the forecast."""
        self.records["place"] = place
        self._find_scenarios()
        n = self.external_forecast.shape[2]
        self.external_forecast[0] = observation["belief"].reshape(4, -1)[[FORECAST, DECAY_RATE], :n]

    def scenario_of(self, search: int) -> Scenario:
        """Return the scenario of a search's episode."""
        scenario: Scenario = self.scenarios.scenarios[int(self.records["place"][search])]
        return scenario

    def _find_scenarios(self) -> None:
        """Write the addresses that follow from the places and days."""
        place, scenarios = self.records["place"], self.scenarios.records
        self.records["scenario"] = self.records["scenarios"] + place * SCENARIO.itemsize
        by_day = (scenarios["world_kind"][place] == LOG_KIND) * self.records["day"] * RECORDED_DAY.itemsize
        self.records["world"] = scenarios["world"][place] + by_day

    def _make_world(self, search: int) -> None:
        """Make the world of a search whose scenario has no records of it; addresses differ between processes."""
        scenario, record = self.scenario_of(search), self.records[search]
        if not self.scenarios.records["world"][record["place"]]:
            world = scenario.occupancy.world(np.uint64(record["key"]), arrival_of(scenario, record))
            self._worlds[search], record["world"] = world, world.address

    def _arrays(self) -> dict[str, NDArray[Any]]:
        """The arrays with a row for each search, keyed by the SEARCH field that holds the row's address."""
        return {field: getattr(self, name) for field, name in _ARRAYS.items()}

    @property
    def address(self) -> int:
        """Address of the records, for compiled code; valid while this object lives."""
        return address_of(self.records, SEARCH)

    @property
    def n_bytes(self) -> int:
        """Memory of the searches, bytes, without the shared tables of the scenarios."""
        return sum(array.nbytes for array in (self.records, *self._arrays().values()))

    def row(self, i: int) -> Searches:
        """Return one of the searches by itself, in the same memory: what changes one changes the other."""
        one, rows = copy(self), slice(i, i + 1)
        one.records = self.records[rows]
        for name in _ARRAYS.values():
            setattr(one, name, getattr(self, name)[rows])
        return one

    def save(self, rows: IntArray | None = None) -> tuple[NDArray[Any], ...]:
        """Return copies of everything that a search changes; of some searches, (k,), which may occur several times."""
        rows = np.arange(len(self.records)) if rows is None else rows
        parts = (self.records, *self._arrays().values())
        return tuple(array[rows] if len(array) else array.copy() for array in parts)

    def restore(self, saved: tuple[NDArray[Any], ...]) -> None:
        """Restore a copy returned by `save` of searches in the same scenarios; records may be given as bytes, uint8."""
        records, *arrays = saved
        records = records.view(SEARCH)
        width = int(records["width"][0])
        if width != self.records["width"][0]:
            raise InputError(f"state is of a lot with {width} slots, this one has {self.records['width'][0]}")
        for name in PROGRESS_FIELDS:
            self.records[name] = records[name]
        if not ((self.records["place"] >= 0) & (self.records["place"] < len(self.scenarios.records))).all():
            raise InputError("state is of other scenarios")
        self._find_scenarios()
        for mine, array in zip(self._arrays().values(), arrays, strict=True):
            mine[...] = array.view(mine.dtype)
        if self.needs_python:
            for search in range(len(self.records)):
                self._make_world(search)


def most_observed_in(problems: Sequence[SearchProblem]) -> int:
    """Return the maximum number of slots that a step observes: those in view, and one that the car attempts."""
    return 1 + max(int(np.diff(problem.slots_in_view[0]).max(initial=0)) for problem in problems)


def arrival_of(scenario: Scenario, record: np.void) -> Arrival:
    """Return the arrival of the search in a SEARCH record."""
    days = scenario.occupancy.arrival_days(scenario.arrival)
    return Arrival(float(record["arrival"]), days[int(record["day"])].date)
