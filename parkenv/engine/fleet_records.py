"""A world of many cars as records with named fields, for the compiled engine."""

from __future__ import annotations

import numpy as np

from parkenv.compiled.memory import ADDRESS, record_at
from parkenv.engine.event_queue import QUEUE_FIELDS
from parkenv.engine.shared_slots import SHARED_WORLD_FIELDS

STATES = ("due", "searching", "parked", "left", "gave_up", "balked", "truncated")
DUE, SEARCHING, PARKED, LEFT, GAVE_UP, BALKED, TRUNCATED = range(7)
"""States of a car: not yet arrived; searching; parked; has left its slot; went elsewhere because the lot was proven
full; went elsewhere because its patience was at an end; ended by the limit of steps."""

OWN_KNOWLEDGE, SHARED_KNOWLEDGE, RESERVE_KNOWLEDGE, FULL_KNOWLEDGE = range(4)
"""What a car knows of the slots: its own observations; also those on the live map; the slot that the guidance system
has reserved for it; the true state of every slot."""

CAR_METRICS = (
    "drive_s",
    "failed_s",
    "walk_s",
    "parking_cost_s",
    "gave_up_s",
    "driven_m",
    "walked_m",
    "failed_parks",
    "slots_passed",
    "n_steps",
)
"""Fields of a CAR record that are copied from its SEARCH record when the search ends."""

CAR = np.dtype(
    [
        # The demand: index of the scenario (goal) and of the kind of driver; vertex of the entry; arrival, s since
        # Monday 00:00; s.
        ("place", np.int64),
        ("kind", np.int64),
        ("entry", np.int64),
        ("arrival", np.float64),
        ("stay_s", np.float64),
        ("patience_s", np.float64),
        # The driver: address of the compiled decide function, or 0 if Python decides; what it knows.
        ("rule", ADDRESS),
        ("knows", np.int64),
        # Whether it reports to the live map; until when it knows that map, s; the slot reserved for it, or -1.
        ("shares", np.bool_),
        ("informed_until", np.float64),
        ("reserved", np.int64),
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
        ("drive_s", np.float64),
        ("failed_s", np.float64),
        ("walk_s", np.float64),
        ("parking_cost_s", np.float64),
        ("gave_up_s", np.float64),
        ("driven_m", np.float64),
        ("walked_m", np.float64),
        ("failed_parks", np.int64),
        ("slots_passed", np.int64),
        ("n_steps", np.int64),
        # Its SEARCH record, 0 unless searching. For compiled drivers: the target slot, or -1; the moves to it,
        # (n_vertices,) uint8 from the last to the first, and how many are left.
        ("search", ADDRESS),
        ("target", np.int64),
        ("moves", ADDRESS),
        ("n_moves", np.int64),
    ],
    align=True,
)
"""A car of the fleet."""

LIVE_SLOT = np.dtype([("time", np.float64), ("taken", np.bool_), ("p", np.float64)], align=True)
"""A slot on the live map: time of the last report, s, before all others without one; what it says; P(taken) then."""

REPORT = np.dtype(
    [("time", np.float64), ("slot", np.int64), ("taken", np.bool_), ("p", np.float64)], align=True
)
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
        *QUEUE_FIELDS,
        # Beginning of the day, s since Monday 00:00; index of the day among the scenario's; the time now.
        ("midnight", np.float64),
        ("day", np.int64),
        ("time", np.float64),
        # SCENARIO records by place; (n_cars,) CAR records in order of arrival; index of the next car to arrive.
        ("scenarios", ADDRESS),
        ("n_cars", np.int64),
        ("cars", ADDRESS),
        ("next_car", np.int64),
        # Cars to decide, in order: a ring of n_cars int64.
        ("ready", ADDRESS),
        ("first_ready", np.int64),
        ("n_ready", np.int64),
        # Unused SEARCH records and tables of moves: (capacity,) int64 addresses each.
        ("free_searches", ADDRESS),
        ("free_moves", ADDRESS),
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
        # For compiled drivers, by place: (n_slots,) int64 slots by cost of arrival; float64 median of that cost, s.
        ("by_cost", ADDRESS),
        ("median_cost_s", ADDRESS),
        # For trained networks that drive: (n_kinds,) int64 addresses of NETWORK records by kind of driver.
        ("networks", ADDRESS),
        # Work space of searches for routes: (n_vertices,) float64, int64, int64; (4 n_vertices + 1,) float64, int64.
        ("route_seconds", ADDRESS),
        ("route_from", ADDRESS),
        ("route_stamp", ADDRESS),
        ("route_number", np.int64),
        ("route_keys", ADDRESS),
        ("route_vertices", ADDRESS),
    ],
    align=True,
)
"""A world with many cars; `arrival` is when it begins, s since Monday 00:00."""

car_at, fleet_at = record_at(CAR), record_at(FLEET)
live_slot_at, report_at, step_at = record_at(LIVE_SLOT), record_at(REPORT), record_at(STEP)
