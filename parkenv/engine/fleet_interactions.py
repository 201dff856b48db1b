"""How cars of a fleet get in each other's way: blocked lanes, queues, and slots that a waiting car holds.

A car that manoeuvres, or stands, blocks the vertex where it is. A car that would reach a blocked vertex waits before
it, and blocks the vertex that it comes from, so queues grow backwards. Cars that leave soon show it by their lights; a
car that stands before such a slot holds it against others, until it drives on.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from parkenv.compiled.memory import float64s, int64s
from parkenv.engine.shared_slots import NO_CAR, leaves_soon, shared_slot_at
from parkenv.world.occupancy.kernel import inlined, kernel


@kernel
def clear_lanes(fleet: Any) -> None:
    """Begin a world: no lane is blocked."""
    until, by = float64s(fleet.blocked_until), int64s(fleet.blocked_by)
    for vertex in range(fleet.n_vertices):
        until[vertex], by[vertex] = -np.inf, NO_CAR


@inlined
def block_lane(fleet: Any, vertex: int, until: float, number: int) -> None:
    """Block a vertex for other cars until a time, s, if cars block lanes."""
    if fleet.manoeuvre_s > 0.0 and until > float64s(fleet.blocked_until)[vertex]:
        float64s(fleet.blocked_until)[vertex] = until
        int64s(fleet.blocked_by)[vertex] = number


@inlined
def blocked_until(fleet: Any, car: Any, number: int) -> float:
    """Return until when another car blocks the vertex that a car has driven to; in the past if none does."""
    if fleet.manoeuvre_s == 0.0 or car.stands or int64s(fleet.blocked_by)[car.vertex] == number:
        return -np.inf
    return float(float64s(fleet.blocked_until)[car.vertex])


@inlined
def hold_slot(fleet: Any, car: Any, number: int) -> None:
    """Let a standing car hold the slot before it if the car in it shows that it leaves, and nobody else holds it."""
    slot = car.vertex
    if fleet.leaving_soon_s > 0.0 and slot < fleet.n_slots:
        shared = shared_slot_at(fleet.slots, slot)
        if shared.held_by == NO_CAR and leaves_soon(fleet, slot, fleet.time, fleet.leaving_soon_s):
            shared.held_by, car.holds = number, slot


@inlined
def release_slot(fleet: Any, car: Any) -> None:
    """Let a car no longer hold a slot."""
    if car.holds != NO_CAR:
        shared_slot_at(fleet.slots, car.holds).held_by = NO_CAR
        car.holds = NO_CAR
