"""Records with named fields for the compiled engine: scenarios, searches, and worlds of many cars.

A field of the type `ADDRESS` holds the address of an array, whose shape and elements its comment gives; 0: none.
Times are in s since Monday 00:00.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from parkenv.compiled.memory import ADDRESS, LINE, record_at
from parkenv.files.known_names import KNOWLEDGE
from parkenv.world.cost_terms import COST_FIELDS, COST_TERMS
from parkenv.world.lot import PARK
from parkenv.world.occupancy.kernel import CURSOR_FIELDS, WORLD_FIELDS
from parkenv.world.scenario import EDGE

N_ACTIONS = PARK + 1
N_REGIONS = 4
N_TERMS = len(COST_TERMS)


Value = Callable[[Any], Any]  # function of a `SearchProblem` or `Scenario` that gives the value of a field
PROBLEM_FIELDS: tuple[tuple[str, Any, Value], ...] = (
    ("n_slots", np.int64, lambda problem: problem.lot.n_slots),
    ("n_vertices", np.int64, lambda problem: problem.lot.n_vertices),
    # Whether slots in view are observed without error, and whether that is all that is observed.
    ("no_errors", np.bool_, lambda problem: problem.sensor_model.perfect),
    ("exact_sensor", np.bool_, lambda problem: problem.observes_exactly),
    ("failure_s", np.float64, lambda problem: problem.failure_s),
    ("give_up_s", np.float64, lambda problem: problem.give_up_s),
    # Whether a search ends once every slot was last observed taken.
    ("leave_full_lot", np.bool_, lambda _: True),
    ("wait_s", np.float64, lambda problem: problem.wait_s),
    # Number of slots in which the scenario's driver may not park.
    ("n_forbidden", np.int64, lambda problem: np.isinf(problem.parking_cost_s).sum()),
    # (n_vertices, 5); (n_vertices, 5); (n_slots,) each.
    ("edges", [EDGE], lambda problem: problem.edges),
    ("action_masks", [np.uint8], lambda problem: problem.action_masks),
    ("walk_s", [np.float64], lambda problem: problem.walk_s),
    ("walk_m", [np.float64], lambda problem: problem.lot.walk_m(problem.goal)),
    ("parking_cost_s", [np.float64], lambda problem: problem.parking_cost_s),
    ("lot_cost_s", [np.float64], lambda problem: problem.lot.slot_parking_cost_s),
    ("zone_of_slot", [np.int64], lambda problem: problem.lot.zone_of_slot),
    # No array without counted facilities.
    ("enter_s", [np.float64], lambda problem: problem.enter_s if problem.enter_s.any() else None),
    # Facilities with a live count: (n_live,) slots; (n_live, n_vertices) drive from each vertex; departures, 1/s.
    ("n_live", np.int64, lambda problem: len(problem.live_slots)),
    ("live", [np.int64], lambda problem: problem.live_slots),
    ("live_drive_s", [np.float64], lambda problem: problem.live_drive_s),
    ("turnover", np.float64, lambda problem: 1.0 / max(problem.stay_s, 1.0)),
    # Slots in view of vertex v are viewed[view_starts[v]] to viewed[view_starts[v + 1]], excluded; of each P(in sight),
    # P(observed taken | taken), P(observed taken | free).
    ("view_starts", [np.int64], lambda problem: problem.slots_in_view[0]),
    ("viewed", [np.int64], lambda problem: problem.slots_in_view[1]),
    ("seen_rate", [np.float64], lambda problem: problem.sensor_rates.seen),
    ("hit_rate", [np.float64], lambda problem: problem.sensor_rates.hit),
    ("false_alarm_rate", [np.float64], lambda problem: problem.sensor_rates.false_alarm),
    # Cues of departures: mean time, s, 0 without any; P(cue | about to leave); P(cue | not).
    ("lead_s", np.float64, lambda problem: getattr(problem.cues, "lead_s", 0.0)),
    ("moving_s", np.float64, lambda problem: getattr(problem.cues, "moving_s", 0.0)),
    ("cue_hit_rate", np.float64, lambda problem: getattr(problem.cues, "hit_rate", 0.0)),
    ("cue_false_alarm_rate", np.float64, lambda problem: getattr(problem.cues, "false_alarm_rate", 0.0)),
)
HIDDEN_FIELDS: tuple[tuple[str, Any, Value], ...] = (
    ("window_start", np.float64, lambda scenario: scenario.arrival.start_s),
    ("window_end", np.float64, lambda scenario: scenario.arrival.end_s),
    ("n_weekdays", np.int64, lambda scenario: len(scenario.arrival_days)),
    ("weekdays", [np.int64], lambda scenario: [day.weekday for day in scenario.arrival_days]),
    ("n_entries", np.int64, lambda scenario: len(scenario.entry_vertices)),
    ("entries", [np.int64], lambda scenario: scenario.entry_vertices),
)
# For PROCESS_KIND, a PROCESS record; for LOG_KIND, RECORDED_DAY records, one for each of `weekdays`; for SHARED_KIND,
# the SHARED_WORLD record; 0 if Python makes the world of every search.
_MODELS = [("world_kind", np.int64), ("world", ADDRESS), ("prior_kind", np.int64), ("prior", ADDRESS)]
# The constant part of the searches in a scenario; [type] in the tables above stands for the address of an array.
SCENARIO = np.dtype(
    [(name, ADDRESS if isinstance(of, list) else of) for name, of, _ in (*PROBLEM_FIELDS, *HIDDEN_FIELDS)]
    + _MODELS,
    align=True,
)
# Fields of a SCENARIO record that hold addresses.
ADDRESSES = (
    *(name for name, of, _ in (*PROBLEM_FIELDS, *HIDDEN_FIELDS) if isinstance(of, list)),
    "world",
    "prior",
)

_SUMS = [
    *((name, np.float64) for name in COST_FIELDS),  # costs over the episode, s
    ("total_s", np.float64),
    ("driven_m", np.float64),
    ("walked_m", np.float64),
    ("failed_parks", np.int64),
    ("slots_passed", np.int64),
    ("n_steps", np.int64),
]
STEP_FIELDS = tuple(f"step_{name}" for name in COST_FIELDS)  # fields of the costs of the last step
_PROGRESS = [
    *_SUMS,
    *((name, np.float64) for name in STEP_FIELDS),
    ("vertex", np.int64),
    ("previous_vertex", np.int64),
    ("time", np.float64),
    ("parked", np.bool_),
    ("over", np.bool_),
    *WORLD_FIELDS,
    ("day", np.int64),  # index among the scenario's weekdays or recorded days
    ("second_of_day", np.float64),  # of that day, at the arrival
    ("n_columns", np.int64),  # slots with a column in the tables
    ("n_observed", np.int64),  # slots observed
    ("n_observed_free", np.float64),  # those that were free when first observed
    ("n_expected_free", np.float64),  # those that were expected to be free
    ("n_last_observed_taken", np.int64),
    ("n_step_observed", np.int64),  # observations of the last step in `step_observed`
    ("n_step_used", np.int64),  # entries of it that may be in use
    # forecast fraction of free slots in each quarter of the lot
    ("free_by_region", np.float64, (N_REGIONS,)),
    ("remembered_slot", np.int64),  # the best slot observed free, or -1
    ("scenario_index", np.int64),  # index of the search's scenario
    ("n_forbidden", np.int64),  # slots in which the driver may not park
]
_EPISODES = [
    ("episode", np.int64),  # number of the episode
    ("seed_state", np.uint64),  # the mixed seed; with the episode it gives `key`
    ("clock", np.float32, (2,)),  # time, and time since the search began, as observed
]

# Fields of a SEARCH record that a search changes.
PROGRESS_FIELDS = tuple(str(entry[0]) for entry in _PROGRESS + _EPISODES)
# Its further fields, besides sizes and addresses.
OPTION_FIELDS = (
    "n_scenarios", "chosen_scenario", "chosen_entry", "chosen_day", "chosen_second", "car", "reserved", "walks",
)  # fmt: skip


def _with_costs(fields: Sequence[Any], **arrays: str) -> np.dtype[Any]:
    """Return the record type of some fields, in which arrays of `N_TERMS` costs overlie the fields that begin there.

    A record is a whole number of cache lines.
    """
    plain: Any = np.dtype(list(fields), align=True)
    members = {name: plain.fields[name][:2] for name in plain.names}
    for name, first in arrays.items():
        members[name] = np.dtype((np.float64, (N_TERMS,))), plain.fields[first][1]
    formats, offsets = zip(*members.values(), strict=True)
    size = -(-plain.itemsize // LINE) * LINE
    layout = {"names": list(members), "formats": formats, "offsets": offsets, "itemsize": size}
    return np.dtype(layout, align=True)  # type: ignore[call-overload, no-any-return]


# A running search; `costs` and `step_costs` are its costs by term, (N_TERMS,).
SEARCH = _with_costs(
    [
        *_PROGRESS,
        *_EPISODES,
        ("scenarios", ADDRESS),  # SCENARIO records
        # number of scenarios, the first ones, from which that of an episode is drawn
        ("n_scenarios", np.int64),
        # scenario, entry and day of the next episode, from 1, or 0 to draw them
        ("chosen_scenario", np.int64),
        ("chosen_entry", np.int64),
        ("chosen_day", np.int64),
        ("chosen_second", np.float64),  # of that day
        ("car", np.int64),  # number of the car in its fleet, where slots are shared
        # (2 n_vertices,) uint8 moves to the target of a compiled policy, the last one first
        ("moves", ADDRESS),
        ("reserved", np.int64),  # slot that a guidance system has reserved, `NO_SLOT`, or `UNGUIDED`
        # (n_zones,) float64, s, what the car's own stay costs, infinite where it may not park; 0: as the scenario says
        ("zone_cost_s", ADDRESS),
        ("walks", np.float64),  # factor of the walk: 2 where the way back counts
        ("scenario", ADDRESS),  # its SCENARIO record
        ("blocks", ADDRESS),  # BLOCK records
        ("slots", ADDRESS),  # SLOT records
        ("columns", ADDRESS),  # (n_slots,) int32
        # (2, width) float64 forecast and decay rate of an external prior, or 0
        ("external_forecast", ADDRESS),
        ("day_error", ADDRESS),  # (2,) float32, of the forecast
        ("world", ADDRESS),  # PROCESS, RECORDED_DAY, FUNCTIONS or SHARED_WORLD record
        ("width", np.int64),  # number of slots of the largest lot
        ("p_occupied", ADDRESS),  # (width,) float32 current belief, or 0 if it is not kept
        ("belief", ADDRESS),  # (4, width) float32, as in the observation, or 0
        ("most_observed", np.int64),
        ("step_observed", ADDRESS),  # (4, most_observed) float32, as in the observation, or 0
        ("cue_table", ADDRESS),  # CUE records by column, or 0 where no scenario has cues
        ("cues", ADDRESS),  # (3, width) float32, as in the observation, or 0
    ],
    costs=COST_FIELDS[0],
    step_costs=STEP_FIELDS[0],
)

# `reserved` of a search for which a guidance system has no slot, and of one without a guidance system.
NO_SLOT, UNGUIDED = -1, -2
SENTINEL = 0  # column shared by all slots without their own: they were not observed

# A slot with a column: true state as in CURSOR, and the search's observations of it.
SLOT = np.dtype(
    [
        ("observed", np.bool_),
        ("observed_taken", np.bool_),  # when last observed
        ("passed", np.bool_),
        ("slot", np.int32),
        *CURSOR_FIELDS,
    ],
    align=True,
)

# What the last observation of a slot has left: the excess of `belief.cue_belief`, its time, s, P(taken), and what was
# observed: the logarithm of P(it | about to leave) / P(it | not).
CUE = np.dtype([(name, np.float64) for name in ("excess", "at", "p", "evidence")], align=True)

# Slots from which the tables of a fleet's searches take memory only where they are written.
SPARSE_SLOTS = 4096
BLOCK_BITS = 3
BLOCK_SIZE = 1 << BLOCK_BITS
# The belief in 8 slots: a few vector instructions update it, and the data of a search stay close together.
BLOCK = np.dtype(
    [
        ("prior", np.float64, (BLOCK_SIZE,)),  # forecast P(taken)
        ("decay_rate", np.float64, (BLOCK_SIZE,)),  # 1/s
        ("p_observed", np.float64, (BLOCK_SIZE,)),  # P(taken) after the last observation
        ("observed_at", np.float64, (BLOCK_SIZE,)),  # its time, s
        ("p_occupied", np.float64, (BLOCK_SIZE,)),  # current P(taken)
    ],
    align=True,
)

FORECAST, DECAY_RATE, P_OBSERVED, OBSERVED_AT = range(4)  # the parts of the observation's `belief`
NEVER_OBSERVED = -1.0  # `observed_at` of a slot not observed in this search

# ---- slots that many cars share

BACKGROUNDS = ("process", "residents", "none")
PROCESS_BACKGROUND, RESIDENTS_BACKGROUND, NO_BACKGROUND = range(3)
NO_CAR = -1

# Records do not begin with another's fields: numba would take them for that type, with a warning.
SHARED_WORLD_FIELDS = [
    ("n_slots", np.int64),
    ("slots", ADDRESS),  # (n_slots,) SHARED_SLOT
    ("first_counted", np.int64),  # index of the first slot that stands for a counted facility
    ("counted", ADDRESS),  # COUNTED records of these
    *WORLD_FIELDS,
    ("background", np.int64),
    ("world_kind", np.int64),  # of the scenario's own world
    ("world", ADDRESS),  # its PROCESS or FUNCTIONS record, or the RECORDED_DAY of the day
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
        ("car", np.int64),  # the car of the fleet in it, or `NO_CAR`
        ("leaves_at", np.float64),  # when that car, or else the resident, leaves or has left
        ("held_by", np.int64),  # the car that waits for it, or `NO_CAR`
        *CURSOR_FIELDS,  # of the background
    ],
    align=True,
)

# A counted facility.
COUNTED = np.dtype(
    [
        ("capacity", np.int64),  # number of cars that fit
        ("n_cars", np.int64),  # inside, or before the barrier
        ("gate_s", np.float64),  # seconds at the barrier
        ("inside_s", np.float64, (2,)),  # seconds from there to a space, when empty and when full
        ("gate_free_at", np.float64),
        ("delay_s", np.float64),  # how often the live count is published; 0: at once
        ("published", np.int64),  # the count published last
        ("period", np.float64),  # in which period since the beginning of the week
    ],
    align=True,
)

# ---- cars, and their world

STATES = ("due", "searching", "parked", "left", "gave_up", "balked", "truncated")
# States of a car: not yet arrived; searching; parked; has left its slot; went elsewhere because the lot was proven
# full; went elsewhere because its patience was at an end; ended by the limit of steps.
DUE, SEARCHING, PARKED, LEFT, GAVE_UP, BALKED, TRUNCATED = range(7)

# What a car knows of the slots: its own observations; also those on the live map; the slot that the guidance system
# has reserved for it; the true state of every slot.
OWN_KNOWLEDGE, SHARED_KNOWLEDGE, RESERVE_KNOWLEDGE, FULL_KNOWLEDGE = (
    KNOWLEDGE.index(name) for name in ("own", "shared", "reserve", "full")
)

# A car of the fleet; `costs` are its costs by term, (N_TERMS,).
CAR = _with_costs(
    [
        ("scenario_index", np.int64),  # index of the scenario (goal)
        ("kind", np.int64),  # of driver
        ("entry", np.int64),  # vertex
        ("arrival", np.float64),
        ("stay_s", np.float64),
        ("patience_s", np.float64),
        ("purpose", np.int64),
        ("walks", np.float64),  # factor of the walk
        ("parked_at", np.int64),  # slot in which it stands when the world begins, or -1
        ("n_forbidden", np.int64),  # slots in which it may not park
        ("policy", ADDRESS),  # of the compiled policy, or 0 if Python decides
        ("knows", np.int64),
        ("shares", np.bool_),  # whether it reports to the live map
        ("informed_until", np.float64),  # until when it knows that map
        ("state", np.int64),  # one of `STATES`
        ("slot", np.int64),  # or -1
        ("ended_at", np.float64),  # when the search ended, infinite before
        ("left_at", np.float64),  # when it left its slot, infinite before
        ("vertex", np.int64),  # where it is, or is driving to, while it searches
        ("stands", np.bool_),  # whether it stands there, in a failed attempt or a wait
        ("queued_s", np.float64),  # time spent in queues, part of `drive_s`
        ("queues_since", np.float64),
        ("holds", np.int64),  # the slot that it holds, or -1
        *_SUMS,  # of the search, complete when it has ended
        ("search", ADDRESS),  # its SEARCH record, 0 unless searching
        # For compiled policies:
        ("target", np.int64),  # the target slot, or -1
        ("n_moves", np.int64),  # how many of the moves to it are left
        # expected end of the search, walk and price included, s since its beginning
        ("expected_s", np.float64),
        ("settled", np.bool_),  # whether the target, not observed yet, was the best at the last decision
    ],
    costs=COST_FIELDS[0],
)

_REPORTED = [
    ("time", np.float64),  # of the last report, before all others without one
    ("taken", np.bool_),  # the observation
    ("hit_rate", np.float64),
    ("false_alarm_rate", np.float64),
    ("p", np.float64),  # P(taken) then
]
LIVE_SLOT = np.dtype(_REPORTED, align=True)  # A slot on the live map

REPORT = np.dtype([("slot", np.int64), *_REPORTED], align=True)  # A report for the live map

# A step of a car, but for the last one, which parks it. A car that does not act at its end waits in a queue.
STEP = np.dtype(
    [
        ("car", np.int64),
        ("begin", np.float64),
        ("end", np.float64),
        ("origin", np.int64),  # the vertex that it drives from
        ("vertex", np.int64),  # the vertex that it drives to
        ("failed", np.bool_),  # whether it is a failed attempt
    ],
    align=True,
)

# A world with many cars; `arrival` is when it begins.
FLEET = np.dtype(
    [
        *SHARED_WORLD_FIELDS,
        # The events to come, at most one of each car: its step is over, or it leaves its slot. Two heaps.
        ("step_times", ADDRESS),  # (n_cars,) float64
        ("step_cars", ADDRESS),  # (n_cars,) int32
        ("n_steps_to_end", np.int64),
        ("departure_times", ADDRESS),  # (n_cars,) float64
        ("departing_cars", ADDRESS),  # (n_cars,) int32
        ("n_departures", np.int64),
        ("event_ranks", ADDRESS),  # (n_cars,) int64, by car, order of events at the same time
        ("event_number", np.int64),  # of the next event
        ("midnight", np.float64),  # beginning of the day
        ("day", np.int64),  # index among the scenario's
        ("time", np.float64),  # now
        ("scenarios", ADDRESS),  # SCENARIO records, one for each goal
        ("n_cars", np.int64),
        ("cars", ADDRESS),  # (n_cars,) CAR, in order of arrival
        ("next_car", np.int64),  # index of the next car to arrive
        # (n_cars, n_zones) float64, what each car's stay costs; 0 without rules of zones
        ("zone_cost_s", ADDRESS),
        ("n_zones", np.int64),
        ("ready", ADDRESS),  # cars to decide, in order: a ring of n_cars int64
        ("first_ready", np.int64),
        ("n_ready", np.int64),
        ("free_searches", ADDRESS),  # (capacity,) int64 addresses of unused SEARCH records
        ("n_free", np.int64),
        ("pending", np.int64),  # the car whose forecast Python must compute before the next event
        ("tick_s", np.float64),  # durations are rounded up to multiples of it; 0: continuous time
        ("max_steps", np.int64),  # limit of a car's decisions
        ("n_searching", np.int64),  # cars now
        ("n_parked", np.int64),
        ("n_gone", np.int64),
        ("n_decisions", np.int64),
        ("searching_s", np.float64),  # integral over time of the cars that search
        ("parked_s", np.float64),  # and of those that are parked
        ("manoeuvre_s", np.float64),  # time that a manoeuvre blocks its lane, 0 without blocking
        ("n_vertices", np.int64),
        ("blocked_until", ADDRESS),  # (n_vertices,) float64
        ("blocked_by", ADDRESS),  # (n_vertices,) int64, which car
        ("live_map", ADDRESS),  # (n_slots,) LIVE_SLOT
        ("delay_s", np.float64),  # of the live map
        ("reports", ADDRESS),  # a ring of REPORT records that are not on the live map yet
        ("report_capacity", np.int64),
        ("first_report", np.int64),
        ("n_reports", np.int64),
        ("reservations_stale", np.bool_),  # whether something has happened since slots were last reserved
        ("steps", ADDRESS),  # (step_capacity,) STEP, all steps so far, if they are kept
        ("step_capacity", np.int64),
        ("n_kept_steps", np.int64),
        ("by_cost", ADDRESS),  # by scenario: (n_slots,) int64 slots by cost of arrival
        ("policy_data", ADDRESS),  # by kind of driver: int64 address of the data of its compiled policy, or 0
        ("junction_of_vertex", ADDRESS),  # (n_vertices,) int64, the vertex by which a blocked lane is known
    ],
    align=True,
)

scenario_at, search_at, edge_at = record_at(SCENARIO), record_at(SEARCH), record_at(EDGE)
slot_at, block_at, cue_at = record_at(SLOT), record_at(BLOCK), record_at(CUE)
shared_world_at, shared_slot_at = record_at(SHARED_WORLD), record_at(SHARED_SLOT)
counted_at, car_at, fleet_at = record_at(COUNTED), record_at(CAR), record_at(FLEET)
live_slot_at, report_at, step_at = record_at(LIVE_SLOT), record_at(REPORT), record_at(STEP)
